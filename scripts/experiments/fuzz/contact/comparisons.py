"""Compare a run with another run event by event, and with independent references."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.contact.checks import JOINT_EVENTS, column_order, compute_start_rates, list_impacts
from scripts.experiments.fuzz.contact.slides import Slides
from scripts.experiments.fuzz.contact.time_stepping import TimeStepping
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import subtract_coordinates

__all__ = ["Agreement", "compare", "compare_with_event_driven", "compare_with_time_stepping"]

LAST_BOUNCE_FACTOR = 100.0  # a sequence of bounces ends at a rise of 1e-10 of a joint's range, which takes 1e-5 s
EVENT_MARGIN_S = 1e-7  # rows closer to an event may be before or after it
MAX_MAGNIFICATION = 30.0  # allowed error over the error of a perturbed reference
PERTURBATION = 1e-11  # relative, of the reference's initial rates
INSTANTS = 25  # for the comparison with the time-stepping scheme
STEPS = (250, 500, 2000)
STEP_DIFFERENCE_FACTOR = 5.0  # allowed error of the scheme over the difference of two step sizes


@dataclass(frozen=True)
class Agreement:
    """Comparison of two runs: their first difference, its time, and the largest error before it."""

    fault: str
    until: float
    error: float


def _event_times(run: Run) -> dict[str, list[float]]:
    """Return times of stop and friction events by name."""
    times: dict[str, list[float]] = {}
    for event in run.events:
        if event["of"] in JOINT_EVENTS:
            times.setdefault(str(event["name"]), []).append(float(event["t"]))
    return times


def compare(one: Run, other: Run, model: Model, allowed: float, until: float = np.inf) -> Agreement:
    """Compare the events of two runs by name in the order of time, and their rows, until a time.

    Events of different names may change their order if their times agree to `allowed`.
    """
    times_a, times_b = _event_times(one), _event_times(other)
    end = min(float(one.t[-1]), float(other.t[-1]), until)
    error, fault, until = 0.0, "", end
    for name in sorted({*times_a, *times_b}):
        for a, b in zip_longest(times_a.get(name, []), times_b.get(name, []), fillvalue=np.inf):
            first = min(a, b)
            if first >= end - EVENT_MARGIN_S:
                break
            delay = abs(a - b) if max(a, b) < np.inf else np.inf
            factor = LAST_BOUNCE_FACTOR if name.endswith("touches") else 1.0
            if delay <= allowed * factor:
                error = max(error, delay / factor)
                continue
            if first < until:
                fault, until = f"{name} at {a:.9g} and {b:.9g}", first
            break
    times = np.array([t for of_name in (*times_a.values(), *times_b.values()) for t in of_name])
    rows_a, rows_b = _common_rows(one.t, other.t)
    comparable = one.t[rows_a] < until - EVENT_MARGIN_S if fault else one.t[rows_a] <= until
    if len(times):
        comparable &= np.abs(one.t[rows_a][:, None] - times).min(axis=1) > EVENT_MARGIN_S
    rows_a, rows_b = rows_a[comparable], rows_b[comparable]
    if len(rows_a):
        distance = _distances(one, other, rows_a, rows_b, model)
        k = int(np.argmax(distance > allowed)) if (distance > allowed).any() else -1
        error = max(error, float(distance.max()))
        if k >= 0:
            fault, until = f"states {distance[k]:.2g} apart at t = {one.t[rows_a[k]]:.6g}", float(one.t[rows_a[k]])
    return Agreement(fault, until, error)


def _common_rows(a: Array, b: Array) -> tuple[np.ndarray, np.ndarray]:
    k = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    matches = np.abs(b[k] - a) < 1e-12
    return np.flatnonzero(matches), k[matches]


def _distances(one: Run, other: Run, rows_a: np.ndarray, rows_b: np.ndarray, model: Model) -> Array:
    order, order_b = column_order(one, model), column_order(other, model)
    q, q_b, v, v_b = one.q_tree[rows_a][:, order], other.q_tree[rows_b][:, order_b], one.v_tree, other.v_tree
    of_q = np.abs(subtract_coordinates(model, q, q_b)).max(axis=1) / max(1.0, float(np.abs(q).max()))
    of_v = np.abs(v[rows_a][:, order] - v_b[rows_b][:, order_b]).max(axis=1) / max(1.0, float(np.abs(v).max()))
    return np.maximum(of_q, of_v)


def compare_with_event_driven(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare impact times and velocities with the event-driven reference; return category and text of the fault."""
    faults = []
    for rechoose in (False, True):
        fault, is_compared = _compare_with_slides(run, model, case, rechoose)
        if not fault:
            return ("", "") if is_compared else ("unsupported", "the reference is uncertain from the start")
        faults.append(fault)
    return "reference", faults[0]


def _compare_with_slides(run: Run, model: Model, case: Case, rechoose: bool) -> tuple[str, bool]:
    slides = Slides(model, case.contacts, rechoose=rechoose)
    order = column_order(run, model)
    q, v, end = run.q_tree[0][order], compute_start_rates(run, case, model), float(run.t[-1])
    exact = slides.run(q, v, end)
    perturbed = slides.run(q, v * (1 + PERTURBATION), end)
    certain_until = min(exact.certain_until, perturbed.certain_until, end)
    rows = np.flatnonzero((run.t > 0) & (run.t < certain_until))
    bounces = [float(event["t"]) for event in list_impacts(run)]
    impact_times = [t for t, _ in exact.impacts]
    for k, (a, b) in enumerate(zip(impact_times, [t for t, _ in perturbed.impacts], strict=False)):
        if a >= certain_until:
            break
        allowed = 1e-9 + MAX_MAGNIFICATION * abs(a - b)
        if a > 0 and _distance_to_stop_event(run, a) > allowed:
            distance = _distance_to_stop_event(run, a)
            return f"impact {k} at t = {a:.9g} is missing; the nearest event is {distance:.2g} s off", True
    for t in bounces:
        if t < certain_until - EVENT_MARGIN_S and (not impact_times or np.abs(np.array(impact_times) - t).min() > 1e-7):
            return f"a bounce at t = {t:.9g} that is not in the reference", True
    times = np.array([*exact.t, *perturbed.t, *(float(event["t"]) for event in run.events)])
    if len(times):
        rows = rows[np.abs(run.t[rows][:, None] - times).min(axis=1, initial=np.inf) > EVENT_MARGIN_S]
    if not len(rows):
        return "", False
    (q_a, v_a), (q_b, v_b) = exact.at(run.t[rows]), perturbed.at(run.t[rows])
    for name, exact_values, perturbed_values, values in (("q", q_a, q_b, run.q_tree), ("rates", v_a, v_b, run.v_tree)):
        scale = max(1.0, float(np.abs(exact_values).max()))
        bound = 1e-9 * scale + MAX_MAGNIFICATION * np.maximum.accumulate(
            np.abs(exact_values - perturbed_values).max(axis=1)
        )
        error = np.abs(values[rows][:, order] - exact_values).max(axis=1)
        if np.any(error > bound):
            k = int(np.argmax(error > bound))
            return f"{name} off by {error[k]:.2g} at t = {run.t[rows[k]]:.6g}, allowed {bound[k]:.2g}", True
    return "", True


def _distance_to_stop_event(run: Run, t: float) -> float:
    return min((abs(float(event["t"]) - t) for event in run.events if event["of"] == "stop"), default=np.inf)


def compare_with_time_stepping(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare with the time-stepping scheme at two step sizes, whose difference estimates the scheme's error.

    The estimate fails if both step sizes round an impact's time alike. A third step size is then compared: its error
    has to be half the second one's, or at most a multiple of the difference from the second.
    """
    scheme = TimeStepping(model, case.contacts)
    order = column_order(run, model)
    start, rates, end = run.q_tree[0][order], compute_start_rates(run, case, model), float(run.t[-1])
    times = end * np.arange(1, INSTANTS + 1) / INSTANTS  # these are also output instants of the run
    exact_values = run.q_tree[[run.at(t) for t in times]][:, order]
    coarse, fine = (scheme.run(start, rates, end, n, INSTANTS) for n in STEPS[:2])
    spread, error = np.abs(coarse - fine).max(axis=1), np.abs(fine - exact_values).max(axis=1)
    allowed = (
        STEP_DIFFERENCE_FACTOR * np.maximum.accumulate(spread) + 1e-3 * float(np.ptp(exact_values, axis=0).max()) + 1e-9
    )
    if not np.any(error > allowed):
        return "", ""
    k = int(np.argmax(error > allowed))
    finest = scheme.run(start, rates, end, STEPS[2], INSTANTS)
    finest_error = np.abs(finest - exact_values).max(axis=1)
    spread = np.abs(finest - fine).max(axis=1)
    if finest_error[: k + 1].max() < max(0.5 * error[: k + 1].max(), STEP_DIFFERENCE_FACTOR * spread[: k + 1].max()):
        return "", ""
    fault = f"{finest_error[k]:.2g} off the time-stepping scheme at t = {times[k]:.4g}, {error[k]:.2g} at larger steps"
    return "stepping", fault
