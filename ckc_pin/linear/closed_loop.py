"""Exact linearization of mechanisms with feedback controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.forces import BodyForce
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.dynamics.formulations import tree_force
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation
from ckc_pin.native import _core
from ckc_pin.native.control import actuation_table, apply_u, law_table
from ckc_pin.native.plant import NONE, Plant
from ckc_pin.native.tables import core_table

__all__ = ["LAWS", "ClosedLoop", "Feedback", "LimitedClosedLoop"]

LAWS = (SetPoint, Tracking)  # controllers whose derivatives are known; a subclass may compute another u
NOT_DIFFERENTIABLE = (
    "the independent coordinates do not parametrize the motion or belong to a free root, or motors that share a force "
    "are at their limits"
)
U_TOLERANCE = 1e-9  # relative difference between the requested u and the u that the motors give


@dataclass(frozen=True)
class Feedback:
    """A linearized plant and controller: ``x_dot = A x + B u`` and ``u = K x``.

    Attributes
    ----------
    A : (2 d, 2 d) array
        Of deviations of the independent coordinates and of their rates.
    B : (2 d, m) array
    K : (m, 2 d) array
        One row for each independent coordinate. If motors are at their limits, also one row for each other joint that
        they drive.
    """

    A: Array
    B: Array
    K: Array

    @property
    def A_closed(self) -> Array:
        """State matrix of the closed loop, A + B K, (2 d, 2 d)."""
        return self.A + self.B @ self.K


class ClosedLoop:
    """A mechanism with the controller of eq. 14 or eq. 16, which can be linearized about any state.

    Parameters
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
        Not of a subclass, whose u may be another one.
    smoothing : float, optional
        The scene's friction_smoothing.
    library : Library, optional
        Compiled terms of the mechanism.
    actuation : Actuation, optional
        Motors with limits. By default u acts without limits.
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
        self._actuation = _ideal_actuation(mechanism) if actuation is None else actuation_table(actuation)
        self.law = law

    @property
    def law(self) -> SetPoint | Tracking:
        """The controller. It can be replaced by another one of the same mechanism."""
        return self._law

    @law.setter
    def law(self, law: SetPoint | Tracking) -> None:
        self._law = law
        self._native = None if law_table(law) is None else self._make_native(law)

    def _make_native(self, law: SetPoint | Tracking) -> _core.Feedback:
        return _core.Feedback(self._table, self._actuation | {"law": law_table(law)})

    def _native_at(self, t: float) -> _core.Feedback:
        """Return the native controller. A desired motion that is a function in Python has its values at t there."""
        if self._native is not None or not isinstance(self._law, Tracking):
            return self._native or self._make_native(self._law)
        q_d, q_d_dot, q_d_ddot = (np.asarray(x, dtype=float) for x in self._law.desired(t))
        parabola = PiecewisePolynomial(np.array([t, t + 1.0]), np.array([0.5 * q_d_ddot, q_d_dot, q_d])[:, np.newaxis])
        return self._make_native(Tracking(self._law.Lambda, self._law.K_D, parabola, self._law.model))

    def linearize(
        self,
        t: float,
        terms: Terms,
        u_tree: Array | float = 0.0,
        locked: IntArray = NONE,
        forces: Sequence[BodyForce] = (),
    ) -> Feedback:
        """Linearize plant and controller about a state.

        Parameters
        ----------
        t : float
            Time at which the controller is evaluated, s.
        terms : Terms
            The state, with ``v_tree = rho q_dot``.
        u_tree : (n,) array, optional
            Other forces on the tree that do not depend on the state, such as friction of sliding joints.
        locked : int array, optional
            Coordinates of joints that stick or are at a stop.
        forces : sequence of BodyForce, optional
            Constant forces on links.

        Raises
        ------
        NumericalError
            J has lost rank, or the controller is not differentiable at this state.
        """
        mechanism, derivatives = self._plant.mechanism, self._native_at(t).at(t, terms.q_tree, terms.v_tree)
        if not isinstance(derivatives, tuple):
            reason = derivatives or NOT_DIFFERENTIABLE
            raise NumericalError(f"{mechanism.name}: the controller cannot be differentiated there: {reason}")
        force, force_by_q, force_by_v = derivatives
        plant = self._plant.at(terms, force + u_tree, locked, forces)
        q = mechanism.partition.q
        other_joints = np.setdiff1d(np.flatnonzero(force_by_q.any(axis=1) | force_by_v.any(axis=1)), q)
        driven = np.concatenate([q, other_joints])
        B = np.vstack([np.zeros((len(plant.at), len(driven))), plant.a_u[np.ix_(plant.at, driven)]])
        K = np.hstack([force_by_q @ plant.T + force_by_v @ plant.V, force_by_v @ plant.T])[driven]
        return Feedback(plant.A, B, K)


def _ideal_actuation(mechanism: Mechanism) -> dict[str, Any]:
    """Return the table of unlimited motors on the independent coordinates."""
    q, zeros = mechanism.partition.q, np.zeros(mechanism.d)
    turns = np.asfortranarray(np.eye(mechanism.n)[q])
    return {
        "transmission": turns,
        "direct": True,
        "lower": zeros - np.inf,
        "upper": zeros + np.inf,
        "weights": zeros + 1.0,
        "preload": zeros,
    }


@dataclass(frozen=True)
class LimitedClosedLoop:
    """A closed loop whose linearization is valid inside joint stops and torque limits only.

    Attributes
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
    closed_loop : ClosedLoop
        The same loop without limits.
    smoothing : float or None
        The scene's friction_smoothing.
    actuation : Actuation or None
        Motors with limits, if there are any.
    """

    mechanism: Mechanism
    law: SetPoint | Tracking
    closed_loop: ClosedLoop
    smoothing: float | None
    actuation: Actuation | None

    def linearize(self, t: float, state: Terms, where: str) -> Feedback:
        """Linearize plant and controller about a state inside all limits.

        Parameters
        ----------
        where : str
            Description of the state, the beginning of an error message.

        Raises
        ------
        NumericalError
            A joint is beyond its stops, the motors cannot give the controller's u, or the loop is not differentiable.
        """
        if violation := describe_stop_violation(self.mechanism, state.q_tree):
            raise NumericalError(f"{where} {violation}")
        actuation = self.actuation
        if actuation is not None and np.isfinite(actuation.limit).any():
            u = self.law.u(t, state)
            limited = apply_u(actuation, state, u)
            if np.abs(limited.u - u).max() > U_TOLERANCE * np.abs(u).max():
                tau = actuation.minimum_norm_torques(state.rho, u)
                raise NumericalError(f"{where} {actuation.explain_overload(tau)}")
        return self.closed_loop.linearize(t, state)

    def compute_required_u(self, state: Terms, q_ddot: Array) -> Array:
        """Return the u that gives the mechanism an acceleration, (d,).

        Dry friction is included only if it is smoothed.
        """
        force = tree_force(state, state.rho @ q_ddot + state.rho_dot_times(state.q_dot))
        if self.smoothing is not None:
            force += self.mechanism.joints.friction * np.tanh(state.v_tree / self.smoothing)
        return state.rho.T @ force
