"""What each named number of a mechanism does to its motion, to first order.

The names are those of `mechanism.parameters`. A number that places something, a length or an angle, is the coordinate
of a joint that is locked where that stands; one that places a fixed joint moves everything that is rigidly behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.errors import InputError
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides, split_component, split_name
from ckc_pin.mechanism.rows import RelativeLog
from ckc_pin.mechanism.spec import FrameSpec
from ckc_pin.native.variation import Effect, Lock, Place

__all__ = ["effects_of"]

ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
WORLD = Frame(0, np.eye(3), np.zeros(3))
TURNS: tuple[Place, ...] = ("direction", "log_a", "log_b")  # what only turns

Thing = tuple[Place, int]
Twist = tuple[Array, Array]  # angular, linear: of the frame at a joint's origin, in its axes


def effects_of(
    mechanism: Mechanism, actuation: Actuation, name: str, given: Overrides, changed: Callable[[Overrides], Mechanism]
) -> tuple[Effect, ...]:
    """Return what a number does; nothing where the motion does not depend on it.

    Parameters
    ----------
    mechanism : Mechanism
    actuation : Actuation
    name : str
        Of a single number: of a vector's, with its component.
    given : mapping
        The scene's own overrides of parameters.
    changed : callable
        Rebuilds the mechanism with other overrides.

    Raises
    ------
    InputError
        A number on which the motion has no derivative.
    """
    whole, k = split_component(name)
    root, carrier, key = split_name(whole)
    match root:
        case "gravity":
            found = iter([Effect("gravity", numbers=np.eye(3)[k])])
        case "link":
            found = _of_link(mechanism, carrier, key, k, given, changed)
        case "joint":
            found = _of_joint(mechanism, carrier, key, k)
        case "loop":
            found = _of_loop(mechanism, carrier, key, k)
        case "coupling":
            found = _of_coupling(mechanism, int(carrier), key)
        case "spring":
            found = _of_spring(mechanism, int(carrier), key, k)
        case "force":
            joint = mechanism.spec.force[int(carrier)].joint
            found = iter([Effect("constant", mechanism.tree.index[joint])])
        case _:
            found = _of_motor(mechanism, actuation, carrier, key)
    return tuple(found)


# --- bodies ------------------------------------------------------------------------------------------


def _of_link(
    mechanism: Mechanism, name: str, key: str, k: int, given: Overrides, changed: Callable[[Overrides], Mechanism]
) -> Iterator[Effect]:
    """A new mass is the same body of another density; a new centre takes the inertia along."""
    body = _Body(mechanism, name)
    if body.placed.joint == 0:
        return
    if key == "mass":
        of_file = body
        if body.mass == 0 and f"link.{name}.mass" in given:  # what it has none of any more, its file says
            of_file = _Body(changed({x: value for x, value in given.items() if x != f"link.{name}.mass"}), name)
        kept = [entry for entry in ENTRIES if f"link.{name}.inertia.{entry}" in given]
        yield body.changed(1.0, body.centre, of_file.per_mass(kept) + _about(body.centre, body.centre))
    elif key == "com":
        yield body.moved(np.zeros(3), body.placed.rotation[:, k])
    else:
        i, j = ENTRIES[key.removeprefix("inertia.")]
        unit = np.zeros((3, 3))
        unit[i, j] = unit[j, i] = 1.0
        yield body.changed(0.0, np.zeros(3), body.turn @ unit @ body.turn.T)


class _Body:
    """A link's mass, its centre and its inertia about that, in the frame of the joint that moves it."""

    def __init__(self, mechanism: Mechanism, link: str) -> None:
        self.placed = _link(mechanism, link)
        element = next(x for x in mechanism.urdf.findall("link") if x.attrib["name"] == link)
        inertial = element.find("inertial")
        self.mass, centre, self.turn, self.tensor = 0.0, np.zeros(3), self.placed.rotation, np.zeros((3, 3))
        if inertial is not None:
            origin = inertial.find("origin")
            self.mass = float(_numbers(inertial.find("mass"), "value", 1)[0])
            centre = _numbers(origin, "xyz", 3)
            self.turn = self.placed.rotation @ pin.rpy.rpyToMatrix(*_numbers(origin, "rpy", 3))
            for entry, (i, j) in ENTRIES.items():
                self.tensor[i, j] = self.tensor[j, i] = float(_numbers(inertial.find("inertia"), entry, 1)[0])
        self.centre = self.placed.translation + self.placed.rotation @ centre
        self.about = self.turn @ self.tensor @ self.turn.T

    def per_mass(self, kept: Sequence[str]) -> Array:
        """Return how the inertia goes with the mass, but for entries that are kept; without mass it does not."""
        scaled = np.zeros((3, 3)) if self.mass == 0 else self.tensor / self.mass
        for i, j in (ENTRIES[entry] for entry in kept):
            scaled[i, j] = scaled[j, i] = 0.0
        return np.asarray(self.turn @ scaled @ self.turn.T)

    def changed(self, mass: float, moment: Array, inertia: Array) -> Effect:
        return Effect("inertia", self.placed.joint, np.concatenate([[mass], moment, inertia[np.triu_indices(3)]]))

    def moved(self, turn: Array, slide: Array) -> Effect:
        e, turning = slide + np.cross(turn, self.centre), pin.skew(turn)
        inertia = turning @ self.about - self.about @ turning
        inertia = inertia + self.mass * (_about(self.centre, e) + _about(e, self.centre))
        return self.changed(0.0, self.mass * e, inertia)


def _about(a: Array, b: Array) -> Array:
    """Of a unit of mass at places: the bilinear part of its inertia about the origin."""
    return float(a @ b) * np.eye(3) - np.outer(a, b)


# --- places ------------------------------------------------------------------------------------------


def _of_joint(mechanism: Mechanism, name: str, key: str, k: int) -> Iterator[Effect]:
    if key in ("xyz", "rpy"):
        yield from _of_placement(mechanism, name, key, k)
        return
    yield Effect("joint_damping" if key == "damping" else key, mechanism.tree.index[name], np.ones(1))


def _of_placement(mechanism: Mechanism, name: str, key: str, k: int) -> Iterator[Effect]:
    joint = next(x for x in mechanism.urdf.findall("joint") if x.attrib["name"] == name)
    base = _link(mechanism, _other(joint, "parent"))
    origin = joint.find("origin")
    twist = _twist(base, key, k, _numbers(origin, "xyz", 3), _numbers(origin, "rpy", 3))
    if mechanism.tree.model.existJointName(name):
        yield from _placed(base.joint, [("joint", mechanism.tree.model.getJointId(name))], twist)
        return
    behind = _Behind(mechanism, joint)
    yield from _placed(base.joint, behind.things(), twist)
    if base.joint:
        bodies = [_Body(mechanism, link) for link in behind.links]
        yield from (body.moved(*twist) for body in bodies if body.mass or body.about.any())


def _twist(base: Frame, key: str, k: int, xyz: Array, rpy: Array) -> Twist:
    """How what stands at `xyz`, turned by `rpy`, in a frame moves with one of those numbers."""
    if key == "xyz":
        return np.zeros(3), base.rotation[:, k]
    yaw, pitch = pin.rpy.rpyToMatrix(0.0, 0.0, rpy[2]), pin.rpy.rpyToMatrix(0.0, rpy[1], 0.0)
    axes = (yaw @ pitch @ np.eye(3)[0], yaw @ np.eye(3)[1], np.eye(3)[2])  # of roll, pitch, yaw
    turn = base.rotation @ axes[k]
    return turn, np.cross(base.translation + base.rotation @ xyz, turn)


def _placed(carrier: int, things: Sequence[Thing], twist: Twist) -> Iterator[Effect]:
    turn, slide = twist
    far = float(np.linalg.norm(slide))
    for place, index in things:
        if turn.any():
            yield Effect("placement", index, np.ones(1), Lock(place, carrier, turn / np.linalg.norm(turn), turns=True))
        if far and place not in TURNS:
            yield Effect("placement", index, np.array([far]), Lock(place, carrier, slide / far))


class _Behind:
    """What is rigidly behind a fixed joint: links, and what stands on them."""

    def __init__(self, mechanism: Mechanism, joint: ElementTree.Element) -> None:
        self.mechanism = mechanism
        self.links, self.fixed, self.moving = [_other(joint, "child")], [joint.attrib["name"]], list[str]()
        joints = mechanism.urdf.findall("joint")
        for link in self.links:  # grows on the way
            for below in joints:
                if _other(below, "parent") != link:
                    continue
                if below.attrib["type"] == "fixed":
                    self.links.append(_other(below, "child"))
                    self.fixed.append(below.attrib["name"])
                else:
                    self.moving.append(below.attrib["name"])

    def things(self) -> list[Thing]:
        model, spec = self.mechanism.tree.model, self.mechanism.spec
        found: list[Thing] = [("joint", model.getJointId(name)) for name in self.moving]
        for k, loop in enumerate(spec.loop):
            for end, frame in enumerate((loop.frame_a, loop.frame_b)):
                if self._carries(frame):
                    found.append(("point", k + end * len(spec.loop)))
                    found += _turning(self.mechanism, loop.name, end)
        lines = [spring for spring in spec.spring if spring.joint is None]
        for k, spring in enumerate(lines):
            for end, stands in enumerate((spring.frame_a, spring.frame_b)):
                if stands is not None and self._carries(stands):
                    found.append(("spring", k + end * len(lines)))
        for k, point in enumerate(spec.point):
            if self._carries(point.frame):
                found.append(("reported", k))
        return found

    def _carries(self, frame: str | FrameSpec) -> bool:
        name = frame if isinstance(frame, str) else frame.link
        return name.removeprefix("joint:") in self.fixed if name.startswith("joint:") else name in self.links


def _turning(mechanism: Mechanism, loop: str, end: int) -> list[Thing]:
    """What turns with a loop's frame."""
    closure, label = mechanism.closure, ("frame_a", "frame_b")[end]
    found: list[Thing] = [("direction", k) for k, of in enumerate(closure.turned_by) if of == (loop, label)]
    for group in closure.groups:
        if isinstance(group, RelativeLog):
            loops = [closure.names[out][0] for out in group.out[::3]]
            found += [("log_b" if end else "log_a", k) for k, name in enumerate(loops) if name == loop]
    return found


def _of_frame(
    mechanism: Mechanism, frame: str | FrameSpec, key: str, k: int, things: Sequence[Thing]
) -> Iterator[Effect]:
    base = mechanism.frames.find(frame if isinstance(frame, str) else frame.link, "parameters")
    at = FrameSpec(link=frame) if isinstance(frame, str) else frame
    yield from _placed(base.joint, things, _twist(base, key, k, np.array(at.xyz), np.array(at.rpy)))


# --- loops, springs, motors --------------------------------------------------------------------------


def _of_loop(mechanism: Mechanism, name: str, key: str, k: int) -> Iterator[Effect]:
    loops = mechanism.spec.loop
    number = next(i for i, loop in enumerate(loops) if loop.name == name)
    if key == "length":
        yield Effect("length", mechanism.closure.names.index((name, "length")))
        return
    table, _, of = key.partition(".")
    end = int(table == "frame_b")
    things: list[Thing] = (
        [("point", number + end * len(loops))] if of == "xyz" else _turning(mechanism, name, end)
    )  # turning about its own origin, the point stays
    yield from _of_frame(mechanism, getattr(loops[number], table), of, k, things)


def _of_coupling(mechanism: Mechanism, number: int, key: str) -> Iterator[Effect]:
    coupling = mechanism.spec.coupling[number]
    row = mechanism.closure.names.index((f"{coupling.joint}~{coupling.other}", "coupling"))
    if key == "offset":
        yield Effect("offset", row)
    else:
        yield Effect("ratio", row, np.array([mechanism.tree.index[coupling.other]], dtype=float))


def _of_spring(mechanism: Mechanism, number: int, key: str, k: int) -> Iterator[Effect]:
    spring = mechanism.spec.spring[number]
    if spring.joint is not None:
        yield Effect(f"joint_{key}", mechanism.tree.index[spring.joint])
        return
    lines = [x for x in mechanism.spec.spring if x.joint is None]
    line = next(i for i, other in enumerate(lines) if other is spring)
    table, _, of = key.partition(".")
    if not of:
        yield Effect(key, line)
        return
    frame = getattr(spring, table)
    yield from _of_frame(mechanism, frame, of, k, [("spring", line + (table == "frame_b") * len(lines))])


def _of_motor(mechanism: Mechanism, actuation: Actuation, name: str, key: str) -> Iterator[Effect]:
    """By its rotor; by its gear where its torque is what is given; by its limit while that is reached."""
    motors = mechanism.motors
    number = motors.names.index(name)
    motor, turns = mechanism.spec.motor[number], motors.transmission[number]
    joint = int(np.flatnonzero(turns)[0])  # the only one where there is a rotor
    if key == "rotor_inertia":
        if np.count_nonzero(turns) > 1:
            raise InputError(f"sensitivities: motor.{name}.rotor_inertia: on several joints a rotor has none")
        yield Effect("armature", joint, np.array([turns[joint] ** 2]))
    elif key == "ratio":
        if motor.rotor_inertia:
            yield Effect("armature", joint, np.array([2 * turns[joint] ** 2 / motor.ratio * motor.rotor_inertia]))
        yield Effect("gear", number, turns / motor.ratio)
    elif key == "torque_limit" and motor.torque_limit == actuation.limit[number]:
        if actuation.scene_limit[number] == motor.torque_limit:
            raise InputError(
                f"sensitivities: motor.{name}.torque_limit: the controller's is the same, so that it matters only "
                "one way; give one of them"
            )
        yield Effect("torque_limit", number, turns)


# --- URDF --------------------------------------------------------------------------------------------


def _link(mechanism: Mechanism, name: str) -> Frame:
    """Where a link is; the root of all is the world."""
    return mechanism.frames.links.get(name, WORLD)


def _other(joint: ElementTree.Element, tag: str) -> str:
    return joint.find(tag).attrib["link"]  # type: ignore[union-attr]


def _numbers(element: Any, attribute: str, count: int) -> Array:
    text = None if element is None else element.get(attribute)
    return np.zeros(count) if text is None else np.array([float(x) for x in text.split()])
