"""The tables and keys of a user's files, and how a terminal prints them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from ckc_pin.base.key_reference import Key, KeyTable, list_tables
from ckc_pin.base.validation import suggest_name
from ckc_pin.control.point_path import PointPathSpec
from ckc_pin.control.spec import MotionSpec, TableSpec, TrackingSpec
from ckc_pin.ensembles.spec import SweepSpec
from ckc_pin.errors import InputError
from ckc_pin.identification.spec import CalibrateSpec, IdentifySpec
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.optimization.spec import OptimizeSpec
from ckc_pin.scene.spec import SceneSpec

__all__ = ["FILES", "find_tables", "format_tables", "tables"]

FILES: dict[str, Any] = {
    "mechanism": MechanismSpec,
    "scene": SceneSpec,
    "sweep": SweepSpec,
    "identify": IdentifySpec,
    "calibrate": CalibrateSpec,
    "optimize": OptimizeSpec,
}
# Tables without a fixed structure: their contents decide which structure is read.
OPEN = {(TrackingSpec, "desired"): (MotionSpec, TableSpec, PointPathSpec)}
# Suffix of the path of such a table.
SUFFIXES: dict[Any, str] = {MotionSpec: ".COORDINATE"}

WIDTH = 18  # of a key's name


@cache
def tables(file: str) -> tuple[KeyTable, ...]:
    """Return the tables of a file, the file itself first, each structure once."""
    heading = "mechanism.toml" if file == "mechanism" else f"NAME.{file}.toml"
    return list_tables(FILES[file], heading, OPEN, SUFFIXES)


def find_tables(name: str) -> list[tuple[str, KeyTable]]:
    """Return the tables of a name with their files: a file, a table's path or else its last part, or a type.

    Examples are ``scene``, ``motor``, ``controller.desired``, ``desired``, ``scene.solver`` and ``set_point``. The name
    of a file stands for all its tables.

    Raises
    ------
    InputError
        There is no such table. The message names the nearest one.
    """
    if name in FILES:
        return [(name, table) for table in tables(name)]
    named = [(file, table) for file in FILES for table in tables(file)]
    of_path = [(file, table) for file, table in named if name == _names(file, table)[0]]
    matches = of_path or [(file, table) for file, table in named if name in _names(file, table)]
    if not matches:
        names = list(dict.fromkeys([*FILES, *(_names(file, table)[0] for file, table in named if table.path)]))
        nearest = suggest_name(name, dict.fromkeys(each for file, table in named for each in _names(file, table)))
        raise InputError(f"ckc keys: no table {name!r}; there are {', '.join(names)}{nearest}")
    return matches


def _names(file: str, table: KeyTable) -> list[str]:
    """Return the names that stand for a table, its path first."""
    if not table.path:
        return [file]
    path = table.path.removesuffix(".COORDINATE").removesuffix(".NAME")
    last = path.rpartition(".")[2]
    tag = table.structure.__struct_config__.tag
    return [path, table.path, last, f"{file}.{path}", *([tag, f"{path}.{tag}"] if tag else [])]


def format_tables(selected: list[tuple[str, KeyTable]]) -> Iterator[str]:
    """Return a line for each table with its description, and a line for each key: type, default, unit, meaning."""
    for number, (file, table) in enumerate(selected):
        if number:
            yield ""
        yield f"{table.heading}{f' in {tables(file)[0].heading}' if table.path else ''}: {_plain_text(table.about)}"
        tag = table.structure.__struct_config__.tag
        if tag:
            yield f'  {"type":<{WIDTH}} "{tag}"; required.'
        yield from (_format_key(key) for key in table.keys)


def _format_key(key: Key) -> str:
    """Return a key in one line: name, type, unit, default, meaning."""
    unit = f", {key.unit}" if key.unit else ""
    default = "required" if key.default == "required" else f"default {key.default}"
    return f"  {key.name:<{WIDTH}} {key.kind}{unit}; {default}. {_plain_text(key.meaning)}"


def _plain_text(text: str) -> str:
    """Return a docstring in one line, without its markup."""
    return " ".join(text.replace("`", "").split())
