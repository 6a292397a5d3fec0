"""Closed configurations at places of a path, against the closed form of the five-bar."""

from __future__ import annotations

import numpy as np
import pytest

import ckc_pin
from ckc_pin.optimization.along_path import follow_places, path_dynamics
from ckc_pin.optimization.path import make_path
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import PathSpec
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import assert_close


@pytest.mark.parametrize("has_start", [False, True])
@pytest.mark.parametrize("fails_together", [False, True])
def test_places_of_a_path_are_closed(has_start: bool, fails_together: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Places are closed from known ones together; if that fails, the path is followed from its beginning."""
    mechanism = ckc_pin.load("five_bar")
    path = make_path(PathSpec(q={"theta_1": [-1.434, -1.2, -1.0], "theta_3": [-1.707, -1.6, -1.9]}), mechanism)
    dynamics, s = ReducedDynamics(mechanism), np.linspace(0.0, 1.0, 41)
    closed = path_dynamics(dynamics, path, s[::8]) if has_start else None
    close, calls = dynamics.close, []

    def close_or_fail(q_tree: Array, q: Array, *step: float) -> Array | None:
        calls.append(len(q))
        return None if fails_together and len(calls) == 1 else close(q_tree, q, *step)

    monkeypatch.setattr(dynamics, "close", close_or_fail)
    q_tree = follow_places(dynamics, path, s, closed)
    assert (calls == [len(s)]) == (has_start and not fails_together)
    for configuration, q in zip(q_tree, path.q(s)[0], strict=True):
        assert_close(np.angle(np.exp(1j * (configuration - FIVE_BAR.sigma(q)))), 0, 1e-12)
