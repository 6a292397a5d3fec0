"""Reading a TOML file into a typed structure, with messages that name the place and the valid choices."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from ckc_pin.errors import InputError

__all__ = ["convert", "read_text", "read_toml"]

T = TypeVar("T")

MAX_BYTES = 16 * 2**20  # no mechanism, scene or URDF that a person wrote is larger


def read_text(path: Path, what: str) -> str:
    """Read a UTF-8 text file.

    Raises
    ------
    InputError
        The file is missing, not a file, too large or not UTF-8.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: {what} of more than {MAX_BYTES // 2**20} MiB")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a {what}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def read_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML; InputError carries the source and the line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: malformed TOML: {error}") from None


def convert(data: Any, kind: type[T], source: str) -> T:
    """Check parsed data against a msgspec structure.

    Raises
    ------
    InputError
        An unknown key (the valid ones are listed), a wrong type, a missing value, or a number that is
        not finite (TOML knows nan and inf).
    """
    try:
        converted = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{source}: {_explain(str(error), data, kind)}") from None
    for key, value in _numbers("", data):
        if not math.isfinite(value):
            raise InputError(f"{source}: {key} = {value} is not a finite number")
    return converted


def _numbers(key: str, value: Any) -> list[tuple[str, float]]:
    if isinstance(value, dict):
        return [x for k, v in value.items() for x in _numbers(f"{key}.{k}" if key else str(k), v)]
    if isinstance(value, list | tuple):
        return [x for k, v in enumerate(value) for x in _numbers(f"{key}[{k}]", v)]
    return [(key, value)] if isinstance(value, float) else []


def _explain(message: str, data: Any, kind: Any) -> str:
    """Turn msgspec's message into one that says where, and what would be right."""
    text, _, place = message.partition(" - at `$")
    place = place.rstrip("`").lstrip(".")
    keyed = bool(re.search(r"(^|\.)?\[\.\.\.\]", place))
    where = f"{place}: " if place and not keyed else (f"in {place.replace('[...]', '[KEY]')}: " if keyed else "")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", text)
    if unknown:
        valid = _keys(msgspec.inspect.type_info(kind), re.findall(r"[^.\[\]]+|\[[^\]]*\]", place), data)
        return f"{where}unknown key {unknown[1]!r}" + (f"; valid: {', '.join(valid)}" if valid else "")
    missing = re.fullmatch(r"Object missing required field `(.*)`", text)
    if missing:
        return f"{where}the key {missing[1]!r} is missing"
    choice = re.fullmatch(r"Invalid enum value (.*)", text)
    if choice:
        options = _choices(msgspec.inspect.type_info(kind), re.findall(r"[^.\[\]]+|\[[^\]]*\]", place), data)
        return f"{where}{choice[1]} is not one of {', '.join(map(repr, options))}"
    text = re.sub(r"`([^`]*)`", lambda m: _PLAIN.get(m[1], m[1]), text)
    return f"{where}{text[0].lower()}{text[1:]}"


_PLAIN = {"int": "an integer", "float": "a number", "str": "a string", "object": "a table", "array": "a list",
          "bool": "true or false", "null": "nothing"}  # fmt: skip


def _descend(info: Any, steps: list[str], data: Any) -> Any:
    """Follow a path such as ['loop', '[0]', 'frame_a'] through a type description."""
    inspect = msgspec.inspect
    for step in steps:
        if isinstance(info, inspect.UnionType):
            info = next((t for t in info.types if _fits(t, data)), info.types[0])
        if isinstance(info, inspect.StructType):
            field = next((f for f in info.fields if f.encode_name == step), None)
            if field is None:
                return None
            info, data = field.type, data.get(step) if isinstance(data, dict) else None
        elif isinstance(info, inspect.ListType | inspect.VarTupleType):
            k = int(step[1:-1]) if step[1:-1].isdigit() else 0
            info, data = info.item_type, data[k] if isinstance(data, list) and len(data) > k else None
        elif isinstance(info, inspect.DictType):
            info, data = info.value_type, None
        else:
            return None
    if isinstance(info, inspect.UnionType):
        info = next((t for t in info.types if _fits(t, data)), info.types[0])
    return info


def _fits(info: Any, data: Any) -> bool:
    """Whether a member of a union is the one that the data is meant for."""
    inspect = msgspec.inspect
    if isinstance(info, inspect.StructType):
        if not isinstance(data, dict):
            return data is None
        return info.tag_field is None or data.get(info.tag_field) == info.tag
    if isinstance(info, inspect.DictType):
        return isinstance(data, dict)
    if isinstance(info, inspect.ListType | inspect.VarTupleType | inspect.TupleType):
        return isinstance(data, list)
    return isinstance(info, inspect.LiteralType) and isinstance(data, str)


def _keys(info: Any, steps: list[str], data: Any) -> list[str]:
    found = _descend(info, steps, data)
    if not isinstance(found, msgspec.inspect.StructType):
        return []
    tag = [found.tag_field] if found.tag_field else []
    return tag + [field.encode_name for field in found.fields]


def _choices(info: Any, steps: list[str], data: Any) -> list[Any]:
    found = _descend(info, steps, data)
    return list(found.values) if isinstance(found, msgspec.inspect.LiteralType) else []
