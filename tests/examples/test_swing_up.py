"""The planned swing-up against the library's loop, its energy, and what it was asked for."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import ckc_pin
from examples import swing_up


@pytest.fixture(scope="module")
def plan() -> swing_up.Plan:
    return swing_up.plan()


def test_the_loop_goes_where_the_plan_goes(plan: swing_up.Plan) -> None:
    assert np.abs(swing_up.replay(plan) - plan.states).max() <= 1e-6


def test_half_the_pieces_are_further_off(plan: swing_up.Plan) -> None:
    """By 2^8 at Gauss points' order; what grows along the motion, and another optimum, leave most of that."""
    coarse = swing_up.plan(pieces=1)
    off = [np.abs(swing_up.replay(found) - found.states).max() for found in (plan, coarse)]
    assert 16 * off[0] < off[1] < 1e-2


def test_the_motors_keep_their_limit_and_lift_what_they_cannot_hold(plan: swing_up.Plan) -> None:
    assert np.abs(plan.u).max() <= swing_up.TORQUE * (1 + 1e-6)
    assert np.abs(plan.states[-1, [0, 2, 4, 6]] - [np.pi / 2, np.pi / 2, 0, 0]).max() < 1e-9
    level = ckc_pin.terms(ckc_pin.load("five_bar"), {"theta_1": 0.0, "theta_3": 0.0})
    assert level.h.min() > swing_up.TORQUE


def test_the_work_of_the_torques_is_the_energy(plan: swing_up.Plan) -> None:
    """Constant on an interval, a torque does its angle's change times itself; the energy is Pinocchio's."""
    mechanism = ckc_pin.load("five_bar")

    def energy(state: np.ndarray) -> float:
        q, v = (dict(zip(mechanism.coordinates, x.tolist(), strict=True)) for x in (state[:4], state[4:]))
        return float(ckc_pin.terms(mechanism, q, v).energy)

    work = np.sum(plan.u * np.diff(plan.states[:, [0, 2]], axis=0))
    gained = energy(plan.states[-1]) - energy(plan.states[0])
    assert gained > 4
    assert abs(work - gained) < 1e-6 * gained


def test_without_casadi_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ckc_pin.InputError, match=r"pip install ckc_pin\[symbolic\]"):
        swing_up.plan()
