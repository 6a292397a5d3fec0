"""Pairs of frames that onshape-to-robot leaves where a loop was cut: closing_X_1 and closing_X_2, or NAME_1 and NAME_2.

The file does not say what joint was there. A third and fourth frame, closing_X_1_z and closing_X_2_z, of newer
exports mark the axis of a hinge; otherwise the type is proposed from the geometry (`proposal`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree.ElementTree import Element

from ckc_pin.formats.draft import Draft
from ckc_pin.formats.urdf.names import Names
from ckc_pin.formats.urdf.proposal import propose
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["take_closing_frames"]

PREFIX = "closing_"
WEIGHTLESS = 1e-6  # kg; a frame is exported as a link of 1e-9


def take_closing_frames(draft: Draft, names: Names) -> None:
    """Add a loop for every pair of frames."""
    pairs = list(_pairs(names))
    hinges = [(one, two) for one, two in pairs if f"{one}_z" in names.links and f"{two}_z" in names.links]
    unknown = [pair for pair in pairs if pair not in hinges]
    for one, two in hinges:
        spec = LoopSpec(name=_stem(one), type="hinge", frame_a=one, frame_b=two)
        draft.loops.append((spec, f"the frames {one}_z and {two}_z mark its axis"))
    points = [LoopSpec(name=_stem(one), type="point", frame_a=one, frame_b=two) for one, two in unknown]
    proposals: dict[tuple[str, str], list[str]] = {}
    for spec, why in propose(draft, points):
        draft.loops.append((spec, f"guessed: {why}"))
        proposals.setdefault((spec.type, why), []).append(spec.name)
    for (kind, why), loops in proposals.items():
        draft.guessed.append(f"{kind} for loop {', '.join(loops)}: {why}")


def _stem(name: str) -> str:
    return name.removesuffix("_1").removeprefix(PREFIX)


def _pairs(names: Names) -> Iterator[tuple[str, str]]:
    """Yield NAME_1, NAME_2 of a name that has exactly these two; without the prefix both must be mere frames."""
    numbered: dict[str, list[str]] = {}
    for name in names.links:
        match = re.fullmatch(r"(.+)_(\d+)", name)
        if match:
            numbered.setdefault(match[1], []).append(match[2])
    for stem, numbers in numbered.items():
        one, two = f"{stem}_1", f"{stem}_2"
        if sorted(numbers) != ["1", "2"]:
            continue
        if stem.startswith(PREFIX) or (_is_frame(names, one) and _is_frame(names, two)):
            yield one, two


def _is_frame(names: Names, link: str) -> bool:
    """Whether a link is a frame alone: on a fixed joint, without weight, shape or children."""
    joint, element = names.above.get(link), names.links[link]
    if joint is None or joint.get("type") != "fixed" or element.find("visual") is not None:
        return False
    if any(j.find("parent").attrib["link"] == link for j in names.joints.values()):  # type: ignore[union-attr]
        return False
    return _mass(element) <= WEIGHTLESS


def _mass(link: Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", "0"))
