"""Which names variables may have: numbers of the mechanism, and keys of the scene that take a number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ckc_pin.ensembles.spec import KINDS
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES, Value, is_parameter, require_known, values_of, with_components
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["check_names"]


def check_names(
    scene_name: str | Path, overrides: Mapping[str, Any], scene: Scene, mechanism: Mechanism, names: tuple[str, ...]
) -> dict[str, tuple[str, int]]:
    """Refuse variables that are none; return those that are components of what the scene gives whole."""
    present = values_of(mechanism.spec, mechanism.urdf)
    for name in names:
        _refuse_distribution(scene, mechanism, present, name)
    asked = [name for name in names if is_parameter(name)]
    require_known(asked, with_components(present), f"{scene.name}: variables")
    vectors: dict[str, tuple[str, int]] = {}
    for name in names:
        if name in present and isinstance(present[name], tuple):
            raise InputError(f"{scene.name}: variables: {name} has three numbers: vary {name}.x, .y or .z")
        of, _, axis = name.rpartition(".")
        if is_parameter(name) and name not in present and of in scene.spec.parameters:
            vectors[name] = (of, AXES.index(axis))
    for name in names:
        if not is_parameter(name):
            _try_key(scene_name, overrides, scene, mechanism, name)
    return vectors


def _refuse_distribution(scene: Scene, mechanism: Mechanism, present: Mapping[str, Value], name: str) -> None:
    """A name that goes on behind a number's: a distribution that there is none of has been read as a table."""
    of, _, kind = name.rpartition(".")
    vector, _, axis = of.rpartition(".")
    is_number = not isinstance(present[of], tuple) if of in present else vector in present and axis in AXES
    start = next((of.removeprefix(x) for x in ("initial.q.", "initial.q_dot.") if of.startswith(x)), "")
    if is_number or start in mechanism.coordinates:
        raise InputError(f"{scene.name}: variables: {of}: unknown key {kind!r}; valid: {', '.join(KINDS)}")


def _try_key(
    scene_name: str | Path, overrides: Mapping[str, Any], scene: Scene, mechanism: Mechanism, name: str
) -> None:
    """A key of the scene: one that takes a number."""
    for table, names in (
        ("initial.q.", mechanism.coordinates),
        ("initial.q_dot.", mechanism.independent),
    ):
        if name.startswith(table):
            if name.removeprefix(table) not in names:
                says = f"variables: {name!r}: no such coordinate; there are {', '.join(names)}"
                raise InputError(f"{scene.name}: {says}")
            load_scene(scene_name, {**overrides, name: 1.0})  # refused as a single run is: q beside initial.at
            return
    try:
        load_scene(scene_name, {**overrides, name: 1})
    except InputError as error:
        if "greater than" in str(error) or "at least" in str(error) or "less than" in str(error):
            return
        raise InputError(f"variables: {name!r} is no number of the scene: {error}") from None
