"""Reference motion of a scene: runs at a tight tolerance, whose agreement tells how accurate the reference is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.analysis.precision.motion import (
    FORMULATIONS,
    INSTANTS,
    Motion,
    compare_motions,
    override_scene,
    span_overrides,
    starts_off_manifold,
    time_scene,
)
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.scene.scene import Scene

__all__ = ["REFERENCE_RTOL", "Reference", "find_confirmed_span", "find_reference"]

REFERENCE_RTOL = 1e-13
GOOD_AGREEMENT = 1e-10  # scaled; if two runs agree this well, no further run is made
MAX_DISAGREEMENT = 1e-6  # scaled; above it, two runs do not confirm each other
MIN_UNCERTAINTY = 1e-15  # scaled; rounding errors limit every reference
ON_MANIFOLD = (("dae", "auto"), ("reduced", "auto"), ("dae", "DOP853"), ("reduced", "Radau"), ("dae", "Radau"))
OFF_MANIFOLD = (("spf, w", "auto"), ("spf, z", "auto"), ("spf, w", "DOP853"), ("spf, w", "Radau"))


@dataclass(frozen=True)
class Reference:
    """The motion of a scene as far as two runs confirm it.

    Attributes
    ----------
    motion : Motion
        Values at the instants.
    t : (m,) array
        Instants, s. The motion is confirmed up to the last one.
    accuracy : float
        Largest scaled difference of the two runs. Errors below it cannot be resolved.
    source, confirmed_by : str
        Formulation and method of the two runs.
    notes : tuple of str
        Such as why the reference ends before the scene.
    """

    motion: Motion
    t: Array
    accuracy: float
    source: str
    confirmed_by: str
    notes: tuple[str, ...]

    @property
    def t_end(self) -> float:
        """Last confirmed instant, s."""
        return float(self.t[-1])

    @property
    def dt(self) -> float:
        """Time between instants, s."""
        return float(self.t[1])

    def to_dict(self) -> dict[str, Any]:
        """Return the reference as JSON-ready data."""
        return {
            "of": self.source,
            "confirmed_by": self.confirmed_by,
            "rtol": REFERENCE_RTOL,
            "accuracy": self.accuracy,
            "t_end": self.t_end,
            "t": self.t.tolist(),
            "q_tree": self.motion.q_tree.tolist(),
            "v_tree": self.motion.v_tree.tolist(),
        }

    def describe(self) -> Iterator[str]:
        """Yield sentences about the reference: its runs, its accuracy, its notes."""
        yield (
            f"reference: {self.source} at rtol {REFERENCE_RTOL:.0e}, confirmed by {self.confirmed_by} to "
            f"{self.accuracy:.1e} up to t = {self.t_end:.6g} s"
        )
        yield from self.notes


@dataclass(frozen=True)
class _TightRun:
    """A run at the reference tolerance."""

    formulation: str
    method: str
    motion: Motion
    run: Run

    @property
    def name(self) -> str:
        return f"{self.formulation}, {self.method}"


@dataclass(frozen=True)
class _Agreement:
    """How far two runs agree: the last instant's number, and the largest scaled difference up to there."""

    last: int
    difference: float
    first: _TightRun
    second: _TightRun

    @property
    def is_good(self) -> bool:
        return self.last == INSTANTS and self.difference <= GOOD_AGREEMENT


def find_reference(scene: Scene, mechanism: Mechanism, limit_s: float) -> Reference | str:
    """Run a scene at a tight tolerance with several formulations and methods, until two runs agree.

    On the manifold all formulations have the same flow. Off it, with phi = w, only the SPF's two coordinates have.

    Parameters
    ----------
    scene : Scene
    mechanism : Mechanism
        The scene's.
    limit_s : float
        Time for all runs together, s.

    Returns
    -------
    Reference, or str
        A sentence if no two runs agree.
    """
    deadline, notes = perf_counter() + limit_s, list[str]()
    t_end, end_note = _find_end(scene, limit_s)
    if end_note:
        notes.append(end_note)
    runs: list[_TightRun] = []
    best: _Agreement | None = None
    failures: list[str] = []
    for formulation, method in OFF_MANIFOLD if starts_off_manifold(scene) else ON_MANIFOLD:
        remaining = deadline - perf_counter()
        if remaining <= 0 or (best and best.is_good):
            break
        tight = _tighten(scene, formulation, method, t_end, min(remaining, limit_s / 3))
        motion, run = time_scene(tight, remaining, max_runs=1)
        if motion.status != "done":
            failures.append(f"{formulation}, {method}: {motion.reason}")
        if run is None:
            continue
        runs.append(_TightRun(formulation, method, motion, run))
        agreements = (
            _Agreement(*find_confirmed_span(mechanism, first.motion, second.motion), first, second)
            for first, second in combinations(runs, 2)
            if _are_independent(first, second)
        )
        best = max(agreements, key=lambda agreement: (agreement.last, -agreement.difference), default=None)
    if best is None or best.last == 0:
        why = "; ".join(failures) or (
            f"two runs at rtol {REFERENCE_RTOL:.0e} differ by more than {MAX_DISAGREEMENT:.0e} from the start"
        )
        return f"no reference could be confirmed: {why}"
    count = best.last + 1
    t = best.first.run.t[:count]
    if best.last < INSTANTS:
        notes.append(_explain_early_end(t, failures))
    motion = Motion("done", "", best.first.motion.q_tree[:count], best.first.motion.v_tree[:count])
    return Reference(motion, t, best.difference, best.first.name, best.second.name, tuple(notes))


def find_confirmed_span(mechanism: Mechanism, first: Motion, second: Motion) -> tuple[int, float]:
    """Return the number of the last instant up to which two motions agree, and their largest scaled difference."""
    scaled = compare_motions(mechanism.tree, second, first).scaled
    disagreeing = np.flatnonzero(~(scaled <= MAX_DISAGREEMENT))
    count = int(disagreeing[0]) if len(disagreeing) else len(scaled)
    return max(0, min(count - 1, INSTANTS)), max(float(scaled[:count].max(initial=0.0)), MIN_UNCERTAINTY)


def _are_independent(first: _TightRun, second: _TightRun) -> bool:
    """Whether two runs can confirm each other. "auto" may have taken the very steps of the other run's method."""
    used = ({name for name, steps in each.run.stats["steps_by_method"].items() if steps} for each in (first, second))
    return first.formulation != second.formulation or set.isdisjoint(*used)


def _tighten(scene: Scene, formulation: str, method: str, t_end: float, limit_s: float, **extra: Any) -> Scene:
    """Return a scene at the reference tolerance, without the scene's own settings of accuracy."""
    removed = dict.fromkeys(f"solver.{key}" for key in ("atol", "baumgarte", "projection", "max_rhs", "min_step"))
    values = {"solver.method": method, "solver.rtol": REFERENCE_RTOL, "solver.max_wall_s": max(limit_s, 0.05)}
    span = span_overrides(scene, t_end, t_end / INSTANTS)
    return override_scene(scene, {**removed, **span, **FORMULATIONS[formulation], **values, **extra})


def _find_end(scene: Scene, limit_s: float) -> tuple[float, str]:
    """Return the end of a scene, which may be an event that stops it, and a note about that event."""
    t_end = scene.spec.t_end
    if not any(event.stop for event in scene.spec.event):
        return t_end, ""
    formulation = "spf, w" if starts_off_manifold(scene) else "dae"
    with_events = {"event": scene.to_dict()["event"]}
    tight = _tighten(scene, formulation, "auto", t_end, limit_s / 3, **with_events)
    _, run = time_scene(tight, limit_s, max_runs=1)
    stops = [event for event in run.events if event["stop"]] if run is not None else []
    if not stops or not stops[-1]["t"] > 0:
        return t_end, ""
    event = stops[-1]
    return event["t"], f"compared up to the event that ends the scene, at t = {event['t']:.6g} s: {event['name']}"


def _explain_early_end(t: Array, failures: list[str]) -> str:
    why = "; ".join(failures) or (
        f"later, runs at rtol {REFERENCE_RTOL:.0e} differ by more than {MAX_DISAGREEMENT:.0e}, as in a chaotic motion, "
        "and no setting is accurate there"
    )
    remedy = "; a larger budget gets further" if "max_wall_s" in why else ""
    return f"compared up to t = {t[-1]:.6g} s, as far as the reference is confirmed ({why}){remedy}"
