"""Motions along paths with other costs and limits than the fastest ones: closed forms, replays, and messages."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Plan, optimize
from tests.optimization.small_models import MASS, require_replay, slider

DISTANCE, WEIGHT = 0.7, 1e-3
RAIL = {"q": {"rail": [0.0, DISTANCE]}}
FIVE_BAR = {"q": {"theta_1": [-1.434, -1.2, -1.0], "theta_3": [-1.707, -1.6, -1.9]}}


@cache
def plan_five_bar(**weights: float) -> Plan:
    return optimize("five_bar", path=FIVE_BAR, minimize=weights, limits={"torque": 2.0})


def cost(plan: Plan, **weights: float) -> float:
    return sum(weight * plan.parts[name] for name, weight in weights.items())


def test_least_effort_of_a_mass_on_a_rail_has_a_linear_force() -> None:
    """The effort is 12 m² L² / T³, so that T + w effort is smallest at T⁴ = 36 w m² L²."""
    plan = optimize(slider(), path=RAIL, minimize={"time": 1.0, "effort": WEIGHT})
    duration = (36 * WEIGHT * MASS**2 * DISTANCE**2) ** 0.25
    assert plan.t_end == pytest.approx(duration, rel=1e-4)
    assert cost(plan, time=1.0, effort=WEIGHT) == pytest.approx(4 / 3 * duration, rel=1e-4)
    assert plan.cost == pytest.approx(cost(plan, time=1.0, effort=WEIGHT))
    largest = 6 * MASS * DISTANCE / duration**2
    exact = np.interp(plan.torque_t, [0.0, duration], [largest, -largest])
    assert np.abs(plan.torque[:, 0] - exact).max() < 5e-3 * largest
    require_replay(plan, np.inf)


def test_least_rate_of_force_has_a_cubic_force() -> None:
    """The integral of the squared rate is 120 m² L² / T⁵, so that the cost is smallest at T⁶ = 600 w m² L²."""
    plan = optimize(slider(), path=RAIL, minimize={"time": 1.0, "torque_rate": WEIGHT})
    duration = (600 * WEIGHT * MASS**2 * DISTANCE**2) ** (1 / 6)
    assert plan.t_end == pytest.approx(duration, rel=1e-4)
    assert cost(plan, time=1.0, torque_rate=WEIGHT) == pytest.approx(1.2 * duration, rel=1e-4)
    require_replay(plan, np.inf)


def test_least_rate_of_force_from_place_to_place_is_the_same() -> None:
    plan = optimize(slider(), to={"q": {"rail": DISTANCE}}, minimize={"time": 1.0, "torque_rate": WEIGHT})
    duration = (600 * WEIGHT * MASS**2 * DISTANCE**2) ** (1 / 6)
    assert plan.t_end == pytest.approx(duration, rel=1e-4)
    assert cost(plan, time=1.0, torque_rate=WEIGHT) == pytest.approx(1.2 * duration, rel=1e-4)


def test_least_peak_force_within_a_time_is_bang_bang() -> None:
    """With T given, the force is ± 4 m L / T²."""
    plan = optimize(slider(), path=RAIL, minimize={"peak_torque": 1.0}, limits={"time": 0.5, "torque": 100.0})
    assert plan.t_end == pytest.approx(0.5, rel=1e-5)
    assert np.abs(plan.torque).max() == pytest.approx(4 * MASS * DISTANCE / 0.5**2, rel=1e-3)


def test_rate_limit_of_force_gives_a_ramp() -> None:
    """Bang-bang with a ramp of slope r from F to -F: half the way is F T²/8 - F³/(6 r²) over the mass."""
    limit, slope = 10.0, 60.0
    plan = optimize(slider(), path=RAIL, limits={"torque": limit, "torque_rate": slope})
    ramp = limit / slope  # half of its duration
    # v = F (t - ...): the distance is F (T/2)² - F ramp²/3, over the mass.
    duration = 2 * np.sqrt(MASS * DISTANCE / limit + ramp**2 / 3)
    assert plan.t_end == pytest.approx(duration, rel=1e-3)
    rates = np.diff(plan.torque[:, 0]) / np.diff(plan.torque_t)
    inside = np.diff(plan.torque_t) > 1e-6
    assert np.abs(rates[inside]).max() < slope * 1.02
    require_replay(plan, limit)


def test_energy_along_a_level_rail_is_the_kinetic_energy() -> None:
    """A motor that brakes gives nothing back: it draws m v²/2 of the fastest moment."""
    plan = optimize(slider(), path=RAIL, minimize={"energy": 1.0}, limits={"time": 1.0, "torque": 100.0})
    # With forces up to F, the smallest largest speed belongs to a trapezoid: L = v T - v² m / F.
    speed = (1.0 - np.sqrt(1.0 - 4 * MASS * DISTANCE / 100.0)) * 100.0 / (2 * MASS)
    assert plan.parts["energy"] == pytest.approx(0.5 * MASS * speed**2, rel=2e-4)
    require_replay(plan, 100.0)


def test_least_energy_without_limits_of_the_force_has_uniform_speed() -> None:
    """The forces at the ends are as short as the grid allows."""
    plan = optimize(slider(), path=RAIL, minimize={"energy": 1.0}, limits={"time": 0.3})
    assert plan.parts["energy"] == pytest.approx(0.5 * MASS * (DISTANCE / 0.3) ** 2, rel=5e-4)


@pytest.mark.parametrize("minimize", [{"effort": 1.0}, {"effort": 1.0, "energy": 0.1}, {"jerk": 1.0}])
def test_the_time_of_a_plan_is_its_limit(minimize: dict[str, float]) -> None:
    """The optimizer's duration has an error of its grid, which is corrected."""
    plan = optimize("five_bar", path=FIVE_BAR, minimize=minimize, limits={"time": 0.5})
    assert plan.t_end == pytest.approx(0.5, rel=1e-6)
    require_replay(plan, np.inf)


@pytest.mark.parametrize(
    ("minimize", "limits"),
    [
        ({"time": 1.0, "effort": 0.05}, {}),
        ({"time": 1.0, "torque_rate": 1e-4}, {}),
        ({"time": 1.0}, {"power": 2.0}),
        ({"time": 1.0}, {"jerk": 200.0}),
    ],
)
def test_smooth_motions_of_the_five_bar_are_replayed(minimize: dict[str, float], limits: dict[str, Any]) -> None:
    plan = optimize("five_bar", path=FIVE_BAR, minimize=minimize, limits={"torque": 2.0} | limits)
    assert plan.t_end > plan_five_bar(time=1.0).t_end
    assert plan.message == "a local optimum along the path"
    require_replay(plan, 2.0)
    if "power" in limits:
        at = [plan.limits.names.index(f"power.{name}") for name in plan.mechanism.actuated]
        assert np.abs(plan.quantities[:, at]).max() < limits["power"] * (1 + 1e-4)


def test_torques_of_a_path_with_rounded_corners_are_replayed() -> None:
    """The table of torques gets finer until the replay ends with the plan."""
    places = {
        "arm_1": [0.3261, 0.2377, 0.4406, 0.1207], "arm_2": [0.5032, 0.3509, 0.1537, 0.5221],
        "arm_3": [0.1031, 0.2893, 0.0899, 0.1237],
    }  # fmt: skip
    path = {"q": places, "shape": "lines", "rounding": 0.02}
    plan = optimize("delta", path=path, minimize={"time": 0.135, "effort": 0.23}, limits={"torque": 8.0})
    require_replay(plan, 8.0)
    assert len(plan.warnings) == 1
    assert "2 corners are rounded" in plan.warnings[0]


def test_effort_lies_between_neighbouring_weights() -> None:
    """A larger weight never gives a longer optimum of its own part: costs are monotone in the weights."""
    plans = [plan_five_bar(time=1.0, effort=weight) for weight in (0.02, 0.05, 0.1)]
    efforts, times = [x.parts["effort"] for x in plans], [x.t_end for x in plans]
    assert efforts == sorted(efforts, reverse=True)
    assert times == sorted(times)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"minimize": {"tracking": 1.0}}, "minimize.tracking: not supported along a path"),
        ({"minimize": {"effort": 1.0}}, "without a weight of time the duration has no bound"),
        ({"limits": {"torque": 2.0, "time": 0.01}}, "the fastest motion takes"),
    ],
)
def test_wrong_input_is_explained(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        optimize("five_bar", **{"path": FIVE_BAR, "limits": {"torque": 2.0}} | change)
