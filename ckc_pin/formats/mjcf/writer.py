"""Write a mechanism as a MuJoCo model.

Bodies and joints are those of Pinocchio's tree, so both programs have the same D', C' and h'. Loops, couplings and
springs become MuJoCo's equality constraints and tendons. A loop type without an exact equality constraint in MuJoCo is
refused, because the model would look right and move differently.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.formats.loop_frames import place_in_plane
from ckc_pin.mechanism.couplings import coefficients_of, coupling_name
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.spec import FrameSpec, LoopSpec

__all__ = ["DEFAULT_TIME_STEP_S", "to_mjcf"]

DEFAULT_TIME_STEP_S = 1e-3
SOLREF_STEPS = 2  # time constant of the loops in time steps, the shortest that MuJoCo's manual allows
SOLIMP = np.array([0.9999, 0.9999, 0.001, 0.5, 2.0])  # the hardest constraints that MuJoCo's manual allows
MIN_MASS = 1e-12  # kg and kg m^2; MuJoCo refuses moving bodies with less
TRIANGLE_TOLERANCE = 1e-9  # relative; of the triangle inequality between principal moments
STICK_RADIUS = 0.03  # of the mechanism's size
MIN_STICK_LENGTH = 1e-6  # of the mechanism's size
PLANE_TOLERANCE = 1e-9  # of the mechanism's size; how far a planar loop may leave its plane
MAX_POWERS = 5  # coefficients of the polynomial of a joint equality
PLANE_CONFIGURATIONS = 5  # random ones, at which this is checked


def to_mjcf(mechanism: Mechanism, time_step: float = DEFAULT_TIME_STEP_S) -> tuple[str, list[str]]:
    """Return a mechanism as a MuJoCo model, and how the model's motion differs.

    Joints, bodies and motors have the mechanism's names. Body frames are Pinocchio's joint frames. The key frame
    "assembled" is the assembled configuration. Loops are as stiff as the time step (s) allows, with MuJoCo's
    Runge-Kutta method. Its Jacobian is dense, because MuJoCo 4.0.0 factorizes a sparse one wrongly (its issue 3767).

    Raises
    ------
    InputError
        MuJoCo has no equality constraint for a loop.
    """
    root = Element("mujoco", model=mechanism.name)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    options = {"timestep": _format(time_step), "integrator": "RK4", "jacobian": "dense"}
    SubElement(root, "option", options | {"gravity": _format(mechanism.tree.model.gravity.linear)})
    stiffness = {"solref": _format(np.array([SOLREF_STEPS * time_step, 1.0])), "solimp": _format(SOLIMP)}
    SubElement(SubElement(root, "default"), "equality", stiffness)
    world = SubElement(root, "worldbody")
    bodies, order = _add_bodies(mechanism, world)
    differences = [
        f"loops are soft constraints in MuJoCo; their time constant (solref) is {SOLREF_STEPS} time steps of "
        f"{time_step:g} s, so change both together"
    ]
    differences += _add_inertials(mechanism, bodies)
    sites = _Sites(bodies)
    for name, frame in mechanism.points.items():
        sites.add(name, frame)
    differences += _add_loops(mechanism, root, sites)
    _add_springs(mechanism, root, sites)
    differences += _joint_differences(mechanism)
    _add_sticks(mechanism, bodies, sites)
    differences += _add_actuators(mechanism, root)
    key = SubElement(root, "keyframe")
    SubElement(key, "key", name="assembled", qpos=_format(_assembled_qpos(mechanism, order)))
    indent(root)
    return tostring(root, encoding="unicode") + "\n", differences


def _format(values: ArrayLike) -> str:
    """Return numbers as text that is read back to the same doubles."""
    return " ".join(repr(float(x)) for x in np.atleast_1d(np.asarray(values)))


def _quaternion(rotation: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix."""
    x, y, z, w = pin.Quaternion(np.ascontiguousarray(rotation)).coeffs()
    return np.array([w, x, y, z])


# --- bodies and joints ---------------------------------------------------------------------------------------------


def _add_bodies(mechanism: Mechanism, world: Element) -> tuple[list[Element], list[int]]:
    """Add a body for each joint; return the bodies by joint (0: the world), and the joints in MuJoCo's order."""
    model = mechanism.tree.model
    children: dict[int, list[int]] = {}
    for joint in range(1, model.njoints):
        children.setdefault(int(model.parents[joint]), []).append(joint)
    names, bodies, order = mechanism.frames.bodies, {0: world}, []
    pending = children.get(0, [])[::-1]
    while pending:
        joint = pending.pop()
        placement = model.jointPlacements[joint]
        place = {"pos": _format(placement.translation), "quat": _format(_quaternion(placement.rotation))}
        bodies[joint] = SubElement(bodies[int(model.parents[joint])], "body", {"name": names[joint]} | place)
        _add_joint(mechanism, joint, bodies[joint])
        order.append(joint)
        pending += children.get(joint, [])[::-1]
    return [bodies[joint] for joint in range(model.njoints)], order


def _add_joint(mechanism: Mechanism, number: int, body: Element) -> None:
    model, springs = mechanism.tree.model, mechanism.springs
    joint, name = model.joints[number], model.names[number]
    if joint.nv == 6:
        SubElement(body, "freejoint", name=name)
        return
    k = joint.idx_v
    axis, turns = mechanism.tree.axis(number)
    element = SubElement(body, "joint", name=name, type="hinge" if turns else "slide", axis=_format(axis))
    if springs.joint_damping[k]:
        element.set("damping", _format(springs.joint_damping[k]))
    if springs.joint_stiffness[k]:
        element.set("stiffness", _format(springs.joint_stiffness[k]))
        element.set("springref", _format(springs.joint_rest[k]))
    joints, (lower, upper) = mechanism.joints, mechanism.tree.limits()
    for key, value in (("armature", model.armature[k]), ("frictionloss", joints.friction[k])):
        if value:
            element.set(key, _format(value))
    if np.isfinite(lower[k]) and lower[k] < upper[k]:
        element.set("range", _format(np.array([lower[k], upper[k]])))
        element.set("limited", str(bool(joints.stopped[k])).lower())


def _joint_differences(mechanism: Mechanism) -> list[str]:
    """Return notes on dry friction, stops and rebound, which are soft or absent in MuJoCo."""
    joints, labels = mechanism.joints, np.array(mechanism.coordinates)
    notes = []
    if joints.friction.any():
        names = ", ".join(labels[joints.friction > 0])
        notes.append(f"joints with dry friction creep in MuJoCo: {names}; adjust solreffriction and solimpfriction")
    if joints.stopped.any():
        names = ", ".join(labels[joints.stopped])
        notes.append(f"stops are soft springs in MuJoCo: {names}; adjust solreflimit and solimplimit")
    if joints.restitution.any():
        notes.append(f"stops do not rebound in MuJoCo: {', '.join(labels[joints.restitution > 0])}")
    return notes


def _add_inertials(mechanism: Mechanism, bodies: list[Element]) -> list[str]:
    """Add mass and inertia to each body; return notes on bodies that MuJoCo does not accept as they are."""
    light, impossible = [], []
    for element, inertia in list(zip(bodies, mechanism.tree.model.inertias, strict=True))[1:]:
        about_centre, mass = np.array(inertia.inertia), float(inertia.mass)
        principal = np.linalg.eigvalsh(about_centre)
        if mass < MIN_MASS or principal[0] < MIN_MASS:
            light.append(element.get("name", ""))
            mass = max(mass, MIN_MASS)
            about_centre = about_centre + max(MIN_MASS - principal[0], 0.0) * np.eye(3)
        elif principal[0] + principal[1] < principal[2] * (1 - TRIANGLE_TOLERANCE):
            impossible.append(element.get("name", ""))
        full = about_centre[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        values = {"pos": _format(inertia.lever), "mass": _format(mass), "fullinertia": _format(full)}
        element.insert(0, Element("inertial", values))
    notes = []
    if light:
        notes.append(f"{', '.join(light)}: mass and inertia are raised to {MIN_MASS:g}, MuJoCo's minimum")
    if impossible:
        notes.append(f"{', '.join(impossible)}: MuJoCo refuses this inertia, which violates the triangle inequality")
    return notes


def _assembled_qpos(mechanism: Mechanism, order: list[int]) -> Array:
    """Return the assembled configuration in MuJoCo's order. A free joint is a pose in the world, quaternion w first."""
    model, q_tree = mechanism.tree.model, mechanism.q_tree
    pose = Pose(mechanism.tree, mechanism.closure.anchors, q_tree)
    values: list[float] = []
    for joint in order:
        k = model.joints[joint].idx_q
        if model.joints[joint].nv == 6:
            values += [*pose.translation[joint], *_quaternion(pose.rotation[joint])]
        else:
            values.append(q_tree[k])
    return np.array(values)


# --- sites, shapes and actuators -----------------------------------------------------------------------------------


class _Sites:
    """Sites of MuJoCo's bodies, for the frames of loops, tendons and points.

    Attributes
    ----------
    places : list of (joint, translation)
    """

    def __init__(self, bodies: list[Element]) -> None:
        self._bodies = bodies
        self._names: set[str] = set()
        self.places: list[tuple[int, Array]] = []

    def add(self, name: str, frame: Frame) -> str:
        """Add a site and return its name, with apostrophes appended if the name is already taken."""
        while name in self._names:
            name += "'"
        self._names.add(name)
        self.places.append((frame.joint, frame.translation))
        place = {"pos": _format(frame.translation), "quat": _format(_quaternion(frame.rotation))}
        SubElement(self._bodies[frame.joint], "site", {"name": name} | place)
        return name


def _add_sticks(mechanism: Mechanism, bodies: list[Element], sites: _Sites) -> None:
    """Draw a stick from each joint to the joints and sites that it carries, without mass and without contact."""
    model, size = mechanism.tree.model, mechanism.size
    style = {"contype": "0", "conaffinity": "0", "mass": "0", "rgba": "0.35 0.55 0.75 1"}
    joints = [(int(model.parents[k]), model.jointPlacements[k].translation) for k in range(1, model.njoints)]
    for joint, end in [*joints, *sites.places]:
        if joint and np.linalg.norm(end) > MIN_STICK_LENGTH * size:
            shape = {"type": "capsule", "size": _format(STICK_RADIUS * size), "fromto": f"0 0 0 {_format(end)}"}
            SubElement(bodies[joint], "geom", shape | style)


def _add_actuators(mechanism: Mechanism, root: Element) -> list[str]:
    """Add motors with their gears, and constant forces; return notes on what differs in MuJoCo.

    A motor on several joints acts on a fixed tendon.
    """
    constant, notes = mechanism.springs.constant, []
    if not mechanism.actuated and not constant.any():
        return []
    actuators = SubElement(root, "actuator")
    motors = mechanism.motors
    for name, turns, limits in zip(motors.names, motors.transmission, motors.torque_limit.T, strict=True):
        joints = np.flatnonzero(turns)
        motor = SubElement(actuators, "motor", name=name)
        if len(joints) == 1:
            motor.set("joint", mechanism.coordinates[joints[0]])
            if turns[joints[0]] != 1.0:
                motor.set("gear", _format(turns[joints[0]]))
        else:
            section = _tendon_section(root)
            label = name
            while section.find(f"*[@name={label!r}]") is not None:
                label += "+"
            motor.set("tendon", label)
            tendon = SubElement(section, "fixed", name=label)
            if rotor := next((x.rotor_inertia for x in mechanism.spec.motor if x.name == name), 0.0):
                motor.set("armature", _format(rotor))
                if not _is_chain(mechanism, joints):
                    notes.append(f"the rotor of motor {name}: MuJoCo neglects that it couples joints of two branches")
            for k in joints:
                SubElement(tendon, "joint", joint=mechanism.coordinates[k], coef=_format(turns[k]))
        if np.isfinite(limits).all():
            motor.set("forcelimited", "true")
            motor.set("forcerange", _format(limits))
    for k in np.flatnonzero(constant):
        name = mechanism.coordinates[k]
        bias = f"{_format(constant[k])} 0 0"
        force = {"gaintype": "fixed", "gainprm": "0", "biastype": "affine", "biasprm": bias}
        SubElement(actuators, "general", {"name": f"force on {name}", "joint": name} | force)
    return notes


def _is_chain(mechanism: Mechanism, coordinates: IntArray) -> bool:
    """Whether the coordinates are of joints of one branch, each of which carries the next."""
    model = mechanism.tree.model
    last = int(model.getJointId(mechanism.coordinates[coordinates[-1]]))
    return all(mechanism.tree.support[last, 0, k] for k in coordinates)


def _tendon_section(root: Element) -> Element:
    section = root.find("tendon")
    return SubElement(root, "tendon") if section is None else section


# --- loops, couplings and springs ----------------------------------------------------------------------------------


def _add_loops(mechanism: Mechanism, root: Element, sites: _Sites) -> list[str]:
    """Add equality constraints for all loops and couplings; return notes on what differs in MuJoCo.

    Raises
    ------
    InputError
        MuJoCo has no equality constraint for a loop.
    """
    equality, tendon, notes = Element("equality"), Element("tendon"), []
    for loop in mechanism.spec.loop:
        a = mechanism.frames.find(loop.frame_a, f"loop {loop.name!r}, frame_a")
        b = mechanism.frames.find(loop.frame_b, f"loop {loop.name!r}, frame_b")
        if loop.type in ("point", "weld"):
            tag = "connect" if loop.type == "point" else "weld"
            _add_equality(equality, tag, loop.name, sites, a, b)
        elif loop.type == "hinge":
            _add_hinge(mechanism, loop, a, b, equality, sites)
            notes.append(
                f"loop {loop.name}: the hinge is two points of its axis in MuJoCo, {mechanism.size:.3g} m apart"
            )
        elif loop.type == "point_2d":
            _add_equality(equality, "connect", loop.name, sites, a, place_in_plane(mechanism, loop, a, b, "MuJoCo"))
            notes.append(f"loop {loop.name}: MuJoCo constrains all three components of the point")
        elif loop.type == "distance":
            _add_distance(mechanism, loop, a, b, equality, tendon, sites)
        else:
            raise InputError(
                f"{mechanism.name}: loop {loop.name!r}: MuJoCo has no equality constraint for type {loop.type!r}; "
                "supported are point, point_2d in a plane, hinge, weld and distance"
            )
    _add_couplings(mechanism, equality, tendon)
    root.extend(section for section in (tendon, equality) if len(section))
    return notes


def _add_springs(mechanism: Mechanism, root: Element, sites: _Sites) -> None:
    """Add a spatial tendon for each spring between frames. Springs on joints are attributes of the joints."""
    between = [spring for spring in mechanism.spec.spring if spring.frame_a is not None and spring.frame_b is not None]
    for k, spring in enumerate(between):
        force = {"stiffness": spring.stiffness, "springlength": spring.rest_length or 0.0, "damping": spring.damping}
        ends = [
            sites.add(f"spring {k + 1}.{end}", mechanism.frames.find(frame, f"spring {k + 1}"))
            for end, frame in (("a", spring.frame_a), ("b", spring.frame_b))
            if isinstance(frame, str | FrameSpec)
        ]
        attributes = {key: _format(value) for key, value in force.items()}
        _add_line(_tendon_section(root), f"spring {k + 1}", ends, attributes)


def _add_equality(equality: Element, tag: str, name: str, sites: _Sites, a: Frame, b: Frame) -> None:
    SubElement(equality, tag, name=name, site1=sites.add(f"{name}.a", a), site2=sites.add(f"{name}.b", b))


def _add_line(tendon: Element, name: str, sites: list[str], attributes: dict[str, str]) -> None:
    """Add a straight tendon between sites."""
    line = SubElement(tendon, "spatial", {"name": name} | attributes)
    for site in sites:
        SubElement(line, "site", site=site)


def _add_hinge(mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame, equality: Element, sites: _Sites) -> None:
    """Add two connects at two points of the axis."""
    axis_a, axis_b = (np.array(axis) / np.linalg.norm(axis) for axis in (loop.axis_a, loop.axis_b))
    for suffix, distance in (("", 0.0), (" axis", mechanism.size)):
        ends = [_shifted(a, distance * axis_a), _shifted(b, distance * axis_b)]
        _add_equality(equality, "connect", loop.name + suffix, sites, *ends)


def _shifted(frame: Frame, offset: Array) -> Frame:
    """Return a frame shifted by an offset in its own axes."""
    return Frame(frame.joint, frame.rotation, frame.translation + frame.rotation @ offset)


def _add_distance(
    mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame, equality: Element, tendon: Element, sites: _Sites
) -> None:
    """Add a tendon of constant length. MuJoCo counts its length from the length at zero coordinates."""
    ends = [sites.add(f"{loop.name}.{end}", frame) for end, frame in (("a", a), ("b", b))]
    _add_line(tendon, loop.name, ends, {})
    joints, points = np.array([a.joint, b.joint], np.intp), np.array([a.translation, b.translation])
    anchors = Anchors(joints, points, np.zeros(0, np.intp), np.zeros((0, 3)))
    length_at_zero = np.linalg.norm(Pose(mechanism.tree, anchors, mechanism.tree.neutral()).r[0])
    polynomial = _format(np.array([(loop.length or 0.0) - length_at_zero, 0, 0, 0, 0]))
    SubElement(equality, "tendon", name=loop.name, tendon1=loop.name, polycoef=polynomial)


def _add_couplings(mechanism: Mechanism, equality: Element, tendon: Element) -> None:
    """Add couplings and a URDF's mimic joints: a polynomial of one joint, or a tendon of constant length.

    Raises
    ------
    InputError
        MuJoCo has no equality constraint for the curve of a coupling.
    """
    for coupling in mechanism.couplings:
        name, polynomial, coefficients = coupling_name(coupling), coupling.polynomial, coefficients_of(coupling)
        if coupling.table or len(polynomial) > MAX_POWERS:
            curve = "a table" if coupling.table else f"a polynomial of degree {len(polynomial) - 1}"
            raise InputError(
                f"{mechanism.name}: coupling {name!r}: MuJoCo has no equality constraint for {curve}; "
                f"polynomials up to degree {MAX_POWERS - 1} are supported"
            )
        joints = [joint for joint, coefficient in coefficients.items() if coefficient]
        if len(joints) > 2:
            fixed = SubElement(tendon, "fixed", name=name)
            for joint in joints:
                SubElement(fixed, "joint", joint=joint, coef=_format(coefficients[joint]))
            SubElement(equality, "tendon", name=name, tendon1=name, polycoef=_format([coupling.offset, 0, 0, 0, 0]))
            continue
        if polynomial:
            joints.append(str(coupling.other))
        else:
            first = coefficients[joints[0]]
            polynomial = [0.0, *(-coefficients[joint] / first for joint in joints[1:])]
        powers = np.zeros(MAX_POWERS)
        powers[: len(polynomial)] = polynomial
        powers[0] += coupling.offset / coefficients[joints[0]]
        names = {f"joint{k + 1}": joint for k, joint in enumerate(joints)}
        SubElement(equality, "joint", {"name": name} | names, polycoef=_format(powers))
