"""Comparisons of a run: with another one event by event, and with the suite's own references."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.contact.judges import JOINT_EVENTS, columns_of, start_rates
from scripts.experiments.fuzz.contact.slides import Slides
from scripts.experiments.fuzz.contact.time_stepping import TimeStepping
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import difference

__all__ = ["Agreement", "compare", "compare_with_slides", "compare_with_steps"]

OF_LAST_BOUNCE = 100.0  # times: bounces end where the last one's rise, 1e-10 of a joint's reach, takes 1e-5 s
BESIDE_EVENT = 1e-7  # s: rows nearer to an event may be before or after it
MAGNIFIED = 30.0  # times what a perturbed reference is off
PERTURBATION = 1e-11  # relative, of the reference's start
SEEN = 25  # instants at which the time-stepping scheme is compared
STEPS = (250, 500, 2000)
STEPS_OFF = 5.0  # times the difference of two step sizes: how far the scheme may be off


@dataclass(frozen=True)
class Agreement:
    """How far two runs agree: what differs first, until when they agree, and by how much they are off until then."""

    fault: str
    until: float
    off: float


def _times(run: Run) -> dict[str, list[float]]:
    """When each event of stops and friction happened, by name."""
    times: dict[str, list[float]] = {}
    for event in run.events:
        if event["of"] in JOINT_EVENTS:
            times.setdefault(str(event["name"]), []).append(float(event["t"]))
    return times


def compare(one: Run, other: Run, model: Model, allowed: float, until: float = np.inf) -> Agreement:
    """Compare the events of two runs, each name's in order of time, and their rows, up to a time.

    Events change places only where their times agree within what is allowed.
    """
    mine, theirs = _times(one), _times(other)
    end = min(float(one.t[-1]), float(other.t[-1]), until)
    off, fault, until = 0.0, "", end
    for name in sorted({*mine, *theirs}):
        for a, b in zip_longest(mine.get(name, []), theirs.get(name, []), fillvalue=np.inf):
            first = min(a, b)
            if first >= end - BESIDE_EVENT:
                break
            late = abs(a - b) if max(a, b) < np.inf else np.inf
            factor = OF_LAST_BOUNCE if name.endswith("touches") else 1.0
            if late <= allowed * factor:
                off = max(off, late / factor)
                continue
            if first < until:
                fault, until = f"{name} at {a:.9g} and {b:.9g}", first
            break
    times = np.array([t for found in (*mine.values(), *theirs.values()) for t in found])
    rows_a, rows_b = _common(one.t, other.t)
    keep = one.t[rows_a] < until - BESIDE_EVENT if fault else one.t[rows_a] <= until
    if len(times):
        keep &= np.abs(one.t[rows_a][:, None] - times).min(axis=1) > BESIDE_EVENT
    rows_a, rows_b = rows_a[keep], rows_b[keep]
    if len(rows_a):
        apart = _apart(one, other, rows_a, rows_b, model)
        k = int(np.argmax(apart > allowed)) if (apart > allowed).any() else -1
        off = max(off, float(apart.max()))
        if k >= 0:
            fault, until = f"states {apart[k]:.2g} apart at t = {one.t[rows_a[k]]:.6g}", float(one.t[rows_a[k]])
    return Agreement(fault, until, off)


def _common(a: Array, b: Array) -> tuple[np.ndarray, np.ndarray]:
    k = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    same = np.abs(b[k] - a) < 1e-12
    return np.flatnonzero(same), k[same]


def _apart(one: Run, other: Run, rows_a: np.ndarray, rows_b: np.ndarray, model: Model) -> Array:
    order, order_b = columns_of(one, model), columns_of(other, model)
    q, q_b, v, v_b = one.q_tree[rows_a][:, order], other.q_tree[rows_b][:, order_b], one.v_tree, other.v_tree
    of_q = np.abs(difference(model, q, q_b)).max(axis=1) / max(1.0, float(np.abs(q).max()))
    of_v = np.abs(v[rows_a][:, order] - v_b[rows_b][:, order_b]).max(axis=1) / max(1.0, float(np.abs(v).max()))
    return np.maximum(of_q, of_v)


def compare_with_slides(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare impact times and velocities with the event-driven reference; category and what is off."""
    faults = []
    for rechoose in (False, True):
        fault, certain = _against_slides(run, model, case, rechoose)
        if not fault:
            return ("", "") if certain else ("unjudged", "the reference is not certain from the start")
        faults.append(fault)
    return "reference", faults[0]


def _against_slides(run: Run, model: Model, case: Case, rechoose: bool) -> tuple[str, bool]:
    slides = Slides(model, case.contacts, rechoose=rechoose)
    order = columns_of(run, model)
    q, v, end = run.q_tree[0][order], start_rates(run, case, model), float(run.t[-1])
    exact = slides.run(q, v, end)
    beside = slides.run(q, v * (1 + PERTURBATION), end)
    certain = min(exact.certain_until, beside.certain_until, end)
    rows = np.flatnonzero((run.t > 0) & (run.t < certain))
    own = [float(event["t"]) for event in run.events if event["of"] == "stop" and event["name"].endswith("bounces")]
    hits = [t for t, _ in exact.impacts]
    for at, (a, b) in enumerate(zip(hits, [t for t, _ in beside.impacts], strict=False)):
        if a >= certain:
            break
        allowed = 1e-9 + MAGNIFIED * abs(a - b)
        if a > 0 and _nearest(run, a) > allowed:
            return f"impact {at} at t = {a:.9g} is missing; nearest event {_nearest(run, a):.2g} s off", True
    for t in own:
        if t < certain - BESIDE_EVENT and (not hits or np.abs(np.array(hits) - t).min() > 1e-7):
            return f"a bounce at t = {t:.9g} that the reference has not", True
    times = np.array([*exact.t, *beside.t, *(float(event["t"]) for event in run.events)])
    rows = rows[np.abs(run.t[rows][:, None] - times).min(axis=1, initial=np.inf) > BESIDE_EVENT] if len(times) else rows
    if not len(rows):
        return "", False
    (q_a, v_a), (q_b, v_b) = exact.at(run.t[rows]), beside.at(run.t[rows])
    for name, right, near, ours in (("q", q_a, q_b, run.q_tree), ("rates", v_a, v_b, run.v_tree)):
        scale = max(1.0, float(np.abs(right).max()))
        bound = 1e-9 * scale + MAGNIFIED * np.maximum.accumulate(np.abs(right - near).max(axis=1))
        off = np.abs(ours[rows][:, order] - right).max(axis=1)
        if np.any(off > bound):
            k = int(np.argmax(off > bound))
            return f"{name} off by {off[k]:.2g} at t = {run.t[rows[k]]:.6g}, allowed {bound[k]:.2g}", True
    return "", True


def _nearest(run: Run, t: float) -> float:
    return min((abs(float(event["t"]) - t) for event in run.events if event["of"] == "stop"), default=np.inf)


def compare_with_steps(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare with the time-stepping scheme at two step sizes, whose difference says how far off it is itself.

    Where that is not enough, since an impact is rounded to a step by chance alike in both, at a third one, which has to
    be nearer to the run by half, or no further off than it is from the second.
    """
    scheme = TimeStepping(model, case.contacts)
    order = columns_of(run, model)
    start, rates, end = run.q_tree[0][order], start_rates(run, case, model), float(run.t[-1])
    times = end * np.arange(1, SEEN + 1) / SEEN  # instants of the run too
    right = run.q_tree[[run.at(t) for t in times]][:, order]
    coarse, fine = (scheme.run(start, rates, end, n, SEEN) for n in STEPS[:2])
    own, off = np.abs(coarse - fine).max(axis=1), np.abs(fine - right).max(axis=1)
    allowed = STEPS_OFF * np.maximum.accumulate(own) + 1e-3 * float(np.ptp(right, axis=0).max()) + 1e-9
    if not np.any(off > allowed):
        return "", ""
    k = int(np.argmax(off > allowed))
    finest = scheme.run(start, rates, end, STEPS[2], SEEN)
    left = np.abs(finest - right).max(axis=1)
    own = np.abs(finest - fine).max(axis=1)
    if left[: k + 1].max() < max(0.5 * off[: k + 1].max(), STEPS_OFF * own[: k + 1].max()):
        return "", ""
    return "stepping", f"{left[k]:.2g} off the time-stepping scheme at t = {times[k]:.4g}, {off[k]:.2g} at larger steps"
