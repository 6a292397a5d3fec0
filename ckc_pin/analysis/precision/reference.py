"""What is right: the scene at a tight tolerance, by two formulations, which tell how right by how well they agree."""

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
    apart,
    changed,
    move,
    off_manifold,
    on_span,
)
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.scene.scene import Scene

__all__ = ["TIGHT", "Reference", "confirm", "find_reference", "said"]

TIGHT = 1e-13
GOOD = 1e-10  # no other pair is tried where two agree to that
CONFIRMED = 1e-6  # scaled; further apart, neither of two is right
LEAST = 1e-15  # nothing is known better than rounding
ON_MANIFOLD = (("dae", "auto"), ("reduced", "auto"), ("dae", "DOP853"), ("reduced", "Radau"), ("dae", "Radau"))
OFF_MANIFOLD = (("spf, w", "auto"), ("spf, z", "auto"), ("spf, w", "DOP853"), ("spf, w", "Radau"))


@dataclass(frozen=True)
class Reference:
    """A scene's motion as far as it can be confirmed.

    Attributes
    ----------
    motion : Motion
        Its values at the instants.
    t : (m,) array
        The instants, s; the last one is how far the motion is confirmed.
    accuracy : float
        How far the two runs that confirm each other are apart, scaled as errors are; errors are not told below that.
    of, by : str
        Which runs these are.
    notes : tuple of str
        Why it does not go to the scene's end, and the like.
    """

    motion: Motion
    t: Array
    accuracy: float
    of: str
    by: str
    notes: tuple[str, ...]

    @property
    def t_end(self) -> float:
        """How far it goes, s."""
        return float(self.t[-1])

    @property
    def dt(self) -> float:
        """Between its instants, s."""
        return float(self.t[1])


@dataclass(frozen=True)
class _Tight:
    formulation: str
    method: str
    motion: Motion
    run: Run

    @property
    def name(self) -> str:
        return f"{self.formulation}, {self.method}"


def find_reference(scene: Scene, mechanism: Mechanism, seconds: float) -> Reference | str:
    """Run a scene at a tight tolerance until two runs agree; return a sentence where none do.

    Parameters
    ----------
    scene : Scene
    mechanism : Mechanism
        The scene's.
    seconds : float
        What all runs together may take.

    Notes
    -----
    On the manifold all formulations are one flow; off it, with phi = w, only the SPF's two coordinates are.
    """
    deadline, notes = perf_counter() + seconds, list[str]()
    t_end, event = _end(scene, seconds)
    if event:
        notes.append(event)
    found: list[_Tight] = []
    best: tuple[int, float, _Tight, _Tight] | None = None
    failures: list[str] = []
    pairs = OFF_MANIFOLD if off_manifold(scene) else ON_MANIFOLD
    for formulation, method in pairs:
        left = deadline - perf_counter()
        if left <= 0 or (best and best[0] == INSTANTS and best[1] <= GOOD):
            break
        motion, run = move(_tight(scene, formulation, method, t_end, min(left, seconds / 3)), left, most=1)
        if motion.status != "done":
            failures.append(f"{formulation}, {method}: {motion.reason}")
        if run is None:
            continue
        found.append(_Tight(formulation, method, motion, run))
        others = (pair for pair in combinations(found, 2) if _independent(*pair))
        best = max((_agreed(mechanism, *pair) for pair in others), key=_rank, default=None)
    if best is None or best[0] == 0:
        why = "; ".join(failures) or f"two runs at rtol {TIGHT:.0e} are more than {CONFIRMED:.0e} apart from the start"
        return f"no reference could be confirmed: {why}"
    last, accuracy, one, other = best
    t = one.run.t[: last + 1]
    if last < INSTANTS:
        notes.append(_why_not_further(t, failures))
    motion = Motion("done", "", one.motion.q_tree[: last + 1], one.motion.v_tree[: last + 1])
    return Reference(motion, t, accuracy, one.name, other.name, tuple(notes))


def confirm(mechanism: Mechanism, one: Motion, other: Motion) -> tuple[int, float]:
    """Return up to which instant two motions confirm each other, and how far apart they are up to there."""
    scaled = apart(mechanism.tree, other, one).scaled
    lost = np.flatnonzero(~(scaled <= CONFIRMED))
    many = int(lost[0]) if len(lost) else len(scaled)
    return max(0, min(many - 1, INSTANTS)), max(float(scaled[:many].max(initial=0.0)), LEAST)


def _independent(one: _Tight, other: _Tight) -> bool:
    """Whether two runs can confirm each other: "auto" may have taken the very steps of a method that is named."""
    used = ({name for name, steps in each.run.stats["steps_by_method"].items() if steps} for each in (one, other))
    return one.formulation != other.formulation or set.isdisjoint(*used)


def _agreed(mechanism: Mechanism, one: _Tight, other: _Tight) -> tuple[int, float, _Tight, _Tight]:
    return (*confirm(mechanism, one.motion, other.motion), one, other)


def _rank(found: tuple[int, float, _Tight, _Tight]) -> tuple[int, float]:
    return found[0], -found[1]


def _tight(scene: Scene, formulation: str, method: str, t_end: float, limit: float, **more: Any) -> Scene:
    loosened = dict.fromkeys(f"solver.{key}" for key in ("atol", "baumgarte", "projection", "max_rhs", "min_step"))
    values = {"solver.method": method, "solver.rtol": TIGHT, "solver.max_wall_s": max(limit, 0.05)}
    return changed(
        scene, {**loosened, **on_span(scene, t_end, t_end / INSTANTS), **FORMULATIONS[formulation], **values, **more}
    )


def _end(scene: Scene, seconds: float) -> tuple[float, str]:
    """Return where a scene ends: at an event that stops it, if there is one; and that as a sentence."""
    t_end = scene.spec.t_end
    if not any(event.stop for event in scene.spec.event):
        return t_end, ""
    formulation = "spf, w" if off_manifold(scene) else "dae"
    own = {"event": scene.to_dict()["event"]}
    _, run = move(_tight(scene, formulation, "auto", t_end, seconds / 3, **own), seconds, most=1)
    met = [event for event in run.events if event["stop"]] if run is not None else []
    if not met or not met[-1]["t"] > 0:
        return t_end, ""
    return met[-1]["t"], f"compared up to the event that ends it, at t = {met[-1]['t']:.6g} s: {met[-1]['name']}"


def _why_not_further(t: Array, failures: list[str]) -> str:
    why = "; ".join(failures) or (
        f"later, runs at rtol {TIGHT:.0e} are more than {CONFIRMED:.0e} apart: the motion forgets what it comes from, "
        "and no setting is right there"
    )
    more = "; a larger budget gets further" if "max_wall_s" in why else ""
    return f"compared up to t = {t[-1]:.6g} s, as far as the reference is confirmed ({why}){more}"


def said(reference: Reference) -> Iterator[str]:
    """Yield what there is to say of a reference, a sentence each."""
    yield (
        f"reference: {reference.of} at rtol {TIGHT:.0e}, confirmed by {reference.by} to {reference.accuracy:.1e} "
        f"up to t = {reference.t_end:.6g} s"
    )
    yield from reference.notes
