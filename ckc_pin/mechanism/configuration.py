"""Constraint terms at one configuration: phi, J, phi_q, phi_z and rho of eqs. 1 to 5."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array, Immutable, IntArray, lazy
from ckc_pin.base.linear_algebra import Factorization
from ckc_pin.base.sparse import smallest_singular_value
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Pose, Rate
from ckc_pin.mechanism.rank import scale_jacobian
from ckc_pin.mechanism.tree import Tree

__all__ = ["Kinematics", "Partition", "Psi"]


class Partition(Immutable, frozen=True):
    """The partition q' = [q; z] of eq. 2: places of the independent and of the dependent coordinates in q'."""

    q: IntArray
    z: IntArray


class Kinematics:
    """Constraint terms at one configuration. Each is computed at its first use.

    Parameters
    ----------
    tree : Tree
    closure : Closure
    partition : Partition
    q_tree : (nq,) array
    """

    def __init__(self, tree: Tree, closure: Closure, partition: Partition, q_tree: Array) -> None:
        self.tree = tree
        self.closure = closure
        self.partition = partition
        self.q_tree = q_tree
        self.pose = Pose(tree, closure.anchors, q_tree)

    @lazy
    def phi(self) -> Array:
        """Residual phi(q') of the loop closure, shape (rows,)."""
        return self.closure.phi(self.pose)

    @lazy
    def J(self) -> Array:
        """Constraint Jacobian d phi / d q', shape (rows, n), columns in the order of the tree."""
        return self.closure.jacobian(self.pose)

    @property
    def phi_q(self) -> Array:
        """Columns of J of the independent coordinates, shape (rows, d)."""
        return self.J[:, self.partition.q]

    @lazy
    def phi_z(self) -> Array:
        """Columns of J of the dependent coordinates, shape (rows, n - d)."""
        return self.J[:, self.partition.z]

    @lazy
    def phi_z_factor(self) -> Factorization:
        """Factorization of phi_z, shared by the Newton steps of sigma, rho and rho_dot."""
        return Factorization(self.phi_z)

    @lazy
    def rho(self) -> Array:
        """Rho of eq. 5, shape (n, d): v' = rho q_dot keeps phi constant."""
        rho = np.zeros((self.tree.n, len(self.partition.q)))
        rho[self.partition.q, np.arange(len(self.partition.q))] = 1.0
        rho[self.partition.z] = -self.phi_z_factor.solve(self.phi_q)
        return rho

    @lazy
    def body_jacobian(self) -> Array:
        """Derivative of phi with respect to the spatial velocities of the bodies, see `Closure.body_jacobian`."""
        return self.closure.body_jacobian(self.pose)

    def J_dot(self, v: Array) -> Array:
        """Time derivative of J along a tangent velocity v, shape (rows, n)."""
        return self.closure.jacobian_dot(self.pose, Rate(self.pose, v))

    def sigma_min(self) -> float:
        """Return the smallest singular value of phi_z, which is zero in a singular configuration; inf if z is empty."""
        if not len(self.partition.z):
            return float("inf")
        if not np.all(np.isfinite(self.phi_z)):
            return float("nan")
        return smallest_singular_value(self.phi_z)

    def margin(self) -> float:
        """Return the smallest singular value of phi_z relative to |J|, both dimensionless; inf if z is empty.

        It is zero where q does not determine the configuration.
        """
        if not len(self.partition.z):
            return float("inf")
        J = scale_jacobian(self.J, self.tree, self.closure)
        if not np.all(np.isfinite(J)):
            return float("nan")
        return smallest_singular_value(J[:, self.partition.z]) / max(float(np.linalg.norm(J)), 1e-300)

    def integrate(self, step: Array) -> Kinematics:
        """Return the kinematics at the configuration that a tangent step leads to."""
        return Kinematics(self.tree, self.closure, self.partition, self.tree.integrate(self.q_tree, step))


class Psi:
    """Psi(q', q) = [phi(q'); S q' - q] of eq. 3, for reference.

    sigma solves Psi = 0 for q'. The last d equations are solved by inserting q, so the program iterates on z only, with
    phi_z, the Schur complement of the Jacobian of Psi.

    Parameters
    ----------
    at : Kinematics
        At q'. Its tree must not have a free root.
    """

    def __init__(self, at: Kinematics) -> None:
        self.at = at

    def value(self, q: Array) -> Array:
        """Psi(q', q), shape (rows + d,)."""
        return np.concatenate([self.at.phi, self.at.q_tree[self.at.tree.q_index[self.at.partition.q]] - q])

    @property
    def jacobian(self) -> Array:
        """d Psi / d q', shape (rows + d, n)."""
        select = np.zeros((len(self.at.partition.q), self.at.tree.n))
        select[np.arange(len(self.at.partition.q)), self.at.partition.q] = 1.0
        return np.vstack([self.at.J, select])
