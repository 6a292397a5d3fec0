"""The numbers that the change of a motion with can be asked for, by name: `link.rod.mass`, `initial.q.theta_1`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import SetPointSpec
from ckc_pin.control.torques import Torques
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import FrameSpec
from ckc_pin.mechanism.tree import Array
from ckc_pin.native.variation import Varying, variation_table
from ckc_pin.simulation.scene import Scene

__all__ = ["variation_of", "varying_of"]

AXES = "xyz"
INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
MOVES = ("joint.", "loop.", "coupling.")  # what a start that is only assembled depends on in another way

Make = Callable[[], Varying]


def variation_of(mechanism: Mechanism, scene: Scene, controller: object, names: Sequence[str]) -> dict[str, Any]:
    """Describe to the loop how a scene's motion is to change with parameters.

    Raises
    ------
    InputError
        As `varying_of`, or a scene whose motion has no known derivatives.
    """
    varying = varying_of(mechanism, scene, controller, names)
    _refuse(mechanism, scene, controller, varying)
    target = np.zeros(0)
    if isinstance(controller, SetPoint) and controller.target.mechanism is mechanism:
        target = controller.target.q_tree
    table = variation_table(mechanism, varying, at_equilibrium=scene.spec.initial.at == "equilibrium", target=target)
    return {"variation": table}


def _refuse(mechanism: Mechanism, scene: Scene, controller: object, varying: Sequence[Varying]) -> None:
    spec = scene.spec
    if isinstance(controller, Sampled):
        raise InputError("sensitivities: controller.sample_time: of what is sampled they are not known; leave it out")
    if controller is not None and type(controller) not in (SetPoint, Tracking, Torques):
        raise InputError(
            f"sensitivities: {type(controller).__name__}: only of a scene's own controllers is it known how u changes"
        )
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        raise InputError('sensitivities: spf_coordinates = "z": eq. 8 as printed is another motion; take "w"')
    if spec.initial.w is not None and any(spec.initial.w):
        raise InputError("sensitivities: initial.w: they are known on phi = 0; leave it out")
    if spec.formulation == "dae" and (spec.solver.baumgarte or not spec.solver.projection):
        raise InputError(
            "sensitivities: solver.baumgarte, solver.projection: the loops have to be closed; leave them out"
        )
    plant = [x.name for x in varying if x.kind not in ("start", "friction", "restitution", "lower", "upper")]
    if type(controller) is Tracking and controller.model is None and plant:
        raise InputError(
            f"sensitivities: {plant[0]}: tracking compensates the mechanism's own terms, and how u changes with "
            "them is not known; give controller.model, or parameters of the start"
        )
    if type(controller) is Tracking and mechanism.tree.free:
        raise InputError(f"sensitivities: tracking of {mechanism.name}: with a free root it is not known how u changes")


def varying_of(mechanism: Mechanism, scene: Scene, controller: object, names: Sequence[str]) -> list[Varying]:
    """Look names up; a vector's stands for its three components.

    Raises
    ------
    InputError
        A name that is none (those there are near it are listed), or is given twice.
    """
    known = dict(_all(mechanism, scene, controller))
    found: list[Varying] = []
    for name in names:
        parts = [name] if name in known else [f"{name}.{axis}" for axis in AXES if f"{name}.{axis}" in known]
        if not parts:
            raise InputError(f"sensitivities: no parameter {name!r}; {_near(name, list(known))}")
        if scene.spec.initial.at == "assembled" and any(_is_of_shape(part) for part in parts):
            raise InputError(
                f'sensitivities: {name}: a start that is "assembled" follows from lengths in a way of its own; '
                "give initial.q"
            )
        found += [known[part]() for part in parts]
    labels = [x.name for x in found]
    if len(set(labels)) < len(labels):
        raise InputError(f"sensitivities: a parameter is named twice in {', '.join(names)}")
    if not labels:
        raise InputError(f"sensitivities: name parameters; {_near('', list(known))}")
    return found


def _is_of_shape(name: str) -> bool:
    return name.startswith(MOVES) and name.rpartition(".")[2] in (*AXES, "length", "offset")


def _near(name: str, known: list[str]) -> str:
    """Those that begin alike, as far as some do."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        near = [other for other in known if other.split(".")[:k] == parts[:k]]
        if near:
            return f"there are {', '.join(near)}"
    return f"they begin with {', '.join(dict.fromkeys(other.split('.')[0] for other in known))}"


def _all(mechanism: Mechanism, scene: Scene, controller: object) -> Iterator[tuple[str, Make]]:
    yield from _of_gravity()
    for link in mechanism.urdf.findall("link"):
        yield from _of_link(mechanism, link)
    for joint in mechanism.urdf.findall("joint"):
        yield from _of_joint(mechanism, joint)
    yield from _of_file(mechanism)
    yield from _of_controller(mechanism, scene, controller)
    yield from _of_start(mechanism, scene)


def _entry(name: str, kind: str, index: int = 0, numbers: Array | None = None) -> tuple[str, Make]:
    return name, lambda: Varying(name, kind, index, np.zeros(0) if numbers is None else np.asarray(numbers, float))


def _of_gravity() -> Iterator[tuple[str, Make]]:
    for axis, e in zip(AXES, np.eye(3), strict=True):
        yield _entry(f"gravity.{axis}", "gravity", 0, e)


def _numbers(element: ElementTree.Element | None, attribute: str, count: int) -> Array:
    text = None if element is None else element.get(attribute)
    return np.zeros(count) if text is None else np.array([float(x) for x in text.split()])


def _of_link(mechanism: Mechanism, link: ElementTree.Element) -> Iterator[tuple[str, Make]]:
    """A new mass is the same body of another density; a new centre takes the inertia along."""
    inertial, name = link.find("inertial"), link.attrib["name"]
    placed = mechanism.frames.links.get(name)
    if inertial is None or placed is None or placed.joint == 0:
        return
    origin, mass = inertial.find("origin"), float(_numbers(inertial.find("mass"), "value", 1)[0])
    centre = _numbers(origin, "xyz", 3)
    turn = pin.rpy.rpyToMatrix(*_numbers(origin, "rpy", 3))
    entries = {key: float(_numbers(inertial.find("inertia"), key, 1)[0]) for key in INERTIA}
    tensor = np.zeros((3, 3))
    for key, (i, j) in INERTIA.items():
        tensor[i, j] = tensor[j, i] = entries[key]
    about = turn @ tensor @ turn.T
    c = placed.translation + placed.rotation @ centre  # in the joint
    of_joint = placed.rotation @ about @ placed.rotation.T
    if mass > 0:
        yield _entry(f"link.{name}.mass", "inertia", placed.joint, _packed(1.0, c, of_joint / mass + _about(c, c)))
    for k, axis in enumerate(AXES):
        e = placed.rotation[:, k]
        numbers = _packed(0.0, mass * e, mass * (_about(c, e) + _about(e, c)))
        yield _entry(f"link.{name}.com.{axis}", "inertia", placed.joint, numbers)
    for key, (i, j) in INERTIA.items():
        unit = np.zeros((3, 3))
        unit[i, j] = unit[j, i] = 1.0
        turned = placed.rotation @ turn @ unit @ turn.T @ placed.rotation.T
        yield _entry(f"link.{name}.inertia.{key}", "inertia", placed.joint, _packed(0.0, np.zeros(3), turned))


def _about(a: Array, b: Array) -> Array:
    """Of a unit of mass at places: the bilinear part of its inertia about the origin."""
    return float(a @ b) * np.eye(3) - np.outer(a, b)


def _packed(mass: float, moment: Array, inertia: Array) -> Array:
    return np.concatenate([[mass], moment, inertia[np.triu_indices(3)]])


def _of_joint(mechanism: Mechanism, joint: ElementTree.Element) -> Iterator[tuple[str, Make]]:
    name, tree = joint.attrib["name"], mechanism.tree
    if not tree.model.existJointName(name):
        return
    at = tree.model.getJointId(name)
    parent = joint.find("parent")
    base = mechanism.frames.links.get(parent.attrib["link"]) if parent is not None else None
    if base is not None and base.joint == tree.model.parents[at]:
        for k, axis in enumerate(AXES):
            yield _placement(f"joint.{name}.xyz.{axis}", "joint", at, base.joint, base.rotation[:, k])
    if name in tree.index:
        k = tree.index[name]
        for key, kind in (("damping", "joint_damping"), ("friction", "friction")):
            yield _entry(f"joint.{name}.{key}", kind, k)
        if mechanism.joints.stopped[k]:
            yield _entry(f"joint.{name}.restitution", "restitution", k)
            for key in ("lower", "upper"):
                yield _entry(f"joint.{name}.{key}", key, k)


def _placement(name: str, placed: str, index: int, carrier: int, axis: Array) -> tuple[str, Make]:
    return name, lambda: Varying(name, "placement", index, placed=placed, carrier=carrier, axis=axis)  # type: ignore[arg-type]


def _of_file(mechanism: Mechanism) -> Iterator[tuple[str, Make]]:
    spec, tree, rows = mechanism.spec, mechanism.tree, mechanism.closure.names
    for k, loop in enumerate(spec.loop):
        for end, frame in enumerate((loop.frame_a, loop.frame_b)):
            yield from _of_frame(
                mechanism, f"loop.{loop.name}.frame_{'ab'[end]}", frame, "point", k + end * len(spec.loop)
            )
        if loop.type == "distance":
            yield _entry(f"loop.{loop.name}.length", "length", rows.index((loop.name, "length")))
    for k, coupling in enumerate(spec.coupling):
        row = rows.index((f"{coupling.joint}~{coupling.other}", "coupling"))
        yield _entry(f"coupling.{k}.offset", "offset", row)
    lines = [spring for spring in spec.spring if spring.joint is None]
    for k, spring in enumerate(spec.spring):
        if spring.joint is not None:
            at = tree.index[spring.joint]
            for key, kind in (("stiffness", "joint_stiffness"), ("rest", "joint_rest"), ("damping", "joint_damping")):
                yield _entry(f"spring.{k}.{key}", kind, at)
            continue
        line = next(i for i, other in enumerate(lines) if other is spring)
        for key in ("stiffness", "rest_length", "damping"):
            yield _entry(f"spring.{k}.{key}", key, line)
        for end, end_frame in enumerate((spring.frame_a, spring.frame_b)):
            if end_frame is not None:
                at = line + end * len(lines)
                yield from _of_frame(mechanism, f"spring.{k}.frame_{'ab'[end]}", end_frame, "spring", at)
    for k, force in enumerate(spec.force):
        yield _entry(f"force.{k}.value", "constant", tree.index[force.joint])


def _of_frame(
    mechanism: Mechanism, name: str, frame: str | FrameSpec, placed: str, index: int
) -> Iterator[tuple[str, Make]]:
    base = mechanism.frames.find(frame if isinstance(frame, str) else frame.link, name)
    for k, axis in enumerate(AXES):
        yield _placement(f"{name}.xyz.{axis}", placed, index, base.joint, base.rotation[:, k])


def _of_controller(mechanism: Mechanism, scene: Scene, controller: object) -> Iterator[tuple[str, Make]]:
    spec, d = scene.spec.controller, mechanism.d
    if type(controller) is not SetPoint or not isinstance(spec, SetPointSpec):
        return
    for key, kind in (("K_P", "gain_q"), ("K_V", "gain_q_dot")):
        if isinstance(getattr(spec, key), float | int):
            yield _entry(f"controller.{key}", kind, 0, np.concatenate([np.eye(d).ravel(), controller.q_d]))
        for k, name in enumerate(mechanism.independent):
            unit = np.diag(np.eye(d)[k])
            yield _entry(f"controller.{key}.{name}", kind, 0, np.concatenate([unit.ravel(), controller.q_d]))


def _of_start(mechanism: Mechanism, scene: Scene) -> Iterator[tuple[str, Make]]:
    tree = mechanism.tree
    for k, name in enumerate(mechanism.independent):
        if name not in tree.free_coordinates and scene.spec.initial.at is None:
            yield _start(f"initial.q.{name}", np.eye(tree.n)[tree.index[name]], None)
        yield _start(f"initial.q_dot.{name}", None, np.eye(mechanism.d)[k])


def _start(name: str, q: Array | None, q_dot: Array | None) -> tuple[str, Make]:
    return name, lambda: Varying(name, "start", q=q, q_dot=q_dot)
