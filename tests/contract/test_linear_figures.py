"""Figures of linear models and root loci: all poles are visible, rounding is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import InputError, Mechanism, Tracking, gain_locus, linearize, load, load_scene, plot, terms
from ckc_pin.scene.parts import build_scene_controller


def test_locus_of_real_poles_shows_no_rounding() -> None:
    locus = gain_locus("five_bar/tracking", "Lambda")
    assert locus is not None
    ax = plot(locus)["locus"].axes[0]
    assert ax.get_ylim()[1] > 0.05 * np.abs(locus.eigenvalues).max()
    assert "at the start of the desired motion" in ax.figure.get_suptitle()
    scene_index = int(np.argmin(np.abs(locus.factors - 1)))
    assert np.array_equal(np.unique(np.round(locus.eigenvalues[scene_index], 6)), np.unique(np.round(_by_hand(), 6)))
    assert "at its target" in plot(gain_locus("five_bar/set_point", "K_V"))["locus"].get_suptitle()
    rubs = gain_locus("talos/squat")
    assert rubs is not None
    assert rubs.at == "at its target without dry friction"
    with pytest.raises(InputError, match=r"'K_I': the controller of five_bar/set_point has K_P and K_V"):
        gain_locus("five_bar/set_point", "K_I")


def _by_hand() -> np.ndarray:
    """Eigenvalues of tracking at its start: those of D r_dot = -(C + K_D) r and of e_dot = r - Lambda e."""
    scene = load_scene("five_bar/tracking")
    mechanism = load("five_bar")
    law = build_scene_controller(scene, mechanism)
    assert isinstance(law, Tracking)
    q, q_dot, _ = law.desired(0.0)
    at = terms(mechanism, dict(zip(mechanism.independent, q, strict=True)),
               dict(zip(mechanism.independent, q_dot, strict=True)))  # fmt: skip
    outer = np.linalg.eigvals(-np.linalg.solve(at.D, at.C + law.K_D))
    return np.concatenate([outer, np.linalg.eigvals(-law.Lambda)])


def test_separated_poles_are_visible_and_coincident_ones_counted(tmp_path: Path) -> None:
    ax = plot(linearize(_stiff_and_free(tmp_path)))["poles"].axes[0]
    assert ax.get_yscale() == "symlog"
    assert [text.get_text() for text in ax.texts] == ["×2"]
    assert plot(linearize("five_bar"))["poles"].axes[0].get_yscale() == "linear"


def _stiff_and_free(folder: Path) -> Mechanism:
    """Three masses on a line: one on a spring of 1e8 N/m, one on a spring of 1 N/m, one on none."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    parts = "".join(
        f'<link name="m{k}">{inertial}</link>'
        f'<joint name="{k}" type="prismatic"><parent link="base"/><child link="m{k}"/>'
        '<axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'
        for k in "abc"
    )
    (folder / "it.urdf").write_text(f'<robot name="it"><link name="base"/>{parts}</robot>')
    springs = "".join(f'[[spring]]\njoint = "{k}"\nstiffness = {c}\n' for k, c in (("a", 1e8), ("b", 1.0)))
    (folder / "mechanism.toml").write_text(f'name = "it"\nurdf = "it.urdf"\n{springs}')
    return load(str(folder / "mechanism.toml"))


def test_oscillating_modes_are_drawn_first(tmp_path: Path) -> None:
    figure = plot(linearize(_stiff_and_free(tmp_path)))["modes"]
    assert [ax.get_title(loc="left")[:2] for ax in figure.axes] == ["3:", "4:"]
    assert "2 rigid not shown" in figure.get_suptitle()
    figure.canvas.draw()
    label = figure._supxlabel.get_window_extent()
    assert figure.bbox.x0 <= label.x0 < label.x1 <= figure.bbox.x1


def test_repr_of_a_locus_is_short() -> None:
    matches = gain_locus("five_bar/set_point", "K_V")
    lines = repr(matches).splitlines()
    assert lines[0].startswith("GainLocus of five_bar/set_point, ")
    assert 3 <= len(lines) <= 8
    assert any(line.split()[:3] == ["K_V", "times", "1"] for line in lines)


def test_results_that_cannot_be_drawn_or_played_are_rejected() -> None:
    model, scene = linearize("five_bar"), load_scene("five_bar/set_point")
    with pytest.raises(InputError, match="give each other result alone"):
        plot(model, model)
    with pytest.raises(InputError, match=r"controller.K_P = 'x': expected a number"):
        gain_locus(scene, overrides={"controller.K_P": "x"})
    for number in ("a", 0, 1.5, None, 3):
        with pytest.raises(InputError, match="five_bar has modes 1 to 2"):
            model.animate_mode(number)  # type: ignore[arg-type]
