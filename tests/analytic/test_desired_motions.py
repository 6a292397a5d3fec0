"""Desired motions with a constant rate, waypoints and tables: closed forms, SciPy's splines, and tracked runs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, make_interp_spline

import ckc_pin
from ckc_pin import InputError, Run, Tracking, load, simulate
from ckc_pin.base.sources import Sources
from ckc_pin.control.desired import Desired, Harmonics, Table
from ckc_pin.control.point_path import PointPath, make_desired
from ckc_pin.control.workspace import follow_desired
from ckc_pin.ensembles.members import Members
from ckc_pin.ensembles.spec import OutputSpec
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import assert_close

Function = Callable[[float], tuple[Array, Array, Array]]

T, X = np.array([0.3, 0.9, 1.4, 2.6]), np.array([-1.4, -1.1, -1.6, -1.2])
LIMITS = {"max_rate": 1.6, "max_acceleration": 9.0}
INSTANTS = np.linspace(0.0, 3.5, 701)
REST = {"offset": -1.7}
FORMULATIONS = ("reduced", "spf", "dae")


def waypoints(profile: str, **others: Any) -> dict[str, Any]:
    return {"waypoints": [[float(t), float(x)] for t, x in zip(T, X, strict=True)], "profile": profile, **others}


def desired(theta_1: dict[str, Any], theta_3: dict[str, Any] = REST, t_end: float = 3.5) -> Desired:
    sources = Sources("it.scene.toml", None)
    return make_desired({"theta_1": theta_1, "theta_3": theta_3}, load("five_bar"), sources, t_end)


def value_with_hold(t: float, inside: Callable[[float], tuple[float, float, float]]) -> tuple[float, float, float]:
    if not T[0] <= t < T[-1]:
        return (float(X[0 if t < T[0] else -1]), 0.0, 0.0)
    return inside(t)


def trapezoid(begin: float, end: float, start: float, goal: float, acceleration: float) -> Callable[[float], Array]:
    """A trapezoid of the rate by hand: its area is the way, and its slopes are the acceleration."""
    duration, way = end - begin, abs(goal - start)
    rate = (acceleration * duration - np.sqrt((acceleration * duration) ** 2 - 4 * acceleration * way)) / 2
    ramp, sign = rate / acceleration, np.sign(goal - start)

    def motion(t: float) -> Array:
        s, remaining = t - begin, end - t
        if s < ramp:
            return np.array([start + sign * acceleration * s**2 / 2, sign * acceleration * s, sign * acceleration])
        if remaining <= ramp:
            return np.array(
                [goal - sign * acceleration * remaining**2 / 2, sign * acceleration * remaining, -sign * acceleration]
            )
        return np.array([start + sign * rate * (s - ramp / 2), sign * rate, 0.0])

    return motion


def through(profile: str) -> Callable[[float], tuple[float, float, float]]:
    """The motion between the waypoints, by SciPy or by hand."""
    if profile == "linear":
        slopes = np.diff(X) / np.diff(T)
        return lambda t: (float(np.interp(t, T, X)), float(slopes[np.searchsorted(T, t, "right") - 1]), 0.0)
    if profile == "trapezoidal":
        pieces = [trapezoid(*T[k : k + 2], *X[k : k + 2], LIMITS["max_acceleration"]) for k in range(len(T) - 1)]
        return lambda t: tuple(pieces[np.searchsorted(T, t, "right") - 1](t).tolist())  # type: ignore[return-value]
    rest = [(1, 0.0), (2, 0.0)]
    spline: Any = (
        CubicSpline(T, X, bc_type="clamped")
        if profile == "cubic"
        else make_interp_spline(T, X, 5, bc_type=(rest, rest))
    )
    return lambda t: tuple(float(spline(t, k)) for k in range(3))  # type: ignore[return-value]


def as_function(profile: str) -> Function:
    """theta_1 through the waypoints, theta_3 at rest."""
    inside = through(profile)

    def motion(t: float) -> tuple[Array, Array, Array]:
        x, x_dot, x_ddot = value_with_hold(t, inside)
        return np.array([x, REST["offset"]]), np.array([x_dot, 0.0]), np.array([x_ddot, 0.0])

    return motion


def spec(profile: str) -> dict[str, Any]:
    return waypoints(profile, **(LIMITS if profile == "trapezoidal" else {}))


PROFILES = ("quintic", "cubic", "linear", "trapezoidal")
profiles = pytest.mark.parametrize("profile", PROFILES)


# --- values ----------------------------------------------------------------------------------------


@profiles
def test_waypoints_match_scipy_and_a_trapezoid_by_hand(profile: str) -> None:
    ours, theirs = desired(spec(profile)), as_function(profile)
    for t in INSTANTS:
        for one, two, tolerance in zip(ours(float(t)), theirs(float(t)), (1e-14, 1e-13, 1e-12), strict=True):
            assert_close(one, two, tolerance)


def test_two_quintic_waypoints_are_the_motion_of_minimum_jerk() -> None:
    motion = desired({"waypoints": [[1.0, -1.4], [3.0, -1.1]]})
    for t in INSTANTS:
        s = min(max((t - 1.0) / 2.0, 0.0), 1.0)
        assert_close(motion(t)[0][0], -1.4 + 0.3 * (10 * s**3 - 15 * s**4 + 6 * s**5), 1e-14)
        assert_close(motion(t)[1][0], 0.3 * (30 * s**2 - 60 * s**3 + 30 * s**4) / 2.0, 1e-14)
        assert_close(motion(t)[2][0], 0.3 * (60 * s - 180 * s**2 + 120 * s**3) / 4.0, 1e-13)


def test_trapezoid_without_time_to_spare_is_a_triangle() -> None:
    motion = desired({"waypoints": [[0.0, 0.0], [2.0, 1.0]], "profile": "trapezoidal", "max_rate": 1.0,
                      "max_acceleration": 1.0})  # fmt: skip
    for t in INSTANTS:
        s, rest = min(t, 1.0), max(2.0 - max(t, 1.0), 0.0)
        assert_close(motion(t)[0][0], s**2 / 2 if t < 1 else 1.0 - rest**2 / 2, 1e-15)
        assert_close(motion(t)[1][0], s if t < 1 else rest, 1e-15)


def test_offset_rate_waves_and_waypoints_add_up_and_differ_by_coordinate() -> None:
    both = desired(
        {"offset": 0.5, "rate": 2.0, "harmonics": [[0.3, 4.0, 0.2]], **spec("trapezoidal")},
        {"offset": 1.0, "rate": -3.0},
    )
    for t in INSTANTS:
        x, x_dot, x_ddot = value_with_hold(t, through("trapezoidal"))
        angle = 4 * t + 0.2
        expected = [
            0.5 + 2 * t + 0.3 * np.sin(angle) + x,
            2 + 1.2 * np.cos(angle) + x_dot,
            -4.8 * np.sin(angle) + x_ddot,
        ]
        assert_close([part[0] for part in both(t)], expected, 1e-13)
        assert_close([part[1] for part in both(t)], [1.0 - 3.0 * t, -3.0, 0.0], 1e-14)


def test_harmonics_alone_are_what_they_were() -> None:
    assert type(desired({"offset": 1.0, "harmonics": [[0.3, 4.0, 0.2]]})) is Harmonics


@pytest.mark.parametrize("rows", [2, 3, 4, 5, 6, 30])
@pytest.mark.parametrize("interpolation", ["linear", "cubic", "quintic"])
def test_tables_match_numpy_and_scipy(interpolation: str, rows: int) -> None:
    random = np.random.default_rng(rows)
    t, q = np.linspace(0.0, 3.5, rows), random.uniform(-1.5, -1.0, (rows, 2))
    text = "\n".join(
        ["t,theta_3,theta_1", *(f"{a!r},{c!r},{b!r}" for a, (b, c) in zip(t.tolist(), q.tolist(), strict=True))]
    )
    table = {"file": "it.csv", "interpolation": interpolation}
    motion = make_desired(table, load("five_bar"), Sources("it.scene.toml", None, {"it.csv": text}), 3.5)
    for x in INSTANTS[:-1]:
        if interpolation == "linear":
            k = np.searchsorted(t, x, "right") - 1
            slope = (q[k + 1] - q[k]) / (t[k + 1] - t[k])
            expected = [q[k] + (x - t[k]) * slope, slope, 0 * slope]
        elif interpolation == "cubic":
            spline: Any = CubicSpline(t, q)  # not-a-knot; of three rows a parabola, of two a line
            expected = [spline(x, k) for k in range(3)]
        elif rows > 5:
            spline = make_interp_spline(t, q, k=5)
            expected = [spline(x, k) for k in range(3)]
        else:  # one polynomial
            fits = [np.polynomial.Polynomial.fit(t, column, rows - 1) for column in q.T]
            expected = [np.array([fit.deriv(k)(x) for fit in fits]) for k in range(3)]
        for one, two, tolerance in zip(motion(x), expected, (1e-12, 1e-11, 1e-9), strict=True):
            assert_close(one, two, tolerance)


# --- tracked runs ----------------------------------------------------------------------------------


def tracked(motion: Function, breaks: Array, instants: Array, Lambda: float = 2.0, K_D: float = 5.0) -> Array:
    """Angles and rates of the five-bar under eq. 16, at the instants; SciPy restarts at each break.

    The closed loop is stiff: its rates decay within milliseconds.
    """
    model = FIVE_BAR

    def rate(t: float, y: Array) -> Array:
        q_tree = model.sigma(y[:2])
        q_d, q_d_dot, q_d_ddot = motion(min(max(t, begin), np.nextafter(end, begin)))
        error, error_dot = y[:2] - q_d, y[2:] - q_d_dot
        v, a, r = q_d_dot - Lambda * error, q_d_ddot - Lambda * error_dot, error_dot + Lambda * error
        C = model.C(q_tree, model.rho(q_tree) @ y[2:])
        u = model.D(q_tree) @ a + C @ v + model.h(q_tree) - K_D * r
        return np.concatenate([y[2:], model.acceleration(q_tree, y[2:], u)])

    y, rows = np.concatenate([model.equilibrium()[Q], [0.0, 0.0]]), []
    for begin, end in pairwise(breaks.tolist()):
        inside = instants[(instants >= begin) & ((instants < end) | (end == breaks[-1]))]
        solution = solve_ivp(rate, (begin, end), y, "LSODA", np.union1d(inside, end), rtol=3e-13, atol=1e-14)
        y = solution.y[:, -1]
        rows.append(solution.y[:, : len(inside)].T)
    return np.concatenate(rows)


def scene(theta_1: dict[str, Any], theta_3: dict[str, Any] = REST, **others: Any) -> dict[str, Any]:
    """The overrides of five_bar/tracking that follow such a motion from the equilibrium."""
    rest = dict(zip(("theta_1", "theta_3"), FIVE_BAR.equilibrium()[Q].tolist(), strict=True))
    controller = {"type": "tracking", "Lambda": 2.0, "K_D": 5.0, "desired": {"theta_1": theta_1, "theta_3": theta_3}}
    return {"controller": controller, "initial": {"q": rest}, "t_end": 3.0, "solver.rtol": 1e-10, **others}


def corners(profile: str) -> Array:
    ramps = []
    if profile == "trapezoidal":
        a = LIMITS["max_acceleration"]
        for duration, way in zip(np.diff(T), np.abs(np.diff(X)), strict=True):
            ramps.append((a * duration - np.sqrt((a * duration) ** 2 - 4 * a * way)) / (2 * a))
    inner = [x for k, ramp in enumerate(ramps) for x in (T[k] + ramp, T[k + 1] - ramp)]
    return np.unique(np.concatenate([[0.0, 3.0], T, inner]))


@pytest.fixture(scope="module")
def references() -> dict[str, Array]:
    instants = np.linspace(0.0, 3.0, 61)
    return {profile: tracked(as_function(profile), corners(profile), instants) for profile in PROFILES}


@profiles
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_tracked_runs_match_scipy(profile: str, formulation: str, references: dict[str, Array]) -> None:
    others = {"formulation": formulation, "solver.output_dt": 0.05}
    run = simulate("five_bar/tracking", scene(spec(profile), **others))
    assert run.status == "done"
    assert run.stats["python_calls"] == 0
    state = np.hstack([run.q_tree[:, Q], run.v_tree[:, Q]])
    assert_close(state, references[profile], 1e-8)
    assert_close(state[:, :2], references[profile][:, :2], 2e-9)


def right_hand_sides(run: Run) -> int:
    assert run.status == "done"
    return int(run.stats["rhs"])


@pytest.mark.parametrize("profile", ["linear", "trapezoidal"])
def test_jumps_cost_no_accuracy_and_few_right_hand_sides(profile: str, references: dict[str, Array]) -> None:
    """Compared with the same motion as a function of Python, whose jumps the step size control has to find."""
    overrides = scene(spec(profile), formulation="reduced", **{"solver.output_dt": 0.05, "solver.rtol": 1e-8})
    ours = simulate("five_bar/tracking", overrides)
    law = Tracking(2.0, 5.0, as_function(profile))
    theirs = simulate("five_bar/tracking", overrides, controller=law)
    assert theirs.stats["python_calls"] > 0
    errors = [float(np.abs(run.q_tree[:, Q] - references[profile][:, :2]).max()) for run in (ours, theirs)]
    assert errors[0] < 1e-10
    assert right_hand_sides(ours) < 0.4 * right_hand_sides(theirs)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_sum_of_rate_waves_and_waypoints_runs_as_its_function_of_python(formulation: str) -> None:
    moves = {"offset": 0.1, "rate": -0.05, "harmonics": [[0.1, 4.0, 0.2]], **spec("trapezoidal")}
    overrides = scene(moves, {"offset": -1.7, "rate": 0.1}, formulation=formulation)
    motion = desired(moves, {"offset": -1.7, "rate": 0.1})
    ours = simulate("five_bar/tracking", overrides)
    theirs = simulate("five_bar/tracking", overrides, controller=Tracking(2.0, 5.0, lambda t: motion(t)))
    assert ours.stats["python_calls"] == 0 < theirs.stats["python_calls"]
    assert_close(ours.q_tree, theirs.q_tree, 1e-9)
    assert_close(ours.u[:-1], theirs.u[:-1], 1e-5)


def test_event_within_a_motion_with_corners_is_where_the_run_has_its_value() -> None:
    event = {"coordinate": "theta_1", "of": "q", "value": -1.3, "direction": 1, "stop": True}
    overrides = scene(spec("trapezoidal"))
    run = simulate("five_bar/tracking", {**overrides, "event": [event]})
    assert_close(run.q_tree[-1, 0], -1.3, 1e-12)
    whole = simulate("five_bar/tracking", {**overrides, "t_end": float(run.t[-1])})
    assert_close(whole.q_tree[-1, 0], -1.3, 1e-9)
    assert T[0] < run.t[-1] < T[1]


def crank_angles(turns: int) -> tuple[dict[str, Any], float]:
    rate = 2 * np.pi
    tracking = {"type": "tracking", "Lambda": 5.0, "K_D": 2.0, "desired": {"crank": {"offset": 0.3, "rate": rate}}}
    initial = {"q": {"crank": 0.3}, "q_dot": {"crank": rate}}
    return {"controller": tracking, "initial": initial, "t_end": float(turns), "solver.output_dt": 0.125}, rate


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_crank_turns_at_constant_speed_for_forty_turns(formulation: str) -> None:
    """The slider's position is that of a circle and a bar, however often the crank has turned."""
    overrides, rate = crank_angles(40)
    run = simulate("slider_crank/default", {**overrides, "formulation": formulation, "solver.rtol": 1e-10})
    assert run.status == "done"
    assert run.stats["python_calls"] == 0
    mechanism = run.mechanism
    angle = 0.3 + rate * run.t
    index = {name: k for k, name in enumerate(mechanism.coordinates)}
    assert_close(run.q_tree[:, index["crank"]], angle, 1e-8)
    assert_close(run.v_tree[:, index["crank"]], rate, 1e-7)
    assert_close(run.q_tree[:, index["slider"]], 0.1 * np.cos(angle) + np.sqrt(0.09 - (0.1 * np.sin(angle)) ** 2), 1e-9)


PLACE = [[0.2, [0.15, -0.42, 0.0]], [0.8, [0.17, -0.40, 0.0]], [1.5, [0.14, -0.43, 0.0]]]


@pytest.mark.parametrize("profile", PROFILES)
def test_point_passes_waypoints(profile: str) -> None:
    limits = {"max_rate": 0.2, "max_acceleration": 0.6} if profile == "trapezoidal" else {}
    path = {"point": "tip", "waypoints": PLACE, "profile": profile, **limits}
    sources = Sources("it.scene.toml", None)
    mechanism = load("five_bar")
    motion = make_desired(path, mechanism, sources, 2.0)
    assert isinstance(motion, PointPath)
    t, x = np.array([t for t, _ in PLACE]), np.array([x for _, x in PLACE])
    for time, place in [(0.0, x[0]), *zip(t.tolist(), x, strict=True), (1.9, x[-1])]:
        q, q_dot, _ = motion(time)
        assert_close(motion.point.forward(q), place, 1e-11)
        if profile == "trapezoidal" or time in (0.0, 1.9):
            assert_close(q_dot, 0, 1e-12)
    for time in np.linspace(0.21, 1.49, 33):
        position, velocity, acceleration = motion.path(float(time))
        k = int(np.searchsorted(t, time)) - 1
        if profile in ("linear", "trapezoidal"):
            along = x[k + 1] - x[k]
            assert_close(np.cross(position - x[k], along), 0, 1e-15)  # on the straight line
            assert np.linalg.norm(velocity) <= 0.2 or profile == "linear"
            assert np.linalg.norm(acceleration) <= 0.6 * (1 + 1e-12)
    overrides = {
        "controller.desired": path,
        "t_end": 2.0,
        "initial": {"q": dict(zip(mechanism.independent, motion(0.0)[0].tolist(), strict=True))},
    }
    for formulation in FORMULATIONS:
        run = simulate("five_bar/tracking", {**overrides, "formulation": formulation, "solver.output_dt": 0.1})
        assert run.status == "done"
        assert run.stats["python_calls"] == 0
        if profile != "linear":
            assert_close(run.q_tree[:, Q], np.array([motion(float(time))[0] for time in run.t]), 2e-8)


def test_quintic_table_overshoots_a_corner_and_a_linear_one_does_not() -> None:
    """A V with slopes of 3 rad/s, of which the manual speaks."""
    t = np.linspace(0.0, 2.0, 11)
    q = 3 * np.abs(t - 1.0)[:, np.newaxis]
    dense = np.linspace(0.0, 2.0, 2001)
    for kind, largest in (("linear", 3.0), ("cubic", 4.098), ("quintic", 5.356)):
        assert np.abs(Table(t, q, kind)(dense)[1]).max() == pytest.approx(largest, rel=1e-3)


# --- everything else that uses a desired motion ------------------------------------------------------


def test_workspace_check_sees_waypoints_that_leave_and_turns_between_samples() -> None:
    mechanism = load("five_bar")
    far = desired({"waypoints": [[0.0, -1.4], [1.0, 1.9]], "profile": "linear"}, {"offset": -1.7})
    exit_time = follow_desired(mechanism, far, 3.0).leaves_at
    assert exit_time is not None
    q = far(exit_time)[0]
    FIVE_BAR.sigma(q - np.array([1e-9, 0.0]))  # reachable just before, on the other side not
    with pytest.raises(ValueError, match="out of reach"):
        FIVE_BAR.sigma(q + np.array([1e-6, 0.0]))
    inside = follow_desired(mechanism, desired(spec("trapezoidal")), 3.5)
    assert inside.leaves_at is None
    assert inside.until == 3.5


def test_workspace_check_follows_one_turn_of_a_crank_for_any_number_of_them() -> None:
    mechanism = load("slider_crank")
    motion = make_desired({"crank": {"offset": 0.3, "rate": -300.0}}, mechanism, Sources("it.scene.toml", None), 1e4)
    check = follow_desired(mechanism, motion, 1e4)
    assert check.leaves_at is None
    assert check.until == 1e4
    assert_close(np.cos(0.3 - 300.0 * check.closest_t), 0, 1e-6)  # the rod is steepest
    assert 0.0 < check.closest_t < 2 * np.pi / 300.0


def test_inverse_dynamics_of_a_trapezoid_matches_the_formulas_and_a_rate_that_jumps_is_refused() -> None:
    overrides = {**scene(spec("trapezoidal")), "solver.output_dt": 0.13}
    forces = ckc_pin.inverse_dynamics("five_bar/tracking", overrides)
    motion = as_function("trapezoidal")
    for t, tau in zip(forces.t, forces.tau, strict=True):
        q, q_dot, q_ddot = motion(float(t))
        q_tree = FIVE_BAR.sigma(q)
        C = FIVE_BAR.C(q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
        assert_close(tau, FIVE_BAR.D(q_tree) @ q_ddot + C @ q_dot + FIVE_BAR.h(q_tree), 1e-12)
    with pytest.raises(InputError, match=r"the rate jumps at t = 0\.3 s.*another profile"):
        ckc_pin.inverse_dynamics("five_bar/tracking", scene(spec("linear")))


def test_check_analyses_stability_unless_the_rate_jumps() -> None:
    stable = ckc_pin.check("five_bar/tracking", scene(spec("trapezoidal")))
    assert stable.stability is not None
    assert stable.stability.stable
    jumps = ckc_pin.check("five_bar/tracking", scene(spec("linear")))
    assert jumps.desired is not None
    assert jumps.desired.leaves_at is None
    assert jumps.stability is not None
    assert jumps.stability.stable is None
    assert "the desired rate jumps at t = 0.3 s" in str(jumps.stability.reason)


def test_sampled_controller_follows_waypoints() -> None:
    """With the controller's own values at its samples, it is the function's sampled run to rounding."""
    overrides = {**scene(spec("trapezoidal")), "controller.sample_time": 0.01, "solver.output_dt": 0.05}
    ours = simulate("five_bar/tracking", overrides)
    law = ckc_pin.Sampled(Tracking(2.0, 5.0, as_function("trapezoidal")), 0.01)
    theirs = simulate("five_bar/tracking", scene(spec("trapezoidal"), **{"solver.output_dt": 0.05}), controller=law)
    assert ours.stats["python_calls"] == 0
    assert_close(ours.q_tree, theirs.q_tree, 1e-9)


def test_saved_runs_contain_the_motion(tmp_path: Path) -> None:
    run = simulate("five_bar/tracking", scene(spec("trapezoidal"), **{"solver.output_dt": 0.1}))
    loaded = Run.load(run.save(tmp_path / "run.npz"))
    assert loaded.scene["controller"]["desired"]["theta_1"] == spec("trapezoidal")
    assert_close(loaded.q_tree, run.q_tree, 0.0)


@pytest.mark.parametrize("profile", ["cubic", "linear", "trapezoidal"])
def test_sensitivities_match_differences_across_jumps(profile: str) -> None:
    overrides = scene(spec(profile), **{"solver.output_dt": 0.5, "solver.rtol": 1e-11, "formulation": "reduced"})
    ours = ckc_pin.sensitivities("five_bar/tracking", ["controller.K_D", "initial.q.theta_1"], overrides)
    step = 1e-4
    runs = [simulate("five_bar/tracking", {**overrides, "controller.K_D": 5.0 + sign * step}) for sign in (1, -1)]
    assert_close(ours.q_tree[:, :, 0], (runs[0].q_tree - runs[1].q_tree) / (2 * step), 1e-7)
    assert np.abs(ours.q_tree[:, :, 0]).max() > 1e-5


def test_linear_model_at_an_instant_of_a_motion_and_map_of_its_scene() -> None:
    overrides = scene(spec("trapezoidal"))
    at_rest, moving = (ckc_pin.linearize("five_bar/tracking", t, overrides) for t in (0.0, 1.1))
    assert np.abs(at_rest.A - moving.A).max() > 1e-3
    tracking = ckc_pin.load_scene("five_bar/tracking", overrides)
    result = ckc_pin.singularity_map("five_bar", scene=tracking, cells=24, loci=False)
    assert result.path is not None


def test_ensemble_varies_a_rate() -> None:
    overrides = scene({"offset": -1.4, "rate": 0.1}, **{"t_end": 0.5})
    name = "controller.desired.theta_1.rate"
    members = Members("five_bar/tracking", overrides, (name,), {"end": OutputSpec(of="q_tree", reduce="end")}, 1, 1)
    result = members.run(0, np.array([[0.1], [0.3]])).outputs
    for k, rate in enumerate((0.1, 0.3)):
        assert_close(result["end"][k], simulate("five_bar/tracking", {**overrides, name: rate}).q_tree[-1], 1e-9)


def test_plain_runs_with_rates_lines_and_trapezoids_do_not_import_scipy() -> None:
    code = f"""
import sys
from ckc_pin import simulate
for profile in ({spec("linear")!r}, {spec("trapezoidal")!r}, {{"offset": -1.4, "rate": 0.1}}):
    overrides = {scene(spec("linear"))!r}
    overrides["controller"]["desired"]["theta_1"] = profile
    assert simulate("five_bar/tracking", overrides).status == "done"
assert not [name for name in sys.modules if name.split(".")[0] == "scipy"]
"""
    subprocess.run([sys.executable, "-c", code], check=True)
