"""`ckc import` of MuJoCo models, against MuJoCo itself: the same bodies, masses, forces and loops at random states."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from ckc_pin import simulate
from ckc_pin.formats.importing import Draft, read, write
from ckc_pin.mechanism.spec import JointSpec
from tests.conftest import assert_close
from tests.contract.helpers.models import TWO_ARMS, has_note, model, write_workshop
from tests.contract.helpers.mujoco_twin import Twin

MACHINE = Path(__file__).parent / "test_import_data" / "machine.xml"
EXACT = 1e-12  # relative to the largest entry
TOLERANCE = 1e-10


# --- the same machine in MuJoCo and imported --------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["machine", "workshop"])
def twin(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Twin:
    """A machine with every kind of orientation, solid and joint; a workshop of replicas, attached models and meshes."""
    return Twin(MACHINE if request.param == "machine" else write_workshop(tmp_path_factory.mktemp("workshop")))


@pytest.fixture(scope="module")
def machine() -> Draft:
    return read(MACHINE)


def states(twin: Twin) -> list[tuple[Any, Any]]:
    """Return the reference pose and random states at growing distances from it."""
    random = np.random.default_rng(7)
    start = np.array([twin.draft.q_guess.get(label, 0.0) for label in twin.tree.coordinates])
    n = twin.tree.n
    return [(start + random.uniform(-far, far, n), random.normal(size=n)) for far in (0.0, 0.3, 0.6, 0.9, 1.2)]


def test_mass_matrix_equals_mujocos(twin: Twin) -> None:
    for values, v in states(twin):
        q_tree, to = twin.put(values, v)
        ours, theirs = twin.mass_matrices(q_tree, to)
        assert_close(ours, theirs, EXACT * np.abs(theirs).max())


def test_motion_without_loops_equals_mujocos(twin: Twin, tmp_path: Path) -> None:
    """The DAE against 2000 steps of RK4, without loops, friction and stops, which are soft in MuJoCo."""
    draft, flags = twin.draft, mujoco.mjtDisableBit
    with_friction = [j.get("name") for j in draft.robot.iterfind("joint") if j.find("dynamics[@friction]") is not None]
    bare = {name: JointSpec(name=name, friction=0.0) for name in with_friction}
    bare |= {spec.name: JointSpec(name=spec.name, armature=spec.armature, friction=0.0) for spec, _ in draft.joints}
    cut = replace(
        draft, loops=[], couplings=[], forces=[], independent=None, joints=[(spec, "") for spec in bare.values()]
    )
    write(cut, tmp_path)
    v = np.random.default_rng(2).uniform(-1, 1, twin.tree.n)
    rates = "".join(f"'{name}' = {x}\n" for name, x in zip(twin.tree.coordinates, v.tolist(), strict=True))
    (tmp_path / "default.scene.toml").write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 0.2\n'
        f'[initial]\nat = "assembled"\n[initial.q_dot]\n{rates}[solver]\nrtol = 1e-11\n'
    )
    run = simulate(tmp_path)
    option = twin.model.opt
    before = option.disableflags, option.timestep, option.integrator
    option.disableflags |= int(flags.mjDSBL_EQUALITY | flags.mjDSBL_FRICTIONLOSS | flags.mjDSBL_LIMIT)
    option.disableflags |= int(flags.mjDSBL_CONTACT | flags.mjDSBL_ACTUATION)
    option.timestep, option.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    twin.put(run.q_tree[0], run.v_tree[0])
    mujoco.mj_step(twin.model, twin.data, nstep=2000)
    ends = twin.data.qpos.copy(), twin.data.qvel.copy()
    option.disableflags, option.timestep, option.integrator = before
    twin.put(run.q_tree[-1], run.v_tree[-1])
    assert np.abs(run.q_tree[-1] - run.q_tree[0]).max() > 0.2
    assert_close(twin.data.qpos, ends[0], 1e-8)
    assert_close(twin.data.qvel, ends[1], 1e-7)


def test_body_inertias_in_the_world_equal_mujocos(twin: Twin) -> None:
    """Mass, centre of mass and inertia of every body, which depend on geometry, joints, refs and solids."""
    for values, v in states(twin):
        q_tree, _ = twin.put(values, v)
        bodies = twin.bodies(q_tree)
        assert len(bodies) == twin.model.nbody - 1
        for ours, theirs in bodies.values():
            for mine, other in zip(ours, theirs, strict=True):
                assert_close(mine, other, TOLERANCE * np.abs(other).max())


def test_spring_and_damper_forces_equal_mujocos(twin: Twin) -> None:
    """Of joints, of tendons between two sites, and of actuators with damping."""
    for values, v in states(twin):
        q_tree, to = twin.put(values, v)
        ours, theirs = twin.passive_forces(q_tree, v, to)
        assert np.abs(theirs).max() > 0.1
        assert_close(ours, theirs, TOLERANCE * np.abs(theirs).max())


def test_loop_residuals_equal_mujocos(twin: Twin) -> None:
    """The distance, and for a weld the angle, of each equality constraint at states where loops are open."""
    for values, v in states(twin):
        q_tree, _ = twin.put(values, v)
        ours, theirs = twin.residuals(q_tree), twin.mujoco_residuals()
        assert set(ours) == set(theirs)
        assert_close([ours[name] for name in theirs], list(theirs.values()), TOLERANCE)


def test_guess_is_the_reference_pose(twin: Twin) -> None:
    """Including refs and the pose of the free body, because coordinates keep MuJoCo's values."""
    twin.put(np.array([twin.draft.q_guess.get(label, 0.0) for label in twin.tree.coordinates]), np.zeros(twin.tree.n))
    assert_close(twin.data.qpos, twin.model.qpos0, TOLERANCE)


def test_gravity_actuators_limits_and_damping_are_imported(machine: Draft) -> None:
    assert machine.gravity == (0.0, -1.5, -9.7)
    assert machine.actuated == ["shoulder", "reach"]
    joints = {j.get("name"): j for j in machine.robot.findall("joint")}
    assert joints["shoulder"].find("dynamics").get("damping") == "0.2"
    assert joints["wrist"].find("dynamics") is None  # the nested class removes the damping
    assert_close(float(joints["shoulder"].find("limit").get("lower")), math.radians(-170), EXACT)
    assert joints["reach"].get("type") == "prismatic"
    assert_close(float(joints["reach"].find("limit").get("upper")), 0.2, EXACT)
    assert joints["swing"].get("type") == "continuous"
    assert has_note(machine.guessed, "ball joint ball is three hinges, ball_x, ball_y, ball_z", "90 degrees")


def test_replicas_and_attached_models_keep_mujocos_names(tmp_path: Path) -> None:
    """And their motors, springs, armature and friction."""
    draft = read(write_workshop(tmp_path))
    assert draft.actuated == ["left_knee", "right_knee"]
    hip = draft.robot.find("joint[@name='right_hip']/limit")
    assert (hip.get("lower"), hip.get("upper")) == ("-1.2", "1.4")
    assert [spec.frame_b.link for spec, _ in draft.springs if spec.joint is None] == ["arm_1", "arm_2", "hub"]
    rotors = {spec.name: spec.armature for spec, _ in draft.joints}
    assert rotors == {"left_hip": 0.02, "left_knee": 0.11, "right_hip": 0.02, "right_knee": 0.11}
    friction = {
        j.get("name"): float(j.find("dynamics").get("friction")) for j in draft.robot.iterfind("joint[dynamics]")
    }
    assert friction == dict.fromkeys(friction, 0.0) | dict.fromkeys(("spin", "swing_0", "swing_1", "swing_2"), 0.1)
    assert has_note(draft.guessed, "hard stops without rebound", "left_hip, right_hip")
    assert not has_note(draft.left_out, "armature")
    assert not has_note(draft.left_out, "friction")
    assert [(spec.joint, spec.ratio) for spec, _ in draft.motors] == [("left_knee", 3.0), ("right_knee", 3.0)]


# --- loops ----------------------------------------------------------------------------------------------------------


def test_two_connects_between_two_bodies_are_a_hinge(tmp_path: Path) -> None:
    ends = "body1='rod' body2='right'"
    connects = f"<connect name='e' {ends} anchor='1 0 -.5'/><connect {ends} anchor='1 .1 -.5'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, comment),) = draft.loops
    assert (loop.name, loop.type) == ("e", "hinge")
    assert loop.axis_a == loop.axis_b == (0.0, 1.0, 0.0)
    assert "two connects 100 mm apart" in comment
    mechanism = draft.build_mechanism()
    assert (mechanism.closure.rows, mechanism.rank, mechanism.d) == (5, 2, 1)


def test_two_connects_by_sites_are_a_hinge_in_either_order(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='t2' site2='s2'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, _),) = draft.loops
    assert loop.type == "hinge"
    assert draft.build_mechanism().d == 1


def test_two_connects_at_different_distances_stay_points(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='s2' site2='t3'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point", "point"]


def test_unsupported_equalities_and_tendons_are_noted(tmp_path: Path) -> None:
    equality = """<equality><connect name="off" site1="s1" site2="t1" active="false"/>
      <tendon name="cable" tendon1="x"/></equality>
      <tendon><spatial name="x" limited="true" range="0 3"><site site="s1"/><site site="t1"/><site site="t2"/></spatial>
      </tendon><contact><exclude body1="left" body2="right"/></contact>"""
    draft = model(tmp_path, TWO_ARMS, equality)
    assert not draft.loops
    assert not draft.couplings
    assert has_note(draft.left_out, "off", "not active")
    assert has_note(draft.left_out, "<tendon> cable")
    assert has_note(draft.left_out, "a limit of tendon x")
    assert has_note(draft.left_out, "contact pairs")


def test_weld_without_torque_is_a_point(tmp_path: Path) -> None:
    draft = model(tmp_path, TWO_ARMS, "<equality><weld site1='s1' site2='t1' torquescale='0'/></equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point"]


def test_loop_within_one_rigid_body_is_left_out(tmp_path: Path) -> None:
    body = "<body name='a'><joint name='j'/><geom size='.1'/><body name='b' pos='1 0 0'><geom size='.1'/></body></body>"
    draft = model(tmp_path, body, "<equality><weld name='glue' body1='a' body2='b'/></equality>")
    assert not draft.loops
    assert has_note(draft.left_out, "loop glue", "one rigid body")


# --- roots ----------------------------------------------------------------------------------------------------------


def root(extra: str = "", ball: str = "") -> str:
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    slides = "".join(f"<joint name='{name}' type='slide' axis='{axis}'/>" for name, axis in axes.items())
    return (
        f"<body name='trunk' pos='0 0 1'>{slides}<joint name='turn' type='ball' {ball}/><geom size='.1'/>{extra}</body>"
    )


def test_three_slides_and_a_ball_are_a_free_root(tmp_path: Path) -> None:
    draft = model(tmp_path, root())
    mechanism = draft.build_mechanism()
    assert mechanism.coordinates == tuple(f"root.{a}" for a in ("x", "y", "z", "rx", "ry", "rz"))
    assert draft.q_guess == {"root.z": 1.0}
    assert has_note(draft.guessed, "three slides and the ball of body trunk")


def test_free_joint_starts_at_the_key_frame(tmp_path: Path) -> None:
    """The key frame "assembled" that `ckc export` writes; refs of the three slides are subtracted."""
    bodies = root().replace("type='slide'", "type='slide' ref='0.3'")
    keys = "<key name='other' qpos='0 0 2 1 0 0 0'/><key name='assembled' qpos='.5 .3 .3 .8 0 0 .6'/>"
    draft = model(tmp_path, bodies, f"<keyframe>{keys}</keyframe>")
    angle = 2 * math.atan2(0.6, 0.8)
    assert_close([draft.q_guess[f"root.{x}"] for x in ("x", "z", "rz")], [0.2, 1.0, angle], 1e-12)
    assert_close([draft.key_frames["other"][f"root.{x}"] for x in ("x", "y", "z", "rz")], [-0.3, -0.3, 2.7, 0], 1e-12)


def test_ball_joint_starts_at_the_key_frame(tmp_path: Path) -> None:
    ball = "<body name='b'><joint name='turn' type='ball'/><geom type='box' size='.1 .2 .3'/></body>"
    key = "<keyframe><key name='assembled' qpos='.5 .5 -.1 .7'/></keyframe>"
    draft = model(tmp_path, ball, key)
    twin = Twin(tmp_path / "thing.xml")
    twin.put(np.array([draft.q_guess[f"turn_{axis}"] for axis in "xyz"]), np.zeros(3))
    assert_close(twin.data.qpos, twin.model.key_qpos[0] / np.linalg.norm(twin.model.key_qpos[0]), 1e-12)


@pytest.mark.parametrize("ball", ["damping='0.1'", "pos='0 0 0.2'", "armature='0.01'"])
def test_slides_and_a_ball_with_other_properties_are_not_a_free_root(tmp_path: Path, ball: str) -> None:
    assert model(tmp_path, root(ball=ball)).build_mechanism().coordinates == (
        "x",
        "y",
        "z",
        "turn_x",
        "turn_y",
        "turn_z",
    )


def test_slides_that_are_used_stay(tmp_path: Path) -> None:
    draft = model(tmp_path, root(), "<actuator><motor joint='z'/></actuator>")
    assert draft.build_mechanism().coordinates[2] == "z"
    assert draft.actuated == ["z"]
