"""The paper's two controllers on the independent coordinates, with their Lyapunov functions.

Errors are q - q_d everywhere. A controller sees the plant's measured state through `Terms`; with its own
`model` it evaluates D, C, h of that model at the measured (q, z), as eq. 16 writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ckc_pin.control.desired import Desired
from ckc_pin.control.gains import require_positive_definite
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array

__all__ = ["Controller", "Model", "SetPoint", "TorqueController", "Tracking", "gives_tau"]


class Controller(Protocol):
    """Anything that gives eq. 6's force u."""

    def u(self, t: float, terms: Terms) -> Array:
        """Return the force on the independent coordinates at time t (s), shape (d,), N m or N."""


class TorqueController(Protocol):
    """Anything that gives the motors' own torques."""

    def tau(self, t: float, terms: Terms) -> Array | Mapping[str, float]:
        """Return tau at time t (s) by motor, N m or N: shape (motors,), or a table; motors not in it have none."""


def gives_tau(controller: Controller | TorqueController) -> bool:
    """Whether a controller gives torques of motors, by the method that it has.

    Raises
    ------
    InputError
        It has both methods, or neither.
    """
    u, tau = (callable(getattr(controller, name, None)) for name in ("u", "tau"))
    if u == tau:
        has = "both u and tau" if u else "neither u nor tau"
        raise InputError(
            f"{type(controller).__name__} has {has}; a controller has one of the methods u(t, terms), for the force on "
            "the independent coordinates, and tau(t, terms), for the motors' torques"
        )
    return tau


class Model:
    """The controller's own idea of the plant: another mechanism with the same coordinates.

    Parameters
    ----------
    mechanism, plant : Mechanism
    convention : "rho" or "actual"
        Where C takes its velocity.

    Raises
    ------
    MechanismError
        The two do not have the same coordinates, split in the same way.
    """

    def __init__(self, mechanism: Mechanism, plant: Mechanism, convention: CoriolisVelocity) -> None:
        for what in ("coordinates", "independent"):
            own, theirs = getattr(mechanism, what), getattr(plant, what)
            if own != theirs:
                raise MechanismError(
                    f"controller.model: its {what} are {', '.join(own)}, the plant's {', '.join(theirs)}"
                )
        self.mechanism = mechanism
        self.convention = convention

    def __call__(self, measured: Terms) -> Terms:
        """Return the model's terms at the plant's measured state."""
        at = self.mechanism.kinematics(measured.q_tree)
        v_tree = at.rho @ measured.q_dot if self.convention == "rho" else measured.v_tree
        return Terms(self.mechanism, at, v_tree)


class SetPoint:
    """Eq. 14: u = K_P (q_d - q) - K_V q_dot + h(q_d).

    Parameters
    ----------
    mechanism : Mechanism
        Whose h is compensated: the plant, or the controller's own model.
    K_P, K_V : (d, d) arrays
        Symmetric positive definite; K_V may be semi-definite.
    q_d : (d,) array
        The target.

    Raises
    ------
    InputError
        Gains that are not as required, a target that the mechanism cannot reach.
    """

    def __init__(self, mechanism: Mechanism, K_P: Array, K_V: Array, q_d: Array) -> None:
        require_positive_definite(K_P, "K_P")
        require_positive_definite(K_V, "K_V", semi=True)
        self.K_P, self.K_V, self.q_d = K_P, K_V, q_d
        target = sigma(mechanism, q_d)
        if target.verdict != "converged":
            wanted = ", ".join(f"{k} = {x:g}" for k, x in zip(mechanism.independent, q_d, strict=True))
            raise InputError(f"controller.q_d: the target {wanted} is {target.verdict}: {target.reason}")
        self.target = Terms(mechanism, target.at, np.zeros(mechanism.n))

    def u(self, t: float, terms: Terms) -> Array:
        """Eq. 14."""
        return -self.K_P @ (terms.q - self.q_d) - self.K_V @ terms.q_dot + self.target.h

    def u_rate_gradient(self, t: float, terms: Terms) -> Array:
        """d u / d q_dot, shape (d, d)."""
        return -self.K_V

    def lyapunov(self, t: float, terms: Terms, w: Array) -> float:
        """The function of section II-B minus its value at q_d, joules."""
        error = terms.q - self.q_d
        potential = terms.potential_energy - self.target.potential_energy - error @ self.target.h
        return float(0.5 * terms.q_dot @ terms.D @ terms.q_dot + potential + 0.5 * error @ self.K_P @ error)


class Tracking:
    """Eq. 16: u = D a + C v + h - K_D r with r = e_dot + Lambda e, v = q_d_dot - Lambda e, e = q - q_d.

    Parameters
    ----------
    Lambda, K_D : (d, d) arrays
        K_D and Lambda^T K_D symmetric positive definite (eq. 18 needs both).
    desired : Desired
    model : Model, optional
        The controller's own idea of the plant.

    Raises
    ------
    InputError
        Gains that are not as required.
    """

    def __init__(self, Lambda: Array, K_D: Array, desired: Desired, model: Model | None = None) -> None:
        require_positive_definite(K_D, "K_D")
        try:
            require_positive_definite(Lambda.T @ K_D, "Lambda^T K_D")
        except InputError as error:
            raise InputError(f"{error}; eq. 18's second term needs it") from None
        self.Lambda, self.K_D, self.desired, self.model = Lambda, K_D, desired, model

    def u(self, t: float, terms: Terms) -> Array:
        """Eq. 16."""
        q_d, q_d_dot, q_d_ddot = self.desired(t)
        error_dot = terms.q_dot - q_d_dot
        v = q_d_dot - self.Lambda @ (terms.q - q_d)
        a = q_d_ddot - self.Lambda @ error_dot
        r = terms.q_dot - v
        own = self.model(terms) if self.model else terms
        return own.D @ a + own.C_times(v) + own.h - self.K_D @ r

    def u_rate_gradient(self, t: float, terms: Terms) -> Array:
        """d u / d q_dot, shape (d, d); C is linear in its velocity and C(x) y = C(y) x."""
        q_d, q_d_dot, _ = self.desired(t)
        v = q_d_dot - self.Lambda @ (terms.q - q_d)
        own = self.model(terms) if self.model else terms
        along_v = Terms(own.mechanism, own.at, own.rho @ v)
        return along_v.C - own.D @ self.Lambda - self.K_D

    def lyapunov(self, t: float, terms: Terms, w: Array) -> float:
        """Eq. 18 with d1 = d2 = 1 and M = I, joules (w's part: square metres)."""
        q_d, q_d_dot, _ = self.desired(t)
        error = terms.q - q_d
        r = terms.q_dot - q_d_dot + self.Lambda @ error
        on_manifold = 0.5 * r @ terms.D @ r + error @ self.Lambda.T @ self.K_D @ error
        return float(on_manifold + 0.5 * w @ w)
