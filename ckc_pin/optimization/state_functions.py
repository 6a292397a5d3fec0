"""Functions of a mechanism's state (q', v', dv'/dt, tau) at many instants, with exact first and second derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.optimization.many_instants import InstantsFunction
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics

__all__ = ["ExpressionFunctions", "SmallestSingularValue", "StateFunctions"]

SHARPNESS = 50  # p of the smooth minimum: it is below the smallest of k equal numbers by the factor k^(-1 / p)


class StateFunctions(Protocol):
    """Functions of the state at m instants."""

    def values(self, at: MotionInstants) -> Array:
        """Return the functions' values, (m, functions)."""

    def gradients(self, at: MotionInstants) -> Array:
        """Return the derivatives by the state, (m, functions, entries)."""

    def hessian(self, at: MotionInstants, weights: Array) -> tuple[IntArray, Array]:
        """Return the second derivatives of weights (m, functions) times the functions, (m, k, k), by k of the entries.

        The numbers of these entries come first. The derivatives by other entries are zero.
        """


class ExpressionFunctions:
    """Functions given by CasADi expressions of the state.

    Parameters
    ----------
    dynamics : ReducedDynamics
    expressions : sequence of casadi.SX
        Of `dynamics.state_symbols`.
    """

    def __init__(self, dynamics: ReducedDynamics, expressions: Sequence[Any]) -> None:
        import casadi as cs

        symbols = list(dynamics.state_symbols)
        state, g = cs.vertcat(*symbols), cs.vertcat(*expressions)
        weights = cs.SX.sym("weights", g.numel())
        jacobian, hessian = cs.jacobian(g, state), cs.hessian(cs.dot(weights, g), state)[0]
        self._curved: IntArray = np.unique(hessian.sparsity().get_triplet()[0]).astype(np.int64)
        at = self._curved.tolist()
        self._values, self._gradients = InstantsFunction.of(symbols, [g]), InstantsFunction.of(symbols, [jacobian])
        self._hessian = InstantsFunction.of([*symbols, weights], [hessian[at, at]])

    def values(self, at: MotionInstants) -> Array:
        """Return the functions' values, (m, functions)."""
        return self._values(at.q_tree, at.v_tree, at.a_tree, at.tau)[0][:, :, 0]

    def gradients(self, at: MotionInstants) -> Array:
        """Return the derivatives by the state, (m, functions, entries)."""
        return self._gradients(at.q_tree, at.v_tree, at.a_tree, at.tau)[0]

    def hessian(self, at: MotionInstants, weights: Array) -> tuple[IntArray, Array]:
        """Return the second derivatives of weights times the functions, by some entries of the state."""
        return self._curved, self._hessian(at.q_tree, at.v_tree, at.a_tree, at.tau, weights)[0]


class SmallestSingularValue:
    """A smooth lower bound of the smallest singular value of phi_z: (sum of sigma^-p)^(-1/p).

    Singular values of mechanisms with equal legs cross, so that the smallest one has corners. The bound has none. It is
    below the smallest of k equal singular values by the factor k^(-1/p), and equals it where the others are larger.

    Parameters
    ----------
    dynamics : ReducedDynamics
    unit : float
        Unit of the value.
    """

    def __init__(self, dynamics: ReducedDynamics, unit: float = 1.0) -> None:
        import casadi as cs

        q, phi_z = dynamics.state_symbols[0], dynamics.phi_z / unit
        self._entries = dynamics.mechanism.tree.nq + 2 * dynamics.n + dynamics.motors
        self._nq = dynamics.mechanism.tree.nq
        column = cs.vec(cs.densify(phi_z))
        jacobian = cs.jacobian(column, q)
        place, self._by = (np.array(x, dtype=np.int64) for x in jacobian.sparsity().get_triplet())
        self._row, self._column = place % phi_z.shape[0], place // phi_z.shape[0]
        weights = cs.SX.sym("weights", column.numel())
        self._phi_z = InstantsFunction.of([q], [phi_z])
        self._jacobian = InstantsFunction.of([q], [cs.vertcat(*cast("list[Any]", jacobian.nonzeros()))])
        self._last: tuple[MotionInstants, tuple[Array, Array, Array, Array, Array]] | None = None
        self._second = InstantsFunction.of([q, weights], [cs.hessian(cs.dot(weights, column), q)[0]])

    def _decompose(self, at: MotionInstants) -> tuple[Array, Array, Array, Array, Array]:
        """Return singular vectors and values, the smooth minimum, and its derivatives by the values."""
        if self._last is None or self._last[0] is not at:
            U, sigma, Vt = np.linalg.svd(self._phi_z(at.q_tree)[0])
            sigma_min = sigma[:, -1:]
            bound = sigma_min * np.sum((sigma_min / sigma) ** SHARPNESS, axis=1, keepdims=True) ** (-1 / SHARPNESS)
            self._last = at, (U, sigma, Vt, bound, (bound / sigma) ** (SHARPNESS + 1))
        return self._last[1]

    def values(self, at: MotionInstants) -> Array:
        """Return the bound, (m, 1)."""
        return self._decompose(at)[3]

    def gradients(self, at: MotionInstants) -> Array:
        """Return the derivatives by the state, (m, 1, entries)."""
        U, _, Vt, _, g = self._decompose(at)
        by_phi = (U * g[:, None, :]) @ Vt
        by_entry = by_phi[:, self._row, self._column] * self._jacobian(at.q_tree)[0][:, :, 0]
        result = np.zeros((len(g), 1, self._entries))
        result[:, 0, : self._nq] = by_entry @ (self._by[:, None] == np.arange(self._nq))
        return result

    def hessian(self, at: MotionInstants, weights: Array) -> tuple[IntArray, Array]:
        """Return the second derivatives by q'."""
        U, sigma, Vt, bound, g = self._decompose(at)
        m, k = sigma.shape
        by_phi = (U * g[:, None, :]) @ Vt
        (result,) = self._second(at.q_tree, by_phi.transpose(0, 2, 1).reshape(m, -1))
        change = np.zeros((m, self._nq, k, k))  # of phi_z in singular vectors
        change[:, self._by, self._row, self._column] = self._jacobian(at.q_tree)[0][:, :, 0]
        change = U.transpose(0, 2, 1)[:, None] @ change @ Vt.transpose(0, 2, 1)[:, None]
        diagonal = np.einsum("mqii->mqi", change)
        curvature = (SHARPNESS + 1) * (g[:, :, None] * g[:, None, :] / bound[:, :, None])
        curvature[:, np.arange(k), np.arange(k)] -= (SHARPNESS + 1) * g / sigma
        result = result + diagonal @ curvature @ diagonal.transpose(0, 2, 1)
        i, j = np.triu_indices(k, 1)
        even, odd = (change[:, :, i, j] + sign * change[:, :, j, i] for sign in (1, -1))
        result = result + (even * (_slopes(g, sigma, i, j) / 2)[:, None]) @ even.transpose(0, 2, 1)
        ratio = (g[:, i] + g[:, j]) / (sigma[:, i] + sigma[:, j])
        result = result + (odd * (ratio / 2)[:, None]) @ odd.transpose(0, 2, 1)
        return np.arange(self._nq), result * weights[:, :, None]


def _slopes(g: Array, sigma: Array, i: IntArray, j: IntArray) -> Array:
    """Return (g_i - g_j) / (sigma_i - sigma_j) of g = c sigma^-(p + 1), without cancellation."""
    x = np.log(sigma[:, i] / sigma[:, j])
    y = -(SHARPNESS + 1) * x
    # g_i - g_j = g_j (exp(y) - 1), and sigma_i - sigma_j = sigma_j (exp(x) - 1).
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = g[:, j] * np.expm1(y) / (sigma[:, j] * np.expm1(x))
    return np.where(np.abs(x) < 1e-12, -(SHARPNESS + 1) * g[:, j] / sigma[:, j], slope)
