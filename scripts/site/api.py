"""API reference from docstrings by autodoc: functions first, then classes, then errors."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import ckc_pin

__all__ = ["markdown", "members_of", "names", "undocumented"]


def names() -> dict[str, list[str]]:
    """Return ``ckc_pin.__all__`` by kind."""
    by_kind: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": []}
    for name in ckc_pin.__all__:
        value = getattr(ckc_pin, name)
        kind = "Functions" if not inspect.isclass(value) else "Errors" if issubclass(value, Exception) else "Classes"
        by_kind[kind].append(name)
    return by_kind


def markdown() -> str:
    """Return a section for each name, in MyST."""
    lines: list[str] = []
    for kind, members in names().items():
        lines += [f"## {kind}", ""]
        for name in members:
            lines += [f"### `{name}`", "", "```{eval-rst}", *_directive(kind, name), "```", ""]
    return "\n".join(lines)


def _directive(kind: str, name: str) -> Iterator[str]:
    if kind == "Functions":
        yield f".. autofunction:: ckc_pin.{name}"
    elif kind == "Errors":
        yield f".. autoexception:: ckc_pin.{name}"
    else:
        yield from (f".. autoclass:: ckc_pin.{name}", "   :members:")


def undocumented() -> list[str]:
    """Return public names, and public members of classes, without a docstring."""
    missing = []
    for name in ckc_pin.__all__:
        value = getattr(ckc_pin, name)
        missing += [name] if not inspect.getdoc(value) else []
        missing += [f"{name}.{member}" for member, of in members_of(value) if not inspect.getdoc(of)]
    return missing


def members_of(value: Any) -> Iterator[tuple[str, Any]]:
    """Return the public methods and properties of a class, in the order of their definition."""
    if inspect.isclass(value):
        for member, of in vars(value).items():
            if not member.startswith("_") and (
                callable(of) or isinstance(of, property | cached_property | classmethod)
            ):
                yield member, of
