"""Reading a TOML file into a typed structure, with messages that name the place and the valid choices."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from stat import S_ISREG
from typing import Any, TypeVar

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.mechanism.explain import explain, place_name

__all__ = ["by_coordinate", "convert", "read_text", "read_toml"]

T = TypeVar("T")

MAX_BYTES = 16 * 2**20  # no mechanism, scene or URDF that a person wrote is larger
INTEGERS = range(-(2**63), 2**63)  # TOML's
DEEPEST = 50  # tables and lists inside each other; tomllib reads dotted keys to any depth, what follows recurses


def read_text(path: Path, what: str) -> str:
    """Read a UTF-8 text file, with or without a byte order mark.

    Raises
    ------
    InputError
        The file is missing, not a file, too large or not UTF-8.
    """
    try:
        status = path.stat()
        if not S_ISREG(status.st_mode):
            raise InputError(f"{path}: a folder or a device, not a {what}")
        if status.st_size > MAX_BYTES:
            raise InputError(f"{path}: more than {MAX_BYTES // 2**20} MiB, too large for a {what}")
        return path.read_text(encoding="utf-8-sig")
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a {what}, not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{str(path)!r}: no name of a file: {error}") from None  # a NUL in it


def read_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML; InputError carries the source and the line."""
    try:
        data = tomllib.loads(text)
        if _deeper_than(DEEPEST, data):
            raise RecursionError
        return data
    except RecursionError:
        raise InputError(f"{source}: malformed TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError is one; so is a number of thousands of digits
        hint = "; this is XML: a URDF is named in a mechanism.toml" if text.lstrip().startswith("<") else ""
        raise InputError(f"{source}: malformed TOML: {error}{hint}") from None


def _deeper_than(depth: int, data: Any) -> bool:
    level = [data]
    for _ in range(depth):
        level = [x for v in level if isinstance(v, dict | list) for x in (v.values() if isinstance(v, dict) else v)]
    return bool(level)


def convert(data: Any, kind: type[T], source: str, at: str = "") -> T:
    """Check parsed data against a msgspec structure.

    Parameters
    ----------
    data : object
    kind : type
    source : str
        The file, as its user knows it.
    at : str
        Where in the file the data stand, when they are not all of it.

    Raises
    ------
    InputError
        An unknown key (the valid ones are listed), a wrong type, a missing value, or a number that is
        not finite (TOML knows nan and inf).
    """
    try:
        converted = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{source}: {explain(str(error), data, kind, at)}") from None
    for steps, value in _numbers((), data):
        if isinstance(value, int) and value not in INTEGERS:
            raise InputError(f"{source}: {place_name(steps, at)}: an integer of more than 64 bits; write it as 1e20")
        if not math.isfinite(value):
            raise InputError(f"{source}: {place_name(steps, at)} = {value}: a finite number is needed")
    return converted


def _numbers(steps: tuple[str | int, ...], value: Any) -> Iterator[tuple[tuple[str | int, ...], int | float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers((*steps, key), inner)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _numbers((*steps, index), inner)
    elif isinstance(value, int | float):
        yield steps, value


def by_coordinate(data: dict[str, Any], *path: str) -> None:
    """Join the tables inside a table into dotted keys, in place: TOML reads ``root.z = 1`` as {root: {z: 1}}.

    Parameters
    ----------
    data : dict
        Parsed TOML.
    *path : str
        Where the table is; nothing happens where there is none.
    """
    *tables, last = path
    at: Any = data
    for table in tables:
        at = at.get(table) if isinstance(at, dict) else None
    if isinstance(at, dict) and isinstance(at.get(last), dict):
        at[last] = dict(_dotted("", at[last]))


def _dotted(key: str, table: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _dotted(f"{key}{name}.", value)
        else:
            yield f"{key}{name}", value
