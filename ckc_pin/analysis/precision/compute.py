"""Compare every setting of a scene with a reference within a budget of time, and advise a setting for each accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ckc_pin.analysis.precision.motion import (
    Motion,
    PrecisionRow,
    compare_motions,
    list_settings,
    motion_without_data,
    override_scene,
    span_overrides,
    starts_off_manifold,
    time_scene,
)
from ckc_pin.analysis.precision.mujoco import explain_unsupported, run_mujoco
from ckc_pin.analysis.precision.reference import Reference, find_reference
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.scene import Scene, as_scene

__all__ = [
    "DEFAULT_BUDGET_S",
    "TABLE_ERRORS",
    "TARGET_ERRORS",
    "Advice",
    "SettingFamily",
    "WorkPrecision",
    "advise_settings",
    "describe_outcome",
    "find_fastest",
    "work_precision",
]

DEFAULT_BUDGET_S = 20.0
REFERENCE_SHARE, MUJOCO_SHARE = 0.35, 0.15  # of the budget
MAX_LONGEST_RUNS = 40  # the time limit of one run is the budget divided by this
OUT_OF_BUDGET = "not tried", "the budget is used up; give a larger one"
RESOLVED_FACTOR = 10.0  # an error is resolved if it is this many times the reference's uncertainty
TARGET_ERRORS = (1e-3, 1e-6, 1e-9)  # for which a setting is advised
TABLE_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)  # columns of the table of times
EQUAL_TIME = 0.1  # relative; smaller differences between two run times are noise
MODEL_RTOL = 1e-10  # of the run that measures the difference of the models

Progress = Callable[[float], None]  # called with the completed fraction, 0 to 1


# --- results -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Advice:
    """The setting to use for an accuracy.

    Attributes
    ----------
    target : float
        Error that is allowed.
    row : PrecisionRow or None
        The fastest setting within that error.
    reason : str
        Why there is none.
    peer : PrecisionRow or None
        MuJoCo's fastest setting within that error.
    """

    target: float
    row: PrecisionRow | None
    reason: str
    peer: PrecisionRow | None

    @property
    def options(self) -> list[str]:
        """The setting as values of `ckc run --set`."""
        if self.row is None:
            return []
        values = ((key, x) for key, x in self.row.overrides.items() if x is not None)
        return [f"{key}={x:.0e}" if isinstance(x, float) else f"{key}={x}" for key, x in values]

    @property
    def removed(self) -> list[str]:
        """Keys that have to be removed from the scene, which `--set` cannot do."""
        return [] if self.row is None else [key for key, x in self.row.overrides.items() if x is None]

    def to_dict(self) -> dict[str, Any]:
        """Return the advice as JSON-ready data."""
        row, peer = self.row, self.peer
        return {
            "target": self.target,
            "set": self.options,
            "remove": self.removed,
            "reason": self.reason,
            "wall_s": row.wall_s if row else None,
            "error": row.error if row else None,
            "mujoco": {"method": peer.method, "dt": peer.dt, "wall_s": peer.wall_s} if peer else None,
        }

    def describe(self, mark: str = "") -> str:
        """Return the advice as a sentence; `mark` encloses the options, such as a backquote in Markdown."""
        if self.row is None:
            text = self.reason
        else:
            options = " ".join(f"--set {option}" for option in self.options)
            text = f"{mark}{options}{mark} ({1e3 * (self.row.wall_s or 0.0):.3g} ms, error {self.row.error:.1e})"
        if self.removed:
            text += f"; remove {', '.join(self.removed)} from the scene"
        if self.peer is not None:
            peer = self.peer
            text += f"; MuJoCo takes {1e3 * (peer.wall_s or 0.0):.3g} ms ({peer.method}, dt {peer.dt:.2g} s)"
        return f"for an error of {self.target:.0e}: {text}"


@dataclass(frozen=True)
class SettingFamily:
    """The settings of one formulation and method.

    Attributes
    ----------
    name : str
    rows : list of PrecisionRow
        By tolerance or step.
    fastest : list of PrecisionRow or None
        For each of `TABLE_ERRORS`, the fastest setting within that error.
    """

    name: str
    rows: list[PrecisionRow]
    fastest: list[PrecisionRow | None]

    @property
    def failure(self) -> str:
        """How many settings failed, and how the first one did; empty if none failed."""
        failed = [row for row in self.rows if row.status in ("refused", "stopped", "failed")]
        return f"{len(failed)} of {len(self.rows)} {describe_outcome(failed[0])}" if failed else ""


def describe_outcome(row: PrecisionRow) -> str:
    """Return status and reason of a row as text."""
    return row.reason if row.reason.startswith(row.status) else f"{row.status}: {row.reason}".removesuffix(": ")


@dataclass
class WorkPrecision:
    """Work-precision comparison of a scene's settings.

    Attributes
    ----------
    scene : str
    status : "done", "stopped" or "interrupted"
        "stopped": no reference could be confirmed.
    message : str
    reference : Reference or None
    rows : list of PrecisionRow
    advice : list of Advice
    notes : list of str
        Such as what was left out, and why.
    model_difference : float or None
        For a start with phi = w other than 0: the scaled difference between the SPF's motion and that of the reduced
        model, which starts with w = 0.
    seconds : float
        Time of the comparison.
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

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON-ready data."""
        return {
            "scene": self.scene,
            "status": self.status,
            "message": self.message,
            "reference": None if self.reference is None else self.reference.to_dict(),
            "model_difference": self.model_difference,
            "rows": [asdict(row) for row in self.rows],
            "advice": [advice.to_dict() for advice in self.advice],
            "notes": list(self.describe_notes()),
            "seconds": self.seconds,
        }

    def families(self) -> Iterator[SettingFamily]:
        """Yield the settings grouped by formulation and method."""
        accuracy = 0.0 if self.reference is None else self.reference.accuracy
        for name in dict.fromkeys(row.family for row in self.rows):
            rows = [row for row in self.rows if row.family == name]
            fastest = [find_fastest(rows, target, accuracy, rows[0].program) for target in TABLE_ERRORS]
            yield SettingFamily(name, rows, fastest)

    def describe_notes(self) -> Iterator[str]:
        """Yield sentences about the reference, unresolved errors, failures, and what was left out."""
        if self.reference is not None:
            yield from self.reference.describe()
            unresolved = sum(row.resolved is False for row in self.rows)
            if unresolved:
                yield f"the errors of {unresolved} settings are not resolved by the reference: at its own uncertainty"
            for family in self.families():
                if family.failure:
                    yield f"{family.name}: {family.failure}"
        yield from self.notes

    def describe(self) -> Iterator[str]:
        """Yield the notes, then the advised settings, which can be pasted into a command."""
        yield from self.describe_notes()
        yield from (advice.describe() for advice in self.advice)


# --- comparison ----------------------------------------------------------------------------------------------------


def work_precision(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    budget: float = DEFAULT_BUDGET_S,
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
        Time for the whole comparison, s.
    mjcf : str
        The mechanism as a MuJoCo model, to compare with MuJoCo. Empty: without MuJoCo.
    progress : callable, optional
        Called as progress(fraction), from 0 to 1.

    Returns
    -------
    WorkPrecision
        After a signal with status "interrupted" and the rows computed so far.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        The start is singular.
    """
    if not (np.isfinite(budget) and budget > 0):
        raise InputError(f"budget = {budget:g}: expected a number of seconds above zero")
    scene = as_scene(scene, overrides, "work_precision")
    mechanism, result = prepare(scene).mechanism, WorkPrecision(scene.name)
    start = perf_counter()
    try:
        _Comparison(result, scene, mechanism, budget, progress or (lambda fraction: None)).run(mjcf)
    except KeyboardInterrupt as stop:
        result.status = "interrupted"
        result.message = f"interrupted{acknowledge(stop)} after {len(result.rows)} settings"
    if result.reference is not None:
        result.advice = advise_settings(result.rows, result.reference.accuracy)
    result.seconds = perf_counter() - start
    return result


@dataclass
class _Comparison:
    """A comparison in progress; `result` has what was computed so far."""

    result: WorkPrecision
    scene: Scene
    mechanism: Mechanism
    budget: float
    progress: Progress

    def run(self, mjcf: str) -> None:
        start, scene = perf_counter(), self.scene
        reference = find_reference(scene, self.mechanism, REFERENCE_SHARE * self.budget)
        if isinstance(reference, str):
            self.result.status, self.result.message = "stopped", reference
            return
        self.result.reference = reference
        self.progress(REFERENCE_SHARE)
        if starts_off_manifold(scene):
            self._measure_model_difference(reference)
        unsupported = explain_unsupported(scene) if mjcf else ""
        mujoco_budget = MUJOCO_SHARE * self.budget if mjcf and not unsupported else 0.0
        self._run_settings(reference, start + self.budget - mujoco_budget, mujoco_budget / self.budget)
        if unsupported:
            self.result.notes.append(f"MuJoCo is not compared: {unsupported}")
        elif mjcf:
            deadline = max(start + self.budget, perf_counter() + mujoco_budget)
            self._add_mujoco(reference, run_mujoco(scene, self.mechanism, mjcf, reference.t, deadline))
        self.progress(1.0)

    def _run_settings(self, reference: Reference, deadline: float, mujoco_share: float) -> None:
        """Run all settings. A family that exceeded its time at one tolerance is not tried with a tighter one."""
        scene, limit_s = self.scene, self.budget / MAX_LONGEST_RUNS
        span, settings = span_overrides(scene, reference.t_end, reference.dt), list(list_settings(scene))
        outcome_by_family: dict[tuple[str, str], tuple[str, str]] = {}
        for k, setting in enumerate(settings):
            self.progress(REFERENCE_SHARE + (1 - REFERENCE_SHARE) * (1 - mujoco_share) * k / len(settings))
            remaining = deadline - perf_counter()
            if setting.family in outcome_by_family:
                motion = motion_without_data(*outcome_by_family[setting.family])
            elif remaining <= 0:
                motion = motion_without_data(*OUT_OF_BUDGET)
            else:
                run_limit = {"solver.max_wall_s": min(limit_s, max(remaining, 0.01))}
                limited = override_scene(scene, {**setting.overrides(scene), **span, **run_limit})
                motion, _ = time_scene(limited, min(limit_s, remaining))
                if motion.status == "refused":
                    outcome_by_family[setting.family] = "refused", motion.reason
                elif "max_wall_s" in motion.reason and remaining < limit_s:  # the budget ended, not the run's limit
                    motion = motion_without_data(*OUT_OF_BUDGET)
                elif "max_wall_s" in motion.reason:
                    reason = f"at rtol {setting.rtol:.0e} it took more than {limit_s:.2g} s"
                    outcome_by_family[setting.family] = "not tried", reason
            row = self._make_row(
                reference,
                motion,
                program="ckc_pin",
                formulation=setting.formulation,
                method=setting.method,
                rtol=setting.rtol,
                overrides=setting.overrides(scene),
            )
            self.result.rows.append(row)
        late = sum((row.status, row.reason) == OUT_OF_BUDGET for row in self.result.rows)
        if late:
            self.result.notes.append(f"{late} settings were not tried, because the budget was used up")

    def _add_mujoco(self, reference: Reference, runs: Iterable[tuple[str, float, Motion]] | str) -> None:
        if isinstance(runs, str):
            self.result.notes.append(f"MuJoCo is not compared: {runs}")
            return
        for method, dt, motion in runs:
            self.result.rows.append(self._make_row(reference, motion, program="MuJoCo", method=method, dt=dt))

    def _make_row(
        self,
        reference: Reference,
        motion: Motion,
        *,
        program: str,
        method: str,
        formulation: str | None = None,
        rtol: float | None = None,
        dt: float | None = None,
        overrides: dict[str, Any] | None = None,
    ) -> PrecisionRow:
        """Return the row of a motion. A motion that does not reach the end has no error."""
        is_complete = motion.status == "done" and len(motion.q_tree) == len(reference.t)
        is_finite = is_complete and bool(np.isfinite(motion.q_tree).all() and np.isfinite(motion.v_tree).all())
        status, reason = motion.status, motion.reason
        if motion.status == "done" and not is_finite:
            status, reason = "failed", "its motion is not finite"
        errors = compare_motions(self.mechanism.tree, motion, reference.motion) if is_finite else None
        error = None if errors is None else float(errors.scaled.max())
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
            error_q=None if errors is None else float(errors.q.max()),
            error_v=None if errors is None else float(errors.v.max()),
            resolved=None if error is None else error > RESOLVED_FACTOR * reference.accuracy,
            rhs=motion.rhs,
            steps=motion.steps,
            used=motion.used,
            wall_s=motion.wall_s,
            setup_s=motion.setup_s,
        )

    def _measure_model_difference(self, reference: Reference) -> None:
        """Compare the reduced model's motion, which starts with w = 0, with the SPF's. It is not an error of a row."""
        overrides = {
            **span_overrides(self.scene, reference.t_end, reference.dt),
            "initial.w": None,
            "formulation": "reduced",
            "solver.rtol": MODEL_RTOL,
        }
        motion, _ = time_scene(override_scene(self.scene, overrides), 1.0, max_runs=1)
        self.result.notes.append("the scene starts off phi = 0, which only the SPF supports: compared with its flow")
        if motion.status == "done":
            difference = float(compare_motions(self.mechanism.tree, motion, reference.motion).scaled.max())
            self.result.model_difference = difference
            self.result.notes.append(
                f"the reduced model and the DAE start from the same q and q_dot with w = 0; their motion differs from "
                f"the SPF's by up to {difference:.1e}, which is a difference of models and not an error"
            )


# --- advice --------------------------------------------------------------------------------------------------------


def advise_settings(rows: Sequence[PrecisionRow], accuracy: float) -> list[Advice]:
    """Return the fastest setting for each target error above the reference's accuracy."""
    advice = []
    for target in TARGET_ERRORS:
        row, peer = (find_fastest(rows, target, accuracy, program) for program in ("ckc_pin", "MuJoCo"))
        reason = ""
        if target <= accuracy:
            reason = f"the reference itself is accurate to {accuracy:.1e} only"
        elif row is None:
            reason = "none of the settings reaches it"
        advice.append(Advice(target, row, reason, peer))
    return advice


def find_fastest(rows: Sequence[PrecisionRow], target: float, accuracy: float, program: str) -> PrecisionRow | None:
    """Return a program's fastest row whose error, with the reference's uncertainty added, is within a target.

    Among rows of about equal time, the method "auto" is preferred.
    """
    good = [
        (row.wall_s, row)
        for row in rows
        if row.program == program
        and row.error is not None
        and row.wall_s is not None
        and row.error + accuracy <= target
    ]
    shortest = min((wall_s for wall_s, _ in good), default=0.0)
    equal = [(row.method != "auto", wall_s, row) for wall_s, row in good if wall_s <= (1 + EQUAL_TIME) * shortest]
    return min(equal, key=lambda each: each[:2])[2] if equal else None
