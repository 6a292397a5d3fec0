"""Limits of the power that all motors draw together, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from ckc_pin import InputError, Plan, optimize
from tests.optimization.small_models import GRAVITY, MASS, require_replay, slider, table

FORCE, POWER, DISTANCE = 10.0, 8.0, 0.5


def slider_duration() -> float:
    """Return the time of a mass that accelerates by FORCE up to POWER, then by POWER, and brakes by FORCE, s."""
    first = POWER / FORCE

    def way(speed: float) -> float:
        powered = MASS * (speed**3 - first**3) / (3 * POWER)
        return MASS * (first**2 + speed**2) / (2 * FORCE) + powered - DISTANCE

    speed = brentq(way, first, 10.0)
    return float(MASS * (first + speed) / FORCE + MASS * (speed**2 - first**2) / (2 * POWER))


@pytest.mark.parametrize("task", [{"to": {"q": {"rail": DISTANCE}}}, {"path": {"q": {"rail": [0.0, DISTANCE]}}}])
def test_a_supply_limits_the_acceleration_but_not_the_braking(task: dict[str, Any]) -> None:
    """The duration has a closed form."""
    plan = optimize(slider(), limits={"torque": FORCE, "total_power": POWER}, intervals=200, **task)
    assert plan.t_end == pytest.approx(slider_duration(), rel=2e-4)
    assert "total_power" in {limit.quantity for limit in plan.active}
    require_replay(plan, FORCE)


def test_without_power_the_fastest_motion_is_a_brachistochrone() -> None:
    """Motors that give no energy act as a frictionless wire, whose best shape is a cycloid (Bernoulli 1697)."""
    radius, angles = 0.2, np.array([1.0, 2.5])
    rate = np.sqrt(GRAVITY / radius)
    x, y = radius * (angles - np.sin(angles)), radius * (np.cos(angles) - 1)
    x_dot, y_dot = radius * rate * (1 - np.cos(angles)), -radius * rate * np.sin(angles)
    start, end = ({"q": {"x": x[k], "y": y[k]}, "q_dot": {"x": x_dot[k], "y": y_dot[k]}} for k in (0, 1))
    plan = optimize(table(), start=start, to=end, limits={"torque": 50.0, "total_power": 1e-3})
    assert plan.t_end == pytest.approx(float(np.ptp(angles)) / rate, rel=1e-5)
    angle = angles[0] + rate * plan.t
    cycloid = np.array([radius * (angle - np.sin(angle)), radius * (np.cos(angle) - 1)]).T
    np.testing.assert_allclose(plan.motion(plan.t)[0], cycloid, atol=5e-4)
    require_replay(plan, 50.0)


def total_power(plan: Plan) -> Any:
    """Return the sum of torques times rates of the motors' joints."""
    columns = plan.columns()
    return sum(columns[f"tau.{name}"] * columns[f"v.{name}"] for name in plan.mechanism.actuated)


def test_motors_of_a_closed_chain_share_a_supply() -> None:
    """The limit is reached and kept, and a motor may draw what another one gives back."""
    to = {"q": {"theta_1": -1.0, "theta_3": -1.9}}
    limit = float(total_power(optimize("five_bar", to=to, limits={"torque": 2.0})).max()) / 2
    plan = optimize("five_bar", to=to, limits={"torque": 2.0, "total_power": limit})
    assert limit * 0.99 < total_power(plan).max() <= limit * 1.001
    columns = plan.columns()
    single = max(np.max(columns[f"tau.{x}"] * columns[f"v.{x}"]) for x in plan.mechanism.actuated)
    assert single > 1.01 * limit
    require_replay(plan, 2.0)


def test_the_limit_is_positive() -> None:
    """Without any power most motions are impossible."""
    with pytest.raises(InputError, match=r"total_power"):
        optimize("five_bar", to={"q": {"theta_1": -1.0, "theta_3": -1.9}}, limits={"total_power": 0.0})
