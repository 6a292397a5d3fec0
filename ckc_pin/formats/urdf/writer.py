"""Write a mechanism as one URDF, with its loops as <loop> elements beside the tree."""

from __future__ import annotations

from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.formats.loop_frames import loop_joint
from ckc_pin.formats.urdf.elements import add_origin
from ckc_pin.mechanism.couplings import coefficients_of, coupling_name
from ckc_pin.mechanism.linkage import tree_texts
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import CouplingSpec
from ckc_pin.mechanism.urdf import parse

__all__ = ["follower_of", "largest_effort", "list_omissions", "list_visuals", "to_urdf"]

LOOP_TYPES = {"ball": "spherical"}  # others have the names of URDF joints
DEFAULT_GRAVITY = (0.0, 0.0, -9.81)
DRAWN_SHAPES = ("box", "cylinder", "sphere")


def to_urdf(mechanism: Mechanism) -> tuple[str, list[str]]:
    """Return a mechanism as a URDF, and notes on parts of the mechanism that it lacks.

    The tree has the mechanism's links, joints and coordinates. Loops are <loop> elements, as in generalized_rbda;
    other programs ignore them. Gears between two joints are <mimic>, motors on one joint <transmission>.

    Raises
    ------
    InputError
        A loop or coupling has no counterpart.
    """
    root = Element("robot", name=mechanism.name)
    joints, springs = mechanism.joints, mechanism.springs
    visuals = list_visuals(mechanism)
    for element in mechanism.urdf:
        copied = deepcopy(element)
        root.append(copied)
        if element.tag == "link":
            copied.extend(visuals.get(element.attrib["name"], []))
        elif (k := mechanism.tree.index.get(element.attrib["name"])) is not None:
            dynamics = {"damping": springs.joint_damping[k], "friction": joints.friction[k]}
            for old in copied.findall("dynamics"):
                copied.remove(old)
            if any(dynamics.values()):
                SubElement(copied, "dynamics", {key: repr(float(value)) for key, value in dynamics.items()})
            limit = copied.find("limit")
            if element.get("type") == "revolute" and limit is None:
                copied.set("type", "continuous")
            effort = largest_effort(mechanism, k)
            if effort is not None and np.isfinite(effort):
                limit = SubElement(copied, "limit", velocity="0") if limit is None else limit
                limit.set("effort", repr(effort))
    elements = {element.attrib["name"]: element for element in root.findall("joint")}
    for coupling in mechanism.couplings:
        joint, other, ratio, offset = follower_of(mechanism, coupling, "a URDF")
        mimic = {"joint": other, "multiplier": repr(ratio), "offset": repr(offset)}
        SubElement(elements[joint], "mimic", mimic)
    base = next(link.attrib["name"] for link in root.findall("link"))
    for loop in mechanism.spec.loop:
        closing = loop_joint(mechanism, loop, "a URDF")
        added = SubElement(root, "loop", name=closing.name, type=LOOP_TYPES.get(closing.kind, closing.kind))
        for tag, link, pose in zip(("predecessor", "successor"), closing.links, closing.aligned_poses, strict=True):
            add_origin(SubElement(added, tag, link=base if link == "world" else link), pose)
        axes = {"axis": "1 0 0", "axis2": "0 1 0"} if closing.kind == "universal" else {"axis": "0 0 1"}
        for tag, axis in axes.items():
            SubElement(added, tag, xyz=axis)
    notes = _add_transmissions(mechanism, root)
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n", notes + list_omissions(mechanism)


def largest_effort(mechanism: Mechanism, k: int) -> float | None:
    """Return the largest force or torque of a motor on coordinate k alone, infinite without a limit; None: no motor."""
    motors = mechanism.motors
    motor = motors.motor_on(k)
    return None if motor is None else float(np.abs(motors.transmission[motor, k] * motors.torque_limit[:, motor]).max())


def follower_of(mechanism: Mechanism, coupling: CouplingSpec, program: str) -> tuple[str, str, float, float]:
    """Return a coupling as joint = ratio * other + offset: joint, other, ratio and offset.

    Raises
    ------
    InputError
        It has more than two joints, or is not linear.
    """
    name, coefficients = coupling_name(coupling), coefficients_of(coupling)
    polynomial = coupling.polynomial
    if coupling.table or len(polynomial) > 2:
        raise InputError(f"{mechanism.name}: coupling {name!r}: {program} has linear couplings only")
    if coupling.joint is not None and coupling.other is not None:
        constant, slope = [*polynomial, 0.0, 0.0][:2] if polynomial else (0.0, float(coupling.ratio or 0.0))
        return coupling.joint, coupling.other, slope, coupling.offset + constant
    if len(coefficients) != 2:
        raise InputError(
            f"{mechanism.name}: coupling {name!r}: {program} couples two joints, this is of {len(coefficients)}"
        )
    (joint, one), (other, two) = coefficients.items()
    return joint, other, -two / one, coupling.offset / one


def list_visuals(mechanism: Mechanism) -> dict[str, list[Element]]:
    """Return the <visual> elements by link that any folder can show: simple shapes, and meshes of packages."""
    visuals: dict[str, list[Element]] = {}
    for tree in tree_texts(mechanism.spec, mechanism.sources):
        for link in parse(tree.text, tree.source, tree.prefix).root.findall("link"):
            for element in link.findall("visual"):
                geometry = element.find("geometry")
                shape = None if geometry is None or not len(geometry) else geometry[0]
                if shape is not None and (shape.tag in DRAWN_SHAPES or "://" in shape.get("filename", "")):
                    visuals.setdefault(link.attrib["name"], []).append(deepcopy(element))
    return visuals


def list_omissions(mechanism: Mechanism) -> list[str]:
    """Return notes on what neither a URDF nor an SDF has."""
    spec, joints, labels = mechanism.spec, mechanism.joints, np.array(mechanism.coordinates)
    armature, motors = mechanism.tree.model.armature, mechanism.motors
    notes = []
    for what, present in (
        (f"rotor inertia of {', '.join(labels[armature > 0])}", bool(armature.any())),
        ("springs between frames", any(spring.frame_a is not None for spring in spec.spring)),
        ("constant forces", bool(spec.force)),
        ("the smaller one of two torque limits", bool((motors.torque_limit[0] != -motors.torque_limit[1]).any())),
        (f"rebound of stops of {', '.join(labels[joints.restitution > 0])}", bool(joints.restitution.any())),
    ):
        notes += [f"left out: {what}"] if present else []
    return notes


def _add_transmissions(mechanism: Mechanism, root: Element) -> list[str]:
    """Add a transmission for each motor on one joint; return a note on the others."""
    motors, others = mechanism.motors, []
    for name, turns in zip(motors.names, motors.transmission, strict=True):
        driven = np.flatnonzero(turns)
        if len(driven) != 1:
            others.append(name)
            continue
        transmission = SubElement(root, "transmission", name=f"{name}_transmission")
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        interface = "hardware_interface/EffortJointInterface"
        joint = SubElement(transmission, "joint", name=mechanism.coordinates[driven[0]])
        SubElement(joint, "hardwareInterface").text = interface
        actuator = SubElement(transmission, "actuator", name=name)
        SubElement(actuator, "hardwareInterface").text = interface
        SubElement(actuator, "mechanicalReduction").text = repr(float(turns[driven[0]]))
    notes = [f"left out: motors on several joints: {', '.join(others)}"] if others else []
    if tuple(mechanism.spec.gravity) != DEFAULT_GRAVITY:
        notes.append("left out: gravity, since a URDF has none; it is " + str(list(mechanism.spec.gravity)))
    springs = mechanism.springs.joint_stiffness
    if springs.any():
        names = ", ".join(np.array(mechanism.coordinates)[springs > 0])
        notes.append(f"left out: springs of joints, since a URDF has none: {names}")
    return notes
