"""Whose terms a run takes: those that are compiled for its mechanism, or Pinocchio's."""

from __future__ import annotations

from collections.abc import Mapping

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.library import Library, compile_terms, find_compiled_terms
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.spec import TermsOf

__all__ = ["changing_library", "library_of"]


def library_of(mechanism: Mechanism, terms: TermsOf) -> Library | None:
    """Return compiled terms where they are asked for; "auto" takes those that are there, and never makes a run wait."""
    if terms == "pinocchio":
        return None
    return compile_terms(mechanism) if terms == "generated" else find_compiled_terms(mechanism)


def changing_library(mechanism: Mechanism, terms: TermsOf, which: Mapping[str, BoolArray] | None) -> Library | None:
    """Return terms that say how they change with numbers; None where there are none, or those are no arguments.

    What varies from zero has to be an argument too: that is a library of its own.
    """
    if which is None or terms == "pinocchio":
        return None
    return (compile_terms if terms == "generated" else find_compiled_terms)(mechanism, which, changes=True)
