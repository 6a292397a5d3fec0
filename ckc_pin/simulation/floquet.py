"""How a periodic motion answers to a push: its monodromy matrix and Floquet multipliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.kinds import a_kind, is_number
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.initial import find_start
from ckc_pin.simulation.prepare import scene_mechanism
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import Scene, as_scene, make_scene, with_changes
from ckc_pin.simulation.sensitivities import sensitivities
from ckc_pin.simulation.simulate import Progress, simulate

__all__ = ["Floquet", "floquet"]

RETURNS = 1e-5  # rad, m and their rates, of the motion's own size: a motion that comes back
SHARE, ROUNDING = 1e-2, 1e-9  # of how far it goes, if that is little: what hardly moves has not come back from anywhere


@dataclass(frozen=True)
class Floquet:
    """A periodic motion to first order.

    Attributes
    ----------
    states : tuple of str
        Rows and columns: the independent coordinates, then their rates.
    monodromy : (2 d, 2 d) array
        What a small change of the start has become after a period.
    multipliers : (2 d,) complex array
        Its eigenvalues, the largest first: beyond 1 in size the motion is unstable.
    period : float
        s.
    run : Run
    """

    states: tuple[str, ...]
    monodromy: Array
    multipliers: np.ndarray[Any, np.dtype[np.complex128]]
    period: float
    run: Run

    def plain(self) -> dict[str, Any]:
        """Return it as JSON has it, complex numbers as [re, im]."""
        return {
            "name": self.run.scene_name,
            "states": list(self.states),
            "period": self.period,
            "monodromy": self.monodromy.tolist(),
            "multipliers": [[float(x.real), float(x.imag)] for x in self.multipliers],
        }


def floquet(
    scene: Scene | str | Path,
    period: float,
    changes: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Floquet:
    """Return the monodromy matrix and the Floquet multipliers of a scene's motion, which is periodic from its start.

    Parameters
    ----------
    scene : str, Path or Scene
    period : float
        s.
    changes : mapping, optional
        As of `simulate`.
    progress : callable, optional
        Called as progress(t, period) along the variational equations, every 0.05 s or so.

    Returns
    -------
    Floquet

    Raises
    ------
    InputError
        The motion does not come back after the period: the message says by how much it misses.
    NumericalError
        It does not get to its end.
    """
    if not is_number(period):
        raise InputError(f"floquet: period: {a_kind(period)} was given; it takes a number of seconds")
    if not np.isfinite(period) or period <= 0:
        raise InputError(f"period = {period:g}: a positive number of seconds is needed")
    given = as_scene(scene, changes, "floquet")
    loaded = make_scene(with_changes(given.plain(), {"t_end": float(period)}), given.name, given.sources)
    mechanism = scene_mechanism(loaded)
    if mechanism.rooted:
        raise InputError(f"{mechanism.name}: {mechanism.rooted[0]}: a free root among the independent coordinates")
    if loaded.spec.initial.at is not None:
        loaded = _from_coordinates(loaded, mechanism)
    names = mechanism.independent
    _require_period(simulate(loaded), period)  # the motion alone: the variational equations are 2 d more of it
    found = sensitivities(loaded, [f"initial.{of}.{name}" for of in ("q", "q_dot") for name in names], None, progress)
    run = found.run
    _require_period(run, period)
    q = mechanism.partition.q
    monodromy = np.concatenate([found.q_tree[-1][q], found.v_tree[-1][q]])
    multipliers = np.linalg.eigvals(monodromy).astype(np.complex128)
    order = np.argsort(-np.abs(multipliers), kind="stable")
    states = (*names, *(f"{name}_dot" for name in names))
    return Floquet(states, monodromy, multipliers[order], float(period), run)


def _from_coordinates(scene: Scene, mechanism: Mechanism) -> Scene:
    """Start where a scene does, with its coordinates as numbers: they are what is pushed."""
    start = find_start(mechanism, scene)
    q = mechanism.tree.named(mechanism.tree.to_coordinates(start.at.q_tree))
    return make_scene(
        with_changes(scene.plain(), {"initial": {"q": q, "q_dot": scene.spec.initial.q_dot}}), scene.name, scene.sources
    )


def _require_period(run: Run, period: float) -> None:
    """A motion is periodic where it ends as it began; turns of a joint are one place."""
    if run.status == "interrupted":
        raise KeyboardInterrupt(run.message)
    if run.status != "done" or run.t[-1] < period * (1 - 1e-12):
        raise NumericalError(f"floquet: the motion does not reach the end of its period: {run.message}")
    tree = run.mechanism.tree
    for what, values in (("", run.q_tree), (" (rate)", run.v_tree)):
        miss = values[-1] - values[0]
        if not what:
            miss = np.where(tree.in_metres, miss, np.mod(miss + np.pi, 2 * np.pi) - np.pi)
        scale = max(1.0, float(np.abs(values).max()))
        allowed = np.minimum(RETURNS * scale, ROUNDING * scale + SHARE * np.ptp(values, axis=0))
        worst = int(np.argmax(np.abs(miss) / allowed))
        if not np.abs(miss[worst]) <= allowed[worst]:
            raise InputError(
                f"period = {run.t[-1]:.9g} s is none: after it {run.coordinates[worst]}{what} is off by "
                f"{miss[worst]:.6g} from its {values[0, worst]:.6g} at the start"
            )
