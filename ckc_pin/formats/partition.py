"""Which coordinates to propose as q: what the file declares where it can serve, then the actuated joints."""

from __future__ import annotations

from ckc_pin.errors import MechanismError
from ckc_pin.formats.draft import Draft
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["settle_independent"]


def settle_independent(draft: Draft) -> None:
    """Keep a declared `independent` if it can serve; without one, propose the actuated joints as part of q.

    A mechanism that does not close is left as it is: whoever corrects its loops needs what the file said.
    """
    if draft.independent is not None:
        declared = draft.independent
        try:
            draft.mechanism()
            return
        except MechanismError as refused:
            draft.independent = None
            mechanism = _built(draft)
            if mechanism is None:
                draft.independent = declared
                return
            reason = str(refused).removeprefix(f"{draft.name}: ").removeprefix("independent: ")
            draft.guessed.append(f"independent is chosen by the program: the file's cannot serve, {reason}")
    elif draft.actuated and (draft.loops or draft.couplings):
        mechanism = _built(draft)
        if mechanism is None:
            return
        names = list(mechanism.independent)
        if not set(draft.actuated) <= set(names):
            return
        draft.independent = names
        more = [name for name in names if name not in draft.actuated]
        draft.why_independent = "the actuated joints" + (f", and chosen: {', '.join(more)}" if more else "")
        if _built(draft) is None:
            draft.independent, draft.why_independent = None, ""


def _built(draft: Draft) -> Mechanism | None:
    try:
        return draft.mechanism()
    except MechanismError:
        return None
