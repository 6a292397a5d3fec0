"""Read the robot.yaml of example-parallel-robots: loops as pairs of frames, motors, and joints to replace."""

from __future__ import annotations

import difflib
import re

import msgspec
import numpy as np

from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.conversion import list_names, make_unique
from ckc_pin.formats.robot import JointAxis, Robot
from ckc_pin.formats.urdf.yaml import parse_yaml
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["add_robot_yaml", "suggest_names"]

LOOP_TYPES = ("3d", "6d")
AXES = dict(zip("XYZ", np.eye(3), strict=True))
MAX_SUGGESTIONS = 3  # similar names in a message about an unknown one


class RobotYaml(msgspec.Struct, frozen=True):
    """Content of a robot.yaml."""

    closed_loop: list[tuple[str, str]] = []
    type: list[str] = []
    name_mot: list[str] = []
    joint_name: list[str] = []
    joint_type: list[str] = []


def add_robot_yaml(robot: Robot, text: str, source: str) -> None:
    """Add the loops and motors of a robot.yaml, and replace joints."""
    content, unknown_keys = parse_yaml(text, RobotYaml, source)
    robot.left_out += [f"{source}: unsupported key {key!r}" for key in unknown_keys]
    if len(content.joint_name) != len(content.joint_type):
        counts = f"{len(content.joint_name)} entries but joint_type has {len(content.joint_type)}"
        raise InputError(f"{source}: joint_name has {counts}; they must have the same number")
    for joint, kind in zip(content.joint_name, content.joint_type, strict=True):
        _substitute(robot, joint, kind, source)
    hinges = [name for name, joint in robot.joints.items() if "spherical" in name and len(joint.axes) == 1]
    if hinges:
        remedy = "if they are ball joints, add them to joint_name with joint_type SPHERICAL and import again"
        robot.guessed.append(
            f"joints called spherical stay hinges, because {source} does not list them: {list_names(hinges)}; {remedy}"
        )
    for position, (one, two) in enumerate(content.closed_loop):
        kind = content.type[position].lower() if position < len(content.type) else ""
        if kind and kind not in LOOP_TYPES:
            raise MechanismError(f"{source}: type {kind!r} of loop {one}, {two} is not one of {', '.join(LOOP_TYPES)}")
        name = make_unique(_common_name(one, two) or f"loop_{position + 1}", [spec.name for spec, _ in robot.loops])
        if not kind:
            robot.guessed.append(f"loop {name} is a weld, because {source} has no type for it")
        frames = [_frame(robot, frame, source) for frame in (one, two)]
        spec = LoopSpec(name=name, type="point" if kind == "3d" else "weld", frame_a=frames[0], frame_b=frames[1])
        robot.loops.append((spec, f"{kind or 'no type'} in {source}"))
    _set_actuated(robot, content.name_mot, source)


def suggest_names(robot: Robot, name: str) -> str:
    """Return the end of a message about an unknown name: similar names of links and joints, or nothing."""
    similar = difflib.get_close_matches(name, [*robot.links, *robot.joints], MAX_SUGGESTIONS)
    return f"; did you mean {', '.join(similar)}?" if similar else ""


def _substitute(robot: Robot, name: str, kind: str, source: str) -> None:
    """Replace a hinge by a ball or universal joint, or by a fixed joint."""
    joint = robot.joints.get(name)
    if joint is None:  # example-parallel-robots' loader ignores such an entry, too
        robot.left_out.append(f"{source}: joint_name {name}: no joint has this name{suggest_names(robot, name)}")
        return
    universal = re.fullmatch(r"UJOINT_([XYZ])([XYZ])", kind)
    if kind != "FIXED" and kind != "SPHERICAL" and universal is None:
        raise MechanismError(f"{source}: joint_type {kind!r} of {name} is not SPHERICAL, FIXED, UJOINT_XY or the like")
    had_forces = any(axis.has_forces for axis in joint.axes)
    letters = "" if kind == "FIXED" else "".join(universal.groups()) if universal else "XYZ"
    joint.kind = "fixed" if kind == "FIXED" else "universal" if universal else "ball"
    joint.axes = [JointAxis(AXES[letter], suffix=f"_{letter}") for letter in letters]
    if had_forces and letters:
        robot.left_out.append(f"dynamics and mimic of joint {name}, now {', '.join(joint.coordinates)}")


def _frame(robot: Robot, name: str, source: str) -> str:
    """Return the name of a link or a joint in the syntax of mechanism.toml."""
    if name in robot.links:
        if name in robot.joints:
            robot.guessed.append(f"{source}: {name!r} is a link and a joint; the link is used")
        return name
    if name in robot.joints:
        return f"joint:{name}"
    raise MechanismError(f"{source}: closed_loop: no link or joint {name!r}{suggest_names(robot, name)}")


def _set_actuated(robot: Robot, motors: list[str], source: str) -> None:
    moving = robot.axes
    missing = [name for name in motors if name not in moving]
    if missing:
        robot.left_out.append(f"{source}: name_mot {', '.join(missing)}: no moving joint has this name")
    robot.actuated = list(dict.fromkeys(name for name in motors if name in moving)) or None


def _common_name(one: str, two: str) -> str:
    """Return the common beginning of the names of two frames."""
    length = next((k for k, (a, b) in enumerate(zip(one, two, strict=False)) if a != b), min(len(one), len(two)))
    return one[:length].rstrip("_-. ")
