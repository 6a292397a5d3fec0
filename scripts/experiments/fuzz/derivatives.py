"""Random sensitivities through impacts, stops and friction, compared with one-sided differences on both sides.

A derivative exists if difference quotients with a larger and with a smaller parameter have the same limit. Each side is
computed with two steps. Output instants at which they disagree, as next to an event, are ignored.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Terms
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import values_of, with_components
from scripts.experiments.fuzz.contact.stops import set_limits
from scripts.experiments.fuzz.mechanisms import random_mechanism
from scripts.experiments.fuzz.spatial import Array

__all__ = ["ColumnCheck", "Draw", "check_columns", "check_sensitivities", "draw", "format_columns", "is_wrong"]

RTOL, RTOL_RUNS = 1e-10, 1e-12  # of sensitivities, and of the runs for differences
INSTANTS = 40
STEP_FACTOR = 4.0  # ratio of the two difference steps of a side
LARGEST_STEP, SMALLEST_STEP = 1e-2, 1e-6  # relative to the parameter's scale
TARGET_CHANGE = 1e-5  # relative change of the motion by a difference step
NOISE = 3e-11  # relative error of a run's states
AGREEMENT = 1e-3  # derivatives are equal if they differ by less, relative to the largest entry
CONVERGED = 3e-2  # largest difference of the two steps of a side, relative to the largest entry
PARAMETERS = 4  # per mechanism
RANGE_ENDS = {
    "friction": (0.0,),
    "damping": (0.0,),
    "restitution": (0.0, 1.0),
    "armature": (0.0,),
}  # values without a run on one side
WRONG = ("false none", "missed", "wrong value")
EXCEPTION = "exception"
SOLVER_LIMITS = {"solver.max_rhs": 200_000, "solver.max_wall_s": 10.0}


@dataclass(frozen=True)
class Draw:
    """A scene with friction and stops, and the parameters of its sensitivities."""

    seed: int
    kind: str
    scene: Path
    overrides: dict[str, Any]
    parameters: dict[str, float]  # values by name


@dataclass(frozen=True)
class ColumnCheck:
    """Comparison of the sensitivity of one parameter of one scene with differences.

    Attributes
    ----------
    computed : str
        Result of `sensitivities`: "derivative", "none", or the reason why there is neither.
    expected : str
        Result of the differences: "derivative", "none" or "undecided".
    error : float
        Largest error over the allowed one; NaN if it was not computed.
    note : str
        Message of the run with sensitivities.
    """

    seed: int
    kind: str
    formulation: str
    parameter: str
    computed: str
    expected: str
    error: float = np.nan
    note: str = ""

    @property
    def result(self) -> str:
        """Result of the comparison: "right", "false none", "missed", "wrong value" or "undecided"."""
        if self.computed not in ("derivative", "none") or self.expected == "undecided":
            return "undecided"
        if self.computed == "none":
            return "right" if self.expected == "none" else "false none"
        if self.expected == "none":
            return "missed"
        return "wrong value" if self.error > 1.0 else "right"


# --- drawing -----------------------------------------------------------------------------------------


def draw(seed: int, folder: Path) -> Draw:
    """Write a random mechanism with friction and stops to a folder, and draw its start and parameters."""
    random = np.random.default_rng([seed, 41])
    random_files = random_mechanism(seed)
    random_files.write(folder)
    without_contact = ckc_pin.load(folder)
    tree, reach = without_contact.tree, without_contact.tree.step_scale
    numbers = tree.to_coordinates(without_contact.q_tree)
    force = np.abs(Terms(without_contact, without_contact.assembled, np.zeros(without_contact.n)).h_tree)
    force = np.where(force > 1e-9 * force.max(), force, force.max()) if force.any() else np.ones(without_contact.n)
    text, urdf = (folder / "mechanism.toml").read_text(), (folder / "tree.urdf").read_text()
    for name, k in tree.index.items():
        if name in tree.free_coordinates:
            continue
        has_friction, has_stops = random.random() < 0.5, random.random() < 0.4
        if not (has_friction or has_stops):
            continue
        text += f'\n[[joint]]\nname = "{name}"\n'
        if has_friction:
            text += f"friction = {float(force[k] * 10 ** random.uniform(-2, 0.3))!r}\n"
        if has_stops:
            margins = random.uniform(0.02, 0.4, 2) * reach[k]
            if random.random() < 0.25:  # at a stop at t = 0
                margins[int(random.integers(2))] = 0.0
            urdf = set_limits(urdf, name, float(numbers[k] - margins[0]), float(numbers[k] + margins[1]))
            text += f"stops = true\nrestitution = {float(random.choice([0.0, 0.0, 0.3, 0.5, 0.9, 1.0]))!r}\n"
    (folder / "mechanism.toml").write_text(text)
    (folder / "tree.urdf").write_text(urdf)
    mechanism = ckc_pin.load(folder)
    pace = float(np.sqrt(mechanism.size))
    moves = (random.random(mechanism.d) < 0.7) * (random.random() < 0.8)
    unit = reach[mechanism.partition.q]
    rates = (random.normal(size=mechanism.d) * moves * unit / pace).tolist()
    overrides: dict[str, Any] = {
        "initial": {"q_dot": dict(zip(mechanism.independent, rates, strict=True))},
        "t_end": float(0.6 * pace * 10 ** random.uniform(-1, 0)),
        "formulation": "dae" if mechanism.splits_root else str(random.choice(["dae", "reduced"])),
        **SOLVER_LIMITS,
    }
    overrides["solver.output_dt"] = overrides["t_end"] / INSTANTS
    if mechanism.splits_root or random.random() < 0.4:
        overrides["initial"]["at"] = "assembled"
    else:
        start = mechanism.independent_part(mechanism.q_tree).tolist()
        overrides["initial"]["q"] = dict(zip(mechanism.independent, start, strict=True))
    parameters = _parameters(random, mechanism, overrides["initial"]) if _scale(mechanism)[1] else {}
    return Draw(seed, random_files.kind, folder, overrides, parameters)


def _parameters(random: np.random.Generator, mechanism: Mechanism, initial: Mapping[str, Any]) -> dict[str, float]:
    """Draw parameters. The key is drawn first, so that stops and friction are as frequent as inertias."""
    components = with_components(values_of(mechanism.spec, mechanism.urdf))
    values = {name: float(x) for name, x in components.items() if not isinstance(x, tuple)}
    values = {name: x for name, x in values.items() if x not in RANGE_ENDS.get(name.rpartition(".")[2], ())}
    for key in ("q", "q_dot"):
        values |= {f"initial.{key}.{name}": x for name, x in initial.get(key, {}).items()}
    if "at" in initial:  # parameters that change an assembled start are unsupported
        geometry = re.compile(r"joint\..*\.(xyz|rpy)\..|loop\..*|coupling\..*")
        values = {name: x for name, x in values.items() if not geometry.fullmatch(name)}
    groups: dict[str, list[str]] = {}
    for name in values:
        root, second, *_ = parts = name.split(".")
        key = {"initial": second, "gravity": ""}.get(root, parts[-1] if len(parts[-1]) > 1 else parts[-2])
        groups.setdefault(f"{root}.{key}", []).append(name)
    drawn: dict[str, float] = {}
    while len(drawn) < min(PARAMETERS, len(values)):
        of_key = groups[str(random.choice(list(groups)))]
        name = of_key[int(random.integers(len(of_key)))]
        drawn[name] = values[name]
    return drawn


# --- the suite ---------------------------------------------------------------------------------------


def check_sensitivities(seed: int) -> list[ColumnCheck]:
    """Draw a seed's scene and check its sensitivities. An unexpected exception counts as a wrong column."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return check_columns(draw(seed, Path(folder) / "mechanism"))
        except CkcError as error:
            return [ColumnCheck(seed, "", "", "", f"refused: {error}", "undecided")]
        except Exception as error:
            return [ColumnCheck(seed, "", "", "", EXCEPTION, "undecided", note=f"{type(error).__name__}: {error}")]


def is_wrong(column: ColumnCheck) -> bool:
    """Return whether sensitivities and differences contradict each other."""
    return column.computed == EXCEPTION or column.result in WRONG


def format_columns(columns: Sequence[ColumnCheck]) -> str:
    """Return a table of counts by kind of mechanism, the reasons of undecided columns, and all wrong columns."""
    head = ("right", *WRONG, "undecided")
    lines = [f"{'mechanism':18s} {'columns':>8s}" + "".join(f" {name:>12s}" for name in head) + f" {'none':>6s}"]
    kinds = sorted({column.kind for column in columns})
    for kind in (*kinds, "all"):
        of_kind = [column for column in columns if kind in (column.kind, "all")]
        count = Counter(column.result for column in of_kind)
        none = sum(column.expected == "none" for column in of_kind)
        numbers = "".join(f" {count[name]:12d}" for name in head)
        lines.append(f"{kind:18s} {len(of_kind):8d}{numbers} {none:6d}")
    why = Counter(
        "differences do not converge, or on one side alone" if x.computed in ("derivative", "none") else x.computed[:40]
        for x in columns if x.result == "undecided"
    )  # fmt: skip
    lines += ["", "undecided:", *(f"  {count:5d}  {reason}" for reason, count in why.most_common())]
    wrong = [x for x in columns if is_wrong(x)]
    lines += ["", f"wrong: {len(wrong)}"]
    lines += [f"  seed {x.seed}: {x.formulation} {x.parameter}: {x.result} {x.error:.2g} {x.note}" for x in wrong]
    return "\n".join(lines)


# --- comparison -----------------------------------------------------------------------------------------


def check_columns(drawn: Draw) -> list[ColumnCheck]:
    """Compute sensitivities for each parameter alone and for all of them, and compare with differences."""
    if not drawn.parameters:
        return []
    overrides = {**drawn.overrides, "solver.rtol": RTOL_RUNS}
    try:
        run = ckc_pin.simulate(drawn.scene, overrides)
    except CkcError as error:
        return [_column(drawn, name, f"no run: {error}") for name in drawn.parameters]
    if run.status != "done":
        return [_column(drawn, name, f"no run: {run.message}") for name in drawn.parameters]
    columns = [_check_column(drawn, name, run) for name in drawn.parameters]
    return [*columns, *_check_all_parameters(drawn, columns)]


def _column(drawn: Draw, name: str, computed: str, expected: str = "undecided", **more: Any) -> ColumnCheck:
    return ColumnCheck(drawn.seed, drawn.kind, drawn.overrides["formulation"], name, computed, expected, **more)


def _check_all_parameters(drawn: Draw, columns: Sequence[ColumnCheck]) -> list[ColumnCheck]:
    """Check that sensitivities for all parameters exist if and only if they exist for each parameter alone."""
    separate = [column.computed for column in columns]
    if any(computed not in ("derivative", "none") for computed in separate):
        return []
    try:
        result = ckc_pin.sensitivities(drawn.scene, list(drawn.parameters), {**drawn.overrides, "solver.rtol": RTOL})
    except CkcError as error:
        return [_column(drawn, "all", f"refused: {error}")]
    computed, expected = _verdict(result), "none" if "none" in separate else "derivative"
    return [_column(drawn, "all", computed, expected, error=0.0, note=result.run.message)]


def _verdict(result: ckc_pin.Sensitivities) -> str:
    if result.run.status == "done":
        return "derivative"
    return "none" if "no derivative" in result.run.message else f"stopped: {result.run.message}"


def _states(run: ckc_pin.Run, mechanism: Mechanism) -> Array:
    """Return coordinates and rates of the joints by instant, (m, 2 n), scaled by `mechanism`, the unperturbed one."""
    scale, joints = _scale(mechanism)
    return np.hstack([run.q_tree[:, joints], run.v_tree[:, joints]]) / scale


def _scale(mechanism: Mechanism) -> tuple[Array, Sequence[int]]:
    tree = mechanism.tree
    joints = [k for name, k in tree.index.items() if name not in tree.free_coordinates]
    reach = tree.step_scale[joints]
    return np.concatenate([reach, reach / np.sqrt(mechanism.size)]), joints


def _check_column(drawn: Draw, name: str, run: ckc_pin.Run) -> ColumnCheck:
    try:
        result = ckc_pin.sensitivities(drawn.scene, [name], {**drawn.overrides, "solver.rtol": RTOL})
    except CkcError as error:
        return _column(drawn, name, f"refused: {error}")
    computed, note = _verdict(result), result.run.message
    if computed not in ("derivative", "none"):
        return _column(drawn, name, computed, note=note)
    value, base = drawn.parameters[name], run
    try:
        sides = _sides(drawn, name, value, base)
        if computed == "none" and _differ(*sides) is False:  # the difference may decay before the next output instant
            t = float(result.run.t[-1])
            t_end = t + 1e-3 * (run.t[-1] - t)
            drawn = replace(drawn, overrides={**drawn.overrides, "t_end": t_end, "solver.output_dt": t_end})
            base = ckc_pin.simulate(drawn.scene, {**drawn.overrides, "solver.rtol": RTOL_RUNS})
            sides = _sides(drawn, name, value, base)
    except _OneSideOnly as error:
        return _column(drawn, name, computed, note=f"{note}; {error}")
    differ = _differ(*sides)
    expected = "undecided" if differ is None else "none" if differ else "derivative"
    largest = np.nan
    if computed == expected == "derivative":
        scale, joints = _scale(run.mechanism)
        S = np.hstack([result.q_tree[:, joints, 0], result.v_tree[:, joints, 0]]) / scale
        largest = max(side.error(S) for side in sides)
    return _column(drawn, name, computed, expected, error=largest, note=note)


class _OneSideOnly(Exception):
    """There is no run with a larger, or with a smaller, parameter."""


@dataclass(frozen=True)
class _Side:
    """One-sided differences by output instant, and their uncertainty; NaN where the two steps disagree."""

    value: Array
    uncertainty: Array

    def error(self, S: Array) -> float:
        """Return the largest error of sensitivities, over the allowed one."""
        size = max(np.nanmax(np.abs(self.value), initial=0.0), np.abs(S).max())
        allowed = 3 * self.uncertainty + AGREEMENT * size
        return float(np.nanmax(np.abs(S - self.value) / allowed[:, None], initial=0.0))


def _sides(drawn: Draw, name: str, at: float, run: ckc_pin.Run) -> tuple[_Side, _Side]:
    base = _states(run, run.mechanism)
    unit = abs(at) if name.startswith("link.") and at else max(abs(at), 0.1)
    trial = _difference(drawn, name, at, 1e-4 * unit, run) * 1e-4 * unit
    change = float(np.quantile(np.abs(trial).max(axis=1), 0.95))  # some instants are next to an event
    size = max(1.0, np.abs(base).max())
    h = 1e-4 * unit * np.clip(TARGET_CHANGE * size / max(change, 1e-300), SMALLEST_STEP / 1e-4, LARGEST_STEP / 1e-4)
    return _side(drawn, name, at, h, run), _side(drawn, name, at, -h, run)


def _side(drawn: Draw, name: str, at: float, h: float, base: ckc_pin.Run) -> _Side:
    coarse, fine = (_difference(drawn, name, at, step, base) for step in (h, h / STEP_FACTOR))
    value = fine + (fine - coarse) / (STEP_FACTOR - 1)
    uncertainty = np.abs(fine - coarse).max(axis=1)
    noise = NOISE * max(1.0, np.abs(_states(base, base.mechanism)).max()) * STEP_FACTOR / abs(h)
    size = np.median(np.abs(fine).max(axis=1))
    unreliable = uncertainty > CONVERGED * np.maximum(np.abs(fine).max(axis=1), size) + 10 * noise
    value[unreliable], uncertainty[unreliable] = np.nan, np.nan
    return _Side(value, uncertainty + noise)


def _difference(drawn: Draw, name: str, at: float, h: float, base: ckc_pin.Run) -> Array:
    try:
        run = ckc_pin.simulate(drawn.scene, {**drawn.overrides, "solver.rtol": RTOL_RUNS, name: at + h})
    except CkcError as error:
        raise _OneSideOnly(f"{name} {h:+.2g}: {error}") from error
    if run.status != "done":
        raise _OneSideOnly(f"{name} {h:+.2g}: {run.message}")
    return (_states(run, base.mechanism) - _states(base, base.mechanism)) / h


def _differ(one: _Side, other: _Side) -> bool | None:
    """Return whether the derivatives of the two sides differ; None if undecided."""
    size = max(np.nanmax(np.abs(one.value), initial=0.0), np.nanmax(np.abs(other.value), initial=0.0))
    gap = np.abs(one.value - other.value).max(axis=1)
    finite = np.isfinite(gap)
    if finite.sum() < max(1, len(finite) // 4):
        return None
    allowed = 3 * (one.uncertainty + other.uncertainty)[finite] + AGREEMENT * size
    ratio = float((gap[finite] / allowed).max())
    return None if 1.0 < ratio < 3.0 else ratio >= 3.0
