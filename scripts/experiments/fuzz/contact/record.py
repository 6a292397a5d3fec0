"""One case: drawn, run in every formulation, judged, and written down as one record."""

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
from scripts.experiments.fuzz.contact import comparisons, judges
from scripts.experiments.fuzz.contact.cases import Case, Draw
from scripts.experiments.fuzz.contact.draw_chains import draw_closed, draw_jammed, draw_pendulums
from scripts.experiments.fuzz.contact.draw_resting import draw_gripper, draw_truss
from scripts.experiments.fuzz.contact.draw_slides import draw_racks, draw_stack, draw_tree
from scripts.experiments.fuzz.read import Model, NoJudge, read

__all__ = ["KINDS", "Finding", "Record", "draw", "judge_seed"]

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
COARSER = (10.0, 100.0)  # times rtol: runs that say how errors grow
LARGEST_SPREAD = 1e-5  # s, and relative: where such runs are further apart, formulations are not compared
MAGNIFIED = 3.0  # times what such runs are off
STEPPED = 12  # every so many seeds of chains are compared with the time-stepping scheme
BESIDE_IMPACT = 1e-9  # s
LEAST_JUMP = 1e-3  # of a rate at an impact, relative
MORE_STEPS = 3.0  # times those without stops and friction


@dataclass(frozen=True)
class Finding:
    """What is wrong with a case: a category of the table, the formulation, and the text."""

    category: str
    formulation: str
    text: str


@dataclass
class Record:
    """What came of one case."""

    seed: int
    kind: str
    runs: int = 0
    events: int = 0
    impacts: int = 0
    compared: bool = False  # by formulations
    magnified: bool = False  # formulations differ after errors have grown, or by as much as two tolerances do
    referenced: bool = False  # by a reference of the suite's own
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)

    def add(self, category: str, formulation: str, text: str) -> None:
        """Note a finding, if there is one."""
        if category and text:
            self.findings.append(Finding(category, formulation, text))

    def row(self) -> dict[str, Any]:
        """As a row of a table."""
        row = asdict(self)
        row["findings"] = " | ".join(f"{x.category} ({x.formulation}): {x.text}" for x in self.findings)
        return row


def draw(seed: int, kind: str | None = None) -> Case:
    """The case of a seed."""
    random = np.random.default_rng([seed, 6])
    weights = np.array([weight for _, weight in KINDS.values()])
    chosen = str(random.choice(list(KINDS), p=weights / weights.sum()))
    return KINDS[kind or chosen][0](seed, np.random.default_rng([seed, 7]))


def judge_seed(seed: int, kind: str | None = None) -> Record:
    """Draw, run and judge the case of a seed."""
    started = perf_counter()
    try:
        case = draw(seed, kind)
    except Exception as error:
        record = Record(seed, kind or "drawing")
        record.add("raw", "", _said(error))
        return record
    record = Record(seed, case.kind)
    with tempfile.TemporaryDirectory() as folder:
        _judge(case, Path(folder), record)
    record.seconds = perf_counter() - started
    return record


def _said(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno}, {last.name})"


def _simulate(scene: Path, case: Case, formulation: str, record: Record, **overrides: Any) -> Run | None:
    """One run; None with a finding where there is none."""
    record.runs += 1
    try:
        run = ckc_pin.simulate(scene, {**BUDGET, **case.overrides, "formulation": formulation, **overrides})
    except CkcError as error:
        record.add("refused", formulation, str(error))
        return None
    except Exception as error:
        record.add("raw", formulation, _said(error))
        return None
    if run.status != "done":
        reason = run.message.split(": ", 1)[-1]  # after the state where it stopped
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
        record.add("raw", "", _said(error))
        return
    formulations = FORMULATIONS[:1] if mechanism.splits_root else FORMULATIONS
    runs = {name: run for name in formulations if (run := _simulate(scene, case, name, record)) is not None}
    if not runs:
        return
    try:
        model = read(case.texts)
    except NoJudge as error:
        record.add("unjudged", "", str(error))
        return
    for name, run in runs.items():
        _judge_run(case, name, run, model, record)
    first = next(iter(runs.values()))
    record.events, record.impacts = len(first.events), len(judges.jumps(first))
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
        record.add(*_with(name, judges.energy_fault(run, model, case)))
        record.add("limits", name, judges.limits_fault(run, case))
        if case.quiet:
            record.add("quiet", name, judges.quiet_fault(run, case))
        if case.jammed:
            record.add("rest", name, judges.rest_fault(run, model, case))
    if not case.conservative and "torque_limit" in case.overrides["controller"]:
        limit = case.overrides["controller"]["torque_limit"]
        if np.abs(run.tau).max(initial=0.0) > limit * (1 + 1e-12):
            record.add("limits", name, f"tau of {np.abs(run.tau).max():.6g} beyond its limit {limit:.6g}")


def _with(formulation: str, fault: tuple[str, str]) -> tuple[str, str, str]:
    return fault[0], formulation, fault[1]


def _compare_steps(case: Case, folder: Path, runs: dict[str, Run], record: Record) -> None:
    plain = case.write(folder / "plain", contacts=False)
    for name, run in runs.items():
        without = ckc_pin.simulate(plain, {**BUDGET, **case.overrides, "formulation": name})
        if run.stats["steps"] > MORE_STEPS * without.stats["steps"] + 5:
            record.add("slow", name, f"{run.stats['steps']} steps, {without.stats['steps']} without stops and friction")


def _compare_formulations(case: Case, scene: Path, runs: dict[str, Run], model: Model, record: Record) -> None:
    """Compare formulations event by event; where they differ, by how much each does at other tolerances."""
    done = {name: run for name, run in runs.items() if run.status == "done"}
    if len(done) < 2:
        return
    record.compared = True
    (name, one), *others = done.items()
    allowed = judges.allowed_error(case, judges.AGREE)
    spread: dict[str, tuple[float, float]] = {}
    for other, run in others:
        found = comparisons.compare(one, run, model, allowed)
        if not found.fault:
            continue
        for of in (name, other):
            if of not in spread:
                spread[of] = _spread(case, scene, of, done[of], model)
        off, until = max(spread[name][0], spread[other][0]), min(spread[name][1], spread[other][1])
        if comparisons.compare(one, run, model, max(allowed, MAGNIFIED * off), until).fault:
            record.add("formulations", f"{name}, {other}", found.fault)
        else:
            record.magnified = True


def _spread(case: Case, scene: Path, formulation: str, run: Run, model: Model) -> tuple[float, float]:
    """How far runs at other tolerances are off one, and until when they are off by no more than LARGEST_SPREAD."""
    off, until = 0.0, float(run.t[-1])
    for times in COARSER:
        rtol = min(1e-3, times * case.overrides["solver.rtol"])
        coarse = _simulate(scene, case, formulation, Record(case.seed, case.kind), **{"solver.rtol": rtol})
        if coarse is not None:
            found = comparisons.compare(run, coarse, model, LARGEST_SPREAD)
            off, until = max(off, found.off if found.off <= LARGEST_SPREAD else 0.0), min(until, found.until)
    return off, until


def _compare_with_references(case: Case, run: Run, model: Model, record: Record) -> None:
    try:
        if case.linear and case.conservative and not case.jammed:
            category, text = comparisons.compare_with_slides(run, model, case)
            record.referenced = category != "unjudged"
            if category == "reference":
                record.add(category, "dae", text)
        chains = case.kind in ("pendulums", "closed chains") and case.conservative
        if chains and case.seed % STEPPED == 0 and "F" not in model.kind and case.contacts:
            record.referenced = True
            record.add(*_with("dae", comparisons.compare_with_steps(run, model, case)))
    except np.linalg.LinAlgError:
        record.referenced = False


def _check_rate_event(case: Case, scene: Path, run: Run, record: Record) -> None:
    """An event on a rate whose value an impact jumps over is met at the impact, in every formulation."""
    random = np.random.default_rng([case.seed, 8])
    if random.random() > 0.3:
        return
    hits = [event for event in judges.jumps(run) if event["t"] > 0]
    if not hits:
        return
    hit = hits[int(random.integers(len(hits)))]
    t, name = float(hit["t"]), str(hit["coordinate"])
    sides = []
    for end in (t - BESIDE_IMPACT, t + BESIDE_IMPACT):
        beside = _simulate(scene, case, "dae", Record(case.seed, case.kind), t_end=end)
        if beside is None or beside.status != "done":
            return
        sides.append(float(beside.v_tree[-1, beside.column(name)]))
    before, after = sides
    if abs(after - before) < LEAST_JUMP * max(1.0, abs(before)):
        return
    value = before + float(random.uniform(0.1, 0.9)) * (after - before)
    for formulation in FORMULATIONS[:1] if run.mechanism.splits_root else FORMULATIONS:
        event = {"of": "q_dot", "coordinate": name, "value": value}
        again = _simulate(scene, case, formulation, record, event=[event])
        if again is not None and again.t[-1] >= t:
            record.add("rate event", formulation, judges.rate_event_fault(again, name, value, t))
