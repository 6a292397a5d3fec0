"""Texts of a mechanism built joint by joint, in any plane and with any axes for the links' frames."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scripts.experiments.fuzz.read import read
from scripts.experiments.fuzz.spatial import Array, rotation, rpy
from scripts.experiments.fuzz.state import split, state

__all__ = ["Builder", "angles", "link", "toml", "words"]


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
    """A growing tree: links "base" and one below each joint, of the joint's name with "_link".

    What is given is in design axes, one plane for a planar mechanism; each link's own axes are turned against those
    by `turns`, so that nothing stays along a coordinate axis.
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
        """Add a joint at a place and along an axis in design axes, and its link; `flat`: com and joints in a plane."""
        random, child = self.random, f"{name}_link"
        turn = rotation(random.normal(size=(1, 3)) * 2)[0] if random.random() < 0.6 else np.eye(3)
        self.turns[child] = turn  # own axes = turn^T design axes
        mass = float(10 ** random.uniform(-1, 0.7))
        com = self.vector(0.5, flat)
        points = random.normal(size=(4, 3)) * 0.15 * self.scale
        own = sum(p @ p * np.eye(3) - np.outer(p, p) for p in points) * mass / 4
        up = self.turns[parent]
        part = _Part(
            name, kind, parent, up.T @ at, angles(up.T @ turn), turn.T @ axis, mass, turn.T @ com, turn.T @ own @ turn
        )
        self.parts.append(part)
        self.guess[name] = float(random.uniform(-1, 1) * (0.3 * self.scale if kind == "prismatic" else np.pi))
        return child

    def vector(self, size: float, flat: Array | None = None) -> Array:
        """A random vector up to a size times the mechanism's; in the plane across `flat`."""
        v = self.random.uniform(-size, size, 3) * self.scale
        return v if flat is None else v - flat * (flat @ v)

    def placement(self, link: str) -> tuple[Array, Array]:
        """A link's own axes and origin in the world, at the guess."""
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
        """The files by name."""
        lines = [f'name = "{self.name}"', f"gravity = {self.gravity.tolist()}", "", "[[tree]]", 'file = "tree.urdf"']
        lines += [f'root = "{"free" if self.free else "fixed"}"']
        lines += [f"xyz = {self.stands[0].tolist()}", f"rpy = {self.stands[1].tolist()}", ""]
        lines += ["[q_guess]", *(f"{key} = {value!r}" for key, value in self.guess.items()), ""]
        for kind, tables in (("loop", self.loops), ("coupling", self.couplings), ("spring", self.springs)):
            for table in tables:
                lines += [f"[[{kind}]]", *(f"{key} = {toml(value)}" for key, value in table.items()), ""]
        return {"mechanism.toml": "\n".join(lines) + "\n", "tree.urdf": self._urdf()}

    def _urdf(self) -> str:
        base = link("base", 2.0, np.zeros(3), np.eye(3) * self.scale**2 / 9)
        text = [base if self.free else '  <link name="base"/>']
        for part in self.parts:
            text.append(link(f"{part.name}_link", part.mass, part.com, part.inertia))
            text.append(
                f'  <joint name="{part.name}" type="{part.kind}">\n    <parent link="{part.parent}"/>'
                f'<child link="{part.name}_link"/>\n    <origin xyz="{words(part.xyz)}" rpy="{words(part.rpy)}"/>'
                f'<axis xyz="{words(part.axis)}"/>\n  </joint>'
            )
        return '<robot name="tree">\n' + "\n".join(text) + "\n</robot>\n"


def angles(R: Array) -> Array:
    """Roll, pitch, yaw of a rotation."""
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def toml(value: Any) -> str:
    """A value as TOML writes it: JSON's way, but for tables; without what is None."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(x)}" for key, x in value.items() if x is not None) + "}"
    if isinstance(value, np.ndarray):
        return toml(value.tolist())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def link(name: str, mass: float, com: Array, inertia: Array) -> str:
    """A link with its inertia, about its centre of mass, as URDF writes it."""
    places = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    moments = " ".join(f'{key}="{float(inertia[at])!r}"' for key, at in places.items())
    return (
        f'  <link name="{name}"><inertial><origin xyz="{words(com)}"/><mass value="{float(mass)!r}"/>\n'
        f"    <inertia {moments}/></inertial></link>"
    )


def words(numbers: Array) -> str:
    """Numbers as an attribute of URDF has them, digit for digit."""
    return " ".join(repr(float(x)) for x in numbers)
