"""Optimal control between configurations: known optima, an independent shooting solution, replays, and messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial
from scipy.optimize import least_squares

import ckc_pin
from ckc_pin import InputError, NumericalError, optimize
from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.optimization.collocation import Collocation
from ckc_pin.optimization.limits import make_limits
from ckc_pin.optimization.mesh_motion import Guess, Mesh, Places
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import KeepOutSpec, LimitsSpec, MinimizeSpec, SphereSpec
from tests.analytic.five_bar import FiveBar
from tests.optimization.small_models import (
    MASS,
    pendulum,
    pendulum_duration,
    require_replay,
    slider,
)

TARGET = {"q": {"theta_1": -1.0, "theta_3": -1.9}}


def test_double_integrator_is_bang_bang() -> None:
    distance, force = 0.7, 3.0
    plan = optimize(slider(), to={"q": {"rail": distance}}, limits={"torque": force}, intervals=100)
    assert plan.t_end == pytest.approx(2 * np.sqrt(distance * MASS / force), rel=1e-4)
    require_replay(plan, force)


def test_pendulum_is_bang_bang() -> None:
    """One switch of the torque. The duration is an integral over the angle."""
    angle, torque = 1.0, 9.0
    plan = optimize(pendulum(torque_limit=torque), to={"q": {"hinge": angle}}, intervals=100)
    assert plan.t_end == pytest.approx(pendulum_duration(angle, torque), rel=1e-4)
    require_replay(plan, torque)


def test_least_effort_of_a_double_integrator_has_a_linear_torque() -> None:
    distance, time = 0.7, 1.5
    plan = optimize(slider(), to={"q": {"rail": distance}}, minimize={"effort": 1.0}, limits={"time": time})
    assert plan.cost == pytest.approx(12 * (MASS * distance) ** 2 / time**3, rel=1e-8)
    assert plan.t_end == pytest.approx(time, rel=1e-6)
    assert np.abs(np.diff(plan.torque[:, 0], 2)).max() < 1e-5


def test_least_jerk_of_a_double_integrator_is_a_quintic_polynomial() -> None:
    """The sixth derivative is zero, and the third is zero at both ends, because accelerations are free there."""
    distance, time = 0.7, 1.5
    plan = optimize(slider(), to={"q": {"rail": distance}}, minimize={"jerk": 1.0}, limits={"time": time})
    conditions = np.array([[1, 1, 1, 1], [2, 3, 4, 5], [0, 6, 0, 0], [0, 6, 24, 60]], dtype=float)
    c = np.linalg.solve(conditions, [1, 0, 0, 0])
    x = plan.t / plan.t_end
    expected = distance * sum(c[k] * x ** (k + 2) for k in range(4))
    assert np.abs(plan.columns()["rail"] - expected).max() < 1e-3 * distance


def least_effort(start: Array, end: Array, time: float) -> float:
    """Return the smallest integral of the five-bar's squared torques by Ritz's method, in NumPy alone."""
    model, bubble = FiveBar.from_table(1, 2, 4, 3), Polynomial([0, 0, 1, -2, 1])
    x, w = np.polynomial.legendre.leggauss(24)
    x, w = (x + 1) / 2, w / 2 * time
    basis = [bubble * Legendre.basis(k).convert(kind=Polynomial)(Polynomial([-1, 2])) for k in range(9)]
    shapes = [Polynomial([0, 0, 3, -2]), *basis]
    values = np.array([[f.deriv(k)(x) / time**k for f in shapes] for k in range(3)])  # (3, shapes, nodes)

    def torques(numbers: Array) -> Array:
        weights = np.vstack([end - start, numbers.reshape(-1, 2)])
        q, v, a = np.einsum("ksn,sd->knd", values, weights)
        rows = []
        for one, rate, acceleration, weight in zip(q + start, v, a, w, strict=True):
            q_tree = model.sigma(one)
            u = model.force(q_tree, rate, acceleration)
            rows.append(np.sqrt(weight) * u)
        return np.concatenate(rows)

    return 2 * float(least_squares(torques, np.zeros(18), xtol=1e-12, ftol=1e-12).cost)


def test_least_effort_of_the_five_bar_equals_an_independent_solution() -> None:
    start, end, time = {"theta_1": -1.434, "theta_3": -1.707}, {"theta_1": -1.3, "theta_3": -1.5}, 0.5
    plan = optimize("five_bar", start={"q": start}, to={"q": end}, minimize={"effort": 1.0}, limits={"time": time})
    expected = least_effort(np.array(list(start.values())), np.array(list(end.values())), time)
    assert plan.cost == pytest.approx(expected, rel=1e-6)
    require_replay(plan, np.inf)


def test_smallest_peak_torque_of_a_double_integrator_is_bang_bang() -> None:
    distance, time = 0.7, 1.5
    plan = optimize(slider(), to={"q": {"rail": distance}}, minimize={"peak_torque": 1.0}, limits={"time": time},
                    intervals=100)  # fmt: skip
    assert plan.cost == pytest.approx(4 * MASS * distance / time**2, rel=1e-3)


def test_rate_limit_is_reached_and_not_exceeded() -> None:
    limits = {"torque": 8.0, "rate": 0.8}
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, limits=limits, intervals=100)
    acceleration = 8.0 / MASS
    assert plan.t_end == pytest.approx(0.7 / 0.8 + 0.8 / acceleration, rel=1e-3)
    assert np.abs(plan.columns()["v.rail"]).max() < 0.8 * (1 + 1e-6)


def test_torque_rate_is_limited() -> None:
    limits = {"torque": 3.0, "torque_rate": 20.0}
    plan = optimize(slider(), to={"q": {"rail": 0.7}}, limits=limits)
    slopes = np.diff(plan.torque[:, 0]) / np.diff(plan.torque_t)
    assert np.abs(slopes).max() < 20.0 * (1 + 1e-6)
    assert np.abs(slopes).max() > 19.9


EVERY_LIMIT: dict[str, Any] = {
    "torque": 2.0, "acceleration": 100.0, "torque_rate": 50.0, "jerk": 1e4, "power": 20.0, "singularity": 0.3,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("five_bar", {"q": {"theta_2": [-1.0, 3.0]}, "rate": {"theta_1": 5.0, "theta_4": 9.0},
                      "keep_out": [KeepOutSpec(sphere=SphereSpec(centre=(0.1, -0.3, 0.0), radius=0.1),
                                               points=["tip"])]}),
        ("delta", {"acceleration": {"swing_1a": 20.0}, "q": {"plate_place.z": [-0.5, 0.5]}}),
        ("slider_crank", {}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("phases", [1, 2])
def test_derivatives_of_the_nonlinear_program_are_exact(name: str, limits: dict[str, Any], phases: int) -> None:
    mechanism = as_mechanism(name, "test")
    dynamics, random, count, d = ReducedDynamics(mechanism), np.random.default_rng(0), 4, mechanism.d
    start, motors = mechanism.independent_part(mechanism.q_tree), len(mechanism.motors.names)
    mesh = Mesh(np.linspace(0.0, phases, count + 1))
    way = random.uniform(-0.2, 0.2, d) / phases
    q_tree = dynamics.follow(mechanism.q_tree, start + np.outer(mesh.gauss_places(), way))
    assert q_tree is not None
    guess = Guess(
        mesh, random.uniform(0.3, 0.6, phases), start + np.outer(mesh.knots, way), np.tile(way / 0.5, (count + 1, 1)),
        random.normal(size=(count, 3, d)), random.normal(size=(count + phases, motors)), q_tree,
    )  # fmt: skip
    other = {"gravity": [1.0, -2.0, 3.0]}
    members = [dynamics, ReducedDynamics(ckc_pin.load(name, other))] if phases > 1 else []
    places = Places(
        guess.q[:: count // phases], random.normal(size=(phases + 1, d)), np.full(phases + 1, np.nan),
        turns=random.normal(size=d) if phases > 1 else None, jumps=False, jumps_at_start=False,
    )  # fmt: skip
    weights = MinimizeSpec(time=1.0, effort=0.1, energy=0.2, jerk=1e-4, peak_torque=0.3, tracking=0.7)
    problem = Collocation(dynamics, make_limits(LimitsSpec(**EVERY_LIMIT | limits), mechanism), weights, guess,
                          mechanism.q_tree, places, random.normal(size=(3 * count, d)), members)  # fmt: skip
    w = problem.pack(guess)
    multipliers = random.normal(size=problem.rows)

    def dense(pattern: Any, values: Array) -> Array:
        matrix = np.zeros(pattern.shape)
        matrix[pattern.get_triplet()] = values
        return matrix

    def slope(x: Array) -> Array:
        return 1.3 * problem.gradient(x) + multipliers @ dense(problem.jacobian_pattern, problem.jacobian(x))

    gradient = problem.gradient(w)
    jacobian = dense(problem.jacobian_pattern, problem.jacobian(w))
    upper = dense(problem.hessian_pattern, problem.hessian(w, 1.3, multipliers))
    hessian = upper + np.triu(upper, 1).T
    for k in range(problem.size):
        step = np.zeros(problem.size)
        step[k] = 1e-6
        (cost_up, up), (cost_down, down) = problem.constraints(w + step), problem.constraints(w - step)
        assert np.abs((up - down) / 2e-6 - jacobian[:, k]).max() < 1e-7 * np.abs(jacobian).max()
        assert abs((cost_up - cost_down) / 2e-6 - gradient[k]) < 1e-7 * np.abs(gradient).max()
        assert np.abs((slope(w + step) - slope(w - step)) / 2e-6 - hessian[:, k]).max() < 1e-6 * np.abs(hessian).max()


@pytest.mark.parametrize(
    ("name", "to", "limit"),
    [
        ("five_bar", TARGET, 2.0),
        ("three_rrr", {"q": {"a_1": -0.5, "a_2": 1.5, "a_3": 3.4}}, 1.0),
        ("delta", {"point": {"plate": [0.1, 0.05, -0.3]}}, 5.0),
        ("stewart", {"point": {"plate": [0.0, 0.0, 0.65]}}, 300.0),
    ],
)
def test_fastest_motion_is_replayed(name: str, to: dict[str, Any], limit: float) -> None:
    plan = optimize(name, to=to, limits={"torque": limit}, intervals=20)
    require_replay(plan, limit)
    if "point" in to:
        ((point, position),) = to["point"].items()
        at = plan.motion(np.array([plan.t_end]))[0][0]
        assert np.abs(ckc_pin.Point(plan.mechanism, point).forward(at) - position).max() < 1e-8


def test_a_free_path_is_not_slower_than_the_straight_one() -> None:
    start = {"theta_1": -1.434, "theta_3": -1.707}
    free = optimize("five_bar", start={"q": start}, to=TARGET, limits={"torque": 2.0})
    path = {name: [start[name], TARGET["q"][name]] for name in start}
    straight = optimize("five_bar", path={"q": path}, limits={"torque": 2.0})
    assert free.t_end < straight.t_end


def test_weak_motors_swing_the_five_bar_to_a_place_that_they_cannot_reach_directly() -> None:
    plan = optimize("five_bar", start={"at": "equilibrium"}, to={"q": {"theta_1": -0.3, "theta_3": -0.9}},
                    limits={"torque": 0.6, "time": 1.6}, minimize={"effort": 1.0})  # fmt: skip
    require_replay(plan, 0.6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"to": {}}, "to: expected one of q, point and at, got none"),
        ({"to": {"q": {"theta_1": -1.0}}}, "theta_3"),
        ({"to": {"point": {"tip": [3.0, 0.0, 0.0]}}}, "to.point: unreachable: the point 'tip'"),
        ({"to": {"q": {"theta_1": 3.1, "theta_3": 0.0}}}, "to.q: unreachable: q is"),
        ({"to": None}, "expected either `to` or `path`, got neither"),
        ({"limits": {}}, "limits: nothing limits the speed"),
        ({"minimize": {"time": 0.0}}, "minimize: every weight is zero"),
        ({"minimize": {"effort": 1.0}}, "without a weight of time the duration has no bound"),
        ({"limits": {"torque": 2.0, "q": {"theta_1": [-1.2, 0.0]}}}, "from: theta_1 = -1.43"),
        ({"start": {"at": "assembled", "q_dot": {"theta_1": 5.0}}, "limits": {"torque": 2.0, "rate": 1.0}},
         "from.q_dot: theta_1 = 5 is above limits.rate = 1"),
    ],
)  # fmt: skip
def test_wrong_input_is_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"to": TARGET, "limits": {"torque": 2.0}, **change}
    with pytest.raises(InputError) as error:
        optimize("five_bar", **arguments)
    assert message in str(error.value)


def test_an_infeasible_duration_is_reported() -> None:
    with pytest.raises(NumericalError, match=r"optimize: (infeasible|stuck|budget): .* largest violation"):
        optimize("five_bar", to=TARGET, limits={"torque": 2.0, "time": 0.02})
