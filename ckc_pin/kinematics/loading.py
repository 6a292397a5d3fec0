"""Load mechanisms by shipped name or path, assembled, with a cache of the mechanisms loaded lately."""

from __future__ import annotations

import sys
from collections.abc import Hashable, Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert, join_dotted_keys, read_toml
from ckc_pin.base.validation import is_number, require_table, require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.assembly import assemble_mechanism
from ckc_pin.mechanism.library import MECHANISM_FILE, GeneratorSpec, is_path, read_mechanism_texts
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides, plain_values
from ckc_pin.mechanism.spec import MechanismSpec

__all__ = ["MechanismCache", "as_mechanism", "build", "cache", "check_overrides", "load", "load_beside", "read_spec"]


class MechanismCache:
    """A cache of assembled mechanisms, safe to use from several threads.

    It hands out copies and keeps its own mechanisms unchanged. The oldest mechanism is dropped first.

    Parameters
    ----------
    capacity : int
        Largest number of mechanisms.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._lock = Lock()
        self._mechanisms: dict[Hashable, Mechanism] = {}

    def values(self) -> list[Mechanism]:
        """Return the mechanisms themselves, oldest first. They must not be changed."""
        with self._lock:
            return list(self._mechanisms.values())

    def find(self, key: Hashable, sources: Sources) -> Mechanism | None:
        """Return a copy of a mechanism whose files still have the same texts, with `sources`; None if there is none."""
        with self._lock:
            mechanism = self._mechanisms.get(key)
        if mechanism is None or any(sources.text(file) != text for file, text in mechanism.sources.texts.items()):
            return None
        return mechanism.copy(sources)

    def add(self, key: Hashable, mechanism: Mechanism) -> None:
        """Store a copy of a mechanism."""
        stored = mechanism.copy(mechanism.sources)
        with self._lock:
            self._mechanisms[key] = stored
            while len(self._mechanisms) > self.capacity:
                self._mechanisms.pop(next(iter(self._mechanisms)))


cache = MechanismCache(capacity=32)


def load(
    name: str | Path | GeneratorSpec,
    overrides: Overrides | None = None,
    prescribed: Mapping[str, float | None] | None = None,
) -> Mechanism:
    """Load a mechanism by shipped name or path.

    Parameters
    ----------
    name : str, Path or GeneratorSpec
        For example ``"five_bar"`` or ``"robots/mine/mechanism.toml"``. ``"n_four_bar"`` is generated with its default
        number of links. A file in the format of another program is imported in memory, with its notes as a warning.
    overrides : mapping, optional
        Parameter values by name that replace those of the files, such as ``{"link.link_2.mass": 0.3}``.
    prescribed : mapping, optional
        Joints that are held at a position, rad or m, by name. Each is a constraint row and takes away a freedom.

    Returns
    -------
    Mechanism
        Independent of every other one. Mechanisms loaded lately are copied from a cache.

    Raises
    ------
    InputError
        A file is missing or malformed, or has an unknown key.
    MechanismError
        The mechanism cannot exist as described.
    """
    require_type(name, (str, Path, GeneratorSpec), "load: name", "a mechanism's shipped name or its path")
    checked = None if overrides is None else check_overrides(overrides, "load: overrides")
    return build(*read_mechanism_texts(name), checked, prescribed)


def load_beside(name: str, folder: Path, parameters: Mapping[str, float | list[float]]) -> Mechanism:
    """Load the mechanism that a file names: a shipped name, or a path relative to the file's folder; errors as `load`.

    Parameters
    ----------
    name : str
    folder : Path
        Folder of the file.
    parameters : mapping
        The file's table of parameter values.
    """
    return load(folder / name if is_path(name) else name, plain_values(parameters) or None)


def check_overrides(overrides: Any, where: str) -> Overrides:
    """Return parameter values with Python floats, and vectors as tuples of three.

    Raises
    ------
    InputError
        They are no table of numbers and vectors by name. The message begins with `where`.
    """
    expected = 'a table of numbers by name, three of a vector, as {"link.link_2.mass": 0.3}'
    require_table(overrides, where, expected)
    checked: dict[str, Any] = {}
    for name, override in overrides.items():
        if override is None:
            raise InputError(f"{name}: only keys of a scene can be removed; a parameter of a mechanism needs a value")
        value = override.tolist() if isinstance(override, np.generic | np.ndarray) else override
        is_vector = isinstance(value, list | tuple)
        for x in value if is_vector else (value,):
            if not is_number(x) or not abs(x) <= sys.float_info.max:
                raise InputError(f"{where}: {name} = {override!r:.80}: expected {expected}")
        checked[name] = tuple(map(float, value)) if is_vector else float(value)
        if is_vector and len(value) != 3:
            raise InputError(f"{where}: {name}: expected 3 numbers, got {len(value)}")
    return checked


def as_mechanism(mechanism: Any, function: str) -> Mechanism:
    """Return the mechanism that a public function got: as it is, or loaded by name or path.

    Raises
    ------
    InputError, MechanismError
        It is not a mechanism; what `load` raises.
    """
    expected = "a mechanism: itself, its shipped name or its path"
    require_type(mechanism, (Mechanism, str, Path, GeneratorSpec), f"{function}: mechanism", expected)
    return mechanism if isinstance(mechanism, Mechanism) else load(mechanism)


def build(
    text: str,
    sources: Sources,
    overrides: Overrides | None = None,
    prescribed: Mapping[str, float | None] | None = None,
) -> Mechanism:
    """Return the assembled mechanism of a mechanism file. The text of the file is added to its sources.

    Parsing, assembly and the rank computation take longer than many runs. A mechanism that was built from the same
    texts is therefore copied from `cache`.
    """
    sources.texts[MECHANISM_FILE] = text
    tables = (tuple(sorted((table or {}).items())) for table in (overrides, prescribed))
    key = (text, sources.name, sources.folder, *tables)
    mechanism = cache.find(key, sources)
    if mechanism is None:
        mechanism = _build(text, sources, overrides, prescribed)
        cache.add(key, mechanism)
    return mechanism


def _build(
    text: str, sources: Sources, overrides: Overrides | None, prescribed: Mapping[str, float | None] | None
) -> Mechanism:
    spec = read_spec(text, sources.name)
    with sources.prefix_errors():
        return assemble_mechanism(spec, sources, overrides, prescribed)


def read_spec(text: str, name: str) -> MechanismSpec:
    """Return the contents of a mechanism file from its text (InputError). `name` is the file's, for messages."""
    data = read_toml(text, name)
    join_dotted_keys(data, "q_guess")
    return convert(data, MechanismSpec, name)
