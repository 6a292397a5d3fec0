"""What a run says of its events, judged: by its own rows, by pieces integrated anew, and beside turning points."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.judge import Judge
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.spatial import Array

__all__ = ["beside_a_turn", "between_rows", "located", "on_both_sides"]

CLEAR = 1e-9  # relative; a row nearer to an event's value may be on either side of it
MOST = 6  # events integrated to
TIGHT = 1e-6  # rtol beside a turning point: rates there are those of the coordinate well enough to know the turn
BESIDE = 1e-6  # of the coordinate's range: how far from a turning point a value is
SAME = 1e-9  # s
LEAST_RANGE = 1e-3  # relative; a coordinate that moves less has no turn to tell apart
TURNS = (".rx", ".ry", ".rz")  # of a rotation vector, which may go from one end to the other

Key = tuple[str, str, float]


def _column(run: Run, of: str, coordinate: str) -> Array:
    return (run.q_tree if of == "q" else run.v_tree)[:, run.column(coordinate)]


def _judged(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Events of coordinates and rates, but for turns that are known up to a whole one."""
    return [e for e in events if e["of"] == "q_dot" or (e["of"] == "q" and not e["coordinate"].endswith(TURNS))]


def between_rows(run: Run, asked: Sequence[dict[str, Any]]) -> str:
    """Whether between rows on either side of a value there are the crossings that lead from one to the other."""
    by_key: dict[Key, list[int]] = {}
    for event in _judged(asked):
        by_key.setdefault((event["of"], event["coordinate"], event["value"]), []).append(event.get("direction", 0))
    for (of, coordinate, value), directions in by_key.items():
        met = [e for e in run.events if (e["of"], e["coordinate"], e["value"]) == (of, coordinate, value)]
        gap = _column(run, of, coordinate) - value
        clear = np.flatnonzero(np.abs(gap) > CLEAR * max(1.0, np.abs(gap).max(), abs(value)))
        for i, j in pairwise(clear):
            here = [e["direction"] for e in met if run.t[i] < e["t"] <= run.t[j]]
            if not _leads(here, directions, int(np.sign(gap[j]) - np.sign(gap[i])) // 2):
                return f"{len(here)} events of {coordinate} between t = {run.t[i]:.6g} and {run.t[j]:.6g}"
    return ""


def _leads(met: Sequence[int], asked: Sequence[int], way: int) -> bool:
    """Whether crossings of one value lead to its other side (way 1 or -1) or back (0), as far as both are asked for."""
    rises, falls = (
        met.count(sign) / count if (count := sum(direction in (0, sign) for direction in asked)) else None
        for sign in (1, -1)
    )
    if rises is not None and falls is not None:
        return rises - falls == way
    return (rises is None or rises >= max(0, way)) and (falls is None or falls >= max(0, -way))


def located(run: Run, judge: Judge, order: Sequence[int], rtol: float, doubtful: float) -> tuple[float, float]:
    """How far off an uncontrolled motion is from the value of an event at its time, at most, over rtol; and when.

    The row before is integrated to that time by the judge; pieces that are off by more than `doubtful` rtol and
    magnify errors that much themselves are left out, as those between rows are. NaN where nothing could be judged.
    """
    met = _judged(run.events)
    met = [met[k] for k in np.unique(np.linspace(0, len(met) - 1, min(MOST, len(met))).astype(int))]
    if not met:
        return np.nan, np.nan
    t = np.array([e["t"] for e in met])
    rows = np.maximum(np.searchsorted(run.t, t) - 1, 0)
    q, v, dt = run.q_tree[rows][:, order], run.v_tree[rows][:, order], t - run.t[rows]
    end = judge.pieces(q, v, dt, 1e-3 * rtol)
    off = np.zeros(len(met))
    for k, event in enumerate(met):
        numbers = (end.q if event["of"] == "q" else end.v)[k]
        at = judge.model.labels.index(event["coordinate"])
        off[k] = abs(numbers[at] - event["value"]) / max(1.0, np.abs(numbers).max())
    resolved = end.resolved & ~judge.sensitive(q, v, dt, end, off > doubtful * rtol)
    if not resolved.any():
        return np.nan, np.nan
    worst = int(np.argmax(np.where(resolved, off, -1.0)))
    return float(off[worst] / rtol), float(t[worst])


def beside_a_turn(motion: Motion, coordinates: Sequence[str]) -> str:
    """Two values beside the first turning point of a coordinate: one crossed on both sides of it, one never.

    The turn is where a run that stops at the coordinate's rest ends; the same motion is then run with events of both
    values. "" where that is right, or where the coordinate does not turn.
    """
    random = np.random.default_rng([motion.seed, 5])
    overrides = {key: value for key, value in motion.overrides.items() if key != "event"} | {"controller": None}
    overrides["solver.rtol"] = min(TIGHT, overrides["solver.rtol"])
    single = [name for name in coordinates if "." not in name]  # a free root's rates are not those of its coordinates
    if not single:
        return ""
    name = str(random.choice(single))
    rest = {"of": "q_dot", "coordinate": name, "value": 0.0}
    try:
        to_turn = ckc_pin.simulate(motion.scene, {**overrides, "event": [{**rest, "stop": True}]})
        values = _beside(to_turn, name)
        if values is None:
            return ""
        asked = [{"of": "q", "coordinate": name, "value": value} for value in values]
        run = ckc_pin.simulate(motion.scene, {**overrides, "event": [rest, *asked]})
    except CkcError:
        return ""
    return on_both_sides(run, name, float(to_turn.t[-1]), *values)


def _beside(to_turn: Run, name: str) -> tuple[float, float] | None:
    """Values short of a turn and beyond it; None where there is no turn that is far from the start."""
    q = _column(to_turn, "q", name)
    way = float(q[-1] - q[0])
    if not to_turn.events or abs(way) < LEAST_RANGE * max(1.0, abs(q[-1])):
        return None
    return float(q[-1]) - BESIDE * way, float(q[-1]) + BESIDE * way


def on_both_sides(run: Run, name: str, t_turn: float, inner: float, outer: float) -> str:
    """Whether a coordinate's first rest is at a turn, the inner value is crossed to and from it, the outer one not."""
    rests = [e["t"] for e in run.events if e["of"] == "q_dot"]
    until = rests[1] if len(rests) > 1 else float(run.t[-1])
    times = [[e["t"] for e in run.events if e["of"] == "q" and e["value"] == value] for value in (inner, outer)]
    inside, outside = ([t for t in found if t <= until] for found in times)
    back = _column(run, "q", name)[(run.t > t_turn) & (run.t < until)] - inner
    returns = bool((np.sign(inner - outer) * back > CLEAR * max(1.0, abs(inner))).any())
    before, after = sum(t < t_turn for t in inside), sum(t > t_turn for t in inside)
    turns = bool(rests) and abs(rests[0] - t_turn) < SAME
    if not turns or outside or before != 1 or not returns <= after <= 1:
        return f"{name} turns at {t_turn:.9g}: rests {rests[:2]}, inside {inside}, outside {outside}"
    return ""
