"""Which coordinates to propose as q: what the file declares where it can serve, then the actuated joints."""

from __future__ import annotations

import numpy as np

from ckc_pin.errors import MechanismError
from ckc_pin.formats.draft import Draft
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import choose_dependent, rank_of

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
        names = _with_actuated(mechanism, draft.actuated)
        if names is None:
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


def _with_actuated(mechanism: Mechanism, actuated: list[str]) -> list[str] | None:
    """Return coordinates that can serve as q, every actuated joint among them; None if there are none."""
    jacobian = mechanism.freedoms.jacobian
    motors = [mechanism.tree.index[name] for name in actuated]
    rest = np.array([k for k in range(mechanism.n) if k not in motors], dtype=np.intp)
    if len(motors) > mechanism.d or rank_of(jacobian[:, rest]).rank < mechanism.rank:
        return None
    place = {int(k): position for position, k in enumerate(rest)}
    blocks = [np.array([place[v + k] for k in range(6)], dtype=np.intp) for _, v in mechanism.tree.free]
    dependent = choose_dependent(jacobian[:, rest], mechanism.rank, blocks)
    if dependent is None:
        return None
    chosen = set(rest.tolist()) - {int(rest[k]) for k in dependent}
    return [*actuated, *(mechanism.coordinates[k] for k in sorted(chosen))]
