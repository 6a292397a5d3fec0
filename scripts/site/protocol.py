"""Generate the reference of the explorer's messages from their typed structures and docstrings."""

from __future__ import annotations

from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec

from ckc_pin.base.key_reference import Key, KeyTable, list_tables
from ckc_pin.explorer.messages import Report, Request

__all__ = ["DIRECTIONS", "markdown", "message_tables"]

DIRECTIONS = {"requests": get_args(Request), "reports": tuple(Report.__subclasses__())}


def message_tables(direction: str) -> list[KeyTable]:
    """Return the messages of a direction, "requests" or "reports", each followed by the structures in its fields."""
    return [table for structure in DIRECTIONS[direction] for table in list_tables(structure, "", {}, {})]


def markdown(direction: str) -> str:
    """Return the messages of a direction, in MyST."""
    return "\n".join(line for table in message_tables(direction) for line in _table(table))


def _table(table: KeyTable) -> Iterator[str]:
    yield f"### `{_name(table.structure)}`\n"
    yield f"{table.about}\n"
    if table.keys:
        yield "| field | value | default | unit | meaning |\n|---|---|---|---|---|"
        yield from (_row(key) for key in table.keys)
        yield ""


def _row(key: Key) -> str:
    default = "" if key.default == "required" else f"`{key.default}`"
    cells = (f"`{key.name}`", _kind(key.annotation) or key.kind, default, key.unit, key.meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _name(structure: Any) -> str:
    """Return the name of a message as it is sent, and of a structure in a field of another one its class."""
    if issubclass(structure, Report):
        return str(structure.kind())
    return str(structure.__struct_config__.tag or structure.__name__)


def _kind(kind: Any) -> str:
    """Return what a field holds, or "" if its description as a key of a file fits."""
    origin, members = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return next(_kind(member) for member in members if member is not NoneType)
    if origin is Annotated:
        lengths = [meta.min_length for meta in members[1:] if meta.min_length]
        return f"{lengths[0]} numbers" if lengths else _kind(members[0])
    if origin is list:
        return f"list of {_many(members[0])}"
    if origin is dict:
        return f"{_many(members[1])} by name"
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return f"`{kind.__name__}`"
    return ""


def _many(kind: Any) -> str:
    words = {str: "strings", float: "numbers", Any: "values"}
    return words.get(kind) or _kind(kind).replace("list of", "lists of") or "numbers"
