"""Reading a TOML file into a typed structure, with messages that name the place and the valid choices."""

from __future__ import annotations

import math
import tomllib
import types
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from datetime import date, datetime, time
from pathlib import Path
from stat import S_ISREG
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from ckc_pin.errors import InputError

__all__ = [
    "Fault",
    "FileStruct",
    "convert",
    "expected",
    "faults",
    "join_dotted_keys",
    "numbers",
    "read_text",
    "read_toml",
]

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


Step = str | int  # a key, or the number of a list's entry

LONGEST = 60  # of a value that is quoted
NEAR = 0.7  # how alike a key and the one that was meant are, of 1
INTEGERS = range(-(2**63), 2**63)  # TOML's
TOO_LARGE = "an integer of at most 64 bits, or a number such as 1e20,"
ALSO = {"an integer": ["a number"]}  # what else a value of some kind may stand for
BOUNDS = {"ge": "at least", "gt": "greater than", "le": "at most", "lt": "less than"}


class Fault(msgspec.Struct, frozen=True):
    """One thing that is wrong.

    Attributes
    ----------
    steps : tuple
        Where: keys and numbers of list entries, from the outside in; of a key that is unknown or missing, its table.
    what : {"unknown key", "missing key", "value"}
    found : object
        The value there; of a key, its name.
    needed : str
        What would be right, where that is not one of the choices.
    instead : str
        What there is, where it is not even of the right kind.
    choices : tuple
        What would be right, where there are few.
    near : str or None
        The choice that was meant, probably.
    """

    steps: tuple[Step, ...]
    what: Literal["unknown key", "missing key", "value"]
    found: Any
    needed: str = ""
    instead: str = ""
    choices: tuple[Any, ...] = ()
    near: str | None = None

    def sentence(self, at: str = "") -> str:
        """Say it, with the place; `at` names where the data stand in their file."""
        place = _place(self.steps, at)
        if self.what == "value":
            head, choices = f"{place}{_quoted(self.found)}", map(repr, self.choices)
        elif self.what == "unknown key":
            head, choices = f"{place and f'{place}: '}unknown key {self.found!r}", map(str, self.choices)
        else:
            head, choices = f"{place and f'{place}: '}the key {self.found!r} is missing", map(repr, self.choices)
        needed = f": {self.needed} is needed" if self.needed else ""
        needed += f", not {self.instead}" if self.instead else ""
        valid = f"; valid: {', '.join(choices)}" if self.choices else ""
        return f"{head}{needed}{valid}{f'; did you mean {self.near!r}?' if self.near else ''}"


def faults(data: Any, kind: Any, steps: tuple[Step, ...] = ()) -> Iterator[Fault]:
    """Find everything in the data that does not fit.

    Parameters
    ----------
    data : object
        Plain data: tables, lists, strings, numbers.
    kind : type
        A msgspec structure or anything else that msgspec converts to.
    steps : tuple
        Where the data stand.
    """
    if _fits(data, kind):
        return
    structs = [member for member in _members(kind) if _is_struct(member)]
    others = [member for member in _members(kind) if not _is_struct(member)]
    mapping = next((member for member in others if get_origin(member) is dict), None)
    items = next((found for found in map(_items, others) if found), None)
    if isinstance(data, Mapping) and structs:
        yield from _in_table(data, structs, steps)
    elif isinstance(data, Mapping) and mapping is not None:
        for key, value in data.items():
            yield from faults(value, get_args(mapping)[1], (*steps, key))
    elif isinstance(data, list | tuple) and data and items and len(items) in (1, len(data)):
        yield from _in_list(data, items, steps)
    else:
        several = items and len(items) > 1 and isinstance(data, list | tuple)
        yield _of_value(data, kind, len(items) if items and several else None, steps)


def numbers(data: Any, steps: tuple[Step, ...] = ()) -> Iterator[Fault]:
    """Find the numbers that no type refuses and nothing can use: TOML knows nan, inf and integers of any size."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            yield from numbers(value, (*steps, key))
    elif isinstance(data, list | tuple):
        for k, value in enumerate(data):
            yield from numbers(value, (*steps, k))
    elif isinstance(data, int) and data not in INTEGERS:
        yield Fault(steps, "value", data, TOO_LARGE)
    elif isinstance(data, float) and not math.isfinite(data):
        yield Fault(steps, "value", data, "a finite number")


def _in_table(data: Mapping[Any, Any], structs: Sequence[Any], steps: tuple[Step, ...]) -> Iterator[Fault]:
    field = structs[0].__struct_config__.tag_field
    if field is not None:
        tags = {struct.__struct_config__.tag: struct for struct in structs}
        if field not in data:
            yield Fault(steps, "missing key", field, choices=tuple(tags))
            return
        if not isinstance(data[field], str) or data[field] not in tags:
            yield Fault((*steps, field), "value", data[field], choices=tuple(tags))
            return
        structs = [tags[data[field]]]
    fields = {known.encode_name: known for known in msgspec.structs.fields(structs[0])}
    keys = (*([field] if field else []), *fields)
    meant = set()
    for key in data:
        if key not in keys and structs[0].__struct_config__.forbid_unknown_fields:
            from difflib import get_close_matches

            near = next(iter(get_close_matches(str(key), set(keys) - set(data), 1, NEAR)), None)
            meant.add(near)
            yield Fault(steps, "unknown key", key, choices=keys, near=near)
    for key, known in fields.items():
        if key in data:
            yield from faults(data[key], known.type, (*steps, key))
        elif known.required and key not in meant:
            yield Fault(steps, "missing key", key, choices=_choices(known.type))


def _in_list(data: Sequence[Any], items: Sequence[Any], steps: tuple[Step, ...]) -> Iterator[Fault]:
    """Find what is wrong with a list's entries; one wrong as a whole stands for others wrong in that way."""
    ways = set()
    for k, value in enumerate(data):
        for fault in faults(value, items[k % len(items)], (*steps, k)):
            as_a_whole = fault.what == "value" and fault.steps == (*steps, k)
            way = (fault.needed, fault.instead, fault.choices)
            if not (as_a_whole and way in ways):
                yield fault
            if as_a_whole:
                ways.add(way)


def _of_value(value: Any, kind: Any, length: int | None, steps: tuple[Step, ...]) -> Fault:
    """Return the fault of a value that is as a whole not what it should be."""
    found = _plain(type(value))
    if isinstance(value, int) and value not in INTEGERS:
        return Fault(steps, "value", value, TOO_LARGE)
    if length is not None:
        return Fault(steps, "value", value, f"a list of {length}", f"of {len(value)}")
    alike = [member for member in _members(kind) if _plain(member) in (found, *ALSO.get(found, ()))]
    if not alike:
        return Fault(steps, "value", value, _one_of([_plain(member) for member in _members(kind)]), found)
    choices = _choices(kind)
    return Fault(steps, "value", value, "" if choices else _one_of([_bounded(m) for m in alike]), choices=choices)


# --- types -----------------------------------------------------------------------------------------


def expected(kind: Any) -> str:
    """Say what fits a type: ``a number greater than 0``, ``a string or a table``."""
    return _one_of([_bounded(member) for member in _members(kind)])


def _fits(value: Any, kind: Any) -> bool:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True


def _members(kind: Any) -> list[Any]:
    """Return the members of a union other than None, or the type itself."""
    union = get_origin(kind) in (Union, types.UnionType)
    return [member for member in get_args(kind) if member is not types.NoneType] if union else [kind]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _items(kind: Any) -> tuple[Any, ...]:
    """Return the types of a list's entries, one for all or one for each; nothing for what is no list."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    arguments = get_args(kind) if get_origin(kind) in (list, tuple) else ()
    return tuple(argument for argument in arguments if argument is not Ellipsis)


def _choices(kind: Any) -> tuple[Any, ...]:
    found = [value for member in _members(kind) if get_origin(member) is Literal for value in get_args(member)]
    return tuple(sorted(found))


PLAIN = (  # the first that fits: a bool is an int, a datetime a date
    (bool, "true or false"),
    (int, "an integer"),
    (float, "a number"),
    (str, "a string"),
    ((dict, msgspec.Struct), "a table"),
    ((list, tuple), "a list"),
    (datetime, "a date and time"),
    (date, "a date"),
    (time, "a time"),
    (types.NoneType, "nothing"),
)


def _plain(kind: Any) -> str:
    """Return what a person calls values of a type."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _plain(get_args(kind)[0])
    if origin is Literal:
        return _plain(type(get_args(kind)[0]))
    return next((words for classes, words in PLAIN if issubclass(origin or kind, classes)), f"a {kind.__name__}")


def _bounded(kind: Any) -> str:
    """Return what a person calls values of a type, with the bounds it has."""
    words = _plain(kind)
    if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
        words += f" of {len(get_args(kind))}"
    for meta in get_args(kind)[1:] if get_origin(kind) is Annotated else ():
        bounds = [f"{text} {getattr(meta, name):g}" for name, text in BOUNDS.items() if getattr(meta, name) is not None]
        words += f"{' of' if bounds[0].startswith('at') else ''} {' and '.join(bounds)}" if bounds else ""
        words += " that is not empty" if meta.min_length else ""
    return words


# --- words -----------------------------------------------------------------------------------------


def _place(steps: Sequence[Step], at: str = "") -> str:
    """Write a path through tables and lists as a person would: ``controller.K_D[0][1]``."""
    name = at
    for step in steps:
        name += f"[{step}]" if isinstance(step, int) else f".{step}" if name else step
    return name


def _one_of(kinds: Sequence[str]) -> str:
    *others, last = dict.fromkeys(kinds)
    return f"{', '.join(others)} or {last}" if others else last


def _quoted(value: Any) -> str:
    """` = value` where that is short."""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return f" = {shown}" if isinstance(value, str | int | float | list) and len(shown) <= LONGEST else ""
