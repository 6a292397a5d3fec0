"""Shrink a failing run: fewer keys, a later start, a shorter time, rounded numbers, with the same failure."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

from ckc_pin import Run
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.record import Record, run_motion

__all__ = ["shrink"]

NEEDED = ("formulation", "t_end", "solver.rtol", "solver.output_dt", "initial", "controller")
MAX_TRIALS = 300


def shrink(motion: Motion) -> Motion:
    """Return the smallest motion found that has the same failure; the motion itself if it does not fail."""
    record, run = run_motion(motion, thorough=True)
    failure, trials = _classify_failure(record), 0
    shrunk = record.verdict != "done" or record.gross
    while shrunk and trials < MAX_TRIALS:
        shrunk = False
        for overrides in _simpler_overrides(motion.overrides, record, run):
            trials += 1
            smaller = replace(motion, overrides=overrides)
            smaller_record, smaller_run = run_motion(smaller, thorough=True)
            if _classify_failure(smaller_record) == failure:
                motion, record, run, shrunk = smaller, smaller_record, smaller_run, True
                break
    return motion


def _classify_failure(record: Record) -> tuple[str, bool, str]:
    """Return the kind of failure: the verdict, and the message without its numbers."""
    message = record.message if record.verdict in ("EXCEPTION", "stopped", "refused") else record.fault
    return record.verdict, record.failed_before_stop, re.sub(r"-?\d[\d.e+-]*", "#", message)[:40]


def _simpler_overrides(overrides: Mapping[str, Any], record: Record, run: Run | None) -> Iterator[dict[str, Any]]:
    """Yield simpler overrides, the largest simplifications first."""
    for key in overrides:
        if key not in NEEDED:
            yield {k: x for k, x in overrides.items() if k != key}
    if overrides.get("controller") is not None:
        yield {**overrides, "controller": None}
    if len(overrides.get("event", [])) > 1:
        for k in range(len(overrides["event"])):
            yield {**overrides, "event": [overrides["event"][k]]}
    if run is not None and record.worst_t == record.worst_t:
        end = record.worst_t + 2 * overrides["solver.output_dt"]
        if end < 0.95 * overrides["t_end"]:
            yield {**overrides, "t_end": end}
        for part in (0.98, 0.9, 0.7, 0.5, 0.3):
            k = run.at(part * record.worst_t)
            if run.t[k] > 0.1 * overrides["t_end"]:
                yield {**overrides, "initial": _initial_state(run, k), "t_end": overrides["t_end"] - float(run.t[k])}
    if overrides["t_end"] != (short := float(f"{overrides['t_end']:.2g}")):
        yield {**overrides, "t_end": short}
    if overrides["solver.rtol"] != (round_ := float(f"{overrides['solver.rtol']:.0e}")):
        yield {**overrides, "solver.rtol": round_}
    for digits in (2, 3, 4, 6):
        for table in ("q", "q_dot"):
            initial = deepcopy(dict(overrides["initial"]))
            if table in initial:
                initial[table] = {name: float(f"{x:.{digits}g}") for name, x in initial[table].items()}
                if initial != overrides["initial"]:
                    yield {**overrides, "initial": initial}


def _initial_state(run: Run, k: int) -> dict[str, Any]:
    """Return row k of a run as initial values. All coordinates are included, so that they select the branch."""
    q = dict(zip(run.coordinates, run.q_tree[k].tolist(), strict=True))
    return {"q": q, "q_dot": {name: float(run.v_tree[k, run.column(name)]) for name in run.independent}}
