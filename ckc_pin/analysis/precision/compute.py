"""Every setting of a scene against its reference, within a budget of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ckc_pin.analysis.precision import mujoco
from ckc_pin.analysis.precision.motion import (
    Motion,
    PrecisionRow,
    apart,
    changed,
    move,
    no_motion,
    off_manifold,
    on_span,
    settings,
)
from ckc_pin.analysis.precision.reference import Reference, find_reference
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["BUDGET", "TARGETS", "Advice", "WorkPrecision", "advise", "fastest", "work_precision"]


BUDGET = 20.0  # s
REFERENCE, PEER = 0.35, 0.15  # parts of the budget
RUNS = 40  # of the longest ones would use up the budget
LATE = "not tried", "the budget was used up before; give a larger one"
CLEAR = 10.0  # an error that many times the reference's uncertainty is told from it

Progress = Callable[[float], None]  # the part that is done


@dataclass
class WorkPrecision:
    """A scene's settings compared.

    Attributes
    ----------
    scene : str
    status : "done", "stopped" or "interrupted"
        "stopped" where no reference could be confirmed.
    message : str
    reference : Reference or None
    rows : list of PrecisionRow
    advice : list of Advice
    notes : list of str
        What was left out, and why.
    model_difference : float or None
        Of a start with phi = w other than 0: how far the reduced model's motion, from w = 0, is from the SPF's.
    seconds : float
        What it took.
    """

    scene: str
    status: Literal["done", "stopped", "interrupted"] = "done"
    message: str = ""
    reference: Reference | None = None
    rows: list[PrecisionRow] = field(default_factory=list)
    advice: list[Advice] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    model_difference: float | None = None
    seconds: float = 0.0


def work_precision(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    budget: float = BUDGET,
    mjcf: str = "",
    progress: Progress | None = None,
) -> WorkPrecision:
    """Compare formulations, methods and tolerances on a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name or its path.
    overrides : mapping, optional
        Values by dotted key.
    budget : float
        What it may take, s.
    mjcf : str
        The mechanism as MuJoCo's model, to put that program beside; empty: without it.
    progress : callable, optional
        Called as progress(part), from 0 to 1.

    Returns
    -------
    WorkPrecision
        A signal ends it with status "interrupted" and the rows up to there.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its start is singular.
    """
    if not (np.isfinite(budget) and budget > 0):
        raise InputError(f"budget = {budget:g}: expected a number of seconds above zero")
    if not isinstance(scene, Scene):
        scene = load_scene(scene, overrides)
    elif overrides:
        raise InputError("work_precision: overrides go with the name of a scene; a Scene is complete")
    ready, found = prepare(scene), WorkPrecision(scene.name)
    began = perf_counter()
    try:
        _compare(found, scene, ready.mechanism, budget, mjcf, progress or (lambda part: None))
    except KeyboardInterrupt as stop:
        found.status = "interrupted"
        found.message = f"interrupted{acknowledge(stop)} after {len(found.rows)} settings"
    if found.reference is not None:
        found.advice = advise(found.rows, found.reference.accuracy)
    found.seconds = perf_counter() - began
    return found


def _compare(
    found: WorkPrecision, scene: Scene, mechanism: Mechanism, budget: float, mjcf: str, progress: Progress
) -> None:
    began = perf_counter()
    reference = find_reference(scene, mechanism, REFERENCE * budget)
    if isinstance(reference, str):
        found.status, found.message = "stopped", reference
        return
    found.reference = reference
    progress(REFERENCE)
    if off_manifold(scene):
        _without_w(found, scene, mechanism, reference)
    missing = mujoco.missing(scene) if mjcf else ""
    peer = PEER * budget if mjcf and not missing else 0.0
    part = (1 - REFERENCE) * (1 - peer / budget)
    _ours(found, scene, mechanism, began + budget - peer, budget / RUNS, lambda x: progress(REFERENCE + part * x))
    if missing:
        found.notes.append(f"MuJoCo is not beside it: {missing}")
    elif mjcf:
        deadline = max(began + budget, perf_counter() + peer)
        _peer(found, mujoco.rows(scene, mechanism, mjcf, reference.t, deadline), mechanism)
    progress(1.0)


def _ours(
    found: WorkPrecision, scene: Scene, mechanism: Mechanism, deadline: float, limit: float, progress: Progress
) -> None:
    """Run all settings; what used up its time at one tolerance is not tried with a tighter one."""
    assert found.reference is not None
    span, every = on_span(scene, found.reference.t_end, found.reference.dt), list(settings(scene))
    spent: dict[tuple[str, str], tuple[str, str]] = {}
    for k, setting in enumerate(every):
        progress(k / len(every))
        left = deadline - perf_counter()
        if setting.family in spent:
            motion = no_motion(*spent[setting.family])
        elif left <= 0:
            motion = no_motion(*LATE)
        else:
            limited = {**setting.overrides(scene), **span, "solver.max_wall_s": min(limit, max(left, 0.01))}
            motion, _ = move(changed(scene, limited), min(limit, left))
            if motion.status == "refused":
                spent[setting.family] = ("refused", motion.reason)
            elif "max_wall_s" in motion.reason and left < limit:  # too late, not too slow
                motion = no_motion(*LATE)
            elif "max_wall_s" in motion.reason:
                spent[setting.family] = "not tried", f"at rtol {setting.rtol:.0e} it took more than {limit:.2g} s"
        found.rows.append(
            _judged(
                found.reference,
                mechanism,
                motion,
                program="ckc_pin",
                formulation=setting.formulation,
                method=setting.method,
                rtol=setting.rtol,
                overrides=setting.overrides(scene),
            )
        )
    late = sum((row.status, row.reason) == LATE for row in found.rows)
    if late:
        found.notes.append(f"{late} settings were not tried: the budget was used up before")


def _peer(found: WorkPrecision, rows: Iterable[tuple[str, float, Motion]] | str, mechanism: Mechanism) -> None:
    if isinstance(rows, str):
        found.notes.append(f"MuJoCo is not beside it: {rows}")
        return
    assert found.reference is not None
    for method, dt, motion in rows:
        found.rows.append(_judged(found.reference, mechanism, motion, program="MuJoCo", method=method, dt=dt))


def _judged(
    reference: Reference,
    mechanism: Mechanism,
    motion: Motion,
    *,
    program: str,
    method: str,
    formulation: str | None = None,
    rtol: float | None = None,
    dt: float | None = None,
    overrides: dict[str, Any] | None = None,
) -> PrecisionRow:
    """Return the row of a motion; one that is not whole has no error."""
    whole = motion.status == "done" and len(motion.q_tree) == len(reference.t)
    finite = whole and bool(np.isfinite(motion.q_tree).all() and np.isfinite(motion.v_tree).all())
    status, reason = motion.status, motion.reason
    if motion.status == "done" and not finite:
        status, reason = "failed", "its motion is not finite"
    off = apart(mechanism.tree, motion, reference.motion) if finite else None
    error = None if off is None else float(off.scaled.max())
    return PrecisionRow(
        program=program,
        formulation=formulation,
        method=method,
        rtol=rtol,
        dt=dt,
        overrides=overrides or {},
        status=status,
        reason=reason,
        error=error,
        error_q=None if off is None else float(off.q.max()),
        error_v=None if off is None else float(off.v.max()),
        resolved=None if error is None else error > CLEAR * reference.accuracy,
        rhs=motion.rhs,
        steps=motion.steps,
        used=motion.used,
        wall_s=motion.wall_s,
        setup_s=motion.setup_s,
    )


def _without_w(found: WorkPrecision, scene: Scene, mechanism: Mechanism, reference: Reference) -> None:
    """Tell how far the motion with w = 0 is from the SPF's: a difference of models, which is in no row's error."""
    overrides = {
        **on_span(scene, reference.t_end, reference.dt),
        "initial.w": None,
        "formulation": "reduced",
        "solver.rtol": 1e-10,
    }
    motion, _ = move(changed(scene, overrides), 1.0, most=1)
    found.notes.append("the scene starts off phi = 0, where only the SPF can: compared with the SPF's own flow")
    if motion.status == "done":
        found.model_difference = float(apart(mechanism.tree, motion, reference.motion).scaled.max())
        found.notes.append(
            f"the reduced model and the DAE, which start from the same q and q_dot with w = 0, are up to "
            f"{found.model_difference:.1e} away from that: a difference of models, no error"
        )


# --- Which setting to take: the fastest one that meets an accuracy.

TARGETS = (1e-3, 1e-6, 1e-9)
CHANCE = 0.1  # of a time


@dataclass(frozen=True)
class Advice:
    """What to take for an error.

    Attributes
    ----------
    target : float
    row : PrecisionRow or None
        The fastest setting that met it.
    reason : str
        Why there is none.
    peer : PrecisionRow or None
        The fastest of MuJoCo's that met it.
    """

    target: float
    row: PrecisionRow | None
    reason: str
    peer: PrecisionRow | None

    @property
    def options(self) -> list[str]:
        """The setting as options of `ckc run`."""
        return [] if self.row is None else _options(self.row.overrides)

    @property
    def removed(self) -> list[str]:
        """Keys to take out of the scene, which no option can."""
        return [] if self.row is None else [key for key, x in self.row.overrides.items() if x is None]


def advise(rows: Sequence[PrecisionRow], accuracy: float) -> list[Advice]:
    """Find the fastest row for each target; what the reference cannot tell is not advised."""
    found = []
    for target in TARGETS:
        ours, theirs = (fastest(rows, target, accuracy, program) for program in ("ckc_pin", "MuJoCo"))
        reason = ""
        if target <= accuracy:
            reason = f"the reference itself is only known to {accuracy:.1e}"
        elif ours is None:
            reason = "no setting that was tried gets there"
        found.append(Advice(target, ours, reason, theirs))
    return found


def fastest(rows: Sequence[PrecisionRow], target: float, accuracy: float, program: str) -> PrecisionRow | None:
    """Return the row that took the least time of those whose error, the reference's added, is within a target.

    Times that close are a matter of chance: of rows that take as long, "auto" is preferred.
    """
    good = [
        (row.wall_s, row)
        for row in rows
        if row.program == program
        and row.error is not None
        and row.wall_s is not None
        and row.error + accuracy <= target
    ]
    least = min((wall_s for wall_s, _ in good), default=0.0)
    same = [(row.method != "auto", wall_s, row) for wall_s, row in good if wall_s <= (1 + CHANCE) * least]
    return min(same, key=lambda each: each[:2])[2] if same else None


def _options(overrides: Mapping[str, Any]) -> list[str]:
    return [f"{key}={x:.0e}" if isinstance(x, float) else f"{key}={x}" for key, x in overrides.items() if x is not None]
