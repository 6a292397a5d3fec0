"""States of linear models: configurations held by motors, times of runs, and rejected arguments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, LinearModel, linearize, load, simulate, terms
from ckc_pin.dynamics import dae_acceleration, multipliers
from tests.analytic.five_bar import FIVE_BAR
from tests.analytic.small_models import coupled_four_bar
from tests.analytic.test_linearization import agree, linearize_appendix


def test_motors_hold_an_operating_point() -> None:
    q = {"theta_1": -1.1, "theta_3": -1.8}
    model = linearize("five_bar", q)
    state = terms(load("five_bar"), q)
    agree(model.tau, FIVE_BAR.h(state.q_tree))
    agree(model.A, linearize_appendix(state.q_tree, np.zeros(2), model.tau)[0])
    a = dae_acceleration(state, state.mechanism.motors.force(model.tau))
    assert np.abs(a).max() < 1e-12
    assert multipliers(state, state.mechanism.motors.force(model.tau), a).shape == (2,)


def test_redundant_motors_hold_the_assembled_configuration() -> None:
    model = linearize("two_ur5", "assembled")
    assert len(model.states) == 12
    assert len(model.inputs) == 12
    assert np.abs(np.linalg.eigvals(model.A)).max() < 1e3


def test_the_error_names_motors_that_cannot_hold_a_configuration(tmp_path: Path) -> None:
    coupled_four_bar(tmp_path, actuated="actuated = []")
    mechanism = load(str(tmp_path / "mechanism.toml"))
    with pytest.raises(InputError, match=r"nothing holds .* the mechanism has no motors.*along crank"):
        linearize(mechanism, {"crank": 0.9})
    overrides = {"controller": {"type": "set_point", "K_P": 1.0, "K_V": 1.0, "q_d": {"theta_1": -1.2, "theta_3": -1.6},
                              "torque_limit": 1e-3}}  # fmt: skip
    with pytest.raises(InputError, match=r"theta_1 would need .* its limit is 0\.001"):
        linearize("five_bar/swing", {"theta_1": -1.0, "theta_3": -1.9}, overrides)


def test_the_model_at_a_time_has_the_state_of_the_run() -> None:
    model = linearize("five_bar/tracking", 1.25)
    run = simulate("five_bar/tracking", {"t_end": 1.25})
    agree(model.q_tree, run.q_tree[-1])
    agree(model.A, linearize_appendix(run.q_tree[-1], run.v_tree[-1][[0, 2]], run.tau[-1])[0], 1e-9)
    assert isinstance(model, LinearModel)
    assert model.closed_loop is not None
    assert np.linalg.eigvals(model.closed_loop).real.max() < 0


@pytest.mark.parametrize("t", [-1.0, 2.5])
def test_a_time_outside_the_run_is_rejected(t: float) -> None:
    with pytest.raises(InputError, match=r"outside the run of five_bar/swing, which lasts from 0 to 2 s"):
        linearize("five_bar/swing", t)


def test_times_of_mechanisms_and_of_stopped_runs_are_rejected() -> None:
    with pytest.raises(InputError, match=r"a mechanism has no time"):
        linearize(load("five_bar"), 1.0)
    with pytest.raises(InputError, match=r"give \"equilibrium\""):
        linearize("five_bar", "there")
    event = {"coordinate": "theta_1", "of": "q_dot", "value": -0.5, "stop": True}
    with pytest.raises(InputError, match=r"ends at t = 0\..* s: stopped by the event"):
        linearize("five_bar/swing", 1.9, {"event": [event]})


@pytest.mark.parametrize("at", [np.array(0.5), 10**400, float("inf"), True, None, "2.0"])
def test_an_argument_that_is_not_a_state_is_rejected(at: Any) -> None:
    with pytest.raises(InputError, match=r"give \"equilibrium\", \"assembled\", \"target\", a time"):
        linearize("five_bar/swing", at)
