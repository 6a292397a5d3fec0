"""Forces from inverse dynamics reproduce the motion of imported URDF and MuJoCo models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ckc_pin import InputError, MechanismError, inverse_dynamics, load, simulate
from ckc_pin.base.sources import resolve_path
from ckc_pin.formats.importing import Draft, read, write
from scripts.experiments.published_robots_motion import measure_reproduction_error
from tests.contract.helpers.models import TWO_ARMS, model
from tests.contract.test_import_urdf import FOUR_BAR, PIN, YAML, imported, legs, spatial, two_legs
from tests.regression.test_inverse_forward import assert_gives_back, assert_integrates_back, waves

SCENE = 'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 0.1\ninitial.at = "assembled"\n'
HINGE = "<equality><connect site1='s1' site2='t1'/><connect site1='s2' site2='t2'/></equality>"
# a floating body with two motor-driven arms
ARM = "<body><joint name='{0}' axis='0 1 0'/><geom type='capsule' fromto='{1} 0 0 {2} 0 .3' size='.03'/></body>"
FLOATING = (
    "<body><freejoint/><geom type='box' size='.2 .1 .1'/>"
    f"{ARM.format('left', -0.2, -0.4)}{ARM.format('right', 0.2, 0.4)}</body>"
)
# a crank with friction, rotor and gear; a rod on a spring
RUBBING = TWO_ARMS.replace('<joint name="a"', '<joint name="a" frictionloss=".3" damping=".2" armature=".05"').replace(
    '<joint name="b"', '<joint name="b" stiffness="4" springref=".3"'
)
GEARED = HINGE + "<actuator><motor joint='a' gear='20'/></actuator>"


def free(draft: Draft) -> Draft:
    """Put a motor on each freedom, regardless of the file's motors."""
    return replace(draft, actuated=None)


MODELS: dict[str, Callable[[Path], Draft]] = {
    "hinge": lambda folder: imported(folder, FOUR_BAR + PIN.format(type="revolute", axis='<axis xyz="0 0 2"/>')),
    "ball in a plane": lambda folder: imported(folder, FOUR_BAR + PIN.format(type="spherical", axis="")),
    "legs in a plane": lambda folder: imported(folder, two_legs()),
    "legs in a plane that turns": lambda folder: imported(folder, two_legs(base="revolute")),
    "spatial loop": lambda folder: imported(folder, spatial("0.5 0 0")),
    "robot.yaml": lambda folder: free(imported(folder, legs(), YAML)),
    "connects": lambda folder: model(folder, TWO_ARMS, HINGE),
    "connects, friction, rotor and gear": lambda folder: model(folder, RUBBING, GEARED),
}
ROBOTS = {
    "alex": "alex_description/urdf/alex_psyonic_hands.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "pr2": "pr2_description/urdf/pr2.urdf",
    "talos": "talos_data/robots/talos_full_v2.urdf",
    "tiago": "tiago_pro_description/robots/tiago_pro.urdf",
}


def robot(file: str) -> Draft:
    """A robot with a motor on every freedom, in place of the file's motors."""
    draft = read(resolve_path(f"package://example-robot-data/robots/{file}", Path(), "test"))
    draft.motors, draft.actuated, draft.independent = [], None, None
    return draft


def write_with_scene(draft: Draft, folder: Path) -> Path:
    write(draft, folder)
    scene = folder / "default.scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    return scene


def assert_swings_as_it_should(draft: Draft, folder: Path) -> None:
    scene = write_with_scene(draft, folder)
    overrides = waves(load(folder / "mechanism.toml"), 0.1)
    forces = inverse_dynamics(scene, overrides)
    assert forces.status == "done"
    assert abs(forces.tau).max() > 0.0
    assert_gives_back(forces)
    assert_integrates_back(scene, overrides, forces)


@pytest.mark.parametrize("name", MODELS)
def test_inverse_dynamics_reproduces_motion_of_imported_models(name: str, tmp_path: Path) -> None:
    assert_swings_as_it_should(MODELS[name](tmp_path), tmp_path / "written")


@pytest.mark.parametrize("name", ROBOTS)
def test_inverse_dynamics_reproduces_motion_of_package_robots(name: str, tmp_path: Path) -> None:
    assert_swings_as_it_should(robot(ROBOTS[name]), tmp_path)


def test_published_robots_are_moved_along_all_driven_freedoms(tmp_path: Path) -> None:
    """They are moved along all freedoms or, with a free root, along those of motors; otherwise an error says so."""
    assert measure_reproduction_error(MODELS["connects, friction, rotor and gear"](tmp_path)) < 1e-9
    pushed = model(tmp_path, FLOATING, "<actuator><motor joint='left'/><motor joint='right'/></actuator>")
    assert measure_reproduction_error(pushed) < 1e-9
    with pytest.raises(InputError, match="mass"):
        measure_reproduction_error(robot("romeo_description/urdf/romeo.urdf"))


def test_freedom_without_motor_is_named(tmp_path: Path) -> None:
    scene = write_with_scene(imported(tmp_path, legs(), YAML), tmp_path / "written")
    with pytest.raises(InputError, match=r"a_hip cannot drive every freedom; the motion along b_hip is driven by"):
        inverse_dynamics(scene, waves(load(tmp_path / "written" / "mechanism.toml"), 0.1))


def test_massless_fingers_are_rejected(tmp_path: Path) -> None:
    """Romeo's fingers and the links geared to them have no mass, so torques do not determine their accelerations."""
    scene = write_with_scene(robot("romeo_description/urdf/romeo.urdf"), tmp_path)
    with pytest.raises((InputError, MechanismError), match="mass"):
        simulate(scene, waves(load(tmp_path / "mechanism.toml"), 0.1))
