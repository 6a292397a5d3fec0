"""`ckc export --to mjcf` against MuJoCo itself: the same tree, the same closure, the same forces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import ckc_pin
from ckc_pin import InputError, Mechanism, load
from ckc_pin.formats import exporting, importing
from ckc_pin.formats.exporting import export
from ckc_pin.mechanism.library import shipped
from tests.contract.helpers.command import ckc

# flat trees, free roots, hinges, welds, redundant rows, couplings, massless links, constant forces, springs; of
# "spatial" rotors, friction and stops too
SHIPPED = ["five_bar", "andrews", "bricard", "stewart", "two_ur5", "slider_crank_spatial"]

EXACT = 1e-12  # relative to the largest entry

LINK = """<link name="{0}"><inertial><origin xyz="0.1 0.02 0.01"/><mass value="{1}"/>
<inertia ixx="1e-3" iyy="2e-3" izz="2.5e-3" ixy="1e-4" ixz="0" iyz="-2e-4"/></inertial></link>"""
MOVES = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4}" rpy="{5}"/>
<axis xyz="{6}"/><dynamics damping="0.03"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>"""

SPATIAL = {
    "s.urdf": "\n".join(
        [
            '<robot name="s"><link name="base"/>',
            *(LINK.format(name, mass) for name, mass in (("crank", 1), ("rocker", 2), ("block", 0.5), ("wheel", 0.3))),
            MOVES.format("a", "continuous", "base", "crank", "0 0 0", "0.1 0.2 0.3", "0 0.6 0.8"),
            MOVES.format("b", "revolute", "base", "rocker", "0.5 0.1 0", "0 0 0.4", "0 1 0"),
            MOVES.format("s", "prismatic", "rocker", "block", "0.1 0 0.1", "0.3 0 0", "1 0 0"),
            MOVES.format("w", "continuous", "crank", "wheel", "0.2 0 0", "0 0 0", "1 0 0"),
            "</robot>",
        ]
    ),
    "mechanism.toml": """
name = "s"
urdf = "s.urdf"
gravity = [1.0, 2.0, -9.0]
actuated = ["a"]
q_guess = {a = 0.3, b = -0.4}
[[loop]]
name = "rod"
type = "distance"
length = 0.45
frame_a = {link = "crank", xyz = [0.2, 0, 0]}
frame_b = {link = "block", xyz = [0.2, 0, 0]}
[[coupling]]
joint = "w"
other = "a"
ratio = -2.5
offset = 0.3
[[spring]]
joint = "s"
rest = 0.05
stiffness = 300.0
damping = 2.0
[[spring]]
frame_a = "base"
frame_b = {link = "block", xyz = [0, 0.1, 0]}
rest_length = 0.2
stiffness = 40.0
damping = 1.5
[[force]]
joint = "b"
value = -0.7
[[joint]]
name = "a"
armature = 0.04
friction = 0.2
[[joint]]
name = "b"
armature = 0.3
stops = true
restitution = 0.5
[[joint]]
name = "s"
armature = 2.0
damping = 0.4
[[point]]
name = "tip"
frame = {link = "block", xyz = [0.2, 0, 0]}
""",
}


@pytest.fixture(scope="module")
def spatial(tmp_path_factory: pytest.TempPathFactory) -> Mechanism:
    return load(write(tmp_path_factory.mktemp("spatial"), SPATIAL))


class Peer:
    """MuJoCo's model of a mechanism, set to Pinocchio's states."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.tree = mechanism.tree
        self.model: Any = mujoco.MjModel.from_xml_string(export(mechanism, "mjcf").text)
        self.data: Any = mujoco.MjData(self.model)

    def put(self, q_tree: Any, v_tree: Any) -> Any:
        """Set a state; return the map from Pinocchio's velocities to MuJoCo's."""
        model, data = self.tree.model, self.tree.data
        pin.forwardKinematics(model, data, q_tree)
        velocities = np.zeros((self.model.nv, self.tree.n))
        for k in range(1, model.njoints):
            joint, there = model.joints[k], self.model.joint(model.names[k])
            at, to = there.qposadr[0], there.dofadr[0]
            if joint.nv == 1:
                self.data.qpos[at] = q_tree[joint.idx_q]
                velocities[to, joint.idx_v] = 1.0
            else:  # MuJoCo: position, w, x, y, z; linear velocity in the world's axes, angular in the body's
                rotation = data.oMi[k].rotation
                x, y, z, w = pin.Quaternion(rotation).coeffs()
                self.data.qpos[at : at + 7] = [*data.oMi[k].translation, w, x, y, z]
                velocities[to : to + 3, joint.idx_v : joint.idx_v + 3] = rotation
                velocities[to + 3 : to + 6, joint.idx_v + 3 : joint.idx_v + 6] = np.eye(3)
        self.data.qvel[:] = velocities @ v_tree
        mujoco.mj_forward(self.model, self.data)
        return velocities


@pytest.fixture(params=[*SHIPPED, "spatial"])
def mechanism(request: pytest.FixtureRequest, spatial: Mechanism) -> Mechanism:
    return spatial if request.param == "spatial" else load(request.param)


def states(mechanism: Mechanism) -> list[tuple[Any, Any]]:
    random = np.random.default_rng(3)
    q_tree = [mechanism.tree.integrate(mechanism.q_tree, random.normal(size=mechanism.n)) for _ in range(4)]
    return [(x, random.normal(size=mechanism.n)) for x in q_tree]


def assert_same(ours: Any, theirs: Any, tolerance: float = 1e-9) -> None:
    assert np.abs(ours - theirs).max() < tolerance * max(1e-3, np.abs(theirs).max())


def test_the_tree_is_the_same(mechanism: Mechanism) -> None:
    peer, tree = Peer(mechanism), mechanism.tree
    for q_tree, v_tree in states(mechanism):
        to = peer.put(q_tree, v_tree)
        M = np.zeros((peer.model.nv, peer.model.nv))
        mujoco.mj_fullM(peer.model, peer.data, M)
        D = pin.crba(tree.model, tree.data, q_tree)
        assert_same(to.T @ M @ to, np.triu(D) + np.triu(D, 1).T, EXACT)
        if tree.is_euclidean:  # a free root's axes turn, and the bias with them
            assert_same(to.T @ peer.data.qfrc_bias, pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree))


def test_springs_dampers_and_constant_forces_are_the_same(mechanism: Mechanism) -> None:
    peer, springs = Peer(mechanism), mechanism.springs
    for q_tree, v_tree in states(mechanism):
        to = peer.put(q_tree, v_tree)
        force = springs.elastic_force(q_tree) + springs.damping_force(q_tree, v_tree)
        assert_same(to.T @ (peer.data.qfrc_passive + peer.data.qfrc_actuator), force)


def test_the_closure_is_the_same(mechanism: Mechanism) -> None:
    """Closed where it is closed here, and for the same motions."""
    peer = Peer(mechanism)
    to = peer.put(mechanism.q_tree, np.zeros(mechanism.n))
    rows = peer.data.efc_J.reshape(-1, peer.model.nv)[: peer.data.ne] @ to
    assert np.abs(peer.data.efc_pos[: peer.data.ne]).max() < 1e-9 * mechanism.size
    assert np.linalg.matrix_rank(rows, tol=1e-9) == mechanism.rank
    assert np.abs(rows @ mechanism.assembled.rho).max() < 1e-9
    assert_same(peer.model.key("assembled").qpos, peer.data.qpos)


def test_points_are_sites_and_joints_have_motors(spatial: Mechanism) -> None:
    peer = Peer(spatial)
    for q_tree, v_tree in states(spatial):
        peer.put(q_tree, v_tree)
        assert_same(peer.data.site("tip").xpos, spatial.point_positions(q_tree)["tip"])
    assert peer.model.actuator("a").trnid[0] == peer.model.joint("a").id
    assert_same(peer.model.opt.gravity, [1.0, 2.0, -9.0])


def test_joints_have_their_rotors_friction_and_stops(spatial: Mechanism) -> None:
    """A range without stops is there, and does not act."""
    model = Peer(spatial).model
    found = {name: (model.joint(name), model.joint(name).dofadr[0]) for name in spatial.coordinates}
    assert {name: model.dof_armature[dof] for name, (_, dof) in found.items()} == {"a": 0.04, "b": 0.3, "s": 2, "w": 0}
    assert {name: model.dof_frictionloss[dof] for name, (_, dof) in found.items()} == {"a": 0.2, "b": 0, "s": 0, "w": 0}
    assert {name: bool(joint.limited[0]) for name, (joint, _) in found.items() if joint.range.any()} == {
        "b": True,
        "s": False,
    }
    assert model.joint("b").range.tolist() == model.joint("s").range.tolist() == [-9.0, 9.0]
    said = export(spatial, "mjcf").differs
    for words in (
        "dry friction lets joints creep there: a;",
        "stops are soft springs there: b;",
        "not rebound there: b",
    ):
        assert any(words in difference for difference in said), said


def test_a_swing_is_the_same_as_far_as_springs_can_close_loops() -> None:
    peer = Peer(load("five_bar"))
    run = ckc_pin.simulate("five_bar/swing", {"t_end": 0.3})
    peer.model.opt.timestep, peer.model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    peer.model.eq_solref[:] = [2e-4, 1.0]
    peer.put(run.q_tree[0], run.v_tree[0])
    for _ in range(3000):
        mujoco.mj_step(peer.model, peer.data)
    ends = [peer.data.joint(name).qpos[0] for name in run.coordinates]
    assert np.abs(run.q_tree[-1] - run.q_tree[0]).max() > 0.1
    assert np.abs(ends - run.q_tree[-1]).max() < 1e-3


@pytest.fixture(params=[*shipped(), "spatial"], scope="module")
def there_and_back(
    request: pytest.FixtureRequest, spatial: Mechanism, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Mechanism, Mechanism]:
    """A mechanism, and what import makes of its export."""
    here = spatial if request.param == "spatial" else load(request.param)
    folder = tmp_path_factory.mktemp("back")
    file = exporting.write(export(here, "mjcf"), folder)
    importing.write(importing.read(file), folder / "back")
    return here, load(folder / "back")


def test_it_comes_back(there_and_back: tuple[Mechanism, Mechanism]) -> None:
    """Coordinates, freedoms, what is driven, gravity, the assembled configuration, points."""
    here, back = there_and_back
    assert back.coordinates == here.coordinates
    assert (back.n, back.rank, back.d) == (here.n, here.rank, here.d)
    assert set(back.actuated) == set(here.actuated)
    assert_same(back.tree.model.gravity.linear, here.tree.model.gravity.linear)
    assert np.abs(back.tree.difference(here.q_tree, back.q_tree)).max() < 1e-8
    for q_tree, _ in states(here):
        ours, theirs = (mechanism.point_positions(q_tree) for mechanism in there_and_back)
        assert set(ours) == set(theirs)
        assert all(np.abs(theirs[name] - ours[name]).max() < 1e-12 * max(1.0, here.size) for name in ours)


def test_its_dynamics_come_back(there_and_back: tuple[Mechanism, Mechanism]) -> None:
    """Mass matrix, bias and the forces of springs, dampers and constant drives at random states."""
    for q_tree, v_tree in states(there_and_back[0]):
        masses, biases, forces = [], [], []
        for mechanism in there_and_back:
            tree, springs = mechanism.tree, mechanism.springs
            D = pin.crba(tree.model, tree.data, q_tree)
            masses.append(np.triu(D) + np.triu(D, 1).T)
            biases.append(pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree))
            forces.append(springs.elastic_force(q_tree) + springs.damping_force(q_tree, v_tree))
        for here, back in (masses, biases, forces):
            assert_same(back, here, 1e-10)


def test_its_joints_come_back(there_and_back: tuple[Mechanism, Mechanism]) -> None:
    """Rotors, friction, ranges and stops; but for what they rebound."""
    here, back = there_and_back
    for name in ("lower", "upper", "friction"):
        assert np.array_equal(getattr(back.joints, name), getattr(here.joints, name)), name
    assert np.array_equal(back.tree.model.armature, here.tree.model.armature)
    assert np.array_equal(back.tree.limits(), here.tree.limits())
    assert not back.joints.restitution.any()


def test_its_closure_comes_back(there_and_back: tuple[Mechanism, Mechanism]) -> None:
    """Missed by as much everywhere, in the same direction; where it is closed it admits the same motions.

    Rows may be resolved in other axes, those of a planar loop be three: the sum of their squares and its gradient
    are the same, and where they are zero the space that J spans.
    """
    here, _ = there_and_back
    for q_tree, _ in states(here):
        one, two = (mechanism.kinematics(q_tree) for mechanism in there_and_back)
        assert_same(two.phi @ two.phi, one.phi @ one.phi, 1e-10)
        assert_same(two.phi @ two.J, one.phi @ one.J, 1e-10)
    one, two = (mechanism.kinematics(here.q_tree) for mechanism in there_and_back)
    assert np.linalg.matrix_rank(np.vstack([one.J, two.J]), tol=1e-7) == here.rank


def test_printed_or_written(tmp_path: Path) -> None:
    printed = ckc("export", "five_bar")
    assert printed.code == 0
    assert mujoco.MjModel.from_xml_string(printed.out).nv == 4
    assert "differs: loop elbow" in printed.err
    written = ckc("export", "five_bar", "--out", str(tmp_path / "m"), "--json").json
    assert written["written"] == [str(tmp_path / "m" / "five_bar.xml")]
    assert (tmp_path / "m" / "five_bar.xml").read_text(encoding="utf-8") == printed.out.rstrip("\n") + "\n"
    again = ckc("export", "five_bar", "--out", str(tmp_path / "m"))
    assert again.code == 2
    assert "there already" in again.err
    assert ckc("export", "five_bar", "--out", str(tmp_path / "m"), "--overwrite").code == 0


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def test_a_plane_that_is_left_is_refused(tmp_path: Path) -> None:
    text = SPATIAL["mechanism.toml"].replace('"distance"\nlength = 0.45', '"point_2d"')
    mechanism = load(write(tmp_path, SPATIAL | {"mechanism.toml": text}))
    with pytest.raises(InputError, match="loop 'rod': MuJoCo has no equality for a point_2d whose frames leave"):
        export(mechanism, "mjcf")


@pytest.mark.parametrize("kind", ["cylindrical", "universal", "prismatic"])
def test_loops_that_mujoco_has_not_are_refused(kind: str, tmp_path: Path) -> None:
    axis = [0.0, float(kind == "universal"), 1.0]
    text = f"""
name = "held"
tree = [{{file = "b.urdf", root = "free"}}]
loop = [{{name = "hold", type = "{kind}", frame_a = "world", frame_b = "b", axis_b = {axis}}}]
"""
    mechanism = load(
        write(tmp_path, {"b.urdf": f'<robot name="b">{LINK.format("b", 1)}</robot>', "mechanism.toml": text})
    )
    with pytest.raises(InputError, match=f"loop 'hold': MuJoCo has no equality for type '{kind}'; it has for point"):
        export(mechanism, "mjcf")


def test_another_format_is_refused() -> None:
    refused = ckc("export", "five_bar", "--to", "sdf")
    assert refused.code == 2
    assert "'sdf' is not 'mjcf'" in refused.err
