"""The terms of the state that the loop is at, for a caller's controller or event: as the loop has computed them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.control.actuation import require_tau, require_u
from ckc_pin.control.controllers import Controller, TorqueController, is_torque_controller
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["LoopTerms", "controller_call", "event_call", "require_number"]

NATIVE = ("D_tree", "C_tree", "h_tree", "bias_tree", "potential_energy", "D", "C", "h", "rho_dot")


class LoopTerms(Terms):
    """Terms at the loop's state; what it does not have, and what is asked for later, NumPy computes.

    Parameters
    ----------
    mechanism : Mechanism
    given : tuple
        What the loop calls with: a view of it for as long as the call lasts, the call's number, t (s), an array of q',
        v', q and q_dot one after the other, which the next call overwrites, and the places of q and z.
    """

    def __init__(self, mechanism: Mechanism, given: tuple[Any, ...]) -> None:
        self.mechanism, self._given, self.t = mechanism, given, given[2]
        self._numbers = own = given[3].copy()
        d = mechanism.d
        self.q, self.q_dot = own[-2 * d : -d], own[-d:]  # at once: hardly a controller does without

    def _term(self, name: str) -> Any:
        """A term that the loop may have, or None, as when the call is over."""
        view, stamp, *_ = self._given
        return view.term(stamp, name)

    @lazy
    def q_tree(self) -> Array:
        """The tree's configuration, shape (nq,)."""
        return self._numbers[: self.mechanism.tree.nq]

    @lazy
    def v_tree(self) -> Array:
        """The tree's velocity, shape (n,)."""
        nq = self.mechanism.tree.nq
        return self._numbers[nq : nq + self.mechanism.n]

    @lazy
    def at(self) -> Kinematics:
        """The closure's terms at q'."""
        self._term("at")  # which it has not: it is told that terms are looked at
        q, z = (np.array(part, np.intp) for part in self._given[4:])
        return Kinematics(self.mechanism.tree, self.mechanism.closure, Partition(q, z), self.q_tree)

    @lazy
    def phi(self) -> Array:
        """Residual of the closure, shape (rows,)."""
        found = self._term("phi")
        return self.at.phi if found is None else found

    @lazy
    def rho(self) -> Array:
        """Rho of eq. 5, shape (n, d)."""
        found = self._term("rho")
        return self.at.rho if found is None else found

    def C_times(self, x: Array) -> Array:
        """Return C x, shape (d,)."""
        return self.C @ x


def _native(name: str) -> lazy[Any]:
    """Return a term that the loop may have."""
    reference: lazy[Any] = Terms.__dict__[name]

    def compute(terms: LoopTerms) -> Any:
        found = terms._term(name)
        return reference.compute(terms) if found is None else found

    compute.__name__, compute.__doc__ = name, reference.__doc__
    return lazy(compute)


for _name in NATIVE:
    setattr(LoopTerms, _name, _native(_name))


def controller_call(controller: Controller | TorqueController, mechanism: Mechanism) -> Callable[..., Any]:
    """Return what the loop calls for a controller that only Python knows: (view) to u or tau, or why there is none."""
    torques = is_torque_controller(controller)
    law: Callable[[float, Terms], Any] = getattr(controller, "tau" if torques else "u")
    require = require_tau if torques else require_u

    def call(*given: Any) -> Any:
        try:
            return require(law(given[2], LoopTerms(mechanism, given)), mechanism)
        except NumericalError as error:
            return str(error)

    return call


def event_call(function: Callable[[float, Terms], Any], name: str, mechanism: Mechanism) -> Callable[..., Any]:
    """Return what the loop calls for an event's function: (view) to a number, or why there is none."""

    def call(*given: Any) -> Any:
        try:
            value = function(given[2], LoopTerms(mechanism, given))
        except NumericalError as error:
            return str(error)
        if isinstance(value, bool | np.bool_):
            says = "a number that changes sign where it happens is needed, as t - 0.5 is one for t > 0.5"
            raise InputError(f"the event {name!r} gave {bool(value)}; {says}")
        return require_number(value, f"the event {name!r}")

    return call


def require_number(value: Any, what: str) -> float:
    """Return what a caller's function gave as a float.

    Raises
    ------
    InputError
        It is no real number, or too large for one.
    """
    number = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise InputError(f"{what} gave {value!r:.80}; a number is needed")
    try:
        return float(number)
    except OverflowError:
        raise InputError(f"{what} gave an integer too large for a number") from None
