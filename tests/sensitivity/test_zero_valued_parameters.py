"""Parameters that are zero and cannot be negative, against extrapolated one-sided differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.sensitivity.sensitivities import sensitivities
from tests.sensitivity.four_bar import TIGHT, write_four_bar

TOLERANCE = 1e-6  # relative to the largest, of one-sided differences


def one_sided(scene: str, name: str, overrides: dict[str, Any]) -> Any:
    """One-sided derivative at 0, by Richardson extrapolation."""

    def value(x: float) -> Any:
        run = simulate(scene, {**overrides, name: x})
        assert run.status == "done"
        return np.concatenate([run.q_tree, run.v_tree], axis=1)

    zero, h = value(0.0), 4e-4
    one, two, four = ((value(x) - zero) / x for x in (h, h / 2, h / 4))
    return (4 * (2 * four - two) - (2 * two - one)) / 3


def compare(scene: str, name: str, overrides: dict[str, Any]) -> None:
    result = sensitivities(scene, [name], {**overrides, name: 0.0})
    expected = one_sided(scene, name, overrides)
    assert np.abs(expected).max() > 1e-3
    ours = np.concatenate([result.q_tree, result.v_tree], axis=1)[:, :, 0]
    assert np.abs(ours - expected).max() <= TOLERANCE * np.abs(expected).max()


@pytest.mark.parametrize("inertia", [{}, {"link.crank.inertia.izz": 0.02}])
def test_a_mass_that_is_set_to_zero(inertia: dict[str, Any], tmp_path: Path) -> None:
    """The inertia scales with the mass as in the file, except for entries that are set."""
    compare(write_four_bar(tmp_path), "link.crank.mass", {**TIGHT, **inertia})


def test_a_mass_whose_inertia_is_set(tmp_path: Path) -> None:
    overrides = {**TIGHT, "link.crank.inertia.izz": 0.02}
    name, h, scene = "link.crank.mass", 2e-3, write_four_bar(tmp_path)
    result = sensitivities(scene, [name], overrides).v_tree[:, :, 0]
    one, two = ((simulate(scene, {**overrides, name: 1.3 + x}).v_tree
                 - simulate(scene, {**overrides, name: 1.3 - x}).v_tree) / (2 * x) for x in (h, h / 2))  # fmt: skip
    assert np.abs(result - (4 * two - one) / 3).max() <= 1e-8 * np.abs(result).max()


def test_friction_must_be_smoothed_if_it_is_zero(tmp_path: Path) -> None:
    """Without friction, stick-slip events are not monitored."""
    scene = write_four_bar(tmp_path)
    compare(scene, "joint.a.friction", {**TIGHT, "friction_smoothing": 0.3})
    with pytest.raises(InputError, match=r"joint\.a\.friction is 0.*joint\.a\.friction = 1e-6 in \[parameters\]"):
        sensitivities(scene, ["joint.a.friction"])
