"""URDFs of every origin: loops inside the file, in a robot.yaml beside it, or as pairs of frames."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from ckc_pin.base.sources import strict_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError
from ckc_pin.formats.draft import Draft, safe_name, some
from ckc_pin.formats.urdf.closing_frames import take_closing_frames
from ckc_pin.formats.urdf.names import Names
from ckc_pin.formats.urdf.rbda_loops import take_loops
from ckc_pin.formats.urdf.robot_yaml import take_yaml
from ckc_pin.mechanism.urdf import parse

__all__ = ["read_urdf", "urdf_beside"]

BESIDE = "robot.yaml"
NO_LOOPS = (
    "no loops, since the URDF declares none: to close one, write a table [[loop]] with name, type, frame_a and "
    "frame_b, such as the one at the end of mechanism.toml. Import itself finds <loop> in a URDF (generalized_rbda), "
    "closed_loop in a robot.yaml beside it (example-parallel-robots), and pairs of links closing_NAME_1, "
    "closing_NAME_2 (onshape-to-robot)"
)


def read_urdf(text: str, path: Path) -> Draft:
    """Read a URDF and what closes its loops.

    Parameters
    ----------
    text : str
    path : Path
        Where the text is from; a robot.yaml in the same folder belongs to it.

    Raises
    ------
    InputError, MechanismError
        What is no URDF, or names something that is not there.
    """
    robot = strict_xml(text, str(path))
    _refuse_xacro(robot, path)
    parse(text, str(path))  # its checks, on a copy that it may change
    draft = Draft(safe_name(path, robot.get("name", "")), f"{path.name}, a URDF", robot)
    names = Names.of(robot)
    if robot.find("loop") is not None or robot.find("coupling") is not None:
        draft.origin = f"{path.name}, a URDF with <loop> and <coupling> as in generalized_rbda"
    take_loops(draft, names, str(path))
    beside = path.parent / BESIDE
    if beside.is_file():
        draft.origin = f"{path.name} and {BESIDE}, as in example-parallel-robots"
        take_yaml(draft, names, read_text(beside, "YAML file"), BESIDE)
    if not draft.loops:
        take_closing_frames(draft, names)
        if draft.loops:
            draft.origin = f"{path.name}, a URDF with pairs of closing frames as from onshape-to-robot"
    _check_mimics(draft, names)
    if not any(joint.get("type") == "floating" for joint in names.joints.values()):
        base = next(name for name in names.links if name not in names.above)
        draft.guessed.append(f'{base} stands fixed in the world; for a free base write [[tree]] with root = "free"')
    draft.guessed.append("gravity is along -z, the file has none")
    if not draft.loops:
        draft.guessed.append(NO_LOOPS)
    meshes = [mesh.get("filename", "") for mesh in robot.iter("mesh")]
    if meshes:
        draft.left_out.append(f"{len(meshes)} mesh files, such as {meshes[0]}: not copied to where the URDF is now")
    return draft


def _check_mimics(draft: Draft, names: Names) -> None:
    """Mimic joints are couplings already; one that follows no joint there is would make the URDF useless."""
    kept = []
    for name, joint in names.joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        other = names.joints.get(mimic.get("joint", ""))
        if other is None or other.get("type") not in ("revolute", "continuous", "prismatic") or other is joint:
            joint.remove(mimic)
            draft.left_out.append(f"joint {name} follows {mimic.get('joint')!r}, which is no joint that moves")
        else:
            kept.append(name)
    if kept:
        draft.guessed.append(f"the URDF's mimic joints are couplings, they stay in the URDF: {some(kept)}")


def urdf_beside(path: Path) -> Path:
    """Return the URDF that a robot.yaml belongs to.

    Raises
    ------
    InputError
        None in its folder, or several and none of them robot.urdf.
    """
    found = sorted(path.parent.glob("*.urdf"))
    named = [p for p in found if p.name == "robot.urdf"] or found
    if len(named) != 1:
        seen = ", ".join(p.name for p in found) or "none"
        raise InputError(f"{path}: one URDF beside it is needed; found {seen}. Import the URDF instead")
    return named[0]


def _refuse_xacro(robot: Element, path: Path) -> None:
    for element in robot.iter():
        if "xacro" in element.tag or any("${" in value for value in element.attrib.values()):
            raise InputError(f"{path}: a xacro, from which a URDF is made: expand it first (xacro FILE > robot.urdf)")
