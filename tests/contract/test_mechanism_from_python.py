"""Mechanisms from Python: `Mechanism.from_urdf` and `Mechanism.save`."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import CkcError, InputError, Loop, Mechanism, Run, check, load, simulate
from ckc_pin.mechanism.library import GENERATORS, library, shipped
from tests.contract.helpers.from_python import mechanism_arguments, mechanism_from_python
from tests.property.mechanisms import closed_mechanism

WRITTEN = [name for name in shipped() if name not in GENERATORS]
FIVE_BAR = (library() / "five_bar/five_bar.urdf").read_text()
ELBOW = Loop("elbow", "point_2d", "tip_left", "tip_right", rows_in="world")
GUESS = {"theta_1": -1.434, "theta_2": 0.248, "theta_3": -1.707, "theta_4": -0.248}


def assert_same(mechanism: Mechanism, other: Mechanism) -> None:
    """Compare everything that a file determines, bit for bit."""
    assert mechanism.coordinates == other.coordinates
    assert mechanism.independent == other.independent
    assert mechanism.actuated == other.actuated
    assert mechanism.closure.names == other.closure.names
    assert mechanism.spec.to_dict() | {"urdf": "", "tree": []} == other.spec.to_dict() | {"urdf": "", "tree": []}
    np.testing.assert_array_equal(mechanism.q_tree, other.q_tree)
    np.testing.assert_array_equal(mechanism.motors.transmission, other.motors.transmission)


@pytest.mark.parametrize("name", WRITTEN)
def test_mechanism_from_python_is_that_of_the_file(name: str) -> None:
    assert_same(mechanism_from_python(name), load(name))


@pytest.mark.parametrize("name", WRITTEN)
def test_saved_mechanism_is_that_of_the_file(name: str, tmp_path: Path) -> None:
    for k, mechanism in enumerate((mechanism_from_python(name), load(name))):
        path = mechanism.save(tmp_path / str(k))
        assert path == tmp_path / str(k) / "mechanism.toml"
        assert_same(load(path), load(name))


@pytest.mark.parametrize("seed", range(4))
def test_saved_random_mechanism_is_the_same(seed: int, tmp_path: Path) -> None:
    """With two trees, a loop, a coupling, springs, dampers and rotors, whose numbers have all digits."""
    mechanism = closed_mechanism("hinge", seed).mechanism
    assert_same(load(mechanism.save(tmp_path)), mechanism)


def test_path_text_and_package_are_the_same(tmp_path: Path) -> None:
    file = tmp_path / "x.urdf"
    file.write_text(FIVE_BAR)
    arguments: dict[str, Any] = {"loops": [ELBOW], "q_guess": GUESS}
    by_path, by_text = (Mechanism.from_urdf(urdf, **arguments) for urdf in (file, FIVE_BAR))
    assert (by_path.name, by_text.name) == ("x", "five_bar")
    np.testing.assert_array_equal(by_path.q_tree, by_text.q_tree)
    np.testing.assert_array_equal(by_path.q_tree, Mechanism.from_urdf(str(file), **arguments).q_tree)


def test_arrays_and_objects_stand_for_lists_and_tables() -> None:
    table = {"name": "elbow", "type": "point_2d", "frame_a": "tip_left", "frame_b": "tip_right", "rows_in": "world"}
    independent = ["theta_1", "theta_2", "theta_3", "theta_4"]
    mechanism = Mechanism.from_urdf(FIVE_BAR, loops=[ELBOW], q_guess=GUESS, gravity=np.array([0, -9.81, 0]))
    np.testing.assert_array_equal(
        mechanism.q_tree, Mechanism.from_urdf(FIVE_BAR, loops=(table,), q_guess=GUESS, gravity=(0, -9.81, 0)).q_tree
    )
    assert mechanism.spec.gravity == (0.0, -9.81, 0.0)
    open_chain = Mechanism.from_urdf(FIVE_BAR, independent=independent, q_guess=np.array([*GUESS.values()]))
    assert open_chain.spec.q_guess == GUESS


def test_parameters_are_those_of_load() -> None:
    parameters = {"link.link_2.mass": np.float64(0.3), "gravity": [0.0, -1.0, 0.0]}
    mechanism = Mechanism.from_urdf(**mechanism_arguments("five_bar"), parameters=parameters)
    other = load("five_bar", parameters)
    assert mechanism.overrides == other.overrides == {"link.link_2.mass": 0.3, "gravity": (0.0, -1.0, 0.0)}
    assert [body.mass for body in mechanism.tree.model.inertias] == [body.mass for body in other.tree.model.inertias]


def test_save_refuses_what_a_mechanism_file_cannot_have(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Mechanism.save: parameters \(link.link_2.mass\).*save a Scene"):
        load("five_bar", {"link.link_2.mass": 0.3}).save(tmp_path)
    with pytest.raises(InputError, match=r"Mechanism.save: prescribed \(crank\)"):
        load("slider_crank", prescribed={"crank": 0.5}).save(tmp_path)
    assert not list(tmp_path.iterdir())
    load("five_bar").save(tmp_path)
    with pytest.raises(InputError, match="there already"):
        load("five_bar").save(tmp_path)
    load("four_bar").save(tmp_path, overwrite=True)
    assert load(tmp_path).name == "four_bar"


def test_files_of_other_folders_are_saved_beside_the_mechanism(tmp_path: Path) -> None:
    """Two trees from different folders have the same file name."""
    for side in "ab":
        (tmp_path / side).mkdir()
        mass = {"a": "1", "b": "2"}[side]
        (tmp_path / side / "arm.urdf").write_text(
            f'<robot name="arm"><link name="base"/><link name="rod"><inertial><mass value="{mass}"/><inertia ixx="1" '
            'iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" type="continuous"><parent '
            'link="base"/><child link="rod"/></joint></robot>'
        )
    (tmp_path / "c").mkdir()
    (tmp_path / "c/mechanism.toml").write_text(
        '# Two arms.\nname = "arms"\ntree = [{file = "../a/arm.urdf", prefix = "a_"}, '
        f'{{file = "{tmp_path}/b/arm.urdf", prefix = "b_"}}]\n'
    )
    trees = [{"file": tmp_path / "a/arm.urdf", "prefix": "a_"}, {"file": tmp_path / "b/arm.urdf", "prefix": "b_"}]
    for k, mechanism in enumerate((load(tmp_path / "c"), Mechanism.from_urdf(trees=trees, name="arms"))):
        path = mechanism.save(tmp_path / f"saved {k}")
        files = {file.name for file in path.parent.iterdir()}
        assert files == {"mechanism.toml", "arm.urdf", "arm_2.urdf"}
        again = load(path)
        assert [body.mass for body in again.tree.model.inertias] == [0.0, 1.0, 2.0]
        assert tomllib.loads(path.read_text())["tree"][1] == {"file": "arm_2.urdf", "prefix": "b_"}


def test_text_says_which_meshes_are_not_there(tmp_path: Path) -> None:
    def with_mesh(file: str) -> str:
        mesh = f'<visual><geometry><mesh filename="{file}"/></geometry></visual>'
        return FIVE_BAR.replace('<link name="link_1">', f'<link name="link_1">{mesh}')

    arguments: dict[str, Any] = {"loops": [ELBOW], "q_guess": GUESS}
    (warning,) = (x for x in Mechanism.from_urdf(with_mesh("parts/rod.stl"), **arguments).warnings if "mesh" in x)
    assert warning.startswith("the URDF is a text, so its meshes are not there: parts/rod.stl; give meshes = ")
    for urdf, meshes in ((with_mesh("rod.stl"), tmp_path), (with_mesh("package://x/rod.stl"), None), (FIVE_BAR, None)):
        mechanism = Mechanism.from_urdf(urdf, **arguments, meshes=meshes)
        assert not any("mesh" in x for x in mechanism.warnings)
        assert mechanism.sources.folder == meshes
    assert warning in check(Mechanism.from_urdf(with_mesh("parts/rod.stl"), **arguments)).warnings


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"loops": [{"name": "x", "typ": "point"}]}, r"loops\[0\]: unknown key 'typ'; .*did you mean 'type'\?"),
        (
            {"loops": [Loop("x", "point_3d", "a", "b")]},
            r"loops\[0\].type = 'point_3d'; valid: .*did you mean 'point_2d'",
        ),
        ({"loops": ELBOW}, "loops: expected a list, got a table"),
        ({"joints": [{"name": "x", "dampin": 1}]}, r"joints\[0\]: unknown key 'dampin'.*did you mean 'damping'"),
        ({"motors": [{"joint": "theta_1", "ratio": "2"}]}, r"motors\[0\].ratio = '2': expected a number, got a string"),
        ({"points": [{"name": "tip"}]}, r"points\[0\]: the key 'frame' is missing"),
        ({"springs": [3]}, r"springs\[0\] = 3: expected a table, got an integer"),
        ({"q_guess": [1.0]}, "q_guess: an array is in the order of independent, which is not given"),
        (
            {"q_guess": [1.0], "independent": ["theta_1", "theta_3"]},
            "expected 2 numbers, in the order theta_1, theta_3",
        ),
        ({"q_guess": {"theta_1": float("nan")}}, "q_guess.theta_1 = nan: expected a finite number"),
        ({"gravity": [0, 1]}, r"gravity = \[0, 1\]: expected a list of 3, got a list of 2"),
        ({"parameters": {"link.link_2.mass": "3"}}, "parameters: link.link_2.mass = '3': expected a table of numbers"),
        ({"name": ""}, "name = ''.*expected a string that is not empty"),
        ({"meshes": 3}, "meshes: expected the folder of the mesh files, got 3"),
        ({"trees": [{"file": FIVE_BAR}]}, "give either urdf, .* or trees"),
    ],
)
def test_wrong_argument_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=rf"^Mechanism.from_urdf: .*{message}"):
        Mechanism.from_urdf(FIVE_BAR, **arguments)


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        (None, "Mechanism.from_urdf: give either urdf"),
        (3, "Mechanism.from_urdf: urdf: expected the text of a URDF or its path, got 3"),
        ("missing.urdf", "missing.urdf: no such URDF"),
        ("<robot", "Mechanism.from_urdf: urdf: malformed XML"),
        ("<mujoco/>", "expected the root element <robot> of a URDF, got <mujoco>"),
        ("package://nothing/x.urdf", "no package 'nothing' is installed"),
    ],
)
def test_wrong_urdf_is_named(urdf: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Mechanism.from_urdf(urdf)


def test_wrong_tree_is_named() -> None:
    for trees, message in (
        ([{"file": FIVE_BAR, "prefx": "x"}], r"trees\[0\]: unknown key 'prefx'; .*did you mean 'prefix'"),
        ([{"prefix": "x"}], r"trees\[0\]: the key 'file' is missing"),
        ([{"file": 3}], r"trees\[0\].file: expected the text of a URDF or its path, got 3"),
        ({"file": FIVE_BAR}, "trees: expected a list of tables, got a dict"),
    ):
        with pytest.raises(InputError, match=message):
            Mechanism.from_urdf(trees=trees)  # type: ignore[arg-type]


def test_error_of_the_mechanism_names_it() -> None:
    with pytest.raises(CkcError, match=r"^mine: spring 1: no joint of one freedom called 'theta_9'"):
        Mechanism.from_urdf(FIVE_BAR, name="mine", springs=[{"joint": "theta_9", "stiffness": 1.0}])


def test_runs_of_one_mechanism_with_and_without_tables_are_rebuilt(tmp_path: Path) -> None:
    """The first run has a table of torques in its texts, which the other run of the same name has not."""
    load("five_bar").save(tmp_path)
    (tmp_path / "torques.csv").write_text("t,theta_1,theta_3\n0,0,0\n1,0,0\n")
    runs = []
    for k, controller in enumerate(('[controller]\ntype = "torques"\nfile = "torques.csv"\n', "")):
        (tmp_path / "default.scene.toml").write_text(
            'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.01\n[initial]\nat = "assembled"\n'
            + controller
        )
        run = simulate(tmp_path)
        runs.append(Run.load(run.save(tmp_path / f"{k}.npz")))
    assert [run.mechanism.sources.texts.keys() for run in runs] == [{"mechanism.toml", "five_bar.urdf"}] * 2
