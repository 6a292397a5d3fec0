"""Loops and couplings inside a URDF, as generalized_rbda writes them.

    <loop name type> <predecessor link><origin/></predecessor> <successor link><origin/></successor> <axis/> </loop>
    <coupling name> <predecessor link/> <successor link/> <ratio value/> </coupling>

and joints with ``independent="true"`` or ``"False"``; a joint without the attribute is independent.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from ckc_pin.errors import InputError, MechanismError
from ckc_pin.formats.draft import Draft, checked_direction, frame, number, unique, vector
from ckc_pin.formats.urdf.names import Names, origin_of, three
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec, LoopType

__all__ = ["take_loops"]

TYPES: dict[str, LoopType] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "prismatic",
    "spherical": "point",
    "fixed": "weld",
}


def take_loops(draft: Draft, names: Names, source: str) -> None:
    """Move <loop>, <coupling> and `independent` out of the URDF, where other readers would not see them."""
    loops, couplings = draft.robot.findall("loop"), draft.robot.findall("coupling")
    for element in loops:
        where = f"{source}: loop {element.get('name', '')!r}"
        draft.loops.append((_loop(element, names, where, [spec.name for spec, _ in draft.loops]), ""))
        draft.robot.remove(element)
    for element in couplings:
        _coupling(element, draft, names, f"{source}: coupling {element.get('name', '')!r}")
        draft.robot.remove(element)
    declared = [(joint, _pop_independent(joint, source)) for joint in draft.robot.findall("joint")]
    if any(said is not None for _, said in declared):
        draft.independent = [
            name for joint, said in declared if said is not False for name in _coordinates(joint)
        ]  # fmt: skip
        draft.why_independent = "as the joints of the URDF say"


def _loop(element: Element, names: Names, where: str, taken: list[str]) -> LoopSpec:
    kind = element.get("type", "")
    if kind not in TYPES:
        raise MechanismError(f"{where}: type {kind!r} is not known; known are {', '.join(TYPES)}")
    ends = []
    for tag in ("predecessor", "successor"):
        end = element.find(tag)
        link = "" if end is None else end.get("link", "")
        if end is None or link not in names.links:
            raise MechanismError(f"{where}: its {tag} {link!r} is no link; there are {', '.join(names.links)}")
        ends.append(frame(link, origin_of(end, where)))
    name = unique(element.get("name") or "loop", taken)
    if TYPES[kind] in ("point", "weld"):
        return LoopSpec(name=name, type=TYPES[kind], frame_a=ends[0], frame_b=ends[1])
    place = f"{where}, <axis>"
    direction = checked_direction(three(element.find("axis"), "xyz", "1 0 0", place), place)
    along = vector(direction / np.linalg.norm(direction))
    return LoopSpec(name=name, type=TYPES[kind], frame_a=ends[0], frame_b=ends[1], axis_a=along, axis_b=along)


def _coupling(element: Element, draft: Draft, names: Names, where: str) -> None:
    """Take ratio * (joints to the predecessor) = joints to the successor, from their nearest common link."""
    chains = []
    for tag in ("predecessor", "successor"):
        end = element.find(tag)
        link = "" if end is None else end.get("link", "")
        if link not in names.links:
            raise MechanismError(f"{where}: its {tag} {link!r} is no link; there are {', '.join(names.links)}")
        chains.append(list(_moving_above(link, names)))
    value = element.find("ratio")
    try:
        ratio = float("" if value is None else value.get("value", ""))
    except ValueError:
        raise InputError(f"{where}: its <ratio> has no number") from None
    before, after = ([joint for joint in chain if joint not in other] for chain, other in (chains, chains[::-1]))
    if len(before) == 1 and len(after) == 1:
        spec = CouplingSpec(joint=after[0], other=before[0], ratio=number(ratio))
        draft.couplings.append((spec, element.get("name", "")))
        return
    said = f"{' + '.join(after) or '0'} = {ratio:g} ({' + '.join(before) or '0'})"
    draft.left_out.append(f"coupling {element.get('name', '')} of more than two joints: {said}")


def _moving_above(link: str, names: Names) -> Iterator[str]:
    while (joint := names.above.get(link)) is not None:
        if joint.get("type") != "fixed":
            yield joint.attrib["name"]
        link = joint.find("parent").attrib["link"]  # type: ignore[union-attr]


def _pop_independent(joint: Element, source: str) -> bool | None:
    text = joint.attrib.pop("independent", None)
    if text is None:
        return None
    if text.lower() not in ("true", "false"):
        raise InputError(f"{source}: joint {joint.get('name')!r}: independent={text!r} is not true or false")
    return text.lower() == "true"


def _coordinates(joint: Element) -> list[str]:
    name, kind = joint.get("name", ""), joint.get("type")
    if kind == "floating":
        return [f"{name}.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
    return [] if kind == "fixed" or joint.find("mimic") is not None else [name]
