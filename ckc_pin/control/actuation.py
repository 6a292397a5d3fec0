"""From the force u of eq. 6 to the motors' tau and the generalized force on the tree, or from tau itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.control.allocation import allocate, least
from ckc_pin.control.spec import AllocationSpec, Limit
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Actuation", "Effort", "require_tau", "require_u"]

NO_NUMBERS = "cSUmMV"  # what NumPy would make real numbers of, in silence or with a warning


def require_u(u: Any, mechanism: Mechanism, what: str = "the controller's u") -> Array:
    """Return u as an array of the right shape, finite or not.

    Raises
    ------
    InputError
        Not numbers, or not one for each independent coordinate.
    """
    return _vector(u, mechanism.independent, what)


def require_tau(tau: Any, mechanism: Mechanism, what: str = "the controller's tau") -> Array:
    """Return torques as an array by motor, finite or not; in a table, motors that are not named have none.

    Raises
    ------
    InputError
        Not numbers, not one for each motor, a name that is no motor's.
    """
    if isinstance(tau, Mapping):
        return mechanism.motors.vector(tau, what, fill=0.0)
    return _vector(tau, mechanism.actuated, what)


def _vector(given: Any, names: Sequence[str], what: str) -> Array:
    if given is None:
        raise InputError(f"{what} is None; {len(names)} numbers are needed: {', '.join(names)}; is a return missing?")
    try:
        array = np.asarray(given)
        if array.dtype.kind in NO_NUMBERS:
            raise TypeError
        vector = array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is no vector of numbers: {given!r:.80}") from None
    if vector.shape != (len(names),):
        raise InputError(f"{what} has shape {vector.shape}; ({len(names)},) is needed: {', '.join(names)}")
    return vector


@dataclass(frozen=True)
class Effort:
    """What the actuators do at one instant: tau by motor, u' on the tree, u = rho^T u'."""

    tau: Array
    u_tree: Array
    u: Array


class Actuation:
    """Maps u to tau, limits tau, and gives what that does to the tree.

    Parameters
    ----------
    mechanism : Mechanism
    torque_limit : number or {motor: number}, optional
        |tau| never exceeds it, N m or N, nor the motor's own limit.
    allocation : AllocationSpec, optional
        How redundant motors share u; absent, tau is the least there is.

    Raises
    ------
    InputError
        A limit, a weight or a preload for what is no motor; weights or a preload without redundancy.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        torque_limit: Limit | dict[str, Limit] | None = None,
        allocation: AllocationSpec | None = None,
    ) -> None:
        self.mechanism, self.motors = mechanism, mechanism.motors
        motors, count = self.motors, len(self.motors.names)
        self.direct = mechanism.has_direct_drives
        given = torque_limit if isinstance(torque_limit, dict) else dict.fromkeys(motors.names, torque_limit or np.inf)
        self.given_limit = motors.vector(given, "controller.torque_limit", np.inf)
        self.limit = np.minimum(self.given_limit, motors.torque_limit)
        allocation = allocation or AllocationSpec()
        self.weights = motors.vector(allocation.weights, "controller.allocation.weights", 1.0)
        self.preload = motors.vector(allocation.preload, "controller.allocation.preload", 0.0)
        for key in ("weights", "preload"):
            if getattr(allocation, key) and count <= mechanism.d:
                raise InputError(
                    f"controller.allocation.{key}: {mechanism.name} has no redundancy, its {count} motors for "
                    f"{mechanism.d} freedoms leave no choice of tau"
                )
        self.none = Effort(np.zeros(count), np.zeros(mechanism.n), np.zeros(mechanism.d))

    def undriven(self, at: Kinematics) -> list[str]:
        """Name freedoms that no motor drives, as many as there are."""
        if self.direct:
            return []
        transmission = self.motors.transmission @ at.rho
        sizes = np.linalg.norm(transmission, axis=1, keepdims=True)
        _, values, directions = np.linalg.svd(transmission / np.where(sizes > 0, sizes, 1.0), full_matrices=True)
        rank = int(np.sum(values > 1e-6 * max(values.max(initial=0.0), 1e-150)))
        loose = pivoted_columns(directions[rank:])[0][: self.mechanism.d - rank]
        return [self.mechanism.independent[k] for k in sorted(loose)]

    def refusal(self, at: Kinematics) -> str:
        """Say why the motors cannot produce every u, with the freedoms that none drives; empty where they can."""
        loose = self.undriven(at)
        if not loose:
            return ""
        names = ", ".join(self.motors.names) or "no joint"
        return (
            f"{self.motors.key}: {names} cannot hold every freedom; "
            f"the motion along {', '.join(loose)} is held by none of them"
        )

    def require_transmission(self, at: Kinematics) -> None:
        """Refuse motors that cannot produce every u: some freedom is held by none of them.

        Raises
        ------
        InputError
            Names the freedoms.
        """
        if says := self.refusal(at):
            raise InputError(says)

    def distribute(self, tangent: Array, force: Array) -> Array:
        """Return the least tau, by the motors' weights, that does what a force on the mechanism does, unlimited.

        Parameters
        ----------
        tangent : (n, d) array
            Basis of the velocities that the loops allow; rho, or any other.
        force : (d,) array
            Along that basis: tangent^T u'.

        Returns
        -------
        (motors,) array
            Where they cannot do it, as nearly as they can.
        """
        return least((self.motors.transmission @ tangent).T, force, self.weights)

    def apply(self, terms: Terms, u: Array) -> Effort:
        """Map u to tau within limits; of redundant motors, as `allocate` does.

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
        if self.direct:
            tau = np.clip(u, -self.limit, self.limit)
            return Effort(tau, self.motors.force(tau), tau)
        transmission = (self.motors.transmission @ terms.rho).T  # u = transmission tau
        tau = allocate(transmission, u, self.limit, self.weights, self.preload)
        return Effort(tau, self.motors.force(tau), transmission @ tau)

    def drive(self, terms: Terms, tau: Any) -> Effort:
        """Take the motors' own torques, within limits.

        Raises
        ------
        InputError
            A controller's tau of the wrong shape, or for what is no motor.
        NumericalError
            A controller's tau that is not finite.
        """
        tau = require_tau(tau, self.mechanism)
        if not np.isfinite(tau).all():
            raise NumericalError(f"the controller's tau is not finite: {tau.tolist()}")
        tau = np.clip(tau, -self.limit, self.limit)
        u_tree = self.motors.force(tau)
        return Effort(tau, u_tree, terms.rho.T @ u_tree)
