"""Builder of mechanism files joint by joint, with random orientations of planes and link frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scripts.experiments.fuzz.read import read_model
from scripts.experiments.fuzz.spatial import Array, rotation, rpy
from scripts.experiments.fuzz.state import split_state, to_state
from scripts.experiments.mechanism_files import roll_pitch_yaw, toml_value, urdf_joint, urdf_link, urdf_robot

__all__ = ["Builder"]


@dataclass
class _Part:
    name: str
    kind: str
    parent: str
    xyz: Array  # of the joint, in the parent link's axes
    rpy: Array
    axis: Array  # in the child link's axes
    mass: float
    com: Array
    inertia: Array


@dataclass
class Builder:
    """Builds a mechanism's files. Links are "base" and one for each joint, named after the joint with "_link" appended.

    Arguments are in design axes, in which a planar mechanism lies in one plane. The axes of each link are rotated
    against the design axes by `link_axes`, so that no joint axis stays parallel to a coordinate axis.
    """

    random: np.random.Generator
    name: str
    free: bool = False
    scale: float = 1.0
    base_pose: Array = field(default_factory=lambda: np.zeros((2, 3)))
    gravity: Array = field(default_factory=lambda: np.zeros(3))
    parts: list[_Part] = field(default_factory=list)
    link_axes: dict[str, Array] = field(default_factory=lambda: {"base": np.eye(3), "world": np.eye(3)})
    loops: list[dict[str, Any]] = field(default_factory=list)
    couplings: list[dict[str, Any]] = field(default_factory=list)
    springs: list[dict[str, Any]] = field(default_factory=list)
    guess: dict[str, float] = field(default_factory=dict)

    def add_joint(self, name: str, kind: str, parent: str, at: Array, axis: Array, plane_normal: Array | None) -> str:
        """Add a joint and its link, and return the link's name. Position and axis are in design axes.

        `plane_normal` is the normal of the plane that has the joints and centres of mass of a planar mechanism.
        """
        random, child = self.random, f"{name}_link"
        axes = rotation(random.normal(size=(1, 3)) * 2)[0] if random.random() < 0.6 else np.eye(3)
        self.link_axes[child] = axes  # vector in link axes = axes^T (vector in design axes)
        mass = float(10 ** random.uniform(-1, 0.7))
        com = self.random_vector(0.5, plane_normal)
        points = random.normal(size=(4, 3)) * 0.15 * self.scale
        inertia = sum(p @ p * np.eye(3) - np.outer(p, p) for p in points) * mass / 4
        parent_axes = self.link_axes[parent]
        part = _Part(
            name,
            kind,
            parent,
            parent_axes.T @ at,
            roll_pitch_yaw(parent_axes.T @ axes),
            axes.T @ axis,
            mass,
            axes.T @ com,
            axes.T @ inertia @ axes,
        )
        self.parts.append(part)
        self.guess[name] = float(random.uniform(-1, 1) * (0.3 * self.scale if kind == "prismatic" else np.pi))
        return child

    def random_vector(self, size: float, plane_normal: Array | None = None) -> Array:
        """Return a random vector with components up to `size` times the mechanism's size, in the plane if given."""
        v = self.random.uniform(-size, size, 3) * self.scale
        return v if plane_normal is None else v - plane_normal * (plane_normal @ v)

    def compute_placement(self, link: str) -> tuple[Array, Array]:
        """Return a link's rotation and origin in world axes at the initial guess."""
        if link == "world":
            return np.eye(3), np.zeros(3)
        if link == "base" and not self.free:
            return rpy(self.base_pose[1]), self.base_pose[0]
        model = read_model(self.to_files())
        q = np.array([[self.guess.get(label, 0.0) for label in model.labels]])
        x, R, _, _ = split_state(to_state(model, q, np.zeros_like(q)))
        names = (["base"] if self.free else []) + [f"{label}_link" for label in model.labels if "." not in label]
        b = names.index(link)
        return R[0, b], x[0, b] - R[0, b] @ model.com[b]

    def to_files(self) -> dict[str, str]:
        """Return the texts of the files by name."""
        lines = [f'name = "{self.name}"', f"gravity = {self.gravity.tolist()}", "", "[[tree]]", 'file = "tree.urdf"']
        lines += [f'root = "{"free" if self.free else "fixed"}"']
        lines += [f"xyz = {self.base_pose[0].tolist()}", f"rpy = {self.base_pose[1].tolist()}", ""]
        lines += ["[q_guess]", *(f"{key} = {value!r}" for key, value in self.guess.items()), ""]
        for kind, tables in (("loop", self.loops), ("coupling", self.couplings), ("spring", self.springs)):
            for table in tables:
                lines += [f"[[{kind}]]", *(f"{key} = {toml_value(value)}" for key, value in table.items()), ""]
        return {"mechanism.toml": "\n".join(lines) + "\n", "tree.urdf": self._urdf()}

    def _urdf(self) -> str:
        base = urdf_link("base", 2.0, np.zeros(3), np.eye(3) * self.scale**2 / 9)
        elements = [base if self.free else '  <link name="base"/>']
        for part in self.parts:
            child = f"{part.name}_link"
            elements.append(urdf_link(child, part.mass, part.com, part.inertia))
            elements.append(urdf_joint(part.name, part.kind, part.parent, child, part.xyz, part.rpy, part.axis))
        return urdf_robot("tree", elements)
