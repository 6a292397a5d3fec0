"""MuJoCo's MJCF: bodies and joints from Pinocchio's tree, so that both programs have the same D', C' and h'."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.formats.mjcf.writer_loops import Sites, add_loops, add_springs, numbers, quaternion
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose

__all__ = ["mjcf"]

LEAST = 1e-12  # kg, kg m^2: MuJoCo refuses a moving body without
THICKNESS = 0.03  # of the mechanism's size: the sticks that it is drawn with
SHORT = 1e-6  # of the size: a stick of no length


def mjcf(mechanism: Mechanism) -> tuple[str, list[str]]:
    """Return a MuJoCo model, and what differs in it.

    Joints, bodies and motors have the mechanism's names; body frames are Pinocchio's joint frames. The key
    frame "assembled" is the assembled configuration.

    Raises
    ------
    InputError
        A loop that MuJoCo has no equality for.
    """
    root = Element("mujoco", model=mechanism.name)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    SubElement(root, "option", gravity=numbers(mechanism.tree.model.gravity.linear))
    world = SubElement(root, "worldbody")
    bodies, order = _bodies(mechanism, world)
    differs = ["loops are soft springs there: set solref and solimp of <equality>, and the time step, to taste"]
    differs += _inertials(mechanism, bodies)
    sites = Sites(bodies)
    for name, frame in mechanism.points.items():
        sites.add(name, frame)
    differs += add_loops(mechanism, root, sites)
    add_springs(mechanism, root, sites)
    differs += _soft_joints(mechanism)
    _draw(mechanism, bodies, sites)
    _motors(mechanism, root)
    key = SubElement(root, "keyframe")
    SubElement(key, "key", name="assembled", qpos=numbers(_qpos(mechanism, order)))
    indent(root)
    return tostring(root, encoding="unicode") + "\n", differs


def _bodies(mechanism: Mechanism, world: Element) -> tuple[list[Element], list[int]]:
    """Add a body for each joint; return them by joint (0: the world), and the joints in MuJoCo's order."""
    model = mechanism.tree.model
    children: dict[int, list[int]] = {}
    for joint in range(1, model.njoints):
        children.setdefault(int(model.parents[joint]), []).append(joint)
    names, bodies, order = mechanism.frames.bodies, {0: world}, []
    waiting = children.get(0, [])[::-1]
    while waiting:
        joint = waiting.pop()
        placement = model.jointPlacements[joint]
        place = {"pos": numbers(placement.translation), "quat": numbers(quaternion(placement.rotation))}
        bodies[joint] = SubElement(bodies[int(model.parents[joint])], "body", {"name": names[joint]} | place)
        _joint(mechanism, joint, bodies[joint])
        order.append(joint)
        waiting += children.get(joint, [])[::-1]
    return [bodies[joint] for joint in range(model.njoints)], order


def _joint(mechanism: Mechanism, number: int, body: Element) -> None:
    model, springs = mechanism.tree.model, mechanism.springs
    joint, name = model.joints[number], model.names[number]
    if joint.nv == 6:
        SubElement(body, "freejoint", name=name)
        return
    at = joint.idx_v
    axis, turns = mechanism.tree.axis(number)
    element = SubElement(body, "joint", name=name, type="hinge" if turns else "slide", axis=numbers(axis))
    if springs.joint_damping[at]:
        element.set("damping", numbers(springs.joint_damping[at]))
    if springs.joint_stiffness[at]:
        element.set("stiffness", numbers(springs.joint_stiffness[at]))
        element.set("springref", numbers(springs.joint_rest[at]))
    joints, (lower, upper) = mechanism.joints, mechanism.tree.limits()
    for key, value in (("armature", model.armature[at]), ("frictionloss", joints.friction[at])):
        if value:
            element.set(key, numbers(value))
    if np.isfinite(lower[at]) and lower[at] < upper[at]:
        element.set("range", numbers(np.array([lower[at], upper[at]])))
        element.set("limited", str(bool(joints.stopped[at])).lower())


def _soft_joints(mechanism: Mechanism) -> list[str]:
    """Say which joints have friction or stops, which give way in MuJoCo."""
    joints, labels = mechanism.joints, np.array(mechanism.coordinates)
    says = []
    if joints.friction.any():
        rubbing = ", ".join(labels[joints.friction > 0])
        says.append(f"dry friction lets joints creep there: {rubbing}; set their solreffriction and solimpfriction")
    if joints.stopped.any():
        stopped = ", ".join(labels[joints.stopped])
        says.append(f"stops are soft springs there: {stopped}; set their solreflimit and solimplimit")
    if joints.restitution.any():
        says.append(f"stops do not rebound there: {', '.join(labels[joints.restitution > 0])}")
    return says


def _inertials(mechanism: Mechanism, bodies: list[Element]) -> list[str]:
    """Give each body its mass; say which ones MuJoCo would have refused."""
    light, impossible = [], []
    for element, inertia in list(zip(bodies, mechanism.tree.model.inertias, strict=True))[1:]:
        about_centre, mass = np.array(inertia.inertia), float(inertia.mass)
        principal = np.linalg.eigvalsh(about_centre)
        if mass < LEAST or principal[0] < LEAST:
            light.append(element.get("name", ""))
            mass, about_centre = max(mass, LEAST), about_centre + max(LEAST - principal[0], 0.0) * np.eye(3)
        elif principal[0] + principal[1] < principal[2] * (1 - 1e-9):
            impossible.append(element.get("name", ""))
        full = about_centre[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        values = {"pos": numbers(inertia.lever), "mass": numbers(mass), "fullinertia": numbers(full)}
        element.insert(0, Element("inertial", values))
    says = []
    if light:
        says.append(f"{', '.join(light)}: mass and inertia raised to {LEAST:g}, the least that MuJoCo takes")
    if impossible:
        says.append(f"{', '.join(impossible)}: MuJoCo refuses this inertia, which breaks the triangle inequality")
    return says


def _draw(mechanism: Mechanism, bodies: list[Element], sites: Sites) -> None:
    """Draw sticks from each joint to the joints and sites that it carries; they neither weigh nor touch."""
    model, size = mechanism.tree.model, mechanism.size
    look = {"contype": "0", "conaffinity": "0", "mass": "0", "rgba": "0.35 0.55 0.75 1"}
    ends = [(int(model.parents[k]), model.jointPlacements[k].translation) for k in range(1, model.njoints)]
    for joint, end in [*ends, *sites.places]:
        if joint and np.linalg.norm(end) > SHORT * size:
            stick = {"type": "capsule", "size": numbers(THICKNESS * size), "fromto": f"0 0 0 {numbers(end)}"}
            SubElement(bodies[joint], "geom", stick | look)


def _motors(mechanism: Mechanism, root: Element) -> None:
    """Add the motors with their gears, one on several joints by a tendon; constant forces take no control."""
    constant = mechanism.springs.constant
    if not mechanism.actuated and not constant.any():
        return
    actuators = SubElement(root, "actuator")
    motors = mechanism.motors
    for name, turns, limit in zip(motors.names, motors.transmission, motors.torque_limit, strict=True):
        joints = np.flatnonzero(turns)
        motor = SubElement(actuators, "motor", name=name)
        if len(joints) == 1:
            motor.set("joint", mechanism.coordinates[joints[0]])
            if turns[joints[0]] != 1.0:
                motor.set("gear", numbers(turns[joints[0]]))
        else:
            motor.set("tendon", name)
            tendon = SubElement(_tendons(root), "fixed", name=name)
            for k in joints:
                SubElement(tendon, "joint", joint=mechanism.coordinates[k], coef=numbers(turns[k]))
        if np.isfinite(limit):
            motor.set("forcelimited", "true")
            motor.set("forcerange", numbers(np.array([-limit, limit])))
    for k in np.flatnonzero(constant):
        name = mechanism.coordinates[k]
        force = {"gaintype": "fixed", "gainprm": "0", "biastype": "affine", "biasprm": f"{numbers(constant[k])} 0 0"}
        SubElement(actuators, "general", {"name": f"force on {name}", "joint": name} | force)


def _tendons(root: Element) -> Element:
    found = root.find("tendon")
    return SubElement(root, "tendon") if found is None else found


def _qpos(mechanism: Mechanism, order: list[int]) -> Array:
    """The assembled configuration in MuJoCo's order; a free root's place is in the world, w first."""
    model, q_tree = mechanism.tree.model, mechanism.q_tree
    pose = Pose(mechanism.tree, mechanism.closure.anchors, q_tree)
    values: list[float] = []
    for joint in order:
        at = model.joints[joint].idx_q
        if model.joints[joint].nv == 6:
            values += [*pose.translation[joint], *quaternion(pose.rotation[joint])]
        else:
            values.append(q_tree[at])
    return np.array(values)
