"""Read the loop_closures.yaml of solidworks_urdf_exporter2: hinges by a point and an axis in the base link."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pinocchio as pin

from ckc_pin.errors import MechanismError
from ckc_pin.formats.conversion import make_unique, require_direction
from ckc_pin.formats.robot import Joint, JointAxis, Robot
from ckc_pin.formats.urdf.robot_yaml import suggest_names
from ckc_pin.formats.urdf.yaml import parse_yaml

__all__ = ["LOOP_CLOSURES_YAML", "add_loop_closures_yaml"]

LOOP_CLOSURES_YAML = "loop_closures.yaml"
Three = tuple[float, float, float]


class _Closure(msgspec.Struct, frozen=True):
    link_a: str
    link_b: str
    point: Three
    axis: Three = (0.0, 0.0, 1.0)


class _Content(msgspec.Struct, frozen=True):
    closures: list[_Closure] = []
    independent: list[str] = []
    dependent: list[str] = []


def add_loop_closures_yaml(robot: Robot, text: str, source: str) -> None:
    """Add the hinges of a loop_closures.yaml. Its independent joints are the motors."""
    content, unknown_keys = parse_yaml(text, _Content, source)
    robot.left_out += [f"{source}: unsupported key {key!r}" for key in unknown_keys if "loops" not in key]
    robot.warnings += [
        f"{source}: unsupported key {key!r}; each of its loops takes up to 6 freedoms that the mechanism has"
        for key in unknown_keys if "loops" in key
    ]  # fmt: skip
    poses = robot.zero_poses()
    base = poses["base_link"] if "base_link" in poses else poses[robot.find_base()]
    for closure in content.closures:
        links = [closure.link_a, closure.link_b]
        for link in links:
            if link not in robot.links:
                raise MechanismError(f"{source}: closures: no link {link!r}{suggest_names(robot, link)}")
        direction = require_direction(closure.axis, f"{source}: axis of {links[0]}, {links[1]}")
        pose = base * pin.SE3(np.eye(3), np.array(closure.point))
        name = make_unique(f"{links[0]}_{links[1]}", robot.joints)
        axes = [JointAxis(direction / np.linalg.norm(direction))]
        in_links = [poses[link].inverse() * pose for link in links]
        robot.add_joint(replace(Joint.between(name, "revolute", links, in_links, axes), closes=True))
    robot.actuated = [name for name in content.independent if name in robot.axes] or None
