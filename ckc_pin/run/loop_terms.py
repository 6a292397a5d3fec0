"""Wrap a caller's controller or event function for the native loop, with terms that the loop has already computed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.control.actuation import require_tau, require_u
from ckc_pin.control.controllers import has_state, initial_state
from ckc_pin.control.forces import BodyForce
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["LoopTerms", "require_number", "wrap_controller", "wrap_event_function", "wrap_force"]


class _LoopTerm(lazy[Any]):
    """A term of `Terms` that is taken from the loop if the loop has computed it, and else computed in NumPy."""

    def __init__(self, name: str) -> None:
        reference: lazy[Any] = Terms.__dict__[name]

        def compute(terms: LoopTerms) -> Any:
            value = terms._read_from_loop(name)
            return reference.compute(terms) if value is None else value

        super().__init__(compute)
        self.name, self.__doc__ = name, reference.__doc__


class LoopTerms(Terms):
    """Terms at the loop's state, passed to a caller's controller or event function.

    Terms that the loop has not computed, and terms that are used after the call, are computed in NumPy.

    Parameters
    ----------
    mechanism : Mechanism
    call : tuple
        Arguments of the native call: a view of the loop that is valid during the call, the call's number, t (s), an
        array of q', v', q and q_dot one after the other, which the next call overwrites, and the indices of q and z.
    """

    D_tree = _LoopTerm("D_tree")
    C_tree = _LoopTerm("C_tree")
    h_tree = _LoopTerm("h_tree")
    bias_tree = _LoopTerm("bias_tree")
    potential_energy = _LoopTerm("potential_energy")
    D = _LoopTerm("D")
    C = _LoopTerm("C")
    h = _LoopTerm("h")
    rho_dot = _LoopTerm("rho_dot")

    def __init__(self, mechanism: Mechanism, call: tuple[Any, ...]) -> None:
        self.mechanism, self._call, self.t = mechanism, call, call[2]
        self._packed = packed = call[3].copy()
        d = mechanism.d
        self.q, self.q_dot = packed[-2 * d : -d], packed[-d:]  # almost every controller reads them

    def _read_from_loop(self, name: str) -> Any:
        """Return a term of the loop. It is None if the loop has not computed it, or if the call is over."""
        view, stamp, *_ = self._call
        return view.term(stamp, name)

    @lazy
    def q_tree(self) -> Array:
        """The tree's configuration, shape (nq,)."""
        return self._packed[: self.mechanism.tree.nq]

    @lazy
    def v_tree(self) -> Array:
        """The tree's velocity, shape (n,)."""
        nq = self.mechanism.tree.nq
        return self._packed[nq : nq + self.mechanism.n]

    @lazy
    def at(self) -> Kinematics:
        """The closure's terms at q'."""
        self._read_from_loop("at")  # The loop has no such term. The call tells it that terms of the closure are used.
        q, z = (np.array(indices, np.intp) for indices in self._call[4:])
        return Kinematics(self.mechanism.tree, self.mechanism.closure, Partition(q, z), self.q_tree)

    @lazy
    def phi(self) -> Array:
        """Residual of the closure, shape (rows,)."""
        phi = self._read_from_loop("phi")
        return self.at.phi if phi is None else phi

    @lazy
    def rho(self) -> Array:
        """Rho of eq. 5, shape (n, d)."""
        rho = self._read_from_loop("rho")
        return self.at.rho if rho is None else rho

    def C_times(self, x: Array) -> Array:
        """Return C x, shape (d,)."""
        return self.C @ x


def wrap_controller(controller: Any, method: str, mechanism: Mechanism) -> Callable[..., Any]:
    """Return the function that the loop calls for a method of a controller written in Python.

    It returns u, tau or the rate of the controller's state, or the text of a NumericalError, at which the run stops.

    Parameters
    ----------
    controller : Controller or TorqueController
    method : "u", "tau" or "state_dot"
    mechanism : Mechanism
    """
    law: Callable[..., Any] = getattr(controller, method)
    takes_state, size = has_state(controller), len(initial_state(controller))

    def require(value: Any) -> Array:
        if method != "state_dot":
            return (require_tau if method == "tau" else require_u)(value, mechanism)
        rate = np.asarray(value, dtype=float)
        if rate.shape != (size,) or not np.all(np.isfinite(rate)):
            raise InputError(f"controller: state_dot: expected {size} finite numbers, got {value!r:.80}")
        return rate

    def call(*arguments: Any) -> Any:
        state = (arguments[0].law_state,) if takes_state else ()
        try:
            return require(law(arguments[2], LoopTerms(mechanism, arguments), *state))
        except NumericalError as error:
            return str(error)

    return call


def wrap_force(force: BodyForce, mechanism: Mechanism) -> Callable[..., Any]:
    """Return the function that the loop calls for a force that is a function of the state."""

    def call(*arguments: Any) -> Any:
        try:
            return force.values(arguments[2], LoopTerms(mechanism, arguments))
        except NumericalError as error:
            return str(error)

    return call


def wrap_event_function(function: Callable[[float, Terms], Any], name: str, mechanism: Mechanism) -> Callable[..., Any]:
    """Return the function that the loop calls for an event function written in Python.

    It returns a number, or the text of a NumericalError, at which the run stops.
    """

    def call(*arguments: Any) -> Any:
        try:
            value = function(arguments[2], LoopTerms(mechanism, arguments))
        except NumericalError as error:
            return str(error)
        if isinstance(value, bool | np.bool_):
            raise InputError(
                f"the event {name!r} gave {bool(value)}; a number that changes sign at the event is needed, "
                "for example t - 0.5 instead of t > 0.5"
            )
        return require_number(value, f"the event {name!r}")

    return call


def require_number(value: Any, source: str) -> float:
    """Return a caller's result as a float.

    Raises
    ------
    InputError
        It is not a real number, or too large for a float.
    """
    number = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise InputError(f"{source} gave {value!r:.80}; a number is needed")
    try:
        return float(number)
    except OverflowError:
        raise InputError(f"{source} gave an integer that is too large for a float") from None
