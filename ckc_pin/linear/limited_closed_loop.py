"""A closed loop, linearized where joints are within their stops and motors within their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.formulations import tree_force
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.linear.closed_loop import ClosedLoop, Feedback
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation

__all__ = ["LoopWithinLimits"]

MISSED = 1e-9  # of what is wanted of the motors


@dataclass(frozen=True)
class LoopWithinLimits:
    """A closed loop that is linearized where it can be.

    Attributes
    ----------
    mechanism : Mechanism
    law : SetPoint or Tracking
    closed_loop : ClosedLoop
        Without limits.
    smoothing : float or None
        A scene's friction_smoothing.
    actuation : Actuation or None
        Motors with limits, if any.
    """

    mechanism: Mechanism
    law: SetPoint | Tracking
    closed_loop: ClosedLoop
    smoothing: float | None
    actuation: Actuation | None

    def at(self, t: float, state: Terms, where: str) -> Feedback:
        """Linearize it.

        Parameters
        ----------
        where : str
            Where that is, as a message begins.

        Raises
        ------
        NumericalError
            A joint is beyond its stops, the motors do not give what is wanted, or it is not linearized there.
        """
        if beyond := describe_stop_violation(self.mechanism, state.q_tree):
            raise NumericalError(f"{where} {beyond}")
        actuation = self.actuation
        if actuation is not None and np.isfinite(actuation.limit).any():
            wanted = self.law.u(t, state)
            given = actuation.apply(state, wanted)
            if np.abs(given.u - wanted).max() > MISSED * np.abs(wanted).max():
                tau = actuation.distribute(state.rho, wanted)
                k = int(np.argmax(np.abs(tau) / actuation.limit))
                raise NumericalError(
                    f"{where} {actuation.motors.names[k]} would need {abs(tau[k]):.4g}, its limit is "
                    f"{actuation.limit[k]:.4g}"
                )
        return self.closed_loop.at(t, state)

    def needed(self, state: Terms, q_ddot: Array) -> Array:
        """Return the u with which the mechanism moves on at an acceleration, dry friction left out if not smooth."""
        force = tree_force(state, state.rho @ q_ddot + state.rho_dot_times(state.q_dot))
        if self.smoothing is not None:
            force += self.mechanism.joints.friction * np.tanh(state.v_tree / self.smoothing)
        return state.rho.T @ force
