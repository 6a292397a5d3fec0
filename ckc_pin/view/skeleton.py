"""A mechanism as sticks, where its bodies are along a run, and the side to look at it from."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.run.run import Run

__all__ = ["Placements", "Projection", "Slide", "Stick", "configurations", "is_planar", "placements", "planes",
           "slides", "sticks", "upward", "viewpoint"]  # fmt: skip

PARALLEL = 1e-9  # sine of the angle below which two joint axes are parallel


@dataclass(frozen=True)
class Stick:
    """A segment from a point of one body to a point of another (usually the same); a body is named by its joint."""

    joint: int
    start: Array
    end_joint: int
    end: Array


@dataclass(frozen=True)
class Placements:
    """Placements of the bodies: rotation (m, joints, 3, 3) and translation (m, joints, 3); joint 0 is the world."""

    rotation: Array
    translation: Array

    def of(self, joint: int, local: Array) -> Array:
        """World positions of a body's point, shape (m, 3)."""
        return np.asarray(self.rotation[:, joint] @ local + self.translation[:, joint])

    def row(self, k: int) -> Placements:
        """Return one configuration's placements, with m = 1."""
        return Placements(self.rotation[k : k + 1], self.translation[k : k + 1])


@dataclass(frozen=True)
class Slide:
    """A prismatic joint: where its rail begins, and along what, in the axes of the body that carries it."""

    joint: int
    parent: int
    origin: Array
    along: Array


@dataclass(frozen=True)
class Projection:
    """A plane to draw on: the side it is seen from, its axes (2, 3) in the world, and their names."""

    title: str
    axes: Array
    names: tuple[str, str]


def placements(mechanism: Mechanism, q_tree: Array) -> Placements:
    """Return the placements at configurations of the tree (m, nq), Pinocchio's q."""
    poses = [Pose(mechanism.tree, mechanism.closure.anchors, q) for q in q_tree]
    return Placements(np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))


def configurations(run: Run, rows: IntArray | slice = slice(None)) -> Array:
    """Return the configurations of the tree (m, nq), Pinocchio's q, at all or some output instants of a run."""
    tree = run.mechanism.tree
    return np.array([tree.from_coordinates(numbers) for numbers in run.q_tree[rows]])


def sticks(mechanism: Mechanism) -> list[Stick]:
    """Return the links as segments between joint origins, loop frames and named points.

    A body's sticks run from its own joint to everything on it, the base's from one joint to the next. A body with
    nothing on it ends at its centre of mass. A slide adds the way from its rail's origin to its body.
    """
    model = mechanism.tree.model
    found: list[Stick] = []
    for joint, nodes in enumerate(_nodes(mechanism)):
        if joint == 0:
            found += [Stick(0, a, 0, b) for a, b in pairwise(nodes)]
            continue
        ends = nodes or [model.inertias[joint].lever.copy()]
        found += [Stick(joint, np.zeros(3), joint, end) for end in ends if np.any(end)]
    return found + [Stick(slide.parent, slide.origin, slide.joint, np.zeros(3)) for slide in slides(mechanism)]


def slides(mechanism: Mechanism) -> list[Slide]:
    """Return the prismatic joints."""
    model = mechanism.tree.model
    found = []
    for joint in range(1, model.njoints):
        if model.joints[joint].shortname().startswith("JointModelP"):
            placement = model.jointPlacements[joint]
            along, _ = mechanism.tree.axis(joint)  # a slide does not turn: the same axes in both bodies
            found.append(Slide(joint, model.parents[joint], placement.translation.copy(), placement.rotation @ along))
    return found


def _nodes(mechanism: Mechanism) -> list[list[Array]]:
    """Points of interest by body, each once, in the body's own axes."""
    model = mechanism.tree.model
    nodes: list[list[Array]] = [[] for _ in range(model.njoints)]

    def add(joint: int, point: Array) -> None:
        if not any(np.allclose(point, known, rtol=0.0, atol=1e-9 * mechanism.size) for known in nodes[joint]):
            nodes[joint].append(point)

    for joint in range(1, model.njoints):
        if model.joints[joint].nv == 1:  # a free root is not held anywhere
            add(model.parents[joint], model.jointPlacements[joint].translation.copy())
    for loop in mechanism.spec.loop:
        for frame in (loop.frame_a, loop.frame_b):
            at = mechanism.frames.find(frame, loop.name)
            add(at.joint, at.translation)
    for at in mechanism.points.values():
        add(at.joint, at.translation)
    return nodes


def is_planar(mechanism: Mechanism) -> bool:
    """Whether every body moves in parallel planes."""
    return _normal(mechanism) is not None


def upward(mechanism: Mechanism) -> Array:
    """Return the direction against gravity, z where there is none, shape (3,)."""
    gravity = np.array(mechanism.spec.gravity)
    return -gravity / np.linalg.norm(gravity) if np.any(gravity) else np.array([0.0, 0.0, 1.0])


def viewpoint(mechanism: Mechanism) -> Array:
    """Return the viewer's axes in the world, rows right, up and towards the viewer, shape (3, 3).

    A planar mechanism is seen along the normal of its plane, with gravity pointing down where it lies in the
    plane; any other one from above and aside, with gravity pointing down.
    """
    up = upward(mechanism)
    normal = _normal(mechanism)
    if normal is None:
        aside = np.eye(3)[int(np.argmin(np.abs(up)))]
        aside -= (aside @ up) * up
        aside /= np.linalg.norm(aside)
        normal = 0.5 * aside + 0.8 * np.cross(aside, up) + 0.35 * up
        normal /= np.linalg.norm(normal)
    up = up - (up @ normal) * normal
    if np.linalg.norm(up) < 1e-6:  # the plane is level
        up = np.eye(3)[1] - normal[1] * normal if abs(normal[1]) < 0.9 else np.eye(3)[2] - normal[2] * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    if is_planar(mechanism) and right[int(np.argmax(np.abs(right)))] < 0:  # from the side where x grows to the right
        right, normal = -right, -normal
    return np.array([right, up, normal])


def planes(mechanism: Mechanism) -> list[Projection]:
    """Return where to draw a mechanism: its own plane, or from the front, from the side and from above.

    The three are the world's coordinate planes, with the axis upwards that is nearest to up.
    """
    if is_planar(mechanism):
        axes = viewpoint(mechanism)[:2]
        return [Projection("", axes, (_axis_name(axes[0], "across"), _axis_name(axes[1], "up")))]
    up = upward(mechanism)
    k = int(np.argmax(np.abs(up)))
    vertical = np.sign(up[k]) * np.eye(3)[k]
    right = np.eye(3)[(k + 1) % 3]
    forward = np.cross(vertical, right)  # away from who looks from the front
    views = (("front", right, vertical), ("side", forward, vertical), ("top", right, forward))
    return [Projection(title, np.array([x, y]), (_axis_name(x, ""), _axis_name(y, ""))) for title, x, y in views]


def _axis_name(direction: Array, otherwise: str) -> str:
    for k, name in enumerate("xyz"):
        if abs(abs(direction[k]) - 1.0) < 1e-9:
            return f"${'-' if direction[k] < 0 else ''}{name}$"
    return otherwise


def _normal(mechanism: Mechanism) -> Array | None:
    """Common normal of a planar mechanism: all hinges along it, all slides across it; None when there is none."""
    tree = mechanism.tree
    if tree.free_roots:
        return None
    _, jacobian = tree.kinematics(mechanism.q_tree)
    hinges = [axis for axis in jacobian[3:].T if np.any(axis)]
    slides = [jacobian[:3, k] for k in range(tree.n) if not np.any(jacobian[3:, k])]
    if not hinges:
        return None
    normal = hinges[0] / np.linalg.norm(hinges[0])
    turned = any(np.linalg.norm(np.cross(axis, normal)) > PARALLEL for axis in hinges)
    leaves = any(abs(slide @ normal) > PARALLEL * np.linalg.norm(slide) for slide in slides)
    return None if turned or leaves else normal
