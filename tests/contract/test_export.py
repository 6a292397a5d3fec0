"""`ckc export --to mjcf` against MuJoCo itself: the same tree, constraints and forces."""

from __future__ import annotations

import re
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

# These have fixed and free roots, hinges, welds, redundant rows, couplings, massless links, constant forces and
# springs. "spatial" has armature, friction and stops, too.
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


class MujocoModel:
    """MuJoCo's model of a mechanism, set to Pinocchio's states."""

    def __init__(self, mechanism: Mechanism, text: str = "") -> None:
        self.tree = mechanism.tree
        self.model: Any = mujoco.MjModel.from_xml_string(text or export(mechanism, "mjcf").text)
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


def test_mass_matrix_and_bias_are_equal(mechanism: Mechanism) -> None:
    mujoco_model, tree = MujocoModel(mechanism), mechanism.tree
    for q_tree, v_tree in states(mechanism):
        to = mujoco_model.put(q_tree, v_tree)
        M = np.zeros((mujoco_model.model.nv, mujoco_model.model.nv))
        mujoco.mj_fullM(mujoco_model.model, mujoco_model.data, M)
        D = pin.crba(tree.model, tree.data, q_tree)
        assert_same(to.T @ M @ to, np.triu(D) + np.triu(D, 1).T, EXACT)
        if tree.is_euclidean:  # velocities of a free root are in rotating axes in Pinocchio only, so the bias differs
            assert_same(to.T @ mujoco_model.data.qfrc_bias, pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree))


def test_spring_damper_and_constant_forces_are_equal(mechanism: Mechanism) -> None:
    mujoco_model, springs = MujocoModel(mechanism), mechanism.springs
    for q_tree, v_tree in states(mechanism):
        to = mujoco_model.put(q_tree, v_tree)
        force = springs.elastic_force(q_tree) + springs.damping_force(q_tree, v_tree)
        assert_same(to.T @ (mujoco_model.data.qfrc_passive + mujoco_model.data.qfrc_actuator), force)


def test_constraints_are_equivalent(mechanism: Mechanism) -> None:
    """Satisfied at the assembled configuration, with the same admissible velocities."""
    mujoco_model = MujocoModel(mechanism)
    to = mujoco_model.put(mechanism.q_tree, np.zeros(mechanism.n))
    rows = mujoco_model.data.efc_J.reshape(-1, mujoco_model.model.nv)[: mujoco_model.data.ne] @ to
    assert np.abs(mujoco_model.data.efc_pos[: mujoco_model.data.ne]).max() < 1e-9 * mechanism.size
    assert np.linalg.matrix_rank(rows, tol=1e-9) == mechanism.rank
    assert np.abs(rows @ mechanism.assembled.rho).max() < 1e-9
    assert_same(mujoco_model.model.key("assembled").qpos, mujoco_model.data.qpos)


def test_points_are_sites_and_joints_have_motors(spatial: Mechanism) -> None:
    mujoco_model = MujocoModel(spatial)
    for q_tree, v_tree in states(spatial):
        mujoco_model.put(q_tree, v_tree)
        assert_same(mujoco_model.data.site("tip").xpos, spatial.point_positions(q_tree)["tip"])
    assert mujoco_model.model.actuator("a").trnid[0] == mujoco_model.model.joint("a").id
    assert_same(mujoco_model.model.opt.gravity, [1.0, 2.0, -9.0])


def test_torque_limits_are_exported() -> None:
    wheel = LINK.format("x", 1) + MOVES.format("a", "continuous", "base", "x", "0 0 0", "0 0 0", "0 1 0")
    motor = {"joint": "a", "ratio": -2.0, "torque_limit": [-0.5, 3.0]}
    mechanism = Mechanism.from_urdf(f'<robot name="r"><link name="base"/>{wheel}</robot>', motors=[motor])
    model: Any = mujoco.MjModel.from_xml_string(export(mechanism, "mjcf").text)
    assert model.actuator("a").forcerange.tolist() == [-0.5, 3.0]
    assert model.actuator("a").forcelimited[0]


def test_armature_friction_and_stops_are_exported(spatial: Mechanism) -> None:
    """A range without stops is exported as inactive."""
    model = MujocoModel(spatial).model
    joints = {name: model.joint(name) for name in spatial.coordinates}
    dofs = [joints[name].dofadr[0] for name in ("a", "b", "s", "w")]
    assert model.dof_armature[dofs].tolist() == [0.04, 0.3, 2.0, 0.0]
    assert model.dof_frictionloss[dofs].tolist() == [0.2, 0.0, 0.0, 0.0]
    is_active = {name: bool(joint.limited[0]) for name, joint in joints.items() if joint.range.any()}
    assert is_active == {"b": True, "s": False}
    assert model.joint("b").range.tolist() == model.joint("s").range.tolist() == [-9.0, 9.0]
    differences = export(spatial, "mjcf").differences
    for words in (
        "joints with dry friction creep in MuJoCo: a;",
        "stops are soft springs in MuJoCo: b;",
        "stops do not rebound in MuJoCo: b",
    ):
        assert any(words in difference for difference in differences), differences


def test_swing_of_the_five_bar_agrees_with_stiff_constraints() -> None:
    mujoco_model = MujocoModel(load("five_bar"))
    run = ckc_pin.simulate("five_bar/swing", {"t_end": 0.3})
    mujoco_model.model.opt.timestep, mujoco_model.model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    mujoco_model.model.eq_solref[:] = [2e-4, 1.0]
    mujoco_model.put(run.q_tree[0], run.v_tree[0])
    for _ in range(3000):
        mujoco.mj_step(mujoco_model.model, mujoco_model.data)
    ends = [mujoco_model.data.joint(name).qpos[0] for name in run.coordinates]
    assert np.abs(run.q_tree[-1] - run.q_tree[0]).max() > 0.1
    assert np.abs(ends - run.q_tree[-1]).max() < 1e-3


@pytest.mark.parametrize("name", ["five_bar", "slider_crank", "delta", "flyball", "two_ur5"])
def test_the_exported_file_moves_as_the_mechanism(name: str, tmp_path: Path) -> None:
    """With the time step, method and stiffness of the file that the command writes."""
    text = ckc("export", name, "--to", "mjcf", "--out", str(tmp_path)).out
    stated = re.search(r"measured within 1 s, from a start at 1 rad/s: (\S+) rad or m", text)
    assert stated
    assert float(stated[1]) < 1e-3
    mechanism = load(name)
    start = {"at": "assembled", "q_dot": dict.fromkeys(mechanism.independent, 0.7)}
    run = ckc_pin.simulate(mechanism, t_end=0.5, initial=start)
    mujoco_model = MujocoModel(mechanism, (tmp_path / f"{name}.xml").read_text())
    mujoco_model.put(mechanism.tree.from_coordinates(run.q_tree[0]), run.v_tree[0])
    while mujoco_model.data.time < 0.5 - 1e-9:
        mujoco.mj_step(mujoco_model.model, mujoco_model.data)
    joints = [name for name in run.coordinates if "." not in name]
    ends = {name: mujoco_model.data.joint(name).qpos[0] for name in joints}
    assert max(abs(run[name][-1] - run[name][0]) for name in joints) > 0.05
    assert max(abs(end - run[name][-1]) for name, end in ends.items()) < 1e-3


@pytest.fixture(params=[*shipped(), "spatial"], scope="module")
def round_trip(
    request: pytest.FixtureRequest, spatial: Mechanism, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Mechanism, Mechanism]:
    """A mechanism, and the mechanism imported from its export."""
    original = spatial if request.param == "spatial" else load(request.param)
    folder = tmp_path_factory.mktemp("back")
    (file,) = exporting.write(export(original, "mjcf"), folder)
    importing.write(importing.read(file), folder / "back")
    return original, load(folder / "back")


def test_export_and_import_keep_coordinates_and_configuration(round_trip: tuple[Mechanism, Mechanism]) -> None:
    """Coordinates, freedoms, actuated joints, gravity, assembled configuration and points."""
    original, imported = round_trip
    assert imported.coordinates == original.coordinates
    assert (imported.n, imported.rank, imported.d) == (original.n, original.rank, original.d)
    assert set(imported.actuated) == set(original.actuated)
    assert_same(imported.tree.model.gravity.linear, original.tree.model.gravity.linear)
    assert np.abs(imported.tree.difference(original.q_tree, imported.q_tree)).max() < 1e-8
    for q_tree, _ in states(original):
        ours, theirs = (mechanism.point_positions(q_tree) for mechanism in round_trip)
        assert set(ours) == set(theirs)
        assert all(np.abs(theirs[name] - ours[name]).max() < 1e-12 * max(1.0, original.size) for name in ours)


def test_export_and_import_keep_dynamics(round_trip: tuple[Mechanism, Mechanism]) -> None:
    """Mass matrix, bias, and the forces of springs, dampers and constant drives at random states."""
    for q_tree, v_tree in states(round_trip[0]):
        masses, biases, forces = [], [], []
        for mechanism in round_trip:
            tree, springs = mechanism.tree, mechanism.springs
            D = pin.crba(tree.model, tree.data, q_tree)
            masses.append(np.triu(D) + np.triu(D, 1).T)
            biases.append(pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree))
            forces.append(springs.elastic_force(q_tree) + springs.damping_force(q_tree, v_tree))
        for original, imported in (masses, biases, forces):
            assert_same(imported, original, 1e-10)


def test_export_and_import_keep_joint_properties(round_trip: tuple[Mechanism, Mechanism]) -> None:
    """Armature, friction, ranges and stops. Restitution is lost, because MuJoCo has none."""
    original, imported = round_trip
    for name in ("lower", "upper", "friction"):
        assert np.array_equal(getattr(imported.joints, name), getattr(original.joints, name)), name
    assert np.array_equal(imported.tree.model.armature, original.tree.model.armature)
    assert np.array_equal(imported.tree.limits(), original.tree.limits())
    assert not imported.joints.restitution.any()


def test_export_and_import_keep_constraints(round_trip: tuple[Mechanism, Mechanism]) -> None:
    """The sum of squares of phi and its gradient are equal, and J has the same row space where the loops are closed.

    The rows themselves may be resolved in other axes, and a planar loop has three rows after the round trip.
    """
    original, _ = round_trip
    for q_tree, _ in states(original):
        one, two = (mechanism.kinematics(q_tree) for mechanism in round_trip)
        assert_same(two.phi @ two.phi, one.phi @ one.phi, 1e-10)
        assert_same(two.phi @ two.J, one.phi @ one.J, 1e-10)
    one, two = (mechanism.kinematics(original.q_tree) for mechanism in round_trip)
    assert np.linalg.matrix_rank(np.vstack([one.J, two.J]), tol=1e-7) == original.rank


def test_model_is_printed_or_written(tmp_path: Path) -> None:
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


def test_point_2d_that_leaves_the_plane_is_refused(tmp_path: Path) -> None:
    text = SPATIAL["mechanism.toml"].replace('"distance"\nlength = 0.45', '"point_2d"')
    mechanism = load(write(tmp_path, SPATIAL | {"mechanism.toml": text}))
    with pytest.raises(InputError, match=r"loop 'rod': .* cannot express a point_2d whose frames leave"):
        export(mechanism, "mjcf")


@pytest.mark.parametrize("kind", ["cylindrical", "universal", "prismatic"])
def test_loops_without_equality_constraint_are_refused(kind: str, tmp_path: Path) -> None:
    axis = [0.0, float(kind == "universal"), 1.0]
    text = f"""
name = "held"
tree = [{{file = "b.urdf", root = "free"}}]
loop = [{{name = "hold", type = "{kind}", frame_a = "world", frame_b = "b", axis_b = {axis}}}]
"""
    mechanism = load(
        write(tmp_path, {"b.urdf": f'<robot name="b">{LINK.format("b", 1)}</robot>', "mechanism.toml": text})
    )
    with pytest.raises(
        InputError, match=f"loop 'hold': MuJoCo has no equality constraint for type '{kind}'; supported are point"
    ):
        export(mechanism, "mjcf")


def test_couplings_have_the_residuals_and_jacobians_of_mujoco() -> None:
    """A gear, the sum of three joints, and a polynomial of the fourth degree, away from the assembled configuration."""
    couplings: list[dict[str, Any]] = [
        {"joint": "a", "other": "b", "ratio": -2.5, "offset": 0.3},
        {"name": "sum", "joints": {"a": 2.0, "c": -0.7, "d": 0.3}, "offset": 0.4},
        {"joint": "d", "other": "c", "polynomial": [0.1, 1.0, -0.3, 0.2, 0.05], "offset": -0.2},
        {"joints": {"e": 2.0}, "offset": 0.3},
    ]
    parts = "".join(LINK.format(f"{x}1", 1) + MOVES.format(x, "continuous", "base", f"{x}1", "0 0 0", "0 0 0", "0 1 0")
                    for x in "abcde")  # fmt: skip
    mechanism = Mechanism.from_urdf(f'<robot name="r"><link name="base"/>{parts}</robot>', couplings=couplings)
    mujoco_model = MujocoModel(mechanism)
    scale = np.array([1.0, 1.0, 1.0, 2.0])  # MuJoCo's joint equality has the coefficient 1
    for q_tree, v_tree in states(mechanism):
        to = mujoco_model.put(q_tree, v_tree)
        rows = mujoco_model.data.efc_J.reshape(-1, mujoco_model.model.nv)[: mujoco_model.data.ne] @ to
        at = mechanism.kinematics(q_tree)
        assert_same(scale * mujoco_model.data.efc_pos[: mujoco_model.data.ne], at.phi, EXACT)
        assert_same(scale[:, None] * rows, at.J, EXACT)


@pytest.mark.parametrize(
    ("curve", "says"),
    [
        ({"polynomial": [0.0, 1.0, 0.0, 0.0, 0.0, 0.2]}, "a polynomial of degree 5"),
        ({"table": [[-1.0, 0.0], [0.0, 0.1], [1.0, 0.5]]}, "a table"),
    ],
)
def test_curves_without_equality_constraint_are_refused(curve: dict[str, Any], says: str) -> None:
    mechanism = Mechanism.from_urdf(
        f'<robot name="r"><link name="base"/>{LINK.format("x", 1)}{LINK.format("y", 1)}'
        + MOVES.format("a", "continuous", "base", "x", "0 0 0", "0 0 0", "0 1 0")
        + MOVES.format("b", "continuous", "base", "y", "0 0 0", "0 0 0", "0 1 0")
        + "</robot>",
        couplings=[{"joint": "a", "other": "b", **curve}],
    )
    with pytest.raises(InputError, match=f"coupling 'a~b': MuJoCo has no equality constraint for {says}"):
        export(mechanism, "mjcf")


def test_unknown_format_is_refused() -> None:
    refused = ckc("export", "five_bar", "--to", "obj")
    assert refused.code == 2
    assert "'obj' is not one of 'mjcf', 'urdf', 'sdf'" in refused.err
