"""Read the robot.yaml of example-parallel-robots: loops as pairs of frames, motors, and joints to replace.

msgspec parses it with PyYAML's safe loader. Deep nesting overflows the stack of PyYAML's C parser, and aliases multiply
the size of the content. Both are refused before parsing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import accumulate
from xml.etree.ElementTree import Element, SubElement

import msgspec

from ckc_pin.base.toml import convert
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.draft import Draft, list_names, make_unique
from ckc_pin.formats.urdf.elements import UrdfIndex
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["add_robot_yaml"]

MAX_CHARACTERS = 2**16  # the largest published file has 2500
LOOP_TYPES = ("3d", "6d")
AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
MAX_DEPTH = 20  # levels of nested values
NESTED_ON_ONE_LINE = re.compile(r"([-?:][ \t]+){20}")  # "- - - ..." nests a level with each dash
ALIAS = re.compile(r"(^|[\s\[{,:-])[&*]\w", re.MULTILINE)


class RobotYaml(msgspec.Struct, frozen=True):
    """Content of a robot.yaml."""

    closed_loop: list[tuple[str, str]] = []
    type: list[str] = []
    name_mot: list[str] = []
    joint_name: list[str] = []
    joint_type: list[str] = []


def add_robot_yaml(draft: Draft, index: UrdfIndex, text: str, source: str) -> None:
    """Add the loops and motors of a robot.yaml to the draft, and replace joints of its URDF.

    Parameters
    ----------
    draft : Draft
    index : UrdfIndex
        Of the draft's URDF; updated after joints were replaced.
    text : str
    source : str
        Name of the file in messages.

    Raises
    ------
    InputError
        Malformed YAML, or a value of the wrong type.
    MechanismError
        A frame, joint or loop type that does not exist.
    """
    content, unknown_keys = _parse(text, source)
    draft.left_out += [f"{source}: unsupported key {key!r}" for key in unknown_keys]
    if len(content.joint_name) != len(content.joint_type):
        counts = f"{len(content.joint_name)} entries but joint_type has {len(content.joint_type)}"
        raise InputError(f"{source}: joint_name has {counts}; they must have the same number")
    for joint, kind in zip(content.joint_name, content.joint_type, strict=True):
        _substitute(draft, index, joint, kind, source)
    hinges = [
        n
        for n, j in index.joints.items()
        if "spherical" in n and j.get("type") != "fixed" and n not in index.split_results
    ]
    if hinges:
        remedy = "if they are ball joints, add them to joint_name with joint_type SPHERICAL and import again"
        draft.guessed.append(
            f"joints called spherical stay hinges, because {source} does not list them: {list_names(hinges)}; {remedy}"
        )
    for position, (one, two) in enumerate(content.closed_loop):
        kind = content.type[position].lower() if position < len(content.type) else ""
        if kind and kind not in LOOP_TYPES:
            raise MechanismError(f"{source}: type {kind!r} of loop {one}, {two} is not one of {', '.join(LOOP_TYPES)}")
        name = make_unique(_common_name(one, two) or f"loop_{position + 1}", [spec.name for spec, _ in draft.loops])
        if not kind:
            draft.guessed.append(f"loop {name} is a weld, because {source} has no type for it")
        frames = [_frame(draft, index, frame, source) for frame in (one, two)]
        spec = LoopSpec(name=name, type="point" if kind == "3d" else "weld", frame_a=frames[0], frame_b=frames[1])
        draft.loops.append((spec, f"{kind or 'no type'} in {source}"))
    _set_actuated(draft, index, content.name_mot, source)


def _parse(text: str, source: str) -> tuple[RobotYaml, list[str]]:
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"{source}: more than {MAX_CHARACTERS} characters, too large for a robot.yaml")
    depth = max(accumulate((c in "[{") - (c in "]}") for c in text), default=0)
    if depth > MAX_DEPTH or NESTED_ON_ONE_LINE.search(text):
        raise InputError(f"{source}: values nested more than {MAX_DEPTH} deep are not accepted")
    if ALIAS.search(text):
        raise InputError(f"{source}: YAML anchors and aliases (&name, *name) are not accepted")
    try:
        content = msgspec.yaml.decode(text)
    except ImportError:
        raise InputError(f"{source}: reading it needs PyYAML; install it with `pip install pyyaml`") from None
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise InputError(f"{source}: malformed YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a table with keys such as closed_loop, type and name_mot")
    keys = {field.name for field in msgspec.structs.fields(RobotYaml)}
    return convert(content, RobotYaml, source), [str(key) for key in content if key not in keys]


def _substitute(draft: Draft, index: UrdfIndex, name: str, kind: str, source: str) -> None:
    """Replace a hinge by the hinges of a ball or universal joint, or by a fixed joint."""
    joint = index.joints.get(name)
    if joint is None:  # example-parallel-robots' loader ignores such an entry, too
        draft.left_out.append(f"{source}: joint_name {name}: no joint has this name{index.suggest_names(name)}")
        return
    universal = re.fullmatch(r"UJOINT_([XYZ])([XYZ])", kind)
    if kind == "FIXED":
        _set_bare_type(joint, "fixed")
        return
    if kind != "SPHERICAL" and universal is None:
        raise MechanismError(f"{source}: joint_type {kind!r} of {name} is not SPHERICAL, FIXED, UJOINT_XY or the like")
    letters = universal.groups() if universal else ("X", "Y", "Z")
    parts = [make_unique(f"{name}_{letter}", index.joints) for letter in letters]
    if joint.find("dynamics") is not None or joint.find("mimic") is not None:
        draft.left_out.append(f"dynamics and mimic of joint {name}, now {', '.join(parts)}")
    _set_bare_type(joint, "revolute")
    _split(draft.robot, joint, parts, [AXES[letter] for letter in letters], lambda part: make_unique(part, index.links))
    index.update_after_split(name, draft.robot)
    if len(letters) == 3:
        hinges = f"ball joint {name} is three hinges, {', '.join(parts)}"
        draft.guessed.append(f"{hinges}: singular where {parts[1]} is +-90 degrees")


def _split(robot: Element, joint: Element, parts: list[str], axes: list[str], link_name: Callable[[str], str]) -> None:
    """Replace one joint by several hinges in series, connected by links without mass."""
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


def _set_bare_type(joint: Element, kind: str) -> None:
    """Change a joint's type and remove every element that depends on the type."""
    joint.set("type", kind)
    for tag in ("axis", "limit", "dynamics", "mimic", "safety_controller", "calibration", "joint_properties"):
        for element in joint.findall(tag):
            joint.remove(element)


def _frame(draft: Draft, index: UrdfIndex, name: str, source: str) -> str:
    """Return the name of a link or a joint in the syntax of mechanism.toml; for a replaced joint, of its last hinge."""
    if name in index.links:
        if name in index.joints:
            draft.guessed.append(f"{source}: {name!r} is a link and a joint; the link is used")
        return name
    if name in index.joints:
        return f"joint:{name}"
    if name in index.split_joints:
        return f"joint:{index.split_joints[name][-1]}"
    raise MechanismError(f"{source}: closed_loop: no link or joint {name!r}{index.suggest_names(name)}")


def _set_actuated(draft: Draft, index: UrdfIndex, motors: list[str], source: str) -> None:
    moving = [name for name, joint in index.joints.items() if joint.get("type") != "fixed"]
    actuated = [name for name in motors if name in moving]
    missing = [name for name in motors if name not in moving]
    if missing:
        draft.left_out.append(f"{source}: name_mot {', '.join(missing)}: no moving joint has this name")
    if actuated:
        draft.actuated = list(dict.fromkeys(actuated))


def _common_name(one: str, two: str) -> str:
    """Return the common beginning of the names of two frames."""
    length = next((k for k, (a, b) in enumerate(zip(one, two, strict=False)) if a != b), min(len(one), len(two)))
    return one[:length].rstrip("_-. ")
