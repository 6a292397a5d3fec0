"""Run a random motion, check it segment by segment against the reference integrator, and return a record."""

from __future__ import annotations

import traceback
from dataclasses import asdict, dataclass, fields
from time import perf_counter
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.events import check_crossings, check_turning_point, measure_event_error
from scripts.experiments.fuzz.joint_forces import ControlMismatch, read_joint_forces
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.read import UnsupportedMechanism, read_model
from scripts.experiments.fuzz.reference import ReferenceIntegrator
from scripts.experiments.fuzz.reversal import measure_reversal_error
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import compute_energy

__all__ = ["ALLOWED_FACTOR", "FIELDS", "Record", "run_motion"]

ALLOWED_FACTOR, ERROR_FLOOR = 1e3, 1e-9  # the error of a segment may be ALLOWED_FACTOR * rtol + ERROR_FLOOR
MAX_CONSTRAINT_VIOLATION = 1e-9  # relative to the mechanism's size
SUSPECT_FACTOR = 30.0  # times rtol; segments with a larger error are ignored if they are ill-conditioned
GROSS_ERROR = 0.3  # relative to the largest coordinate or to the energy; reported at any tolerance


@dataclass
class Record:
    """Result of one run. Errors of segments are divided by rtol."""

    seed: int
    mechanism: str
    scene: str = ""
    formulation: str = ""
    method: str = ""
    rtol: float = np.nan
    t_end: float = np.nan
    control: bool = False
    events: int = 0
    triggered: int = 0
    event_error: float = np.nan
    status: str = ""
    message: str = ""
    t: float = np.nan
    rhs: int = 0
    segments: int = 0
    unresolved: int = 0
    p50: float = np.nan
    p90: float = np.nan
    worst: float = np.nan
    worst_t: float = np.nan
    drift: float = np.nan
    jump: float = np.nan
    phi: float = np.nan
    reversal: float = np.nan
    verdict: str = ""
    gross: bool = False
    fault: str = ""
    seconds: float = np.nan
    checking_seconds: float = np.nan
    errors: str = ""

    @property
    def failed_before_stop(self) -> bool:
        """Whether a run stopped only after it had gone wrong."""
        return self.verdict == "stopped" and bool(self.fault) and not self.fault.startswith("unsupported")

    def row(self) -> dict[str, Any]:
        """Return the record as a row of a table."""
        return asdict(self)


FIELDS = [field.name for field in fields(Record)]


def run_motion(motion: Motion, *, thorough: bool = False) -> tuple[Record, Run | None]:
    """Run a motion and check it; exceptions other than CkcError are recorded as faults.

    `thorough`: check it with further runs too, reversed and with events next to a turning point.
    """
    overrides = motion.overrides
    record = Record(
        motion.seed, motion.mechanism, motion.scene, overrides["formulation"], overrides.get("solver.method", "auto"),
        overrides["solver.rtol"], overrides["t_end"], overrides.get("controller") is not None,
        len(overrides.get("event", [])),
    )  # fmt: skip
    started = perf_counter()
    try:
        run = ckc_pin.simulate(motion.scene, overrides)
    except CkcError as error:
        record.status, record.message, record.verdict = "refused", str(error), "refused"
        record.seconds = perf_counter() - started
        return record, None
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        record.status, record.verdict = "exception", "EXCEPTION"
        record.message = f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})"
        record.seconds = perf_counter() - started
        return record, None
    record.seconds, started = perf_counter() - started, perf_counter()
    record.status, record.message, record.t = run.status, run.message, float(run.t[-1])
    record.rhs, record.triggered = int(run.stats["rhs"]), len(run.events)
    _check_run(record, run, motion, thorough)
    record.checking_seconds = perf_counter() - started
    return record, run


def _check_run(record: Record, run: Run, motion: Motion, thorough: bool) -> None:
    mechanism = run.mechanism
    record.phi = run.max_phi
    finite = all(bool(np.isfinite(x).all()) for x in (run.q_tree, run.v_tree, run.energy))
    record.verdict = run.status
    fault = "" if finite else "not finite"
    if run.status == "stopped" and not run.message:
        fault = "stopped without a reason"
    allowed = max(10 * mechanism.tolerance, MAX_CONSTRAINT_VIOLATION * max(1.0, mechanism.size))
    if finite and not run.max_phi <= allowed:
        fault = f"loops open by {run.max_phi:.2g}"
    if finite:
        fault = fault or check_crossings(run, motion.overrides.get("event", []))
    if finite and not run.w.any() and len(run.t) > 1:
        try:
            if mechanism.joints.friction.any():
                raise UnsupportedMechanism("dry friction")
            reference = ReferenceIntegrator(read_model(run.texts))
            fault = _check_segments(record, run, motion, reference) or fault
            fault = fault or _check_events_and_reversal(record, run, motion, reference, thorough)
        except UnsupportedMechanism as error:
            record.fault = f"unsupported by the reference integrator: {error}"
        except ControlMismatch as error:
            fault = str(error)
    if fault and run.status == "done":
        record.verdict = "WRONG"
    record.fault = fault or record.fault


def _check_segments(record: Record, run: Run, motion: Motion, reference: ReferenceIntegrator) -> str:
    """Check some segments and the energy; return the fault as text, or ""."""
    model, rtol, controller = reference.model, record.rtol, motion.overrides.get("controller")
    conservative = model.conservative and controller is None
    order = [run.coordinates.index(label) for label in model.labels]
    q, v = run.q_tree[:, order], run.v_tree[:, order]
    kinetic, potential = compute_energy(model, q, v)
    total_energy = kinetic + potential
    largest_energy = float(np.abs(total_energy).max())
    weight = float(model.mass.sum() * np.linalg.norm(model.gravity) * model.size)  # energy at rest is rounding error
    scale = max(float(kinetic.max()), float(np.ptp(potential)), 1e-6 * largest_energy, 1e-6 * weight, 1e-300)
    fault = ""
    if np.abs(total_energy - run.energy).max() > 1e-9 * max(scale, largest_energy):
        fault = "run.energy differs from the energy of the states"
    if conservative:
        record.drift = float(np.abs(total_energy - total_energy[0]).max() / scale)
        record.jump = float(np.abs(np.diff(total_energy)).max() / scale)
    rows, forces = np.arange(len(run.t)), None
    if controller is not None:
        rows, forces = read_joint_forces(controller, model, run, motion.overrides["solver.output_dt"])
    q, v, t = q[rows], v[rows], run.t[rows]
    chosen = _choose_segments(np.random.default_rng([motion.seed, 4]), total_energy if conservative else None, v)
    forces = None if forces is None else forces[chosen]
    dt = np.diff(t)[chosen]
    if reference.has_no_mass(q[chosen]):
        raise UnsupportedMechanism("a freedom that moves no mass")
    end = reference.integrate_segments(q[chosen], v[chosen], dt, 1e-3 * rtol, forces)
    error = reference.compute_error(q[chosen + 1], v[chosen + 1], end.q, end.v)
    suspect = error > SUSPECT_FACTOR * rtol
    end.resolved[reference.find_ill_conditioned(q[chosen], v[chosen], dt, end, suspect, forces)] = False
    record.segments, record.unresolved = int(end.resolved.sum()), int((~end.resolved).sum())
    if record.segments:
        errors = error[end.resolved] / rtol
        record.p50, record.p90, record.worst = (float(np.percentile(errors, p)) for p in (50, 90, 100))
        record.worst_t = float(t[chosen[end.resolved][np.argmax(errors)]])
        record.errors = " ".join(f"{x:.3g}" for x in errors)
        record.gross = run.status == "done" and bool(error[end.resolved].max() > GROSS_ERROR)
        if error[end.resolved].max() > ALLOWED_FACTOR * rtol + ERROR_FLOOR:
            fault = f"a segment off by {error[end.resolved].max():.2g} at t = {record.worst_t:.4g}"
    record.gross |= run.status == "done" and record.drift > GROSS_ERROR
    if not fault and record.jump > 10 * ALLOWED_FACTOR * rtol + ERROR_FLOOR:
        fault = f"energy jumps by {record.jump:.2g}"
    return fault


def _check_events_and_reversal(
    record: Record, run: Run, motion: Motion, reference: ReferenceIntegrator, thorough: bool
) -> str:
    """Check events, and if `thorough` the reversed motion and a turning point; return the fault as text, or ""."""
    order = [run.coordinates.index(label) for label in reference.model.labels]
    allowed = ALLOWED_FACTOR + ERROR_FLOOR / record.rtol
    if not record.control:
        record.event_error, t = measure_event_error(run, reference, order, record.rtol, SUSPECT_FACTOR)
        if record.event_error > allowed:
            return f"an event off by {record.event_error * record.rtol:.2g} at t = {t:.4g}"
    if not (thorough and run.status == "done"):
        return ""
    if record.jump == record.jump:
        record.reversal = measure_reversal_error(run, motion, reference, order, SUSPECT_FACTOR)
        if record.reversal > allowed:
            return f"the reversed run is off by {record.reversal * record.rtol:.2g}"
    return check_turning_point(motion, run.coordinates)


def _choose_segments(random: np.random.Generator, total_energy: Array | None, v: Array) -> np.ndarray:
    """Return up to eight segments: the largest changes of energy and of v', and two random ones."""
    last = len(v) - 1
    by_v = np.argsort(-np.abs(np.diff(v, axis=0)).max(axis=1))[: 3 if total_energy is not None else 5]
    by_energy = np.argsort(-np.abs(np.diff(total_energy)))[:3] if total_energy is not None else by_v
    return np.unique(np.concatenate([by_v, by_energy, random.integers(0, last, 2)]))
