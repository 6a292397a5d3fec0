"""Independent reader of mechanism files: bodies, joints, constraints and forces as arrays, without Pinocchio."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

import numpy as np

from scripts.experiments.fuzz.spatial import Array, IntArray, perpendicular, rpy

__all__ = ["Frame", "Model", "UnsupportedMechanism", "read_model"]

ROOT = ("x", "y", "z", "rx", "ry", "rz")
MOVING = {"revolute": "R", "continuous": "R", "prismatic": "P", "floating": "F"}


class UnsupportedMechanism(Exception):
    """Mechanism that the reference integrator does not support."""


@dataclass(frozen=True)
class Frame:
    """Frame fixed in a body: the body's index (the last one is the world), rotation and origin in the body's axes."""

    body: int
    R: Array
    p: Array


@dataclass
class _Link:
    frame: Frame  # in the body that the link belongs to
    mass: float = 0.0
    com: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass
class Model:
    """Mechanism as bodies 0 ... nb - 1, each moved by one joint, and the world as body nb.

    A body's axes are the axes of its joint's child link. `place_R` and `place_p` are the joint's frame in the parent's
    axes. `newton_euler.py` converts the lists to arrays.
    """

    kind: list[str]
    parent: IntArray
    place_R: Array
    place_p: Array
    axis: Array
    mass: Array
    com: Array
    inertia: Array
    column: IntArray
    labels: list[str]
    gravity: Array
    size: float
    components: list[
        tuple[Frame, Frame, int, Array]
    ]  # A, B, body in which the direction is fixed, direction in that body
    dots: list[tuple[int, Array, int, Array]]
    distances: list[tuple[Frame, Frame, float]]
    parallel: list[tuple[int, int]]  # bodies with equal orientation
    couplings: Array  # (rows, n)
    springs: list[tuple[Frame, Frame, float, float, float]]  # A, B, stiffness, rest length, damping
    stiffness: Array  # by column
    rest: Array
    damping: Array
    constant: Array

    @property
    def nb(self) -> int:
        return len(self.kind)

    @property
    def n(self) -> int:
        return len(self.labels)

    @property
    def conservative(self) -> bool:
        return not self.damping.any() and not any(spring[4] for spring in self.springs)


class _Reader:
    def __init__(self) -> None:
        self.links: dict[str, _Link] = {}
        self.joints: dict[str, Frame] = {}
        self.bodies: list[dict[str, Any]] = []
        self.labels: list[str] = []
        self.joint_damping: dict[str, float] = {}
        self.mimic: list[tuple[str, str, float]] = []
        self.links_of_body: list[list[_Link]] = []
        self.offsets: list[float] = []

    def read_tree(self, text: str, spec: Mapping[str, Any]) -> None:
        robot, prefix = ElementTree.fromstring(text), spec.get("prefix", "")
        links = {prefix + element.attrib["name"]: element for element in robot.findall("link")}
        joints = robot.findall("joint")
        below: dict[str, list[ElementTree.Element]] = {}
        for joint in joints:
            below.setdefault(prefix + joint.find("parent").attrib["link"], []).append(joint)  # type: ignore[union-attr]
        base = (set(links) - {prefix + joint.find("child").attrib["link"] for joint in joints}).pop()  # type: ignore[union-attr]
        placement = Frame(-1, rpy(spec.get("rpy", (0, 0, 0))), np.array(spec.get("xyz", (0, 0, 0)), float))
        if spec.get("parent", "world") != "world":
            placement = _compose(self.links[spec["parent"]].frame, placement.R, placement.p)
        if spec.get("root", "fixed") == "free":
            placement = self.body("F", f"{prefix}root", placement, np.zeros(3))
        self.links[base] = self.link(links[base], placement)
        pending = [base]
        while pending:
            name = pending.pop()
            for joint in below.get(name, []):
                child = prefix + joint.find("child").attrib["link"]  # type: ignore[union-attr]
                frame = self.joint(joint, prefix, self.links[name].frame)
                self.links[child] = self.link(links[child], frame)
                pending.append(child)

    def joint(self, element: ElementTree.Element, prefix: str, parent: Frame) -> Frame:
        name, kind = prefix + element.attrib["name"], element.attrib["type"]
        R, p = _read_origin(element)
        self.offsets.append(float(np.linalg.norm(p)))
        if kind == "fixed":
            self.joints[name] = _compose(parent, R, p)
            return self.joints[name]
        if kind not in MOVING:
            raise UnsupportedMechanism(f"joint {name}: {kind}")
        axis = _read_numbers(element.find("axis"), "xyz", "1 0 0")
        frame = self.body(MOVING[kind], name, _compose(parent, R, p), axis / (np.linalg.norm(axis) or 1.0))
        self.joints[name] = frame
        dynamics, mimic = element.find("dynamics"), element.find("mimic")
        if dynamics is not None:
            self.joint_damping[name] = float(dynamics.get("damping", "0"))
        if mimic is not None:
            self.mimic.append((name, prefix + mimic.attrib["joint"], float(mimic.get("multiplier", "1"))))
        return frame

    def body(self, kind: str, name: str, placement: Frame, axis: Array) -> Frame:
        if kind == "F" and placement.body >= 0:
            raise UnsupportedMechanism(f"{name}: a free root whose parent is a moving link")
        number, column = len(self.bodies), len(self.labels)
        self.labels += [f"{name}.{x}" for x in ROOT] if kind == "F" else [name]
        self.bodies.append({"kind": kind, "stands": placement, "axis": axis, "column": column})
        self.links_of_body.append([])
        return Frame(number, np.eye(3), np.zeros(3))

    def link(self, element: ElementTree.Element, frame: Frame) -> _Link:
        inertial = element.find("inertial")
        link = _Link(frame)
        if inertial is not None:
            R, p = _read_origin(inertial)
            link.mass = float(inertial.find("mass").attrib["value"])  # type: ignore[union-attr]
            xx, yy, zz, xy, xz, yz = (
                float(inertial.find("inertia").attrib[key])  # type: ignore[union-attr]
                for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            )
            turned = frame.R @ R
            link.com = frame.p + frame.R @ p
            link.inertia = turned @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turned.T
        if frame.body >= 0:
            self.links_of_body[frame.body].append(link)
        return link

    def frame(self, frame_spec: str | Mapping[str, Any]) -> Frame:
        if isinstance(frame_spec, str):
            name, R, p = frame_spec, np.eye(3), np.zeros(3)
        else:
            name, R, p = (
                frame_spec["link"],
                rpy(frame_spec.get("rpy", (0, 0, 0))),
                np.array(frame_spec.get("xyz", (0, 0, 0)), float),
            )
        if name == "world":
            base = Frame(-1, np.eye(3), np.zeros(3))
        elif name.startswith("joint:"):
            base = self.joints[name.removeprefix("joint:")]
        else:
            base = self.links[name].frame
        return _compose(base, R, p)


def read_model(texts: Mapping[str, str]) -> Model:
    """Return the model of a mechanism from the texts of its files by name; one of them is "mechanism.toml"."""
    spec = tomllib.loads(texts["mechanism.toml"])
    if spec.get("joint"):
        raise UnsupportedMechanism("rotors, friction or stops in [[joint]] tables")
    reader = _Reader()
    for read_tree in spec.get("tree", [{"file": spec.get("urdf")}]):
        reader.read_tree(texts[read_tree["file"]], read_tree)
    nb, n = len(reader.bodies), len(reader.labels)
    placement = [body["stands"] for body in reader.bodies]
    merged = [_merge_links(links) for links in reader.links_of_body]
    model = Model(
        kind=[body["kind"] for body in reader.bodies],
        parent=np.array([s.body % (nb + 1) for s in placement], np.intp),  # -1 is the world, the last body
        place_R=np.array([s.R for s in placement]),
        place_p=np.array([s.p for s in placement]),
        axis=np.array([body["axis"] for body in reader.bodies]),
        mass=np.array([m for m, _, _ in merged]),
        com=np.array([c for _, c, _ in merged]),
        inertia=np.array([i for _, _, i in merged]),
        column=np.array([body["column"] for body in reader.bodies], np.intp),
        labels=reader.labels,
        gravity=np.array(spec.get("gravity", (0, 0, -9.81)), float),
        size=max(reader.offsets, default=0.0) or 1.0,
        components=[], dots=[], distances=[], parallel=[], springs=[],
        couplings=np.zeros((0, n)), stiffness=np.zeros(n), rest=np.zeros(n), damping=np.zeros(n), constant=np.zeros(n),
    )  # fmt: skip
    for loop in spec.get("loop", []):
        _add_loop(model, reader, loop)
    at = {label: k for k, label in enumerate(model.labels)}
    couplings = [(c["joint"], c["other"], c["ratio"]) for c in spec.get("coupling", [])] + reader.mimic
    model.couplings = np.zeros((len(couplings), n))
    for row, (joint, other, ratio) in zip(model.couplings, couplings, strict=True):
        row[at[joint]], row[at[other]] = 1.0, -ratio
    for name, value in reader.joint_damping.items():
        model.damping[at[name]] += value
    for force in spec.get("force", []):
        model.constant[at[force["joint"]]] += force["value"]
    for spring in spec.get("spring", []):
        k, c = spring.get("stiffness", 0.0), spring.get("damping", 0.0)
        if "joint" in spring:
            column = at[spring["joint"]]
            model.stiffness[column], model.rest[column] = k, spring.get("rest", 0.0)
            model.damping[column] += c
        else:
            a, b = reader.frame(spring["frame_a"]), reader.frame(spring["frame_b"])
            model.springs.append((a, b, k, spring.get("rest_length", 0.0), c))
    return model


def _add_loop(model: Model, reader: _Reader, loop: Mapping[str, Any]) -> None:
    """Add a loop's constraint rows, as in the table of docs/reference/mechanism.md.

    The rows log(R_A^T R_B) = 0 are stored as two bodies with equal orientation.
    """
    kind, a, b = loop["type"], reader.frame(loop["frame_a"]), reader.frame(loop["frame_b"])
    model.size = max(model.size, float(np.linalg.norm(a.p)), float(np.linalg.norm(b.p)))
    axis_a, axis_b = (np.array(loop.get(key, (0, 0, 1)), float) for key in ("axis_a", "axis_b"))
    axis_a, axis_b = axis_a / np.linalg.norm(axis_a), axis_b / np.linalg.norm(axis_b)
    e1, e2 = perpendicular(axis_a)
    if kind == "distance":
        model.distances.append((a, b, float(loop["length"])))
    else:
        all_directions = kind in ("point", "hinge", "universal", "weld")
        for e in np.eye(3) if all_directions else (e1, e2):
            world = loop.get("rows_in", "a") == "world"
            model.components.append((a, b, -1 if world else a.body, e if world else a.R @ e))
    if kind in ("hinge", "cylindrical"):
        model.dots += [(a.body, a.R @ e, b.body, b.R @ axis_b) for e in (e1, e2)]
    elif kind == "universal":
        model.dots.append((a.body, a.R @ axis_a, b.body, b.R @ axis_b))
    elif kind in ("prismatic", "weld"):
        model.parallel.append((a.body, b.body))


def _merge_links(links: list[_Link]) -> tuple[float, Array, Array]:
    """Return mass, centre of mass, and inertia about it, of links that belong to one body."""
    mass = sum(link.mass for link in links)
    com = sum((link.mass * link.com for link in links), np.zeros(3)) / (mass or 1.0)
    inertia = np.zeros((3, 3))
    for link in links:
        r = link.com - com
        inertia += link.inertia + link.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, com, inertia


def _compose(base: Frame, R: Array, p: Array) -> Frame:
    return Frame(base.body, base.R @ R, base.p + base.R @ p)


def _read_origin(element: ElementTree.Element) -> tuple[Array, Array]:
    origin = element.find("origin")
    return rpy(_read_numbers(origin, "rpy", "0 0 0")), _read_numbers(origin, "xyz", "0 0 0")


def _read_numbers(element: ElementTree.Element | None, key: str, default: str) -> Array:
    return np.array([float(x) for x in (default if element is None else element.get(key, default)).split()])
