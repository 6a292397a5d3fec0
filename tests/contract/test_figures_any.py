"""Figures of other mechanisms: many freedoms, spinning hinges, short peaks, projection planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ckc_pin
from ckc_pin.view.figures import draw_runs
from ckc_pin.view.geometry import projection_planes
from ckc_pin.view.layout import clip_end_peaks
from ckc_pin.view.style import COLOURS, REST_COLOUR
from tests.contract.test_figures import assert_legends_apart, lines


@pytest.fixture(scope="module")
def stewart() -> ckc_pin.Run:
    return ckc_pin.simulate("stewart", {"t_end": 0.1})


@pytest.mark.parametrize(
    ("overrides", "title"),
    [
        ({"joint.crank.damping": 0.0}, "energy drift"),
        ({"joint.crank.damping": 0.1}, "energy change"),
        ({"friction_smoothing": 0.1}, "energy drift"),
        ({"friction_smoothing": 0.1, "joint.crank.friction": 0.1}, "energy change"),
    ],
)
def test_energy_taken_by_dampers_is_not_called_drift(overrides, title):
    """Drift is what an integrator does to an energy that should stay."""
    run = ckc_pin.simulate("slider_crank", {"t_end": 0.05, **overrides})
    titles = [ax.get_title("left") for ax in draw_runs(run)["motion"].axes]
    assert [said for said in titles if "energy" in said] == [f"c)  {title}"]


def test_six_coordinates_have_colours_and_all_have_small_panels(stewart):
    figures = draw_runs(stewart)
    assert list(figures) == ["motion", "motion_snapshots", "motion_coordinates"]
    drawn = [line.get_color() for line in figures["motion"].axes[0].get_lines()]
    assert sorted(drawn) == sorted(COLOURS)  # the legs
    panels = figures["motion_coordinates"].axes
    assert [ax.get_title(loc="right") for ax in panels] == list(stewart.coordinates)
    for ax, column in zip(panels, stewart.q_tree.T, strict=True):
        np.testing.assert_array_equal(lines(ax)[0][1], column)
    assert {ax.get_ylabel() for ax in panels} == {"(rad)", "(m)"}


def test_motors_beyond_the_palette_are_grey_and_drawn_first():
    run = ckc_pin.simulate("two_ur5/lift", {"t_end": 0.05})
    figures = draw_runs(run)
    ax = figures["tracking"].axes[1]
    colours = [line.get_color() for line in ax.get_lines() if len(line.get_xdata()) == len(run.t)]
    assert colours[:6] == [REST_COLOUR] * 6
    assert sorted(colours[6:]) == sorted(COLOURS)
    texts = [text.get_text() for text in figures["tracking"].legends[0].get_texts()]
    assert "6 more" in texts
    assert len(figures["tracking_efforts"].axes) == 12
    for name, figure in figures.items():
        assert_legends_apart(figure, name)


def test_spinning_crank_is_wrapped():
    run = ckc_pin.simulate("four_bar/turning", {"t_end": 1.0})
    crank = run.q_tree[:, run.column("crank")]
    assert np.ptp(crank) > 2 * np.pi
    ax = draw_runs(run)["motion"].axes[0]
    shown = lines(ax, COLOURS[0])[0][1]
    kept = np.isfinite(shown)
    assert np.abs(shown[kept]).max() <= np.pi
    np.testing.assert_allclose(np.exp(1j * shown[kept]), np.exp(1j * crank[kept]), atol=1e-12)
    assert 0 < np.sum(~kept) <= np.ptp(crank) / np.pi  # once a turn the pen is lifted
    assert [text.get_text() for text in ax.texts] == [r"crank, coupler: wrapped to $±π$"]
    many = draw_runs(replace(run, q_tree=run.q_tree * 40))["motion"].axes
    assert "turns" in " ".join(ax.get_ylabel() for ax in many)


def test_axis_is_clipped_only_for_a_short_peak_at_an_end():
    from matplotlib.figure import Figure

    t = np.linspace(0.0, 10.0, 1001)
    calm = np.sin(t)[:, None]
    for at, said in ((0, "▲ 50 at 0 s"), (1000, "▲ 50 at 10 s"), (500, "")):
        peaked = calm.copy()
        peaked[at] = 50.0
        ax = Figure().add_subplot()
        assert clip_end_peaks(ax, [(t, peaked)], 10.0) == said
        assert not said or 1.0 < ax.get_ylim()[1] < 1.5
    peaked = -2.0 - calm
    peaked[0] = -1e16
    ax = Figure().add_subplot()
    assert clip_end_peaks(ax, [(t, peaked)], 10.0) == "▼ -1e+16 at 0 s"
    assert clip_end_peaks(ax, [(t, calm)], 10.0) == ""
    assert clip_end_peaks(ax, [(t[:1], calm[:1])], 10.0) == ""
    assert clip_end_peaks(ax, [(t, np.full_like(calm, np.nan))], 10.0) == ""


def test_spatial_mechanisms_are_drawn_on_coordinate_planes(stewart):
    shown = projection_planes(stewart.mechanism)
    assert [(plane.title, plane.names) for plane in shown] == [
        ("front", ("$x$", "$z$")), ("side", ("$y$", "$z$")), ("top", ("$x$", "$y$")),
    ]  # fmt: skip
    front, side, top, *_ = draw_runs(stewart)["motion_snapshots"].axes
    assert [(ax.get_xlabel(), ax.get_ylabel()) for ax in (front, side, top)] == [
        ("$x$ (m)", "$z$ (m)"), ("$y$ (m)", "$z$ (m)"), ("$x$ (m)", "$y$ (m)"),
    ]  # fmt: skip
    assert len(front.patches) == 5 * (6 + 1)  # in each pose a cylinder on each leg, and the platform


def test_slider_is_drawn_on_its_rail():
    run = ckc_pin.simulate("slider_crank", {"t_end": 0.2})
    ax = draw_runs(run)["motion_snapshots"].axes[0]
    way = run.q_tree[:, run.column("slider")]
    middles = [patch.get_xy()[:4].mean(axis=0) for patch in ax.patches]
    expected = [way[run.at(float(t))] for t in np.linspace(0.0, 0.2, 5)]
    np.testing.assert_allclose([x for x, _ in middles], expected, atol=1e-12)
    (rail,) = [line for line in ax.get_lines() if line.get_marker() == "|"]
    assert rail.get_xdata().min() < min(expected)
    assert rail.get_xdata().max() > max(expected)


def test_paper_is_cited_for_its_scenes_only(stewart):
    figure = draw_runs(ckc_pin.simulate("five_bar/set_point", {"t_end": 0.02}))["set_point"]
    assert "Fig. 3, eq. 14" in " ".join(text.get_text() for text in figure.texts)
    other = draw_runs(ckc_pin.simulate("delta/circle", {"t_end": 0.02}))["tracking"]
    words = " ".join([*(text.get_text() for text in other.texts), *(ax.get_title(loc="left") for ax in other.axes)])
    assert not {"eq.", "paper", "Fig."} & set(words.replace(",", " ").split())


def test_prescribed_joints_are_drawn_with_all_coordinates_and_the_torque():
    """The crank was the only freedom, so no coordinate is independent."""
    run = ckc_pin.simulate("slider_crank/driven", {"t_end": 0.1})
    figures = draw_runs(run)
    assert list(figures) == ["prescribed", "prescribed_checks", "prescribed_snapshots"]
    energy, torque, angles, position, angle_rates, rate = figures["prescribed"].axes
    for ax, names in ((angles, ["crank", "rod"]), (position, ["slider"]), (angle_rates, ["v.crank", "v.rod"]),
                      (rate, ["v.slider"]), (torque, ["tau.crank"]), (energy, ["energy"])):  # fmt: skip
        for (_, values), name in zip(lines(ax), names, strict=True):
            np.testing.assert_array_equal(values, run[name], err_msg=name)


def test_joint_servos_are_drawn_in_the_phase_plane_with_their_torque():
    run = ckc_pin.simulate("four_bar/servo", {"t_end": 0.1})
    figures = draw_runs(run)
    assert list(figures) == ["joint_servo", "joint_servo_checks", "joint_servo_snapshots"]
    plane, torque, angle, rate = figures["joint_servo"].axes
    x, y = lines(plane)[0]
    np.testing.assert_array_equal([x, y], [run["crank"], run["v.crank"]])
    for ax, name in ((torque, "tau.crank"), (angle, "crank"), (rate, "v.crank")):
        np.testing.assert_array_equal(lines(ax)[0][1], run[name], err_msg=name)
