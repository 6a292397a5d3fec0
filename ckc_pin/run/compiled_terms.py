"""Select compiled or Pinocchio terms for a run."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.library import Library, compile_terms, find_compiled_terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.spec import TermsOf

__all__ = ["COMPILE_AFTER_RHS", "NEVER", "compile_during_run", "select_derivative_library", "select_library"]

# Generating and compiling a mechanism's terms costs about this many right-hand sides, whatever the mechanism, and up to
# 2.5 times as many for a single long branch (docs/theory/generated.md). A run that has done so many compiles its terms
# if at least half of its time remains.
COMPILE_AFTER_RHS = 2_000_000
NEVER = 2**62  # right-hand sides


def select_library(mechanism: Mechanism, terms: TermsOf) -> Library | None:
    """Return the compiled terms that a run starts with, or None for Pinocchio's.

    With "auto" these are terms compiled earlier; "auto" never makes a run wait for the compiler.
    """
    if terms == "pinocchio":
        return None
    return compile_terms(mechanism) if terms == "generated" else find_compiled_terms(mechanism)


def select_derivative_library(
    mechanism: Mechanism, terms: TermsOf, arguments: Mapping[str, BoolArray] | None
) -> Library | None:
    """Return compiled terms that have parameter derivatives, or None for Pinocchio's.

    Parameters
    ----------
    arguments : mapping or None
        Numbers of the mechanism that have to be arguments of the library, by name of the array. A number that is zero
        is no argument of the usual library. None: some parameter cannot be an argument.
    """
    if arguments is None or terms == "pinocchio":
        return None
    return (compile_terms if terms == "generated" else find_compiled_terms)(
        mechanism, arguments, directional_derivatives=True
    )


def compile_during_run(mechanism: Mechanism, loop: Any, missing_arguments: Mapping[str, BoolArray] | None) -> None:
    """Compile a mechanism's terms and give them to a loop that has started with Pinocchio's.

    The loop keeps Pinocchio's terms if there is no compiler or CasADi, or if there are too many coordinates.

    Parameters
    ----------
    missing_arguments : mapping or None
        Arguments that the library needs for parameter derivatives, as of `select_derivative_library`.
    """
    with suppress(InputError):
        library = compile_terms(mechanism, missing_arguments, directional_derivatives=missing_arguments is not None)
        loop.use_compiled_terms((library.path, library.parameters))
