"""MuJoCo's MJCF: tree, equality constraints, actuated joints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ckc_pin.errors import InputError
from ckc_pin.formats.draft import Draft, safe_name, vector
from ckc_pin.formats.mjcf.document import Document
from ckc_pin.formats.mjcf.equality import Equalities
from ckc_pin.formats.mjcf.tree import MjcfTree

__all__ = ["read_mjcf"]

# sections that change how a model moves and have no counterpart here
UNREAD = {
    "tendon": "tendons",
    "contact": "contact pairs and exclusions: there is no contact here",
    "deformable": "deformable bodies",
    "keyframe": "key frames; one of them may be a better [q_guess]",
}


def read_mjcf(text: str, path: Path) -> Draft:
    """Read a MuJoCo model.

    Parameters
    ----------
    text : str
    path : Path
        Where the text is from; included files are looked for beside it.

    Raises
    ------
    InputError
        What is no MJCF, with the element's name.
    """
    document = Document.read(text, path)
    tree = MjcfTree(document, frozenset(_used_joints(document)))
    equalities = Equalities(document, tree)
    name = safe_name(path, document.root.get("model", ""))
    draft = Draft(name, f"{path.name}, a MuJoCo model", tree.robot)
    tree.robot.set("name", name)
    gravity = document.option.numbers("gravity", "0 0 -9.81", 3)[:3]
    draft.gravity = vector(gravity if document.flag.get("gravity", "enable") == "enable" else (0.0, 0.0, 0.0))
    draft.loops, draft.couplings, draft.springs = equalities.loops, equalities.couplings, tree.springs
    draft.q_guess = tree.q_guess
    draft.guessed = tree.guessed + equalities.guessed
    draft.left_out = tree.left_out + equalities.left_out
    _actuators(document, tree, draft)
    draft.left_out += [f"{what} (not read)" for what in document.left_out]
    draft.left_out += [said for tag, said in UNREAD.items() if any(len(s) for s in document.root.findall(tag))]
    if any(any(document.option.numbers(key, "0")) for key in ("wind", "density", "viscosity")):
        draft.left_out.append("forces of the medium (wind, density, viscosity)")
    return draft


def _used_joints(document: Document) -> Iterator[str]:
    for element in document.root.iterfind("actuator/*"):
        yield from (element.get(key, "") for key in ("joint", "jointinparent"))
    for element in document.root.iterfind("equality/joint"):
        yield from (element.get(key, "") for key in ("joint1", "joint2"))


def _actuators(document: Document, tree: MjcfTree, draft: Draft) -> None:
    """Take the actuated joints; gains, gears and ranges belong to MuJoCo's own controllers."""
    joints: list[str] = []
    actuators = list(document.root.iterfind("actuator/*"))
    for element in actuators:
        name = element.get("joint") or element.get("jointinparent")
        if name in tree.ref:
            joints += [name] if name not in joints else []
        else:
            through = name or next((f"{k} {element.get(k)}" for k in ("tendon", "site", "body") if element.get(k)), "")
            draft.left_out.append(f"actuator {element.get('name', '')} on {through or 'no joint'}".replace("  ", " "))
    known = {e.get("name") for tag in ("joint", "freejoint") for e in document.root.iter(tag)}
    for element in actuators:
        name = element.get("joint") or element.get("jointinparent")
        if name and name not in known:
            raise InputError(f"{document.source}: actuator {element.get('name', '')!r}: no joint {name!r}")
    if joints:
        draft.actuated = joints
        draft.left_out.append("what the actuators do: gears, gains, ranges; their joints are `actuated`")
