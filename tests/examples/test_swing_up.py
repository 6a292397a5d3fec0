"""The planned swing-up, compared with its simulation, its energy balance and its requirements."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import ckc_pin
from examples import swing_up


@pytest.fixture(scope="module")
def plan() -> swing_up.Plan:
    return swing_up.plan()


def test_simulation_reproduces_planned_states(plan: swing_up.Plan) -> None:
    assert np.abs(swing_up.replay(plan) - plan.states).max() <= 1e-6


def test_error_grows_with_half_the_pieces(plan: swing_up.Plan) -> None:
    """The order at Gauss points would give 2^8; error growth along the motion and another optimum reduce this."""
    coarse = swing_up.plan(pieces=1)
    errors = [np.abs(swing_up.replay(solution) - solution.states).max() for solution in (plan, coarse)]
    assert 16 * errors[0] < errors[1] < 1e-2


def test_torques_respect_limit_below_holding_torque(plan: swing_up.Plan) -> None:
    assert np.abs(plan.u).max() <= swing_up.TORQUE * (1 + 1e-6)
    assert np.abs(plan.states[-1, [0, 2, 4, 6]] - [np.pi / 2, np.pi / 2, 0, 0]).max() < 1e-9
    level = ckc_pin.terms(ckc_pin.load("five_bar"), {"theta_1": 0.0, "theta_3": 0.0})
    assert level.h.min() > swing_up.TORQUE


def test_work_of_torques_equals_energy_gain(plan: swing_up.Plan) -> None:
    """The work of a constant torque is torque times angle; the energy is Pinocchio's."""
    mechanism = ckc_pin.load("five_bar")

    def energy(state: np.ndarray) -> float:
        q, v = (dict(zip(mechanism.coordinates, x.tolist(), strict=True)) for x in (state[:4], state[4:]))
        return float(ckc_pin.terms(mechanism, q, v).energy)

    work = np.sum(plan.u * np.diff(plan.states[:, [0, 2]], axis=0))
    gained = energy(plan.states[-1]) - energy(plan.states[0])
    assert gained > 4
    assert abs(work - gained) < 1e-6 * gained


def test_missing_casadi_is_reported_with_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ckc_pin.InputError, match=r"pip install ckc_pin\[symbolic\]"):
        swing_up.plan()
