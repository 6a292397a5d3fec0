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
from tests.contract.helpers.models import TWO_ARMS, model, said, write_workshop
from tests.contract.helpers.mujoco_twin import Twin

MACHINE = Path(__file__).parent / "test_import_data" / "machine.xml"
EXACT = 1e-12
SAME = 1e-10


# --- the same machine in MuJoCo and here ----------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["machine", "workshop"])
def twin(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Twin:
    """A machine with every kind of orientation, solid and joint; one of replicas, attached models and meshes."""
    return Twin(MACHINE if request.param == "machine" else write_workshop(tmp_path_factory.mktemp("workshop")))


@pytest.fixture(scope="module")
def machine() -> Draft:
    return read(MACHINE)


def states(twin: Twin) -> list[tuple[Any, Any]]:
    """The reference pose and random ones farther and farther away."""
    random = np.random.default_rng(7)
    start = np.array([twin.draft.q_guess.get(label, 0.0) for label in twin.tree.coordinates])
    n = twin.tree.n
    return [(start + random.uniform(-far, far, n), random.normal(size=n)) for far in (0.0, 0.3, 0.6, 0.9, 1.2)]


def test_the_mass_matrix_is_mujocos(twin: Twin) -> None:
    for values, v in states(twin):
        q_tree, to = twin.put(values, v)
        ours, theirs = twin.mass_matrices(q_tree, to)
        assert_close(ours, theirs, EXACT * np.abs(theirs).max())


def test_the_free_motion_is_mujocos(twin: Twin, tmp_path: Path) -> None:
    """All loops cut, without friction and stops, which are soft there: the DAE against 2000 steps of RK4."""
    draft, flags = twin.draft, mujoco.mjtDisableBit
    rubbing = [j.get("name") for j in draft.robot.iterfind("joint") if j.find("dynamics[@friction]") is not None]
    bare = {name: JointSpec(name=name, friction=0.0) for name in rubbing}
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


def test_bodies_are_where_mujoco_has_them(twin: Twin) -> None:
    """Mass, centre of mass and inertia of every body in the world's axes: geometry, joints, refs and solids."""
    for values, v in states(twin):
        q_tree, _ = twin.put(values, v)
        bodies = twin.bodies(q_tree)
        assert len(bodies) == twin.model.nbody - 1
        for ours, theirs in bodies.values():
            for mine, other in zip(ours, theirs, strict=True):
                assert_close(mine, other, SAME * np.abs(other).max())


def test_springs_and_dampers_pull_as_mujocos(twin: Twin) -> None:
    """Those of joints, of tendons between two sites, and what actuators add to a joint's damping."""
    for values, v in states(twin):
        q_tree, to = twin.put(values, v)
        ours, theirs = twin.passive_forces(q_tree, v, to)
        assert np.abs(theirs).max() > 0.1
        assert_close(ours, theirs, SAME * np.abs(theirs).max())


def test_loops_miss_by_what_mujoco_says(twin: Twin) -> None:
    """The distance, and for a weld the angle, by which each equality constraint is not met anywhere."""
    for values, v in states(twin):
        q_tree, _ = twin.put(values, v)
        ours, theirs = twin.misses(q_tree), twin.their_misses()
        assert set(ours) == set(theirs)
        assert_close([ours[name] for name in theirs], list(theirs.values()), SAME)


def test_the_reference_pose_is_the_guess(twin: Twin) -> None:
    """Refs and the free body's pose; the coordinates keep MuJoCo's numbers."""
    twin.put(np.array([twin.draft.q_guess.get(label, 0.0) for label in twin.tree.coordinates]), np.zeros(twin.tree.n))
    assert_close(twin.data.qpos, twin.model.qpos0, SAME)


def test_what_else_the_machine_says(machine: Draft) -> None:
    assert machine.gravity == (0.0, -1.5, -9.7)
    assert machine.actuated == ["shoulder", "reach"]
    joints = {j.get("name"): j for j in machine.robot.findall("joint")}
    assert joints["shoulder"].find("dynamics").get("damping") == "0.2"
    assert joints["wrist"].find("dynamics") is None  # the nested class takes the damping away
    assert_close(float(joints["shoulder"].find("limit").get("lower")), math.radians(-170), EXACT)
    assert joints["reach"].get("type") == "prismatic"
    assert_close(float(joints["reach"].find("limit").get("upper")), 0.2, EXACT)
    assert joints["swing"].get("type") == "continuous"
    assert said(machine.guessed, "ball joint ball is three hinges, ball_x, ball_y, ball_z", "90 degrees")


def test_what_else_the_workshop_says(tmp_path: Path) -> None:
    """Replicas and attached models under the names that MuJoCo gives them; what has no counterpart by name."""
    draft = read(write_workshop(tmp_path))
    assert draft.actuated == ["left_knee", "right_knee"]
    hip = draft.robot.find("joint[@name='right_hip']/limit")
    assert (hip.get("lower"), hip.get("upper")) == ("-1.2", "1.4")
    assert [spec.frame_b.link for spec, _ in draft.springs if spec.joint is None] == ["arm_1", "arm_2", "hub"]
    rotors = {spec.name: spec.armature for spec, _ in draft.joints}
    assert rotors == {"left_hip": 0.02, "left_knee": 0.11, "right_hip": 0.02, "right_knee": 0.11}
    rubbing = {
        j.get("name"): float(j.find("dynamics").get("friction")) for j in draft.robot.iterfind("joint[dynamics]")
    }
    assert rubbing == dict.fromkeys(rubbing, 0.0) | dict.fromkeys(("spin", "swing_0", "swing_1", "swing_2"), 0.1)
    assert said(draft.guessed, "hard stops without rebound", "left_hip, right_hip")
    assert not said(draft.left_out, "armature")
    assert not said(draft.left_out, "friction")
    assert [(spec.joint, spec.ratio) for spec, _ in draft.motors] == [("left_knee", 3.0), ("right_knee", 3.0)]


# --- loops ----------------------------------------------------------------------------------------------------------


def test_two_connects_of_one_pair_are_a_hinge(tmp_path: Path) -> None:
    ends = "body1='rod' body2='right'"
    connects = f"<connect name='e' {ends} anchor='1 0 -.5'/><connect {ends} anchor='1 .1 -.5'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, comment),) = draft.loops
    assert (loop.name, loop.type) == ("e", "hinge")
    assert loop.axis_a == loop.axis_b == (0.0, 1.0, 0.0)
    assert "two connects 100 mm apart" in comment
    mechanism = draft.mechanism()
    assert (mechanism.closure.rows, mechanism.rank, mechanism.d) == (5, 2, 1)


def test_two_connects_by_sites_either_way_round(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='t2' site2='s2'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    ((loop, _),) = draft.loops
    assert loop.type == "hinge"
    assert draft.mechanism().d == 1


def test_two_connects_at_different_distances_stay_points(tmp_path: Path) -> None:
    connects = "<connect site1='s1' site2='t1'/><connect site1='s2' site2='t3'/>"
    draft = model(tmp_path, TWO_ARMS, f"<equality>{connects}</equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point", "point"]


def test_what_is_not_active_or_not_linear_or_not_known_is_said(tmp_path: Path) -> None:
    equality = """<equality><connect name="off" site1="s1" site2="t1" active="false"/>
      <joint name="cam" joint1="a" joint2="b" polycoef="0 1 0.5 0 0"/><tendon name="cable" tendon1="x"/></equality>
      <tendon><spatial name="x" limited="true" range="0 3"><site site="s1"/><site site="t1"/><site site="t2"/></spatial>
      </tendon><contact><exclude body1="left" body2="right"/></contact>"""
    draft = model(tmp_path, TWO_ARMS, equality + "<keyframe><key qpos='0 0 0'/></keyframe>")
    assert not draft.loops
    assert not draft.couplings
    assert said(draft.left_out, "off", "not active")
    assert said(draft.left_out, "joints a and b", "not linear")
    assert said(draft.left_out, "<tendon> cable")
    assert said(draft.left_out, "a limit of tendon x")
    assert said(draft.left_out, "contact pairs")
    assert said(draft.left_out, "key frames")


def test_a_weld_without_torque_is_a_point(tmp_path: Path) -> None:
    draft = model(tmp_path, TWO_ARMS, "<equality><weld site1='s1' site2='t1' torquescale='0'/></equality>")
    assert [loop.type for loop, _ in draft.loops] == ["point"]


def test_a_loop_within_one_rigid_body_is_left_out(tmp_path: Path) -> None:
    body = "<body name='a'><joint name='j'/><geom size='.1'/><body name='b' pos='1 0 0'><geom size='.1'/></body></body>"
    draft = model(tmp_path, body, "<equality><weld name='glue' body1='a' body2='b'/></equality>")
    assert not draft.loops
    assert said(draft.left_out, "loop glue", "one rigid body")


# --- roots ----------------------------------------------------------------------------------------------------------


def root(extra: str = "", ball: str = "") -> str:
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    slides = "".join(f"<joint name='{name}' type='slide' axis='{axis}'/>" for name, axis in axes.items())
    return (
        f"<body name='trunk' pos='0 0 1'>{slides}<joint name='turn' type='ball' {ball}/><geom size='.1'/>{extra}</body>"
    )


def test_three_slides_and_a_ball_are_a_free_root(tmp_path: Path) -> None:
    draft = model(tmp_path, root())
    mechanism = draft.mechanism()
    assert mechanism.coordinates == tuple(f"root.{a}" for a in ("x", "y", "z", "rx", "ry", "rz"))
    assert draft.q_guess == {"root.z": 1.0}
    assert said(draft.guessed, "three slides and the ball of body trunk")


def test_free_joints_start_where_the_file_says(tmp_path: Path) -> None:
    """The three slides' refs too, and the key frame that `ckc export` writes."""
    bodies = root().replace("type='slide'", "type='slide' ref='0.3'")
    keys = "<key name='assembled' qpos='.5 .3 .3 .8 0 0 .6'/><key name='other' qpos='0 0 0 1 0 0 0'/>"
    draft = model(tmp_path, bodies, f"<keyframe>{keys}</keyframe>")
    angle = 2 * math.atan2(0.6, 0.8)
    assert_close([draft.q_guess[f"root.{x}"] for x in ("x", "z", "rz")], [0.2, 1.0, angle], 1e-12)
    assert said(draft.left_out, "key frames")


def test_a_ball_starts_where_the_key_frame_says(tmp_path: Path) -> None:
    ball = "<body name='b'><joint name='turn' type='ball'/><geom type='box' size='.1 .2 .3'/></body>"
    key = "<keyframe><key name='assembled' qpos='.5 .5 -.1 .7'/></keyframe>"
    draft = model(tmp_path, ball, key)
    twin = Twin(tmp_path / "thing.xml")
    twin.put(np.array([draft.q_guess[f"turn_{axis}"] for axis in "xyz"]), np.zeros(3))
    assert_close(twin.data.qpos, twin.model.key_qpos[0] / np.linalg.norm(twin.model.key_qpos[0]), 1e-12)


@pytest.mark.parametrize("ball", ["damping='0.1'", "pos='0 0 0.2'", "armature='0.01'"])
def test_slides_and_a_ball_with_more_to_them_stay(tmp_path: Path, ball: str) -> None:
    assert model(tmp_path, root(ball=ball)).mechanism().coordinates == ("x", "y", "z", "turn_x", "turn_y", "turn_z")


def test_slides_that_are_used_stay(tmp_path: Path) -> None:
    draft = model(tmp_path, root(), "<actuator><motor joint='z'/></actuator>")
    assert draft.mechanism().coordinates[2] == "z"
    assert draft.actuated == ["z"]
