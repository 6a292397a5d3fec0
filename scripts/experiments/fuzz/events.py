"""Checks of a run's events: against its output rows, with the reference integrator, and next to turning points."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.reference import ReferenceIntegrator
from scripts.experiments.fuzz.spatial import Array

__all__ = ["check_crossings", "check_crossings_at_turn", "check_turning_point", "measure_event_error"]

VALUE_TOLERANCE = 1e-9  # relative; a row closer to an event's value may be on either side of it
MAX_EVENTS = 6  # number of events of a run whose time is checked
TURNING_POINT_RTOL = 1e-6  # largest rtol at which rates locate a turning point accurately enough
VALUE_OFFSET = 1e-6  # distance of a value from a turning point, relative to the coordinate's range
TIME_TOLERANCE_S = 1e-9
MIN_RANGE = 1e-3  # relative; turning points of coordinates that move less are not checked
ROTATION_VECTOR_SUFFIXES = (".rx", ".ry", ".rz")  # a rotation vector may jump by a full turn

Key = tuple[str, str, float]


def _column(run: Run, of: str, coordinate: str) -> Array:
    return (run.q_tree if of == "q" else run.v_tree)[:, run.column(coordinate)]


def _checkable_events(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return events of coordinates and rates, without components of rotation vectors."""
    return [
        event for event in events
        if event["of"] == "q_dot"
        or (event["of"] == "q" and not event["coordinate"].endswith(ROTATION_VECTOR_SUFFIXES))
    ]  # fmt: skip


def check_crossings(run: Run, requested: Sequence[dict[str, Any]]) -> str:
    """Check that the crossings between two output rows explain on which side of the value each row is.

    Returns the fault as text, or "".
    """
    by_key: dict[Key, list[int]] = {}
    for event in _checkable_events(requested):
        by_key.setdefault((event["of"], event["coordinate"], event["value"]), []).append(event.get("direction", 0))
    for (of, coordinate, value), directions in by_key.items():
        events = [e for e in run.events if (e["of"], e["coordinate"], e["value"]) == (of, coordinate, value)]
        gap = _column(run, of, coordinate) - value
        clear = np.flatnonzero(np.abs(gap) > VALUE_TOLERANCE * max(1.0, np.abs(gap).max(), abs(value)))
        for i, j in pairwise(clear):
            directions_between = [e["direction"] for e in events if run.t[i] < e["t"] <= run.t[j]]
            if not _is_consistent(directions_between, directions, int(np.sign(gap[j]) - np.sign(gap[i])) // 2):
                return f"{len(directions_between)} events of {coordinate} between t = {run.t[i]:.6g} and {run.t[j]:.6g}"
    return ""


def _is_consistent(crossings: Sequence[int], requested: Sequence[int], net: int) -> bool:
    """Return whether the directions of crossings are consistent with a net crossing of 1, -1 or 0.

    If only one direction was requested, the number of its crossings has a lower bound only.
    """
    rises, falls = (
        crossings.count(sign) / count if (count := sum(direction in (0, sign) for direction in requested)) else None
        for sign in (1, -1)
    )
    if rises is not None and falls is not None:
        return rises - falls == net
    return (rises is None or rises >= max(0, net)) and (falls is None or falls >= max(0, -net))


def measure_event_error(
    run: Run, reference: ReferenceIntegrator, order: Sequence[int], rtol: float, suspect_factor: float
) -> tuple[float, float]:
    """Return the largest error over rtol of an event's value at its time, and that time, for a motion without control.

    The reference integrates from the output row before the event. Ill-conditioned segments with an error above
    `suspect_factor` rtol are excluded. Both results are NaN if no event could be checked.
    """
    events = _checkable_events(run.events)
    events = [events[k] for k in np.unique(np.linspace(0, len(events) - 1, min(MAX_EVENTS, len(events))).astype(int))]
    if not events:
        return np.nan, np.nan
    t = np.array([e["t"] for e in events])
    rows = np.maximum(np.searchsorted(run.t, t) - 1, 0)
    q, v, dt = run.q_tree[rows][:, order], run.v_tree[rows][:, order], t - run.t[rows]
    end = reference.integrate_segments(q, v, dt, 1e-3 * rtol)
    error = np.zeros(len(events))
    for k, event in enumerate(events):
        numbers = (end.q if event["of"] == "q" else end.v)[k]
        at = reference.model.labels.index(event["coordinate"])
        error[k] = abs(numbers[at] - event["value"]) / max(1.0, np.abs(numbers).max())
    resolved = end.resolved & ~reference.find_ill_conditioned(q, v, dt, end, error > suspect_factor * rtol)
    if not resolved.any():
        return np.nan, np.nan
    worst = int(np.argmax(np.where(resolved, error, -1.0)))
    return float(error[worst] / rtol), float(t[worst])


def check_turning_point(motion: Motion, coordinates: Sequence[str]) -> str:
    """Check crossings of two values next to a coordinate's first turning point: one is crossed twice, one never.

    A run that stops at zero rate gives the turning point. The motion is then repeated with events at both values.
    Returns the fault as text, or "" also if the coordinate has no turning point.
    """
    random = np.random.default_rng([motion.seed, 5])
    overrides = {key: value for key, value in motion.overrides.items() if key != "event"} | {"controller": None}
    overrides["solver.rtol"] = min(TURNING_POINT_RTOL, overrides["solver.rtol"])
    single = [name for name in coordinates if "." not in name]  # rates of a free root are not derivatives of its q'
    if not single:
        return ""
    name = str(random.choice(single))
    rest = {"of": "q_dot", "coordinate": name, "value": 0.0}
    try:
        to_turn = ckc_pin.simulate(motion.scene, {**overrides, "event": [{**rest, "stop": True}]})
        values = _choose_values_around_turn(to_turn, name)
        if values is None:
            return ""
        requested = [{"of": "q", "coordinate": name, "value": value} for value in values]
        run = ckc_pin.simulate(motion.scene, {**overrides, "event": [rest, *requested]})
    except CkcError:
        return ""
    return check_crossings_at_turn(run, name, float(to_turn.t[-1]), *values)


def _choose_values_around_turn(to_turn: Run, name: str) -> tuple[float, float] | None:
    """Return values just before and beyond a turning point; None without a turning point far from the start."""
    q = _column(to_turn, "q", name)
    change = float(q[-1] - q[0])
    if not to_turn.events or abs(change) < MIN_RANGE * max(1.0, abs(q[-1])):
        return None
    return float(q[-1]) - VALUE_OFFSET * change, float(q[-1]) + VALUE_OFFSET * change


def check_crossings_at_turn(run: Run, name: str, t_turn: float, inner: float, outer: float) -> str:
    """Check that the rate is first zero at t_turn, and that the inner value is crossed before and after, not the outer.

    Returns the fault as text, or "".
    """
    rests = [e["t"] for e in run.events if e["of"] == "q_dot"]
    until = rests[1] if len(rests) > 1 else float(run.t[-1])
    times = [[e["t"] for e in run.events if e["of"] == "q" and e["value"] == value] for value in (inner, outer)]
    inside, outside = ([t for t in crossing_times if t <= until] for crossing_times in times)
    beyond_inner = _column(run, "q", name)[(run.t > t_turn) & (run.t < until)] - inner
    returns = bool((np.sign(inner - outer) * beyond_inner > VALUE_TOLERANCE * max(1.0, abs(inner))).any())
    before, after = sum(t < t_turn for t in inside), sum(t > t_turn for t in inside)
    turns = bool(rests) and abs(rests[0] - t_turn) < TIME_TOLERANCE_S
    if not turns or outside or before != 1 or not returns <= after <= 1:
        return f"{name} turns at {t_turn:.9g}: rests {rests[:2]}, inside {inside}, outside {outside}"
    return ""
