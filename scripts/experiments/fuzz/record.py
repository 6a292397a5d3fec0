"""One run: computed, judged piece by piece, and written down as one record."""

from __future__ import annotations

import traceback
from dataclasses import asdict, dataclass, fields
from time import perf_counter
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.events import beside_a_turn, between_rows, located
from scripts.experiments.fuzz.joint_forces import Unlike, joint_forces
from scripts.experiments.fuzz.judge import Judge
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.read import NoJudge, read
from scripts.experiments.fuzz.reversal import reversal
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import energy

__all__ = ["ALLOWED", "FIELDS", "Record", "run_motion"]

ALLOWED, FLOOR = 1e3, 1e-9  # a piece of a run that is done may be off by ALLOWED * rtol + FLOOR
OPEN = 1e-9  # of the mechanism's size: what a closure may be open, at most
DOUBTFUL = 30.0  # times rtol: a piece off by more counts only if it does not magnify errors that much itself
GROSS = 0.3  # of the largest coordinate or of the energy: no tolerance excuses it


@dataclass
class Record:
    """What came of one run. Errors of pieces are divided by rtol."""

    seed: int
    mechanism: str
    scene: str = ""
    formulation: str = ""
    method: str = ""
    rtol: float = np.nan
    t_end: float = np.nan
    control: bool = False
    events: int = 0
    met: int = 0
    event_off: float = np.nan
    status: str = ""
    message: str = ""
    t: float = np.nan
    rhs: int = 0
    pieces: int = 0
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
    why: str = ""
    seconds: float = np.nan
    judging: float = np.nan
    errors: str = ""

    @property
    def off(self) -> bool:
        """Whether a run stopped only after it had gone wrong."""
        return self.verdict == "stopped" and bool(self.why) and not self.why.startswith("no judge")

    def row(self) -> dict[str, Any]:
        """As a row of a table."""
        return asdict(self)


FIELDS = [field.name for field in fields(Record)]


def run_motion(motion: Motion, *, thorough: bool = False) -> tuple[Record, Run | None]:
    """Run a motion and judge it, thoroughly by further runs too; what comes out but a CkcError is a finding."""
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
        record.status, record.verdict = "raw", "RAW"
        record.message = f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})"
        record.seconds = perf_counter() - started
        return record, None
    record.seconds, started = perf_counter() - started, perf_counter()
    record.status, record.message, record.t = run.status, run.message, float(run.t[-1])
    record.rhs, record.met = int(run.stats["rhs"]), len(run.events)
    _judge(record, run, motion, thorough)
    record.judging = perf_counter() - started
    return record, run


def _judge(record: Record, run: Run, motion: Motion, thorough: bool) -> None:
    mechanism = run.mechanism
    record.phi = run.max_phi
    finite = all(bool(np.isfinite(x).all()) for x in (run.q_tree, run.v_tree, run.energy))
    record.verdict = run.status
    wrong = "" if finite else "not finite"
    if run.status == "stopped" and not run.message:
        wrong = "stopped without a reason"
    allowed = max(10 * mechanism.tolerance, OPEN * max(1.0, mechanism.size))
    if finite and not run.max_phi <= allowed:
        wrong = f"open by {run.max_phi:.2g}"
    if finite:
        wrong = wrong or between_rows(run, motion.overrides.get("event", []))
    if finite and not run.w.any() and len(run.t) > 1:
        try:
            if mechanism.joints.friction.any():
                raise NoJudge("dry friction")
            judge = Judge(read(run.texts))
            wrong = _pieces(record, run, motion, judge) or wrong
            wrong = wrong or _beyond_pieces(record, run, motion, judge, thorough)
        except NoJudge as error:
            record.why = f"no judge: {error}"
        except Unlike as error:
            wrong = str(error)
    if wrong and run.status == "done":
        record.verdict = "WRONG"
    record.why = wrong or record.why


def _pieces(record: Record, run: Run, motion: Motion, judge: Judge) -> str:
    """Judge some pieces; what is wrong with them, if anything."""
    model, rtol, controller = judge.model, record.rtol, motion.overrides.get("controller")
    conservative = model.conservative and controller is None
    order = [run.coordinates.index(label) for label in model.labels]
    q, v = run.q_tree[:, order], run.v_tree[:, order]
    kinetic, potential = energy(model, q, v)
    total = kinetic + potential
    weight = float(model.mass.sum() * np.linalg.norm(model.gravity) * model.size)  # at rest energy is all rounding
    scale = max(
        float(kinetic.max()), float(np.ptp(potential)), 1e-6 * float(np.abs(total).max()), 1e-6 * weight, 1e-300
    )
    wrong = ""
    if np.abs(total - run.energy).max() > 1e-9 * max(scale, float(np.abs(total).max())):
        wrong = "the energy written down is not that of the states"
    if conservative:
        record.drift = float(np.abs(total - total[0]).max() / scale)
        record.jump = float(np.abs(np.diff(total)).max() / scale)
    rows, acting = np.arange(len(run.t)), None
    if controller is not None:
        rows, acting = joint_forces(controller, model, run, motion.overrides["solver.output_dt"])
    q, v, t = q[rows], v[rows], run.t[rows]
    chosen = _choose(np.random.default_rng([motion.seed, 4]), total if conservative else None, v)
    acting = None if acting is None else acting[chosen]
    dt = np.diff(t)[chosen]
    if judge.has_no_mass(q[chosen]):
        raise NoJudge("a freedom that moves no mass")
    end = judge.pieces(q[chosen], v[chosen], dt, 1e-3 * rtol, acting)
    off = judge.error(q[chosen + 1], v[chosen + 1], end.q, end.v)
    end.resolved[judge.sensitive(q[chosen], v[chosen], dt, end, off > DOUBTFUL * rtol, acting)] = False
    record.pieces, record.unresolved = int(end.resolved.sum()), int((~end.resolved).sum())
    if record.pieces:
        errors = off[end.resolved] / rtol
        record.p50, record.p90, record.worst = (float(np.percentile(errors, p)) for p in (50, 90, 100))
        record.worst_t = float(t[chosen[end.resolved][np.argmax(errors)]])
        record.errors = " ".join(f"{x:.3g}" for x in errors)
        record.gross = run.status == "done" and bool(off[end.resolved].max() > GROSS)
        if off[end.resolved].max() > ALLOWED * rtol + FLOOR:
            wrong = f"a piece off by {off[end.resolved].max():.2g} at t = {record.worst_t:.4g}"
    record.gross |= run.status == "done" and record.drift > GROSS
    if not wrong and record.jump > 10 * ALLOWED * rtol + FLOOR:
        wrong = f"energy jumps by {record.jump:.2g}"
    return wrong


def _beyond_pieces(record: Record, run: Run, motion: Motion, judge: Judge, thorough: bool) -> str:
    """Judge events, and thoroughly the way back and values beside a turn; what is wrong with them, if anything."""
    order = [run.coordinates.index(label) for label in judge.model.labels]
    allowed = ALLOWED + FLOOR / record.rtol
    if not record.control:
        record.event_off, t = located(run, judge, order, record.rtol, DOUBTFUL)
        if record.event_off > allowed:
            return f"an event off by {record.event_off * record.rtol:.2g} at t = {t:.4g}"
    if not (thorough and run.status == "done"):
        return ""
    if record.jump == record.jump:
        record.reversal = reversal(run, motion, judge, order, DOUBTFUL)
        if record.reversal > allowed:
            return f"the way back misses its past by {record.reversal * record.rtol:.2g}"
    return beside_a_turn(motion, run.coordinates)


def _choose(random: np.random.Generator, total: Array | None, v: Array) -> np.ndarray:
    """Up to eight pieces: where energy changes most, where v' does, and some others."""
    last = len(v) - 1
    by_v = np.argsort(-np.abs(np.diff(v, axis=0)).max(axis=1))[: 3 if total is not None else 5]
    by_energy = np.argsort(-np.abs(np.diff(total)))[:3] if total is not None else by_v
    return np.unique(np.concatenate([by_v, by_energy, random.integers(0, last, 2)]))
