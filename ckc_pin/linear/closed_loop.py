"""Controllers in the loop, linearized exactly: what u depends on, and what that makes of the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.control import actuation_table, law_table
from ckc_pin.native.plant import NONE, Plant
from ckc_pin.native.tables import core_table

__all__ = ["ClosedLoop", "Feedback"]

UNKNOWN = "q is no chart or has coordinates of a free root, or motors that share u are at their limits"


@dataclass(frozen=True)
class Feedback:
    """A controller about one state: x_dot = A x + B u, u = K x with x the deviations that the states of A are.

    Attributes
    ----------
    A : (2 d, 2 d) array
    B : (2 d, m) array
    K : (m, 2 d) array
        Of the independent coordinates, and where motors are at their limits of all joints that they turn.
    """

    A: Array
    B: Array
    K: Array

    @property
    def closed(self) -> Array:
        """A of the closed loop, (2 d, 2 d)."""
        return self.A + self.B @ self.K


class ClosedLoop:
    """A mechanism under eq. 14 or eq. 16, to be linearized at states of it.

    Parameters
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
    smoothing : float, optional
        A scene's friction_smoothing.
    library : Library, optional
        The mechanism's terms, compiled.
    actuation : Actuation, optional
        Motors with limits; absent, u acts as the controller asks for it.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        law: SetPoint | Tracking,
        smoothing: float | None = None,
        library: Library | None = None,
        actuation: Actuation | None = None,
    ) -> None:
        self._plant = Plant(mechanism, smoothing, library)
        self._table = core_table(mechanism, library)
        self._acts = _as_asked(mechanism) if actuation is None else actuation_table(actuation)
        self.law = law

    @property
    def law(self) -> SetPoint | Tracking:
        """The controller, which may be changed for another one."""
        return self._law

    @law.setter
    def law(self, law: SetPoint | Tracking) -> None:
        self._law = law
        self._native = _core.Feedback(self._table, self._acts | {"law": law_table(law)})

    def at(self, t: float, terms: Terms, u_tree: Array | float = 0.0, locked: IntArray = NONE) -> Feedback:
        """Linearize plant and controller.

        Parameters
        ----------
        terms : Terms
            At v' = rho q_dot.
        u_tree : (n,) array, optional
            Other forces that do not change with the state, as of joints that slide.
        locked : int array, optional
            Coordinates of joints that stick or touch.

        Raises
        ------
        NumericalError
            J has lost rank, the controller has no u there, or it is not known how motors at their limits share it.
        """
        mechanism, found = self._plant.mechanism, self._native.at(t, terms.q_tree, terms.v_tree)
        if not isinstance(found, tuple):
            raise NumericalError(f"{mechanism.name}: the controller cannot be differentiated there: {found or UNKNOWN}")
        force, by_q, by_v = found
        plant = self._plant.at(terms, force + u_tree, locked)
        q = mechanism.partition.q
        others = np.setdiff1d(np.flatnonzero(by_q.any(axis=1) | by_v.any(axis=1)), q)
        acts = np.concatenate([q, others])
        B = np.vstack([np.zeros((len(plant.at), len(acts))), plant.a_u[np.ix_(plant.at, acts)]])
        K = np.hstack([by_q @ plant.T + by_v @ plant.V, by_v @ plant.T])[acts]
        return Feedback(plant.A, B, K)


def _as_asked(mechanism: Mechanism) -> dict[str, Any]:
    """Motors that turn the independent coordinates themselves, without limits."""
    q, none = mechanism.partition.q, np.zeros(mechanism.d)
    turns = np.asfortranarray(np.eye(mechanism.n)[q])
    return {"turns": turns, "direct": True, "limit": none + np.inf, "weights": none + 1.0, "preload": none}
