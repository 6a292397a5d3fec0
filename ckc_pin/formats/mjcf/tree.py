"""MuJoCo's bodies and joints to a URDF's links and joints, without a change of what the coordinates mean.

A URDF joint moves its child's frame, a MuJoCo joint turns a body about a point of that body. So the frame of
a link is that of the body shifted to its last joint, and every body is remembered with its pose in its link.
A joint's `ref`, its value in the reference pose, goes into the joint's origin: the numbers stay MuJoCo's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import number, some, unique, vector
from ckc_pin.formats.mjcf.document import MAIN, Attributes, Child, Document
from ckc_pin.formats.mjcf.inertia import Geom, bounded, declared, from_geoms
from ckc_pin.formats.mjcf.joints import MjcfJoint, is_free_root
from ckc_pin.formats.urdf.elements import UNLIMITED, Body, JointLimits, add_joint, add_link
from ckc_pin.mechanism.spec import SpringSpec
from ckc_pin.mechanism.tree import Array

__all__ = ["MjcfTree", "Placed"]


@dataclass(frozen=True)
class Placed:
    """Where something stands: its pose in a link, and in the world in the reference pose qpos0."""

    link: str
    pose: pin.SE3
    reference: pin.SE3

    def at(self, pose: pin.SE3) -> Placed:
        """Return what stands at a pose in this."""
        return Placed(self.link, self.pose * pose, self.reference * pose)


@dataclass
class MjcfTree:
    """The tree of a model, as it grows.

    Parameters
    ----------
    document : Document
    used : frozenset of str
        Joints that an actuator or an equality names.

    Attributes
    ----------
    robot : Element
        The URDF.
    bodies, sites : dict of str to Placed
    ref : dict of str to float
        Joints of one freedom and their values in the reference pose.
    q_guess : dict of str to float
        The reference pose, by coordinate, where it is not zero.
    springs : list of (SpringSpec, comment)
    guessed, left_out : list of str
    """

    document: Document
    used: frozenset[str]
    robot: Element = field(default_factory=lambda: Element("robot"))
    bodies: dict[str, Placed] = field(default_factory=dict)
    sites: dict[str, Placed] = field(default_factory=dict)
    ref: dict[str, float] = field(default_factory=dict)
    q_guess: dict[str, float] = field(default_factory=dict)
    springs: list[tuple[SpringSpec, str]] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        named = self.document.root.iter
        self._links = {"world", *(e.get("name", "") for e in named("body"))}
        self._joints = {e.get("name", "") for tag in ("joint", "freejoint") for e in named(tag)}
        self._seen: set[str] = set()
        self._armature: dict[str, float] = {}
        self._undrawn = 0
        self._weightless: list[str] = []
        self._unweighed: list[str] = []
        self._solids: dict[str, Body] = {}
        self._elements = {"world": add_link(self.robot, "world")}
        self.bodies["world"] = Placed("world", pin.SE3.Identity(), pin.SE3.Identity())
        for world in self.document.root.findall("worldbody"):
            self._content(world, self.bodies["world"], world.get("childclass", MAIN))
        self._weigh()
        if self._unweighed:
            self.left_out.append(f"masses of shapes unknown here; give the link an <inertial>: {some(self._unweighed)}")
        if self._weightless:
            self.left_out.append(f"gravity compensation of bodies: {some(self._weightless)}")
        if self._armature:
            found = some([f"{name} {x:g}" for name, x in self._armature.items()])
            self.left_out.append(f"armature, the inertia of rotors behind gears (kg m^2 or kg): {found}")
        if self._undrawn:
            self.left_out.append(f"{self._undrawn} shapes that are no box, cylinder or sphere: not drawn")

    # --- bodies ----------------------------------------------------------------------------------

    def _content(self, body: Element, placed: Placed, childclass: str) -> list[Geom]:
        """Read what a body contains, its children last; return its geoms."""
        geoms: list[Geom] = []
        children: list[tuple[Child, Placed]] = []
        for child in self.document.children(body, childclass):
            element = child.element
            if element.tag == "geom":
                a = self.document.attributes(element, child.childclass, element.get("name", f"of {placed.link}"))
                geoms.append(Geom.read(a, child.frame, self.document))
                self._undrawn += not geoms[-1].draw(self._elements[placed.link], placed.pose)
            elif element.tag == "site":
                self._site(child, placed)
            elif element.tag == "body":
                children.append((child, placed))
            elif element.tag == "plugin":
                self.left_out.append(f"<plugin> of body {placed.link}")
        for child, parent in children:
            self._body(child, parent)
        return geoms

    def _body(self, child: Child, parent: Placed) -> None:
        element = child.element
        childclass = element.get("childclass", child.childclass)
        name = element.get("name") or unique(f"body_{len(self.bodies)}", self._links)
        if name in self.bodies:
            raise InputError(f"{self.document.source}: two bodies are called {name!r}")
        a = Attributes(dict(element.attrib), f"{self.document.source}: body {name!r}")
        start = parent.at(child.frame * self.document.pose(a))
        children = list(self.document.children(element, childclass))
        joints = list(self._read_joints(children, name))
        if a.get("mocap") == "true":
            self.left_out.append(f"body {name} is moved from outside (mocap): it stands still here")
        if a.number("gravcomp"):
            self._weightless.append(name)
        place = self._free if self._is_free(joints, name, parent) else self._chain
        pose = place(joints, name, start)
        placed = self.bodies[name] = Placed(name, pose, start.reference)
        self._solids[name] = Body(0.0, np.zeros(3), np.zeros((3, 3)))
        geoms = self._content(element, placed, childclass)
        self._solids[name] = self._body_inertia(name, children, geoms).moved(pose)

    def _body_inertia(self, name: str, children: Sequence[Child], geoms: Sequence[Geom]) -> Body:
        rule = self.document.compiler.flag("inertiafromgeom", "auto")
        inertial = next((c for c in children if c.element.tag == "inertial"), None)
        if inertial is not None and rule != "true":
            a = self.document.attributes(inertial.element, name=f"of body {name}")
            return bounded(declared(a, inertial.frame, self.document), self.document)
        body, unknown = from_geoms(geoms, self.document) if rule != "false" else (None, [])
        for geom in unknown:
            of = geom.attributes.get("name") or geom.attributes.get("mesh") or "without a name"
            self._unweighed.append(f"{name} ({geom.kind} {of})")
        return bounded(body or Body(0.0, np.zeros(3), np.zeros((3, 3))), self.document)

    def _weigh(self) -> None:
        """Write the inertias, scaled where the compiler is told the total mass."""
        total = sum(body.mass for body in self._solids.values())
        wanted = self.document.compiler.number("settotalmass", -1.0)
        scale = wanted / total if wanted > 0 and total > 0 else 1.0
        for name, body in self._solids.items():
            link = self._elements[name]
            scratch = add_link(Element("robot"), name, Body(scale * body.mass, body.centre, scale * body.inertia))
            for position, part in enumerate(scratch):
                link.insert(position, part)

    def _site(self, child: Child, placed: Placed) -> None:
        a = self.document.attributes(child.element, child.childclass)
        pose = child.frame * self.document.pose(a)
        if "fromto" in a:
            pose = child.frame * pin.SE3(np.eye(3), np.array(a.numbers("fromto", least=6)[:6]).reshape(2, 3).mean(0))
        if child.element.get("name"):
            self.sites[child.element.attrib["name"]] = placed.at(pose)

    # --- joints ----------------------------------------------------------------------------------

    def _read_joints(self, children: Sequence[Child], body: str) -> Iterator[MjcfJoint]:
        for child in children:
            if child.element.tag not in ("joint", "freejoint"):
                continue
            joint = MjcfJoint.read(child, body, self.document)
            if not joint.name:
                name = unique("root" if joint.kind == "free" else f"{body}_{joint.kind}", self._joints)
                joint = replace(joint, name=name)
            if joint.name in self._seen:
                raise InputError(f"{joint.attributes.where}: two joints have this name")
            self._seen.add(joint.name)
            self._joints.add(joint.name)
            yield joint

    def _is_free(self, joints: Sequence[MjcfJoint], body: str, parent: Placed) -> bool:
        """Whether joints leave a body all six freedoms as a free joint does, with nothing acting on them."""
        kinds = [joint.kind for joint in joints]
        if "free" in kinds:
            if kinds != ["free"] or parent.link != "world":
                raise InputError(f"{self.document.source}: body {body!r}: a free joint is the only one of a top body")
            return True
        if parent.link != "world" or any(j.name in self.used for j in joints) or not is_free_root(joints):
            return False
        self.guessed.append(f"the three slides and the ball of body {body} are one free joint, 'root'")
        return True

    def _free(self, joints: Sequence[MjcfJoint], body: str, start: Placed) -> pin.SE3:
        """Add a floating joint; its coordinates are the body's pose in the world."""
        name = joints[0].name if joints[0].kind == "free" else unique("root", self._joints)
        self._joints.add(name)
        self._join(name, "floating", "world", body, pin.SE3.Identity())
        values = (*start.reference.translation, *pin.log3(start.reference.rotation))
        for label, value in zip(("x", "y", "z", "rx", "ry", "rz"), values, strict=True):
            if number(value):
                self.q_guess[f"{name}.{label}"] = number(value)
        return pin.SE3.Identity()

    def _chain(self, joints: Sequence[MjcfJoint], body: str, start: Placed) -> pin.SE3:
        """Add a body's joints one after another, massless links between them; return its pose in its link."""
        link, pose = start.link, start.pose
        if not joints:
            self._join(unique(f"{body}_fixed", self._joints), "fixed", link, body, pose)
            return pin.SE3.Identity()
        for position, joint in enumerate(joints):
            last = position == len(joints) - 1
            child = body if last else unique(f"{body}_{joint.name}_link", self._links)
            origin = pose * pin.SE3(np.eye(3), joint.at)
            if joint.kind == "ball":
                self._ball(joint, link, child, origin)
            else:
                self._scalar(joint, link, child, origin * joint.turned(-joint.ref))
            link, pose = child, pin.SE3(np.eye(3), -joint.at)
        return pose

    def _scalar(self, joint: MjcfJoint, link: str, child: str, origin: pin.SE3) -> None:
        """Add a hinge or a slide, with its range, damping, friction and spring."""
        a, name = joint.attributes, joint.name
        limits = joint.limits(self.document)
        kind = "prismatic" if joint.kind == "slide" else ("continuous" if limits.lower is None else "revolute")
        damping, *more = a.numbers("damping", "0", 1)
        self._join(name, kind, link, child, origin, joint.axis, limits, damping, a.number("frictionloss"))
        stiffness, *more_ = a.numbers("stiffness", "0", 1)
        if stiffness:
            rest = number(a.number("springref") * joint.unit(self.document))
            self.springs.append((SpringSpec(joint=name, stiffness=stiffness, rest=rest), "the joint's stiffness"))
        if any((*more, *more_)):
            self.left_out.append(f"quadratic and cubic parts of stiffness or damping of joint {name}")
        if all(x > 0 for x in a.numbers("springdamper", "0 0", 2)):
            self.left_out.append(f"springdamper of joint {name}, which MuJoCo turns into stiffness and damping")
        if a.number("armature"):
            self._armature[name] = a.number("armature")
        self.ref[name] = number(joint.ref)
        if self.ref[name]:
            self.q_guess[name] = self.ref[name]

    def _ball(self, joint: MjcfJoint, link: str, child: str, origin: pin.SE3) -> None:
        """Add three hinges through massless links for a ball joint."""
        names = [unique(f"{joint.name}_{axis}", self._joints) for axis in "xyz"]
        for position, (name, axis) in enumerate(zip(names, np.eye(3), strict=True)):
            below = child if position == 2 else unique(f"{child}_{'xy'[position]}", self._links)
            self._joints.add(name)
            self._join(name, "continuous", link, below, origin, axis)
            self.ref[name] = 0.0
            link, origin = below, pin.SE3.Identity()
        self.guessed.append(
            f"ball joint {joint.name} is three hinges, {', '.join(names)}: singular where {names[1]} is +-90 degrees"
        )
        acting = [key for key in ("damping", "stiffness", "frictionloss", "armature") if joint.attributes.number(key)]
        if joint.attributes.flag("limited", "auto") != "false" and "range" in joint.attributes:
            acting.append("range")
        if acting:
            self.left_out.append(f"{', '.join(acting)} of ball joint {joint.name}")

    def _join(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        origin: pin.SE3,
        axis: Sequence[float] | Array = (),
        limits: JointLimits = UNLIMITED,
        damping: float = 0.0,
        friction: float = 0.0,
    ) -> None:
        self._links.add(child)
        self._elements[child] = add_link(self.robot, child)
        direction = vector(axis) if len(axis) else ()
        add_joint(self.robot, name, kind, parent, child, origin, direction, limits, damping, friction)
