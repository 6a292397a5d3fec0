"""Mechanisms by shipped name or by path, assembled."""

from __future__ import annotations

import sys
from copy import deepcopy
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert, join_dotted_keys, read_toml
from ckc_pin.base.validation import is_number, require_table, require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism.library import MECHANISM_FILE, GeneratorSpec, read_mechanism_texts
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides
from ckc_pin.mechanism.spec import MechanismSpec

__all__ = ["as_mechanism", "build", "load"]

MOST_KEPT = 32  # of the mechanisms built

_built: dict[Any, Mechanism] = {}  # never handed out, only copied
_building = Lock()


def load(name: str | Path | GeneratorSpec, overrides: Overrides | None = None) -> Mechanism:
    """Load a mechanism by shipped name or path.

    Parameters
    ----------
    name : str, Path or GeneratorSpec
        For example ``"five_bar"`` or ``"robots/mine/mechanism.toml"``; ``"n_four_bar"`` is made with its
        usual number of links.
    overrides : mapping, optional
        Numbers that are other ones, by name, e.g. ``{"link.link_2.mass": 0.3}``.

    Raises
    ------
    InputError
        A file that is missing, malformed, or has an unknown key.
    MechanismError
        A mechanism that cannot exist as described.
    """
    require_type(name, (str, Path, GeneratorSpec), "load: name", "a mechanism's shipped name or its path")
    return build(*read_mechanism_texts(name), None if overrides is None else _as_read(overrides))


def _as_read(overrides: Any) -> Overrides:
    """Return numbers by name as a file has them: Python's, three of them as a tuple (InputError)."""
    takes = 'a table of numbers by name, three of a vector, as {"link.link_2.mass": 0.3}'
    require_table(overrides, "load: overrides", takes)
    found: dict[str, Any] = {}
    for name, given in overrides.items():
        value = given.tolist() if isinstance(given, np.generic | np.ndarray) else given
        several = isinstance(value, list | tuple)
        for x in value if several else (value,):
            if not is_number(x) or not abs(x) <= sys.float_info.max:
                raise InputError(f"load: overrides: {name} = {given!r:.80}: expected {takes}")
        found[name] = tuple(map(float, value)) if several else float(value)
        if several and len(value) != 3:
            raise InputError(f"load: overrides: {name}: {len(value)} numbers were given; a vector has three")
    return found


def as_mechanism(given: Any, who: str) -> Mechanism:
    """Return the mechanism that a public function was given: as it is, or loaded by name or path.

    Raises
    ------
    InputError, MechanismError
        No mechanism; what `load` raises.
    """
    takes = "a mechanism: itself, its shipped name or its path"
    require_type(given, (Mechanism, str, Path, GeneratorSpec), f"{who}: mechanism", takes)
    return given if isinstance(given, Mechanism) else load(given)


def build(text: str, sources: Sources, overrides: Overrides | None = None) -> Mechanism:
    """Build a mechanism from the text of its file; the text is kept among its sources.

    One that was built of the same texts before is copied: parsing, assembling and counting freedoms take longer than
    many a run.
    """
    sources.texts[MECHANISM_FILE] = text
    key = (text, sources.name, sources.folder, tuple(sorted((overrides or {}).items())))
    built = _built.get(key)
    if built is not None and all(sources.text(file) == known for file, known in built.sources.texts.items()):
        return deepcopy(built, {id(built.sources): sources})
    mechanism = _build(text, sources, overrides)
    with _building:
        _built[key] = deepcopy(mechanism)
        while len(_built) > MOST_KEPT:
            _built.pop(next(iter(_built)))
    return mechanism


def _build(text: str, sources: Sources, overrides: Overrides | None) -> Mechanism:
    data = read_toml(text, sources.name)
    join_dotted_keys(data, "q_guess")
    spec = convert(data, MechanismSpec, sources.name)
    with sources.prefix_errors():
        return assemble_mechanism(spec, sources, overrides)
