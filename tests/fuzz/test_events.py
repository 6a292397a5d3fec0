"""Fuzz suite: the checks of events pass correct runs and reject runs with wrong events."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest

import ckc_pin
from ckc_pin import Run
from scripts.experiments.fuzz.events import (
    check_crossings,
    check_crossings_at_turn,
    check_turning_point,
    measure_event_error,
)
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.read import read_model
from scripts.experiments.fuzz.record import ALLOWED_FACTOR, SUSPECT_FACTOR
from scripts.experiments.fuzz.reference import ReferenceIntegrator

RTOL = 1e-7
OVERRIDES: dict[str, Any] = {
    "formulation": "reduced",
    "t_end": 0.6,
    "solver.rtol": RTOL,
    "solver.output_dt": 0.004,
    "initial": {"q": {"theta_1": -1.0, "theta_3": 1.5}, "q_dot": {"theta_1": 1.0, "theta_3": 3.0}},
    "controller": None,
}
EVENTS = [{"of": "q", "coordinate": "theta_2", "value": 1.0}, {"of": "q_dot", "coordinate": "theta_1", "value": 0.0}]


@cache
def run_with_events() -> Run:
    """Return a motion with crossings of an angle and of a rate in both directions."""
    run = ckc_pin.simulate("five_bar/swing", {**OVERRIDES, "event": EVENTS})
    assert {(e["of"], e["direction"]) for e in run.events} == {("q", -1), ("q", 1), ("q_dot", -1), ("q_dot", 1)}
    return run


def reference_of(run: Run) -> tuple[ReferenceIntegrator, list[int]]:
    reference = ReferenceIntegrator(read_model(run.texts))
    return reference, [run.coordinates.index(label) for label in reference.model.labels]


def test_missing_and_extra_crossings_are_found_between_rows() -> None:
    run = run_with_events()
    assert check_crossings(run, EVENTS) == ""
    for k, event in enumerate(run.events):
        lost = [*run.events[:k], *run.events[k + 1 :]]
        turned = [*run.events[:k], {**event, "direction": -event["direction"]}, *run.events[k + 1 :]]
        for events in (lost, turned, [*run.events, event]):
            assert event["coordinate"] in check_crossings(replace(run, events=events), EVENTS)


@pytest.mark.parametrize("direction", [-1, 1])
def test_crossings_in_one_direction_are_found_between_rows(direction: int) -> None:
    events_one_way = [{**event, "direction": direction} for event in EVENTS]
    crossings = [event for event in run_with_events().events if event["direction"] == direction]
    assert check_crossings(replace(run_with_events(), events=crossings), events_one_way) == ""
    assert (
        check_crossings(replace(run_with_events(), events=[*crossings, *crossings]), [*events_one_way, *events_one_way])
        == ""
    )
    for k in range(len(crossings)):
        assert check_crossings(replace(run_with_events(), events=crossings[:k] + crossings[k + 1 :]), events_one_way)


def test_event_times_agree_with_the_reference_integrator() -> None:
    run = run_with_events()
    error, _ = measure_event_error(run, *reference_of(run), RTOL, SUSPECT_FACTOR)
    assert error < 10
    late = [{**event, "t": event["t"] + 2e-4 * (k == 2)} for k, event in enumerate(run.events)]
    error, t = measure_event_error(replace(run, events=late), *reference_of(run), RTOL, SUSPECT_FACTOR)
    assert error > ALLOWED_FACTOR
    assert t == late[2]["t"]


def test_values_next_to_a_turning_point_are_crossed_twice_or_never() -> None:
    first = next(event["t"] for event in run_with_events().events if event["of"] == "q_dot")
    stop = [{**EVENTS[1], "stop": True}]
    turn = float(ckc_pin.simulate("five_bar/swing", {**OVERRIDES, "event": stop}).q_tree[-1, 0])
    inner, outer = turn - 1e-8, turn + 1e-8
    events_one_way = [{"of": "q", "coordinate": "theta_1", "value": value} for value in (inner, outer)]
    run = ckc_pin.simulate("five_bar/swing", {**OVERRIDES, "event": [EVENTS[1], *events_one_way]})
    assert check_crossings_at_turn(run, "theta_1", first, inner, outer) == ""
    crossings = [event for event in run.events if event["of"] == "q" and event["t"] < 0.1]
    assert len(crossings) == 2
    for event in crossings:
        missed = [other for other in run.events if other is not event]
        assert check_crossings_at_turn(replace(run, events=missed), "theta_1", first, inner, outer)
    grazed = [*run.events, {**crossings[0], "value": outer}]
    assert check_crossings_at_turn(replace(run, events=grazed), "theta_1", first, inner, outer)
    assert check_crossings_at_turn(replace(run, events=crossings), "theta_1", first, inner, outer)


@pytest.mark.parametrize("formulation", ["reduced", "spf", "dae"])
@pytest.mark.parametrize("seed", range(4))
def test_events_next_to_turning_points_are_correct(formulation: str, seed: int) -> None:
    motion = Motion(seed, "five_bar", "five_bar/swing", {**OVERRIDES, "formulation": formulation})
    assert check_turning_point(motion, run_with_events().coordinates) == ""
