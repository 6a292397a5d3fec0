"""Names of C from names of a mechanism, and numbers and comments as C text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

__all__ = ["comment", "identifiers", "initializer", "table"]

NUMBERS_A_LINE = 6


def identifiers(names: Iterable[str]) -> list[str]:
    """Return names with the letters, digits and underscores that C allows, all different."""
    used, result = set[str](), list[str]()
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_]", "_", name)
        identifier, count = base, 1
        while identifier in used:
            count += 1
            identifier = f"{base}_{count}"
        used.add(identifier)
        result.append(identifier)
    return result


def comment(text: str) -> str:
    """Return a text as it can stand inside a comment of C."""
    text = re.sub(r"\s+", " ", text).replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
    return text.encode("ascii", "backslashreplace").decode().rstrip("\\")


def initializer(values: Iterable[Any]) -> str:
    """Return numbers as an initializer of C, at least one number, with all their digits."""
    texts = [_number(x) for x in values] or ["0"]
    lines = [", ".join(texts[k : k + NUMBERS_A_LINE]) for k in range(0, len(texts), NUMBERS_A_LINE)]
    return "{" + ",\n    ".join(lines) + "}"


def table(kind: str, name: str, values: Sequence[Any], columns: int = 0) -> str:
    """Return a constant static array of C; of pairs if `columns` is two."""
    if columns:
        rows = ", ".join(initializer(row) for row in values) or initializer([0] * columns)
        return f"static const {kind} {name}[][{columns}] = {{{rows}}};"
    return f"static const {kind} {name}[] = {initializer(values)};"


def _number(x: Any) -> str:
    if isinstance(x, int):
        return str(x)
    number = float(x)
    infinite = {float("inf"): "HUGE_VAL", float("-inf"): "-HUGE_VAL"}
    return infinite.get(number) or repr(number)
