"""What public functions say of an argument of the wrong kind: once, at their door, with what they take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from os import PathLike, fsencode, fspath
from typing import Any

import numpy as np

from ckc_pin.errors import InputError

__all__ = [
    "accepts_arguments",
    "describe_value",
    "is_number",
    "require_callable",
    "require_controller_signature",
    "require_flag",
    "require_path",
    "require_table",
    "require_type",
]

PLAIN = (int, float, complex, str, bytes, type(None), np.generic)  # shown as they are; of the rest their kind
MOST = 80  # characters of a value that is shown


def describe_value(given: Any) -> str:
    """Say what was given: a plain value as it is written, of anything else what it is."""
    if isinstance(given, type):
        return f"the class {given.__name__}"
    if isinstance(given, PLAIN):
        return f"{given!r:.{MOST}}"
    kind = type(given).__name__
    return f"{'an' if kind[0] in 'AEIOUaeiou' else 'a'} {kind}"


def require_type(given: Any, kinds: type | tuple[type, ...], what: str, takes: str) -> None:
    """Refuse an argument that is of none of some kinds.

    Parameters
    ----------
    given
        The argument.
    kinds : type or tuple of types
    what : str
        The function and its argument, as ``"simulate: scene"``.
    takes : str
        What would be right.

    Raises
    ------
    InputError
        ``what``, what was given, what it takes.
    """
    if not isinstance(given, kinds):
        raise InputError(f"{what}: {describe_value(given)} was given; it takes {takes}")


def require_path(given: Any, what: str, takes: str = "a path, as a string or a Path") -> None:
    """Refuse what is no path, or has characters that no path can have; errors are those of `require_type`."""
    require_type(given, (str, PathLike), what, takes)
    try:
        possible = isinstance(fspath(given), str) and b"\0" not in fsencode(given)
    except UnicodeEncodeError:
        possible = False
    if not possible:
        raise InputError(f"{what}: {describe_value(fspath(given))} is not a valid path; it takes {takes}")


def require_table(given: Any, what: str, takes: str) -> None:
    """Refuse what is no table, and one with keys that are no names; errors are those of `require_type`."""
    require_type(given, Mapping, what, takes)
    for key in given:
        require_type(key, str, f"{what}, a key", takes)


def accepts_arguments(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments."""
    try:
        signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # of some builtins it is not known
        pass
    return True


def require_controller_signature(function: Callable[..., Any], called: str, what: str) -> None:
    """Refuse a function that cannot be called with (t, terms).

    Raises
    ------
    InputError
        What it takes.
    """
    if not accepts_arguments(function, 2):
        raise InputError(
            f"{what}: {called}({', '.join(signature(function).parameters)}) was given; it must take (t, terms)"
        )


def require_callable(given: Any, what: str, takes: str, count: int = 2) -> None:
    """Refuse what cannot be called with so many arguments and is not absent.

    Raises
    ------
    InputError
        What it takes.
    """
    if given is not None and not callable(given):
        raise InputError(f"{what}: {describe_value(given)} was given; it takes {takes}")
    if given is not None and not accepts_arguments(given, count):
        raise InputError(f"{what}: a function of other arguments was given; it takes {takes}")


def require_flag(given: Any, what: str) -> None:
    """Refuse what is neither True nor False; errors are those of `require_type`."""
    require_type(given, (bool, np.bool_), what, "True or False")


def is_number(given: Any) -> bool:
    """Whether something is a real number, Python's or NumPy's; True and False are none."""
    return isinstance(given, int | float | np.integer | np.floating) and not isinstance(given, bool)
