"""Motors of a URDF: <transmission> elements of ROS and Drake, and the command interfaces of <ros2_control>."""

from __future__ import annotations

import math
from collections import Counter
from xml.etree.ElementTree import Element

from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import list_names, make_unique, round_number
from ckc_pin.formats.robot import Robot
from ckc_pin.mechanism.spec import MotorSpec

__all__ = ["MOTOR_TAGS", "add_control_mimics", "add_motors"]

MOTOR_TAGS = ("transmission", "ros2_control")
JOINT_TAGS = ("joint", "flexJoint", "rollJoint", "gap_joint")  # in a transmission; all but the first are PR2's


def add_motors(robot: Robot, root: Element, unread: Counter[str]) -> None:
    """Add a motor for each transmission, and for each joint with a command interface.

    A joint with several transmissions or interfaces has one motor. A mimic joint has none. The largest effort of a
    joint limits the torque of its motor.
    """
    axes, driven, undriven = robot.axes, list[str](), list[str]()
    free = {name for name, axis in axes.items() if axis.mimic is None}
    controls = root.findall("ros2_control")
    for element in [*root.findall("transmission"), *(t for c in controls for t in c.findall("transmission"))]:
        names = list(dict.fromkeys(e.get("name", "") for tag in JOINT_TAGS for e in element.findall(tag)))
        if not names or not set(names) <= free.difference(driven):
            undriven.append(element.get("name", ""))
            continue
        _add_transmission(robot, element, names)
        driven += names
    if undriven:
        why = "their joints do not move, follow others, have a motor already or are not named"
        robot.left_out.append(f"transmissions {list_names(undriven)}: {why}")
    for control in controls:
        commanded = [j.get("name", "") for j in control.findall("joint") if j.find("command_interface") is not None]
        for name in commanded:
            if name in free and name not in driven:
                _add_motor(robot, name, 1.0)
                driven.append(name)
        if missing := [name for name in commanded if name not in axes]:
            robot.left_out.append(f"command interfaces of joints that do not move: {list_names(missing)}")
        read_tags = ("joint", "transmission", "hardware")
        unread.update(f"<{child.tag}> of <ros2_control>" for child in control if child.tag not in read_tags)
    if robot.motors:
        robot.actuated = driven


def add_control_mimics(robot: Robot, root: Element) -> None:
    """Add the mimic joints that <ros2_control> declares by <param name="mimic">, as older Gazebo plugins read them."""
    axes = robot.axes
    for joint in root.iterfind("ros2_control/joint"):
        params = {param.get("name"): (param.text or "").strip() for param in joint.findall("param")}
        axis = axes.get(joint.get("name", ""))
        if axis is not None and axis.mimic is None and "mimic" in params:
            where = f"{robot.source}: <ros2_control> joint {joint.get('name')!r}"
            ratio, offset = (_number(params.get(key), d, where) for key, d in (("multiplier", 1.0), ("offset", 0.0)))
            axis.mimic = (params["mimic"], ratio, offset)


def _number(text: str | None, default: float, where: str) -> float:
    try:
        value = default if text is None or not text.strip() else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {text!r} is not a finite number")
    return value


def _reduction(element: Element | None, default: float, where: str) -> float:
    """Return the reduction of a transmission or of its actuator or joint: Drake's element, or ROS 1's or ROS 2's.

    Drake reflects the rotor by its own element, also where ROS has a reduction of 1 for a drive that hides its gear.
    """
    if element is None:
        return default
    drake = element.find("drake:gear_ratio")
    texts = [None if drake is None else drake.get("value")]
    texts += [element.findtext("mechanicalReduction"), element.findtext("mechanical_reduction")]
    value = _number(next((text for text in texts if text is not None), None), default, where)
    if not value:
        raise InputError(f"{where}: its mechanical reduction is 0; expected a ratio")
    return value


def _add_motor(robot: Robot, joint: str, ratio: float, rotor_inertia: float = 0.0) -> None:
    effort = robot.axes[joint].limits.effort
    spec = MotorSpec(
        name=_choose_name(robot, joint),
        joint=joint,
        ratio=round_number(ratio),
        rotor_inertia=rotor_inertia,
        torque_limit=effort / abs(ratio) if effort > 0 else None,
    )
    robot.motors.append((spec, ""))


def _choose_name(robot: Robot, name: str) -> str:
    return make_unique(name, [spec.name or "" for spec, _ in robot.motors])


def _add_transmission(robot: Robot, element: Element, names: list[str]) -> None:
    """Add the motor of one joint, or the motors of a transmission with two actuators and two joints.

    ros_control defines the shafts' angles x_1, x_2 by the joints' angles q_1, q_2, with the reductions n of
    the actuators and m of the joints:

    - differential: x_1 = n_1 (m_1 q_1 + m_2 q_2), x_2 = n_2 (m_1 q_1 - m_2 q_2)
    - four-bar linkage: x_1 = n_1 m_1 q_1, x_2 = n_2 (q_1 + m_2 q_2)
    """
    label = element.get("name", "")
    where = f"{robot.source}: transmission {label!r}"
    actuators, joints = element.findall("actuator"), element.findall("joint")
    if len(names) == 1:
        ends = (element.find("actuator"), element.find("joint"), element)
        ratio = next((r for end in ends if (r := _reduction(end, 1.0, where)) != 1.0), 1.0)
        rotor = next((e for a in actuators for e in a if e.tag == "drake:rotor_inertia"), None)
        inertia = _number(None if rotor is None else rotor.get("value"), 0.0, where)
        if inertia < 0:
            raise InputError(f"{where}: negative rotor inertia {inertia:g}")
        _add_motor(robot, names[0], ratio, inertia)
        return
    kind = (element.findtext("type") or element.get("type") or element.findtext("plugin") or "").strip()
    is_differential = "Differential" in kind
    if len(names) != 2 or len(actuators) != 2 or len(joints) != 2 or not (is_differential or "FourBar" in kind):
        unsupported = f"type {kind!r} is unsupported; its joints have a motor each"
        robot.left_out.append(f"transmission {label} of {list_names(names)}: {unsupported}")
        for name in names:
            _add_motor(robot, name, 1.0)
        return
    (n_1, n_2), (m_1, m_2) = ([_reduction(e, 1.0, where) for e in ends] for ends in (actuators, joints))
    one, two = names
    if is_differential:
        rows = [{one: n_1 * m_1, two: n_1 * m_2}, {one: n_2 * m_1, two: -n_2 * m_2}]
    else:
        rows = [{one: n_1 * m_1}, {one: n_2, two: n_2 * m_2}]
    robot.guessed.append(f"transmission {label} has two motors on sums of {one} and {two}, as ros_control defines it")
    for actuator, weights in zip(actuators, rows, strict=True):
        name = _choose_name(robot, actuator.get("name") or f"{label}_motor")
        spec = MotorSpec(name=name, joints={joint: round_number(weight) for joint, weight in weights.items()})
        robot.motors.append((spec, ""))
