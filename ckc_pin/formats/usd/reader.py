"""Read a USD stage with physics: rigid bodies, joints as a graph, drives and gravity.

The frame of a link is that of its rigid body, without scale. A joint is defined by its poses in both bodies. The poses
of the bodies in the stage are where the assembly starts.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import choose_name, list_names, make_frame, make_unique, round_number, round_vector
from ckc_pin.formats.robot import Joint, Link, Robot
from ckc_pin.formats.usd.bodies import SHAPES, add_visuals, read_link
from ckc_pin.formats.usd.joints import DISTANCE, JointFreedoms, angles_of
from ckc_pin.formats.usd.stage import Stage
from ckc_pin.mechanism.spec import LoopSpec, MotorSpec

__all__ = ["USD_SUFFIXES", "read_usd"]

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
WORLD = "world"
EARTH = 9.81  # m/s^2
SAME_OFFSET = 1e-6  # m; the numbers of a stage are single precision
EXTENSIONS = r"physx(?!Scene|RigidBody|Articulation|Collision|Material|TriangleMesh|Convex)\w*|mjc|newton"
IRRELEVANT = (
    r"physics:(startsAsleep|\w*[vV]elocity|approximation|\w+Friction|restitution|type|density|collisionEnabled)"
)
TARGETS = r"drive:\w+:physics:(type|target\w+|stiffness|damping)"  # of a controller


def read_usd(path: Path) -> Robot:
    """Read a USD stage.

    Raises
    ------
    InputError, MechanismError
        usd-core is not installed, the stage is incomplete, or a prim of it is invalid. The message names the prim.
    """
    return _Reader(Stage(path)).read()


@dataclass
class _Reader:
    """What was read of a stage so far."""

    stage: Stage
    bodies: dict[Any, str] = field(default_factory=dict)  # links by the paths of their prims
    joints: dict[Any, Joint] = field(default_factory=dict)  # by the paths of their prims
    rows: dict[Any, tuple[Joint, pin.SE3]] = field(default_factory=dict)  # last joints of MuJoCo by their two links
    notes: dict[str, list[str]] = field(default_factory=dict)
    with_gains: list[str] = field(default_factory=list)

    def read(self) -> Robot:
        stage, parts = self.stage, dict[Any, list[Any]]()
        default = stage.usd.GetDefaultPrim()
        name = choose_name(stage.path, default.GetName() if default else "")
        robot = Robot(
            name=name, origin=f"{stage.path.name}, a USD stage", source=str(stage.path), guessed=stage.guessed
        )
        for prim in stage.prims:
            if "PhysicsRigidBodyAPI" in prim.GetAppliedSchemas() and stage.value(prim, "physics:rigidBodyEnabled"):
                self.bodies[prim.GetPath()] = make_unique(prim.GetName(), (WORLD, *self.bodies.values()))
            parts.setdefault(self._body_of(prim), []).append(prim)
        if not self.bodies:
            raise InputError(f"{stage.path}: no rigid body; expected prims with PhysicsRigidBodyAPI")
        robot.links[WORLD] = Link()
        for prim in parts.get(None, ()):
            add_visuals(robot.links[WORLD], stage, prim, pin.SE3.Identity())
        for path, link in self.bodies.items():
            prim = stage.usd.GetPrimAtPath(path)
            robot.links[link] = read_link(stage, prim, parts[path], self.notes)
            if stage.value(prim, "physics:kinematicEnabled"):
                robot.add_joint(Joint(f"{link}_fixed", "fixed", WORLD, link, self._pose(path)))
                self.notes.setdefault("kinematic bodies are fixed to the world", []).append(link)
        joints = [prim for prim in stage.prims if prim.GetTypeName().endswith("Joint")]
        for prim in joints:
            self._add_joint(robot, prim)
        for prim in joints:
            self._add_mimics(robot, prim)
        self._add_roots(robot)
        self._read_gravity(robot)
        robot.actuated = [spec.joint or "" for spec, _ in robot.motors] or None
        robot.guessed += [f"{what}: {list_names(names)}" for what, names in self.notes.items()]
        if self.with_gains:
            gains = "stiffness and damping of drives, which belong to a controller; their joints have motors"
            robot.left_out.append(f"{gains}: {list_names(self.with_gains)}")
        robot.leave_out(self._count_unread())
        return robot

    def _body_of(self, prim: Any) -> Any:
        """Return the path of the rigid body to which a prim belongs; None for the world."""
        while prim and prim.GetPath() not in self.bodies:
            prim = prim.GetParent()
        return prim.GetPath() if prim else None

    def _pose(self, path: Any) -> pin.SE3:
        """Return the pose of a body in the world."""
        return self.stage.pose(self.stage.usd.GetPrimAtPath(path))[0]

    # --- joints ------------------------------------------------------------------------------------

    def _end(self, prim: Any, number: int) -> tuple[str, pin.SE3, pin.SE3]:
        """Return the link of one of the two bodies of a joint, and the poses of the joint in it and in the world."""
        stage, where = self.stage, f"{self.stage.where(prim)}: physics:body{number}"
        targets = prim.GetRelationship(f"physics:body{number}").GetTargets()
        target = stage.usd.GetPrimAtPath(targets[0]) if len(targets) == 1 else None
        if targets and not target:
            raise MechanismError(f"{where} is {list_names([*map(str, targets)])}; expected one prim that exists")
        pose, scale = stage.pose(target) if target else (pin.SE3(stage.up, np.zeros(3)), np.full(3, stage.length))
        point = scale * stage.numbers(prim, f"physics:localPos{number}", [0.0, 0.0, 0.0])
        pose = pose * pin.SE3(stage.rotation(prim, f"physics:localRot{number}"), point)
        body = self._body_of(target)
        return (self.bodies[body], self._pose(body).inverse() * pose, pose) if body else (WORLD, pose, pose)

    def _add_joint(self, robot: Robot, prim: Any) -> None:
        stage, name = self.stage, make_unique(prim.GetName(), robot.joints)
        if stage.value(prim, "physics:jointEnabled") is False:
            robot.left_out.append(f"joint {name}, which is not enabled")
            return
        freedoms = None if prim.GetTypeName() == DISTANCE else JointFreedoms(stage, prim)
        links, poses, places = zip(*(self._end(prim, number) for number in (0, 1)), strict=True)
        if links[0] == links[1]:
            raise MechanismError(f"{stage.where(prim)}: it connects {links[0]!r} with itself; expected two bodies")
        if freedoms is None or freedoms.kind == "floating":
            self._add_distance(robot, prim, links, poses)
            return
        poses = (poses[0] * freedoms.shift, poses[1] * freedoms.turn.inverse())
        joint = Joint.between(name, freedoms.kind, links, poses, freedoms.axes)
        step = (places[0] * freedoms.shift).inverse() * places[1] * freedoms.turn.inverse()
        angles = iter(angles_of(step.rotation, [axis.direction for axis in joint.axes if not axis.slides]))
        for freedom, label, axis in zip(freedoms.names, joint.coordinates, joint.axes, strict=True):
            value = round_number(float(axis.direction @ step.translation) if axis.slides else next(angles))
            robot.q_guess |= {label: value} if value else {}
            self._add_motor(robot, freedoms, freedom, label)
        joint = joint.reversed() if links[1] == WORLD else joint
        joint.closes = bool(stage.value(prim, "physics:excludeFromArticulation"))
        if "MjcJointAPI" in str(prim.GetMetadata("apiSchemas")):  # usd-core does not know this schema
            self._put_behind(robot, joint, stage.where(prim))
        robot.add_joint(joint)
        self.joints[prim.GetPath()] = joint
        if any(stage.number(prim, f"physics:coneAngle{k}Limit", -1.0, finite=False) >= 0 for k in (0, 1)):
            robot.left_out.append(f"cone limit of joint {name}")

    def _put_behind(self, robot: Robot, joint: Joint, where: str) -> None:
        """Put a joint of MuJoCo behind the others of the same two bodies, which MuJoCo connects in the order given."""
        links, offset = (joint.parent, joint.child), joint.in_parent * joint.in_child.inverse()
        before, expected = self.rows.get(links, (None, offset))
        self.rows[links] = joint, offset
        if before is None:
            return
        if not offset.isApprox(expected, SAME_OFFSET):
            raise MechanismError(
                f"{where}: at zero it places {links[1]!r} elsewhere than joint {before.name!r} does; expected the same"
            )
        before.child = joint.parent = make_unique(f"{before.child}_{before.name}", robot.links)
        robot.links[joint.parent], joint.in_parent = Link(), joint.in_child
        self.notes.setdefault("joints behind another one of the same two bodies, as in MuJoCo", []).append(joint.name)

    def _add_motor(self, robot: Robot, freedoms: JointFreedoms, freedom: str, coordinate: str) -> None:
        if not freedoms.has_drive(freedom):
            return
        limit = freedoms.find("drive:{}:physics:maxForce", freedom, math.inf) * freedoms.unit(freedom, "force")
        if not limit > 0:
            robot.left_out.append(f"drive of {coordinate}, whose largest force is {limit:g}")
            return
        torque_limit = round_number(limit) if math.isfinite(limit) else None
        robot.motors.append((MotorSpec(name=coordinate, joint=coordinate, torque_limit=torque_limit), ""))
        if any(freedoms.find(f"drive:{{}}:physics:{key}", freedom, 0.0) for key in ("stiffness", "damping")):
            self.with_gains.append(coordinate)

    def _add_distance(self, robot: Robot, prim: Any, links: Any, poses: Any) -> None:
        """Add a constant distance between two points; joints with other distances constrain no freedom."""
        low, high = (self.stage.number(prim, f"physics:{end}Distance", -1.0, finite=False) for end in ("min", "max"))
        if not 0 < low == high < math.inf:
            robot.left_out.append(f"joint {prim.GetName()}: it takes no freedom, since it has no constant distance")
            return
        name = make_unique(prim.GetName(), [*robot.joints, *(spec.name for spec, _ in robot.loops)])
        one, two = (make_frame(link, pose) for link, pose in zip(links, poses, strict=True))
        length = round_number(low * self.stage.length)
        robot.loops.append((LoopSpec(name=name, type="distance", frame_a=one, frame_b=two, length=length), ""))

    def _add_mimics(self, robot: Robot, prim: Any) -> None:
        """Add the couplings of PhysX, position + gearing * reference + offset = 0, and of Newton, a polynomial."""
        joint = self.joints.get(prim.GetPath())
        for relationship in prim.GetRelationships():
            schema, _, end = relationship.GetName().rpartition(":")
            if joint is None or end not in ("referenceJoint", "mimicJoint"):
                continue
            master = next((self.joints[path] for path in relationship.GetTargets() if path in self.joints), joint)
            if master is joint or len(master.axes) != 1 or len(joint.axes) != 1:
                why = "one of both joints does not exist or has not one freedom; there is 1 freedom more"
                robot.warnings.append(f"mimic of joint {joint.name} is left out, because {why}")
                continue
            sign, *keys = (-1.0, "gearing", "offset") if end == "referenceJoint" else (1.0, "mimicCoef1", "mimicCoef0")
            ratio, offset = (sign * self.stage.number(prim, f"{schema}:{key}", 0.0) for key in keys)
            unit, other = (self.stage.length if j.axes[0].slides else math.radians(1.0) for j in (joint, master))
            joint.axes[0].mimic = (master.name, round_number(ratio * unit / other), round_number(offset * unit))

    # --- roots, gravity and notes ------------------------------------------------------------------

    def _add_roots(self, robot: Robot) -> None:
        """Give bodies that no joint connects with the world a free joint: roots of articulations first."""
        prims = [self.stage.usd.GetPrimAtPath(path) for path in self.bodies]
        for prim in sorted(prims, key=lambda prim: "PhysicsArticulationRootAPI" not in prim.GetAppliedSchemas()):
            if self.bodies[prim.GetPath()] not in robot.distances(WORLD):
                robot.add_free_root(self.bodies[prim.GetPath()], self._pose(prim.GetPath()))

    def _read_gravity(self, robot: Robot) -> None:
        stage, direction, size = self.stage, np.array([0.0, 0.0, -1.0]), EARTH
        scene = next((prim for prim in stage.prims if prim.GetTypeName() == "PhysicsScene"), None)
        if scene is None:
            robot.guessed.append(f"gravity is {-EARTH:g} m/s² along z, because the file has no PhysicsScene")
        else:
            declared = stage.up @ stage.numbers(scene, "physics:gravityDirection", [0.0, 0.0, 0.0])
            direction = declared / np.linalg.norm(declared) if declared.any() else direction
            magnitude = stage.number(scene, "physics:gravityMagnitude", -1.0, finite=False)
            size = magnitude * stage.length if magnitude >= 0 else EARTH
        robot.gravity = round_vector(size * direction)

    def _count_unread(self) -> Counter[str]:
        """Return the numbers of shapes that are not drawn, and of physical attributes and prims that were not read."""
        from pxr import UsdGeom

        unread: Counter[str] = Counter()
        for prim in self.stage.prims:
            kind = str(prim.GetTypeName())
            is_shape = prim.IsA(UsdGeom.Gprim) and kind not in SHAPES
            if is_shape or (re.match("Physx|Mjc|Newton", kind) and not kind.endswith("Joint")):
                unread[f"{kind} that is not drawn" if is_shape else kind] += 1
            for name in (attribute.GetName() for attribute in prim.GetAuthoredAttributes()):
                is_physics = re.match(rf"(physics|drive|limit|{EXTENSIONS}):", name)
                if (
                    is_physics
                    and (prim.GetPath(), name) not in self.stage.read
                    and not re.fullmatch(f"{IRRELEVANT}|{TARGETS}", name)
                ):
                    unread[f"{name.rpartition(':')[2]} ({name.partition(':')[0]}) of {kind}"] += 1
        return unread
