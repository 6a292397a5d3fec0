"""Returns of controllers: arrays, tables by coordinate or motor, and numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, Run, Scene, Simulator, Terms, load, simulate
from ckc_pin.mechanism.library import library
from tests.conftest import assert_close

START = {"q": {"theta_1": -1.2, "theta_3": -1.9}}


@pytest.fixture(scope="module")
def five_bar() -> Mechanism:
    return load("five_bar")


def assert_same_runs(run: Run, other: Run) -> None:
    """Compare the motion and the forces bit for bit."""
    for name in ("q_tree", "v_tree", "u", "tau"):
        np.testing.assert_array_equal(getattr(run, name), getattr(other, name), err_msg=name)


class Torques:
    """A torque controller that returns what it is made with."""

    def __init__(self, result: Any) -> None:
        self.result = result

    def tau(self, t: float, terms: Terms) -> Any:
        return self.result


def test_controller_returns_a_table_by_coordinate_or_motor(five_bar: Mechanism) -> None:
    expected = simulate(five_bar, t_end=0.05, initial=START, controller=lambda t, terms: np.array([0.3, 0.0]))
    for controller in (
        lambda t, terms: {"theta_1": 0.3},
        lambda t, terms: {"theta_3": 0.0, "theta_1": np.float64(0.3)},
    ):
        assert_same_runs(simulate(five_bar, t_end=0.05, initial=START, controller=controller), expected)
    by_motor = simulate(five_bar, t_end=0.05, initial=START, controller=Torques({"theta_1": 0.3}))
    assert_close(by_motor.q_tree, expected.q_tree, 1e-9)
    simulator = Simulator("five_bar/swing", {"initial": START, "formulation": "reduced"})
    assert_close(
        simulator.step({"theta_1": 0.3}, 0.05).q_tree,
        expected.mechanism.tree.from_coordinates(expected.q_tree[-1]),
        1e-9,
    )


def test_controller_returns_a_number_with_one_freedom() -> None:
    crank = load("slider_crank")
    assert crank.independent == ("crank",)
    runs = [
        simulate(crank, t_end=0.05, controller=lambda t, terms, x=x: x)  # type: ignore[misc]
        for x in (np.array([0.3]), 0.3, np.float64(0.3), np.array(0.3), {"crank": 0.3})
    ]
    for run in runs[1:]:
        assert_same_runs(run, runs[0])
    assert_close(simulate(crank, t_end=0.05, controller=Torques(0.3)).tau, 0.3, 1e-15)
    assert_close(Simulator(Scene(crank, t_end=1.0)).step(0.3, 0.05).q, runs[0].q[-1], 1e-9)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (lambda t, terms: {"theta_2": 1.0}, "u: no independent coordinate 'theta_2'; there are theta_1, theta_3"),
        (lambda t, terms: {"theta1": 1.0}, "no independent coordinate 'theta1'.*did you mean 'theta_1'"),
        (lambda t, terms: {"theta_1": None}, "the controller's u: theta_1 = None: expected a number"),
        (lambda t, terms: 1.0, r"the controller's u: expected 2 numbers \(theta_1, theta_3\), got the number 1"),
        (Torques({"theta1": 1.0}), "the controller's tau: no motor 'theta1'; there are .*did you mean 'theta_1'"),
        (Torques({"theta_1": "x"}), "the controller's tau: expected a table of numbers by motor"),
        (Torques(1.0), r"controller's tau: expected 2 numbers \(theta_1, theta_3\), got the number 1"),
    ],
)
def test_wrong_return_of_a_controller_is_named(five_bar: Mechanism, controller: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(five_bar, t_end=0.05, initial=START, controller=controller)


def test_motor_that_is_no_coordinate_is_named_as_such() -> None:
    motors = [{"name": "drive", "joint": "crank", "ratio": 2.0}]
    urdf = (library() / "slider_crank/slider_crank.urdf").read_text()
    spec = load("slider_crank").spec
    mechanism = Mechanism.from_urdf(urdf, loops=spec.loop, q_guess=spec.q_guess, independent=["crank"], motors=motors)
    with pytest.raises(
        InputError, match="no independent coordinate 'drive'; there are crank; motor torques are what a"
    ):
        simulate(mechanism, t_end=0.05, controller=lambda t, terms: {"drive": 1.0})


def test_table_that_depends_on_earlier_calls_is_refused(five_bar: Mechanism) -> None:
    calls: list[float] = []

    def count(t: float, terms: Terms) -> dict[str, float]:
        calls.append(t)
        return {"theta_1": float(len(calls))}

    with pytest.raises(
        InputError, match=r"u returns a dict at t = 0 after a call|must be a function of \(t, terms\) alone"
    ):
        simulate(five_bar, t_end=0.05, initial=START, controller=count)
