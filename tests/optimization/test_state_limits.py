"""Limits of the state in optimal control: closed forms, and optimality by equations of the tests' own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial
from scipy.optimize import brentq, nnls

from ckc_pin import InputError, NumericalError, Plan, optimize
from ckc_pin.base.arrays import Array
from tests.analytic.five_bar import FiveBar
from tests.optimization.small_models import MASS, require_replay, slider

DISTANCE, FORCE = 0.7, 5.0
TO = {"q": {"rail": DISTANCE}}
START, END = {"theta_1": -1.434, "theta_3": -1.707}, {"theta_1": -1.0, "theta_3": -1.9}
TIME = 0.5


# --- closed forms --------------------------------------------------------------------------------


def test_power_limit_of_a_double_integrator() -> None:
    """The force is the largest one up to the speed P / F. Then v^2 grows linearly in time. Braking is its mirror."""
    power = 4.0
    plan = optimize(slider(), to=TO, limits={"torque": FORCE, "power": power}, intervals=100)
    slow = power / FORCE
    first = MASS * slow**2 / (2 * FORCE)
    top = np.cbrt(slow**3 + 3 * power / MASS * (DISTANCE / 2 - first))
    expected = 2 * (slow * MASS / FORCE + MASS * (top**2 - slow**2) / (2 * power))
    assert plan.t_end == pytest.approx(expected, rel=3e-4)
    product = plan.columns()["tau.rail"] * plan.columns()["v.rail"]
    assert np.abs(product).max() < power * (1 + 1e-3)
    require_replay(plan, FORCE)
    assert {x.quantity for x in plan.active} == {"power.rail", "tau.rail"}


def test_speed_limit_of_a_shaft_behind_a_gear() -> None:
    """The motor turns 10 times as fast as the joint, whose profile is trapezoidal."""
    plan = optimize(slider(ratio=10.0, speed_limit=8.0), to=TO, limits={"torque": FORCE / 10}, intervals=100)
    assert plan.t_end == pytest.approx(DISTANCE / 0.8 + 0.8 * MASS / FORCE, rel=1e-3)
    assert np.abs(plan.columns()["v.rail"]).max() < 0.8 * (1 + 1e-3)


def test_jerk_limit_of_a_double_integrator() -> None:
    """The acceleration is the largest one, falls with the largest jerk, and is the smallest one at the end."""
    jerk, largest = 20.0, FORCE / MASS
    fall = 2 * largest / jerk

    def distance(time: float) -> float:
        t = np.linspace(0, time, 200_001)
        a = np.clip(largest - jerk * (t - (time - fall) / 2), -largest, largest)
        return float(np.trapezoid((time - t) * a, t))

    expected = brentq(lambda time: distance(time) - DISTANCE, fall, 5.0)
    plan = optimize(slider(), to=TO, limits={"torque": FORCE, "jerk": jerk}, intervals=100)
    assert plan.t_end == pytest.approx(expected, rel=1e-4)
    slopes = np.diff(plan.torque[:, 0]) / np.diff(plan.torque_t) / MASS
    assert np.abs(slopes).max() < jerk * (1 + 1e-6)
    require_replay(plan, FORCE)


def test_least_energy_of_a_double_integrator_is_the_kinetic_energy_of_a_trapezoid() -> None:
    """The work of the driving force is the largest kinetic energy, which is smallest in the trapezoidal profile."""
    time, a = 1.5, FORCE / MASS
    plan = optimize(slider(), to=TO, minimize={"energy": 1.0}, limits={"torque": FORCE, "time": time}, intervals=100)
    speed = (time - np.sqrt(time**2 - 4 * DISTANCE / a)) * a / 2
    assert plan.cost == pytest.approx(MASS * speed**2 / 2, rel=1e-3)
    require_replay(plan, FORCE)


def test_energy_counts_each_motor_that_drives() -> None:
    plan = optimize("five_bar", start={"q": START}, to={"q": END}, minimize={"energy": 1.0, "effort": 0.05},
                    limits={"torque": 2.0, "time": TIME})  # fmt: skip
    columns = plan.columns()
    driven = sum(np.maximum(columns[f"tau.{name}"] * columns[f"v.{name}"], 0.0) for name in START)
    assert plan.parts["energy"] == pytest.approx(float(np.trapezoid(driven, plan.t)), rel=1e-3)
    require_replay(plan, 2.0)


def test_tracking_of_a_double_integrator_is_the_linear_quadratic_optimum() -> None:
    """x'''' m^2 r + x = x_d, with x and x' at both ends; x_d is constant, so that x - x_d is a sum of exponentials."""
    time, weight, desired = 1.5, 1e-3, 1.2
    plan = optimize(slider(), to=TO, minimize={"tracking": 1.0, "effort": weight}, limits={"time": time},
                    desired={"rail": {"offset": desired}}, intervals=80)  # fmt: skip
    roots = np.roots([MASS**2 * weight, 0, 0, 0, 1])
    ends = np.exp(roots * time)
    matrix = np.array([np.ones(4), roots, ends, roots * ends])
    c = np.linalg.solve(matrix, [-desired, 0, DISTANCE - desired, 0])
    x = desired + np.real(np.exp(np.outer(plan.t, roots)) @ c)
    assert np.abs(plan.columns()["rail"] - x).max() < 1e-6
    assert plan.t_end == time
    require_replay(plan, np.inf)


def test_tracking_follows_a_table() -> None:
    """Without effort, the motion is the table's as far as the ends allow it."""
    t = np.linspace(0.0, TIME, 21)
    s = 10 * (t / TIME) ** 3 - 15 * (t / TIME) ** 4 + 6 * (t / TIME) ** 5
    table = {"t": t, **{name: START[name] + s * (END[name] - START[name]) for name in START}}
    plan = optimize("five_bar", start={"q": START}, to={"q": END}, minimize={"tracking": 1.0}, limits={"time": TIME},
                    desired={"file": table})  # fmt: skip
    for name in START:
        assert np.abs(np.interp(t, plan.t, plan.columns()[name]) - table[name]).max() < 1e-3


# --- optimality on the five-bar, by its equations in NumPy alone -------------------------------------


Inside = Callable[[FiveBar, Array, Array], float]
MODEL = FiveBar.from_table(1, 2, 4, 3)


def optimality_gap(plan: Plan, inside: Inside) -> tuple[float, float]:
    """Return the effort of a plan, and the part of its gradient that no multipliers of active limits balance.

    The gradients are differences along 24 polynomial variations of the motion that vanish at both ends.
    """
    T, bubble = plan.t_end, Polynomial([0, 0, 1, -2, 1])
    x, w = np.polynomial.legendre.leggauss(4)
    knots = plan.torque_t
    t = (knots[:-1, None] + np.diff(knots)[:, None] * (x + 1) / 2).ravel()
    weights = (np.diff(knots)[:, None] * w / 2).ravel()
    shapes = [bubble * Legendre.basis(k).convert(kind=Polynomial)(Polynomial([-1, 2])) for k in range(12)]

    def at(times: Array, numbers: Array) -> tuple[Array, Array, Array]:
        values = np.array([[f.deriv(k)(times / T) / T**k for f in shapes] for k in range(3)])
        q, v, a = np.einsum("ksn,sd->knd", values, numbers) + np.array(plan.motion(times))
        return np.array([MODEL.sigma(one) for one in q]), v, a

    def effort(numbers: Array) -> float:
        total = 0.0
        for q_tree, rate, acceleration, weight in zip(*at(t, numbers), weights, strict=True):
            u = MODEL.force(q_tree, rate, acceleration)
            total += weight * float(u @ u)
        return total

    def margins(times: Array, numbers: Array) -> Array:
        q_trees, v, _ = at(times, numbers)
        return np.array([inside(MODEL, one, MODEL.rho(one) @ rate) for one, rate in zip(q_trees, v, strict=True)])

    zero, grid = np.zeros((12, 2)), np.linspace(0.0, T, 801)[1:-1]
    active = grid[margins(grid, zero) < 2e-3]
    gradient, slopes = np.empty(24), np.empty((len(active), 24))
    for k in range(24):
        step = np.zeros(24)
        step[k] = 1e-4
        up, down = (step.reshape(12, 2) * sign for sign in (1, -1))
        gradient[k] = (effort(up) - effort(down)) / 2e-4
        slopes[:, k] = (margins(active, up) - margins(active, down)) / 2e-4
    return effort(zero), nnls(slopes.T, gradient)[1] / float(np.linalg.norm(gradient))


def smallest(model: FiveBar, q_tree: Array) -> float:
    return float(np.linalg.svd(model.phi_z(q_tree), compute_uv=False)[-1])


def tip(model: FiveBar, q_tree: Array) -> Array:
    """Return the position of the pin between the distal links."""
    angles = np.array([q_tree[0], q_tree[0] + q_tree[1]])
    return np.array([model.l[0], model.l[1]]) @ np.column_stack([np.cos(angles), np.sin(angles)])


AT_START = MODEL.sigma(np.array(list(START.values())))
BEYOND = {"theta_1": -0.369, "theta_3": -2.603}
CENTRE, RADIUS = [0.11, -0.56, 0.0], 0.015
LIMITED: list[tuple[dict[str, float], dict[str, Any], str, Inside]] = [
    (END, {"q": {"theta_2": [-1.0, 0.3]}}, "theta_2", lambda model, q_tree, v_tree: 0.3 - q_tree[1]),
    (END, {"rate": {"theta_2": 3.5}}, "v.theta_2", lambda model, q_tree, v_tree: 3.5 + v_tree[1]),
    (END, {"keep_out": [{"sphere": {"centre": CENTRE, "radius": RADIUS}, "points": ["tip"]}]}, "distance.tip",
     lambda model, q_tree, v_tree: 100 * (np.linalg.norm(tip(model, q_tree) - CENTRE[:2]) - RADIUS)),
    (BEYOND, {"singularity": 0.6}, "sigma_min",
     lambda model, q_tree, v_tree: smallest(model, q_tree) / smallest(model, AT_START) - 0.6),
]  # fmt: skip


@pytest.mark.parametrize(("end", "limits", "name", "inside"), LIMITED, ids=[x[2] for x in LIMITED])
def test_least_effort_within_a_limit_is_optimal(
    end: dict[str, float], limits: dict[str, Any], name: str, inside: Inside
) -> None:
    """The limit is active, holds between the points of the mesh too, and its multipliers balance the gradient."""
    plan = optimize("five_bar", start={"q": START}, to={"q": end}, minimize={"effort": 1.0},
                    limits={"time": TIME, **limits})  # fmt: skip
    require_replay(plan, np.inf)
    assert name in {x.quantity for x in plan.active}
    q, v, _ = plan.motion(np.linspace(0.0, plan.t_end, 3001))
    q_trees = [MODEL.sigma(one) for one in q]
    worst = min(inside(MODEL, one, MODEL.rho(one) @ rate) for one, rate in zip(q_trees, v, strict=True))
    assert worst > -1e-3
    effort, gap = optimality_gap(plan, inside)
    assert plan.cost == pytest.approx(effort, rel=1e-5)
    assert gap < 1e-3


# --- wrong input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limits": {"torque": 2.0, "power": {"theta_2": 5.0}}}, "limits.power: no motor 'theta_2'"),
        ({"limits": {"torque": 2.0, "jerk": {"theta_2": 5.0}}}, "limits.jerk: no coordinate 'theta_2'"),
        ({"limits": {"torque": 2.0, "power": -1.0}}, "power"),
        ({"limits": {"torque": 2.0, "keep_out": [{"sphere": {"centre": CENTRE, "radius": 0.1}, "points": ["tip"]}]}},
         "from: the point 'tip' is 0.04"),
        ({"limits": {"torque": 2.0, "keep_out": [{"sphere": {"centre": CENTRE, "radius": 0.1}, "points": ["top"]}]}},
         "limits.keep_out[0].points: no point 'top'; there are tip"),
        ({"limits": {"torque": 2.0, "singularity": 0.9}}, "to: sigma_min(phi_z) is 0.306 of its value at the start"),
        ({"minimize": {"tracking": 1.0}}, "minimize.tracking needs desired"),
        ({"desired": {"theta_1": {}, "theta_3": {}}}, "desired needs minimize.tracking"),
        ({"minimize": {"tracking": 1.0}, "desired": {"theta_1": {}, "theta_3": {}}}, "the duration is limits.time"),
        ({"minimize": {"tracking": 1.0}, "desired": {"theta_1": {}}, "limits": {"time": 1.0}},
         "optimize: desired: needs a table for each of theta_1, theta_3 (or file); 'theta_3' is missing"),
        ({"minimize": {"tracking": 1.0}, "limits": {"time": 1.0},
          "desired": {"file": {"t": [0.0, 0.5], "theta_1": [0, 0], "theta_3": [0, 0]}, "interpolation": "linear"}},
         "ends at t = 0.5 s"),
    ],
)  # fmt: skip
def test_wrong_limits_and_weights_are_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"start": {"q": START}, "to": {"q": END}, "limits": {"torque": 2.0}, **change}
    with pytest.raises(InputError) as error:
        optimize("five_bar", **arguments)
    assert message in str(error.value)


def test_a_limit_that_no_motion_holds_ends_with_a_reason() -> None:
    with pytest.raises(NumericalError, match=r"optimize: (infeasible|stuck|budget): .*"):
        optimize(slider(), to=TO, limits={"torque": FORCE, "power": 0.01, "time": 0.8})


def test_limits_that_are_not_reached_do_not_change_the_least_energy() -> None:
    """The energy's variables stay with its equations, whatever other functions of the state are limited."""
    task: dict[str, Any] = {"to": {"q": {"crank": 2.0}}, "minimize": {"time": 1.0, "energy": 0.3}}
    alone = optimize("slider_crank", **task, limits={"torque": 3.0})
    limits = {"torque": 3.0, "singularity": 0.1, "power": 1000.0, "total_power": 1000.0, "rate": {"rod": 1000.0}}
    limited = optimize("slider_crank", **task, limits=limits)
    assert limited.cost == pytest.approx(alone.cost, rel=1e-6)
