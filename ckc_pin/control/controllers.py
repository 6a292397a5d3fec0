"""Controllers: set-point control (eq. 14), tracking (eq. 16), recorded torques, and the user's own functions.

Errors are q - q_d everywhere. A controller gets the plant's measured state as `Terms`. With a model of its own it
evaluates D, C and h of that model at the measured (q, z), as eq. 16 writes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value, require_callable, require_controller_signature, require_type
from ckc_pin.control.desired import Desired
from ckc_pin.control.spec import Gain, gain_matrix, require_positive_definite
from ckc_pin.dynamics.formulations import CoriolisVelocity
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "ControlLaw",
    "Controller",
    "ControllerModel",
    "RecordedTorques",
    "SetPoint",
    "TorqueController",
    "Tracking",
    "as_controller",
    "has_state",
    "initial_state",
    "is_torque_controller",
    "require_no_memory",
]


CONTROLLER_FORMS = (
    "an object with one of the methods u(t, terms), for the force on the independent coordinates, and tau(t, terms), "
    "for the motors' torques; or a function u(t, terms)"
)


class Controller(Protocol):
    """A controller that returns eq. 6's force u."""

    def u(self, t: float, terms: Terms) -> Array | Mapping[str, float] | float:
        """Return the force on the independent coordinates at time t (s), N m or N.

        Shape (d,), or a table by coordinate without those that are zero. A number with one freedom.
        """


class ControllerWithState(Protocol):
    """A controller with a state of its own, such as the integral of an error, that is integrated with the motion.

    `u` or `tau` take the state as a third argument. A sampled controller's state advances by sample_time * state_dot.

    Attributes
    ----------
    initial_state : (k,) array
    """

    initial_state: Array

    def state_dot(self, t: float, terms: Terms, state: Array) -> Array:
        """Return the rate of the state at time t (s), shape (k,)."""


class TorqueController(Protocol):
    """A controller that returns motor torques."""

    def tau(self, t: float, terms: Terms) -> Array | Mapping[str, float] | float:
        """Return torques at time t (s), N m or N.

        Shape (motors,), or a table by motor without those that are zero. A number with one motor.
        """


ControlLaw = Callable[[float, Terms], Any]  # a controller as a plain function from (t, terms) to u


class FunctionController:
    """A plain function as a controller.

    Parameters
    ----------
    function : callable
        From (t, terms) to u.
    """

    def __init__(self, function: ControlLaw) -> None:
        self.u: ControlLaw = function


def as_controller(value: Any) -> Controller | TorqueController:
    """Return a caller's argument as a controller: an object with method u or tau, or a plain function u(t, terms).

    Raises
    ------
    InputError
        The argument is a class, or a function of other arguments, or anything else; an attribute `u`, `tau` or
        `lyapunov` is not such a method; attributes of a SetPoint or Tracking were replaced by unusable values.
    """
    if isinstance(value, type):
        name = value.__name__
        raise InputError(f"controller: expected an object, got the class {name}; create one with {name}()")
    methods = [name for name in ("u", "tau") if callable(getattr(value, name, None))]
    if not methods and not callable(value):
        raise InputError(f"controller: expected {CONTROLLER_FORMS}, got {describe_value(value)}")
    for method in methods or [""]:
        function = getattr(value, method) if method else value
        name = method or getattr(value, "__name__", type(value).__name__)
        if isinstance(function, type):
            raise InputError(f"controller: {name}: expected a function of (t, terms), got {describe_value(function)}")
        require_controller_signature(function, name, "controller", count=3 if has_state(value) else 2)
    if has_state(value):
        require_controller_signature(value.state_dot, "state_dot", "controller", count=3)
        initial_state(value)
    if methods:
        _require_lyapunov(getattr(value, "lyapunov", None))
    if type(value) is SetPoint or type(value) is Tracking:  # a subclass may have other attributes
        value.validate_attributes()
    controller: Controller | TorqueController = value if methods else FunctionController(value)
    is_torque_controller(controller)  # refuses a controller with both methods
    return controller


def require_no_memory(controller: Controller | TorqueController, start: Terms, other: Terms) -> None:
    """Raise InputError if a controller returns different values for the same (t, terms), as one with memory does.

    An integrator evaluates states in any order, tries steps again and asks for a state several times, so u must be a
    function of (t, terms) alone. The controller is called at the start, at another state, and at the start again.

    Parameters
    ----------
    controller : Controller or TorqueController
    start, other : Terms
        At t = 0, and at another state later.
    """
    method = "tau" if is_torque_controller(controller) else "u"
    arguments = (initial_state(controller),) if has_state(controller) else ()

    def law(t: float, terms: Terms) -> Any:
        return getattr(controller, method)(t, terms, *arguments)

    try:
        first, _, again = law(start.t, start), law(other.t, other), law(start.t, start)
        (names, values), (names_again, values_again) = _names_and_values(first), _names_and_values(again)
        differs = names != names_again or not np.array_equal(values, values_again, equal_nan=True)
    except Exception:  # The run calls it again and reports what is wrong with it.
        return
    if differs:
        raise InputError(
            f"controller: {method} returns {describe_value(again)} at t = 0 after a call at t = {other.t:g}, and "
            f"{describe_value(first)} before it. It must be a function of (t, terms) alone, because the integrator "
            "calls it in any order; a controller with memory or noise runs as "
            "ckc_pin.Sampled(controller, sample_time), which calls it once a sample"
        )


def _names_and_values(result: Any) -> tuple[list[str], Array]:
    """Return the sorted names of a table that a controller returned, none of an array, and the values."""
    if isinstance(result, Mapping):
        return sorted(result), np.array([result[name] for name in sorted(result)], dtype=float)
    return [], np.asarray(result, dtype=float)


def _require_lyapunov(function: Any) -> None:
    """Raise InputError if a run could not evaluate an attribute `lyapunov`."""
    takes = "a function of (t, terms, w) that returns a number, or None"
    if isinstance(function, type):
        raise InputError(f"controller: lyapunov: expected {takes}, got {describe_value(function)}")
    require_callable(function, "controller: lyapunov", takes, 3)


def is_torque_controller(controller: Controller | TorqueController) -> bool:
    """Return whether a controller returns motor torques (method `tau`) instead of u.

    Raises
    ------
    InputError
        It has both methods or neither.
    """
    has_u, has_tau = (callable(getattr(controller, name, None)) for name in ("u", "tau"))
    if has_u == has_tau:
        methods = "both u and tau" if has_u else "neither u nor tau"
        raise InputError(
            f"{type(controller).__name__} has {methods}; a controller has one of the methods u(t, terms), for the "
            "force on the independent coordinates, and tau(t, terms), for the motors' torques"
        )
    return has_tau


def has_state(controller: Any) -> bool:
    """Return whether a controller has a state of its own, whose rate is its method `state_dot`."""
    return callable(getattr(controller, "state_dot", None))


def initial_state(controller: Any) -> Array:
    """Return the initial state of a controller, shape (k,); empty if it has none.

    Raises
    ------
    InputError
        Its attribute `initial_state` is missing, or not a vector of finite numbers.
    """
    if not has_state(controller):
        return np.zeros(0)
    try:
        state = np.array(getattr(controller, "initial_state", None), dtype=float)
    except (TypeError, ValueError):
        state = np.full(1, np.nan)
    if state.ndim != 1 or not np.all(np.isfinite(state)):
        raise InputError(
            f"controller: {type(controller).__name__} has state_dot; its attribute initial_state must be a vector of "
            f"finite numbers, got {describe_value(getattr(controller, 'initial_state', None))}"
        )
    return state


class ControllerModel:
    """A controller's own model of the plant: another mechanism with the same coordinates.

    Parameters
    ----------
    mechanism, plant : Mechanism
    convention : "rho" or "actual"
        Where C takes its velocity.

    Raises
    ------
    MechanismError
        The two mechanisms differ in their coordinates or in the independent ones.
    """

    def __init__(self, mechanism: Mechanism, plant: Mechanism, convention: CoriolisVelocity) -> None:
        for attribute in ("coordinates", "independent"):
            ours, theirs = getattr(mechanism, attribute), getattr(plant, attribute)
            if ours != theirs:
                raise MechanismError(
                    f"controller.model: its {attribute} are {', '.join(ours)}, the plant's {', '.join(theirs)}"
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
        Mechanism whose h is compensated: the plant, or the controller's own model.
    K_P, K_V : number, {joint: number} or (d, d) array
        Symmetric positive definite, in the order of `independent`; K_V may be semi-definite.
    q_d : (d,) array or {coordinate: number}
        The target.
    start : Kinematics, optional
        A configuration of the assembly branch on which h(q_d) is evaluated; default: the assembled configuration.

    Raises
    ------
    InputError
        Wrong gains, or a target that the mechanism cannot reach.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        K_P: Gain | Array,
        K_V: Gain | Array,
        q_d: Array | Mapping[str, float],
        start: Kinematics | None = None,
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
        target = sigma(mechanism, q_d, start)
        if target.verdict != "converged":
            values = ", ".join(f"{k} = {x:g}" for k, x in zip(mechanism.independent, q_d, strict=True))
            raise InputError(f"controller.q_d: the target {values} is {target.verdict}: {target.reason}")
        self.target = Terms(mechanism, target.at, np.zeros(mechanism.n))

    def u(self, t: float, terms: Terms) -> Array:
        """Return eq. 14's force."""
        return -self.K_P @ (terms.q - self.q_d) - self.K_V @ terms.q_dot + self.target.h

    def validate_attributes(self) -> None:
        """Raise InputError if attributes were replaced by values that the controller cannot use."""
        require_type(self.target, Terms, "SetPoint: target", "Terms, those at the target")
        d = self.target.mechanism.d
        for name, shape in (("K_P", (d, d)), ("K_V", (d, d)), ("q_d", (d,))):
            _require_array(getattr(self, name), shape, f"SetPoint: {name}")

    def u_rate_gradient(self, t: float, terms: Terms) -> Array:
        """Return d u / d q_dot, shape (d, d)."""
        return -self.K_V

    def lyapunov(self, t: float, terms: Terms, w: Array) -> float:
        """Return the Lyapunov function of section II-B minus its value at q_d, J."""
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
    model : ControllerModel, optional
        The controller's own model of the plant.

    Raises
    ------
    InputError
        Wrong gains, or a desired trajectory that is not such a function.
    """

    def __init__(
        self,
        Lambda: float | Array,
        K_D: float | Array,
        desired: Desired,
        model: ControllerModel | None = None,
    ) -> None:
        names = [f"coordinate {k + 1}" for k in range(_trajectory_dimension(desired))]
        if model is not None:
            require_type(model, ControllerModel, "Tracking: model", "a ControllerModel")
        Lambda, K_D = gain_matrix(Lambda, names, "Lambda"), gain_matrix(K_D, names, "K_D")
        require_positive_definite(K_D, "K_D")
        try:
            require_positive_definite(Lambda.T @ K_D, "Lambda^T K_D")
        except InputError as error:
            raise InputError(f"{error}; eq. 18's second term needs it") from None
        self.Lambda, self.K_D, self.desired, self.model = Lambda, K_D, desired, model

    def u(self, t: float, terms: Terms) -> Array:
        """Return eq. 16's force."""
        q_d, q_d_dot, q_d_ddot = self.desired(t)
        error_dot = terms.q_dot - q_d_dot
        v = q_d_dot - self.Lambda @ (terms.q - q_d)
        a = q_d_ddot - self.Lambda @ error_dot
        r = terms.q_dot - v
        model_terms = self.model(terms) if self.model else terms
        return model_terms.D @ a + model_terms.C_times(v) + model_terms.h - self.K_D @ r

    def validate_attributes(self) -> None:
        """Raise InputError if attributes were replaced by values that the controller cannot use."""
        d = _trajectory_dimension(self.desired)
        for name in ("Lambda", "K_D"):
            _require_array(getattr(self, name), (d, d), f"Tracking: {name}")
        if self.model is not None:
            require_type(self.model, ControllerModel, "Tracking: model", "a ControllerModel")

    def u_rate_gradient(self, t: float, terms: Terms) -> Array:
        """Return d u / d q_dot, shape (d, d). C is linear in its velocity, and C(x) y = C(y) x."""
        q_d, q_d_dot, _ = self.desired(t)
        v = q_d_dot - self.Lambda @ (terms.q - q_d)
        model_terms = self.model(terms) if self.model else terms
        terms_at_v = Terms(model_terms.mechanism, model_terms.at, model_terms.rho @ v)
        return terms_at_v.C - model_terms.D @ self.Lambda - self.K_D

    def lyapunov(self, t: float, terms: Terms, w: Array) -> float:
        """Return eq. 18's function with d1 = d2 = 1 and M = I, J (the part of w: m^2)."""
        q_d, q_d_dot, _ = self.desired(t)
        error = terms.q - q_d
        r = terms.q_dot - q_d_dot + self.Lambda @ error
        on_manifold = 0.5 * r @ terms.D @ r + error @ self.Lambda.T @ self.K_D @ error
        return float(on_manifold + 0.5 * w @ w)


class RecordedTorques:
    """Motor torques over time, held from each sample to the next one or interpolated linearly.

    Parameters
    ----------
    times : (k,) array
        Increasing, s; the first one at most 0.
    values : (k, motors) array
        N m or N.
    interpolates : bool
        Whether to interpolate.
    """

    def __init__(self, times: Array, values: Array, *, interpolates: bool) -> None:
        first = max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0)
        self.times, self.values, self.interpolates = times[first:], values[first:], interpolates
        self.corners = self.times if interpolates else np.zeros(0)  # where the rate of the torques jumps

    def tau(self, t: float, terms: Terms) -> Array:
        """Return the torques at time t (s), shape (motors,)."""
        if self.interpolates:
            return np.array([np.interp(t, self.times, column) for column in self.values.T])
        return np.asarray(self.values[max(int(np.searchsorted(self.times, t, side="right")) - 1, 0)])


def _require_array(value: Any, shape: tuple[int, ...], what: str) -> None:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{what}: expected an array of shape {shape} of finite numbers, got {describe_value(value)}")


def _trajectory_dimension(desired: Any) -> int:
    """Return the number of coordinates of a desired trajectory; raise InputError if it is not a trajectory."""
    takes = "a function of t that returns q_d, its rate and its acceleration, each of shape (d,)"
    if desired is None or isinstance(desired, type):
        raise InputError(f"Tracking: desired: expected {takes}, got {describe_value(desired)}")
    require_callable(desired, "Tracking: desired", takes, 1)
    at_start = desired(0.0)
    shapes = [np.shape(part) for part in at_start] if isinstance(at_start, tuple | list | np.ndarray) else []
    if len(shapes) != 3 or len(set(shapes)) != 1 or len(shapes[0]) != 1:
        raise InputError(f"Tracking: desired(0): expected {takes}, got {at_start!r:.80}")
    return int(shapes[0][0])
