"""Events at mode transitions of joints: values that an impact skips, and rates that become zero and stay zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import Event, Simulator, sensitivities, simulate
from tests.conftest import assert_close
from tests.joints.conftest import FORMULATIONS, Make, slide

G = 9.81
Table = dict[str, Any]  # an event, or overrides of a scene


def rate_event(value: float, direction: int = 0, stop: bool = False, of: str = "q_dot", joint: str = "x") -> Table:
    return {"of": of, "coordinate": joint, "value": value, "direction": direction, "stop": stop}


def slider(scene_of: Make, x: float, rate: float, joint: str, t_end: float, gravity: float = 0.0) -> Path:
    """A block of 1 kg that slides along x, its lower stop at 0."""
    more = f"gravity = [{-gravity!r}, 0, 0]\n"
    start = f"q = {{x = {x!r}}}\nq_dot = {{x = {rate!r}}}\n"
    return scene_of(slide("x", "base", "block", 1.0, 0.0), f'{more}[[joint]]\nname = "x"\n{joint}', start, t_end)


def occurrences(events: list[Table], name: str) -> list[tuple[float, int]]:
    return [(event["t"], event["direction"]) for event in events if event["name"] == name]


def step_through(scene: Path, overrides: Table, t_end: float, events: list[Event]) -> list[Table]:
    simulator = Simulator(scene, overrides, events=events)
    for t in np.linspace(0.0, t_end, 8)[1:]:
        while simulator.state.t < t - 1e-9:
            simulator.step(None, t - simulator.state.t)
    return simulator.events


def events_by_caller(scene: Path, overrides: Table, t_end: float, functions: list[Event]) -> list[list[Table]]:
    """The events that `simulate`, a `Simulator` and `sensitivities` report."""
    return [
        simulate(scene, overrides, events=functions).events,
        step_through(scene, overrides, t_end, functions),
        sensitivities(scene, ["link.block.mass"], overrides, events=functions).run.events,
    ]


# --- impacts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("seed", range(7))
def test_an_event_whose_value_an_impact_skips_occurs_at_the_impact(scene_of: Make, formulation: str, seed: int) -> None:
    """At x / v the rate jumps from -v to e v, once across each value between them, in the first step or a later one."""
    random = np.random.default_rng(seed)
    x, v, e = random.uniform(0.1, 1.0), random.uniform(0.5, 5.0), random.uniform(0.0, 1.0)
    value, beyond = float(random.uniform(-v, e * v)), 1.1 * v
    scene = slider(scene_of, x, -v, f"stops = true\nrestitution = {e!r}\n", 2 * x / v)
    events = [rate_event(value), rate_event(value, -1), rate_event(beyond), rate_event(-beyond)]
    functions = [Event(lambda t, terms: terms.q_dot[0] ** 3 - value**3, name="own")]
    for max_step in (10.0, 0.3 * x / v):
        overrides = {"formulation": formulation, "event": events, "solver.max_step": max_step}
        for events_found in events_by_caller(scene, overrides, 2 * x / v, functions):
            hit = (pytest.approx(x / v, abs=1e-10), 1)
            assert occurrences(events_found, f"v.x = {value:g}") == [hit], "rising, once"
            assert occurrences(events_found, "own") == [hit]
            assert not occurrences(events_found, f"v.x = {beyond:g}")
            assert not occurrences(events_found, f"v.x = {-beyond:g}")


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("x", [0.0, 0.6])
def test_a_run_stopped_by_an_impact_ends_with_the_state_after_it(scene_of: Make, formulation: str, x: float) -> None:
    """Also if the run starts with an impact."""
    scene = slider(scene_of, x, -2.0, "stops = true\nrestitution = 0.5\n", 1.0)
    for event, functions in (
        ([rate_event(0.3, 1, True)], []),
        ([], [Event(lambda t, y: y.q_dot[0] - 0.3, 1, True, "own")]),
    ):
        overrides = {"formulation": formulation, "event": event}
        run = simulate(scene, overrides, events=functions)
        sensitivity = sensitivities(scene, ["initial.q_dot.x", "joint.x.restitution"], overrides, events=functions)
        for one in (run, sensitivity.run):
            assert one.message.startswith("stopped by the event")
            assert one.t[-1] == pytest.approx(x / 2.0, abs=1e-11)
            assert np.all(np.diff(one.t) > 0.0)
            assert one.v_tree[-1] == pytest.approx([1.0])
        simulator = Simulator(scene, overrides, events=functions)
        assert simulator.step(None, 0.9).v_tree == pytest.approx([1.0])
        assert simulator.state.t == pytest.approx(x / 2.0, abs=1e-11)
        assert simulator.step(None, 0.5).t == pytest.approx(x / 2.0 + 0.5), "the event does not occur again"
        if event:
            assert sensitivity.end_time == pytest.approx([x / 4.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_impact_while_another_joint_begins_to_stick(scene_of: Make, formulation: str) -> None:
    """One block hits its stop at 1 s, at the instant at which friction stops another one."""
    urdf = slide("x", "base", "block", 1.0, 0.0) + slide("y", "base", "other", 1.0)
    joints = '[[joint]]\nname = "x"\nstops = true\nrestitution = 0.5\n[[joint]]\nname = "y"\nfriction = 0.5\n'
    start = "q = {x = 1.0, y = 0.0}\nq_dot = {x = -1.0, y = 0.5}\n"
    scene = scene_of(urdf, "gravity = [0, 0, 0]\n" + joints, start, 3.0)
    overrides = {"formulation": formulation, "event": [rate_event(0.2), rate_event(0.0, joint="y")]}
    functions = [Event(lambda t, terms: terms.q_dot[0] + terms.q_dot[1] - 0.2, name="own")]
    for events_found in (
        simulate(scene, overrides, events=functions).events,
        step_through(scene, overrides, 3.0, functions),
    ):
        assert occurrences(events_found, "v.x = 0.2") == [(pytest.approx(1.0, abs=1e-10), 1)]
        assert occurrences(events_found, "v.y = 0") == [(pytest.approx(1.0, abs=1e-10), -1)]
        assert occurrences(events_found, "own") == [(pytest.approx(1.0, abs=1e-10), 1)]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_bouncing_balls_rate_is_zero_at_each_impact_and_apex(scene_of: Make, formulation: str) -> None:
    e, fall = 0.4, np.sqrt(2.0 / G)
    scene = slider(scene_of, 1.0, 0.0, f"stops = true\nrestitution = {e}\n", 1.8, G)
    functions = [Event(lambda t, terms: terms.q_dot[0], name="own")]
    flights = 2 * fall * e ** np.arange(1, 60)
    impacts, apexes = fall + np.r_[0.0, np.cumsum(flights)], fall + np.cumsum(flights) - flights / 2
    overrides = {"formulation": formulation, "event": [rate_event(0.0)], "solver.rtol": 1e-10}
    for events_found in events_by_caller(scene, overrides, 1.8, functions):
        bounces = sum(event["name"] == "x bounces" for event in events_found)
        for name in ("own", "v.x = 0"):
            here = occurrences(events_found, name)
            assert [direction for _, direction in here] == [1, -1] * bounces + [1], (
                "the last one is where contact begins"
            )
            assert [t for t, _ in here[::2]] == pytest.approx(impacts[: bounces + 1], abs=1e-9)
            assert [t for t, _ in here[1::2]] == pytest.approx(apexes[:bounces], abs=1e-9)


def test_a_body_that_transfers_all_momentum_comes_to_rest_once(scene_of: Make) -> None:
    """Equal masses, e = 1: the moving one stops where it hits the other one at 1 s, although nothing holds it there."""
    urdf = slide("a", "base", "one", 1.0) + slide("b", "one", "two", 1.0, 0.0)
    joints = 'gravity = [0, 0, 0]\n[[joint]]\nname = "b"\nstops = true\nrestitution = 1.0\n'
    scene = scene_of(urdf, joints, "q = {a = 0.0, b = 1.0}\nq_dot = {a = 1.0, b = -1.0}\n", 3.0)
    functions = [Event(lambda t, terms: terms.q_dot[0], name="own")]
    for formulation in FORMULATIONS:
        for t_end in (1.5, 2.0, 3.3):
            overrides = {"formulation": formulation, "t_end": t_end, "event": [rate_event(0.0, joint="a")]}
            run = simulate(scene, overrides, events=functions)
            assert (
                occurrences(run.events, "v.a = 0")
                == occurrences(run.events, "own")
                == [(pytest.approx(1.0, abs=1e-10), -1)]
            )


# --- rest ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("t_end", [1.5, 2.0, 3.7])
def test_a_joint_that_stays_at_its_stop_comes_to_rest_once(scene_of: Make, formulation: str, t_end: float) -> None:
    """At 1 s it hits its stop with e = 0 and stays: its rate becomes zero, and its coordinate is at the stop."""
    scene = slider(scene_of, 1.0, -1.0, "stops = true\nrestitution = 0.0\n", t_end)
    events = [rate_event(0.0), rate_event(0.0, of="q"), rate_event(-0.5), {"of": "limit", "coordinate": "x"}]
    functions = [Event(lambda t, y: y.q_dot[0], name="rate"), Event(lambda t, y: y.q[0], name="place")]
    once = {"v.x = 0": 1, "x = 0": -1, "v.x = -0.5": 1, "x at its lower limit": 1, "rate": 1, "place": -1}
    for events_found in events_by_caller(scene, {"formulation": formulation, "event": events}, t_end, functions):
        for name, direction in once.items():
            assert occurrences(events_found, name) == [(pytest.approx(1.0, abs=1e-10), direction)], name
    stopped = simulate(scene, {"formulation": formulation, "event": [rate_event(0.0, stop=True)]})
    assert stopped.t[-1] == pytest.approx(1.0, abs=1e-10)
    assert stopped.v_tree[-1] == pytest.approx([0.0], abs=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("again", [1.0, -1.0])
def test_a_joint_that_sticks_comes_to_rest_once_and_moves_on(scene_of: Make, formulation: str, again: float) -> None:
    """Pushed for 1 s with twice its friction it slides until 2 s. Sliding again in either direction is no event."""
    scene = slider(scene_of, 5.0, 0.0, "friction = 0.5\n", 20.0)
    functions = [Event(lambda t, terms: terms.q_dot[0], name="own")]
    simulator = Simulator(scene, {"formulation": formulation, "event": [rate_event(0.0)]}, events=functions)
    for push, dt in ((1.0, 1.0), (0.0, 1.7), (0.3, 1.3), (again, 1.0), (0.0, 3.0), (0.0, 2.0)):
        simulator.step([push], dt)
    for name in ("own", "v.x = 0"):
        rests = [(pytest.approx(2.0, abs=1e-9), -1), (pytest.approx(6.0, abs=1e-9), -1 if again > 0 else 1)]
        assert occurrences(simulator.events, name) == rests


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-9])
def test_joints_locked_by_sticking_joints_come_to_rest_once(rtol: float) -> None:
    """Friction in two joints of the five-bar stops all four after an impact."""
    names = [f"theta_{k}" for k in (1, 2, 3, 4)]
    functions = [Event(lambda t, terms, k=k: terms.v_tree[k], name=name) for k, name in enumerate(names)]  # type: ignore[misc]
    overrides = {
        "controller": None,
        "t_end": 1.0,
        "solver.rtol": rtol,
        "event": [rate_event(0.0, joint=name) for name in names],
        **{f"joint.{name}.friction": 4.0 for name in ("theta_1", "theta_3")},
    }
    counts = {"theta_1": [1, -1], "theta_2": [-1, 1], "theta_3": [1], "theta_4": [1, -1]}
    for formulation in FORMULATIONS:
        run = simulate("five_bar/friction", {**overrides, "formulation": formulation}, events=functions)
        assert np.abs(run.v_tree[-1]).max() < 1e-12
        impact = next(event["t"] for event in run.events if event["name"] == "theta_1 bounces")
        rest = next(event["t"] for event in run.events if event["name"] == "theta_1 sticks")
        for name, directions in counts.items():
            for called in (name, f"v.{name} = 0"):
                here = occurrences(run.events, called)
                assert [direction for _, direction in here] == directions, called
                if name != "theta_3":
                    assert [t for t, _ in here] == pytest.approx([impact, rest], abs=1e-2 * rtol + 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_events_do_not_change_a_motion_with_sticking_and_impacts(formulation: str) -> None:
    """Event functions report the same occurrences as the scene's events."""
    names = [f"theta_{k}" for k in (1, 2, 3, 4)]
    plain = simulate("five_bar/friction", {"formulation": formulation})
    monitored = simulate(
        "five_bar/friction",
        {"formulation": formulation, "event": [rate_event(0.0, joint=name) for name in names]},
        events=[Event(lambda t, terms, k=k: terms.v_tree[k], name=name) for k, name in enumerate(names)],  # type: ignore[misc]
    )
    assert monitored.stats["rhs"] == plain.stats["rhs"]
    assert_close(monitored.q_tree, plain.q_tree, 1e-9)  # as closely as the loops close
    for name in names:
        functions, of_scene = occurrences(monitored.events, name), occurrences(monitored.events, f"v.{name} = 0")
        assert [direction for _, direction in functions] == [direction for _, direction in of_scene]
        assert [t for t, _ in functions] == pytest.approx([t for t, _ in of_scene], abs=1e-8)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_joint_fixed_by_the_loops_has_no_events(scene_of: Make, formulation: str) -> None:
    """The end of its arm is fixed to the base: it cannot turn, whatever the other joint does."""
    pinned = """<link name="arm"><inertial><mass value="1"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="c" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/></joint>"""
    loop = '[[loop]]\nname = "l"\ntype = "point"\nframe_a = {link = "arm", xyz = [0.3, 0.7, 0.1]}\n'
    loop += 'frame_b = {link = "base", xyz = [0.3, 0.7, 0.1]}\n[[joint]]\nname = "x"\nstops = true\nrestitution = 0.5\n'
    urdf = slide("x", "base", "ball", 1.0, 0.0) + pinned
    scene = scene_of(urdf, 'gravity = [-9, 1, 2]\nindependent = ["x"]\n' + loop, "q = {x = 1.0}\n", 2.0)
    events = [rate_event(0.0, joint="c"), rate_event(0.0, of="q", joint="c")]
    run = simulate(scene, {"formulation": formulation, "event": events})
    assert {event["coordinate"] for event in run.events} == {"x"}
