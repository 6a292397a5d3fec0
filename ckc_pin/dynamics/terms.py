"""All terms at one state, each computed when first asked for.

Everything that the formulations, the controllers and the monitors need at one state (q', v') is a
property here under the paper's name. An acceleration asks for D', the bias and J, never for C'; a
controller that needs C' asks for it, and it is computed then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, lazy
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.validation import require_table
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Terms", "terms"]

SERIALIZED_TERMS = ("D_tree", "C_tree", "h_tree", "phi", "rho", "rho_dot", "D", "C", "h", "energy")


class Terms(HasSummary):
    """Dynamics of a mechanism at one state.

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics
        The closure's terms at q'.
    v_tree : (n,) array
        Velocity v' in tangent coordinates; what C', rho_dot and the bias are evaluated at.

    Notes
    -----
    Pinocchio's workspace is shared, so results are copied (`Tree.evaluate`). Units are SI; D' is (n, n), D is (d, d).
    """

    def __init__(self, mechanism: Mechanism, at: Kinematics, v_tree: Array) -> None:
        self.mechanism = mechanism
        self.at = at
        self.q_tree = at.q_tree
        self.v_tree = v_tree

    def summary(self) -> Summary:
        """Return what there is to see of it: the state, and what it can be asked for."""
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
        return Summary(f"Terms of {mechanism.name} at a state, each computed when first asked for", rows)

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
        """D', inertia of the open chains, shape (n, n)."""
        return self.mechanism.tree.evaluate(pin.crba, self.q_tree)

    @lazy
    def C_tree(self) -> Array:
        """C', the Christoffel matrix, shape (n, n)."""
        return self.mechanism.tree.evaluate(pin.computeCoriolisMatrix, self.q_tree, self.v_tree)

    @lazy
    def h_tree(self) -> Array:
        """h', gravity of the tree and its springs, whatever has a potential: shape (n,)."""
        h = self.mechanism.tree.evaluate(pin.computeGeneralizedGravity, self.q_tree)
        return h - self.spring_force if self.mechanism.springs.any else h

    @lazy
    def bias_tree(self) -> Array:
        """C' v' + h' without the matrix C', shape (n,)."""
        bias = self.mechanism.tree.evaluate(pin.nonLinearEffects, self.q_tree, self.v_tree)
        return bias - self.spring_force if self.mechanism.springs.any else bias

    @lazy
    def spring_force(self) -> Array:
        """Generalized force of the springs, shape (n,)."""
        return self.mechanism.springs.elastic_force(self.q_tree)

    @lazy
    def damping_force(self) -> Array:
        """Generalized force of dampers and of the URDF's viscous joint damping, shape (n,)."""
        return self.mechanism.springs.damping_force(self.q_tree, self.v_tree)

    @lazy
    def energy(self) -> float:
        """Kinetic energy of the tree at v', potential energy and what springs store, joules."""
        kinetic = 0.5 * float(self.v_tree @ self.D_tree @ self.v_tree)
        return kinetic + self.potential_energy

    @lazy
    def potential_energy(self) -> float:
        """V(q'), joules, zero at the world's origin."""
        gravity = float(self.mechanism.tree.evaluate(pin.computePotentialEnergy, self.q_tree))
        return gravity + self.mechanism.springs.energy(self.q_tree)

    @lazy
    def q(self) -> Array:
        """Independent coordinates q, shape (d,)."""
        return self.q_tree[self.mechanism.tree.q_index[self.at.partition.q]]

    @lazy
    def q_dot(self) -> Array:
        """Their rates, shape (d,)."""
        return self.v_tree[self.at.partition.q]

    # --- the closure, eqs. 1 to 5 ----------------------------------------------------------------

    @property
    def phi(self) -> Array:
        """Residual of the closure, shape (rows,)."""
        return self.at.phi

    @property
    def rho(self) -> Array:
        """Rho of eq. 5, shape (n, d)."""
        return self.at.rho

    @lazy
    def J_dot(self) -> Array:
        """Time derivative of J along v', shape (rows, n)."""
        return self.at.J_dot(self.v_tree)

    @lazy
    def rho_dot(self) -> Array:
        """Time derivative of rho along v', shape (n, d): J rho = 0 gives phi_z rho_dot_z = -J_dot rho."""
        rho_dot = np.zeros_like(self.rho)
        rho_dot[self.at.partition.z] = -self.at.phi_z_factor.solve(self.J_dot @ self.rho)
        return rho_dot

    def rho_dot_times(self, x: Array) -> Array:
        """Return rho_dot x, shape (n,), without the matrix."""
        product = np.zeros(len(self.rho))
        product[self.at.partition.z] = -self.at.phi_z_factor.solve(self.J_dot @ (self.rho @ x))
        return product

    # --- the reduced model, eq. 6 ----------------------------------------------------------------

    @lazy
    def D(self) -> Array:
        """Inertia of the reduced model, rho^T D' rho, shape (d, d)."""
        return self.rho.T @ self.D_tree @ self.rho

    @lazy
    def D_factor(self) -> Factorization:
        """Factorization of D."""
        return Factorization(self.D)

    @lazy
    def C(self) -> Array:
        """C = rho^T (D' rho_dot + C' rho), shape (d, d)."""
        return self.rho.T @ (self.D_tree @ self.rho_dot + self.C_tree @ self.rho)

    @lazy
    def h(self) -> Array:
        """Reduced gravity vector, rho^T h', shape (d,)."""
        return self.rho.T @ self.h_tree

    def C_times(self, x: Array) -> Array:
        """Return C x, shape (d,), without the matrix C."""
        return self.rho.T @ (self.D_tree @ self.rho_dot_times(x) + self.C_tree @ (self.rho @ x))


def terms(mechanism: Mechanism | str | Path, q: Mapping[str, float], v: Mapping[str, float] | None = None) -> Terms:
    """Return all terms at one state.

    Parameters
    ----------
    mechanism : Mechanism, or a name or path as for `load`
    q : {coordinate: value}
        The independent coordinates alone: sigma closes the loops, on the assembled branch. All
        coordinates: taken as they are, on the closure or off it.
    v : {coordinate: value}, optional
        The independent rates alone (absent ones are zero): v' = rho q_dot. All: as they are.

    Raises
    ------
    InputError
        Unknown or missing coordinates, values that are not finite, q out of reach.
    NumericalError
        q is singular.
    """
    mechanism = as_mechanism(mechanism, "terms")
    v = {} if v is None else v
    for name, table in (("q", q), ("v", v)):
        require_table(table, f"terms: {name}", f"a table by coordinate, as {{{mechanism.coordinates[0]!r}: 0.4}}")
    at = _kinematics_at(mechanism, q)
    if set(v) >= set(mechanism.coordinates) and mechanism.dependent:
        return Terms(mechanism, at, mechanism.vector(v, mechanism.coordinates, "v"))
    q_dot = mechanism.vector(v, mechanism.independent, "v", fill=0.0)
    if at.phi_z_factor.singular:
        raise NumericalError("phi_z is singular here: rho does not exist", q_tree=dict(q))
    return Terms(mechanism, at, at.rho @ q_dot)


def _kinematics_at(mechanism: Mechanism, q: Mapping[str, float]) -> Kinematics:
    if set(q) >= set(mechanism.coordinates):
        numbers = mechanism.vector(q, mechanism.coordinates, "q")
        return mechanism.kinematics(mechanism.tree.from_coordinates(numbers))
    partly = [name for name in q if name in mechanism.dependent]
    if partly:
        raise InputError(
            f"q: give the independent coordinates alone ({', '.join(mechanism.independent)}) or all of them "
            f"({', '.join(mechanism.coordinates)}); {partly[0]!r} alone does not fit"
        )
    wanted = mechanism.vector(q, mechanism.independent, "q")
    found = sigma(mechanism, wanted)
    if found.verdict == "converged":
        return found.at
    where = ", ".join(f"{name} = {x:g}" for name, x in zip(mechanism.independent, wanted, strict=True))
    if found.verdict == "singular":
        raise NumericalError(f"q: {where} is singular: {found.reason}", q_tree=dict(q))
    raise InputError(f"q: {where} is out of reach: {found.reason}")
