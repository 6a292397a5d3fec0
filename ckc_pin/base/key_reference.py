"""The reference of the keys of a user's files, from the typed structures that read them.

Type, bounds and default are those of the structure. Meaning, unit and example are in its docstring: a numpydoc
`Attributes` section with the unit in place of the type, and an example in the last line.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin

import msgspec

from ckc_pin.base.toml import describe_type

__all__ = ["Key", "KeyTable", "describe_structure", "list_tables"]


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
class KeyTable:
    """A table of a file: its path without the file's name, its TOML heading, its structure and its keys."""

    path: str
    heading: str
    structure: Any
    about: str
    keys: tuple[Key, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the table as JSON-ready data."""
        names = ("name", "kind", "default", "unit", "meaning", "example")
        rows = [{name: getattr(key, name) for name in names} for key in self.keys]
        return {"table": self.path, "heading": self.heading, "about": self.about, "keys": rows}


def list_tables(
    structure: Any,
    heading: str,
    open_tables: Mapping[tuple[Any, str], tuple[Any, ...]],
    suffixes: Mapping[Any, str],
) -> tuple[KeyTable, ...]:
    """Return the tables of a file, the file itself first, each structure once.

    Parameters
    ----------
    structure : type
        The structure that reads the file.
    heading : str
        Name of the file.
    open_tables : mapping
        By structure and key, the structures of tables whose contents decide which structure is read.
    suffixes : mapping
        By structure, the suffix of the path of such a table.
    """
    return tuple(_Walk(open_tables, suffixes).walk(structure, "", heading))


class _Walk:
    def __init__(self, open_tables: Mapping[tuple[Any, str], tuple[Any, ...]], suffixes: Mapping[Any, str]) -> None:
        self.open_tables = open_tables
        self.suffixes = suffixes
        self.seen: set[Any] = set()

    def walk(self, structure: Any, path: str, heading: str) -> Iterator[KeyTable]:
        self.seen.add(structure)
        about, entries = describe_structure(structure)
        fields = msgspec.structs.fields(structure)
        keys = tuple(_key(field, entries.get(field.encode_name, ("", "", ""))) for field in fields)
        yield KeyTable(path, heading, structure, about, keys)
        for field in fields:
            opened = self.open_tables.get((structure, field.encode_name))
            many, named = get_origin(field.type) is list, get_origin(field.type) is dict and not opened
            for member in opened or _structures(field.type):
                if member not in self.seen:
                    suffix = self.suffixes.get(member, ".NAME" if named else "")
                    where = f"{path}.{field.encode_name}".lstrip(".") + suffix
                    tag = member.__struct_config__.tag
                    suffix = f' with type = "{tag}"' if tag else ""
                    yield from self.walk(member, where, (f"[[{where}]]" if many else f"[{where}]") + suffix)


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
    if len(members) == 1 and get_origin(inner) is list and not _nested(inner):
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
def describe_structure(structure: Any) -> tuple[str, dict[str, tuple[str, str, str]]]:
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
