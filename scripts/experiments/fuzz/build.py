"""Files of a mechanism that is built joint by joint, in any plane and with any axes of the links' frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scripts.experiments.fuzz.read import read
from scripts.experiments.fuzz.spatial import Array, rotation, rpy
from scripts.experiments.fuzz.state import split, state
from scripts.experiments.mechanism_files import roll_pitch_yaw, toml_value, urdf_joint, urdf_link, urdf_robot

__all__ = ["Builder"]


@dataclass
class _Part:
    name: str
    kind: str
    parent: str
    xyz: Array  # of the joint, in the parent's own axes
    rpy: Array
    axis: Array  # in the child's own axes
    mass: float
    com: Array
    inertia: Array


@dataclass
class Builder:
    """Builder of a mechanism's files: links are "base" and one for each joint, the joint's name with "_link".

    Arguments are in design axes, in which a planar mechanism is in one plane. Each link's own axes are rotated against
    them by `turns`, so that nothing stays parallel to a coordinate axis.
    """

    random: np.random.Generator
    name: str
    free: bool = False
    scale: float = 1.0
    stands: Array = field(default_factory=lambda: np.zeros((2, 3)))
    gravity: Array = field(default_factory=lambda: np.zeros(3))
    parts: list[_Part] = field(default_factory=list)
    turns: dict[str, Array] = field(default_factory=lambda: {"base": np.eye(3), "world": np.eye(3)})
    loops: list[dict[str, Any]] = field(default_factory=list)
    couplings: list[dict[str, Any]] = field(default_factory=list)
    springs: list[dict[str, Any]] = field(default_factory=list)
    guess: dict[str, float] = field(default_factory=dict)

    def joint(self, name: str, kind: str, parent: str, at: Array, axis: Array, flat: Array | None) -> str:
        """Add a joint at a place and along an axis in design axes, and its link.

        `flat` is the normal of a planar mechanism's plane, in which joints and centres of mass are placed.
        """
        random, child = self.random, f"{name}_link"
        turn = rotation(random.normal(size=(1, 3)) * 2)[0] if random.random() < 0.6 else np.eye(3)
        self.turns[child] = turn  # own axes = turn^T design axes
        mass = float(10 ** random.uniform(-1, 0.7))
        com = self.vector(0.5, flat)
        points = random.normal(size=(4, 3)) * 0.15 * self.scale
        own = sum(p @ p * np.eye(3) - np.outer(p, p) for p in points) * mass / 4
        up = self.turns[parent]
        part = _Part(
            name,
            kind,
            parent,
            up.T @ at,
            roll_pitch_yaw(up.T @ turn),
            turn.T @ axis,
            mass,
            turn.T @ com,
            turn.T @ own @ turn,
        )
        self.parts.append(part)
        self.guess[name] = float(random.uniform(-1, 1) * (0.3 * self.scale if kind == "prismatic" else np.pi))
        return child

    def vector(self, size: float, flat: Array | None = None) -> Array:
        """Return a random vector of at most `size` times the mechanism's size, in the plane with normal `flat`."""
        v = self.random.uniform(-size, size, 3) * self.scale
        return v if flat is None else v - flat * (flat @ v)

    def placement(self, link: str) -> tuple[Array, Array]:
        """Return a link's axes and origin in the world at the guess."""
        if link == "world":
            return np.eye(3), np.zeros(3)
        if link == "base" and not self.free:
            return rpy(self.stands[1]), self.stands[0]
        model = read(self.texts())
        q = np.array([[self.guess.get(label, 0.0) for label in model.labels]])
        x, R, _, _ = split(state(model, q, np.zeros_like(q)))
        names = (["base"] if self.free else []) + [f"{label}_link" for label in model.labels if "." not in label]
        b = names.index(link)
        return R[0, b], x[0, b] - R[0, b] @ model.com[b]

    def texts(self) -> dict[str, str]:
        """Return the files by name."""
        lines = [f'name = "{self.name}"', f"gravity = {self.gravity.tolist()}", "", "[[tree]]", 'file = "tree.urdf"']
        lines += [f'root = "{"free" if self.free else "fixed"}"']
        lines += [f"xyz = {self.stands[0].tolist()}", f"rpy = {self.stands[1].tolist()}", ""]
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
