"""Expand xacro files with the package `xacro`, which needs no ROS.

xacro evaluates Python expressions. Those of an untrusted file could reach Python's internals through attributes.
Attributes that begin with an underscore, names that begin with two, and those of frames and generators, are therefore
refused.
`$(find PACKAGE)` is a folder of the file's repository.
"""

from __future__ import annotations

import ast
import contextlib
import io
import re
from pathlib import Path
from typing import Any

from ckc_pin.errors import InputError
from ckc_pin.formats.repository import find_folder, repository_of

__all__ = ["expand_xacro", "is_xacro"]

INTERNAL = re.compile(r"_|(gi|f|cr|ag|tb|co|func)_|mro$|format(_map)?$")  # names that lead out of an expression


def is_xacro(path: Path, text: str) -> bool:
    """Whether a file has to be expanded by xacro."""
    return path.suffix == ".xacro" or "<xacro:" in text or "${" in text


def expand_xacro(path: Path) -> str:
    """Return the XML that a xacro file describes, with the default values of its arguments."""
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise InputError(
            f"{path}: reading xacro files needs xacro; install it with `pip install 'ckc_pin[xacro]'`, or expand the "
            "file first with `xacro FILE > robot.urdf`"
        ) from None
    root = repository_of(path.absolute().parent)
    evaluate = xacro.safe_eval

    def check_and_evaluate(expression: str, *scopes: Any) -> Any:
        for node in ast.walk(ast.parse(expression.strip(), mode="eval")):
            name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
            is_property = isinstance(node, ast.Name) and re.match(r"_(?!_)", name)
            if INTERNAL.match(name) and not is_property:
                raise InputError(f"{path}: the expression ${{{expression}}} uses {name!r}, which is not accepted")
        return evaluate(expression, *scopes)

    messages = io.StringIO()
    replaced: dict[tuple[Any, str], Any] = {
        (xacro, "safe_eval"): check_and_evaluate,
        (substitution_args, "_eval_find"): lambda package: str(find_folder(package, root, path)),
    }
    originals = {(module, name): getattr(module, name) for module, name in replaced}
    try:
        for (module, name), function in replaced.items():
            setattr(module, name, function)
        with contextlib.redirect_stderr(messages):
            return str(xacro.process_file(str(path)).toxml())
    except InputError:
        raise
    except Exception as error:  # xacro raises errors of any class for a malformed file
        if isinstance(refused := getattr(error, "exc", None), InputError):
            raise refused from None
        reason = " ".join(str(error).split()) or type(error).__name__
        if "Undefined substitution argument" in reason:
            reason += (
                f"; it has no default, so expand the file first with `xacro {path.name} ARGUMENT:=VALUE > robot.urdf`"
            )
        raise InputError(f"{path}: xacro cannot expand it: {reason}") from None
    finally:
        for (module, name), function in originals.items():
            setattr(module, name, function)
