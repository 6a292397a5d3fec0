"""What the step loop needs of a formulation, and what its coordinates need to be coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ckc_pin.dynamics.formulations import spf_z_dot
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array

__all__ = ["Counts", "Force", "Gradient", "Rhs", "System", "nearly_singular", "require_chart", "spf_velocity"]

CHART_MARGIN = 1e-5  # of |J|: phi_z's least singular value at which q has stopped to be a chart
DIFFERENCE = 1.5e-8  # step of forward differences, rad or m

Force = Callable[[float, Terms], Array]  # u' on the tree at (t, terms)
Gradient = Callable[[float, Terms], Array | None]  # d u / d q_dot at (t, terms); None where it is not known
Rhs = Callable[[float, Array], Array]


@dataclass
class Counts:
    """Work done by a system: Newton corrections, factorizations, changes of the partition."""

    newton: int = 0
    factorizations: int = 0
    switches: int = 0


class System(Protocol):
    """What the step loop needs of a formulation.

    Attributes
    ----------
    positions : int
        How many leading entries of y are positions whose rates are the next as many; 0 when they are not.
    projects : bool
        Whether `accept` edits the state.
    backend : "python" or "native"
        What evaluates the right-hand side.
    held : int
        How many directions of y the closure holds still: as many eigenvalues of `jacobian` say nothing.
    """

    mechanism: Mechanism
    counts: Counts

    @property
    def backend(self) -> str: ...

    @property
    def positions(self) -> int: ...

    @property
    def projects(self) -> bool: ...

    @property
    def held(self) -> int: ...

    def start(self) -> Array:
        """Initial y."""

    def rhs(self, t: float, y: Array) -> Array:
        """f(t, y); NumericalError where it does not exist."""

    def terms(self, t: float, y: Array) -> Terms:
        """Terms at a state, on the closure if the formulation holds it."""

    def configuration(self, t: float, y: Array) -> Array:
        """Pinocchio's q at a state, as near as it is known without closing the loops, shape (nq,)."""

    def slope(self, t: float, y: Array, f: Array) -> Array:
        """y' at an accepted step, f = rhs(t, y), for interpolation."""

    def accept(self, t: float, y: Array) -> Array | None:
        """Take note of an accepted step; return y projected, or None when it stays as it is."""

    def jacobian(self, t: float, y: Array, rhs: Rhs) -> Array | None:
        """d rhs / d y, shape (len(y), len(y)); None when nothing is known that differences would not find."""

    def velocity(self, t: float, terms: Terms) -> Array:
        """The velocity of the tree, shape (n,); off the manifold the SPF's z_dot differs from rho_z q_dot."""

    def w(self, t: float) -> Array:
        """What phi should be at t, shape (rows,)."""

    def w_dot(self, t: float) -> Array:
        """What its rate should be, shape (rows,)."""


def nearly_singular(at: Kinematics, margin: float) -> str | None:
    """Say that phi_z is singular within a margin relative to J; None when it is not."""
    sigma_min = at.sigma_min()
    if not sigma_min <= margin * np.linalg.norm(at.J):
        return None
    names = at.tree.coordinates
    q, z = ([names[k] for k in part] for part in (at.partition.q, at.partition.z))
    return (
        f"phi_z is singular (its least singular value is {sigma_min:.2g}): "
        f"{', '.join(q)} do not determine {', '.join(z)} here"
    )


def require_chart(at: Kinematics) -> None:
    """Stop where q is no chart any more: results beyond would be rounding errors."""
    problem = nearly_singular(at, CHART_MARGIN)
    if problem:
        q_tree = at.tree.named(at.tree.to_coordinates(at.q_tree))
        raise NumericalError(problem, q_tree=q_tree)


def spf_velocity(terms: Terms, epsilon: float, w: Array) -> Array:
    """Velocity of the tree in the SPF, shape (n,): off the manifold z_dot is not rho_z q_dot."""
    velocity = terms.v_tree.copy()
    velocity[terms.at.partition.z] = spf_z_dot(terms.at, terms.q_dot, epsilon, w)
    return velocity
