"""Motors of a URDF: <transmission> elements of ROS and Drake, and the command interfaces of <ros2_control>."""

from __future__ import annotations

from collections import Counter
from xml.etree.ElementTree import Element

from ckc_pin.errors import InputError
from ckc_pin.formats.conversion import list_names, make_unique, round_number
from ckc_pin.formats.robot import Robot
from ckc_pin.mechanism.spec import MotorSpec

__all__ = ["MOTOR_TAGS", "add_motors"]

MOTOR_TAGS = ("transmission", "ros2_control")
JOINT_TAGS = ("joint", "flexJoint", "rollJoint", "gap_joint")  # in a transmission; all but the first are PR2's


def add_motors(robot: Robot, root: Element, unread: Counter[str]) -> None:
    """Add a motor for each transmission, and for each joint with a command interface.

    A joint with several transmissions or interfaces has one motor. A mimic joint has none.

    Raises
    ------
    InputError
        A reduction or rotor inertia is not a number, or a reduction is zero.
    """
    axes = robot.axes
    followers = {name for name, axis in axes.items() if axis.mimic is not None}
    motors: list[MotorSpec] = []
    driven: list[str] = []
    unmoved: list[str] = []
    controls = root.findall("ros2_control")
    for element in [*root.findall("transmission"), *(t for c in controls for t in c.findall("transmission"))]:
        names = list(dict.fromkeys(e.get("name", "") for tag in JOINT_TAGS for e in element.findall(tag)))
        where = f"{robot.source}: transmission {element.get('name', '')!r}"
        if not names or not set(names) <= set(axes):
            unmoved.append(element.get("name", ""))
        elif len(names) == 1 and names[0] not in driven and names[0] not in followers:
            motors.append(_simple(element, names[0], motors, where))
            driven.append(names[0])
        elif len(names) > 1 and not set(names) & set(driven):
            motors += _coupled(element, names, robot, motors, where)
            driven += names
    if unmoved:
        robot.left_out.append(f"transmissions whose joints do not move or are not named: {list_names(unmoved)}")
    for control in controls:
        for joint in control.findall("joint"):
            name = joint.get("name", "")
            if joint.find("command_interface") is None or name in driven or name in followers:
                continue
            if name in axes:
                motors.append(MotorSpec(name=make_unique(name, [m.name or "" for m in motors]), joint=name))
                driven.append(name)
            else:
                robot.left_out.append(f"command interfaces of {name}, which is not a moving joint")
        unread.update(
            f"<{child.tag}> of <ros2_control>"
            for child in control
            if child.tag not in ("joint", "transmission", "hardware")
        )
    if motors:
        robot.motors = [(motor, "") for motor in motors]
        robot.actuated = driven


def _number(text: str | None, default: float, where: str) -> float:
    try:
        return default if text is None or not text.strip() else float(text)
    except ValueError:
        raise InputError(f"{where}: {text!r} is not a number") from None


def _reduction(element: Element | None, default: float, where: str) -> float:
    """Return the reduction of an <actuator> or <joint>: ROS 1's and ROS 2's element, or Drake's."""
    drake = None if element is None else element.find("drake:gear_ratio")
    texts = (
        [] if element is None else [element.findtext("mechanicalReduction"), element.findtext("mechanical_reduction")]
    )
    texts.append(None if drake is None else drake.get("value"))
    value = _number(next((text for text in texts if text is not None), None), default, where)
    if not value:
        raise InputError(f"{where}: its mechanical reduction is 0; expected a ratio")
    return value


def _simple(element: Element, joint: str, motors: list[MotorSpec], where: str) -> MotorSpec:
    actuator = element.find("actuator")
    in_joint = element.find("joint")
    rotor = None if actuator is None else actuator.find("drake:rotor_inertia")
    inertia = _number(None if rotor is None else rotor.get("value"), 0.0, where)
    if inertia < 0:
        raise InputError(f"{where}: negative rotor inertia {inertia:g}")
    taken = [motor.name or "" for motor in motors]
    ratio = _reduction(actuator, _reduction(in_joint, _reduction(element, 1.0, where), where), where)
    return MotorSpec(name=make_unique(joint, taken), joint=joint, ratio=round_number(ratio), rotor_inertia=inertia)


def _coupled(element: Element, names: list[str], robot: Robot, motors: list[MotorSpec], where: str) -> list[MotorSpec]:
    """Return the motors of a transmission with two actuators and two joints.

    ros_control defines the shafts' angles x_1, x_2 by the joints' angles q_1, q_2, with the reductions n of
    the actuators and m of the joints:

    - differential: x_1 = n_1 (m_1 q_1 + m_2 q_2), x_2 = n_2 (m_1 q_1 - m_2 q_2)
    - four-bar linkage: x_1 = n_1 m_1 q_1, x_2 = n_2 (q_1 + m_2 q_2)
    """
    actuators, joints = element.findall("actuator"), element.findall("joint")
    kind = (element.findtext("type") or element.get("type") or element.findtext("plugin") or "").strip()
    is_differential, is_four_bar = "Differential" in kind, "FourBar" in kind
    label = element.get("name", "")
    if len(names) != 2 or len(actuators) != 2 or not (is_differential or is_four_bar):
        robot.left_out.append(
            f"transmission {label} of {list_names(names)}: type {kind!r} is unsupported; its joints have a motor each"
        )
        return [MotorSpec(name=make_unique(name, [m.name or "" for m in motors]), joint=name) for name in names]
    (n_1, n_2), (m_1, m_2) = ([_reduction(e, 1.0, where) for e in ends] for ends in (actuators, joints))
    one, two = names
    if is_differential:
        rows = [{one: n_1 * m_1, two: n_1 * m_2}, {one: n_2 * m_1, two: -n_2 * m_2}]
    else:
        rows = [{one: n_1 * m_1}, {one: n_2, two: n_2 * m_2}]
    robot.guessed.append(
        f"transmission {label} is read as ros_control defines it: two motors on sums of joints {one}, {two}"
    )
    taken = [motor.name or "" for motor in motors]
    specs: list[MotorSpec] = []
    for actuator, weights in zip(actuators, rows, strict=True):
        name = make_unique(actuator.get("name") or f"{label}_motor", [*taken, *(spec.name or "" for spec in specs)])
        specs.append(MotorSpec(name=name, joints={joint: round_number(weight) for joint, weight in weights.items()}))
    return specs
