"""Draw a case, run it in all formulations, check the runs, and return a record."""

from __future__ import annotations

import re
import tempfile
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.contact import checks, comparisons
from scripts.experiments.fuzz.contact.cases import Case, Draw
from scripts.experiments.fuzz.contact.draw_chains import draw_closed, draw_jammed, draw_pendulums
from scripts.experiments.fuzz.contact.draw_resting import draw_gripper, draw_truss
from scripts.experiments.fuzz.contact.draw_slides import draw_racks, draw_stack, draw_tree
from scripts.experiments.fuzz.read import Model, UnsupportedMechanism, read_model

__all__ = ["KINDS", "CaseFault", "Record", "check_seed", "draw"]

KINDS: dict[str, tuple[Draw, float]] = {
    "stack": (draw_stack, 0.22),
    "tree": (draw_tree, 0.12),
    "racks": (draw_racks, 0.12),
    "pendulums": (draw_pendulums, 0.16),
    "closed": (draw_closed, 0.2),
    "jammed": (draw_jammed, 0.04),
    "truss": (draw_truss, 0.07),
    "gripper": (draw_gripper, 0.07),
}
FORMULATIONS = ("dae", "reduced", "spf")
BUDGET = {"solver.max_rhs": 200_000, "solver.max_wall_s": 5.0}
RTOL_FACTORS = (10.0, 100.0)  # tolerances over rtol of the runs that measure how errors grow
MAX_SPREAD = 1e-5  # s, and relative; formulations are compared until runs at these tolerances differ by more
SPREAD_FACTOR = 3.0  # allowed difference of formulations over the difference of these runs
TIME_STEPPING_EVERY = 12  # one seed of this many is compared with the time-stepping scheme
IMPACT_MARGIN_S = 1e-9
MIN_RATE_JUMP = 1e-3  # relative
MAX_STEP_RATIO = 3.0  # number of steps over the number without stops and friction


@dataclass(frozen=True)
class CaseFault:
    """Fault of a case: category of the table, formulation, and text."""

    category: str
    formulation: str
    text: str


@dataclass
class Record:
    """Result of one case."""

    seed: int
    kind: str
    runs: int = 0
    events: int = 0
    impacts: int = 0
    compared: bool = False  # formulations with each other
    magnified: bool = False  # formulations differ no more than runs at different tolerances
    referenced: bool = False  # compared with an independent reference
    seconds: float = 0.0
    faults: list[CaseFault] = field(default_factory=list)

    def add(self, category: str, formulation: str, text: str) -> None:
        """Add a fault if there is one."""
        if category and text:
            self.faults.append(CaseFault(category, formulation, text))

    def row(self) -> dict[str, Any]:
        """Return the record as a row of a table."""
        row = asdict(self)
        row["faults"] = " | ".join(f"{x.category} ({x.formulation}): {x.text}" for x in self.faults)
        return row


def draw(seed: int, kind: str | None = None) -> Case:
    """Return the case of a seed."""
    random = np.random.default_rng([seed, 6])
    weights = np.array([weight for _, weight in KINDS.values()])
    chosen = str(random.choice(list(KINDS), p=weights / weights.sum()))
    return KINDS[kind or chosen][0](seed, np.random.default_rng([seed, 7]))


def check_seed(seed: int, kind: str | None = None) -> Record:
    """Draw, run and check the case of a seed."""
    started = perf_counter()
    try:
        case = draw(seed, kind)
    except Exception as error:
        record = Record(seed, kind or "drawing")
        record.add("exception", "", _describe_exception(error))
        return record
    record = Record(seed, case.kind)
    with tempfile.TemporaryDirectory() as folder:
        _judge(case, Path(folder), record)
    record.seconds = perf_counter() - started
    return record


def _describe_exception(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno}, {last.name})"


def _simulate(scene: Path, case: Case, formulation: str, record: Record, **overrides: Any) -> Run | None:
    """Run a case. If the run is refused or raises an exception, add a fault and return None."""
    record.runs += 1
    try:
        run = ckc_pin.simulate(scene, {**BUDGET, **case.overrides, "formulation": formulation, **overrides})
    except CkcError as error:
        record.add("refused", formulation, str(error))
        return None
    except Exception as error:
        record.add("exception", formulation, _describe_exception(error))
        return None
    if run.status != "done":
        reason = run.message.split(": ", 1)[-1]  # the text before the colon describes the state
        named = any(re.search(rf"\b{re.escape(name)}\b", reason) for name in run.coordinates)
        record.add("stopped" if named else "unnamed", formulation, run.message)
    return run


def _judge(case: Case, folder: Path, record: Record) -> None:
    scene = case.write(folder / "case")
    try:
        mechanism = ckc_pin.load(scene)
    except CkcError as error:
        record.add("refused", "", str(error))
        return
    except Exception as error:
        record.add("exception", "", _describe_exception(error))
        return
    formulations = FORMULATIONS[:1] if mechanism.splits_root else FORMULATIONS
    runs = {name: run for name in formulations if (run := _simulate(scene, case, name, record)) is not None}
    if not runs:
        return
    try:
        model = read_model(case.texts)
    except UnsupportedMechanism as error:
        record.add("unsupported", "", str(error))
        return
    for name, run in runs.items():
        _judge_run(case, name, run, model, record)
    first = next(iter(runs.values()))
    record.events, record.impacts = len(first.events), len(checks.list_impacts(first))
    if case.compares_steps:
        _compare_steps(case, folder, runs, record)
    _compare_formulations(case, scene, runs, model, record)
    if first.status == "done":
        _compare_with_references(case, first, model, record)
        if record.impacts and not case.jammed:
            _check_rate_event(case, scene, first, record)


def _judge_run(case: Case, name: str, run: Run, model: Model, record: Record) -> None:
    finite = all(bool(np.isfinite(x).all()) for x in (run.q_tree, run.v_tree, run.energy))
    if not finite:
        record.add("energy", name, "not finite")
        return
    if run.status == "done":
        record.add(*_tagged(name, checks.check_energy(run, model, case)))
        record.add("limits", name, checks.check_limits(run, case))
        if case.quiet:
            record.add("quiet", name, checks.check_quiet_joints(run, case))
        if case.jammed:
            record.add("rest", name, checks.check_rest(run, model, case))
    if not case.conservative and "torque_limit" in case.overrides["controller"]:
        limit = case.overrides["controller"]["torque_limit"]
        if np.abs(run.tau).max(initial=0.0) > limit * (1 + 1e-12):
            record.add("limits", name, f"tau of {np.abs(run.tau).max():.6g} exceeds its limit {limit:.6g}")


def _tagged(formulation: str, fault: tuple[str, str]) -> tuple[str, str, str]:
    return fault[0], formulation, fault[1]


def _compare_steps(case: Case, folder: Path, runs: dict[str, Run], record: Record) -> None:
    scene_without_contact = case.write(folder / "plain", contacts=False)
    for name, run in runs.items():
        without = ckc_pin.simulate(scene_without_contact, {**BUDGET, **case.overrides, "formulation": name})
        if run.stats["steps"] > MAX_STEP_RATIO * without.stats["steps"] + 5:
            record.add("slow", name, f"{run.stats['steps']} steps, {without.stats['steps']} without stops and friction")


def _compare_formulations(case: Case, scene: Path, runs: dict[str, Run], model: Model, record: Record) -> None:
    """Compare formulations event by event. If they differ, measure how much each differs at other tolerances."""
    done = {name: run for name, run in runs.items() if run.status == "done"}
    if len(done) < 2:
        return
    record.compared = True
    (name, one), *others = done.items()
    allowed = checks.compute_allowed_error(case, checks.AGREEMENT)
    spread: dict[str, tuple[float, float]] = {}
    for other, run in others:
        agreement = comparisons.compare(one, run, model, allowed)
        if not agreement.fault:
            continue
        for formulation in (name, other):
            if formulation not in spread:
                spread[formulation] = _measure_spread(case, scene, formulation, done[formulation], model)
        error, until = max(spread[name][0], spread[other][0]), min(spread[name][1], spread[other][1])
        if comparisons.compare(one, run, model, max(allowed, SPREAD_FACTOR * error), until).fault:
            record.add("formulations", f"{name}, {other}", agreement.fault)
        else:
            record.magnified = True


def _measure_spread(case: Case, scene: Path, formulation: str, run: Run, model: Model) -> tuple[float, float]:
    """Return the error of runs at larger tolerances, and the time until which it is at most MAX_SPREAD."""
    error, until = 0.0, float(run.t[-1])
    for factor in RTOL_FACTORS:
        rtol = min(1e-3, factor * case.overrides["solver.rtol"])
        coarse = _simulate(scene, case, formulation, Record(case.seed, case.kind), **{"solver.rtol": rtol})
        if coarse is not None:
            agreement = comparisons.compare(run, coarse, model, MAX_SPREAD)
            error = max(error, agreement.error if agreement.error <= MAX_SPREAD else 0.0)
            until = min(until, agreement.until)
    return error, until


def _compare_with_references(case: Case, run: Run, model: Model, record: Record) -> None:
    try:
        if case.linear and case.conservative and not case.jammed:
            category, text = comparisons.compare_with_event_driven(run, model, case)
            record.referenced = category != "unsupported"
            if category == "reference":
                record.add(category, "dae", text)
        chains = case.kind in ("pendulums", "closed chains") and case.conservative
        if chains and case.seed % TIME_STEPPING_EVERY == 0 and "F" not in model.kind and case.contacts:
            record.referenced = True
            record.add(*_tagged("dae", comparisons.compare_with_time_stepping(run, model, case)))
    except np.linalg.LinAlgError:
        record.referenced = False


def _check_rate_event(case: Case, scene: Path, run: Run, record: Record) -> None:
    """Check that an event on a rate is triggered by an impact that jumps over its value, in all formulations."""
    random = np.random.default_rng([case.seed, 8])
    if random.random() > 0.3:
        return
    hits = [event for event in checks.list_impacts(run) if event["t"] > 0]
    if not hits:
        return
    hit = hits[int(random.integers(len(hits)))]
    t, name = float(hit["t"]), str(hit["coordinate"])
    sides = []
    for end in (t - IMPACT_MARGIN_S, t + IMPACT_MARGIN_S):
        run_to_side = _simulate(scene, case, "dae", Record(case.seed, case.kind), t_end=end)
        if run_to_side is None or run_to_side.status != "done":
            return
        sides.append(float(run_to_side.v_tree[-1, run_to_side.column(name)]))
    before, after = sides
    if abs(after - before) < MIN_RATE_JUMP * max(1.0, abs(before)):
        return
    value = before + float(random.uniform(0.1, 0.9)) * (after - before)
    for formulation in FORMULATIONS[:1] if run.mechanism.splits_root else FORMULATIONS:
        event = {"of": "q_dot", "coordinate": name, "value": value}
        rerun = _simulate(scene, case, formulation, record, event=[event])
        if rerun is not None and rerun.t[-1] >= t:
            record.add("rate event", formulation, checks.check_rate_event(rerun, name, value, t))
