"""The figure of how a run changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import ckc_pin
from ckc_pin.sensitivity.sensitivities import sensitivities
from ckc_pin.view.result_figures import draw_sensitivities, save_sensitivities
from tests.sensitivity.changed import written


def test_a_panel_a_parameter_with_the_independent_coordinates(tmp_path: Path) -> None:
    found = sensitivities(written(tmp_path), ["link.crank.mass", "initial.q.a"])
    figure = draw_sensitivities(found)
    assert [ax.get_title("left") for ax in figure.axes] == ["by link.crank.mass", "by initial.q.a"]
    of = r"$\partial q / \partial p$"
    assert [ax.get_ylabel() for ax in figure.axes] == [f"{of} (rad/kg)", f"{of} (rad/rad)"]
    for k, ax in enumerate(figure.axes):
        assert np.array_equal(ax.lines[0].get_ydata(), found.q_tree[:, 0, k])
    (path,) = save_sensitivities(found, tmp_path)
    assert path.name == "sensitivities.png"
    assert path.stat().st_size > 5000


def test_only_the_first_six(tmp_path: Path) -> None:
    found = sensitivities(written(tmp_path), ["gravity", "joint.c.xyz", "initial.q.a", "spring.0.stiffness"])
    labels = {ax.get_title("left"): ax.get_ylabel() for ax in draw_sensitivities(found).axes}
    assert labels["by gravity.y"].endswith(" (rad/(m/s²))")
    assert all(label.endswith(")") for label in labels.values())
    assert list(labels) == [f"by {name}" for name in found.parameters[:6]]
    (figure,) = ckc_pin.plot(found).values()
    assert "the first 6 of 8 parameters" in figure.get_suptitle()
