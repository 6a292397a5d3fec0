"""The figure of sensitivities."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import ckc_pin
from ckc_pin.sensitivity.sensitivities import sensitivities
from ckc_pin.view.result_figures import draw_sensitivities, save_sensitivities
from tests.sensitivity.four_bar import write_four_bar


def test_each_parameter_has_a_panel_with_the_independent_coordinates(tmp_path: Path) -> None:
    result = sensitivities(write_four_bar(tmp_path), ["link.crank.mass", "initial.q.a"])
    figure = draw_sensitivities(result)
    assert [ax.get_title("left") for ax in figure.axes] == ["by link.crank.mass", "by initial.q.a"]
    of = r"$\partial q / \partial p$"
    assert [ax.get_ylabel() for ax in figure.axes] == [f"{of} (rad/kg)", f"{of} (rad/rad)"]
    for k, ax in enumerate(figure.axes):
        assert np.array_equal(ax.lines[0].get_ydata(), result.q_tree[:, 0, k])
    (path,) = save_sensitivities(result, tmp_path)
    assert path.name == "sensitivities.png"
    assert path.stat().st_size > 5000


def test_the_figure_shows_six_parameters_at_most(tmp_path: Path) -> None:
    result = sensitivities(write_four_bar(tmp_path), ["gravity", "joint.c.xyz", "initial.q.a", "spring.0.stiffness"])
    labels = {ax.get_title("left"): ax.get_ylabel() for ax in draw_sensitivities(result).axes}
    assert labels["by gravity.y"].endswith(" (rad/(m/s²))")
    assert all(label.endswith(")") for label in labels.values())
    assert list(labels) == [f"by {name}" for name in result.parameters[:6]]
    (figure,) = ckc_pin.plot(result).values()
    assert "the first 6 of 8 parameters" in figure.get_suptitle()
