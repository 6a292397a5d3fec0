"""Overrides of a scene's values by dotted key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

from ckc_pin.base.toml import FileStruct, find_faults, join_dotted_keys
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import MIN_SIMILARITY, find_nearest_name, suggest_name
from ckc_pin.errors import InputError
from ckc_pin.mechanism.parameters import ROOTS, is_parameter
from ckc_pin.scene.spec import SceneSpec

__all__ = ["EXPECTED_OVERRIDES", "apply_overrides", "join_names"]

TABLES_BY_NAME = (("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("parameters",))  # keys contain dots
TablesByName = Sequence[tuple[str, ...]]
EXPECTED_OVERRIDES = 'a table of values by dotted key, as {"solver.rtol": 1e-10}'


def join_names(data: dict[str, Any]) -> None:
    """Join nested tables into names with dots, in place, in all tables of a scene whose keys are such names."""
    for path in TABLES_BY_NAME:
        join_dotted_keys(data, *path)


def apply_overrides(
    data: dict[str, Any],
    overrides: Mapping[str, Any],
    spec: type[FileStruct] = SceneSpec,
    tables_by_name: TablesByName = TABLES_BY_NAME,
    file: str = "scene",
) -> dict[str, Any]:
    """Return a copy of a file's data with values replaced by dotted key; None removes a key.

    The name of a mechanism parameter, as ``link.rod.mass``, stands for its entry in the table ``parameters``. Names of
    parameters and coordinates may contain dots.

    Parameters
    ----------
    data : dict
        Parsed TOML.
    overrides : mapping
    spec : type
        Structure of the file.
    tables_by_name : sequence of tuples
        Tables whose keys are names with dots.
    file : str
        Kind of file, for messages.
    """
    result = deepcopy(data)
    for path in tables_by_name:
        join_dotted_keys(result, *path)
    for key, value in overrides.items():
        _check_root(key, spec, file)
        *tables, last = _split_key(f"parameters.{key}" if is_parameter(key) else key, tables_by_name)
        if value is None:
            _remove_key(result, key, tables, last, spec, tables_by_name, file)
            continue
        target = result
        for k, table in enumerate(tables):
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise InputError(f"{key}: {'.'.join(tables[: k + 1])} is a value, not a table")
        target[last] = to_toml_value(value)
    return result


def _remove_key(
    data: dict[str, Any], key: str, tables: list[str], last: str, spec: type[FileStruct], tables_by_name: TablesByName,
    file: str,
) -> None:  # fmt: skip
    """Remove a key from a file's data, in place. A key that a file may have and this one has not is no error.

    Raises
    ------
    InputError
        No such file has this key, or the file's table of names has no such entry.
    """
    target: Any = data
    for table in tables:
        target = target.get(table) if isinstance(target, dict) else None
    if isinstance(target, dict) and last in target:
        del target[last]
        return
    where = ".".join(tables)
    if tuple(tables) in tables_by_name:
        names = ", ".join(target or {}) or "nothing"
        raise InputError(
            f"{key}: the {file} has no such entry to remove; {where} has {names}{suggest_name(last, target or {})}"
        )
    probe: dict[str, Any] = deepcopy(data)
    inner = probe
    for table in tables:
        inner[table] = inner.get(table) if isinstance(inner.get(table), dict) else {}
        inner = inner[table]
    inner[last] = None
    for fault in find_faults(probe, spec):
        *path, name = [*fault.path, fault.value]
        if fault.kind == "unknown key" and [*tables, last][: len(path) + 1] == [*path, name]:
            raise InputError(f"{key}: {_with_article(file)} has no such key to remove: {fault.sentence()}")


def _check_root(key: str, spec: type[FileStruct], file: str) -> None:
    """Raise InputError if a key begins almost like the name of a mechanism parameter, and not like a file's key."""
    root, keys = key.partition(".")[0], spec.__struct_fields__
    if root in keys or is_parameter(key):
        return
    nearest = find_nearest_name(root, [*keys, *ROOTS], MIN_SIMILARITY)
    if nearest in ROOTS:
        raise InputError(
            f"{key}: neither a key of {_with_article(file)} nor a parameter of a mechanism, which begins with "
            f"{', '.join(ROOTS)}{suggest_name(key, [nearest + key.removeprefix(root)])}"
        )


def _with_article(file: str) -> str:
    return f"{'an' if file[0] in 'aeiou' else 'a'} {file}"


def _split_key(key: str, tables_by_name: TablesByName) -> list[str]:
    """Split a dotted key into tables and key. Names in tables by name keep their dots."""
    for path in tables_by_name:
        start = ".".join([*path, ""])
        if key.startswith(start):
            return [*path, key.removeprefix(start)]
    return key.split(".")
