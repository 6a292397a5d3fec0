"""Argument validation shared by the public API: types, paths, tables, callables and flags.

Every function raises InputError with one sentence: ``function: argument: expected ..., got ...``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from inspect import signature
from os import PathLike, fsencode, fspath
from typing import Any

import numpy as np

from ckc_pin.errors import InputError

__all__ = [
    "MIN_SIMILARITY",
    "accepts_arguments",
    "describe_value",
    "find_near_names",
    "find_nearest_name",
    "is_array",
    "is_number",
    "match_names",
    "require_callable",
    "require_controller_signature",
    "require_flag",
    "require_path",
    "require_table",
    "require_type",
    "suggest_name",
]

SHORT_TYPES = (int, float, complex, str, bytes, type(None), np.generic)  # quoted in messages; others by their type
MAX_QUOTED = 80  # characters of a value in a message
VECTOR_AXES = ("x", "y", "z", "rx", "ry", "rz")
MIN_SIMILARITY = 0.65  # of an unknown name and a valid one, from 0 to 1, for "did you mean"


def describe_value(value: Any) -> str:
    """Return a value as messages quote it: numbers and strings as written, other objects by their type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, SHORT_TYPES):
        return f"{value!r:.{MAX_QUOTED}}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def require_type(value: Any, types: type | tuple[type, ...], where: str, expected: str) -> None:
    """Require that an argument is an instance of one of some types.

    Parameters
    ----------
    value : object
        The argument.
    types : type or tuple of types
    where : str
        Function and argument, such as ``"simulate: scene"``. The message begins with it.
    expected : str
        What would be right, such as ``"a mechanism's shipped name or its path"``.

    Raises
    ------
    InputError
        The argument has another type.
    """
    if not isinstance(value, types):
        raise InputError(f"{where}: expected {expected}, got {describe_value(value)}")


def require_path(value: Any, where: str, expected: str = "a path, as a string or a Path") -> None:
    """Require a string or Path without characters that no path can have. Raises as `require_type` does."""
    require_type(value, (str, PathLike), where, expected)
    try:
        is_valid = isinstance(fspath(value), str) and b"\0" not in fsencode(value)
    except UnicodeEncodeError:
        is_valid = False
    if not is_valid:
        raise InputError(f"{where}: expected {expected}, but {describe_value(fspath(value))} is not a valid path")


def require_table(value: Any, where: str, expected: str) -> None:
    """Require a mapping whose keys are strings. Raises as `require_type` does."""
    require_type(value, Mapping, where, expected)
    for key in value:
        require_type(key, str, f"{where}, a key", expected)


def accepts_arguments(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with `count` positional arguments."""
    try:
        signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # some built-in functions have no signature
        pass
    return True


def require_controller_signature(function: Callable[..., Any], name: str, where: str, count: int = 2) -> None:
    """Require a function that can be called with (t, terms), or with (t, terms, state) if `count` is 3.

    Raises
    ------
    InputError
        It takes other arguments.
    """
    if not accepts_arguments(function, count):
        parameters = ", ".join(signature(function).parameters)
        expected = "(t, terms, state)" if count == 3 else "(t, terms)"
        raise InputError(f"{where}: expected a function of {expected}, got {name}({parameters})")


def require_callable(value: Any, where: str, expected: str, count: int = 2) -> None:
    """Require None, or a function that can be called with `count` positional arguments.

    Raises
    ------
    InputError
        It is not callable, or takes other arguments.
    """
    if value is not None and not callable(value):
        raise InputError(f"{where}: expected {expected}, got {describe_value(value)}")
    if value is not None and not accepts_arguments(value, count):
        raise InputError(f"{where}: expected {expected}, got a function of other arguments")


def require_flag(value: Any, where: str) -> None:
    """Require True or False. Raises as `require_type` does."""
    require_type(value, (bool, np.bool_), where, "True or False")


def is_array(value: Any) -> bool:
    """Whether a value is a list, a tuple or an array with at least one axis."""
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def is_number(value: Any) -> bool:
    """Whether a value is a real number of Python or NumPy; True and False are not numbers."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def find_nearest_name(name: str, names: Iterable[str], min_similarity: float = 0.0) -> str | None:
    """Return the valid name that is most similar to an unknown one, regardless of case and underscores.

    Parameters
    ----------
    name : str
    names : iterable of str
        The valid names.
    min_similarity : float
        Between 0 and 1. The result is None if no name is so similar.
    """
    similarities = {other: _similarity(name, other) for other in names}
    best = max(similarities, key=similarities.__getitem__, default=None)
    return best if best is not None and similarities[best] >= min_similarity else None


def find_near_names(name: Any, names: Iterable[str], count: int) -> list[str]:
    """Return the valid names that are most similar to an unknown one, the most similar first."""
    from heapq import nlargest  # imported here because input without errors does not need it

    return nlargest(count, names, key=lambda other: _similarity(str(name), other))


def _similarity(name: str, other: str) -> float:
    from difflib import SequenceMatcher  # imported here because input without errors does not need it

    pairs = ((name, other), (_fold_case(name), _fold_case(other)))
    return max(SequenceMatcher(None, *pair).ratio() for pair in pairs)


def suggest_name(name: Any, names: Iterable[Any]) -> str:
    """Return the end of a message about an unknown name: the most similar valid name; empty if there is none."""
    nearest = find_nearest_name(str(name), [other for other in names if isinstance(other, str)])
    if nearest is None or not isinstance(name, str):
        return ""
    is_similar = find_nearest_name(name, [nearest], MIN_SIMILARITY) or nearest.endswith(f".{name}")
    return f"; did you mean {nearest!r}?" if is_similar else f"; the nearest is {nearest!r}"


def match_names(pattern: Any, names: Iterable[str], where: str) -> list[str]:
    """Return the names that a pattern with the wildcards ``*``, ``?`` and ``[...]`` stands for, in their order.

    The name of a vector stands for its components, which end in ``.x`` and so on.

    Raises
    ------
    InputError
        No name matches. The message lists vectors and numbers, with ``*`` in place of what carries them.
    """
    names = list(names)
    matches = [name for name in names if isinstance(pattern, str) and _matches(name, pattern)]
    if not matches:
        kinds = ", ".join(dict.fromkeys(_kind(name) for name in names)) or "none"
        raise InputError(f"{where}: nothing is called {pattern!r:.80}; there are {kinds}{suggest_name(pattern, names)}")
    return matches


def _matches(name: str, pattern: str) -> bool:
    vector, _, axis = name.rpartition(".")
    return fnmatchcase(name, pattern) or (axis in VECTOR_AXES and fnmatchcase(vector, pattern))


def _kind(name: str) -> str:
    root, _, rest = name.partition(".")
    key = rest.partition(".")[2]
    vector, _, axis = key.rpartition(".")
    key = vector if axis in VECTOR_AXES and vector else key
    return f"{root}.*.{key}" if key else name


def _fold_case(name: str) -> str:
    return name.casefold().replace("_", "").replace("-", "")
