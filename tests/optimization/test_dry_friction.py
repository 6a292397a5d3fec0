"""Optimal motions with dry friction: closed forms, and replays in the step loop, whose friction is exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import optimize
from tests.optimization.small_models import MASS, require_replay, slider


def test_fastest_motion_against_dry_friction_is_bang_bang() -> None:
    distance, force, friction = 0.7, 3.0, 0.5
    plan = optimize(slider(friction=friction), to={"q": {"rail": distance}}, limits={"torque": force}, intervals=100)
    forth, back = (force - friction) / MASS, (force + friction) / MASS
    fastest = np.sqrt(2 * distance / (1 / forth + 1 / back))
    assert plan.t_end == pytest.approx(fastest / forth + fastest / back, rel=1e-4)
    require_replay(plan, force)


def test_least_effort_against_dry_friction() -> None:
    """The force is m a + friction, and the integral of a is zero, so that friction adds its square times T."""
    distance, friction, time = 0.7, 0.5, 1.5
    plan = optimize(slider(friction=friction), to={"q": {"rail": distance}}, minimize={"effort": 1.0},
                    limits={"time": time})  # fmt: skip
    assert plan.cost == pytest.approx(12 * (MASS * distance) ** 2 / time**3 + friction**2 * time, rel=1e-6)
    require_replay(plan, np.inf)


@pytest.mark.parametrize(
    "task", [{"limits": {"torque": 2.0}}, {"limits": {"torque": 2.0, "time": 0.5}, "minimize": {"effort": 1.0}}]
)
def test_passive_joints_that_turn_back_are_replayed(task: dict[str, Any]) -> None:
    """Both passive joints turn back on the way, at places that depend on the solution."""
    rubbing = ckc_pin.load("five_bar", {f"joint.theta_{k}.friction": 0.05 for k in (1, 2, 3, 4)})
    to = {"q": {"theta_1": -1.0, "theta_3": -1.9}}
    plan, smooth = (optimize(mechanism, to=to, **task) for mechanism in (rubbing, "five_bar"))
    require_replay(plan, 2.0)
    assert not plan.warnings
    assert plan.cost > smooth.cost
    rates = np.array([plan.columns()[f"v.theta_{k}"][1:-1] for k in (1, 2, 3, 4)])
    assert (np.diff(np.sign(rates), axis=1) != 0).any()


def test_a_motion_that_has_to_stick_says_so() -> None:
    """The mass has to wait before it moves, so that its motion has a time at rest, which has no direction."""
    plan = optimize(slider(friction=2.0), to={"q": {"rail": 0.01}}, minimize={"tracking": 1.0, "effort": 1e-6},
                    limits={"time": 2.0, "torque": 5.0},
                    desired={"rail": {"waypoints": [[0.0, 0.0], [1.0, 0.0], [2.0, 0.01]]}})  # fmt: skip
    assert plan.replay.error > 1e-6
    assert any("dry friction may stick" in warning for warning in plan.warnings)
