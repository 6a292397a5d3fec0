"""`ckc export --to urdf` and `--to sdf` against Pinocchio and Drake, and imported again."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import ckc_pin
from ckc_pin import InputError, Mechanism, load
from ckc_pin.base.arrays import Array
from ckc_pin.formats import exporting, importing
from ckc_pin.formats.exporting import export
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc
from tests.contract.test_export import SPATIAL

FIXED = ["five_bar", "slider_crank", "bricard", "four_bar", "flyball", "three_rrr", "andrews", "slider_crank_spatial"]


def mass_and_gravity(mechanism: Mechanism, q_tree: Array) -> tuple[Array, Array]:
    """D' without rotors, and the gravity forces, by Pinocchio's model of the mechanism."""
    model = mechanism.tree.model.copy()
    armature = model.armature.copy()
    data = model.createData()
    D = pin.crba(model, data, q_tree)
    D = np.triu(D) + np.triu(D, 1).T - np.diag(armature)
    return D, pin.computeGeneralizedGravity(model, data, q_tree)


@pytest.mark.parametrize("name", FIXED)
def test_drake_reads_the_same_tree_from_sdf(name: str) -> None:
    """Without the joints that close loops, which Drake's trees do not have."""
    mechanism = load(name)
    root = ElementTree.fromstring(export(mechanism, "sdf").text)
    model = root.find("world/model")
    assert model is not None
    loops = {loop.name for loop in mechanism.spec.loop}
    for joint in model.findall("joint"):
        if joint.attrib["name"] in loops:
            model.remove(joint)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "sdf")
    gravity = [float(x) for x in (root.findtext("world/gravity") or "").split()]
    plant.mutable_gravity_field().set_gravity_vector(gravity)
    plant.Finalize()
    assert plant.num_positions() == mechanism.n
    order = [plant.GetJointByName(joint).position_start() for joint in mechanism.coordinates]
    context, random = plant.CreateDefaultContext(), np.random.default_rng(3)
    for _ in range(5):
        from_assembled = random.uniform(-1.0, 1.0, mechanism.n)
        numbers = np.zeros(mechanism.n)
        numbers[order] = from_assembled
        plant.SetPositions(context, numbers)
        D, gravity_force = mass_and_gravity(mechanism, mechanism.q_tree + from_assembled)
        theirs = plant.CalcMassMatrixViaInverseDynamics(context)[np.ix_(order, order)]
        assert_close(theirs, D, 1e-12 * np.abs(D).max())
        forces = -plant.CalcGravityGeneralizedForces(context)[order]
        assert_close(forces, gravity_force, 1e-12 * max(1.0, np.abs(gravity_force).max()))
    motors = {plant.get_joint_actuator(index).joint().name() for index in plant.GetJointActuatorIndices()}
    assert motors == set(mechanism.actuated)


@pytest.mark.parametrize("name", [*FIXED, "delta", "stewart", "two_ur5"])
def test_pinocchio_reads_the_same_tree_from_urdf(name: str) -> None:
    mechanism = load(name)
    model = pin.buildModelFromXML(export(mechanism, "urdf").text)
    expected = mechanism.tree.model
    assert list(model.names) == list(expected.names)
    for ours, theirs in zip(model.inertias, expected.inertias, strict=True):
        assert_close(ours.toDynamicParameters(), theirs.toDynamicParameters(), 1e-14)
    for ours, theirs in zip(model.jointPlacements, expected.jointPlacements, strict=True):
        assert_close(ours.homogeneous, theirs.homogeneous, 1e-14)


MOVING = [
    name for name in (*FIXED, "delta", "n_four_bar") if name not in ("andrews", "flyball")
]  # springs between frames


@pytest.mark.parametrize("name", MOVING)
@pytest.mark.parametrize("to", ["urdf", "sdf"])
def test_an_exported_mechanism_moves_the_same_after_import(name: str, to: str, tmp_path: Path) -> None:
    original = load(name)
    (file,) = exporting.write(export(original, to), tmp_path)
    importing.write(importing.read(file), tmp_path / "back")
    text = (tmp_path / "back" / "mechanism.toml").read_text()
    gravity = f"gravity = {json.dumps(list(map(float, original.tree.model.gravity.linear)))}"
    text = re.sub(r"(?m)^gravity = .*\n", "", text)  # a URDF has none
    imported = load_text(tmp_path / "back", f"{gravity}\n{text}")
    assert imported.d == original.d
    assert set(imported.actuated) >= set(original.actuated) & set(imported.coordinates)
    zero = original.tree.to_coordinates(original.q_tree) if to == "sdf" else np.zeros(original.n)
    shift = dict(zip(original.coordinates, zero, strict=True))
    rates = dict.fromkeys(original.independent, 0.3)
    run = ckc_pin.simulate(original, t_end=0.1, initial={"at": "assembled", "q_dot": rates}, formulation="dae")
    both = [name for name in original.coordinates if name in imported.coordinates and "." not in name]
    assert set(imported.independent) <= set(both)
    q = {name: float(run[name][0] - shift[name]) for name in both}
    other = ckc_pin.simulate(
        imported,
        t_end=0.1,
        formulation="dae",
        initial={"q": q, "q_dot": {name: float(run[f"v.{name}"][0]) for name in imported.independent}},
    )
    for joint in both:
        assert_close(other[joint] + shift[joint], run[joint], 1e-7)


def load_text(folder: Path, text: str) -> Mechanism:
    (folder / "mechanism.toml").write_text(text)
    return load(folder)


@pytest.mark.parametrize("to", ["urdf", "sdf"])
@pytest.mark.parametrize(
    ("kind", "keys", "freedoms"),
    [
        ("point", {}, 3),
        ("hinge", {"axis_a": [1.0, 2.0, 2.0], "axis_b": [1.0, 2.0, 2.0]}, 1),
        ("universal", {"axis_a": [1.0, 2.0, 2.0], "axis_b": [2.0, -2.0, 1.0]}, 2),
        ("prismatic", {"axis_a": [1.0, 2.0, 2.0]}, 1),
        ("weld", {}, 0),
    ],
)
def test_loops_of_each_type_allow_the_same_motions(
    kind: str, keys: dict[str, list[float]], freedoms: int, to: str, tmp_path: Path
) -> None:
    """A free body and a link that turns about an axis, joined by a loop between tilted frames."""
    link = (
        '<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="1"/><inertia ixx="0.01" iyy="0.02" izz="0.02"'
    )
    link += ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
    urdf = f"""<robot name="pair"><link name="base"/>{link.format("crank")}{link.format("bar")}
    <joint name="a" type="continuous"><parent link="base"/><child link="crank"/><axis xyz="0 1 0"/></joint>
    <joint name="b" type="floating"><parent link="base"/><child link="bar"/></joint></robot>"""
    place = {"xyz": [0.3, 0.1, 0.2], "rpy": [0.4, -0.5, 0.6]}  # where all coordinates are zero, the frames coincide
    frames = {"frame_a": {"link": "crank", **place}, "frame_b": {"link": "bar", **place}}
    original = Mechanism.from_urdf(urdf, loops=[{"name": "joined", "type": kind, **frames, **keys}])
    (file,) = exporting.write(export(original, to), tmp_path)
    importing.write(importing.read(file), tmp_path / "back")
    imported = load(tmp_path / "back")
    assert original.d == imported.d == freedoms + 1
    ours, theirs = (ckc_pin.simulate(mechanism, t_end=0.3, formulation="dae") for mechanism in (original, imported))
    assert np.ptp(ours["a"]) > 0.01
    assert_close(theirs["a"], ours["a"], 1e-6)
    assert_close(theirs["energy.kinetic"], ours["energy.kinetic"], 1e-6)


@pytest.mark.parametrize("to", ["urdf", "sdf"])
def test_unsupported_parts_are_refused_or_listed(to: str, tmp_path: Path) -> None:
    mechanism = Mechanism.from_urdf(SPATIAL["s.urdf"])
    curved = Mechanism.from_urdf(SPATIAL["s.urdf"], couplings=[{"joint": "a", "other": "w", "polynomial": [0, 1, 0.5]}])
    with pytest.raises(InputError, match="has linear couplings only"):
        export(curved, to)
    sprung = Mechanism.from_urdf(
        SPATIAL["s.urdf"],
        springs=[{"frame_a": "world", "frame_b": "crank", "stiffness": 3.0}],
        joints=[{"name": "w", "armature": 0.1}],
        forces=[{"joint": "s", "value": 1.0}],
    )
    notes = export(sprung, to).differences
    for words in ("rotor inertia of w", "springs between frames", "constant forces"):
        assert f"left out: {words}" in notes
    assert not [note for note in export(mechanism, to).differences if "left out" in note]
    outcome = ckc("export", "five_bar", "--to", to, "--out", str(tmp_path))
    assert outcome.code == 0, outcome.err
    assert (tmp_path / f"five_bar.{to}").exists()
