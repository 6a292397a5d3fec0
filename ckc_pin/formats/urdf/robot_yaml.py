"""The robot.yaml of example-parallel-robots: pairs of frames, motors, and joints that stand for others.

PyYAML reads it through msgspec, by its safe loader. Its C parser overflows the stack on values nested without
end, and aliases multiply what comes out, so both are refused beforehand.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import accumulate
from xml.etree.ElementTree import Element, SubElement

import msgspec

from ckc_pin.base.toml import convert
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.draft import Draft, some, unique
from ckc_pin.formats.urdf.names import Names
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["take_yaml"]

MAX_CHARACTERS = 2**16  # the largest published one has 2500
TYPES = ("3d", "6d")
AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
MAX_DEPTH = 20
STACKED = re.compile(r"([-?:][ \t]+){20}")  # "- - - ..." nests on one line
ALIAS = re.compile(r"(^|[\s\[{,:-])[&*]\w", re.MULTILINE)


class RobotYaml(msgspec.Struct, frozen=True):
    """What the file may hold."""

    closed_loop: list[tuple[str, str]] = []
    type: list[str] = []
    name_mot: list[str] = []
    joint_name: list[str] = []
    joint_type: list[str] = []


def take_yaml(draft: Draft, names: Names, text: str, source: str) -> None:
    """Add the loops and motors of a robot.yaml, and substitute joints in the URDF.

    Raises
    ------
    InputError
        Malformed YAML, or a value of the wrong kind.
    MechanismError
        A frame, joint or type that does not exist.
    """
    content, unknown = _parse(text, source)
    draft.left_out += [f"{source}: key {key!r}, which is not known here" for key in unknown]
    if len(content.joint_name) != len(content.joint_type):
        counts = f"{len(content.joint_name)} entries, joint_type {len(content.joint_type)}"
        raise InputError(f"{source}: joint_name has {counts}")
    for joint, kind in zip(content.joint_name, content.joint_type, strict=True):
        _substitute(draft, names, joint, kind, source)
    hinges = [
        n for n, j in names.joints.items() if "spherical" in n and j.get("type") != "fixed" and n not in names.made
    ]
    if hinges:
        remedy = "if they stand for balls, give them joint_name and joint_type SPHERICAL and import again"
        draft.guessed.append(
            f"joints called spherical stay hinges, {source} says nothing else: {some(hinges)}; {remedy}"
        )
    for position, (one, two) in enumerate(content.closed_loop):
        kind = content.type[position].lower() if position < len(content.type) else ""
        if kind and kind not in TYPES:
            raise MechanismError(f"{source}: type {kind!r} of loop {one}, {two} is not one of {', '.join(TYPES)}")
        name = unique(_common_name(one, two) or f"loop_{position + 1}", [spec.name for spec, _ in draft.loops])
        if not kind:
            draft.guessed.append(f"loop {name} is a weld: {source} has no type for it")
        frames = [_frame(draft, names, frame, source) for frame in (one, two)]
        spec = LoopSpec(name=name, type="point" if kind == "3d" else "weld", frame_a=frames[0], frame_b=frames[1])
        draft.loops.append((spec, f"{kind or 'no type'} in {source}"))
    _motors(draft, names, content.name_mot, source)


def _parse(text: str, source: str) -> tuple[RobotYaml, list[str]]:
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"{source}: more than {MAX_CHARACTERS} characters, too large for a robot.yaml")
    if STACKED.search(text) or max(accumulate((c in "[{") - (c in "]}") for c in text), default=0) > MAX_DEPTH:
        raise InputError(f"{source}: values nested more than {MAX_DEPTH} deep are not accepted")
    if ALIAS.search(text):
        raise InputError(f"{source}: YAML anchors and aliases (&name, *name) are not accepted")
    try:
        plain = msgspec.yaml.decode(text)
    except ImportError:
        raise InputError(f"{source}: reading it needs PyYAML: pip install pyyaml") from None
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise InputError(f"{source}: malformed YAML: {' '.join(str(error).split())}") from None
    if not isinstance(plain, dict):
        raise InputError(f"{source}: not a table with closed_loop, type, name_mot")
    known = {field.name for field in msgspec.structs.fields(RobotYaml)}
    return convert(plain, RobotYaml, source), [str(key) for key in plain if key not in known]


def _substitute(draft: Draft, names: Names, name: str, kind: str, source: str) -> None:
    """Turn a hinge into a ball or universal joint of several hinges, or fix it."""
    joint = names.joints.get(name)
    if joint is None:  # as in the format's own loader, which passes over it
        draft.left_out.append(f"{source}: joint_name {name}: no joint has this name{names.near(name)}")
        return
    universal = re.fullmatch(r"UJOINT_([XYZ])([XYZ])", kind)
    if kind == "FIXED":
        _reduce(joint, "fixed")
        return
    if kind != "SPHERICAL" and universal is None:
        raise MechanismError(f"{source}: joint_type {kind!r} of {name} is not SPHERICAL, FIXED, UJOINT_XY or the like")
    letters = universal.groups() if universal else ("X", "Y", "Z")
    parts = [unique(f"{name}_{letter}", names.joints) for letter in letters]
    if joint.find("dynamics") is not None or joint.find("mimic") is not None:
        draft.left_out.append(f"dynamics and mimic of joint {name}, now {', '.join(parts)}")
    _reduce(joint, "revolute")
    _split(draft.robot, joint, parts, [AXES[letter] for letter in letters], lambda part: unique(part, names.links))
    names.replace(name, draft.robot)
    if len(letters) == 3:
        said = f"ball joint {name} is three hinges, {', '.join(parts)}"
        draft.guessed.append(f"{said}: singular where {parts[1]} is +-90 degrees")


def _split(robot: Element, joint: Element, parts: list[str], axes: list[str], link_name: Callable[[str], str]) -> None:
    """Put several hinges, one after another through massless links, in place of one joint."""
    end = joint.find("child").attrib["link"]  # type: ignore[union-attr]
    position = list(robot).index(joint)
    parent = joint.find("parent").attrib["link"]  # type: ignore[union-attr]
    origin = joint.find("origin")
    robot.remove(joint)
    for part, axis in zip(parts, axes, strict=True):
        hinge = Element("joint", name=part, type="continuous")
        SubElement(hinge, "parent", link=parent)
        if origin is not None and part == parts[0]:
            hinge.append(origin)
        parent = end if part == parts[-1] else link_name(f"{part}_link")
        SubElement(hinge, "child", link=parent)
        SubElement(hinge, "axis", xyz=axis)
        robot.insert(position, hinge)
        position += 1
        if parent != end:
            robot.insert(position, Element("link", name=parent))
            position += 1


def _reduce(joint: Element, kind: str) -> None:
    joint.set("type", kind)
    for tag in ("axis", "limit", "dynamics", "mimic", "safety_controller", "calibration", "joint_properties"):
        for element in joint.findall(tag):
            joint.remove(element)


def _frame(draft: Draft, names: Names, name: str, source: str) -> str:
    """Return a link or a joint as mechanism.toml calls it; of a joint that was split, its last hinge."""
    if name in names.links:
        if name in names.joints:
            draft.guessed.append(f"{source}: {name!r} is a link and a joint; the link is meant")
        return name
    if name in names.joints:
        return f"joint:{name}"
    if name in names.split:
        return f"joint:{names.split[name][-1]}"
    raise MechanismError(f"{source}: closed_loop: no link or joint {name!r}{names.near(name)}")


def _motors(draft: Draft, names: Names, motors: list[str], source: str) -> None:
    moving = [name for name, joint in names.joints.items() if joint.get("type") != "fixed"]
    found = [name for name in motors if name in moving]
    missing = [name for name in motors if name not in moving]
    if missing:
        draft.left_out.append(f"{source}: name_mot {', '.join(missing)}: no moving joint has this name")
    if found:
        draft.actuated = list(dict.fromkeys(found))


def _common_name(one: str, two: str) -> str:
    """Return what the names of two frames begin with."""
    same = next((k for k, (a, b) in enumerate(zip(one, two, strict=False)) if a != b), min(len(one), len(two)))
    return one[:same].rstrip("_-. ")
