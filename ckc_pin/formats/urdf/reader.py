"""Read a URDF and its loops, which may be in the file itself, in a robot.yaml beside it, or marked by pairs of frames.

generalized_rbda declares loops and couplings inside the URDF:

    <loop name type> <predecessor link><origin/></predecessor> <successor link><origin/></successor> <axis/> </loop>
    <coupling name> <predecessor link/> <successor link/> <ratio value/> </coupling>

and marks joints with ``independent="true"`` or ``"False"``. A joint without the attribute is independent.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ckc_pin.base.sources import parse_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.draft import (
    Draft,
    choose_name,
    list_names,
    make_frame,
    make_unique,
    require_direction,
    round_number,
    round_vector,
)
from ckc_pin.formats.urdf.closing_frames import add_closing_frame_loops
from ckc_pin.formats.urdf.elements import UrdfIndex, parse_origin, parse_vector
from ckc_pin.formats.urdf.robot_yaml import add_robot_yaml
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec, LoopType
from ckc_pin.mechanism.urdf import parse

__all__ = ["find_urdf_beside", "read_urdf"]

ROBOT_YAML = "robot.yaml"
NO_LOOPS = (
    "no loops, because the URDF declares none. To close one, write a table [[loop]] with name, type, frame_a and "
    "frame_b, such as the one at the end of mechanism.toml. Import itself recognizes <loop> in a URDF "
    "(generalized_rbda), closed_loop in a robot.yaml beside it (example-parallel-robots), and pairs of links "
    "closing_NAME_1, closing_NAME_2 (onshape-to-robot)"
)
LOOP_TYPES: dict[str, LoopType] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "prismatic",
    "spherical": "point",
    "fixed": "weld",
}


def read_urdf(text: str, path: Path) -> Draft:
    """Read a URDF and its loops.

    Parameters
    ----------
    text : str
    path : Path
        File of the text. A robot.yaml in the same folder belongs to it.

    Raises
    ------
    InputError, MechanismError
        The text is not a valid URDF, or an element names a link or joint that does not exist.
    """
    robot = parse_xml(text, str(path))
    _refuse_xacro(robot, path)
    parse(text, str(path))  # for its checks; it modifies its own copy of the tree only
    draft = Draft(choose_name(path, robot.get("name", "")), f"{path.name}, a URDF", robot)
    index = UrdfIndex.of(robot)
    if robot.find("loop") is not None or robot.find("coupling") is not None:
        draft.origin = f"{path.name}, a URDF with <loop> and <coupling> as in generalized_rbda"
    _move_loops(draft, index, str(path))
    yaml_file = path.parent / ROBOT_YAML
    if yaml_file.is_file():
        draft.origin = f"{path.name} and {ROBOT_YAML}, as in example-parallel-robots"
        add_robot_yaml(draft, index, read_text(yaml_file, "YAML file"), ROBOT_YAML)
    if not draft.loops:
        add_closing_frame_loops(draft, index)
        if draft.loops:
            draft.origin = f"{path.name}, a URDF with pairs of closing frames as from onshape-to-robot"
    _check_mimics(draft, index)
    if not any(joint.get("type") == "floating" for joint in index.joints.values()):
        base = next(name for name in index.links if name not in index.parent_joint)
        draft.guessed.append(f'{base} is fixed to the world; for a free base write [[tree]] with root = "free"')
    draft.guessed.append("gravity is along -z, because a URDF does not specify it")
    if not draft.loops:
        draft.guessed.append(NO_LOOPS)
    meshes = [mesh.get("filename", "") for mesh in robot.iter("mesh")]
    if meshes:
        draft.left_out.append(f"{len(meshes)} mesh files, such as {meshes[0]}: they are not copied beside the new URDF")
    return draft


def find_urdf_beside(path: Path) -> Path:
    """Return the URDF to which a robot.yaml belongs.

    Raises
    ------
    InputError
        The folder has no URDF, or several and none of them is robot.urdf.
    """
    urdfs = sorted(path.parent.glob("*.urdf"))
    candidates = [p for p in urdfs if p.name == "robot.urdf"] or urdfs
    if len(candidates) != 1:
        names = ", ".join(p.name for p in urdfs) or "none"
        raise InputError(f"{path}: expected one URDF in the same folder, got {names}; import the URDF itself instead")
    return candidates[0]


def _refuse_xacro(robot: Element, path: Path) -> None:
    for element in robot.iter():
        if "xacro" in element.tag or any("${" in value for value in element.attrib.values()):
            raise InputError(
                f"{path}: this is a xacro file, not a URDF; expand it first with `xacro FILE > robot.urdf`"
            )


def _check_mimics(draft: Draft, index: UrdfIndex) -> None:
    """Remove mimic elements whose joint does not exist or is fixed; the mechanism reads the others as couplings."""
    valid = []
    for name, joint in index.joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        other = index.joints.get(mimic.get("joint", ""))
        if other is None or other.get("type") not in ("revolute", "continuous", "prismatic") or other is joint:
            joint.remove(mimic)
            draft.left_out.append(f"mimic of joint {name}: {mimic.get('joint')!r} is not another moving joint")
        else:
            valid.append(name)
    if valid:
        draft.guessed.append(f"mimic joints act as couplings and stay in the URDF: {list_names(valid)}")


# --- loops and couplings of generalized_rbda -----------------------------------------------------------------------


def _move_loops(draft: Draft, index: UrdfIndex, source: str) -> None:
    """Move <loop>, <coupling> and `independent` from the URDF to the draft, because other readers ignore them."""
    loops, couplings = draft.robot.findall("loop"), draft.robot.findall("coupling")
    for element in loops:
        where = f"{source}: loop {element.get('name', '')!r}"
        draft.loops.append((_loop(element, index, where, [spec.name for spec, _ in draft.loops]), ""))
        draft.robot.remove(element)
    for element in couplings:
        _add_coupling(element, draft, index, f"{source}: coupling {element.get('name', '')!r}")
        draft.robot.remove(element)
    declared = [(joint, _pop_independent(joint, source)) for joint in draft.robot.findall("joint")]
    if any(is_independent is not None for _, is_independent in declared):
        draft.independent = [
            name for joint, is_independent in declared if is_independent is not False for name in _coordinates(joint)
        ]
        draft.why_independent = "declared by the joints of the URDF"


def _loop(element: Element, index: UrdfIndex, where: str, taken: list[str]) -> LoopSpec:
    kind = element.get("type", "")
    if kind not in LOOP_TYPES:
        raise MechanismError(f"{where}: unsupported type {kind!r}; expected one of {', '.join(LOOP_TYPES)}")
    ends = []
    for tag in ("predecessor", "successor"):
        link, end = _end_of(element, tag, index, where)
        ends.append(make_frame(link, parse_origin(end, where)))
    name = make_unique(element.get("name") or "loop", taken)
    if LOOP_TYPES[kind] in ("point", "weld"):
        return LoopSpec(name=name, type=LOOP_TYPES[kind], frame_a=ends[0], frame_b=ends[1])
    where_axis = f"{where}, <axis>"
    direction = require_direction(parse_vector(element.find("axis"), "xyz", "1 0 0", where_axis), where_axis)
    axis = round_vector(direction / np.linalg.norm(direction))
    return LoopSpec(name=name, type=LOOP_TYPES[kind], frame_a=ends[0], frame_b=ends[1], axis_a=axis, axis_b=axis)


def _add_coupling(element: Element, draft: Draft, index: UrdfIndex, where: str) -> None:
    """Add ratio * (joints to the predecessor) = joints to the successor, counted from their nearest common link."""
    chains = []
    for tag in ("predecessor", "successor"):
        link, _ = _end_of(element, tag, index, where)
        chains.append(list(_moving_joints_above(link, index)))
    value = element.find("ratio")
    try:
        ratio = float("" if value is None else value.get("value", ""))
    except ValueError:
        raise InputError(f"{where}: expected <ratio> with a number as value") from None
    before, after = ([joint for joint in chain if joint not in other] for chain, other in (chains, chains[::-1]))
    if len(before) == 1 and len(after) == 1:
        spec = CouplingSpec(joint=after[0], other=before[0], ratio=round_number(ratio))
        draft.couplings.append((spec, element.get("name", "")))
        return
    equation = f"{' + '.join(after) or '0'} = {ratio:g} ({' + '.join(before) or '0'})"
    draft.left_out.append(f"coupling {element.get('name', '')} of more than two joints: {equation}")


def _end_of(element: Element, tag: str, index: UrdfIndex, where: str) -> tuple[str, Element]:
    """Return the link of a <predecessor> or <successor>, and that element."""
    end = element.find(tag)
    link = "" if end is None else end.get("link", "")
    if end is None or link not in index.links:
        raise MechanismError(f"{where}: {tag} {link!r} is not a link; expected one of {', '.join(index.links)}")
    return link, end


def _moving_joints_above(link: str, index: UrdfIndex) -> Iterator[str]:
    """Yield the joints that are not fixed, from a link up to the root."""
    while (joint := index.parent_joint.get(link)) is not None:
        if joint.get("type") != "fixed":
            yield joint.attrib["name"]
        link = joint.find("parent").attrib["link"]  # type: ignore[union-attr]


def _pop_independent(joint: Element, source: str) -> bool | None:
    """Remove a joint's `independent` attribute and return its value, None if there was none."""
    text = joint.attrib.pop("independent", None)
    if text is None:
        return None
    if text.lower() not in ("true", "false"):
        raise InputError(f"{source}: joint {joint.get('name')!r}: independent={text!r} is not true or false")
    return text.lower() == "true"


def _coordinates(joint: Element) -> list[str]:
    """Return the labels of a joint's coordinates."""
    name, kind = joint.get("name", ""), joint.get("type")
    if kind == "floating":
        return [f"{name}.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
    return [] if kind == "fixed" or joint.find("mimic") is not None else [name]
