"""What a person types on a command line: KEY=VALUE for a scene, a table of numbers by coordinate."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from ckc_pin.errors import InputError

__all__ = ["read_overrides", "read_table"]


def read_overrides(option: str, settings: Iterable[str]) -> dict[str, Any]:
    """Read KEY=VALUE settings; a value is TOML where it can be, else a plain string.

    Raises
    ------
    InputError
        No `=`, or an empty part in the key.
    """
    overrides: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not all(part.strip() for part in key.split(".")):
            raise InputError(f"{option} {setting}: write KEY=VALUE, e.g. solver.rtol=1e-10")
        overrides[key.strip()] = _value(text)
    return overrides


def _value(text: str) -> Any:
    """Read TOML, or a number that TOML would write otherwise (.1, 5., 1.e-3), else take the text as it is."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        pass
    with suppress(ValueError):
        if any(character.isdigit() for character in text):  # not Infinity, not NaN
            return float(text)
    return text


def read_table(option: str, text: str) -> dict[str, float]:
    """Read a JSON table of numbers by coordinate.

    Raises
    ------
    InputError
        Not JSON, not a table, a name that is given twice, not a number.
    """
    example = f"write a table by coordinate, e.g. {option} '{{\"theta_1\": 0.4}}'"
    twice: list[str] = []

    def table_of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        twice.extend(name for k, name in enumerate(names) if name in names[:k])
        return dict(pairs)

    try:
        table = json.loads(text, object_pairs_hook=table_of)
    except (ValueError, RecursionError):
        raise InputError(f"{option} {text[:80]}: not JSON; {example}") from None
    if not isinstance(table, dict):
        raise InputError(f"{option} {text[:80]}: not a table; {example}")
    if twice:
        raise InputError(f"{option}: {twice[0]} is given twice")
    for name, value in table.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) <= sys.float_info.max:
            raise InputError(f"{option}: {name} = {json.dumps(value)[:80]}: expected a finite number")
    return table
