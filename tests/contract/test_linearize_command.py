"""`ckc linearize`: JSON, files, playback of modes, errors; the LQR example."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Run, check, floquet, gain_locus, linearize, plot
from ckc_pin.linear.mode_animation import animate_modes
from tests.analytic.small_models import plate_on_springs
from tests.contract.helpers.command import ckc

ROOT = Path(__file__).resolve().parents[2]
KEYS = ["name", "states", "inputs", "outputs", "A", "B", "C", "D", "eigenvalues", "modes", "at", "locked",
        "closed_loop", "notes"]  # fmt: skip
FALLING = """<robot name="falling"><link name="base"/>
<link name="stone"><inertial><mass value="1.0"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="fall" type="prismatic"><parent link="base"/><child link="stone"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="1" velocity="1"/></joint></robot>
"""


def test_json_has_labels_and_matrices() -> None:
    result = ckc("linearize", "five_bar", "--at", "equilibrium", "--json").json
    assert list(result) == KEYS
    model = linearize("five_bar")
    for name in "ABCD":
        assert np.array_equal(result[name], getattr(model, name))
    assert result["states"] == ["theta_1", "theta_3", "v.theta_1", "v.theta_3"]
    assert result["inputs"] == ["tau.theta_1", "tau.theta_3"]
    assert [complex(*x) for x in result["eigenvalues"]] == model.eigenvalues.tolist()
    assert result["at"]["q_tree"] == model.q_tree.tolist()
    assert result["at"]["t"] is None
    shape = result["modes"][0]["shape"]
    assert max(abs(complex(*x)) for x in shape.values()) == pytest.approx(1.0)
    assert result["closed_loop"] is None


def test_linearization_at_a_time_includes_the_closed_loop() -> None:
    result = ckc("linearize", "five_bar/set_point", "--at", "0.5", "--json").json
    assert result["at"]["t"] == 0.5
    assert len(result["closed_loop"]["A"]) == 4
    assert max(re for re, _ in result["closed_loop"]["eigenvalues"]) < 0
    assert any("plant" in note for note in result["notes"])


def test_text_output_fits_one_screen() -> None:
    answer = ckc("linearize", "stewart")
    assert answer.code == 0
    assert "1.503 Hz, damping ratio 0" in answer.out
    assert len(answer.out.splitlines()) < 25


def test_out_writes_model_figures_and_modes_to_play(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    assert (
        ckc("linearize", "five_bar/set_point", "--at", '{"theta_1": -1.3, "theta_3": -1.7}', "--out", str(folder)).code
        == 0
    )
    assert {path.name for path in folder.iterdir()} >= {
        "linear.npz",
        "poles.png",
        "modes.png",
        "locus.png",
        "mode_1.npz",
    }
    with np.load(folder / "linear.npz") as file:
        model = linearize("five_bar", {"theta_1": -1.3, "theta_3": -1.7})
        assert np.array_equal(file["A"], model.A)
        assert file["outputs"].tolist() == list(model.outputs)
    run = Run.load(folder / "mode_1.npz")
    period = 1 / model.modes[0].frequency
    assert run.t[-1] == pytest.approx(2 * period)
    assert run.max_phi < 1e-8
    assert np.abs(run.q_tree[0] - run.q_tree[-1]).max() < 1e-12
    # small displacements are proportional to the shape
    shape = model.modes[0].shape
    displacement = run.q_tree - model.q_tree
    k = int(np.argmax(np.abs(shape)))
    assert np.ptp(displacement[:, k]) == pytest.approx(2 * np.abs(displacement[:, k]).max(), rel=0.2)
    assert ckc("play", str(folder / "mode_1.npz"), "--html", str(tmp_path / "mode.html")).code == 0


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (("five_bar", "--at", "sometimes"), "give equilibrium, assembled, target, a time in seconds"),
        (("five_bar", "--at", ""), "give equilibrium, assembled, target, a time in seconds"),
        (("five_bar", "--at", '{"theta_1": 0.3, "theta_1": 0.4}'), "theta_1 is given twice"),
        (("five_bar/swing", "--at", "3"), "outside the run of five_bar/swing, which lasts from 0 to 2 s"),
        (("five_bar", "--at", '{"theta_1": 0.3}'), "theta_3 missing"),
        (("five_bar", "--at", '{"theta_1": 3.0, "theta_3": 0.1}'), "is out of reach"),
        (("five_bar", "--at", "{"), "not JSON"),
        (("no_such",), "no mechanism 'no_such'"),
    ],
)
def test_invalid_arguments_are_reported(line: tuple[str, ...], says: str) -> None:
    answer = ckc("linearize", *line)
    assert answer.code == 2
    assert says in answer.err


def test_missing_equilibrium_exits_with_3(tmp_path: Path) -> None:
    falling = tmp_path / "mechanism.toml"
    falling.write_text('name = "falling"\nurdf = "falling.urdf"\n')
    (tmp_path / "falling.urdf").write_text(FALLING)
    answer = ckc("linearize", str(falling), "--json")
    assert answer.code == 3
    assert "no stable equilibrium is reached from q_guess: after 300 steps it still falls" in answer.json["message"]
    assert "linearize it as assembled" in answer.json["message"]


PERIOD = "4.99171151369"  # of bricard/period, which swings to and fro and keeps its energy


def test_floquet_multipliers_equal_those_of_python(tmp_path: Path) -> None:
    result = ckc("linearize", "bricard/period", "--period", PERIOD, "--json").json
    assert list(result) == ["name", "states", "period", "monodromy", "multipliers", "stable", "uncertainty"]
    assert result["stable"] is None
    assert result == floquet("bricard/period", float(PERIOD)).to_dict()
    # one freedom without damping: areas in phase space are conserved, and a perturbation along the motion is periodic
    monodromy = np.array(result["monodromy"])
    assert np.linalg.det(monodromy) == pytest.approx(1.0, abs=1e-7)
    assert [complex(*x) for x in result["multipliers"]] == pytest.approx([1.0, 1.0], abs=1e-3)
    folder = tmp_path / "motion"
    answer = ckc("linearize", "bricard/period", "--period", PERIOD, "--out", str(folder))
    assert "neither grow nor decay" in " ".join(answer.out.split())  # wherever its line is broken
    with np.load(folder / "floquet.npz") as file:
        assert np.array_equal(file["monodromy"], monodromy)
        assert file["states"].tolist() == result["states"]
    assert Run.load(folder / "run.npz").t[-1] == float(PERIOD)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (("bricard/period", "--period", "4"), "period = 4 s is not a period: after it"),
        (("bricard/period", "--period", "-1"), "period = -1: expected a positive number of seconds"),
        (("bricard/period", "--period", "4", "--at", "2"), "--at and --period are both given"),
    ],
)
def test_invalid_periods_are_rejected(line: tuple[str, ...], says: str) -> None:
    answer = ckc("linearize", *line)
    assert answer.code == 2
    assert says in answer.err


def test_check_reports_closed_loop_stability() -> None:
    result = ckc("check", "talos/squat", "--json").json["stability"]
    assert result["stable"] is True
    assert len(result["eigenvalues"]) == 52
    assert result["leaves_out"] == ["dry friction"]
    assert "stable at its target" in ckc("check", "five_bar/set_point").out
    assert ckc("check", "five_bar", "--json").json["stability"] is None


def test_check_reports_stability_of_the_sampled_loop(tmp_path: Path) -> None:
    scene = tmp_path / "seldom.scene.toml"
    scene.write_text(
        'mechanism = "five_bar"\nformulation = "reduced"\nt_end = 1.0\ninitial.at = "equilibrium"\n'
        '[controller]\ntype = "set_point"\nK_P = 10.0\nK_V = 1.0\nsample_time = 0.2\ndelay = 0.05\n'
        "q_d = { theta_1 = -1.2, theta_3 = -1.9 }\n"
    )
    result = ckc("check", str(scene), "--json").json
    assert result["stability"]["sampled"] is True
    assert result["stability"]["stable"] is False
    assert result["stability"]["multiplier"] > 1
    assert result["stability"]["leaves_out"] == []
    assert any("unstable as sampled" in warning for warning in result["warnings"])
    assert "UNSTABLE as sampled, factor" in ckc("check", str(scene)).out.replace("\n", " ")
    assert ckc("check", "five_bar/set_point", "--json").json["stability"]["sampled"] is False


def test_lqr_example_stabilizes_the_equilibrium() -> None:
    example = runpy.run_path(str(ROOT / "examples" / "lqr.py"))
    model, regulator = example["design"]()
    assert model.eigenvalues.real.max() > 5, "it would fall"
    values = np.linalg.eigvals(model.A - model.B @ regulator.K)
    assert values.real.max() < -10
    run = example["hold"](regulator)
    error = np.abs(run.q_tree[:, [0, 2]] - regulator.x_0[:2]).max(axis=1)
    assert run.status == "done"
    assert error[0] > 0.07
    assert error[run.at(1.0)] < 1e-5
    assert error[-1] < 1e-10


def test_root_locus_crosses_the_axis_at_the_smallest_gain() -> None:
    locus, result = gain_locus("five_bar/set_point"), check("five_bar/set_point").stability
    assert locus is not None
    assert locus.gain == "K_P"
    assert result is not None
    assert result.least_K_P is not None
    smallest_factor = result.least_K_P[0, 0] / 10.0  # of the scene's K_P
    rightmost = locus.eigenvalues.real.max(axis=1)
    assert np.array_equal(rightmost < 0, locus.factors > smallest_factor)
    scene_eigenvalues = locus.eigenvalues[int(np.argmin(np.abs(locus.factors - 1)))]
    assert np.abs(np.sort_complex(scene_eigenvalues) - np.sort_complex(result.eigenvalues)).max() < 1e-6
    assert gain_locus("five_bar") is None
    assert gain_locus("five_bar/swing") is None


def test_figures_show_poles_modes_and_the_locus() -> None:
    model = linearize("five_bar/set_point", 0.5)
    ax = plot(model)["poles"].axes[0]
    plant, closed = (np.sort_complex(line.get_xdata() + 1j * line.get_ydata()) for line in ax.lines[-2:])
    assert model.closed_loop is not None
    assert np.array_equal(plant, np.sort_complex(model.eigenvalues))
    assert np.abs(closed - np.sort_complex(np.linalg.eigvals(model.closed_loop))).max() < 1e-9
    low, high = ax.get_xlim()
    assert low < closed.real.min() < plant.real.max() < high
    panels = plot(linearize("stewart"))["modes"].axes
    assert len(panels) == 6
    assert panels[0].get_title(loc="left").startswith("1: 1.503 Hz")
    locus = gain_locus("three_rrr/circle")
    assert locus is not None
    assert locus.gain == "K_D"
    assert len(plot(locus)["locus"].axes[0].collections[-1].get_offsets()) == locus.eigenvalues.size


def test_bars_of_a_mode_equal_its_animation_at_two_phases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ckc_pin.linear.mode_animation.MAX_AMPLITUDE", 0.01)
    model = linearize(plate_on_springs(tmp_path))  # with dampers, so that not all coordinates are in phase
    figure, animations = plot(model)["modes"], animate_modes(model)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "at one instant",
        "a quarter of a period later",
    ]
    rows = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    tree = model.mechanism.tree
    rest = tree.from_coordinates(model.q_tree)
    assert "root.x" in rows[0]
    for number in (1, 2, 3):
        bars = figure.axes[number - 1].containers
        run = animations[number]
        frames = [np.argmin(np.abs(run.t - part / model.modes[number - 1].frequency)) for part in (0.0, 0.25)]
        parts = np.array([[bar.get_width() for bar in drawn] for drawn in bars])
        moved = [tree.difference(rest, tree.from_coordinates(run.q_tree[k])) for k in frames]
        displayed = np.array(moved) / tree.step_scale
        largest = np.argmax(np.abs(displayed))
        displayed /= displayed.flat[largest] / parts.flat[largest]  # as large as it is shown
        assert np.abs(displayed - parts).max() < 0.05


def test_output_folder_loses_files_of_another_model(tmp_path: Path) -> None:
    kept = tmp_path / "mode_of_mine.npz"
    kept.write_bytes(b"")
    assert ckc("linearize", "five_bar/set_point", "--at", "target", "--out", str(tmp_path)).code == 0
    assert (tmp_path / "locus.png").exists()
    (tmp_path / "mode_9.npz").write_bytes(b"")
    assert ckc("linearize", "slider_crank", "--out", str(tmp_path)).code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "linear.npz", "mode_1.npz", "mode_of_mine.npz", "modes.png", "poles.png",
    ]  # fmt: skip


def test_missing_outputs_are_reported(tmp_path: Path) -> None:
    """Modes that are rigid have no run, and a start out of reach leaves a locus without a branch."""
    assert "0 of 6 modes can be played: rigid modes" in " ".join(
        ckc("linearize", "three_rrr", "--out", str(tmp_path)).out.split()
    )
    start = "initial={q={theta_1=3.0, theta_3=0.1}}"
    answer = ckc("linearize", "five_bar/set_point", "--set", start, "--out", str(tmp_path))
    assert answer.code == 0
    assert "no root locus: " in answer.err
    assert (tmp_path / "poles.png").exists()
    assert not (tmp_path / "locus.png").exists()


def test_run_that_stops_before_the_instant_exits_with_3() -> None:
    answer = ckc("linearize", "five_bar/swing", "--at", "1.5", "--set", "solver.max_rhs=20", "--json")
    assert answer.code == 3
    assert "ends at t = " in answer.json["message"]


def test_damping_ratio_of_an_undamped_mode_is_zero() -> None:
    model = linearize("stewart")
    assert model.modes[0].description == "1.503 Hz, damping ratio 0"
    run = model.animate_mode(1)
    assert run is not None
    assert run.scene_name == "stewart: mode 1, 1.503 Hz", "a run of it has none"


def test_mode_animations_of_the_stewart_platform_keep_its_loops_closed() -> None:
    model = linearize("stewart")
    runs = animate_modes(model)
    assert list(runs) == [1, 2, 3, 4, 5, 6]
    for number, run in runs.items():
        mode = model.modes[number - 1]
        assert run.max_phi < 1e-9
        assert run.max_phi_dot < 1e-9
        assert run.t[-1] == pytest.approx(2 / mode.frequency)
        # the rates are those of the motion, by differences around the ring of frames, to the size of a swing squared
        largest = int(np.argmax(np.abs(mode.shape)))  # pairs of modes share a frequency, and any mixture is one
        displacement, rates = run.q_tree[:49, largest], run.v_tree[:48, largest]
        slope = (np.roll(displacement[:48], -1) - np.roll(displacement[:48], 1)) / (2 * run.t[1])
        assert np.abs(slope - rates).max() <= 0.2 * np.abs(rates).max()
