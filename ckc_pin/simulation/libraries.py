"""Whose terms a run takes: those that are compiled for its mechanism, or Pinocchio's."""

from __future__ import annotations

from collections.abc import Sequence

from ckc_pin.generated.library import Library, compiled, find
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.native.variation import Varying, directions_of
from ckc_pin.simulation.scene_spec import TermsOf

__all__ = ["changing_library", "library_of"]


def library_of(mechanism: Mechanism, terms: TermsOf) -> Library | None:
    """Return compiled terms where they are asked for; "auto" takes those that are there, and never makes a run wait."""
    if terms == "pinocchio":
        return None
    return compiled(mechanism) if terms == "generated" else find(mechanism)


def changing_library(
    mechanism: Mechanism, terms: str, varying: Sequence[Varying]
) -> tuple[Library | None, Array | None]:
    """Return terms that say how they change with what varies, and the parameters in their numbers; or neither.

    What varies from zero has to be an argument too: that is a library of its own. Of angles there is none.
    """
    found = None if terms == "pinocchio" else directions_of(mechanism, varying)
    if found is None:
        return None, None
    which, directions = found
    library = (compiled if terms == "generated" else find)(mechanism, which=which, changes=True)
    return library, None if library is None else directions
