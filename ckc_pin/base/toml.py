"""Read TOML files into typed structures, with messages that name every error, its place and the valid choices.

msgspec decides whether a value fits a type. It reports the first error only, so when a conversion fails this module
walks through data and types together and collects all errors. A file without errors costs nothing extra.
"""

from __future__ import annotations

import math
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from datetime import date, datetime, time
from pathlib import Path
from stat import S_ISREG
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from ckc_pin.base.validation import MIN_SIMILARITY, find_nearest_name, suggest_name
from ckc_pin.errors import InputError

__all__ = [
    "Fault",
    "FileStruct",
    "convert",
    "describe_type",
    "find_faults",
    "find_invalid_numbers",
    "join_dotted_keys",
    "read_text",
    "read_toml",
]

T = TypeVar("T")
Step = str | int  # a key of a table, or the index of a list's entry

MAX_BYTES = 16 * 2**20  # of a text file; no mechanism, scene or URDF that a person wrote is larger
MAX_DEPTH = 50  # nested tables and lists; tomllib accepts any depth of dotted keys, the code that follows recurses
MAX_FAULTS = 5  # reported for one file
MAX_QUOTED = 60  # characters of a value in a message
INTEGERS = range(-(2**63), 2**63)  # the range of TOML
TOO_LARGE = "an integer of at most 64 bits, or a number such as 1e20"
CONVERTIBLE = {"an integer": ["a number"]}  # by the type of a value: other types that it may stand for
BOUNDS = {"ge": "at least", "gt": "greater than", "le": "at most", "lt": "less than"}
TYPE_NAMES = (  # the first match counts: a bool is an int, a datetime is a date
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


class FileStruct(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of the structures that describe tables of files: immutable, and unknown keys are errors."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Copy mutable fields; share the immutable ones."""
        fields = ((name, getattr(self, name)) for name in self.__struct_fields__)
        copied = {name: twin for name, value in fields if (twin := deepcopy(value, memo)) is not value}
        return msgspec.structs.replace(self, **copied) if copied else self


# --- reading -------------------------------------------------------------------------------------


def read_text(path: Path, what: str) -> str:
    """Read a UTF-8 text file, with or without a byte order mark.

    Parameters
    ----------
    path : Path
    what : str
        What the file is, for messages, such as ``"scene"``.

    Raises
    ------
    InputError
        The file is missing, not a regular file, too large or not UTF-8.
    """
    try:
        status = path.stat()
        if not S_ISREG(status.st_mode):
            raise InputError(f"{path}: a folder or a device, not a {what}")
        if status.st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES // 2**20} MiB, the maximum size of a {what}")
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
        raise InputError(f"{str(path)!r}: not a valid file name: {error}") from None  # it contains a NUL character


def read_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML. InputError names the source and the line."""
    try:
        data = tomllib.loads(text)
        if _is_deeper_than(MAX_DEPTH, data):
            raise RecursionError
        return data
    except RecursionError:
        raise InputError(f"{source}: malformed TOML: nested too deeply") from None
    except ValueError as error:  # a TOMLDecodeError, or an integer with thousands of digits
        hint = "; this is XML: a URDF is named in a mechanism.toml" if text.lstrip().startswith("<") else ""
        raise InputError(f"{source}: malformed TOML: {error}{hint}") from None


def _is_deeper_than(depth: int, data: Any) -> bool:
    level = [data]
    for _ in range(depth):
        level = [x for v in level if isinstance(v, dict | list) for x in (v.values() if isinstance(v, dict) else v)]
    return bool(level)


def convert(data: Any, kind: type[T], source: str, at: str = "") -> T:
    """Convert parsed data to a msgspec structure, and check them.

    Parameters
    ----------
    data : object
    kind : type
        A msgspec structure.
    source : str
        Name of the file, for messages.
    at : str
        Key of the table that the data are, if they are not the whole file.

    Raises
    ------
    InputError
        Unknown keys, wrong types, missing keys and numbers that are not finite: all of them in one message.
    """
    faults: list[Fault] = []
    try:
        converted = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        faults = [*find_faults(data, kind)]
        if not faults:
            raise InputError(f"{source}: {at and f'{at}: '}{error}") from None  # keys that are not strings
    reported = {fault.path for fault in faults}
    faults += [fault for fault in find_invalid_numbers(data) if fault.path not in reported]
    if faults:
        raise InputError(f"{source}: {_number_sentences([fault.sentence(at) for fault in faults])}")
    return converted


def _number_sentences(sentences: list[str]) -> str:
    """Join sentences in one line, numbered if there are several."""
    if len(sentences) == 1:
        return sentences[0]
    text = " ".join(f"({k}) {sentence}" for k, sentence in enumerate(sentences[:MAX_FAULTS], 1))
    return text + (f" and {len(sentences) - MAX_FAULTS} more" if len(sentences) > MAX_FAULTS else "")


def join_dotted_keys(data: dict[str, Any], *path: str) -> None:
    """Join nested tables into dotted keys, in place: {root: {z: 1}}, TOML's ``root.z = 1``, becomes {"root.z": 1}.

    Parameters
    ----------
    data : dict
        Parsed TOML.
    *path : str
        Keys that lead to the table. If it does not exist, the data stay as they are.
    """
    *parents, last = path
    table: Any = data
    for key in parents:
        table = table.get(key) if isinstance(table, dict) else None
    if isinstance(table, dict) and isinstance(table.get(last), dict):
        table[last] = dict(_flatten("", table[last]))


def _flatten(prefix: str, table: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value


# --- errors in data ------------------------------------------------------------------------------


class Fault(msgspec.Struct, frozen=True):
    """One error in the data of a file.

    Attributes
    ----------
    path : tuple
        Keys and list indices that lead to the value, outermost first. For an unknown or missing key: to its table.
    kind : {"unknown key", "missing key", "value"}
    value : object
        The value; for a key, its name.
    expected : str
        What would be right, unless `choices` says so.
    got : str
        Type or length of the value, if that is wrong.
    choices : tuple
        The valid keys or values, if there are few.
    suggestion : str or None
        The most similar valid choice.
    """

    path: tuple[Step, ...]
    kind: Literal["unknown key", "missing key", "value"]
    value: Any
    expected: str = ""
    got: str = ""
    choices: tuple[Any, ...] = ()
    suggestion: str | None = None

    def sentence(self, at: str = "") -> str:
        """Return the message; `at` is the place of the data in their file."""
        place = _format_path(self.path, at)
        if self.kind == "value":
            head, choices = f"{place}{_quote(self.value)}", map(repr, self.choices)
        elif self.kind == "unknown key":
            head, choices = f"{place and f'{place}: '}unknown key {self.value!r}", map(str, self.choices)
        else:
            head, choices = f"{place and f'{place}: '}the key {self.value!r} is missing", map(repr, self.choices)
        expected = f": expected {self.expected}" if self.expected else ""
        expected += f", got {self.got}" if self.got else ""
        valid = f"; valid: {', '.join(choices)}" if self.choices else ""
        nearest = "" if self.suggestion is None else suggest_name(self.value, [self.suggestion])
        return f"{head}{expected}{valid}{nearest}"


def find_faults(data: Any, kind: Any, path: tuple[Step, ...] = ()) -> Iterator[Fault]:
    """Find all errors of data against a type.

    Parameters
    ----------
    data : object
        Tables, lists, strings and numbers, as a TOML file contains them.
    kind : type
        A msgspec structure or another type that msgspec converts to.
    path : tuple
        Keys and list indices that lead to the data.
    """
    if _fits(data, kind):
        return
    structs = [member for member in _members(kind) if _is_struct(member)]
    others = [member for member in _members(kind) if not _is_struct(member)]
    mapping = next((member for member in others if get_origin(member) is dict), None)
    items = next((types_ for types_ in map(_item_types, others) if types_), None)
    if isinstance(data, Mapping) and structs:
        yield from _faults_of_table(data, structs, path)
    elif isinstance(data, Mapping) and mapping is not None:
        for key, value in data.items():
            yield from find_faults(value, get_args(mapping)[1], (*path, key))
    elif isinstance(data, list | tuple) and data and items and len(items) in (1, len(data)):
        yield from _faults_of_list(data, items, path)
    else:
        has_fixed_length = items and len(items) > 1 and isinstance(data, list | tuple)
        yield _fault_of_value(data, kind, len(items) if items and has_fixed_length else None, path)


def find_invalid_numbers(data: Any, path: tuple[Step, ...] = ()) -> Iterator[Fault]:
    """Find numbers that TOML allows and no quantity can have: nan, inf, and integers of more than 64 bits."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            yield from find_invalid_numbers(value, (*path, key))
    elif isinstance(data, list | tuple):
        for k, value in enumerate(data):
            yield from find_invalid_numbers(value, (*path, k))
    elif isinstance(data, int) and data not in INTEGERS:
        yield Fault(path, "value", data, TOO_LARGE)
    elif isinstance(data, float) and not math.isfinite(data):
        yield Fault(path, "value", data, "a finite number")


def _faults_of_table(data: Mapping[Any, Any], structs: Sequence[Any], path: tuple[Step, ...]) -> Iterator[Fault]:
    tag_key = structs[0].__struct_config__.tag_field
    if tag_key is not None:
        tags = {struct.__struct_config__.tag: struct for struct in structs}
        if tag_key not in data:
            yield Fault(path, "missing key", tag_key, choices=tuple(tags))
            return
        if not isinstance(data[tag_key], str) or data[tag_key] not in tags:
            suggestion = _find_nearest(data[tag_key], tags)
            yield Fault((*path, tag_key), "value", data[tag_key], choices=tuple(tags), suggestion=suggestion)
            return
        structs = [tags[data[tag_key]]]
    fields = {field.encode_name: field for field in msgspec.structs.fields(structs[0])}
    keys = (*([tag_key] if tag_key else []), *fields)
    misspelled: set[str | None] = set()
    for key in data:
        if key not in keys and structs[0].__struct_config__.forbid_unknown_fields:
            name = str(key)
            nearest = find_nearest_name(name, [k for k in keys if k not in data], MIN_SIMILARITY)
            misspelled.add(nearest)
            of_table = next((f"{k}.{name}" for k, field in fields.items() if name in _keys_of_tables(field.type)), None)
            suggestion = nearest or of_table or _find_nearest(name, keys)
            yield Fault(path, "unknown key", key, choices=keys, suggestion=suggestion)
    for key, field in fields.items():
        if key in data:
            yield from find_faults(data[key], field.type, (*path, key))
        elif field.required and key not in misspelled:
            yield Fault(path, "missing key", key, choices=_choices(field.type))


def _find_nearest(value: Any, choices: Iterable[Any]) -> str | None:
    """Return the choice most similar to a value; None if one of them is no string."""
    names = [choice for choice in choices if isinstance(choice, str)]
    return find_nearest_name(value, names) if isinstance(value, str) else None


def _keys_of_tables(kind: Any) -> set[str]:
    """Return the keys of the tables that a key's value may be."""
    structs = [member for member in _members(kind) if _is_struct(member)]
    return {field.encode_name for struct in structs for field in msgspec.structs.fields(struct)}


def _faults_of_list(data: Sequence[Any], items: Sequence[Any], path: tuple[Step, ...]) -> Iterator[Fault]:
    """Find the errors of a list's entries. Of several entries that are wrong in the same way, report the first."""
    reported = set()
    for k, value in enumerate(data):
        for fault in find_faults(value, items[k % len(items)], (*path, k)):
            is_whole_entry = fault.kind == "value" and fault.path == (*path, k)
            reason = (fault.expected, fault.got, fault.choices)
            if not (is_whole_entry and reason in reported):
                yield fault
            if is_whole_entry:
                reported.add(reason)


def _fault_of_value(value: Any, kind: Any, length: int | None, path: tuple[Step, ...]) -> Fault:
    """Return the error of a value that does not fit its type as a whole."""
    value_type = _type_name(type(value))
    if isinstance(value, int) and value not in INTEGERS:
        return Fault(path, "value", value, TOO_LARGE)
    if length is not None:
        return Fault(path, "value", value, f"a list of {length}", f"a list of {len(value)}")
    accepted = (value_type, *CONVERTIBLE.get(value_type, ()))
    same_type = [member for member in _members(kind) if _type_name(member) in accepted]
    if not same_type:
        return Fault(path, "value", value, _join_or([_type_name(member) for member in _members(kind)]), value_type)
    choices = _choices(kind)
    if choices:
        return Fault(path, "value", value, choices=choices, suggestion=_find_nearest(value, choices))
    return Fault(path, "value", value, _join_or(map(_bounded_type_name, same_type)))


# --- types ---------------------------------------------------------------------------------------


def describe_type(kind: Any) -> str:
    """Return a type in words: ``a number greater than 0``, ``a string or a table``."""
    return _join_or([_bounded_type_name(member) for member in _members(kind)])


def _fits(value: Any, kind: Any) -> bool:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True


def _members(kind: Any) -> list[Any]:
    """Return the members of a union except None; for another type, the type itself."""
    is_union = get_origin(kind) in (Union, types.UnionType)
    return [member for member in get_args(kind) if member is not types.NoneType] if is_union else [kind]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _item_types(kind: Any) -> tuple[Any, ...]:
    """Return the types of a list's entries: one for all, or one for each; empty if the type is not a list."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    arguments = get_args(kind) if get_origin(kind) in (list, tuple) else ()
    return tuple(argument for argument in arguments if argument is not Ellipsis)


def _choices(kind: Any) -> tuple[Any, ...]:
    return tuple(sorted(x for member in _members(kind) if get_origin(member) is Literal for x in get_args(member)))


def _type_name(kind: Any) -> str:
    """Return the name of a type as a user of TOML knows it."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _type_name(get_args(kind)[0])
    if origin is Literal:
        return _type_name(type(get_args(kind)[0]))
    return next((name for classes, name in TYPE_NAMES if issubclass(origin or kind, classes)), f"a {kind.__name__}")


def _bounded_type_name(kind: Any) -> str:
    """Return the name of a type with its bounds: ``a number of at least 0``."""
    name = _type_name(kind)
    if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
        name += f" of {len(get_args(kind))}"
    for meta in get_args(kind)[1:] if get_origin(kind) is Annotated else ():
        bounds = [f"{text} {getattr(meta, key):g}" for key, text in BOUNDS.items() if getattr(meta, key) is not None]
        name += f"{' of' if bounds[0].startswith('at') else ''} {' and '.join(bounds)}" if bounds else ""
        name += " that is not empty" if meta.min_length else ""
    return name


# --- formatting ----------------------------------------------------------------------------------


def _format_path(path: Sequence[Step], at: str = "") -> str:
    """Return keys and indices as in Python: ``controller.K_D[0][1]``."""
    text = at
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def _join_or(names: Iterator[str] | Sequence[str]) -> str:
    *others, last = dict.fromkeys(names)
    return f"{', '.join(others)} or {last}" if others else last


def _quote(value: Any) -> str:
    """Return `` = value`` if it is short."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return f" = {text}" if isinstance(value, str | int | float | list) and len(text) <= MAX_QUOTED else ""
