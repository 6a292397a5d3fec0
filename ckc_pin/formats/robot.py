"""A robot as a file of another program describes it: a graph of links and joints, with loops, couplings and notes.

A reader of a format fills a `Robot` and knows nothing else. `ckc_pin.formats.tree` turns it into a tree with loop
closures, which is what a mechanism file has.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import MechanismError
from ckc_pin.formats.conversion import make_unique, round_number
from ckc_pin.mechanism.spec import CouplingSpec, ForceSpec, LoopSpec, MotorSpec, PointSpec, SpringSpec, Vector3

__all__ = [
    "UNLIMITED",
    "Body",
    "Joint",
    "JointAxis",
    "JointKind",
    "JointLimits",
    "Link",
    "Mimic",
    "Robot",
    "Tables",
    "ball_axes",
]

T = TypeVar("T")
WithComment = list[tuple[T, str]]  # each table with its comment in the file; an empty comment is not written
JointKind = Literal[  # hinges: several in a row
    "fixed", "revolute", "prismatic", "floating", "ball", "universal", "cylindrical", "planar", "screw", "hinges"
]
Mimic = tuple[str, float, float]  # other joint, ratio, offset


# --- links and joints ----------------------------------------------------------------------------------------------


@dataclass
class Body:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), the last two in the axes of one frame."""

    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def transformed(self, pose: pin.SE3) -> Body:
        """Return the body in the axes of the frame in which `pose` is given."""
        return Body(self.mass, pose.act(self.centre), pose.rotation @ self.inertia @ pose.rotation.T)


@dataclass
class Link:
    """A rigid body in its own frame: mass properties, and its shapes as <visual> elements of a URDF."""

    body: Body = field(default_factory=Body)
    visuals: list[Element] = field(default_factory=list)


@dataclass(frozen=True)
class JointLimits:
    """Range of a joint (rad or m; None: unlimited), its largest force or torque and its largest speed (0: none)."""

    lower: float | None = None
    upper: float | None = None
    effort: float = 0.0
    velocity: float = 0.0


UNLIMITED = JointLimits()


@dataclass
class JointAxis:
    """One freedom of a joint."""

    direction: Array  # unit vector in the joint's frame
    slides: bool = False  # along the axis, instead of turning about it
    limits: JointLimits = UNLIMITED
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0  # where the spring has no force
    stops: bool = False  # whether the limits are stops
    mimic: Mimic | None = None
    suffix: str = ""  # ending of the coordinate's name, if the joint has several axes

    @property
    def has_forces(self) -> bool:
        """Whether the axis has forces, inertia or a coupling, which a loop closure cannot express."""
        values = (self.damping, self.friction, self.armature, self.stiffness, self.stops, self.mimic)
        return any(bool(value) for value in values)

    @property
    def has_limits(self) -> bool:
        """Whether the range is less than a full turn."""
        lower, upper = self.limits.lower, self.limits.upper
        if lower is None or upper is None:
            return lower is not upper
        return self.slides or upper - lower < 2 * np.pi


@dataclass
class Joint:
    """A joint between two links: the frames that coincide at zero, and its axes in the order from parent to child."""

    name: str
    kind: JointKind
    parent: str
    child: str
    in_parent: pin.SE3 = field(default_factory=pin.SE3.Identity)  # the joint's frame in both links
    in_child: pin.SE3 = field(default_factory=pin.SE3.Identity)
    axes: list[JointAxis] = field(default_factory=list)  # a ball has three hinges about x, y and z
    pitch: float = 0.0  # advance of a screw, m/rad; its axes are a hinge and a slide
    closes: bool = False  # whether the file declares it as the closure of a loop, which is cut first
    comment: str = ""  # on the loop, if the joint is cut

    @classmethod
    def between(
        cls, name: str, kind: JointKind, links: Sequence[str], poses: Sequence[pin.SE3], axes: list[JointAxis]
    ) -> Joint:
        """Return a joint between two links, parent first, at its poses in both."""
        return cls(name, kind, links[0], links[1], poses[0], poses[1], axes)

    @property
    def coordinates(self) -> list[str]:
        """Names of the joints of one freedom that the joint becomes in a tree."""
        if len(self.axes) < 2:
            return [self.name] * len(self.axes)
        return [f"{self.name}{axis.suffix or f'_{k + 1}'}" for k, axis in enumerate(self.axes)]

    def reversed(self) -> Joint:
        """Return the joint with parent and child exchanged, so that its coordinates keep their values."""
        turned = [
            replace(axis, direction=-axis.direction, suffix=name.removeprefix(self.name))
            for axis, name in zip(reversed(self.axes), reversed(self.coordinates), strict=True)
        ]
        return replace(
            self, parent=self.child, child=self.parent, in_parent=self.in_child, in_child=self.in_parent, axes=turned
        )


# --- robots --------------------------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class Tables:
    """Tables of ``mechanism.toml`` besides links and joints, and notes for the user."""

    name: str  # of the mechanism and its URDF
    origin: str  # the file and its format
    source: str  # name of the file in messages
    loops: WithComment[LoopSpec] = field(default_factory=list)  # frames are relative to those of the robot's links
    couplings: WithComment[CouplingSpec] = field(default_factory=list)
    springs: WithComment[SpringSpec] = field(default_factory=list)
    forces: WithComment[ForceSpec] = field(default_factory=list)
    motors: WithComment[MotorSpec] = field(default_factory=list)
    points: WithComment[PointSpec] = field(default_factory=list)
    untyped: list[LoopSpec] = field(default_factory=list)  # coincident points, whose joint the file does not give
    independent: list[str] | None = None  # None: the program chooses them
    actuated: list[str] | None = None  # also the joints of `motors`
    why_independent: str = ""  # comment on `independent`
    gravity: Vector3 = (0.0, 0.0, -9.81)
    q_guess: dict[str, float] = field(default_factory=dict)  # start of the assembly by coordinate
    key_frames: dict[str, dict[str, float]] = field(default_factory=dict)  # other configurations by name
    guessed: list[str] = field(default_factory=list)  # assumptions where the file says nothing
    left_out: list[str] = field(default_factory=list)  # content of the file that the mechanism does not have
    warnings: list[str] = field(default_factory=list)  # why it has other freedoms than the file means


@dataclass(kw_only=True)
class Robot(Tables):
    """A robot as a reader understood it. Joints may form loops."""

    links: dict[str, Link] = field(default_factory=dict)
    joints: dict[str, Joint] = field(default_factory=dict)
    materials: list[Element] = field(default_factory=list)  # <material> elements that the links' shapes name

    def add_joint(self, joint: Joint) -> None:
        """Add a joint."""
        where = f"{self.source}: joint {joint.name!r}"
        if joint.name in self.joints:
            raise MechanismError(f"{self.source}: two joints are called {joint.name!r}")
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in self.links:
                raise MechanismError(
                    f"{where}: its {end} link {link!r} does not exist; there are {', '.join(self.links)}"
                )
        if joint.parent == joint.child:
            raise MechanismError(f"{where}: it connects link {joint.child!r} with itself; expected two links")
        self.joints[joint.name] = joint

    def add_free_root(self, link: str, pose: pin.SE3) -> None:
        """Connect a link with the world by a free joint. Its pose is where the assembly starts."""
        name = make_unique("root", self.joints)
        self.add_joint(Joint(name, "floating", "world", link))
        values = (*pose.translation, *pin.log3(pose.rotation))
        labels = ("x", "y", "z", "rx", "ry", "rz")
        guess = {f"{name}.{label}": round_number(float(x)) for label, x in zip(labels, values, strict=True)}
        self.q_guess |= {label: x for label, x in guess.items() if x}
        self.guessed.append(
            f"{link} is free, with the coordinates {name}.x to {name}.rz, because no joint fixes it to the world"
        )

    def leave_out(self, unread: Counter[str]) -> None:
        """Note elements that were not read; those that seem to close loops are warnings."""
        for what, count in sorted(unread.items()):
            if re.search(r"loop|clos|constraint|equality|weld|connect|joint:", what, re.IGNORECASE):
                each = "each of them" if count > 1 else "it"
                self.warnings.append(
                    f"{count} {what}: the program cannot read it; if {each} closes a loop, the mechanism has up to 6 "
                    f"freedoms more than meant for {each}; write a table [[loop]] instead"
                )
            else:
                self.left_out.append(f"{count} {what}")

    @property
    def axes(self) -> dict[str, JointAxis]:
        """Axes by the names of their coordinates."""
        return {
            name: axis
            for joint in self.joints.values()
            for name, axis in zip(joint.coordinates, joint.axes, strict=True)
        }

    def distances(self, start: str) -> dict[str, int]:
        """Return the numbers of joints from a link to the links that joints connect with it."""
        neighbours: dict[str, list[str]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            neighbours[joint.parent].append(joint.child)
            neighbours[joint.child].append(joint.parent)
        distance, pending = {start: 0}, [start]
        for link in pending:
            for other in neighbours[link]:
                if other not in distance:
                    distance[other] = distance[link] + 1
                    pending.append(other)
        return distance

    def zero_poses(self) -> dict[str, pin.SE3]:
        """Return the poses of the links at zero, relative to the base, without the joints that close loops."""
        edges: dict[str, list[tuple[str, pin.SE3]]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            if not joint.closes:
                step = joint.in_parent * joint.in_child.inverse()
                edges[joint.parent].append((joint.child, step))
                edges[joint.child].append((joint.parent, step.inverse()))
        poses: dict[str, pin.SE3] = {}
        for base in (self.find_base(), *self.links):  # parts that only closing joints connect begin at identity
            pending = [] if base in poses else [base]
            poses.setdefault(base, pin.SE3.Identity())
            while pending:
                link = pending.pop()
                for other, step in edges[link]:
                    if other not in poses:
                        poses[other] = poses[link] * step
                        pending.append(other)
        return poses

    def find_base(self) -> str:
        """Return the link at which the tree begins: "world", or the first link that is no joint's child."""
        children = {joint.child for joint in self.joints.values() if not joint.closes}
        roots = [name for name in self.links if name not in children]
        return "world" if "world" in roots else next(iter((*roots, *self.links)))


def ball_axes(suffixes: Sequence[str] = ("_x", "_y", "_z")) -> list[JointAxis]:
    """Return the axes of a ball joint."""
    return [JointAxis(direction, suffix=suffix) for direction, suffix in zip(np.eye(3), suffixes, strict=True)]
