"""The paper's two controllers on the independent coordinates, with their Lyapunov functions.

Errors are q - q_d everywhere. A controller sees the plant's measured state through `Terms`; with its own
`model` it evaluates D, C, h of that model at the measured (q, z), as eq. 16 writes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value, require_callable, require_controller_signature, require_type
from ckc_pin.control.desired import Desired
from ckc_pin.control.gains import gain_matrix, require_positive_definite
from ckc_pin.control.spec import Gain
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Controller", "Law", "Model", "SetPoint", "TorqueController", "Tracking", "as_controller", "gives_tau"]


TAKES = (
    "an object with one of the methods u(t, terms), for the force on the independent coordinates, and tau(t, terms), "
    "for the motors' torques; or a function u(t, terms)"
)


class Controller(Protocol):
    """Anything that gives eq. 6's force u."""

    def u(self, t: float, terms: Terms) -> Array:
        """Return the force on the independent coordinates at time t (s), shape (d,), N m or N."""


class TorqueController(Protocol):
    """Anything that gives the motors' own torques."""

    def tau(self, t: float, terms: Terms) -> Array | Mapping[str, float]:
        """Return tau at time t (s) by motor, N m or N: shape (motors,), or a table; motors not in it have none."""


Law = Callable[[float, Terms], Any]  # a controller that is a plain function: (t, terms) to u


class FunctionController:
    """A plain function as a controller.

    Parameters
    ----------
    function : callable
        (t, terms) to u.
    """

    def __init__(self, function: Law) -> None:
        self.u: Law = function


def as_controller(given: Any) -> Controller | TorqueController:
    """Return what a caller gave as a controller: an object that is one, or a plain function u(t, terms).

    Raises
    ------
    InputError
        A class in the place of an object of it, a function of other arguments, anything else; an attribute `u`, `tau`
        or `lyapunov` that is no method as required; attributes of a SetPoint or Tracking that were replaced by others.
    """
    if isinstance(given, type):
        name = given.__name__
        raise InputError(f"controller: expected an object, got the class {name}; create one with {name}()")
    own = [name for name in ("u", "tau") if callable(getattr(given, name, None))]
    if not own and not callable(given):
        raise InputError(f"controller: expected {TAKES}, got {describe_value(given)}")
    for name in own or [""]:
        law = getattr(given, name) if name else given
        called = name or getattr(given, "__name__", type(given).__name__)
        if isinstance(law, type):
            raise InputError(f"controller: {called}: expected a function of (t, terms), got {describe_value(law)}")
        require_controller_signature(law, called, "controller")
    if own:
        _require_lyapunov(getattr(given, "lyapunov", None))
    if type(given) is SetPoint or type(given) is Tracking:  # a subclass may have attributes of its own
        given.require_attributes()
    found: Controller | TorqueController = given if own else FunctionController(given)
    gives_tau(found)
    return found


def _require_lyapunov(function: Any) -> None:
    """Refuse an attribute `lyapunov` that a run could not evaluate (InputError)."""
    takes = "a function of (t, terms, w) that returns a number, or None"
    if isinstance(function, type):
        raise InputError(f"controller: lyapunov: expected {takes}, got {describe_value(function)}")
    require_callable(function, "controller: lyapunov", takes, 3)


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
    K_P, K_V : number, {joint: number} or (d, d) array
        Symmetric positive definite, in the order of `independent`; K_V may be semi-definite.
    q_d : (d,) array or {coordinate: number}
        The target.
    near : Kinematics, optional
        On whose assembly branch h is that at the target, where a run starts; default: as assembled.

    Raises
    ------
    InputError
        Gains that are not as required, a target that the mechanism cannot reach.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        K_P: Gain | Array,
        K_V: Gain | Array,
        q_d: Array | Mapping[str, float],
        near: Kinematics | None = None,
    ) -> None:
        require_type(mechanism, Mechanism, "SetPoint: mechanism", "a Mechanism, as load returns it")
        names = mechanism.independent
        self.K_P, self.K_V = gain_matrix(K_P, names, "K_P"), gain_matrix(K_V, names, "K_V")
        require_positive_definite(self.K_P, "K_P")
        require_positive_definite(self.K_V, "K_V", semi=True)
        if not isinstance(q_d, Mapping):
            require_type(q_d, (np.ndarray, list, tuple), "SetPoint: q_d", "a number for each independent coordinate")
            if len(q_d) != len(names):
                raise InputError(f"SetPoint: q_d has {len(q_d)} numbers; {len(names)} are needed: {', '.join(names)}")
            q_d = dict(zip(names, q_d, strict=True))
        self.q_d = q_d = mechanism.vector(q_d, names, "controller.q_d")
        target = sigma(mechanism, q_d, near)
        if target.verdict != "converged":
            wanted = ", ".join(f"{k} = {x:g}" for k, x in zip(mechanism.independent, q_d, strict=True))
            raise InputError(f"controller.q_d: the target {wanted} is {target.verdict}: {target.reason}")
        self.target = Terms(mechanism, target.at, np.zeros(mechanism.n))

    def u(self, t: float, terms: Terms) -> Array:
        """Eq. 14."""
        return -self.K_P @ (terms.q - self.q_d) - self.K_V @ terms.q_dot + self.target.h

    def require_attributes(self) -> None:
        """Refuse attributes that were replaced by values that the law cannot use (InputError)."""
        require_type(self.target, Terms, "SetPoint: target", "Terms, those at the target")
        d = self.target.mechanism.d
        for name, shape in (("K_P", (d, d)), ("K_V", (d, d)), ("q_d", (d,))):
            _require_array(getattr(self, name), shape, f"SetPoint: {name}")

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
    Lambda, K_D : number or (d, d) array
        In the order of `independent`. K_D and Lambda^T K_D symmetric positive definite (eq. 18 needs both).
    desired : Desired
        A function of t (s) that returns q_d, its rate and its acceleration, each of shape (d,).
    model : Model, optional
        The controller's own idea of the plant.

    Raises
    ------
    InputError
        Gains that are not as required.
    """

    def __init__(self, Lambda: float | Array, K_D: float | Array, desired: Desired, model: Model | None = None) -> None:
        of_each = [f"coordinate {k + 1}" for k in range(_dimension(desired))]
        if model is not None:
            require_type(model, Model, "Tracking: model", "a Model")
        Lambda, K_D = gain_matrix(Lambda, of_each, "Lambda"), gain_matrix(K_D, of_each, "K_D")
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

    def require_attributes(self) -> None:
        """Refuse attributes that were replaced by values that the law cannot use (InputError)."""
        d = _dimension(self.desired)
        for name in ("Lambda", "K_D"):
            _require_array(getattr(self, name), (d, d), f"Tracking: {name}")
        if self.model is not None:
            require_type(self.model, Model, "Tracking: model", "a Model")

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


def _require_array(given: Any, shape: tuple[int, ...], what: str) -> None:
    try:
        array = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{what}: expected an array of shape {shape} of finite numbers, got {describe_value(given)}")


def _dimension(desired: Any) -> int:
    """Return how many coordinates a trajectory is of; refuse what is none."""
    takes = "a function of t that returns q_d, its rate and its acceleration, each of shape (d,)"
    if desired is None or isinstance(desired, type):
        raise InputError(f"Tracking: desired: expected {takes}, got {describe_value(desired)}")
    require_callable(desired, "Tracking: desired", takes, 1)
    at_start = desired(0.0)
    shapes = [np.shape(part) for part in at_start] if isinstance(at_start, tuple | list | np.ndarray) else []
    if len(shapes) != 3 or len(set(shapes)) != 1 or len(shapes[0]) != 1:
        raise InputError(f"Tracking: desired(0): expected {takes}, got {at_start!r:.80}")
    return int(shapes[0][0])
