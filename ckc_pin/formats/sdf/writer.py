"""Write a mechanism as a world of SDFormat, where joints close loops.

A joint of SDFormat that closes a loop is placed in one link only. Its place in the other one follows from the poses of
the links in the file. The file therefore has the assembled configuration, and its coordinates count from there.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import to_rpy
from ckc_pin.formats.loop_frames import LoopJoint, loop_joint
from ckc_pin.formats.urdf.elements import INERTIA_ENTRIES, format_numbers, parse_origin
from ckc_pin.formats.urdf.writer import follower_of, largest_effort, list_omissions, list_visuals
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["to_sdf"]

VERSION = "1.11"
NO_EFFORT = 0.0  # Drake takes a joint without effort for one without a motor
LOOP_KINDS = ("ball", "revolute", "universal", "prismatic", "fixed")
MOTOR_PLUGIN = {"filename": "gz-sim-apply-joint-force-system", "name": "gz::sim::systems::ApplyJointForce"}
SHAPES = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}


def to_sdf(mechanism: Mechanism) -> tuple[str, list[str]]:
    """Return a mechanism as an SDFormat world, and notes on differences.

    A joint with a motor has Gazebo's plugin that applies a force, and an effort limit other than 0, as Drake expects.

    Raises
    ------
    InputError
        A loop or coupling has no counterpart.
    """
    root = Element("sdf", version=VERSION)
    world = SubElement(root, "world", name=mechanism.name)
    SubElement(world, "gravity").text = format_numbers(mechanism.tree.model.gravity.linear)
    model = SubElement(world, "model", name=mechanism.name)
    poses, visuals = _link_poses(mechanism), list_visuals(mechanism)
    links = [element.attrib["name"] for element in mechanism.urdf.findall("link")]
    for element in mechanism.urdf.findall("link"):
        name = element.attrib["name"]
        link = SubElement(model, "link", name=name)
        _add_pose(link, poses[name])
        _add_inertial(link, element)
        for k, visual in enumerate(visuals.get(name, [])):
            _add_visual(link, visual, f"visual_{k + 1}")
    moved = {element.find("child").attrib["link"] for element in mechanism.urdf.findall("joint")}  # type: ignore[union-attr]
    for base in (name for name in links if name not in moved):
        _add_joint(model, f"{base}_to_world", "fixed", "world", base)
    assembled = mechanism.tree.to_coordinates(mechanism.q_tree)
    axes: dict[str, Element] = {}
    for element in mechanism.urdf.findall("joint"):
        axis = _add_tree_joint(mechanism, model, element, assembled)
        if axis is not None:
            axes[element.attrib["name"]] = axis
    for coupling in mechanism.couplings:
        joint, other, ratio, _ = follower_of(mechanism, coupling, "SDFormat")
        mimic = SubElement(axes[joint], "mimic", joint=other)
        for tag, value in (("multiplier", ratio), ("offset", 0.0), ("reference", 0.0)):
            SubElement(mimic, tag).text = repr(value)
    for loop in mechanism.spec.loop:
        _add_loop_joint(model, loop_joint(mechanism, loop, "SDFormat"), poses)
    for turns in mechanism.motors.transmission:
        driven = np.flatnonzero(turns)
        if len(driven) == 1:
            plugin = SubElement(model, "plugin", MOTOR_PLUGIN)
            SubElement(plugin, "joint_name").text = mechanism.coordinates[driven[0]]
    notes = ["coordinates count from the assembled configuration", *list_omissions(mechanism)]
    if mechanism.motors.names and (mechanism.motors.transmission.astype(bool).sum(axis=1) > 1).any():
        notes.append("left out: motors on several joints")
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n", notes


def _link_poses(mechanism: Mechanism) -> dict[str, pin.SE3]:
    """Return the pose of each link in the world, as assembled."""
    model, data = mechanism.tree.model, mechanism.tree.data
    pin.forwardKinematics(model, data, mechanism.q_tree)
    return {
        name: pin.SE3(data.oMi[frame.joint]) * pin.SE3(frame.rotation, frame.translation)
        for name, frame in mechanism.frames.links.items()
    }


def _add_pose(element: Element, pose: pin.SE3) -> None:
    numbers = [*pose.translation, *to_rpy(pose.rotation)]
    SubElement(element, "pose").text = format_numbers(numbers)


def _add_inertial(link: Element, element: Element) -> None:
    """Add mass and inertia, zeros for a link without them, since SDFormat's default is 1 kg."""
    inertial = element.find("inertial")
    added = SubElement(link, "inertial")
    if inertial is not None:
        _add_pose(added, parse_origin(inertial, "inertial"))
    mass, inertia = (None if inertial is None else inertial.find(tag) for tag in ("mass", "inertia"))
    SubElement(added, "mass").text = "0" if mass is None else mass.attrib["value"]
    entries = SubElement(added, "inertia")
    for name in INERTIA_ENTRIES:
        SubElement(entries, name).text = "0" if inertia is None else inertia.get(name, "0")


def _add_visual(link: Element, visual: Element, name: str) -> None:
    geometry = visual.find("geometry")
    assert geometry is not None
    added = SubElement(link, "visual", name=name)
    _add_pose(added, parse_origin(visual, "visual"))
    shape = SubElement(SubElement(added, "geometry"), geometry[0].tag)
    if geometry[0].tag == "mesh":
        SubElement(shape, "uri").text = geometry[0].attrib["filename"]
        SubElement(shape, "scale").text = geometry[0].get("scale", "1 1 1")
        return
    for attribute in SHAPES[geometry[0].tag]:
        SubElement(shape, attribute).text = geometry[0].attrib[attribute]


def _add_joint(model: Element, name: str, kind: str, parent: str, child: str) -> Element:
    joint = SubElement(model, "joint", name=name, type=kind)
    SubElement(joint, "parent").text = parent
    SubElement(joint, "child").text = child
    return joint


def _add_axis(joint: Element, direction: Array, tag: str = "axis") -> Element:
    axis = SubElement(joint, tag)
    SubElement(axis, "xyz").text = format_numbers(direction)
    return axis


def _add_tree_joint(mechanism: Mechanism, model: Element, element: Element, assembled: Array) -> Element | None:
    """Add a joint of the tree; return its axis, None if it has none. A free root has no joint."""
    parent, child = (element.find(tag).attrib["link"] for tag in ("parent", "child"))  # type: ignore[union-attr]
    name, kind = element.attrib["name"], element.attrib["type"]
    if kind == "floating":
        return None
    joint = _add_joint(model, name, kind, parent, child)
    k = mechanism.tree.index.get(name)
    if k is None:
        return None
    direction, _ = mechanism.tree.axis(int(mechanism.tree.model.getJointId(name)))
    axis = _add_axis(joint, direction)
    springs, joints, (lower, upper) = mechanism.springs, mechanism.joints, mechanism.tree.limits()
    limit = SubElement(axis, "limit")
    for tag, bound in (("lower", lower[k]), ("upper", upper[k])):
        if np.isfinite(bound):
            SubElement(limit, tag).text = repr(float(bound - assembled[k]))
    effort = largest_effort(mechanism, k)
    SubElement(limit, "effort").text = repr(NO_EFFORT if effort is None else effort if np.isfinite(effort) else -1.0)
    dynamics = SubElement(axis, "dynamics")
    for tag, value in (
        ("damping", springs.joint_damping[k]),
        ("friction", joints.friction[k]),
        ("spring_reference", springs.joint_rest[k] - assembled[k] if springs.joint_stiffness[k] else 0.0),
        ("spring_stiffness", springs.joint_stiffness[k]),
    ):
        if value:
            SubElement(dynamics, tag).text = repr(float(value))
    return axis


def _add_loop_joint(model: Element, loop: LoopJoint, poses: dict[str, pin.SE3]) -> None:
    """Add the joint of a loop in the frame of its child. A link, not the world, has to be the child."""
    if loop.kind not in LOOP_KINDS:
        raise InputError(f"{model.get('name')}: loop {loop.name!r}: SDFormat has no {loop.kind} joint")
    order = (1, 0) if loop.links[1] == "world" else (0, 1)
    (parent, child), frames = (loop.links[k] for k in order), loop.aligned_poses
    joint = _add_joint(model, loop.name, loop.kind, parent, child)
    _add_pose(joint, frames[order[1]])
    if loop.kind == "universal":  # its axes are given in the joint's frame, in the assembled configuration
        in_parent = frames[order[0]] if parent == "world" else poses[parent] * frames[order[0]]
        in_child = poses[child] * frames[order[1]]
        first = np.eye(3)[order[0]]  # x of the first link's frame, y of the second one's
        _add_axis(joint, in_child.rotation.T @ in_parent.rotation @ first)
        _add_axis(joint, np.eye(3)[order[1]], "axis2")
    elif loop.kind in ("revolute", "prismatic"):
        _add_axis(joint, np.array([0.0, 0.0, 1.0]))
