"""Terms of the equations of motion at one state, each computed at its first use.

All quantities that formulations, controllers and monitors need at a state (q', v') are properties of `Terms`, under
the paper's names. An acceleration requires D', the bias and J, but not the matrix C', so C' is computed only for a
controller that uses it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.toml_writer import to_toml_value
from ckc_pin.base.validation import is_array, require_table
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Terms", "terms"]

SERIALIZED_TERMS = ("D_tree", "C_tree", "h_tree", "phi", "rho", "rho_dot", "D", "C", "h", "energy")


class Terms(HasSummary):
    """Terms of the equations of motion of a mechanism at one state.

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics
        The constraint terms at q'.
    v_tree : (n,) array
        Velocity v' in tangent coordinates, at which C', rho_dot and the bias are evaluated.
    t : float
        Time of the state, s.

    Notes
    -----
    Units are SI. Results are copies, since Pinocchio's workspace is shared (`Tree.evaluate`).
    """

    def __init__(self, mechanism: Mechanism, at: Kinematics, v_tree: Array, t: float = 0.0) -> None:
        self.mechanism = mechanism
        self.t = t
        self.at = at
        self.q_tree = at.q_tree
        self.v_tree = v_tree

    def summary(self) -> Summary:
        """Return the state, energy and closure error, and the names and shapes of the terms."""
        mechanism, tree = self.mechanism, self.mechanism.tree
        names, n, d = mechanism.coordinates, mechanism.n, mechanism.d
        rows: list[Row] = [
            ("q_tree", format_quantities(names, tree.to_coordinates(self.q_tree), tree.units())),
            ("v_tree", format_quantities(names, self.v_tree, tree.units("/s"))),
            ("energy", f"{self.energy:.9g} J"),
            ("largest |phi|", f"{np.abs(self.phi).max(initial=0.0):.2g}"),
            ("of the tree", [f"D_tree {n, n}", f"C_tree {n, n}", f"h_tree ({n},)"]),
            ("reduced", [f"D {d, d}", f"C {d, d}", f"h ({d},)", f"rho {n, d}", f"rho_dot {n, d}"]),
        ]
        return Summary(f"Terms of {mechanism.name} at a state, each computed at its first use", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return state and terms as JSON-ready data; this computes all of them."""
        mechanism = self.mechanism
        state = {
            "coordinates": mechanism.coordinates,
            "independent": mechanism.independent,
            "dependent": mechanism.dependent,
            "q_tree": mechanism.tree.to_coordinates(self.q_tree).tolist(),
            "v_tree": self.v_tree.tolist(),
            "phi_q": self.at.phi_q.tolist(),
            "phi_z": self.at.phi_z.tolist(),
        }
        return state | {name: np.asarray(getattr(self, name)).tolist() for name in SERIALIZED_TERMS}

    # --- the tree, eq. 1 -------------------------------------------------------------------------

    @lazy
    def D_tree(self) -> Array:
        """Inertia matrix D' of the tree, shape (n, n)."""
        return self.mechanism.tree.mass_matrix(self.q_tree)

    @lazy
    def C_tree(self) -> Array:
        """Coriolis matrix C' of the tree from Christoffel symbols, shape (n, n)."""
        return self.mechanism.tree.evaluate(pin.computeCoriolisMatrix, self.q_tree, self.v_tree)

    @lazy
    def h_tree(self) -> Array:
        """Generalized gravity h' of the tree, including springs and constant forces, shape (n,)."""
        h = self.mechanism.tree.evaluate(pin.computeGeneralizedGravity, self.q_tree)
        return h - self.spring_force if self.mechanism.springs.any else h

    @lazy
    def bias_tree(self) -> Array:
        """C' v' + h', computed without the matrix C', shape (n,)."""
        bias = self.mechanism.tree.evaluate(pin.nonLinearEffects, self.q_tree, self.v_tree)
        return bias - self.spring_force if self.mechanism.springs.any else bias

    @lazy
    def spring_force(self) -> Array:
        """Generalized force of springs and constant forces, shape (n,)."""
        return self.mechanism.springs.elastic_force(self.q_tree)

    @lazy
    def damping_force(self) -> Array:
        """Generalized force of dampers and viscous joint damping, shape (n,)."""
        return self.mechanism.springs.damping_force(self.q_tree, self.v_tree)

    @lazy
    def energy(self) -> float:
        """Kinetic energy at v' plus potential energy, joules."""
        kinetic = 0.5 * float(self.v_tree @ self.D_tree @ self.v_tree)
        return kinetic + self.potential_energy

    @lazy
    def potential_energy(self) -> float:
        """Potential energy of gravity, springs and constant forces, joules; gravity's is zero at the world's origin."""
        gravity = float(self.mechanism.tree.evaluate(pin.computePotentialEnergy, self.q_tree))
        return gravity + self.mechanism.springs.energy(self.q_tree)

    @lazy
    def q(self) -> Array:
        """Independent coordinates q, shape (d,)."""
        return self.q_tree[self.mechanism.tree.q_index[self.at.partition.q]]

    @lazy
    def q_dot(self) -> Array:
        """Independent velocities q_dot, shape (d,)."""
        return self.v_tree[self.at.partition.q]

    # --- the closure, eqs. 1 to 5 ----------------------------------------------------------------

    @property
    def phi(self) -> Array:
        """Residual of the closure, shape (rows,)."""
        return self.at.phi

    @property
    def rho(self) -> Array:
        """Rho of eq. 5, shape (n, d): v' = rho q_dot."""
        return self.at.rho

    @lazy
    def J_dot(self) -> Array:
        """Time derivative of J along v', shape (rows, n)."""
        return self.at.J_dot(self.v_tree)

    @lazy
    def rho_dot(self) -> Array:
        """Time derivative of rho along v', shape (n, d), from J rho = 0: phi_z rho_dot_z = -J_dot rho."""
        rho_dot = np.zeros_like(self.rho)
        rho_dot[self.at.partition.z] = -self.at.phi_z_factor.solve(self.J_dot @ self.rho)
        return rho_dot

    def rho_dot_times(self, x: Array) -> Array:
        """Return rho_dot x, shape (n,), without computing the matrix rho_dot."""
        product = np.zeros(len(self.rho))
        product[self.at.partition.z] = -self.at.phi_z_factor.solve(self.J_dot @ (self.rho @ x))
        return product

    # --- the reduced model, eq. 6 ----------------------------------------------------------------

    @lazy
    def D(self) -> Array:
        """Inertia matrix of the reduced model, D = rho^T D' rho, shape (d, d)."""
        return self.rho.T @ self.D_tree @ self.rho

    @lazy
    def D_factor(self) -> Factorization:
        """Factorization of D."""
        return Factorization(self.D)

    @lazy
    def C(self) -> Array:
        """Coriolis matrix of the reduced model, C = rho^T (D' rho_dot + C' rho), shape (d, d)."""
        return self.rho.T @ (self.D_tree @ self.rho_dot + self.C_tree @ self.rho)

    @lazy
    def h(self) -> Array:
        """Gravity vector of the reduced model, h = rho^T h', shape (d,)."""
        return self.rho.T @ self.h_tree

    def C_times(self, x: Array) -> Array:
        """Return C x, shape (d,), without computing the matrix C."""
        return self.rho.T @ (self.D_tree @ self.rho_dot_times(x) + self.C_tree @ (self.rho @ x))


def terms(
    mechanism: Mechanism | str | Path,
    q: Mapping[str, float] | Sequence[float] | Array,
    v: Mapping[str, float] | Sequence[float] | Array | None = None,
) -> Terms:
    """Return the terms of the equations of motion at one state.

    Parameters
    ----------
    mechanism : Mechanism, or a name or path as for `load`
    q : {coordinate: value} or array
        Either the independent coordinates: sigma closes the loops, on the assembled branch. Or all coordinates: they
        are used as they are, whether they close the loops or not. An array is in the order of `independent` or of
        `coordinates`.
    v : {coordinate: value} or array, optional
        Either independent velocities, zero by default: v' = rho q_dot. Or all velocities, used as they are.

    Raises
    ------
    InputError
        Unknown or missing coordinates, values that are not finite numbers, or q out of reach.
    NumericalError
        The configuration is singular.
    """
    mechanism = as_mechanism(mechanism, "terms")
    q, v = (
        _as_table(mechanism, values, f"terms: {name}") for name, values in (("q", q), ("v", {} if v is None else v))
    )
    at = _kinematics_at(mechanism, q)
    if set(v) >= set(mechanism.coordinates) and mechanism.dependent:
        return Terms(mechanism, at, mechanism.vector(v, mechanism.coordinates, "v"))
    q_dot = mechanism.vector(v, mechanism.independent, "v", fill=0.0)
    if at.phi_z_factor.singular:
        raise NumericalError("phi_z is singular here: rho does not exist", q_tree=dict(q))
    return Terms(mechanism, at, at.rho @ q_dot)


def _as_table(mechanism: Mechanism, values: Any, where: str) -> Mapping[str, float]:
    """Return values by coordinate; an array is in the order of `independent` or `coordinates` (InputError)."""
    if is_array(values):
        return mechanism.name_values(to_toml_value(values), where, mechanism.independent, mechanism.coordinates)
    expected = f"a table by coordinate, as {{{mechanism.coordinates[0]!r}: 0.4}}, or an array"
    require_table(values, where, expected)
    return dict(values)


def _kinematics_at(mechanism: Mechanism, q: Mapping[str, float]) -> Kinematics:
    if set(q) >= set(mechanism.coordinates):
        numbers = mechanism.vector(q, mechanism.coordinates, "q")
        return mechanism.kinematics(mechanism.tree.from_coordinates(numbers))
    dependent = [name for name in q if name in mechanism.dependent]
    if dependent:
        raise InputError(
            f"q: expected the independent coordinates ({', '.join(mechanism.independent)}) or all coordinates "
            f"({', '.join(mechanism.coordinates)}), got {dependent[0]!r} without the others"
        )
    values = mechanism.vector(q, mechanism.independent, "q")
    solution = sigma(mechanism, values)
    if solution.verdict == "converged":
        return solution.at
    where = ", ".join(f"{name} = {x:g}" for name, x in zip(mechanism.independent, values, strict=True))
    if solution.verdict == "singular":
        raise NumericalError(f"q: {where} is singular: {solution.reason}", q_tree=dict(q))
    raise InputError(f"q: {where} is out of reach: {solution.reason}")
