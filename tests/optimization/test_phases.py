"""Motions through places: closed forms of a mass on a rail, times at rest, replays, files, and messages."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import ckc_pin
from ckc_pin import InputError, Plan, optimize
from ckc_pin.optimization.mesh_motion import DEGREE, Guess, Mesh, Places
from ckc_pin.optimization.route import Route
from tests.contract.helpers.command import ckc
from tests.optimization.small_models import GRAVITY, LENGTH, MASS, pendulum, require_replay, slider, table

FORCE, ACCELERATION = 3.0, 3.0 / MASS


def fastest(distance: float, before: float, after: float) -> float:
    """Return the time of a mass between two rates that are not larger than the highest one, with one switch."""
    highest = np.sqrt(ACCELERATION * distance + (before**2 + after**2) / 2)
    return float((2 * highest - before - after) / ACCELERATION)


def test_torques_begin_again_exactly_when_a_rest_ends() -> None:
    """However sums of times round, rows of the table do not go back in time."""
    random, phases = np.random.default_rng(0), 4
    still = np.zeros((phases + 1, 1))
    places = Places(still, still, np.zeros(phases + 1))
    for _ in range(100):
        durations, rests = random.uniform(0.01, 0.1, (2, phases))
        mesh = Mesh.uniform(8, durations)
        knots, count = len(mesh.knot), len(mesh.steps)
        sizes = [(count + 1, 1), (count + 1, 1), (count, DEGREE, 1), (knots, 1), (count * DEGREE, 1)]
        values = Guess(mesh, durations, *map(np.zeros, sizes))
        route = Route(places, rests, np.ones((phases, 1)), np.inf, ())
        t, torque = route.torques(values, values.torque)
        assert np.diff(t).min() >= 0
        assert t[-1] == pytest.approx(durations.sum() + rests.sum())
        assert np.trapezoid(torque[:, 0], t) == pytest.approx(rests.sum())


def test_a_place_beyond_the_end_is_reached_and_left_in_bang_bang_motions() -> None:
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, via=[{"q": {"rail": 0.9}, "rest": True}],
                    limits={"torque": FORCE}, intervals=100)  # fmt: skip
    assert plan.t_end == pytest.approx(fastest(0.9, 0, 0) + fastest(0.2, 0, 0), rel=5e-4)
    assert plan.via_t[0] == pytest.approx(fastest(0.9, 0, 0), rel=5e-4)
    require_replay(plan, FORCE)


def test_a_place_is_passed_at_a_given_rate() -> None:
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, via=[{"q": {"rail": 0.3}, "q_dot": {"rail": 0.2}}],
                    limits={"torque": FORCE}, intervals=200)  # fmt: skip
    assert plan.t_end == pytest.approx(fastest(0.3, 0, 0.2) + fastest(0.4, 0.2, 0), rel=1e-3)
    require_replay(plan, FORCE)


def test_a_place_on_the_way_does_not_slow_the_motion() -> None:
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, via=[{"q": {"rail": 0.2}}], limits={"torque": FORCE},
                    intervals=100)  # fmt: skip
    assert plan.t_end == pytest.approx(fastest(0.7, 0, 0), rel=5e-4)


def test_least_effort_through_places_at_given_times_is_a_clamped_spline() -> None:
    t, x = np.array([0.0, 0.4, 0.9, 1.5]), np.array([0.0, 0.5, 0.3, 0.7])
    via = [{"q": {"rail": place}, "time": time} for place, time in zip(x[1:-1], t[1:-1], strict=True)]
    plan = optimize(slider(), to={"q": {"rail": x[-1]}}, via=via, minimize={"effort": 1.0}, limits={"time": t[-1]})
    spline = CubicSpline(t, x, bc_type="clamped")
    ends = MASS * spline(np.array([t[:-1], t[1:]]), 2)  # of the pieces, in which it is linear
    expected = np.sum(np.diff(t) / 3 * (ends[0] ** 2 + ends[0] * ends[1] + ends[1] ** 2))
    assert plan.cost == pytest.approx(expected, rel=1e-7)
    assert plan.via_t == pytest.approx(t[1:-1], abs=1e-8)
    assert np.abs(plan.motion(plan.t)[0][:, 0] - spline(plan.t)).max() < 1e-6


def test_free_times_of_places_are_those_of_least_effort() -> None:
    """The best time of a place between two others follows from the cost of the two cubics, on a fine grid of times."""
    x, end = np.array([0.0, 0.5, 0.7]), 1.5

    def cost(time: float) -> float:
        spline = CubicSpline([0.0, time, end], x, bc_type="clamped")
        a, b, c = MASS * spline([0.0, time, end], 2)
        return float(time / 3 * (a**2 + a * b + b**2) + (end - time) / 3 * (b**2 + b * c + c**2))

    plan = optimize(slider(), to={"q": {"rail": x[-1]}}, via=[{"q": {"rail": x[1]}}], minimize={"effort": 1.0},
                    limits={"time": end})  # fmt: skip
    times = np.linspace(0.3, 1.3, 10_001)
    best = times[int(np.argmin([cost(time) for time in times]))]
    assert plan.cost == pytest.approx(cost(best), rel=1e-7)
    assert plan.via_t[0] == pytest.approx(best, abs=2e-4)


def test_torques_do_not_jump_where_their_rate_is_limited() -> None:
    arguments: dict[str, Any] = {"to": {"q": {"rail": 0.7}}, "via": [{"q": {"rail": 0.3}, "q_dot": {"rail": -0.1}}]}
    jumping = optimize(slider(), limits={"torque": FORCE}, **arguments)
    same = np.flatnonzero(np.diff(jumping.torque_t) == 0)
    assert len(same) == 1
    rate = 40.0
    limited = optimize(slider(), limits={"torque": FORCE, "torque_rate": rate}, **arguments)
    steps, torques = np.diff(limited.torque_t), np.diff(limited.torque[:, 0])
    assert np.abs(torques[steps == 0]).max() < 1e-8
    assert np.abs(torques[steps > 0] / steps[steps > 0]).max() < rate * (1 + 1e-6)
    assert limited.t_end > jumping.t_end
    require_replay(limited, FORCE)


def test_coordinates_that_a_place_does_not_name_are_free() -> None:
    """Gravity's torque is constant: along y the motion is as without the place."""
    arguments: dict[str, Any] = {"to": {"q": {"x": 0.2, "y": 0.6}}, "minimize": {"effort": 1.0}, "limits": {"time": 1}}
    plan = optimize(table(), via=[{"q": {"x": 0.5}, "time": 0.4}], **arguments)
    t = plan.t / plan.t_end
    assert np.abs(plan.columns()["y"] - 0.6 * (3 * t**2 - 2 * t**3)).max() < 1e-6
    spline = CubicSpline([0, 0.4, plan.t_end], [0, 0.5, 0.2], bc_type="clamped")
    assert np.abs(plan.columns()["x"] - spline(plan.t)).max() < 1e-6


def test_time_at_rest_holds_the_mechanism() -> None:
    """The effort at rest is that of gravity's torque. The motions before and after are those without time at rest."""
    angle, dwell, moving = 0.6, 0.25, 1.0
    arguments: dict[str, Any] = {"to": {"q": {"hinge": 1.0}}, "minimize": {"effort": 1.0}}
    through = optimize(pendulum(), via=[{"q": {"hinge": angle}, "rest": True}], limits={"time": moving}, **arguments)
    resting = optimize(pendulum(), via=[{"q": {"hinge": angle}, "dwell": dwell}], limits={"time": moving + dwell},
                       **arguments)  # fmt: skip
    static = MASS * GRAVITY * LENGTH * np.sin(angle)
    assert resting.cost - through.cost == pytest.approx(dwell * static**2, rel=1e-6)
    assert resting.t_end == pytest.approx(through.t_end + dwell, rel=1e-6)
    assert resting.via_t == pytest.approx(through.via_t, rel=1e-6)
    require_replay(resting, np.inf)
    run = resting.simulate()
    still = (run.t > resting.via_t[0] + 1e-6) & (run.t < resting.via_t[0] + dwell - 1e-6)
    assert still.sum() > 20
    assert np.abs(run["hinge"][still] - angle).max() < 1e-6
    assert np.abs(run["v.hinge"][still]).max() < 1e-6


def passes(plan: Plan, point: str, positions: list[list[float]]) -> None:
    """Require that a point is at positions when the places are reached."""
    q = plan.motion(np.array(plan.via_t))[0]
    for one, position in zip(q, positions, strict=True):
        assert np.abs(ckc_pin.Point(plan.mechanism, point).forward(one) - position).max() < 1e-8


def test_a_delta_passes_points_and_is_replayed() -> None:
    points = [[0.0, 0.0, -0.27], [0.1, 0.0, -0.27]]
    plan = optimize("delta", start={"point": {"plate": [0.0, 0.0, -0.29]}},
                    via=[{"point": {"plate": points[0]}}, {"point": {"plate": points[1]}, "dwell": 0.05}],
                    to={"point": {"plate": [0.1, 0.0, -0.29]}}, limits={"torque": 5.0}, intervals=40)  # fmt: skip
    require_replay(plan, 5.0)
    passes(plan, "plate", points)


def test_a_five_bar_keeps_the_limits_of_its_state_in_all_phases() -> None:
    limits = {"torque": 2.0, "rate": {"theta_1": 4.0, "theta_4": 6.0}, "singularity": 0.3, "power": 5.0}
    plan = optimize("five_bar", start={"at": "equilibrium"}, via=[{"q": {"theta_1": -1.2, "theta_3": -1.5}}],
                    to={"q": {"theta_1": -1.0, "theta_3": -1.9}}, limits=limits)  # fmt: skip
    require_replay(plan, 2.0)
    assert np.abs(plan.columns()["v.theta_4"]).max() < 6.0 * (1 + 2e-3)
    assert {x.quantity for x in plan.active} & {"v.theta_1", "v.theta_4", "power.theta_1", "power.theta_3"}


def test_saved_scenes_and_tables_have_jumps_and_times_at_rest(tmp_path: Path) -> None:
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, via=[{"q": {"rail": 0.9}, "dwell": 0.3}],
                    limits={"torque": FORCE})  # fmt: skip
    plan.save(tmp_path)
    assert np.all(np.diff(plan.t) > 0)
    rows = np.genfromtxt(tmp_path / "plan.csv", delimiter=",", names=True, deletechars="")
    assert np.abs(np.interp(plan.via_t[0] + 0.15, rows["t"], rows["tau.rail"])) < 1e-12
    run = ckc_pin.simulate(tmp_path / "open.scene.toml")
    assert run["rail"][-1] == pytest.approx(0.7, abs=1e-6)
    closed = ckc_pin.simulate(tmp_path / "closed.scene.toml")
    assert closed["rail"][-1] == pytest.approx(0.7, abs=1e-3)
    assert plan.to_dict()["via_t"] == list(plan.via_t)


def test_a_mass_is_carried_from_one_place_to_another(tmp_path: Path) -> None:
    """Each phase is bang-bang with its own acceleration. Files of both sections are run one after the other."""
    distance, load, rest = 0.7, 2.5, 0.2
    via = [{"q": {"rail": distance}, "dwell": rest, "parameters": {"link.cart.mass": MASS + load}}]
    plan = optimize(slider(), to={"q": {"rail": 0.0}}, via=via, limits={"torque": FORCE}, intervals=100)
    expected = rest + 2 * np.sqrt(distance * MASS / FORCE) + 2 * np.sqrt(distance * (MASS + load) / FORCE)
    assert plan.t_end == pytest.approx(expected, rel=5e-4)
    require_replay(plan, FORCE)
    with pytest.raises(InputError, match=r"take plan\.part\(k\)\.scene\(\) of each section"):
        plan.scene()
    with pytest.raises(InputError, match="expected a number below 2"):
        plan.part(2)
    files = plan.save(tmp_path)
    assert plan.to_dict(files)["files"][:2] == ["part_1/open.scene.toml", "part_1/closed.scene.toml"]
    for number, place in ((1, distance), (2, 0.0)):
        run = ckc_pin.simulate(tmp_path / f"part_{number}" / "open.scene.toml")
        assert run["rail"][-1] == pytest.approx(place, abs=1e-6)
        assert run.t[-1] == pytest.approx(plan.part(number - 1).t_end)
        closed = ckc_pin.simulate(tmp_path / f"part_{number}" / "closed.scene.toml")
        assert closed["rail"][-1] == pytest.approx(place, abs=2e-3)


def test_parameters_of_a_place_hold_until_the_next_ones() -> None:
    """The torques at rest are those of the mass before the place."""
    angle, masses = 0.6, (3.0, 1.0)
    via = [{"q": {"hinge": angle}, "dwell": 0.1, "parameters": {"link.rod.mass": masses[0]}},
           {"q": {"hinge": -angle}, "dwell": 0.1},
           {"q": {"hinge": angle}, "dwell": 0.1, "parameters": {"link.rod.mass": masses[1]}}]  # fmt: skip
    plan = optimize(pendulum(torque_limit=20.0), via=via, to={"q": {"hinge": 0.0}})
    at_rest = np.interp(np.array(plan.via_t) + 0.05, plan.torque_t, plan.torque[:, 0])
    signs, before = np.array([1, -1, 1]), np.array([MASS, masses[0], masses[0]])
    assert at_rest == pytest.approx(signs * before * GRAVITY * LENGTH * np.sin(angle), rel=1e-9)
    assert [(x.begin, x.end) for x in plan.sections[1:2]] == [
        (pytest.approx(plan.via_t[0] + 0.1), pytest.approx(plan.via_t[2] + 0.1))
    ]
    require_replay(plan, 20.0)


def test_a_file_lists_places_and_parameters(tmp_path: Path) -> None:
    file = tmp_path / "carry.optimize.toml"
    file.write_text("""
        mechanism = "five_bar"
        to = {q = {theta_1 = -1.434, theta_3 = -1.707}}
        limits = {torque = 3.0}
        [[via]]
        q = {theta_1 = -1.0, theta_3 = -1.9}
        rest = true
        [via.parameters]
        link.link_2.mass = 0.5
    """)
    answer = ckc("optimize", str(file))
    assert answer.code == 0
    assert "open.scene.toml and closed.scene.toml in part_1 to part_2" in answer.out
    assert ckc("optimize", str(file), "--out", str(tmp_path / "plan")).code == 0
    scene = tmp_path / "plan" / "part_2" / "open.scene.toml"
    assert tomllib.loads(scene.read_text())["parameters"] == {"link.link_2.mass": 0.5}
    assert ckc("run", str(scene)).code == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"via": [{"q": {"rail": 0.2}}, {"q": {"rail": 0.2}, "dwell": 0.1}]}, "via[1]: the same place as via[0]"),
        ({"via": [{"q": {"rail": 0.2}, "dwell": 0.1}], "limits": {"torque": 3.0, "torque_rate": 9.0}},
         "via[0]: dwell: torques jump there, which limits.torque_rate excludes"),
        ({"via": [{"q": {"rail": 0.2}, "parameters": {"link.cart.mass": 3.0}}]},
         "via[0]: parameters change at rest only"),
        ({"via": [{"q": {"rail": 0.2}, "rest": True, "parameters": {"gravity": [0, 0, -1]}}]},
         "via[0]: parameters: gravity is not the mass, com or inertia of a link"),
        ({"via": [{"q": {"rail": 0.2}, "rest": True, "parameters": {"link.cat.mass": 3.0}}]},
         "via[0]: slider: parameters: "),
        ({"via": [{"q": {"rail": 0.2}, "rest": True, "parameters": {"link.cart.mass": -1.0}}]},
         "via[0]: slider: parameters: link 'cart': negative mass -1 kg"),
        ({"via": [{}]}, "via[0]: expected either q or point, got neither"),
        ({"via": [{"q": {"rail": 0.2}, "point": {"a": [0, 0, 0]}}]}, "via[0]: expected either q or point, got both"),
        ({"via": [{"q": {"slide": 0.2}}]}, "via[0].q: "),
        ({"via": [{"q": {"rail": 0.2}}, {"q": {"rail": 0.2}, "q_dot": {"rail": 1.0}, "rest": True}]},
         "via[1]: q_dot: the motion is at rest there"),
        ({"via": [{"q": {"rail": 20.0}}]}, "via[0]: rail = 20 is outside its limits"),
        ({"via": [{"q": {"rail": 0.2}, "time": 0.5}, {"q": {"rail": 0.3}, "time": 0.4}]},
         "the times of places do not increase"),
        ({"via": [{"q": {"rail": 0.2}, "dwell": 2.0}], "limits": {"torque": 3.0, "time": 1.0}},
         "leave no time for the motion"),
        ({"via": [{"q": {"rail": 0.2}}], "to": None, "path": {"q": {"rail": [0.0, 0.7]}}},
         "via: a motion along a path passes the places of the path"),
        ({"via": [{"q": {"rail": 0.2}, "dwell": 0.1}], "minimize": {"time": 1.0, "peak_torque": 1.0}},
         "via[0]: dwell: not supported with minimize.peak_torque"),
        ({"via": {"q": {"rail": 0.2}}}, "via: expected a list of tables"),
    ],
)  # fmt: skip
def test_wrong_places_are_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"to": {"q": {"rail": 0.7}}, "limits": {"torque": 3.0}, **change}
    with pytest.raises(InputError) as error:
        optimize(slider(), **arguments)
    assert message in str(error.value)


def test_a_place_at_which_torques_do_not_hold_the_mechanism_is_refused() -> None:
    with pytest.raises(InputError, match=r"via\[0\]: dwell: torques within their limits do not hold"):
        optimize(pendulum(torque_limit=4.0), via=[{"q": {"hinge": 1.2}, "dwell": 0.1}], to={"q": {"hinge": 0.5}})
