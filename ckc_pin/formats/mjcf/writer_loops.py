"""Loops, couplings and springs as MuJoCo's equality constraints and tendons.

MuJoCo has no equality for some of the rows here. Those that it can only miss are refused: a model that
moves in other ways than the mechanism would look right.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.rows import Affine
from ckc_pin.mechanism.spec import FrameSpec, LoopSpec

__all__ = ["Sites", "add_loops", "add_springs", "in_one_plane", "numbers", "quaternion"]

POSES = 5  # random ones, at which a planar loop has to stay in its plane
FLAT = 1e-9  # of the size: how well


class Sites:
    """The frames that loops, tendons and points sit on, as sites of MuJoCo's bodies."""

    def __init__(self, bodies: list[Element]) -> None:
        self._bodies = bodies
        self._names: set[str] = set()
        self.places: list[tuple[int, Array]] = []

    def add(self, name: str, frame: Frame) -> str:
        """Add a site; return its name, made unlike those there are."""
        while name in self._names:
            name += "'"
        self._names.add(name)
        self.places.append((frame.joint, frame.translation))
        place = {"pos": numbers(frame.translation), "quat": numbers(quaternion(frame.rotation))}
        SubElement(self._bodies[frame.joint], "site", {"name": name} | place)
        return name


def numbers(values: Array | float) -> str:
    """Write numbers so that they are read back as they are."""
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))


def quaternion(rotation: Array) -> Array:
    """Return w, x, y, z of a rotation matrix."""
    x, y, z, w = pin.Quaternion(np.ascontiguousarray(rotation)).coeffs()
    return np.array([w, x, y, z])


def add_loops(mechanism: Mechanism, root: Element, sites: Sites) -> list[str]:
    """Add equality constraints for all loops and couplings; return what differs.

    Raises
    ------
    InputError
        A loop that MuJoCo has no equality for.
    """
    equality, tendon, differs = Element("equality"), Element("tendon"), []
    for loop in mechanism.spec.loop:
        a = mechanism.frames.find(loop.frame_a, f"loop {loop.name!r}, frame_a")
        b = mechanism.frames.find(loop.frame_b, f"loop {loop.name!r}, frame_b")
        if loop.type in ("point", "weld"):
            kind = "connect" if loop.type == "point" else "weld"
            _equality(equality, kind, loop.name, sites.add(f"{loop.name}.a", a), sites.add(f"{loop.name}.b", b))
        elif loop.type == "hinge":
            _hinge(mechanism, loop, a, b, equality, sites)
            differs.append(f"loop {loop.name}: a hinge is two points of its axis there, {mechanism.size:.3g} m apart")
        elif loop.type == "point_2d":
            b = in_one_plane(mechanism, loop, a, b)
            _equality(equality, "connect", loop.name, sites.add(f"{loop.name}.a", a), sites.add(f"{loop.name}.b", b))
            differs.append(f"loop {loop.name}: all three components of the point are closed there")
        elif loop.type == "distance":
            _distance(mechanism, loop, a, b, equality, tendon, sites)
        else:
            raise InputError(
                f"{mechanism.name}: loop {loop.name!r}: MuJoCo has no equality for type {loop.type!r}; it has for "
                "point, point_2d in a plane, hinge, weld and distance"
            )
    _couplings(mechanism, equality)
    root.extend(part for part in (tendon, equality) if len(part))
    return differs


def add_springs(mechanism: Mechanism, root: Element, sites: Sites) -> None:
    """Add a spatial tendon for each spring between frames; those on joints are in the joints."""
    between = [spring for spring in mechanism.spec.spring if spring.frame_a is not None and spring.frame_b is not None]
    if not between:
        return
    tendon = root.find("tendon")
    tendon = SubElement(root, "tendon") if tendon is None else tendon
    for k, spring in enumerate(between):
        force = {"stiffness": spring.stiffness, "springlength": spring.rest_length or 0.0, "damping": spring.damping}
        ends = [
            sites.add(f"spring {k + 1}.{end}", mechanism.frames.find(frame, f"spring {k + 1}"))
            for end, frame in (("a", spring.frame_a), ("b", spring.frame_b))
            if isinstance(frame, str | FrameSpec)
        ]
        _spatial(tendon, f"spring {k + 1}", ends, {key: numbers(value) for key, value in force.items()})


def _equality(equality: Element, kind: str, name: str, a: str, b: str) -> None:
    SubElement(equality, kind, name=name, site1=a, site2=b)


def _spatial(tendon: Element, name: str, ends: list[str], attributes: dict[str, str]) -> None:
    line = SubElement(tendon, "spatial", {"name": name} | attributes)
    for end in ends:
        SubElement(line, "site", site=end)


def _hinge(mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame, equality: Element, sites: Sites) -> None:
    for suffix, along in (("", 0.0), (" axis", mechanism.size)):
        name = loop.name + suffix
        ends = (sites.add(f"{name}.{end}", _further(frame, axis, along)) for end, frame, axis in _axes(loop, a, b))
        _equality(equality, "connect", name, *ends)


def _axes(loop: LoopSpec, a: Frame, b: Frame) -> list[tuple[str, Frame, Array]]:
    units = [np.array(axis) / np.linalg.norm(axis) for axis in (loop.axis_a, loop.axis_b)]
    return [("a", a, units[0]), ("b", b, units[1])]


def _further(frame: Frame, axis: Array, along: float) -> Frame:
    return Frame(frame.joint, frame.rotation, frame.translation + frame.rotation @ axis * along)


def in_one_plane(mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame) -> Frame:
    """Move B into A's plane, where the third component never changes; refuse a loop that leaves it."""
    tree, random = mechanism.tree, np.random.default_rng(1)
    axis = np.array(loop.axis_a) / np.linalg.norm(loop.axis_a)
    joints, points = np.array([a.joint, b.joint], np.intp), np.array([a.translation, b.translation])
    anchors = Anchors(joints, points, np.zeros(0, np.intp), np.zeros((0, 3)))
    heights, shifts = [], []
    for step in [np.zeros(tree.n), *random.normal(size=(POSES, tree.n))]:
        pose = Pose(tree, anchors, tree.integrate(mechanism.q_tree, step))
        turned = axis if loop.rows_in == "world" else pose.rotation[a.joint] @ a.rotation @ axis
        heights.append(turned @ pose.r[0])
        shifts.append(pose.rotation[b.joint].T @ turned)
    if max(np.ptp(heights), np.ptp(shifts, axis=0).max()) > FLAT * mechanism.size:
        raise InputError(
            f"{mechanism.name}: loop {loop.name!r}: MuJoCo has no equality for a point_2d whose frames leave the plane"
        )
    return Frame(b.joint, b.rotation, b.translation + heights[0] * shifts[0])


def _distance(
    mechanism: Mechanism, loop: LoopSpec, a: Frame, b: Frame, equality: Element, tendon: Element, sites: Sites
) -> None:
    """Add a tendon kept at the loop's length; MuJoCo counts it from the one at zero coordinates."""
    ends = [sites.add(f"{loop.name}.{end}", frame) for end, frame in (("a", a), ("b", b))]
    _spatial(tendon, loop.name, ends, {})
    joints, points = np.array([a.joint, b.joint], np.intp), np.array([a.translation, b.translation])
    anchors = Anchors(joints, points, np.zeros(0, np.intp), np.zeros((0, 3)))
    at_zero = np.linalg.norm(Pose(mechanism.tree, anchors, mechanism.tree.neutral()).r[0])
    longer = numbers(np.array([(loop.length or 0.0) - at_zero, 0, 0, 0, 0]))
    SubElement(equality, "tendon", name=loop.name, tendon1=loop.name, polycoef=longer)


def _couplings(mechanism: Mechanism, equality: Element) -> None:
    """Add the rows joint - ratio * other - offset = 0: couplings, and a URDF's mimic joints."""
    names = [name for name, row in mechanism.closure.names if row == "coupling"]
    affine = [group for group in mechanism.closure.groups if isinstance(group, Affine)]
    rows = [row for group in affine for row in zip(group.matrix, group.offset, strict=True)]
    for name, (row, offset) in zip(names, rows, strict=True):
        joint = int(np.flatnonzero(row == 1)[0])
        others = [int(k) for k in np.flatnonzero(row) if k != joint]
        joints = {f"joint{k + 1}": mechanism.coordinates[at] for k, at in enumerate([joint, *others])}
        polynomial = [offset, -sum(row[others]), 0, 0, 0]
        SubElement(equality, "joint", {"name": name} | joints, polycoef=numbers(np.array(polynomial)))
