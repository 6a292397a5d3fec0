"""The fastest motion of a bead on two crossed rails in gravity has a closed form: each rail's motor is bang-bang."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import optimize
from tests.optimization.small_models import GRAVITY, MASS, require_replay, table


def test_the_slower_rail_determines_the_duration() -> None:
    """Upwards, the acceleration is F / m - g, and F / m + g when braking."""
    force, height = 40.0, 0.6
    up, down = force / MASS - GRAVITY, force / MASS + GRAVITY
    duration = np.sqrt(2 * height * (1 / up + 1 / down))
    plan = optimize(table(), to={"q": {"x": 0.1, "y": height}}, limits={"torque": force}, intervals=100)
    assert plan.t_end == pytest.approx(duration, rel=1e-4)
    require_replay(plan, force)
