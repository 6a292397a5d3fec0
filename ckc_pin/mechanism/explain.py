"""Why data do not fit a msgspec structure, in plain words: the place, the value, what would be right.

msgspec says ``Expected `float` > 0.0 - at `$.solver.rtol` ``; a person reads ``solver.rtol = -1: a number
greater than 0 is needed``. It hides the keys of tables by name (``$.q[...]``); they are found again by trying
one at a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any

import msgspec
from msgspec import inspect

__all__ = ["explain", "place_name"]

Step = str | int  # a key, or the number of a list's entry

PLAIN = {
    "int": "an integer",
    "float": "a number",
    "str": "a string",
    "object": "a table",
    "array": "a list",
    "bool": "true or false",
    "null": "nothing",
    "date": "a date",
    "datetime": "a date and time",
    "time": "a time",
}


def explain(message: str, data: Any, kind: Any, at: str = "") -> str:
    """Turn a message of `msgspec.convert(data, kind)` into a sentence.

    Parameters
    ----------
    message : str
        Of its ValidationError.
    data, kind : object
        What was converted to what.
    at : str
        Name of the place where the data stand in their file.
    """
    text, _, where = message.partition(" - at `$")
    steps = _steps(where.rstrip("`"), text, data, kind)
    place, value, wanted = place_name(steps, at), _value(data, steps), _type_at(kind, steps, data)
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", text, re.DOTALL)
    if unknown:
        return f"{_before(place)}unknown key {unknown[1]!r}; valid: {', '.join(_keys(wanted))}"
    missing = re.fullmatch(r"Object missing required field `(.*)`", text)
    if missing:
        holder = _type_at(kind, steps, data, union=True)
        choices = _choices(_field(wanted, missing[1])) or (_tags(holder) if missing[1] == "type" else [])
        return f"{_before(place)}the key {missing[1]!r} is missing{_valid(choices)}"
    named = f"{place}{_shown(value)}"
    if re.match(r"Invalid (enum )?value", text):
        parent = _type_at(kind, steps[:-1], data, union=True)
        return f"{named}{_valid(_choices(wanted) or _tags(parent))}"
    return f"{named}: {_needed(text)}"


def place_name(steps: Iterable[Step], at: str = "") -> str:
    """Write a path through tables and lists as a person would: ``controller.K_D[0][1]``."""
    name = at
    for step in steps:
        name += f"[{step}]" if isinstance(step, int) else f".{step}" if name else step
    return name


def _before(place: str) -> str:
    return f"{place}: " if place else ""


def _valid(choices: Sequence[Any]) -> str:
    return f"; valid: {', '.join(map(repr, choices))}" if choices else ""


def _shown(value: Any) -> str:
    """` = value` where that is short."""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return f" = {shown}" if isinstance(value, str | int | float | list) and len(shown) <= 60 else ""


def _needed(text: str) -> str:
    """``Expected `float | null`, got `str` `` and its kin."""
    expected = re.fullmatch(r"Expected `(.*?)`(.*?)(?:, got `?(.*?)`?)?", text)
    if not expected:
        return text[0].lower() + text[1:]
    kinds, condition, got = expected.groups()
    *others, last = (PLAIN.get(kind, kind) for kind in kinds.split(" | ") if kind != "null")
    needed = f"{', '.join(others)} or {last}" if others else last
    compared = re.fullmatch(r" (>=|>|<=|<) (.*)", condition)
    length = re.fullmatch(r" of length (>= )?(.*)", condition)
    if compared:
        words = {">": "greater than", ">=": "of at least", "<": "less than", "<=": "of at most"}
        needed += f" {words[compared[1]]} {float(compared[2]):g}"
    elif length:
        needed += " that is not empty" if length[1] else f" of {length[2]}"
    if got is None or got == "bool":
        return f"{needed} is needed"
    return f"{needed} is needed, not {f'of {got}' if got.isdigit() else PLAIN.get(got, got)}"


# --- places ----------------------------------------------------------------------------------------


def _steps(where: str, text: str, data: Any, kind: Any) -> list[Step]:
    """Read ``.loop[0].axis_a[2]``; a hidden key ``[...]`` is the one that alone gives the same message."""
    steps: list[Step] = []
    for key, index in re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", where):
        steps.append(key or (int(index) if index != "..." else _hidden_key(steps, text, data, kind)))
    return steps


def _hidden_key(before: list[Step], text: str, data: Any, kind: Any) -> str:
    table = _value(data, before)
    for key in table:
        try:
            msgspec.convert(_replaced(data, before, {key: table[key]}), kind)
        except msgspec.ValidationError as error:
            if str(error).partition(" - at `$")[0] == text:
                return str(key)
    return "..."


def _value(data: Any, steps: Sequence[Step]) -> Any:
    for step in steps:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return {}
    return data


def _replaced(data: Any, steps: Sequence[Step], value: Any) -> Any:
    """Return a copy of nested data with one part replaced."""
    if not steps:
        return value
    changed = copy(data)
    changed[steps[0]] = _replaced(data[steps[0]], steps[1:], value)
    return changed


# --- types -----------------------------------------------------------------------------------------


def _type_at(kind: Any, steps: Sequence[Step], data: Any, *, union: bool = False) -> Any:
    """Follow a path through a type description; `union`: return the last one with all its members."""
    info: Any = inspect.type_info(kind)
    for step in steps:
        info = _member(info, data)
        if isinstance(info, inspect.StructType):
            info = _field(info, step)
        elif isinstance(info, inspect.ListType | inspect.VarTupleType):
            info = info.item_type
        elif isinstance(info, inspect.DictType):
            info = info.value_type
        else:
            return None
        data = _value(data, [step])
    return info if union else _member(info, data)


def _member(info: Any, data: Any) -> Any:
    """Return the member of a union that the data are meant for."""
    if not isinstance(info, inspect.UnionType):
        return info
    return next((member for member in info.types if _fits(member, data)), info.types[0])


def _fits(info: Any, data: Any) -> bool:
    if isinstance(info, inspect.StructType):
        return isinstance(data, dict) and (info.tag_field is None or data.get(info.tag_field) == info.tag)
    if isinstance(info, inspect.DictType):
        return isinstance(data, dict)
    if isinstance(info, inspect.ListType | inspect.VarTupleType | inspect.TupleType):
        return isinstance(data, list)
    return isinstance(info, inspect.LiteralType)


def _keys(info: Any) -> list[str]:
    if not isinstance(info, inspect.StructType):
        return []
    return [*([info.tag_field] if info.tag_field else []), *(field.encode_name for field in info.fields)]


def _choices(info: Any) -> list[Any]:
    return list(info.values) if isinstance(info, inspect.LiteralType) else []


def _field(info: Any, name: Step) -> Any:
    fields = info.fields if isinstance(info, inspect.StructType) else ()
    return next((field.type for field in fields if field.encode_name == name), None)


def _tags(info: Any) -> list[Any]:
    """Tags of a union of structures."""
    members = info.types if isinstance(info, inspect.UnionType) else [info]
    return [m.tag for m in members if isinstance(m, inspect.StructType) and m.tag is not None]
