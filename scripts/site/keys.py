"""Generate the reference of the keys of a user's files from the typed structures that read them.

Type, bounds and default are those of the structure. Meaning, unit and example are in its docstring: a numpydoc
`Attributes` section with the unit in place of the type, and an example in the last line.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin

import msgspec

from ckc_pin.base.toml import describe_type
from ckc_pin.control.point_path import PointPathSpec
from ckc_pin.control.spec import MotionSpec, TableSpec, TrackingSpec
from ckc_pin.ensembles.spec import SweepSpec
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.scene.spec import SceneSpec

__all__ = ["FILES", "Key", "Table", "markdown", "tables"]

FILES: dict[str, Any] = {"mechanism": MechanismSpec, "scene": SceneSpec, "sweep": SweepSpec}
# Tables without a fixed structure: their contents decide which structure is read.
OPEN = {(TrackingSpec, "desired"): (MotionSpec, TableSpec, PointPathSpec)}
# Suffix of the path of such a table.
PLACES: dict[Any, str] = {MotionSpec: ".COORDINATE"}


@dataclass(frozen=True)
class Key:
    """A key with its type, default, unit, meaning and example."""

    name: str
    kind: str
    default: str
    unit: str
    meaning: str
    example: str
    annotation: Any

    @property
    def documented(self) -> bool:
        """Whether it has a meaning and an example."""
        return bool(self.meaning and self.example)


@dataclass(frozen=True)
class Table:
    """A table of a file: its path without the file's name, its TOML heading, its structure and its keys."""

    path: str
    heading: str
    structure: Any
    about: str
    keys: tuple[Key, ...]


@cache
def tables(file: str) -> tuple[Table, ...]:
    """Return the tables of a file, the file itself first, each structure once."""
    return tuple(_walk(FILES[file], "", "mechanism.toml" if file == "mechanism" else f"NAME.{file}.toml", set()))


def _walk(structure: Any, path: str, heading: str, seen: set[Any]) -> Iterator[Table]:
    seen.add(structure)
    about, entries = described(structure)
    fields = msgspec.structs.fields(structure)
    keys = tuple(_key(field, entries.get(field.encode_name, ("", "", ""))) for field in fields)
    yield Table(path, heading, structure, about, keys)
    for field in fields:
        opened = OPEN.get((structure, field.encode_name))
        many, named = get_origin(field.type) is list, get_origin(field.type) is dict and not opened
        inner = opened or _structures(field.type)
        for member in inner:
            if member not in seen:
                where = f"{path}.{field.encode_name}".lstrip(".") + PLACES.get(member, ".NAME" if named else "")
                tag = member.__struct_config__.tag
                says = f' with type = "{tag}"' if tag else ""
                yield from _walk(member, where, (f"[[{where}]]" if many else f"[{where}]") + says, seen)


def _structures(kind: Any) -> tuple[Any, ...]:
    """Return the structures that a type names, at any depth."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return (kind,)
    return tuple(structure for member in get_args(kind) for structure in _structures(member))


def _key(field: Any, entry: tuple[str, str, str]) -> Key:
    unit, meaning, example = entry
    return Key(field.encode_name, _kind(field.type), _default(field), unit, meaning, example, field.type)


def _kind(kind: Any) -> str:
    choices = [member for member in (kind, *get_args(kind)) if get_origin(member) is Literal]
    if choices:
        return ", ".join(f'"{value}"' if isinstance(value, str) else str(value) for value in get_args(choices[0]))
    if get_origin(kind) is dict:
        return _by_name(get_args(kind)[1])
    if get_origin(kind) is list and _structures(kind):
        return "list of tables"
    members = [member for member in get_args(kind) if member is not NoneType]
    inner = next((member for member in members if get_origin(member) in (list, tuple)), kind)
    if get_origin(inner) is tuple and Ellipsis not in get_args(inner):
        return f"list of {len(get_args(inner))} {'numbers of at least 0' if 'ge' in str(inner) else 'numbers'}"
    if get_origin(inner) is list and get_args(inner)[0] is not list and not _nested(inner):
        return "list of numbers" if get_args(inner)[0] is float else "list of names"
    return re.sub(r"^an? ", "", describe_type(kind))


def _by_name(values: Any) -> str:
    if values is Any:
        return "table"
    many = {str: "strings", float: "numbers"}
    members = get_args(values) if get_origin(values) is UnionType else (values,)
    said = [
        "tables"
        if _structures(member)
        else "lists of 3 numbers"
        if get_origin(member) is tuple
        else many.get(member, "numbers")
        for member in members
    ]
    return f"table of {' or '.join(said)} by name"


def _nested(kind: Any) -> bool:
    return get_origin(get_args(kind)[0]) in (list, tuple)


def _default(field: Any) -> str:
    if field.required:
        return "required"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if isinstance(value, msgspec.Struct):
        return "defaults of its keys"
    if value is None:
        return "absent"
    literal = list(value) if isinstance(value, tuple) else value
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(literal)


# --- docstrings ------------------------------------------------------------------------------------


@cache
def described(structure: Any) -> tuple[str, dict[str, tuple[str, str, str]]]:
    """Return a structure's description, and (unit, meaning, example) of each key, including keys of its bases."""
    entries: dict[str, tuple[str, str, str]] = {}
    for base in reversed(structure.__mro__):
        if issubclass(base, msgspec.Struct) and base.__dict__.get("__doc__"):
            entries |= _entries(_section(inspect.cleandoc(base.__doc__))[1])
    return _section(inspect.cleandoc(structure.__doc__ or ""))[0], entries


def _section(text: str) -> tuple[str, str]:
    about, _, rest = text.partition("Attributes\n----------\n")
    return about.strip(), rest


def _entries(text: str) -> dict[str, tuple[str, str, str]]:
    entries = {}
    for match in re.finditer(r"^(\w+)(?: : (.*))?\n((?:    .*\n?)+)", text, re.MULTILINE):
        name, unit, body = match[1], match[2] or "", [line.strip() for line in match[3].strip().splitlines()]
        example = body.pop().strip("`") if re.match(rf"``{name} = .*``$", body[-1]) else ""
        entries[name] = (unit, " ".join(body), example)
    return entries


# --- a page ----------------------------------------------------------------------------------------


def markdown(file: str) -> str:
    """Return the reference of a file, in MyST."""
    return "\n".join(line for table in tables(file) for line in _table(file, table))


def _table(file: str, table: Table) -> Iterator[str]:
    anchor = "-".join(filter(None, ("table", file, re.sub(r"\W+", "-", table.path), table.structure.__name__)))
    yield f"({anchor.lower()})="
    yield f"## `{table.heading}`\n"
    yield f"{_code(table.about)}\n"
    for key in table.keys:
        yield f":::{{ckc:key}} {'.'.join(filter(None, (table.path, key.name)))}"
        said = {"file": file, "kind": key.kind, "default": key.default, "unit": key.unit}
        yield from (f":{name}: {_quoted(value)}" for name, value in said.items() if value)
        yield f"\n{_code(key.meaning)}\n"
        yield f"```toml\n{key.example}\n```\n:::\n"


def _code(text: str) -> str:
    return text.replace("``", "`")


def _quoted(value: str) -> str:
    """Quote an option as YAML, with doubled apostrophes."""
    return "'" + value.replace("'", "''") + "'"
