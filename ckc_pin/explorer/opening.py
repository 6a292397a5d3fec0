"""Open what the explorer shows: a mechanism, a scene, or a mechanism whose loops cannot be closed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.assembly import assemble_mechanism, open_loops
from ckc_pin.kinematics.loading import load, read_spec
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.library import MECHANISM_FILE, read_mechanism_texts
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.names import is_scene_name
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["Opened", "close_again", "open_explored"]

EXPECTED = "a mechanism or a scene: itself, its name or its path"


@dataclass(frozen=True)
class Opened:
    """What the explorer shows.

    Attributes
    ----------
    name : str
        The name or path that the user gave, or the mechanism's name.
    mechanism : Mechanism
        Without its loops if these cannot be closed.
    start : Kinematics
        The configuration to begin with.
    scene : Scene or None
    q_dot : (d,) array or None
        Rates with which the scene starts.
    with_open_loops : Mechanism or None
        The mechanism with its open loops, if they cannot be closed. For drawing only.
    problem : str
        Why the loops cannot be closed, or "".
    """

    name: str
    mechanism: Mechanism
    start: Kinematics
    scene: Scene | None = None
    q_dot: Array | None = None
    with_open_loops: Mechanism | None = None
    problem: str = ""


def open_explored(what: Any, overrides: dict[str, Any] | None = None) -> Opened:
    """Open a mechanism or a scene.

    Parameters
    ----------
    what : Mechanism, Scene, str or Path
    overrides : dict, optional
        Values by dotted key: of a scene's keys, or of a mechanism's parameters.

    Raises
    ------
    InputError, MechanismError
        It cannot be loaded. A mechanism by name or path whose loops cannot be closed is no error.
    """
    require_type(what, (Mechanism, Scene, str, Path), "explore: what", EXPECTED)
    if isinstance(what, Mechanism):
        if overrides:
            raise InputError("explore: overrides: expected none with a Mechanism; give its name or path instead")
        return Opened(what.name, what, what.assembled)
    if isinstance(what, Scene) or is_scene_name(str(what)):
        scene = what.with_overrides(overrides) if isinstance(what, Scene) else load_scene(what, overrides)
        mechanism = load_scene_mechanism(scene)
        start = find_start(mechanism, scene)
        return Opened(scene.name, mechanism, start.at, scene, start.q_dot)
    try:
        mechanism = load(what, overrides)
    except MechanismError as error:
        if error.q_tree is None or overrides:
            raise
        text, sources = read_mechanism_texts(what)
        sources.texts[MECHANISM_FILE] = text
        as_tree, opened = open_loops(read_spec(text, sources.name), sources, error.q_tree)
        return Opened(str(what), as_tree, as_tree.assembled, with_open_loops=opened, problem=str(error))
    return Opened(str(what), mechanism, mechanism.assembled)


def close_again(opened: Opened, at: Kinematics) -> Opened | None:
    """Return the mechanism with closed loops, assembled near a configuration of its tree; None if that fails."""
    full = opened.with_open_loops
    assert full is not None
    sources, tree = full.sources.with_texts({}), opened.mechanism.tree
    spec = read_spec(sources.text(MECHANISM_FILE), sources.name)
    spec = msgspec.structs.replace(spec, q_guess=tree.named(tree.to_coordinates(at.q_tree)))
    try:
        mechanism = assemble_mechanism(spec, sources)
    except MechanismError:
        return None
    return replace(opened, mechanism=mechanism, start=mechanism.assembled, with_open_loops=None, problem="")
