"""`ckc import` of USD physics: stages written by pxr, compared with equations of the test's own.

Chains are compared with NumPy, masses with pxr's own `ComputeMassProperties`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils
from scipy.spatial.transform import Rotation

import ckc_pin
from ckc_pin import CkcError, InputError
from ckc_pin.base.arrays import Array
from ckc_pin.errors import ImportNote
from ckc_pin.formats.importing import Draft, read, read_robot
from tests.conftest import assert_close
from tests.contract.test_import_urdf import has_note

AXES = np.eye(3)
UNITS = [(1.0, 1.0, "Z"), (0.01, 0.001, "Y")]  # metres and kilograms per unit, up axis


def pose(position: Sequence[float] | Array, rotation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


class Writer:
    """A stage with few digits in each number, so that single precision represents them exactly."""

    def __init__(self, path: Path, length: float = 1.0, mass: float = 1.0, up: str = "Z") -> None:
        self.path, self.length, self.mass = path, length, mass
        self.stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageMetersPerUnit(self.stage, length)
        UsdPhysics.SetStageKilogramsPerUnit(self.stage, mass)
        UsdGeom.SetStageUpAxis(self.stage, up)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/chain").GetPrim())

    def body(
        self, name: str, at: Array | None = None, mass: float = 0.0, centre: Sequence[float] = (), inertia: Any = None
    ) -> Any:
        """A rigid body at a pose of the world; lengths in units of the stage."""
        prim = UsdGeom.Xform.Define(self.stage, f"/chain/{name}")
        if at is not None:
            prim.AddTransformOp().Set(Gf.Matrix4d(at.T))
        UsdPhysics.RigidBodyAPI.Apply(prim.GetPrim())
        api = UsdPhysics.MassAPI.Apply(prim.GetPrim())
        if mass:
            api.CreateMassAttr(mass)
        if len(centre):
            api.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, centre)))
        if inertia is not None:
            moments, axes = inertia
            api.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, moments)))
            api.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, axes)))
        return prim.GetPrim()

    def joint(
        self, kind: str, name: str, bodies: Sequence[str | None], *frames: tuple[Any, Any], **attributes: Any
    ) -> Any:
        joint = getattr(UsdPhysics, kind).Define(self.stage, f"/chain/{name}")
        for k, (body, (position, quaternion)) in enumerate(
            zip(bodies, frames or (((0, 0, 0), (1, 0, 0, 0)),) * 2, strict=True)
        ):
            if body:
                getattr(joint, f"CreateBody{k}Rel")().SetTargets([f"/chain/{body}"])
            getattr(joint, f"CreateLocalPos{k}Attr")(Gf.Vec3f(*map(float, position)))
            getattr(joint, f"CreateLocalRot{k}Attr")(Gf.Quatf(*map(float, quaternion)))
        for key, value in attributes.items():
            getattr(joint, f"Create{key}Attr")(value)
        return joint.GetPrim()

    def limit(self, joint: Any, freedom: str, low: float, high: float) -> None:
        api = UsdPhysics.LimitAPI.Apply(joint, freedom)
        api.CreateLowAttr(low)
        api.CreateHighAttr(high)

    def lock(self, joint: Any, *freedoms: str) -> None:
        for freedom in freedoms:
            self.limit(joint, freedom, 1.0, -1.0)

    def drive(self, joint: Any, freedom: str, **attributes: Any) -> None:
        api = UsdPhysics.DriveAPI.Apply(joint, freedom)
        for key, value in attributes.items():
            getattr(api, f"Create{key}Attr")(value)

    def read(self) -> Draft:
        self.stage.GetRootLayer().Save()
        return read(self.path)


@pytest.fixture
def writer(tmp_path: Path) -> Writer:
    return Writer(tmp_path / "chain.usda")


# --- random chains -------------------------------------------------------------------------------------------------

KINDS = {  # slides, hinges
    "revolute": ("", "Y"), "prismatic": ("Z", ""), "fixed": ("", ""), "ball": ("", "XYZ"),
    "universal": ("", "XZ"), "cylindrical": ("Y", "Y"), "planar": ("XZ", "Y"), "swivel": ("", "YZ"),
    "cartesian": ("XYZ", ""), "slot": ("X", "Z"),
}  # fmt: skip


class Chain:
    """A random chain with one body a joint, and its kinematics and inertia in NumPy."""

    def __init__(self, writer: Writer, kinds: Sequence[str], seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.kinds, self.frames, self.bodies = kinds, [], []
        length, mass = 1 / writer.length, 1 / writer.mass
        for k, kind in enumerate(kinds):
            frames = [(self.digits(3), self.digits(4)) for _ in "ab"]
            body = (self.random.uniform(0.5, 2.0), self.digits(3), self.random.uniform(0.3, 0.5, 3), self.digits(4))
            body = (round(body[0], 4), body[1], body[2].round(4), body[3])
            self.frames.append([pose(p, Rotation.from_quat(q, scalar_first=True).as_matrix()) for p, q in frames])
            self.bodies.append(body)
            inertia = (body[2] * mass * length**2, body[3])
            writer.body(f"b{k}", None, body[0] * mass, body[1] * length, inertia)
            ends = [(p * length, q) for p, q in frames]
            self.joint(writer, k, kind, (f"b{k - 1}" if k else None, f"b{k}"), ends)

    def digits(self, count: int) -> Array:
        return self.random.uniform(-1.0, 1.0, count).round(4)

    def joint(self, writer: Writer, k: int, kind: str, bodies: Sequence[str | None], ends: Any) -> None:
        slides, hinges = KINDS[kind]
        native = {
            "revolute": "RevoluteJoint",
            "prismatic": "PrismaticJoint",
            "fixed": "FixedJoint",
            "ball": "SphericalJoint",
        }
        if kind in native:
            axis = {"Axis": slides or hinges} if len(slides + hinges) == 1 else {}
            writer.joint(native[kind], f"j{k}", bodies, *ends, **axis)
            return
        generic = writer.joint("Joint", f"j{k}", bodies, *ends)
        writer.lock(
            generic, *(f"trans{a}" for a in "XYZ" if a not in slides), *(f"rot{a}" for a in "XYZ" if a not in hinges)
        )

    def labels(self, k: int) -> list[str]:
        slides, hinges = KINDS[self.kinds[k]]
        names = [f"trans{a}" for a in slides] + [f"rot{a}" for a in hinges]
        return [f"j{k}"] if len(names) == 1 else [f"j{k}_{name}" for name in names]

    def terms(self, q: dict[str, float], gravity: Array) -> tuple[Array, Array]:
        """Mass matrix and gravity forces: sums over the bodies, whose velocities are sums over the axes."""
        at, poses = np.eye(4), []
        axes: list[tuple[bool, Array, Array, int]] = []  # slides, direction, point, first body that it moves
        for k, kind in enumerate(self.kinds):
            at, (slides, hinges) = at @ self.frames[k][0], KINDS[kind]
            for j, (label, letter) in enumerate(zip(self.labels(k), slides + hinges, strict=True)):
                axis = AXES["XYZ".index(letter)]
                is_slide = j < len(slides)
                axes.append((is_slide, at[:3, :3] @ axis, at[:3, 3].copy(), k))
                turn = np.eye(3) if is_slide else Rotation.from_rotvec(axis * q[label]).as_matrix()
                at = at @ pose(axis * q[label] * is_slide, turn)
            at = at @ np.linalg.inv(self.frames[k][1])
            poses.append(at)
        matrix, forces = np.zeros((len(axes), len(axes))), np.zeros(len(axes))
        for k, (mass, centre, moments, quaternion) in enumerate(self.bodies):
            place = (poses[k] @ [*centre, 1.0])[:3]
            rotation = poses[k][:3, :3] @ Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            linear, angular = np.zeros((3, len(axes))), np.zeros((3, len(axes)))
            for column, (is_slide, direction, point, first) in enumerate(axes):
                if first <= k:
                    linear[:, column] = direction if is_slide else np.cross(direction, place - point)
                    angular[:, column] = 0.0 if is_slide else direction
            matrix += mass * linear.T @ linear + angular.T @ rotation @ np.diag(moments) @ rotation.T @ angular
            forces -= mass * linear.T @ gravity
        return matrix, forces


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("units", UNITS)
def test_chain_has_the_mass_matrix_of_its_kinematics(
    tmp_path: Path, seed: int, units: tuple[float, float, str]
) -> None:
    random = np.random.default_rng(100 + seed)
    kinds = [str(kind) for kind in random.permutation(list(KINDS))]
    writer = Writer(tmp_path / "chain.usda", *units)
    chain = Chain(writer, kinds, seed)
    draft = writer.read()
    mechanism = draft.build_mechanism()
    labels = [label for k in range(len(kinds)) for label in chain.labels(k)]
    order = [labels.index(label) for label in mechanism.coordinates]
    q = dict(zip(labels, random.uniform(-1.0, 1.0, len(labels)).tolist(), strict=True))
    matrix, forces = chain.terms(q, -9.81 * AXES["XYZ".index(units[2])])
    ours, ours_forces = tree_terms(mechanism, [q[label] for label in mechanism.coordinates])
    assert_close(ours, matrix[np.ix_(order, order)], 1e-13, relative=True)
    assert_close(ours_forces, forces[order], 1e-13, relative=True)
    notes = ("units of 0.01 m", "units of 0.001 kg", "y axis of the stage")
    assert all(has_note(draft.guessed, note) == (units[2] == "Y") for note in notes)


def tree_terms(mechanism: Any, q: Sequence[float]) -> tuple[Array, Array]:
    """Mass matrix and gravity forces of the imported tree, which Pinocchio computes."""
    model, q_tree = mechanism.tree.model, np.array(q)
    upper = np.triu(pin.crba(model, model.createData(), q_tree))
    return upper + np.triu(upper, 1).T, pin.computeGeneralizedGravity(model, model.createData(), q_tree)


OBLIQUE = (0.8, 0.0, 0.6, 0.0)  # a quaternion


def join_as_mujoco(writer: Writer, name: str, axis: str, turn: Sequence[float], at: Sequence[float] = (0, 0, 0)) -> Any:
    """Add a hinge of MuJoCo between bodies a and b, whose frames have one orientation and one origin in each body."""
    ends = ((np.add(at, (0.1, 0.2, 0.3)), turn), ((-0.1, 0.05, 0.0), turn))
    prim = writer.joint("RevoluteJoint", name, ("a", "b"), *ends, Axis=axis)
    prim.SetMetadata("apiSchemas", Sdf.TokenListOp.CreateExplicit(["MjcJointAPI"]))
    return prim


def test_joints_of_two_bodies_from_mujoco_move_one_after_the_other(writer: Writer) -> None:
    """MuJoCo applies the joints of a body in their order. The third axis is not perpendicular to the others."""
    for name in "ab":
        writer.body(name, **LINK)
    writer.joint("RevoluteJoint", "base", (None, "a"), Axis="Z")
    straight = (1.0, 0.0, 0.0, 0.0)
    for name, axis, turn in (("p", "X", straight), ("q", "Z", straight), ("r", "Y", OBLIQUE), ("s", "X", OBLIQUE)):
        join_as_mujoco(writer, name, axis, turn)
    draft = writer.read()
    mechanism = draft.build_mechanism()
    assert mechanism.coordinates == ("base", "p", "q", "r", "s")
    assert has_note(draft.guessed, "joints behind another one of the same two bodies, as in MuJoCo: q, r, s")
    oblique = Rotation.from_quat(OBLIQUE, scalar_first=True).as_matrix()
    axes = {"p": AXES[0], "q": AXES[2], "r": oblique @ AXES[1], "s": oblique @ AXES[0]}
    hinges = "".join(
        f'<joint name="{name}" pos="-0.1 0.05 0" axis="{" ".join(map(str, axis))}" armature="1"/>'
        for name, axis in axes.items()
    )  # Without rotors, the mass matrix of four hinges through one point is singular, of which MuJoCo writes a log.
    inertial = '<inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint name="base" axis="0 0 1"/>{inertial}'
        f'<body pos="0.2 0.15 0.3">{hinges}{inertial}</body></body></worldbody></mujoco>'
    )
    data, theirs = mujoco.MjData(model), np.zeros((5, 5))
    data.qpos = np.random.default_rng(4).uniform(-1, 1, 5)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, theirs)
    ours, forces = tree_terms(mechanism, data.qpos)
    assert_close(ours, theirs - np.diag(model.dof_armature), 1e-7, relative=True)  # OBLIQUE has single precision
    assert_close(forces, data.qfrc_bias, 1e-6)


@pytest.mark.parametrize("units", UNITS)
def test_authored_pose_is_where_the_assembly_starts(tmp_path: Path, units: tuple[float, float, str]) -> None:
    """Bodies that are drawn at other values of the joints than zero."""
    writer = Writer(tmp_path / "chain.usda", *units)
    chain = Chain(writer, [*KINDS], 7)
    random, at, expected = np.random.default_rng(8), np.eye(4), {}
    for k, kind in enumerate(chain.kinds):
        at, (slides, _) = at @ chain.frames[k][0], KINDS[kind]
        values = random.uniform(-1.4, 1.4, len(chain.labels(k)) if kind != "fixed" else 0)
        for j, (label, letter, value) in enumerate(zip(chain.labels(k), "".join(KINDS[kind]), values, strict=True)):
            axis = AXES["XYZ".index(letter)]
            turn = np.eye(3) if j < len(slides) else Rotation.from_rotvec(value * axis).as_matrix()
            at, expected[label] = at @ pose(axis * value * (j < len(slides)), turn), value
        at = at @ np.linalg.inv(chain.frames[k][1])
        prim = UsdGeom.Xformable(writer.stage.GetPrimAtPath(f"/chain/b{k}"))
        prim.AddTransformOp().Set(Gf.Matrix4d(pose(at[:3, 3] / writer.length, at[:3, :3]).T))
    draft = writer.read()
    assert set(draft.q_guess) == set(expected)
    assert_close([draft.q_guess[label] for label in expected], [*expected.values()], 1e-12)


# --- masses --------------------------------------------------------------------------------------------------------


def add_shapes(writer: Writer, parent: str) -> list[Any]:
    """Collision shapes in a body, whose frames have a scale."""
    sizes: dict[str, dict[str, Any]] = {
        "Cube": {"Size": 0.4}, "Sphere": {"Radius": 0.2}, "Cylinder": {"Radius": 0.1, "Height": 0.7, "Axis": "X"},
        "Capsule": {"Radius": 0.15, "Height": 0.5, "Axis": "Y"},
    }  # fmt: skip
    prims = []
    for k, (kind, values) in enumerate(sizes.items()):
        shape = getattr(UsdGeom, kind).Define(writer.stage, f"/chain/{parent}/{kind.lower()}")
        for key, value in values.items():
            getattr(shape, f"Create{key}Attr")(value)
        shape.AddTranslateOp().Set(Gf.Vec3d(0.3 * k, -0.2, 0.1 * k))
        shape.AddRotateXYZOp().Set(Gf.Vec3f(20.0 * k, -30.0, 50.0))
        if kind == "Cube":
            shape.AddScaleOp().Set(Gf.Vec3f(1.0, 2.0, 0.5))
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        prims.append(shape.GetPrim())
    return prims


def mass_of_shape(prim: Any) -> Any:
    """Volume and inertia of a shape at density 1, by textbook formulas."""
    scale = np.array([1.0, 2.0, 0.5]) if prim.GetTypeName() == "Cube" else np.ones(3)
    info = UsdPhysics.RigidBodyAPI.MassInformation()
    if prim.GetTypeName() == "Cube":
        x, y, z = 0.4 * scale
        volume, moments = x * y * z, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) * x * y * z / 12
    elif prim.GetTypeName() == "Sphere":
        volume = 4 / 3 * math.pi * 0.2**3
        moments = np.full(3, 0.4 * volume * 0.2**2)
    elif prim.GetTypeName() == "Cylinder":
        volume = math.pi * 0.1**2 * 0.7
        across = volume * (3 * 0.1**2 + 0.7**2) / 12
        moments = np.array([volume * 0.1**2 / 2, across, across])
    else:  # integrals over discs of the radius that the capsule has at each height
        heights, weights = np.polynomial.legendre.leggauss(60)
        pieces = [(-0.25, 0.25, lambda y: 0.15 + 0 * y), (0.25, 0.4, lambda y: np.sqrt(0.15**2 - (y - 0.25) ** 2))]
        volume, moments = 0.0, np.zeros(3)
        for (low, high, radius), times in zip(pieces, (1, 2), strict=True):
            y, w = (low + high) / 2 + (high - low) / 2 * heights, times * (high - low) / 2 * weights
            disc = math.pi * radius(y) ** 2
            volume += float(w @ disc)
            across = float(w @ (disc * (radius(y) ** 2 / 4 + y**2)))
            moments += [across, float(w @ (disc * radius(y) ** 2 / 2)), across]
    info.volume, info.inertia = float(volume), Gf.Matrix3f(Gf.Matrix3d(*np.diag(moments).ravel().tolist()))
    info.centerOfMass, info.localPos, info.localRot = Gf.Vec3f(0), Gf.Vec3f(0), Gf.Quatf(1)
    matrix = UsdGeom.Xformable(prim).GetLocalTransformation().RemoveScaleShear()
    info.localPos, info.localRot = Gf.Vec3f(matrix.ExtractTranslation()), Gf.Quatf(matrix.ExtractRotationQuat())
    return info


@pytest.mark.parametrize("case", ["density", "mass", "centre", "material", "shapes", "default"])
def test_masses_of_shapes_agree_with_pxr(writer: Writer, case: str) -> None:
    body = writer.body("b")
    shapes, api = add_shapes(writer, "b"), UsdPhysics.MassAPI(body)
    if case in ("density", "shapes", "centre"):
        api.CreateDensityAttr(800.0)
    if case == "mass":
        api.CreateMassAttr(3.0)
    if case == "centre":
        api.CreateCenterOfMassAttr(Gf.Vec3f(0.1, 0.2, -0.3))
    if case == "material":
        material = UsdShade.Material.Define(writer.stage, "/chain/steel")
        UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(7800.0)
        binding = UsdShade.MaterialBindingAPI.Apply(shapes[0])
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    if case == "shapes":
        UsdPhysics.MassAPI.Apply(shapes[1]).CreateMassAttr(2.0)
        UsdPhysics.MassAPI.Apply(shapes[2]).CreateDensityAttr(100.0)
    draft = writer.read()
    mass, moments, centre, axes = UsdPhysics.RigidBodyAPI(body).ComputeMassProperties(mass_of_shape)
    inertial = draft.build_mechanism().tree.model.inertias[1]
    rotation = Rotation.from_quat([axes.GetReal(), *axes.GetImaginary()], scalar_first=True).as_matrix()
    assert_close(inertial.mass, mass, 1e-6, relative=True)
    assert_close(inertial.lever, np.array(centre), 1e-6)
    assert_close(inertial.inertia, rotation @ np.diag(np.array(moments)) @ rotation.T, 2e-6, relative=True)
    assert has_note(draft.guessed, "default density", "b") == (case in ("material", "default", "mass"))
    shapes_drawn = [visual.find("geometry")[0].tag for visual in draft.robot.iterfind("link[@name='b']/visual")]
    assert shapes_drawn == ["box", "sphere", "cylinder", "cylinder", "sphere", "sphere"]


def test_bodies_without_mass_or_inertia_are_named(writer: Writer) -> None:
    writer.body("none")
    writer.body("point", None, 2.0)
    mesh = UsdGeom.Mesh.Define(writer.stage, "/chain/none/mesh")
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    draft = writer.read()
    assert has_note(draft.guessed, "no mass", "none")
    assert has_note(draft.guessed, "no inertia", "point")
    assert has_note(draft.left_out, "1 Mesh that is not drawn")


# --- joints --------------------------------------------------------------------------------------------------------

LINK = {"mass": 1.0, "centre": (0.1, 0.0, 0.0), "inertia": ((0.1, 0.1, 0.1), (1, 0, 0, 0))}


def test_excluded_joint_is_a_loop(writer: Writer) -> None:
    """A four-bar, whose links are 1, 0.8, 0.6 and the ground; frames have no common orientation."""
    for name in ("crank", "rod", "rocker"):
        writer.body(name, **LINK)
    turned = Rotation.from_euler("xyz", [0.3, -0.7, 0.9])  # the plane of the mechanism in the bodies' frames
    q = turned.as_quat(scalar_first=True)

    def point(x: float) -> tuple[Any, Any]:
        return turned.apply([x, 0.0, 0.0]), q

    writer.joint("RevoluteJoint", "a", (None, "crank"), point(0.0), point(0.0), Axis="Z")
    writer.joint("RevoluteJoint", "b", ("crank", "rod"), point(0.6), point(0.0), Axis="Z")
    writer.joint("RevoluteJoint", "c", (None, "rocker"), point(1.0), point(0.0), Axis="Z")
    closing = {"Axis": "Z", "ExcludeFromArticulation": True}
    writer.joint("RevoluteJoint", "d", ("rod", "rocker"), point(0.8), point(0.7), **closing)
    draft = writer.read()
    ((loop, _),) = draft.loops
    assert (loop.name, loop.type, draft.left_out, draft.warnings) == ("d", "hinge", [], [])
    mechanism = draft.build_mechanism()
    assert (mechanism.n, mechanism.rank, mechanism.d) == (3, 2, 1)
    a, b, c = (mechanism.q_tree[mechanism.coordinates.index(name)] for name in "abc")
    tip = 0.6 * np.exp(1j * a) + 0.8 * np.exp(1j * (a + b))
    gap = tip - 1 - 0.7 * np.exp(1j * c)
    assert_close([gap.real, gap.imag], [0.0, 0.0], 1e-7)  # the lengths of the file are in single precision


def test_limits_drives_and_properties_are_in_si_units(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "cm.usda", 0.01, 0.001)
    for name in "abcd":
        writer.body(name, **LINK)
    hinge = writer.joint("RevoluteJoint", "hinge", (None, "a"), LowerLimit=-90.0, UpperLimit=math.inf)
    slide = writer.joint("PrismaticJoint", "slide", (None, "b"), LowerLimit=-3.0, UpperLimit=5.0)
    generic = writer.joint("Joint", "generic", (None, "c"))
    writer.lock(generic, "transX", "transY", "transZ", "rotZ")
    writer.limit(generic, "rotX", -30.0, 45.0)
    still = writer.joint("RevoluteJoint", "still", (None, "d"), LowerLimit=30.0, UpperLimit=30.0)
    writer.drive(hinge, "angular", MaxForce=4000.0, Stiffness=3.0, Type="acceleration")
    writer.drive(slide, "linear")
    writer.drive(generic, "rotY", MaxForce=0.0)
    for name, value in {"physxJoint:armature": 20.0, "physxJoint:jointFriction": 0.2, "mjc:damping": 30.0}.items():
        hinge.CreateAttribute(name, Sdf.ValueTypeNames.Float).Set(value)
    slide.CreateAttribute("physxJointAxis:linear:viscousFrictionCoefficient", Sdf.ValueTypeNames.Float).Set(7.0)
    slide.CreateAttribute("physxJoint:maxJointVelocity", Sdf.ValueTypeNames.Float).Set(50.0)
    draft = writer.read()
    limits = {j.get("name"): j.find("limit") for j in draft.robot.iterfind("joint")}
    bounds = {
        name: (float(e.get("lower", 0)), float(e.get("upper", 0)), float(e.get("velocity", 0)))
        for name, e in limits.items() if e is not None
    }  # fmt: skip
    assert_close(bounds["hinge"], (-math.pi / 2, 1e308, 0.0), 1e-14)
    assert_close(bounds["slide"], (-0.03, 0.05, 0.5), 1e-14)
    assert_close(bounds["generic_rotX"], (-math.pi / 6, math.pi / 4, 0.0), 1e-14)
    assert sorted(draft.build_mechanism().coordinates) == ["generic_rotX", "generic_rotY", "hinge", "slide"]
    assert {spec.joint: spec.torque_limit for spec, _ in draft.motors} == {"hinge": 4000e-7, "slide": None}
    ((properties, _),) = draft.joints
    assert properties.name == "hinge"
    assert_close(properties.armature, 20e-7, 1e-18)
    dampings = {
        j.get("name"): float(j.find("dynamics").get("damping")) for j in draft.robot.iterfind("joint[dynamics]")
    }
    assert_close([dampings["hinge"], dampings["slide"]], [30e-7, 7e-3], 1e-18)
    for fragments in (("stiffness", "hinge"), ("1 jointFriction (physxJoint)",), ("drive of generic_rotY",)):
        assert has_note(draft.left_out, *fragments)
    origin = draft.robot.find("joint[@name='still']/origin").get("rpy").split()
    assert_close([float(x) for x in origin], [math.pi / 6, 0.0, 0.0], 1e-15)
    assert still


def test_mimic_and_distance_are_constraints(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "cm.usda", 0.01)
    for name in "abc":
        writer.body(name, **LINK)
    one = writer.joint("RevoluteJoint", "one", (None, "a"))
    two = writer.joint("PrismaticJoint", "two", ("a", "b"))
    writer.joint(
        "DistanceJoint",
        "rod",
        ("b", "c"),
        ((0, 0, 0), (1, 0, 0, 0)),
        ((2, 0, 0), (1, 0, 0, 0)),
        MinDistance=0.5,
        MaxDistance=0.5,
    )
    writer.joint("DistanceJoint", "rope", ("a", "c"), MaxDistance=0.5)
    two.CreateAttribute("physxMimicJoint:rotX:gearing", Sdf.ValueTypeNames.Float).Set(-0.5)
    two.CreateAttribute("physxMimicJoint:rotX:offset", Sdf.ValueTypeNames.Float).Set(0.25)
    two.CreateRelationship("physxMimicJoint:rotX:referenceJoint").SetTargets([one.GetPath()])
    draft = writer.read()
    mimic = draft.robot.find("joint[@name='two']/mimic")
    assert_close(
        [float(mimic.get(key)) for key in ("multiplier", "offset")], [0.5 * 0.01 * 180 / math.pi, -0.25 * 0.01], 1e-13
    )
    assert [(spec.name, spec.type, spec.length) for spec, _ in draft.loops] == [("rod", "distance", 0.005)]
    assert has_note(draft.guessed, "c is free")
    assert has_note(draft.left_out, "joint rope")


def test_frames_agree_with_the_parser_of_pxr(writer: Writer) -> None:
    """Bodies with a scale, one of them a mirror, and joints to prims inside a body and to a prim that does not move."""
    random = np.random.default_rng(3)
    for name, scale in {"a": [2.0, 2.0, 2.0], "b": [-3.0, 1.0, 0.5], "static": [1.0, 1.0, 1.0]}.items():
        turn = Rotation.from_euler("xyz", random.uniform(-1.0, 1.0, 3)).as_matrix()
        body = writer.body(name, pose(random.uniform(-1.0, 1.0, 3), turn @ np.diag(scale)), **LINK)
        UsdPhysics.RigidBodyAPI(body).CreateRigidBodyEnabledAttr(name != "static")
    inner = UsdGeom.Xform.Define(writer.stage, "/chain/a/inner")
    inner.AddTranslateOp().Set(Gf.Vec3d(0.3, 0.2, 0.1))
    inner.AddRotateXOp().Set(40.0)
    frames = [(random.uniform(-1.0, 1.0, 3).round(4), random.uniform(-1.0, 1.0, 4).round(4)) for _ in range(4)]
    writer.joint("RevoluteJoint", "one", ("static", "a/inner"), *frames[:2], Axis="Z")
    writer.joint("PrismaticJoint", "two", ("a", "b"), *frames[2:])
    writer.stage.GetRootLayer().Save()
    with pytest.warns(DeprecationWarning, match="deprecated"):  # its successor has no signature in Python yet
        parsed = UsdPhysics.LoadUsdPhysicsFromRange(writer.stage, ["/"])
    robot = read_robot(writer.path)
    kinds = (UsdPhysics.ObjectType.RevoluteJoint, UsdPhysics.ObjectType.PrismaticJoint)
    for kind, name in zip(kinds, ("one", "two"), strict=True):
        ((joint,), ours) = parsed[kind][1], robot.joints[name]
        for k, frame in enumerate((ours.in_parent, ours.in_child)):
            quaternion = getattr(joint, f"localPose{k}Orientation")
            theirs = Rotation.from_quat(
                [quaternion.GetReal(), *quaternion.GetImaginary()], scalar_first=True
            ).as_matrix()
            position = np.array(getattr(joint, f"localPose{k}Position"))
            if (name, k) == ("one", 0):  # pxr gives the frame in the prim; ours is in the world
                continue
            assert_close(frame.translation, position, 1e-6)
            assert_close(frame.rotation, theirs, 1e-6)


def test_kinematic_static_and_free_bodies(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "cm.usda", 0.01, 0.001, "Y")
    for name in ("held", "static", "arm", "floating"):
        body = UsdPhysics.RigidBodyAPI(writer.body(name, pose((100.0, 200.0, 300.0), np.eye(3)), **LINK))
        if name == "held":
            body.CreateKinematicEnabledAttr(True)
        if name == "static":
            body.CreateRigidBodyEnabledAttr(False)
    writer.joint("RevoluteJoint", "hip", ("arm", "static"))
    scene = UsdPhysics.Scene.Define(writer.stage, "/scene")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0.0, 2.0, 0.0))
    scene.CreateGravityMagnitudeAttr(300.0)
    draft = writer.read()
    assert draft.gravity == (0.0, 0.0, 3.0)
    assert_close([draft.q_guess[f"root.{key}"] for key in ("x", "y", "z", "rx")], [1.0, -3.0, 2.0, math.pi / 2], 1e-14)
    assert "world" not in {child.get("link") for child in draft.robot.iterfind("joint/child")}
    mechanism = draft.build_mechanism()
    assert mechanism.n == 7
    assert "hip" in mechanism.coordinates
    assert has_note(draft.guessed, "kinematic bodies", "held")


# --- bad input -----------------------------------------------------------------------------------------------------


def add_gear(writer: Writer) -> None:
    writer.stage.DefinePrim("/chain/gear", "PhysxPhysicsGearJoint")


def add_tilted_lock(writer: Writer) -> None:
    generic = writer.joint("Joint", "odd", (None, "a"))
    writer.lock(generic, "transX", "transY", "transZ", "rotX")
    writer.limit(generic, "rotZ", 20.0, 20.0)


def add_reference(writer: Writer) -> None:
    writer.stage.GetPrimAtPath("/chain").GetReferences().AddReference("nowhere.usda")


def add_hinge(*bodies: str | None, **attributes: Any) -> Callable[[Writer], Any]:
    return lambda writer: writer.joint("RevoluteJoint", "j", bodies, **attributes)


def add_hinges_apart(writer: Writer) -> None:
    writer.body("b", **LINK)
    join_as_mujoco(writer, "p", "X", OBLIQUE)
    join_as_mujoco(writer, "q", "Y", OBLIQUE, (0.0, 0.1, 0.0))


BAD: dict[str, tuple[Callable[[Writer], Any], str]] = {
    "missing": (add_hinge(None, "nobody"), r"/chain/j: physics:body1 is /chain/nobody; expected one prim"),
    "itself": (add_hinge("a", "a"), r"/chain/j: it connects 'a' with itself; expected two bodies"),
    "world": (add_hinge(None, None), r"/chain/j: it connects 'world' with itself; expected two bodies"),
    "type": (add_gear, r"/chain/gear: unsupported joint type 'PhysxPhysicsGearJoint'; expected"),
    "angle": (add_tilted_lock, r"/chain/odd: an angle is locked at another value than 0 beside free angles"),
    "axis": (add_hinge(None, "a", Axis="W"), r"/chain/j: physics:axis = 'W'; expected X, Y or Z"),
    "limits": (add_hinge(None, "a", LowerLimit=2.0, UpperLimit=1.0), r"joint 'j': its lower limit .* is above"),
    "mass": (lambda writer: writer.body("heavy", None, -1.0), r"/chain/heavy: a negative mass"),
    "nan": (lambda writer: writer.body("heavy", None, math.nan), r"/chain/heavy: physics:mass = nan; expected 1 f"),
    "apart": (add_hinges_apart, r"/chain/q: at zero it places 'b' elsewhere than joint 'p' does"),
    "flat": (lambda writer: writer.body("flat", np.diag([1.0, 0.0, 1.0, 1.0])), r"/chain/flat: its transform has no"),
    "reference": (add_reference, r"not a complete USD stage: .*nowhere"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_stages_are_refused_by_name(writer: Writer, capfd: pytest.CaptureFixture[str], case: str) -> None:
    spoil, message = BAD[case]
    writer.body("a", **LINK)
    spoil(writer)
    writer.stage.GetRootLayer().Save()
    capfd.readouterr()
    with pytest.raises(CkcError, match=message) as error:
        read(writer.path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.usda", '#usda 1.0\ndef Xform "a" { float x = }', "not a complete USD stage: .*Expected"),
        ("a.usdc", "garbage", "not a complete USD stage"),
        ("a.usd", "", "not a complete USD stage"),
        ("a.usda", "#usda 1.0\n", "no rigid body; expected prims with PhysicsRigidBodyAPI"),
    ],
)
def test_other_content_is_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read(tmp_path / name)


def test_layers_outside_of_the_repository_are_refused(tmp_path: Path) -> None:
    (tmp_path / "repository" / ".git").mkdir(parents=True)
    outer, inner = Writer(tmp_path / "other.usda"), Writer(tmp_path / "repository" / "robot.usda")
    outer.body("a", **LINK)
    outer.stage.GetRootLayer().Save()
    inner.stage.GetPrimAtPath("/chain").GetReferences().AddReference("../other.usda")
    with pytest.raises(InputError, match=r"layer other.usda is outside of the model's repository 'repository'"):
        inner.read()


def test_missing_package_is_named(writer: Writer, monkeypatch: pytest.MonkeyPatch) -> None:
    writer.stage.GetRootLayer().Save()
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"needs usd-core; install it with `pip install 'ckc_pin\[usd\]'`"):
        read(writer.path)


# --- composition ---------------------------------------------------------------------------------------------------


def test_instances_packages_and_nested_bodies_are_read(tmp_path: Path) -> None:
    """Two instances of a referenced leg, whose shin is inside the thigh and drawn at 30 degrees, in a .usdz."""
    leg = Writer(tmp_path / "leg.usda")
    leg.body("thigh", **LINK)
    shin = Rotation.from_euler("z", 30.0, degrees=True).as_matrix()
    leg.body("thigh/shin", pose((1.0, 0.0, 0.0), shin), **LINK)
    frames = ((1, 0, 0), (1, 0, 0, 0)), ((0, 0, 0), (1, 0, 0, 0))
    leg.joint("RevoluteJoint", "knee", ("thigh", "thigh/shin"), *frames, Axis="Z")
    leg.stage.GetRootLayer().Save()
    writer = Writer(tmp_path / "robot.usda")
    for k, name in enumerate(("left", "right")):
        prim = UsdGeom.Xform.Define(writer.stage, f"/chain/{name}")
        prim.AddTranslateOp().Set(Gf.Vec3d(0.0, k, 0.0))
        prim.GetPrim().GetReferences().AddReference("leg.usda")
        prim.GetPrim().SetInstanceable(True)
    writer.stage.GetRootLayer().Save()
    assert UsdUtils.CreateNewUsdzPackage(str(writer.path), str(tmp_path / "robot.usdz"))
    for name in ("robot.usda", "robot.usdz"):
        draft = read(tmp_path / name)
        links = {link.get("name") for link in draft.robot.iterfind("link")}
        assert links == {"world", "thigh", "shin", "thigh_2", "shin_2"}
        assert_close([draft.q_guess["knee"], draft.q_guess["knee_2"]], [math.pi / 6] * 2, 1e-14)
        assert draft.q_guess["root_2.y"] == 1.0
        assert draft.build_mechanism().d == 14


def test_stage_is_checked_without_an_import(writer: Writer) -> None:
    writer.body("a", **LINK)
    writer.joint("RevoluteJoint", "hip", (None, "a"))
    writer.stage.GetRootLayer().Save()
    with pytest.warns(ImportNote, match=r"is imported as chain.usda, a USD stage\n.*PhysicsScene"):
        assert ckc_pin.load(writer.path).coordinates == ("hip",)
