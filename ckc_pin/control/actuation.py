"""From the force u of eq. 6 to the actuators' tau and the generalized force on the tree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.control.spec import Limit
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array

__all__ = ["Actuation", "Effort", "require_u"]

NO_NUMBERS = "cSUmMV"  # what NumPy would make real numbers of, in silence or with a warning


def require_u(u: Any, mechanism: Mechanism, what: str = "the controller's u") -> Array:
    """Return u as an array of the right shape, finite or not.

    Raises
    ------
    InputError
        Not numbers, or not one for each independent coordinate.
    """
    try:
        given = np.asarray(u)
        if given.dtype.kind in NO_NUMBERS:
            raise TypeError
        vector = given.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is no vector of numbers: {u!r:.80}") from None
    if vector.shape != (mechanism.d,):
        names = ", ".join(mechanism.independent)
        raise InputError(f"{what} has shape {vector.shape}; ({mechanism.d},) is needed: {names}")
    return vector


@dataclass(frozen=True)
class Effort:
    """What the actuators do at one instant: tau by actuator, u' on the tree, u = rho^T u'."""

    tau: Array
    u_tree: Array
    u: Array


class Actuation:
    """Maps u to tau, limits tau, and gives what that does to the tree.

    Parameters
    ----------
    mechanism : Mechanism
    torque_limit : number or {actuator: number}, optional
        |tau| never exceeds it, N m or N.

    Raises
    ------
    InputError
        A limit for a joint that is no actuator, or an actuator without one.
    """

    def __init__(self, mechanism: Mechanism, torque_limit: Limit | dict[str, Limit] | None = None) -> None:
        self.mechanism = mechanism
        self.at = mechanism.actuated_at
        self.direct = mechanism.actuated == mechanism.independent
        self.limit: Array | None = None
        if isinstance(torque_limit, dict):
            unknown = [name for name in torque_limit if name not in mechanism.actuated]
            if unknown:
                raise InputError(
                    f"controller.torque_limit: {unknown[0]!r} is no actuator; there are {', '.join(mechanism.actuated)}"
                )
            self.limit = np.array([torque_limit.get(name, np.inf) for name in mechanism.actuated])
        elif torque_limit is not None:
            self.limit = np.full(len(self.at), float(torque_limit))

        self.none = Effort(np.zeros(len(self.at)), np.zeros(mechanism.n), np.zeros(mechanism.d))

    def require_transmission(self, at: Kinematics) -> None:
        """Refuse actuators that cannot produce every u: some freedom is held by none of them.

        Raises
        ------
        InputError
            Names the freedom that is held least.
        """
        if self.direct:
            return
        transmission = at.rho[self.at].T
        values, directions = np.linalg.eigh(transmission @ transmission.T)
        if values[0] <= 1e-12 * max(values[-1], 1e-300):
            loose = self.mechanism.independent[int(np.argmax(np.abs(directions[:, 0])))]
            raise InputError(
                f"actuated: {', '.join(self.mechanism.actuated) or 'no joint'} cannot hold every freedom; "
                f"the motion along {loose} is held by none of them"
            )

    def distribute(self, tangent: Array, force: Array) -> Array:
        """Return the tau of minimum norm that does what a force on the mechanism does, unlimited.

        Parameters
        ----------
        tangent : (n, d) array
            Basis of the velocities that the loops allow; rho, or any other.
        force : (d,) array
            Along that basis: tangent^T u'.

        Returns
        -------
        (actuators,) array
            Where they cannot do it, as nearly as they can.
        """
        return np.asarray(np.linalg.lstsq(tangent[self.at].T, force, rcond=1e-9)[0], dtype=float)

    def apply(self, terms: Terms, u: Array) -> Effort:
        """Map u to tau (minimum norm when there are more actuators than freedoms) and limit it.

        Raises
        ------
        InputError
            A controller's u of the wrong shape.
        NumericalError
            A controller's u that is not finite.
        """
        u = require_u(u, self.mechanism)
        if not np.isfinite(u).all():
            raise NumericalError(f"the controller's u is not finite: {u.tolist()}")
        tau = u if self.direct else self.distribute(terms.rho, u)
        if self.limit is not None:
            tau = np.clip(tau, -self.limit, self.limit)
        u_tree = np.zeros(self.mechanism.n)
        u_tree[self.at] = tau
        return Effort(tau, u_tree, tau if self.direct else terms.rho[self.at].T @ tau)
