"""Actuation: motor torques tau from eq. 6's force u, torque limits, and the generalized force u' on the tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import pivoted_columns
from ckc_pin.base.validation import is_number, suggest_name
from ckc_pin.control.spec import AllocationSpec, TorqueLimit
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.motors import torque_limits

__all__ = ["Actuation", "Effort", "require_tau", "require_u"]

NOT_REAL_KINDS = "cSUmMV"  # NumPy kinds that `astype(float)` converts silently or with a warning
MIN_TRANSMISSION = 1e-9  # of the largest singular value: smaller ones of the transmission count as zero
DRIVE_TOLERANCE = 1e-6  # relative singular value below which motors do not drive a motion


def require_u(u: Any, mechanism: Mechanism, what: str = "the controller's u") -> Array:
    """Return u as an array of shape (d,). Its entries may be NaN or infinite.

    In a table, independent coordinates without an entry have zero force. A number stands for one freedom.

    Raises
    ------
    InputError
        u is not a vector of numbers, not of that length, or names something that is not an independent coordinate.
    """
    if isinstance(u, Mapping):
        names = mechanism.independent
        unknown = next((name for name in u if name not in names), None)
        if unknown is not None:
            remedy = "; motor torques are what a method tau returns" if unknown in mechanism.actuated else ""
            raise InputError(
                f"{what}: no independent coordinate {unknown!r}; there are {', '.join(names)}"
                f"{remedy or suggest_name(unknown, names)}"
            )
        wrong = next((name for name in u if not is_number(u[name])), None)
        if wrong is not None:
            raise InputError(f"{what}: {wrong} = {u[wrong]!r:.80}: expected a number")
        u = [u.get(name, 0.0) for name in names]
    return _vector(u, mechanism.independent, what)


def require_tau(tau: Any, mechanism: Mechanism, what: str = "the controller's tau") -> Array:
    """Return torques as an array by motor. Its entries may be NaN or infinite.

    In a table, motors without an entry have zero torque. A number stands for one motor.

    Raises
    ------
    InputError
        tau is not a vector of numbers, not one number a motor, or names something that is not a motor.
    """
    if isinstance(tau, Mapping):
        return mechanism.motors.vector(tau, what, fill=0.0)
    return _vector(tau, mechanism.actuated, what)


def _vector(value: Any, names: Sequence[str], what: str) -> Array:
    if value is None:
        raise InputError(f"{what}: expected {len(names)} numbers ({', '.join(names)}), got None; is a return missing?")
    try:
        array = np.asarray(value)
        if array.dtype.kind in NOT_REAL_KINDS:
            raise TypeError
        vector = array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what}: expected a vector of numbers, got {value!r:.80}") from None
    if vector.shape == ():
        if len(names) != 1:
            raise InputError(f"{what}: expected {len(names)} numbers ({', '.join(names)}), got the number {vector:g}")
        return vector.reshape(1)
    if vector.shape != (len(names),):
        raise InputError(f"{what}: expected shape ({len(names)},) ({', '.join(names)}), got {vector.shape}")
    return vector


class Effort(Struct, frozen=True):
    """Forces of the actuators at one instant: tau by motor, u' on the tree, u = rho^T u'."""

    tau: Array
    u_tree: Array
    u: Array


class Actuation:
    """Motors of a mechanism with torque limits and the allocation of redundant motors.

    Parameters
    ----------
    mechanism : Mechanism
    torque_limit : number, (lower, upper) or {motor: either}, optional
        Limit of |tau|, or both limits of tau, N m or N, in addition to the motors' own limits.
    allocation : AllocationSpec, optional
        Weights and preload of redundant motors; default: minimum-norm torques.

    Attributes
    ----------
    is_direct : bool
        Whether each motor drives one independent coordinate, in order and without gear: tau = u.
    scene_limit, limit : (2, motors) array
        Lower and upper limits: of `torque_limit` alone, and with the motors' own limits; infinite where there is none.
    weights, preload : (motors,) array
    zero : Effort

    Raises
    ------
    InputError
        A limit, a weight or a preload for something that is not a motor; weights or a preload without redundant motors.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        torque_limit: TorqueLimit | dict[str, TorqueLimit] | None = None,
        allocation: AllocationSpec | None = None,
    ) -> None:
        self.mechanism, self.motors = mechanism, mechanism.motors
        motors, count = self.motors, len(self.motors.names)
        self.is_direct = mechanism.has_direct_drives
        where = "controller.torque_limit"
        if isinstance(torque_limit, dict):
            sides = {name: torque_limits(limit, f"{where}.{name}") for name, limit in torque_limit.items()}
        else:
            sides = dict.fromkeys(motors.names, torque_limits(torque_limit, where))
        lower, upper = ({name: limits[side] for name, limits in sides.items()} for side in (0, 1))
        self.scene_limit = np.array([motors.vector(lower, where, -np.inf), motors.vector(upper, where, np.inf)])
        self.limit = np.array(
            [
                np.maximum(self.scene_limit[0], motors.torque_limit[0]),
                np.minimum(self.scene_limit[1], motors.torque_limit[1]),
            ]
        )
        allocation = allocation or AllocationSpec()
        self.weights = motors.vector(allocation.weights, "controller.allocation.weights", 1.0)
        self.preload = motors.vector(allocation.preload, "controller.allocation.preload", 0.0)
        for key in ("weights", "preload"):
            if getattr(allocation, key) and count <= mechanism.d:
                raise InputError(
                    f"controller.allocation.{key}: {mechanism.name} has no redundant motors: u determines the torques "
                    f"of its {count} motors for {mechanism.d} freedoms; remove {key}"
                )
        self.zero = Effort(np.zeros(count), np.zeros(mechanism.n), np.zeros(mechanism.d))

    def find_undriven_freedoms(self, at: Kinematics) -> list[str]:
        """Return independent coordinates that no motor drives, as many as there are undriven freedoms."""
        if self.is_direct:
            return []
        transmission = self.motors.transmission @ at.rho
        sizes = np.linalg.norm(transmission, axis=1, keepdims=True)
        _, values, directions = np.linalg.svd(transmission / np.where(sizes > 0, sizes, 1.0), full_matrices=True)
        rank = int(np.sum(values > DRIVE_TOLERANCE * max(values.max(initial=0.0), 1e-150)))
        undriven = pivoted_columns(directions[rank:])[0][: self.mechanism.d - rank]
        return [self.mechanism.independent[k] for k in sorted(undriven)]

    def explain_undriven_freedoms(self, at: Kinematics) -> str:
        """Return why the motors cannot produce every u, or an empty text if they can."""
        undriven = self.find_undriven_freedoms(at)
        if not undriven:
            return ""
        names = ", ".join(self.motors.names) or "no joint"
        return (
            f"{self.motors.key}: {names} cannot drive every freedom; "
            f"the motion along {', '.join(undriven)} is driven by none of them"
        )

    def require_driven_freedoms(self, at: Kinematics) -> None:
        """Raise InputError, with the undriven freedoms' names, if the motors cannot produce every u."""
        if reason := self.explain_undriven_freedoms(at):
            raise InputError(reason)

    def minimum_norm_torques(self, tangent: Array, force: Array) -> Array:
        """Return minimum-norm motor torques equivalent to a generalized force, ignoring limits.

        Parameters
        ----------
        tangent : (n, d) array, or (m, n, d)
            Basis of the velocities that the loops allow: rho, or any other.
        force : (d,) array, or (m, d)
            In that basis: tangent^T u'.

        Returns
        -------
        (motors,) array, or (m, motors)
            Minimum of the norm weighted by `weights`. If the motors cannot produce the force, the least-squares
            solution.
        """
        scale = 1.0 / np.sqrt(self.weights)
        transmission = np.swapaxes(self.motors.transmission @ tangent, -1, -2)
        inverse = np.linalg.pinv(transmission * scale, rcond=MIN_TRANSMISSION)
        return np.asarray(scale * (inverse @ force[..., None])[..., 0], dtype=float)

    def explain_overload(self, tau: Array) -> str:
        """Return which motor is furthest beyond its limits at torques tau, (motors,), as part of a message."""
        limit = np.where(tau < 0.0, self.limit[0], self.limit[1])
        k = int(np.argmax(np.abs(tau) / np.maximum(np.abs(limit), 1e-300)))
        sign = 1.0 if self.limit[0, k] == -self.limit[1, k] else np.sign(tau[k])
        return f"{self.motors.names[k]} would need {sign * abs(tau[k]):.4g}, its limit is {sign * abs(limit[k]):.4g}"

    def apply_tau(self, terms: Terms, tau: Any) -> Effort:
        """Return the effort of motor torques, clipped at their limits.

        Raises
        ------
        InputError
            tau has the wrong shape, or names something that is not a motor.
        NumericalError
            tau is not finite.
        """
        tau = require_tau(tau, self.mechanism)
        if not np.isfinite(tau).all():
            raise NumericalError(f"the controller's tau is not finite: {tau.tolist()}")
        tau = np.clip(tau, *self.limit)
        u_tree = self.motors.force(tau)
        return Effort(tau, u_tree, terms.rho.T @ u_tree)
