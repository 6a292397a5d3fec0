"""Reading a TOML file into a typed structure, with messages that name the place and the valid choices."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from stat import S_ISREG
from typing import Any, TypeVar

import msgspec

from ckc_pin.base.faults import Fault, faults, numbers
from ckc_pin.errors import InputError

__all__ = ["FileStruct", "convert", "join_dotted_keys", "read_text", "read_toml"]

T = TypeVar("T")

MAX_BYTES = 16 * 2**20  # no mechanism, scene or URDF that a person wrote is larger
MOST_SAID = 5  # of the faults of one file
DEEPEST = 50  # tables and lists inside each other; tomllib reads dotted keys to any depth, what follows recurses


class FileStruct(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a table of a file says: unknown keys are errors, and nobody changes it."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Copy the tables; what is frozen stays what it is."""
        fields = ((name, getattr(self, name)) for name in self.__struct_fields__)
        copied = {name: twin for name, value in fields if (twin := deepcopy(value, memo)) is not value}
        return msgspec.structs.replace(self, **copied) if copied else self


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
        Unknown keys (the valid ones are listed), wrong types, missing values, and numbers that are not finite (TOML
        knows nan and inf), all of them in one message.
    """
    found: list[Fault] = []
    try:
        converted = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        found = [*faults(data, kind)]
        if not found:
            raise InputError(f"{source}: {at and f'{at}: '}{error}") from None  # keys that are no strings
    named = {fault.steps for fault in found}
    found += [fault for fault in numbers(data) if fault.steps not in named]
    if found:
        raise InputError(f"{source}: {_all_of([fault.sentence(at) for fault in found])}")
    return converted


def _all_of(sentences: list[str]) -> str:
    """Write several sentences in one line, numbered."""
    if len(sentences) == 1:
        return sentences[0]
    said = " ".join(f"({k}) {sentence}" for k, sentence in enumerate(sentences[:MOST_SAID], 1))
    return said + (f" and {len(sentences) - MOST_SAID} more" if len(sentences) > MOST_SAID else "")


def join_dotted_keys(data: dict[str, Any], *path: str) -> None:
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
