"""Hints of `ckc check` and of messages: units, loop types that would move, near names, the shapes of a gain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import InputError, MechanismError, check, load, load_scene, simulate
from ckc_pin.base.validation import find_nearest_name, suggest_name
from ckc_pin.kinematics.loop_types import describe_locking_loops
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.library import GeneratorSpec, shipped
from ckc_pin.mechanism.unit_hints import find_unit_warnings
from tests.contract.helpers.command import ckc
from tests.contract.sketches import FOUR_BAR, FOUR_BAR_LOOP


def write(folder: Path, *edits: tuple[str, str], urdf: str = FOUR_BAR) -> Path:
    """Write a four-bar with edits of its mechanism file and URDF."""
    text = 'name = "four_bar"\nurdf = "m.urdf"\n' + FOUR_BAR_LOOP
    for old, new in edits:
        assert old in text + urdf
        text, urdf = text.replace(old, new), urdf.replace(old, new)
    (folder / "m.urdf").write_text(urdf)
    (folder / "mechanism.toml").write_text(text)
    return folder / "mechanism.toml"


LIMIT = '<limit lower="-90" upper="90" effort="1" velocity="1"/>'

# --- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", shipped())
def test_units_of_shipped_mechanisms_cause_no_warning(name: str) -> None:
    assert find_unit_warnings(load(name)) == []


def test_long_light_linkage_causes_no_warning(tmp_path: Path) -> None:
    """A chain of 40 squares of 1 m: 40 m and 81 kg."""
    scene = load_scene("n_four_bar", {"mechanism.N": 40})
    assert not any("millimetres" in warning for warning in check(scene).warnings)


def test_size_is_printed_and_in_the_json(tmp_path: Path) -> None:
    """The longest distance in this four-bar is from the base's joint gamma to alpha, or along the coupler: 0.5 m."""
    path = str(write(tmp_path))
    assert ckc("check", path, "--json").json["size"] == 0.5
    assert "size, moving mass       0.5 m, 3 kg" in ckc("check", path).out


def units(path: Path) -> str:
    (warning,) = find_unit_warnings(load(path))
    assert warning in check(path).warnings
    return warning


def test_mechanism_in_millimetres_is_named_by_its_size(tmp_path: Path) -> None:
    edits = [
        ("0.2 0 0", "200 0 0"),
        ("0.5 0 0", "500 0 0"),
        ("[0.5,", "[500,"),
        ("[0.4,", "[400,"),
        ("0.1 0 0", "100 0 0"),
    ]
    warning = units(write(tmp_path, *edits))
    assert warning == (
        "lengths look like millimetres: the size of the mechanism is 500 m, its moving mass 3 kg; lengths are in metres"
    )


def test_heavy_machine_of_twenty_metres_causes_no_warning(tmp_path: Path) -> None:
    edits = [("0.2 0 0", "8 0 0"), ("0.5 0 0", "20 0 0"), ("[0.5,", "[20,"), ("[0.4,", "[16,"), ('"1"', '"9000"')]
    assert find_unit_warnings(load(write(tmp_path, *edits))) == []


def test_single_length_in_millimetres_is_named(tmp_path: Path) -> None:
    point = (
        'actuated = ["alpha"]\nspring = [{frame_a = "world", frame_b = {link = "coupler", xyz = [250.0, 0.0, 0.0]}}]\n'
    )
    path = write(tmp_path, ('independent = ["alpha"]', point))
    assert units(path).startswith("lengths look like millimetres: spring.0.frame_b.xyz = 250 m; lengths are in metres")


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (("alpha = -0.5", "alpha = -45"), "q_guess.alpha = -45 rad"),
        (("alpha = -0.5", "alpha = 10"), "q_guess.alpha = 10 rad"),
        (
            ('"alpha" type="continuous">', f'"alpha" type="revolute">{LIMIT}'),
            "limits of alpha = -90 to 90 rad",
        ),
        (("xyz = [0.5, 0.0, 0.0]}", "xyz = [0.5, 0.0, 0.0], rpy = [0.0, 90.0, 0.0]}"), "rpy = [0, 90, 0] rad"),
        (('xyz="0.2 0 0"', 'xyz="0.2 0 0" rpy="0 180 0"'), "joint.beta.rpy = [0, 180, 0] rad"),
        (
            ('independent = ["alpha"]', 'spring = [{joint = "gamma", rest = 30.0, stiffness = 1.0}]'),
            "spring.0.rest = 30 rad",
        ),
    ],
)  # fmt: skip
def test_angles_in_degrees_are_named(edit: tuple[str, str], says: str, tmp_path: Path) -> None:
    warning = units(write(tmp_path, edit))
    assert warning.startswith("angles look like degrees: ")
    assert says in warning
    assert warning.endswith("; angles are in radians")


@pytest.mark.parametrize(("lower", "upper", "is_named"), [(-9, 9, False), (-100, 100, False), (0, 200, True)])
def test_limits_of_a_slide_in_millimetres_are_named(lower: float, upper: float, is_named: bool, tmp_path: Path) -> None:
    """A slide on a base of 0.5 m; +-100 m stands for no limits."""
    slide = f'<axis xyz="0 0 1"/><limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/></joint>'
    link = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    (tmp_path / "m.urdf").write_text(
        f'<robot name="m"><link name="base"/><link name="a">{link}</link><joint name="a" type="prismatic">'
        f'<parent link="base"/><child link="a"/><origin xyz="0.5 0 0"/>{slide}</robot>'
    )
    (tmp_path / "mechanism.toml").write_text('name = "m"\nurdf = "m.urdf"\n')
    expected = ["lengths look like millimetres: limit of a = 200 m; lengths are in metres"] if is_named else []
    assert find_unit_warnings(load(tmp_path / "mechanism.toml")) == expected


@pytest.mark.parametrize("limit", [6.2831853, 12.566370614, 100, 1000, 1e10, 3.0])
def test_limits_of_whole_turns_and_unlimited_joints_cause_no_warning(limit: float, tmp_path: Path) -> None:
    limits = f'<limit lower="-{limit}" upper="{limit}" effort="1" velocity="1"/>'
    path = write(tmp_path, ('"alpha" type="continuous">', f'"alpha" type="revolute">{limits}'))
    assert find_unit_warnings(load(path)) == []


def test_start_and_target_in_degrees_are_named() -> None:
    """In ckc check and in run.warnings."""
    values = {
        "initial": {"q": {"theta_1": -80.0, "theta_3": -100.0}},
        "controller.q_d": {"theta_1": -1.0, "theta_3": -90},
    }
    warning = (
        "angles look like degrees: initial.q.theta_1 = -80 rad, initial.q.theta_3 = -100 rad, "
        "controller.q_d.theta_3 = -90 rad; angles are in radians"
    )
    assert warning in check("five_bar/set_point", values).warnings
    assert warning in simulate("five_bar/set_point", values | {"t_end": 0.01}).warnings


# --- loop types ------------------------------------------------------------------------------------


def locked(folder: Path, kind: str, axis: str = "axis_a = [0.0, 1.0, 0.0]") -> Mechanism:
    """Return a four-bar whose loop closes with the orientation of its assembled configuration."""
    mechanism = load(write(folder))
    alpha, beta, gamma = mechanism.q_tree
    edits = [
        ('independent = ["alpha"]', ""),
        ("point_2d", kind),
        ("xyz = [0.5, 0.0, 0.0]}", f"xyz = [0.5, 0.0, 0.0], rpy = [0.0, {gamma - alpha - beta}, 0.0]}}"),
        ("axis_a = [0.0, 1.0, 0.0]", axis),
    ]
    for name, value in zip(("alpha", "beta", "gamma"), mechanism.q_tree, strict=True):
        edits.append(
            ({"alpha": "alpha = -0.5", "beta": "beta = 0.0", "gamma": "gamma = -1.5"}[name], f"{name} = {value}")
        )
    return load(write(folder, *edits))


def test_weld_that_locks_names_its_rows_and_types_that_move(tmp_path: Path) -> None:
    mechanism = locked(tmp_path, "weld")
    assert mechanism.d == 0
    (warning,) = [x for x in check(mechanism).warnings if "no freedom" in x]
    assert warning == (
        "the loops leave no freedom (d = 0): loop 'joint' (weld) locks it by its rows x, z, ry; "
        '"hinge" with axis_b = [0, 1, 0], "point_2d", "universal" or "point" would leave 1 freedom'
    )


def test_hinge_about_a_wrong_axis_names_the_right_one(tmp_path: Path) -> None:
    says = describe_locking_loops(locked(tmp_path, "hinge", axis=""))
    assert '"hinge" with axis_a = [0, 1, 0] and axis_b = [0, 1, 0]' in says


def test_each_named_type_leaves_the_freedom_that_is_promised(tmp_path: Path) -> None:
    locked(tmp_path, "weld")
    text = (tmp_path / "mechanism.toml").read_text()
    for kind in ("hinge", "point_2d", "universal", "point"):
        axis_b = "\naxis_b = [0.0, 1.0, 0.0]" if kind == "hinge" else ""
        (tmp_path / "mechanism.toml").write_text(text.replace('"weld"', f'"{kind}"') + axis_b)
        assert load(tmp_path / "mechanism.toml").d == 1
    assert describe_locking_loops(load(tmp_path / "mechanism.toml")) == ""


def test_run_of_a_locked_mechanism_names_the_loop(tmp_path: Path) -> None:
    locked(tmp_path, "weld")
    scene = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\ninitial = {at = "assembled"}\n'
    (tmp_path / "default.scene.toml").write_text(scene)
    answer = ckc("run", str(tmp_path))
    assert answer.code == 2
    assert "nothing can move; loop 'joint' (weld) locks it by its rows x, z, ry" in answer.err.replace("\n", " ")


def test_weld_that_cannot_close_names_types_that_can(tmp_path: Path) -> None:
    """The crank of 0.2 m never reaches the configurations in which coupler and rocker are parallel."""
    with pytest.raises(MechanismError, match='all loops would close if loop joint had type "hinge"') as error:
        load(write(tmp_path, ('independent = ["alpha"]', ""), ("point_2d", "weld")))
    assert '"point_2d"' in str(error.value)


# --- near names ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "nearest"),
    [
        ("solver.rtl", "'rtol'"),
        ("contoller.K_P", "'controller'"),
        ("controller.KP", "'K_P'"),
        ("rtol", "'solver.rtol'"),
        ("lnk.link_2.mass", "'link.link_2.mass'"),
        ("link.link2.mass", "'link.link_2'"),
        ("controller.q_d.theta1", "'theta_1'"),
    ],
)
def test_unknown_key_names_the_nearest(key: str, nearest: str) -> None:
    """In an override of Python and of the command line, also where the scene has the right key already."""
    with pytest.raises(InputError, match=f"did you mean {nearest}"):
        simulate("five_bar/set_point", {key: 1.0})
    answer = ckc("check", "five_bar/set_point", "--set", f"{key}=1.0")
    assert answer.code == 2
    assert f"did you mean {nearest}?" in " ".join(answer.err.split())


def test_unknown_key_of_files_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"loop\[0\]: unknown key 'axis_c'.*; did you mean 'axis_a'"):
        load(write(tmp_path, ("axis_a", "axis_c")))
    with pytest.raises(InputError, match=r"loop\[0\].type = 'hing'.*; did you mean 'hinge'\?"):
        load(write(tmp_path, ("point_2d", "hing")))
    with pytest.raises(InputError, match=r"q_guess: no coordinate 'alfa'.*; did you mean 'alpha'\?"):
        load(write(tmp_path, ("alpha = -0.5", "alfa = -0.5")))


def test_nearest_name_ignores_case_and_underscores() -> None:
    names = ["theta_1", "K_P", "rtol"]
    assert [find_nearest_name(x, names) for x in ("THETA1", "kp", "r_tol")] == names
    assert find_nearest_name("rtl", []) is None
    assert suggest_name("anything", names).startswith("; the nearest is ")


# --- gains -----------------------------------------------------------------------------------------


def test_list_of_numbers_is_a_diagonal_gain() -> None:
    """In the order of `independent`, the same run as with a table and with a matrix."""
    gains = ([1.5, 2.5], {"theta_1": 1.5, "theta_3": 2.5}, [[1.5, 0.0], [0.0, 2.5]])
    ends = [simulate("five_bar/set_point", {"controller.K_P": x, "t_end": 0.5}).q_tree[-1] for x in gains]
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])
    assert load_scene("five_bar/set_point", {"controller.K_P": [1.5, 2.5]}).to_dict()["controller"]["K_P"] == [1.5, 2.5]


def test_gain_of_a_wrong_length_says_which_shapes_are_accepted() -> None:
    answer = ckc("check", "five_bar/set_point", "--set", "controller.K_P=[1, 2, 3]")
    assert answer.code == 2
    assert " ".join(answer.err.split()).endswith(
        "controller.K_P: expected a number, a table by joint, a list of 2 numbers (the diagonal) or a 2 x 2 matrix in "
        "the order theta_1, theta_3, got a list of 3 numbers"
    )


def test_row_of_many_links_has_no_lengths_in_millimetres() -> None:
    """The feet of 60 squares are up to 60 m from the first one, without a gap in between."""
    mechanism = load(GeneratorSpec(generator="n_four_bar", N=60))
    assert find_unit_warnings(mechanism) == []
