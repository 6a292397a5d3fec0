"""Controllers of a user's own that remember something: refused as functions of (t, terms), and run once a sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ckc_pin import InputError, Sampled, Terms, simulate
from tests.conftest import assert_close

Array = NDArray[np.float64]
SCENE = {"formulation": "reduced", "t_end": 0.5}
TARGET = np.array([-1.4, -1.7])


class Pid:
    """The PID controller that people write first: its integral depends on when it was called."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.integral, self.last = np.zeros(2), 0.0

    def u(self, t: float, terms: Terms) -> Array:
        error = terms.q - TARGET
        self.integral = self.integral + error * (t - self.last)
        self.last = t
        return np.asarray(-20.0 * error - 2.0 * terms.q_dot - 30.0 * self.integral)


class Noisy:
    def __init__(self) -> None:
        self.random = np.random.default_rng(3)

    def tau(self, t: float, terms: Terms) -> Array:
        return self.random.normal(size=2)


@pytest.mark.parametrize("controller", [Pid(), Noisy()])
def test_controller_with_memory_is_refused_with_a_remedy(controller: Any) -> None:
    with pytest.raises(
        InputError, match=r"function of \(t, terms\) alone.*ckc_pin\.Sampled\(controller, sample_time\)"
    ):
        simulate("five_bar/swing", SCENE, controller=controller)


def test_function_of_the_state_is_not_refused() -> None:
    calls: list[float] = []

    def damper(t: float, terms: Terms) -> Array:
        calls.append(t)
        return np.asarray(np.sin(t) - 0.5 * terms.q_dot)

    assert simulate("five_bar/swing", SCENE, controller=damper).status == "done"
    assert calls[0] == 0.0


def test_sampled_controller_starts_afresh_in_each_run() -> None:
    controller = Sampled(Pid(), sample_time=0.005)
    first, second = (simulate("five_bar/swing", SCENE, controller=controller) for _ in range(2))
    assert_close(second.q_tree, first.q_tree, 0.0)
    assert np.abs(first.u).max() > 0.0
    third = simulate("five_bar/swing", SCENE, controller=Sampled(Pid(), sample_time=0.005))
    assert_close(third.q_tree, first.q_tree, 0.0)


def test_error_of_a_controller_is_reported_by_the_run() -> None:
    def broken(t: float, terms: Terms) -> Array:
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        simulate("five_bar/swing", SCENE, controller=broken)
