"""Geometry of a mechanism for drawing: points of bodies, their placements along a run, projections and loop gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rows import Component, Distance
from ckc_pin.run.run import Run

__all__ = ["COINCIDENCE_TOLERANCE", "Placements", "Projection", "Slide", "compute_loop_gaps", "compute_placements",
           "compute_view_axes", "find_body_points", "find_position_loops", "find_slides",
           "homogeneous", "is_planar", "pinocchio_configurations", "projection_planes", "up_direction"]  # fmt: skip

PARALLEL_TOLERANCE = 1e-9  # sine of the angle below which two joint axes are parallel
COINCIDENCE_TOLERANCE = 1e-9  # of the mechanism's size: points closer than this are one point


@dataclass(frozen=True)
class Placements:
    """Placements of all bodies: rotation (m, joints, 3, 3) and translation (m, joints, 3); joint 0 is the world."""

    rotation: Array
    translation: Array

    def point_positions(self, joint: int, local: Array) -> Array:
        """Return the world positions (m, 3) of a point that is fixed on a body."""
        return np.asarray(self.rotation[:, joint] @ local + self.translation[:, joint])

    def select_row(self, k: int) -> Placements:
        """Return the placements of one configuration, with m = 1."""
        return Placements(self.rotation[k : k + 1], self.translation[k : k + 1])


@dataclass(frozen=True)
class Slide:
    """A prismatic joint: the origin of its rail and its direction, in the axes of the parent body."""

    joint: int
    parent: int
    origin: Array
    direction: Array


@dataclass(frozen=True)
class Projection:
    """A plane to draw on: its title ("front", ...), its axes (2, 3) in the world, and the names of the axes."""

    title: str
    axes: Array
    names: tuple[str, str]


def compute_placements(mechanism: Mechanism, q_tree: Array) -> Placements:
    """Compute the placements of all bodies at configurations (m, nq) of the tree, Pinocchio's q."""
    poses = [Pose(mechanism.tree, mechanism.closure.anchors, q) for q in q_tree]
    return Placements(np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))


def pinocchio_configurations(run: Run, rows: IntArray | slice = slice(None)) -> Array:
    """Return the configurations (m, nq), Pinocchio's q, at all or some output times of a run."""
    tree = run.mechanism.tree
    return np.array([tree.from_coordinates(coordinates) for coordinates in run.q_tree[rows]])


def homogeneous(rotation: Array, translation: Array) -> Array:
    """Return the homogeneous matrix (4, 4) of a rotation or another linear map, and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


# --- points and slides ---------------------------------------------------------------------------


def find_body_points(mechanism: Mechanism) -> list[list[Array]]:
    """Return, by body, the distinct points that its link connects, in the body's axes.

    They are the origins of the joints on the body, loop frames, named points, and the origin of the body's own joint.
    A moving body without any other point has its centre of mass as well. A slide on the base has no fixed point there.
    """
    model = mechanism.tree.model
    tolerance = COINCIDENCE_TOLERANCE * mechanism.size
    points: list[list[Array]] = [[] for _ in range(model.njoints)]

    def add(joint: int, point: Array) -> None:
        if not any(np.allclose(point, other, rtol=0.0, atol=tolerance) for other in points[joint]):
            points[joint].append(point)

    base_slides = [slide.joint for slide in find_slides(mechanism) if not slide.parent]
    for joint in range(1, model.njoints):
        if model.joints[joint].nv == 1 and joint not in base_slides:  # A free root is not attached to its parent.
            add(model.parents[joint], model.jointPlacements[joint].translation.copy())
    for loop in mechanism.spec.loop:
        for frame in (loop.frame_a, loop.frame_b):
            anchor = mechanism.frames.find(frame, loop.name)
            add(anchor.joint, anchor.translation)
    for anchor in mechanism.points.values():
        add(anchor.joint, anchor.translation)
    for joint in range(1, model.njoints):
        if not points[joint]:
            add(joint, model.inertias[joint].lever.copy())
        add(joint, np.zeros(3))
    return points


def find_slides(mechanism: Mechanism) -> list[Slide]:
    """Return the prismatic joints."""
    model = mechanism.tree.model
    slides = []
    for joint in range(1, model.njoints):
        if model.joints[joint].shortname().startswith("JointModelP"):
            placement = model.jointPlacements[joint]
            axis, _ = mechanism.tree.axis(joint)  # the same in both bodies, because a slide does not rotate
            slides.append(Slide(joint, model.parents[joint], placement.translation.copy(), placement.rotation @ axis))
    return slides


# --- views ---------------------------------------------------------------------------------------


def is_planar(mechanism: Mechanism) -> bool:
    """Return whether all bodies move in parallel planes."""
    return _find_plane_normal(mechanism) is not None


def up_direction(mechanism: Mechanism) -> Array:
    """Return the direction against gravity, shape (3,); z without gravity."""
    gravity = np.array(mechanism.spec.gravity)
    return -gravity / np.linalg.norm(gravity) if np.any(gravity) else np.array([0.0, 0.0, 1.0])


def compute_view_axes(mechanism: Mechanism) -> Array:
    """Return the viewer's axes in the world, shape (3, 3): the rows point right, up and towards the viewer.

    A planar mechanism is seen along the normal of its plane, with gravity pointing down if it lies in the plane. Any
    other mechanism is seen obliquely from above, with gravity pointing down.
    """
    up = up_direction(mechanism)
    normal = _find_plane_normal(mechanism)
    if normal is None:
        horizontal = np.eye(3)[int(np.argmin(np.abs(up)))]
        horizontal -= (horizontal @ up) * up
        horizontal /= np.linalg.norm(horizontal)
        normal = 0.5 * horizontal + 0.8 * np.cross(horizontal, up) + 0.35 * up
        normal /= np.linalg.norm(normal)
    up = up - (up @ normal) * normal
    if np.linalg.norm(up) < 1e-6:  # The plane is horizontal, so gravity selects no direction in it.
        up = np.eye(3)[1] - normal[1] * normal if abs(normal[1]) < 0.9 else np.eye(3)[2] - normal[2] * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    if is_planar(mechanism) and right[int(np.argmax(np.abs(right)))] < 0:  # Look from the side where x points right.
        right, normal = -right, -normal
    return np.array([right, up, normal])


def projection_planes(mechanism: Mechanism) -> list[Projection]:
    """Return the planes to draw a mechanism on: its own plane if it is planar, else front, side and top view.

    The three views are coordinate planes of the world. The axis closest to the direction against gravity points up.
    """
    if is_planar(mechanism):
        axes = compute_view_axes(mechanism)[:2]
        return [Projection("", axes, (_name_axis(axes[0], "across"), _name_axis(axes[1], "up")))]
    up = up_direction(mechanism)
    k = int(np.argmax(np.abs(up)))
    vertical = np.sign(up[k]) * np.eye(3)[k]
    right = np.eye(3)[(k + 1) % 3]
    depth = np.cross(vertical, right)  # away from the viewer of the front view
    views = (("front", right, vertical), ("side", depth, vertical), ("top", right, depth))
    return [Projection(title, np.array([x, y]), (_name_axis(x, ""), _name_axis(y, ""))) for title, x, y in views]


def _name_axis(direction: Array, default: str) -> str:
    for k, name in enumerate("xyz"):
        if abs(abs(direction[k]) - 1.0) < 1e-9:
            return f"${'-' if direction[k] < 0 else ''}{name}$"
    return default


def _find_plane_normal(mechanism: Mechanism) -> Array | None:
    """Return the normal of a planar mechanism: all hinges are parallel to it, all slides perpendicular to it."""
    tree = mechanism.tree
    if tree.free_roots:
        return None
    _, jacobian = tree.kinematics(mechanism.q_tree)
    hinges = [axis for axis in jacobian[3:].T if np.any(axis)]
    slides = [jacobian[:3, k] for k in range(tree.n) if not np.any(jacobian[3:, k])]
    if not hinges:
        return None
    normal = hinges[0] / np.linalg.norm(hinges[0])
    is_oblique = any(np.linalg.norm(np.cross(axis, normal)) > PARALLEL_TOLERANCE for axis in hinges)
    leaves_plane = any(abs(slide @ normal) > PARALLEL_TOLERANCE * np.linalg.norm(slide) for slide in slides)
    return None if is_oblique or leaves_plane else normal


# --- loop gaps -----------------------------------------------------------------------------------


def compute_loop_gaps(mechanism: Mechanism, q_tree: Array) -> dict[str, Array]:
    """Compute how far each loop is open: the vector from B to A of the constrained part of p_A - p_B.

    Parameters
    ----------
    q_tree : (m, nq) array
        Configurations of the tree, Pinocchio's q.

    Returns
    -------
    dict of str to (m, 3) array
        By loop, in the world's axes, metres. Unconstrained displacements, such as the travel of a slide, are not part
        of a gap. Loops that constrain directions only are left out.
    """
    gaps = {loop: np.zeros((len(q_tree), 3)) for loop in find_position_loops(mechanism)}
    for k, q in enumerate(q_tree):
        pose = Pose(mechanism.tree, mechanism.closure.anchors, q)
        for group in mechanism.closure.groups:
            if isinstance(group, Component):
                offsets = group.phi(pose)[:, None] * pose.e[group.direction]
            elif isinstance(group, Distance):
                r = pose.r[group.pair]
                lengths = np.linalg.norm(r, axis=1, keepdims=True)
                offsets = r * (1.0 - group.length[:, None] / np.maximum(lengths, 1e-300))
            else:
                continue
            for row, offset in zip(group.out, offsets, strict=True):
                gaps[mechanism.closure.names[row][0]][k] += offset
    return gaps


def find_position_loops(mechanism: Mechanism) -> list[str]:
    """Return the loops with rows that constrain a position, in the order of the constraint rows."""
    rows = [row for group in mechanism.closure.groups if isinstance(group, Component | Distance) for row in group.out]
    return list(dict.fromkeys(mechanism.closure.names[row][0] for row in sorted(rows)))
