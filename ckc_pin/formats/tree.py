"""Turn a robot, whose joints form a graph, into a tree with loop closures.

Joints of the tree keep their limits, friction, springs, couplings and motors. A joint that is cut becomes a loop, which
cannot have any of them. The spanning tree is therefore chosen by weight: joints with such properties stay, joints that
the file declares as closures go first, and branches are short otherwise. If a loop has no other joint to cut, the joint
carries a link without mass, which a weld holds to the other body.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import fields, replace
from typing import Any
from xml.etree.ElementTree import Element

import msgspec
import pinocchio as pin

from ckc_pin.errors import MechanismError
from ckc_pin.formats.conversion import list_names, make_frame, make_unique, round_number, round_vector
from ckc_pin.formats.draft import Draft
from ckc_pin.formats.robot import Joint, JointAxis, Link, Robot, Tables
from ckc_pin.formats.urdf.elements import add_inertial, add_joint, add_link, from_pose, move_visual
from ckc_pin.mechanism.spec import CouplingSpec, Frame, FrameSpec, JointSpec, LoopSpec, LoopType, SpringSpec

__all__ = ["LOOP_OF_JOINT", "make_draft"]

LOOP_OF_JOINT: dict[str, LoopType] = {
    "revolute": "hinge",
    "prismatic": "prismatic",
    "ball": "point",
    "fixed": "weld",
    "universal": "universal",
    "cylindrical": "cylindrical",
}
HAS_FORCES, HAS_LIMITS, IS_RIGID, IS_PLAIN, CLOSES = 4, 3, 2, 1, 0  # how much is lost where a joint is cut


def make_draft(robot: Robot) -> Draft:
    """Return a robot as a tree with loop closures."""
    return _Tree(robot).draft()


class _Tree:
    """The spanning tree of a robot."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.links = dict(robot.links)
        self.loops: list[tuple[LoopSpec, str]] = []
        # Frame of each link of the robot in the frame of the URDF's link, which is the frame of its joint.
        self.offset = {robot.find_base(): pin.SE3.Identity()}
        self.joints: dict[str, Joint] = {}  # of the tree, directed away from the base
        self.guessed: list[str] = []
        self._check_pairs()
        distance = self._distances()
        self._used = set(_used_joints(robot))
        order = sorted(robot.joints.values(), key=lambda joint: self._sort_key(joint, distance))
        kept = _spanning_tree(order)
        cut = [joint for name, joint in robot.joints.items() if name not in kept]
        self._direct([joint for name, joint in robot.joints.items() if name in kept])
        self._cut(cut)

    # --- choice of the tree ------------------------------------------------------------------------

    def _check_pairs(self) -> None:
        pairs: dict[frozenset[str], Joint] = {}
        for joint in (joint for joint in self.robot.joints.values() if joint.kind != "fixed"):
            other = pairs.setdefault(frozenset((joint.parent, joint.child)), joint)
            if other is not joint:
                raise MechanismError(
                    f"{self.robot.source}: joints {other.name!r} and {joint.name!r} both connect links "
                    f"{joint.parent!r} and {joint.child!r}; expected one joint between two links"
                )

    def _distances(self) -> dict[str, int]:
        """Return the number of joints from the base to each link. All links must be connected with it."""
        (base,) = self.offset
        distance = self.robot.distances(base)
        if len(distance) < len(self.links):
            lost = [name for name in self.links if name not in distance]
            children = {joint.child for joint in self.robot.joints.values()}
            roots = [base, *([name for name in lost if name not in children] or lost[:1])]
            raise MechanismError(
                f"{self.robot.source}: links are not connected; roots found: {', '.join(map(repr, roots))}; a joint "
                "has to connect them"
            )
        return distance

    def _sort_key(self, joint: Joint, distance: dict[str, int]) -> tuple[float, ...]:
        nearest, furthest = sorted((distance[joint.parent], distance[joint.child]))
        return (-self._worth(joint), joint.kind in ("ball", "universal", "cylindrical"), nearest, furthest)

    def _worth(self, joint: Joint) -> int:
        """Return how much is lost where a joint is cut."""
        if (
            joint.kind not in LOOP_OF_JOINT
            or not self._used.isdisjoint(joint.coordinates)
            or any(axis.has_forces for axis in joint.axes)
        ):
            return HAS_FORCES
        if any(axis.has_limits for axis in joint.axes):
            return HAS_LIMITS
        if joint.closes:
            return CLOSES
        return IS_RIGID if joint.kind == "fixed" else IS_PLAIN

    # --- the tree ----------------------------------------------------------------------------------

    def _direct(self, kept: list[Joint]) -> None:
        """Direct the joints of the tree away from the base, and place the links' frames."""
        at: dict[str, list[Joint]] = {name: [] for name in self.links}
        for joint in kept:
            at[joint.parent].append(joint)
            at[joint.child].append(joint)
        directed: dict[str, Joint] = {}
        pending = list(self.offset)
        for link in pending:
            for joint in at[link]:
                if joint.name in directed:
                    continue
                directed[joint.name] = self._place(joint if joint.parent == link else joint.reversed())
                pending.append(directed[joint.name].child)
        self.joints = {joint.name: directed[joint.name] for joint in kept}

    def _place(self, joint: Joint) -> Joint:
        """Return a joint of the tree with its pose in the URDF's parent link."""
        origin, offset = self.offset[joint.parent] * joint.in_parent, joint.in_child.inverse()
        if not joint.axes:
            origin, offset = origin * offset, pin.SE3.Identity()
        self.offset[joint.child] = offset
        return replace(joint, in_parent=origin)

    def _cut(self, joints: list[Joint]) -> None:
        """Turn joints that are not in the tree into loops."""
        reported: dict[str, list[str]] = {}
        for joint in joints:
            if self._worth(joint) >= HAS_LIMITS:
                link = make_unique(f"{joint.name}_link", self.links)
                self.links[link] = Link()
                carrier = replace(joint, child=link, in_child=pin.SE3.Identity())
                self.joints[joint.name] = self._place(carrier)
                joint = Joint(joint.name, "fixed", link, joint.child, in_child=joint.in_child, comment=joint.comment)
                note = "stay in the tree with links without mass, which welds of the same names hold to their bodies"
                reported.setdefault(f"close loops that have no other joint to cut; they {note}", []).append(joint.name)
            elif not joint.closes:
                reported.setdefault("close loops and are cut there, so they are loops now", []).append(joint.name)
            self.loops.append((self._loop(joint), joint.comment))
        self.guessed += [f"joints that {what}: {list_names(names)}" for what, names in reported.items()]

    def _loop(self, joint: Joint) -> LoopSpec:
        ends = [self._at(link, pose) for link, pose in ((joint.parent, joint.in_parent), (joint.child, joint.in_child))]
        name = make_unique(joint.name, [spec.name for spec, _ in [*self.robot.loops, *self.loops]])
        axes = [round_vector(axis.direction) for axis in joint.axes if joint.kind != "ball"]
        directions: dict[str, Any] = {"axis_a": axes[0], "axis_b": axes[-1]} if axes else {}
        return LoopSpec(name=name, type=LOOP_OF_JOINT[joint.kind], frame_a=ends[0], frame_b=ends[1], **directions)

    # --- the draft ---------------------------------------------------------------------------------

    def draft(self) -> Draft:
        robot = self.robot
        xml = Element("robot", name=robot.name)
        xml.extend(robot.materials)
        for name, link in self.links.items():
            self._add_link(xml, name, link)
        tables = {field.name: copy(getattr(robot, field.name)) for field in fields(Tables)}
        draft = Draft(**tables, robot=xml)
        draft.guessed += self.guessed
        cut = {name for joint in robot.joints.values() if joint.name not in self.joints for name in joint.coordinates}
        draft.q_guess = {name: x for name, x in robot.q_guess.items() if name not in cut}
        draft.springs = []
        for joint in self.joints.values():
            self._add_joint(draft, joint)
        draft.loops = [
            (self._placed(spec, "frame_a", "frame_b"), comment) for spec, comment in robot.loops
        ] + self.loops
        draft.untyped = [self._placed(spec, "frame_a", "frame_b") for spec in robot.untyped]
        draft.springs += [
            (spec if spec.joint else self._placed(spec, "frame_a", "frame_b"), text) for spec, text in robot.springs
        ]
        draft.points = [(self._placed(spec, "frame"), comment) for spec, comment in robot.points]
        return draft

    def _add_link(self, xml: Element, name: str, link: Link) -> None:
        element, offset = add_link(xml, name), self.offset.get(name, pin.SE3.Identity())
        is_moved = not offset.isIdentity(0.0)
        add_inertial(element, link.body.transformed(offset) if is_moved else link.body)
        for visual in link.visuals:
            element.append(move_visual(visual, offset) if is_moved else visual)

    def _add_joint(self, draft: Draft, joint: Joint) -> None:
        """Add a joint to the URDF, several axes as joints in series that are connected by links without mass."""
        if not joint.axes:
            add_joint(draft.robot, joint.name, joint.kind, joint.parent, joint.child, joint.in_parent)
            return
        names, parent, origin = joint.coordinates, joint.parent, joint.in_parent
        for name, axis in zip(names, joint.axes, strict=True):
            child = joint.child if name == names[-1] else make_unique(f"{name}_link", self.links)
            if child not in self.links:
                self.links[child] = Link()
                add_link(draft.robot, child)
            add_joint(draft.robot, name, "", parent, child, origin, axis=axis)
            parent, origin = child, pin.SE3.Identity()
            _add_tables(draft, name, axis)
        if joint.kind == "screw":
            turn, slide = (0, 1) if joint.axes[1].slides else (1, 0)
            spec = CouplingSpec(joint=names[slide], other=names[turn], ratio=round_number(joint.pitch))
            draft.couplings.append((spec, f"the thread of screw {joint.name}"))
        if joint.kind == "ball":
            hinges = f"ball joint {joint.name} is three hinges, {', '.join(names)}"
            draft.guessed.append(f"{hinges}: singular where {names[1]} is +-90 degrees")
        elif len(names) > 1:
            draft.guessed.append(f"{joint.kind} joint {joint.name} is joints in a row: {', '.join(names)}")

    def _placed(self, spec: Any, *keys: str) -> Any:
        """Return a table with its frames relative to the URDF's links."""
        return msgspec.structs.replace(spec, **{key: self._frame(getattr(spec, key)) for key in keys})

    def _frame(self, frame: Frame) -> Frame:
        link = frame if isinstance(frame, str) else frame.link
        pose = pin.SE3.Identity() if isinstance(frame, str) else from_pose(frame.xyz, frame.rpy)
        if link.startswith("joint:") and (declared := self.robot.joints.get(link.removeprefix("joint:"))):
            placed = self.joints.get(declared.name)
            if placed is not None and placed.child == declared.child:
                name = f"joint:{placed.coordinates[-1] if placed.axes else placed.name}"
                return name if isinstance(frame, str) else FrameSpec(link=name, xyz=frame.xyz, rpy=frame.rpy)
            link, pose = declared.child, declared.in_child * pose
        elif link not in self.offset or (self.offset[link].isIdentity(0.0) and not self._hides_ground(link)):
            return frame
        return self._at(link, pose)

    def _hides_ground(self, link: str) -> bool:
        """Whether a moving link has the name of the ground."""
        return link == "world" and self.robot.find_base() != link

    def _at(self, link: str, pose: pin.SE3) -> Frame:
        """Return a frame of the URDF at a pose in a link of the robot."""
        if self._hides_ground(link):
            raise MechanismError(
                f"{self.robot.source}: link 'world' is carried by a joint; rename it, since loops use it"
            )
        return make_frame(link, self.offset[link] * pose)


def _used_joints(robot: Robot) -> Iterable[str]:
    """Yield the joints that tables of the robot name, and the masters of mimic joints."""
    yield from (*(robot.independent or ()), *(robot.actuated or ()))
    for table in (robot.couplings, robot.springs, robot.forces, robot.motors):
        for spec, _ in table:
            names = (spec.joint, getattr(spec, "other", None), *getattr(spec, "joints", ()))
            yield from (name for name in names if name)
    yield from (axis.mimic[0] for joint in robot.joints.values() for axis in joint.axes if axis.mimic)


def _spanning_tree(joints: Iterable[Joint]) -> set[str]:
    """Return the joints of the spanning tree to which earlier joints belong rather than later ones (Kruskal)."""
    parent: dict[str, str] = {}

    def find(link: str) -> str:
        while parent.setdefault(link, link) != link:
            parent[link] = link = parent[parent[link]]
        return link

    kept = set()
    for joint in joints:
        one, other = find(joint.parent), find(joint.child)
        if one != other:
            parent[one] = other
            kept.add(joint.name)
    return kept


def _add_tables(draft: Draft, name: str, axis: JointAxis) -> None:
    """Add what a URDF's joint does not have: its spring, armature and stops."""
    if axis.stiffness:
        spring = SpringSpec(joint=name, stiffness=axis.stiffness, rest=round_number(axis.rest))
        draft.springs.append((spring, "the joint's stiffness"))
    if axis.armature or axis.stops:
        draft.joints.append((JointSpec(name=name, armature=axis.armature or None, stops=axis.stops), ""))
