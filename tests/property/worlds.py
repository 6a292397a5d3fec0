"""Random spatial worlds: two trees of random joints and bodies, as URDF for the program and in numpy for the tests.

The tree "a" stands fixed in the world, "b" stands fixed too or moves on a free root. Each has a revolute and a
prismatic joint in a row and a revolute branch. Nothing here uses the package or Pinocchio: placements come from
the numbers that the URDF is written with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from scripts.experiments.mechanism_files import urdf_joint, urdf_link
from tests.analytic.five_bar import Array

Placement = tuple[Array, Array]  # rotation (3, 3), translation (3,)
Numbers = dict[str, float]  # a configuration by coordinate, or a velocity; a free root's as in docs/reference/names.md

ROOT = ("x", "y", "z", "rx", "ry", "rz")
# joint, kind, parent link; the child link of joint "jK" is "K", the base "0"
JOINTS = (("j1", "revolute", "0"), ("j2", "prismatic", "1"), ("j3", "revolute", "2"), ("j4", "revolute", "1"))


@dataclass(frozen=True)
class Body:
    """Mass, centre of mass, and inertia about it."""

    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True)
class Joint:
    """A joint of a tree as its URDF has it."""

    name: str
    kind: str
    parent: str
    xyz: Array
    rpy: Array
    axis: Array
    body: Body

    def placed(self, value: float) -> Placement:
        """Child link in the parent link."""
        R, axis = rotation(self.rpy), self.axis / np.linalg.norm(self.axis)
        if self.kind == "prismatic":
            return R, self.xyz + R @ axis * value
        return R @ Rotation.from_rotvec(axis * value).as_matrix(), self.xyz


@dataclass(frozen=True)
class World:
    """Two trees, gravity, and where each tree's root stands."""

    trees: Mapping[str, tuple[Joint, ...]]
    stands: Mapping[str, tuple[Array, Array]]  # xyz, rpy
    root_body: Body
    gravity: Array
    free: bool = True
    random: np.random.Generator = field(default_factory=np.random.default_rng)

    @property
    def coordinates(self) -> list[str]:
        """Labels of all coordinates."""
        root = [f"b_root.{axis}" for axis in ROOT] if self.free else []
        return [joint.name for joint in self.trees["a_"]] + root + [joint.name for joint in self.trees["b_"]]

    def configuration(self) -> Numbers:
        """A random configuration; angles of the root well below half a turn."""
        return dict(zip(self.coordinates, self.random.uniform(-1, 1, len(self.coordinates)).tolist(), strict=True))

    def velocity(self) -> Numbers:
        """A random velocity; a free root's is its twist in its own axes."""
        return dict(zip(self.coordinates, self.random.uniform(-2, 2, len(self.coordinates)).tolist(), strict=True))

    def moved(self, q: Numbers, v: Numbers, time: float) -> Numbers:
        """A path through q whose velocity there is v."""
        path = {name: value + time * v[name] for name, value in q.items()}
        if self.free:
            (R, p), twist = self._root(q), np.array([v[f"b_root.{axis}"] for axis in ROOT])
            turned = Rotation.from_matrix(R) * Rotation.from_rotvec(time * twist[3:])
            path |= zip([f"b_root.{x}" for x in ROOT], [*(p + time * R @ twist[:3]), *turned.as_rotvec()], strict=True)
        return path

    def _root(self, q: Numbers) -> Placement:
        numbers = np.array([q[f"b_root.{axis}"] for axis in ROOT])
        return Rotation.from_rotvec(numbers[3:]).as_matrix(), numbers[:3]

    def placement(self, frame: str, q: Numbers) -> Placement:
        """A link, `joint:NAME` (where its child link is), or `world`, in the world."""
        name = frame.removeprefix("joint:").replace("_j", "_")
        if name == "world":
            return np.eye(3), np.zeros(3)
        prefix, link = name[:2], name[2:]
        if link == "0":
            xyz, rpy = self.stands[prefix]
            base = rotation(rpy), xyz
            return compose(base, self._root(q)) if self.free and prefix == "b_" else base
        joint = next(joint for joint in self.trees[prefix] if joint.name == f"{prefix}j{link}")
        return compose(self.placement(prefix + joint.parent, q), joint.placed(q[joint.name]))

    def bodies(self, q: Numbers) -> list[tuple[Body, Placement]]:
        """All bodies that can move, and where they are."""
        joints = [joint for tree in self.trees.values() for joint in tree]
        moving = [(joint.body, self.placement(f"joint:{joint.name}", q)) for joint in joints]
        return [*moving, (self.root_body, self.placement("b_0", q))] if self.free else moving

    def energy(self, q: Numbers, v: Numbers) -> float:
        """Kinetic and potential energy, summed over bodies, their velocities by differences."""
        spin = slope(lambda t: np.array([R for _, (R, _) in self.bodies(self.moved(q, v, t))]))
        centre = slope(lambda t: np.array([p + R @ b.com for b, (R, p) in self.bodies(self.moved(q, v, t))]))
        total = 0.0
        for (body, (R, p)), R_dot, c_dot in zip(self.bodies(q), spin, centre, strict=True):
            W = R.T @ R_dot
            omega = np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
            total += body.mass * c_dot @ c_dot / 2 + omega @ body.inertia @ omega / 2
            total -= body.mass * self.gravity @ (p + R @ body.com)
        return float(total)

    def urdf(self, prefix: str) -> str:
        """The tree as URDF, its names without the prefix."""
        base = self.root_body
        parts = [urdf_link("0", base.mass, base.com, base.inertia) if prefix == "b_" else '<link name="0"/>']
        for joint in self.trees[prefix]:
            name = joint.name.removeprefix(prefix)
            body, limit = joint.body, '<limit lower="-9" upper="9" effort="0" velocity="0"/>'
            parts += [
                urdf_link(name[1:], body.mass, body.com, body.inertia),
                urdf_joint(name, joint.kind, joint.parent, name[1:], joint.xyz, joint.rpy, joint.axis, limit),
            ]
        return f'<robot name="tree">{"".join(parts)}</robot>'


def random_world(seed: int, *, free: bool = True) -> World:
    """A world from a seed."""
    random = np.random.default_rng(seed)

    def vector(size: float) -> Array:
        return random.uniform(-size, size, 3)

    def body() -> Body:
        turn, points = rotation(vector(3)), random.uniform(-0.1, 0.1, (4, 3))  # four point masses and a ball
        inertia = 1e-3 * np.eye(3) + sum(x @ x * np.eye(3) - np.outer(x, x) for x in points @ turn)
        return Body(random.uniform(0.2, 2.0), vector(0.3), inertia)

    def tree(prefix: str) -> tuple[Joint, ...]:
        return tuple(
            Joint(prefix + name, kind, parent, vector(0.5), vector(3), vector(1), body())
            for name, kind, parent in JOINTS
        )

    return World(
        trees={prefix: tree(prefix) for prefix in ("a_", "b_")},
        stands={prefix: (vector(0.5), vector(3)) for prefix in ("a_", "b_")},
        root_body=body(),
        gravity=vector(10),
        free=free,
        random=random,
    )


def rotation(rpy: Array) -> Array:
    """URDF's roll, pitch, yaw: about the fixed x, y, z axes in this order."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def compose(a: Placement, b: Placement) -> Placement:
    """Placement b given in a."""
    return a[0] @ b[0], a[1] + a[0] @ b[1]


def slope(f: Callable[[float], Array], step: float = 2e-4) -> Array:
    """df/dt at 0 by central differences of order 4: to some 1e-11 for functions with scales near 1."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)
