"""Of numbers that are zero and may only grow, against extrapolated one-sided differences of tight runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import sensitivities
from tests.sensitivity.changed import TIGHT, written

CLOSE = 1e-6  # of the largest: one-sided differences


def one_sided(scene: str, name: str, overrides: dict[str, Any]) -> Any:
    """From 0 on, by Richardson's extrapolation."""

    def value(x: float) -> Any:
        run = simulate(scene, {**overrides, name: x})
        assert run.status == "done"
        return np.concatenate([run.q_tree, run.v_tree], axis=1)

    zero, h = value(0.0), 4e-4
    one, two, four = ((value(x) - zero) / x for x in (h, h / 2, h / 4))
    return (4 * (2 * four - two) - (2 * two - one)) / 3


def compare(scene: str, name: str, overrides: dict[str, Any]) -> None:
    found = sensitivities(scene, [name], {**overrides, name: 0.0})
    wanted = one_sided(scene, name, overrides)
    assert np.abs(wanted).max() > 1e-3
    ours = np.concatenate([found.q_tree, found.v_tree], axis=1)[:, :, 0]
    assert np.abs(ours - wanted).max() <= CLOSE * np.abs(wanted).max()


@pytest.mark.parametrize("given", [{}, {"link.crank.inertia.izz": 0.02}])
def test_of_a_mass_that_is_changed_to_zero(given: dict[str, Any], tmp_path: Path) -> None:
    """The inertia grows with it as its file's does, but for what is given."""
    compare(written(tmp_path), "link.crank.mass", {**TIGHT, **given})


def test_of_a_mass_whose_inertia_is_given(tmp_path: Path) -> None:
    overrides = {**TIGHT, "link.crank.inertia.izz": 0.02}
    name, h, scene = "link.crank.mass", 2e-3, written(tmp_path)
    found = sensitivities(scene, [name], overrides).v_tree[:, :, 0]
    one, two = ((simulate(scene, {**overrides, name: 1.3 + x}).v_tree
                 - simulate(scene, {**overrides, name: 1.3 - x}).v_tree) / (2 * x) for x in (h, h / 2))  # fmt: skip
    assert np.abs(found - (4 * two - one) / 3).max() <= 1e-8 * np.abs(found).max()


def test_of_friction(tmp_path: Path) -> None:
    """Where it is smoothed; else the joint that turns round would have to be looked for."""
    scene = written(tmp_path)
    compare(scene, "joint.a.friction", {**TIGHT, "friction_smoothing": 0.3})
    with pytest.raises(InputError, match=r"joint\.a\.friction: it is 0.*joint\.a\.friction = 1e-6 in \[parameters\]"):
        sensitivities(scene, ["joint.a.friction"])
