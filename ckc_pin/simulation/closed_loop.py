"""Controllers in the loop, linearized exactly: what u depends on, and what that makes of the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.generated.library import Library
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.native import _core
from ckc_pin.native.control import law_table
from ckc_pin.native.plant import Plant
from ckc_pin.native.tables import core_table

__all__ = ["ClosedLoop", "Feedback"]


@dataclass(frozen=True)
class Feedback:
    """A controller about one state: x_dot = A x + B u, u = K x, x = (q, q_dot), u on the independent coordinates.

    Attributes
    ----------
    A : (2 d, 2 d) array
    B : (2 d, d) array
    K : (d, 2 d) array
    """

    A: Array
    B: Array
    K: Array

    def mean(self, other: Feedback) -> Feedback:
        """Return what is half-way between this and another one."""
        return Feedback((self.A + other.A) / 2, (self.B + other.B) / 2, (self.K + other.K) / 2)

    @property
    def closed(self) -> Array:
        """A of the closed loop, (2 d, 2 d)."""
        return self.A + self.B @ self.K


class ClosedLoop:
    """A mechanism under eq. 14 or eq. 16, to be linearized at states of it. Torque limits are not in it.

    Parameters
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
    smoothing : float, optional
        A scene's friction_smoothing.
    library : Library, optional
        The mechanism's terms, compiled.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        law: SetPoint | Tracking,
        smoothing: float | None = None,
        library: Library | None = None,
    ) -> None:
        self._plant = Plant(mechanism, smoothing, library)
        self._table = core_table(mechanism, library)
        self.law = law

    @property
    def law(self) -> SetPoint | Tracking:
        """The controller, which may be changed for another one."""
        return self._law

    @law.setter
    def law(self, law: SetPoint | Tracking) -> None:
        self._law, self._native = law, _core.Feedback(self._table, law_table(law))

    def at(self, t: float, terms: Terms) -> Feedback:
        """Linearize plant and controller, at v' = rho q_dot.

        Raises
        ------
        NumericalError
            J has lost rank, or the controller has no u there.
        """
        mechanism, found = self._plant.mechanism, self._native.at(t, terms.q_tree, terms.v_tree)
        if not isinstance(found, tuple):
            raise NumericalError(f"{mechanism.name}: the controller cannot be differentiated there: {found or 'no u'}")
        (u, by_q, by_v), q = found, mechanism.partition.q
        u_tree = np.zeros(mechanism.n)
        u_tree[q] = u
        plant = self._plant.at(terms, u_tree)
        B = np.vstack([np.zeros((len(plant.at), len(q))), plant.a_u[np.ix_(plant.at, q)]])
        return Feedback(plant.A, B, np.hstack([by_q @ plant.T + by_v @ plant.V, by_v @ plant.T]))
