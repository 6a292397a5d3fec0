"""Generate the pages of the reference of keys from the same source as `ckc keys`."""

from __future__ import annotations

import re
from collections.abc import Iterator

from ckc_pin.base.key_reference import KeyTable
from ckc_pin.cli.key_tables import tables

__all__ = ["markdown"]


def markdown(file: str) -> str:
    """Return the reference of a file, in MyST."""
    return "\n".join(line for table in tables(file) for line in _table(file, table))


def _table(file: str, table: KeyTable) -> Iterator[str]:
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
