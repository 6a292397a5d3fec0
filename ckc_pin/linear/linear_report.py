"""Linear models and the stability of controllers, as plain data and in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.base.summary import format_eigenvalues, to_pairs
from ckc_pin.linear.linear_model import LinearModel, eigenvalues_of
from ckc_pin.linear.stability_result import Stability

if TYPE_CHECKING:
    from rich.text import Text

__all__ = [
    "linear_plain",
    "linear_text",
    "save_linear",
    "stability_plain",
    "stability_text",
    "stability_warning",
]

UNDAMPED = 1e-9  # of the fastest eigenvalue: a rate of decay that is none
OFF = 1e-6  # rad or m: less off a motion is not worth a word


def linear_plain(model: LinearModel) -> dict[str, Any]:
    """Return a linear model as JSON-ready data (docs/reference/json.md)."""
    closed = model.closed_loop
    return {
        "name": model.name,
        "states": model.states,
        "inputs": model.inputs,
        "outputs": model.outputs,
        **{name: getattr(model, name).tolist() for name in "ABCD"},
        "eigenvalues": to_pairs(model.eigenvalues),
        "modes": [
            {
                "eigenvalue": to_pairs([mode.eigenvalue])[0],
                "frequency": mode.frequency,
                "damping_ratio": mode.damping_ratio,
                "shape": dict(zip(model.coordinates, to_pairs(mode.shape), strict=True)),
            }
            for mode in model.modes
        ],
        "at": {
            "state": model.at,
            "t": model.t,
            "coordinates": model.coordinates,
            "q_tree": model.q_tree.tolist(),
            "v_tree": model.v_tree.tolist(),
            "tau": model.tau.tolist(),
        },
        "locked": model.locked,
        "closed_loop": None
        if closed is None
        else {"A": closed.tolist(), "eigenvalues": to_pairs(eigenvalues_of(closed))},
        "notes": model.notes,
    }


def linear_text(model: LinearModel) -> Text:
    """Return a linear model for people."""
    from rich.text import Text

    lines = [repr(model)]
    if model.closed_loop is not None:
        lines.append(f"  closed loop: {format_eigenvalues(eigenvalues_of(model.closed_loop))} 1/s")
    return Text("\n".join(lines))


def save_linear(model: LinearModel, path: Path) -> Path:
    """Write a linear model to a file, NumPy's npz without pickle (docs/reference/run_file.md): whole or not at all.

    Raises
    ------
    InputError
        It cannot be written.
    """
    numbers = (*"ABCD", "q_tree", "v_tree", "tau", "motions", "eigenvalues")
    arrays: dict[str, Any] = {name: getattr(model, name) for name in numbers}
    arrays |= {
        name: np.array(getattr(model, name), dtype=str) for name in ("states", "inputs", "outputs", "coordinates")
    }
    about = {"name": model.name, "at": model.at, "t": model.t, "locked": model.locked, "notes": model.notes}
    if model.closed_loop is not None:
        arrays["closed_loop"] = model.closed_loop
    with open_atomic(path) as file:
        np.savez_compressed(file, **arrays, meta=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8))
    return path


# --- periodic motions ----------------------------------------------------------------------------


# --- stability -----------------------------------------------------------------------------------


def stability_plain(found: Stability | None) -> dict[str, Any] | None:
    """Return what a check says of a closed loop as JSON-ready data."""
    if found is None:
        return None
    return {
        **vars(found),
        "eigenvalues": None if found.eigenvalues is None else to_pairs(found.eigenvalues),
        "least_K_P": None if found.least_K_P is None else found.least_K_P.tolist(),
        "offset": None if found.offset is None else found.offset.tolist(),
    }


def stability_text(found: Stability) -> str:
    """Say in a line whether a closed loop is stable, and how much."""
    if found.stable is None:
        return f"not known whether it is stable: {found.reason}"
    says = "stable" if found.stable else "UNSTABLE"
    swings = found.eigenvalues is not None and not found.eigenvalues[0].real
    if swings and not (found.stable or found.sampled or found.growth is not None):
        says = "neither stable nor unstable, nothing damps it,"
    if found.leaves_out:
        says += f", {' and '.join(found.leaves_out)} left out,"
    as_sampled = " as sampled" if found.sampled else ""
    if found.growth is not None and found.largest_growth is not None and found.offset is not None:
        far = float(found.offset.max())
        off = f", a run goes up to {far:.2g} rad or m off it" if found.stable and far > OFF else ""
        values = format_eigenvalues(found.eigenvalues)
        return (
            f"{says} along the motion{as_sampled}: errors grow to {_times(found.largest_growth)} at most, to "
            f"{_times(found.growth)} at its end{off}; eigenvalues at its start {values} 1/s"
        )
    if found.multiplier is not None:
        says += f"{as_sampled}, factor {found.multiplier:.6g} a sample,"
    slowest = "" if found.slowest is None or np.isinf(found.slowest) else f", slowest decay {found.slowest:.3g} s"
    where = "where it rests" if found.least_K_P is None else "at its target"
    return f"{says} {where}{slowest}: eigenvalues {format_eigenvalues(found.eigenvalues)} 1/s"


def stability_warning(found: Stability, independent: tuple[str, ...]) -> list[str]:
    """Say of an unstable loop what would make it stable, and of one that may be why it is not known."""
    if found.stable:
        return _off_target(found, independent)
    if found.stable is None:
        return [f"whether the closed loop is stable is not known: {found.reason}"]
    if found.growth is not None:
        along = "along the desired motion" + (" as sampled" if found.sampled else "")
        helps = (
            "; sample more often, delay less, or take other gains" if found.sampled else
            "; larger Lambda and K_D would help"
        )  # fmt: skip
        return [
            f"the closed loop is unstable {along}: an error may be {_times(found.growth)} as large at its end{helps}"
        ]
    assert found.eigenvalues is not None
    assert found.least_eigenvalue is not None
    worst = float(found.eigenvalues[0].real)
    if found.least_eigenvalue <= 0:
        least = (
            ""
            if found.least_K_P is None
            else f"; the least K_P in its proportions is {_gain(found.least_K_P, independent)}"
        )
        return [
            f"the closed loop is unstable at its target: eigenvalue {worst:.3g} 1/s, and K_P + dh/dq has the "
            f"eigenvalue {found.least_eigenvalue:.4g}{least}"
        ]
    if found.multiplier is not None and worst < -UNDAMPED * np.abs(found.eigenvalues).max():
        return [
            f"the closed loop is unstable as sampled: errors grow {found.multiplier:.6g} times a sample, while without "
            "sampling and delay they would decay; sample more often, delay less, or take smaller gains"
        ]
    return [
        "the closed loop does not come to rest at its target: something swings about it that neither K_V nor the "
        "joints damp; give K_V, or a larger one"
    ]


def _times(growth: float) -> str:
    return f"{growth:.3g} times" if np.isfinite(growth) else "more than 1e308 times"


def _off_target(found: Stability, independent: tuple[str, ...]) -> list[str]:
    if found.offset is None or found.least_K_P is not None or found.growth is not None:
        return []
    off = ", ".join(f"{name} {x:+.4g}" for name, x in zip(independent, found.offset, strict=True))
    return [f"the closed loop rests off its target ({off}): its model's h there is not what the mechanism needs"]


def _gain(K_P: Array, names: tuple[str, ...]) -> str:
    diagonal = np.diagonal(K_P)
    if np.array_equal(K_P, diagonal[0] * np.eye(len(K_P))):
        return f"{diagonal[0]:.6g}"
    if np.array_equal(K_P, np.diag(diagonal)):
        return ", ".join(f"{name} = {x:.6g}" for name, x in zip(names, diagonal, strict=True))
    return str(np.round(K_P, 4).tolist())
