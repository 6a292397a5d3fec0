"""Write tables as TOML, and turn Python values and typed structures into tables."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

__all__ = ["LINE_WIDTH", "format_key", "format_value", "to_table", "to_toml_value", "write_toml"]

LINE_WIDTH = 116  # characters of a written file


def to_toml_value(value: Any) -> Any:
    """Return a Python value in the types that TOML has.

    NumPy scalars and arrays become numbers and lists, and structures become tables without their default values.
    """
    if isinstance(value, msgspec.Struct):
        return to_table(value)
    if isinstance(value, Mapping):
        return {key: to_toml_value(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [to_toml_value(inner) for inner in value]
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def to_table(spec: msgspec.Struct) -> dict[str, Any]:
    """Return the keys of a structure whose values differ from the defaults."""
    config, table = spec.__struct_config__, dict[str, Any]()
    if config.tag_field is not None:
        table[config.tag_field] = config.tag
    for field in msgspec.structs.fields(spec):
        value, factory = getattr(spec, field.name), field.default_factory
        if field.required or value != (field.default if factory is msgspec.NODEFAULT else factory()):
            table[field.encode_name] = to_toml_value(value)
    return table


def write_toml(data: Mapping[str, Any]) -> str:
    """Return TOML text of a table with strings, numbers, lists and tables. Numbers keep all their digits."""
    return "\n".join(_lines(data, "")).lstrip("\n") + "\n"


def _lines(table: Mapping[str, Any], path: str) -> Iterator[str]:
    """Yield the lines of a table: its values first, then its tables and lists of tables with their headers."""
    values, tables = dict[str, str](), dict[str, Any]()
    for key, value in table.items():
        line = f"{format_key(key)} = {format_value(value)}"
        is_table, is_list_of_tables = isinstance(value, Mapping), _is_list_of_tables(value)
        if (is_table and not path) or is_list_of_tables or (is_table and len(line) > LINE_WIDTH):
            tables[key] = value
        else:
            values[key] = line
    yield from values.values()
    for key, value in tables.items():
        name = f"{path}{format_key(key)}"
        if isinstance(value, Mapping):
            yield from ("", f"[{name}]", *_lines(value, f"{name}."))
        else:
            for entry in value:
                yield from ("", f"[[{name}]]", *(f"{format_key(k)} = {format_value(v)}" for k, v in entry.items()))


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, Sequence) and bool(value) and all(isinstance(entry, Mapping) for entry in value)


def format_value(value: Any) -> str:
    """Return a string, number, list or table as TOML in one line.

    Raises
    ------
    TypeError
        TOML has no such type.
    """
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float | int):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{format_key(key)} = {format_value(inner)}' for key, inner in value.items())}}}"
    raise TypeError(f"TOML has no type for {value!r:.80}")


def format_key(key: str) -> str:
    """Return a key as TOML, in quotes if it has other characters than letters, digits, _ and -."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else format_value(key)
