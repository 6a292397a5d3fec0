"""Figures of runs, compared with closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

import ckc_pin
from ckc_pin.view.figures import draw_runs, plot_runs
from ckc_pin.view.style import coordinate_symbol, label_runs
from tests.contract.sketches import ARM, FOUR_BAR, FOUR_BAR_LOOP, write_scene

BLUE, VERMILLION = to_rgb("#0072B2"), to_rgb("#D55E00")
L_PROXIMAL, L_DISTAL, BASE = 0.2794, 0.3048, 0.3048  # of five_bar


@pytest.fixture(scope="session")
def tracking(run: Callable[..., ckc_pin.Run]) -> list[ckc_pin.Run]:
    return [run("five_bar/tracking", formulation=name) for name in ("spf", "reduced")]


@pytest.fixture(scope="session")
def set_point(run: Callable[..., ckc_pin.Run]) -> ckc_pin.Run:
    return run("five_bar/set_point")


@pytest.fixture(scope="module")
def fig_4(tracking):
    return draw_runs(tracking)


@pytest.fixture(scope="module")
def fig_3(set_point):
    return draw_runs(set_point)


@pytest.fixture(scope="module")
def motion(swing):
    return draw_runs(swing)


def lines(ax, colour=None, style=None):
    """Lines of an axes with their (x, y), by colour and line style."""
    result = [
        line
        for line in ax.get_lines()
        if (colour is None or np.allclose(to_rgb(line.get_color()), to_rgb(colour)))
        and (style is None or line.get_linestyle() == style)
    ]
    return [np.array(line.get_data(), dtype=float) for line in result]


# --- Fig. 4 --------------------------------------------------------------------------------------


def test_fig_4_has_the_papers_panels(fig_4):
    figure = fig_4["tracking"]
    space, torques, angles, velocities = figure.axes
    assert [ax.get_title(loc="left")[:2] for ax in figure.axes] == ["a)", "b)", "c)", "d)"]
    assert (space.get_xlabel(), space.get_ylabel()) == (r"$\theta_{1}$ (rad)", r"$\theta_{3}$ (rad)")
    assert torques.get_ylabel() == "$u$ (N m)"
    assert angles.get_ylabel() == "$q$ (rad)"
    assert velocities.get_ylabel() == r"$\dot q$ (rad/s)"


def test_desired_ellipse_and_dots_agree_with_equation_21(fig_4):
    space, _, angles, velocities = fig_4["tracking"].axes
    (ellipse,) = lines(space, "black", ":")
    theta_1, theta_3 = ellipse
    np.testing.assert_allclose((theta_1 / (np.pi / 3)) ** 2 + ((np.pi / 4 - theta_3) / (np.pi / 4)) ** 2, 1, atol=1e-12)
    dots_1, dots_3 = lines(angles, "black", "None")
    np.testing.assert_allclose(dots_1[1], np.pi / 3 * np.sin(dots_1[0]), atol=1e-12)
    np.testing.assert_allclose(dots_3[1], np.pi / 4 * (1 - np.cos(dots_3[0])), atol=1e-12)
    rates_1, rates_3 = lines(velocities, "black", "None")
    np.testing.assert_allclose(rates_1[1], np.pi / 3 * np.cos(rates_1[0]), atol=1e-12)
    np.testing.assert_allclose(rates_3[1], np.pi / 4 * np.sin(rates_3[0]), atol=1e-12)


def test_spf_is_dashed_and_reduced_solid_in_equal_colours(tracking, fig_4):
    spf, reduced = tracking
    ax = fig_4["tracking"].axes[2]
    drawn = [line for line in ax.get_lines() if line.get_linestyle() != "None"]
    assert [line.get_linestyle() for line in drawn] == ["-", "-", "--", "--"]  # later ones lie on earlier ones
    assert [to_rgb(line.get_color()) for line in drawn] == [BLUE, VERMILLION, BLUE, VERMILLION]
    for line, run, column in zip(drawn, (reduced, reduced, spf, spf), (0, 2, 0, 2), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), run.q_tree[:, column])


def test_note_compares_torque_maxima_with_the_paper(fig_4):
    ax = fig_4["tracking"].axes[1]
    (note,) = [text.get_text() for text in ax.texts]
    assert "24.8 N m (paper: ≤ 30)" in note
    assert "1.35 N m (paper: ≤ 5)" in note
    assert "▲ 24.8 at 0 s" in note  # the peak at the start does not hide the rest
    assert 1.3 < ax.get_ylim()[1] < 1.8


def test_legend_covers_no_panel(fig_4, fig_3, motion):
    for name, figure in {**fig_4, **fig_3, **motion}.items():
        if figure.legends:  # not snapshots of one run
            assert_legends_apart(figure, name)


def assert_legends_apart(figure, name=""):
    """No legend lies on an axes or beyond the page, and no axes on a title."""
    figure.draw_without_rendering()
    panels = [ax.get_tightbbox() for ax in figure.axes]
    boxes = [legend.get_window_extent() for legend in figure.legends]
    for box in boxes:
        assert not any(panel.overlaps(box) for panel in panels), name
    boxes += [ax.get_legend().get_window_extent() for ax in figure.axes if ax.get_legend()]
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1, name
        assert not [ax for ax in figure.axes if ax.get_window_extent().shrunk(0.99, 0.99).overlaps(box)], name
    title = figure._suptitle.get_window_extent()
    assert not any(panel.overlaps(title) for panel in panels), name


def test_csv_trajectory_is_rebuilt_from_a_saved_run(tmp_path):
    t = np.linspace(0.0, 0.3, 31)
    table = np.column_stack([t, -1.43 + 0.1 * np.sin(t), -1.70 + 0.1 * t**2])
    name = "desired.csv"
    folder = Path(str(tmp_path / "model"))
    folder.mkdir()
    np.savetxt(folder / name, table, delimiter=",", header="t,theta_1,theta_3", comments="")
    (folder / "x.scene.toml").write_text(
        'mechanism = "five_bar"\nformulation = "reduced"\nt_end = 0.3\n[initial]\nat = "equilibrium"\n'
        f'[controller]\ntype = "tracking"\nLambda = 1.0\nK_D = 10.0\n[controller.desired]\nfile = "{name}"\n'
    )
    saved = ckc_pin.simulate(folder / "x.scene.toml").save(tmp_path / "run.npz")
    (folder / name).unlink()
    dots_1, dots_3 = lines(draw_runs(ckc_pin.Run.load(saved))["tracking"].axes[2], "black", "None")
    np.testing.assert_allclose(dots_1[1], -1.43 + 0.1 * np.sin(dots_1[0]), atol=1e-9)
    np.testing.assert_allclose(dots_3[1], -1.70 + 0.1 * dots_3[0] ** 2, atol=1e-9)


# --- Fig. 3 --------------------------------------------------------------------------------------


def elbows_and_tip(theta_1: float, theta_3: float) -> np.ndarray:
    """Joint positions of the five-bar from its two angles, the tip on the side that det phi_z > 0 has."""
    left = L_PROXIMAL * np.array([np.cos(theta_1), np.sin(theta_1)])
    right = np.array([BASE, 0.0]) + L_PROXIMAL * np.array([np.cos(theta_3), np.sin(theta_3)])
    between = right - left
    gap = np.linalg.norm(between)
    below = np.array([between[1], -between[0]]) / gap
    return np.array([left, right, 0.5 * (left + right) + below * np.sqrt(L_DISTAL**2 - 0.25 * gap**2)])


@pytest.mark.parametrize(
    ("colour", "angles"),
    [(BLUE, (-1.43430851, -1.70733217)), (VERMILLION, (np.pi / 4, np.pi / 4))],
    ids=["initial", "desired"],
)
def test_fig_3a_shows_initial_and_desired_linkages(fig_3, colour, angles):
    ax = fig_3["set_point"].axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x$ (m)", "$y$ (m)")
    ends = np.hstack(lines(ax, colour)).T
    for joint in [[0.0, 0.0], [BASE, 0.0], *elbows_and_tip(*angles)]:
        assert np.linalg.norm(ends - joint, axis=1).min() < 1e-7
    lengths = [np.linalg.norm(line[:, 1] - line[:, 0]) for line in lines(ax, colour, "-")]
    np.testing.assert_allclose(sorted(lengths), [L_PROXIMAL, L_PROXIMAL, L_DISTAL, L_DISTAL], atol=1e-12)


def test_fig_3_errors_are_q_minus_q_d(set_point, fig_3):
    _, _, errors, rates = fig_3["set_point"].axes
    assert errors.get_ylabel() == "$q - q_d$ (rad)"
    np.testing.assert_array_equal(lines(errors, BLUE)[0][1], set_point.q_tree[:, 0] - np.pi / 4)
    np.testing.assert_array_equal(lines(rates, VERMILLION)[0][1], set_point.v_tree[:, 2])


def test_checks_show_residual_energy_and_lyapunov_function(set_point, fig_3):
    residual, forces, energy, lyapunov = fig_3["set_point_checks"].axes
    assert residual.get_yscale() == lyapunov.get_yscale() == "log"
    drawn = lines(residual)[0][1]
    expected = np.abs(set_point.phi - set_point.w).max(axis=1)
    np.testing.assert_array_equal(drawn[expected > 0], expected[expected > 0])
    np.testing.assert_array_equal(lines(energy)[0][1], set_point.energy)
    loop = set_point.loop_forces()["elbow"]
    np.testing.assert_allclose(lines(forces)[0][1], np.hypot(*loop.T), rtol=1e-12)
    assert forces.get_title(loc="left") == "b)  force in loop elbow"
    assert forces.get_legend() is None
    shown = lines(lyapunov)[0][1]
    np.testing.assert_array_equal(shown[:30], set_point.lyapunov[:30])


# --- anything else -------------------------------------------------------------------------------


def test_motion_figure_shows_energy_drift_and_residual(swing, motion):
    assert list(motion) == ["motion", "motion_snapshots"]
    joints, rates, drift, residual = motion["motion"].axes
    assert len(lines(joints)) == len(lines(rates)) == 4
    power = int(drift.get_ylabel().split("{")[1].split("}")[0])
    np.testing.assert_allclose(lines(drift)[0][1] * 10.0**power, swing.energy - swing.energy[0], rtol=1e-12)
    assert residual.get_yscale() == "log"


def test_snapshots_are_poses_at_equal_times(swing, motion):
    poses, forces, colours = motion["motion_snapshots"].axes
    assert colours.get_ylabel() == "$t$ (s)"
    assert forces.get_ylabel() == r"$|\lambda|$ (N)"
    ends = np.hstack([line for line in lines(poses, style="-") if line.shape == (2, 2)]).T
    for t in np.linspace(0.0, 2.0, 5):
        q = swing.q_tree[swing.at(t)]
        for foot, angle in ((0.0, q[0]), (BASE, q[2])):
            elbow = [foot + L_PROXIMAL * np.cos(angle), L_PROXIMAL * np.sin(angle)]
            assert np.linalg.norm(ends - elbow, axis=1).min() < 1e-12


def test_loop_forces_use_rows_in_metres(tmp_path):
    run = ckc_pin.simulate("three_rrr", {"t_end": 0.02})
    figure = draw_runs(run)["motion_snapshots"]
    shown = [line[1] for line in lines(figure.axes[1], style="-") if len(line[1]) == len(run.t)]
    forces = run.loop_forces()
    assert len(shown) == len(forces)
    for drawn, loop in zip(shown, forces.values(), strict=True):
        np.testing.assert_allclose(drawn, np.linalg.norm(loop[:, :2], axis=1), rtol=1e-12)


def test_one_freedom_gets_a_phase_plane(tmp_path):
    control = """
[initial.q]
alpha = -0.5
[controller]
type = "tracking"
Lambda = 2.0
K_D = 5.0
[controller.desired.alpha]
offset = 0.5
harmonics = [[0.3, 5.0, 0.0]]
"""
    run = ckc_pin.simulate(write_scene(tmp_path / "four_bar", FOUR_BAR, FOUR_BAR_LOOP, control))
    space = draw_runs(run)["tracking"].axes[0]
    assert "phase plane" in space.get_title(loc="left")
    assert (space.get_xlabel(), space.get_ylabel()) == (r"$\alpha$ (rad)", r"$\dot{\alpha}$ (rad/s)")
    (desired,) = lines(space, "black", ":")
    np.testing.assert_allclose(((desired[0] - 0.5) / 0.3) ** 2 + (desired[1] / 1.5) ** 2, 1.0, atol=1e-12)


def test_three_freedoms_with_a_slide_have_an_axes_for_each_unit(tmp_path):
    control = """
[initial.q]
turn = 0.3
lift = -0.2
"reach$/1" = 0.05
[controller]
type = "set_point"
K_P = 60.0
K_V = 9.0
[controller.q_d]
turn = 0.6
lift = 0.1
"reach$/1" = 0.1
"""
    run = ckc_pin.simulate(write_scene(tmp_path / "arm", ARM, "", control))
    linkage, torques, forces, angles, lengths, rates, speeds = draw_runs(run)["set_point"].axes
    assert (torques.get_ylabel(), forces.get_ylabel()) == ("$u$ (N m)", "$u$ (N)")
    assert "torques and forces" in torques.get_title(loc="left")
    assert (angles.get_ylabel(), lengths.get_ylabel()) == ("$q - q_d$ (rad)", "$q - q_d$ (m)")
    assert (rates.get_ylabel(), speeds.get_ylabel()) == (r"$\dot q$ (rad/s)", "reach\\$/1 rate (m/s)")
    error = run.q_tree[:, run.column("reach$/1")] - 0.1
    np.testing.assert_allclose(lines(lengths)[0][1], error, atol=1e-15)
    assert len(lines(linkage, VERMILLION, "-")) == 2  # a and c, the rod of the slide; b is its cylinder
    (sleeve, _) = linkage.patches  # of the initial pose and of the desired one, on a moving body
    assert np.ptp(sleeve.get_xy(), axis=0).max() > 0
    written = plot_runs(run, tmp_path / "out")  # the residual of no loop is zero: no logarithm
    assert {path.stem for path in written} == {"set_point", "set_point_checks", "set_point_snapshots"}


def test_python_controller_gets_the_tracking_layout(tmp_path):
    class Damper:
        def u(self, t, terms):
            return -0.2 * terms.q_dot

    run = ckc_pin.simulate("five_bar/swing", {"formulation": "reduced", "t_end": 0.2}, controller=Damper())
    figures = draw_runs(run)
    assert list(figures) == ["own", "own_checks", "own_snapshots"]
    assert len(figures["own_checks"].axes) == 3  # it has no Lyapunov function
    np.testing.assert_array_equal(lines(figures["own"].axes[1], BLUE)[0][1], run.tau[:, 0])


def test_each_mechanism_gets_its_own_figure(swing, tmp_path):
    other = ckc_pin.simulate("five_bar_as_printed/swing", {"t_end": 0.1})
    stems = ["five_bar_motion", "five_bar_as_printed_motion"]
    assert list(draw_runs([swing, other])) == [f"{stem}{more}" for stem in stems for more in ("", "_snapshots")]


def test_run_that_stopped_at_the_start_can_be_drawn(tracking, tmp_path):
    run = tracking[0]
    rows = {name: getattr(run, name)[:1] for name in ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy")}
    stopped = replace(run, status="stopped", lyapunov=run.lyapunov[:1], **rows)
    assert len(plot_runs(stopped, tmp_path)) == 3
    texts = [text.get_text() for text in draw_runs(stopped)["tracking"].texts]
    assert "five_bar/tracking, Fig. 4, eq. 16, SPF, ε = 10⁻⁴ (stopped at 0 s)" in texts


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("theta_1", r"$\theta_{1}$"),
        ("phi", r"$\phi$"),
        ("left_knee", "left_knee"),
        ("a$b", r"a\$b"),
        ("thetas", "thetas"),
    ],
)
def test_greek_names_become_symbols_and_others_are_escaped(name, shown):
    assert coordinate_symbol(name) == shown


def test_run_labels_are_distinct(tracking, swing):
    spf, reduced = tracking
    assert label_runs([reduced, spf]) == ["reduced", "SPF, ε = 10⁻⁴"]
    assert label_runs([reduced, swing]) == ["five_bar/tracking: reduced", "five_bar/swing: DAE"]
    assert label_runs([reduced, reduced]) == ["1. reduced", "2. reduced"]
