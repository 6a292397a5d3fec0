"""Inertias that some body can have, nearest to measured combinations and to a prior.

The pseudo-inertia P of every link stays positive definite. What the measurements leave open is as close to the prior
P_0 as possible, in a distance that depends on neither frame nor unit (Lee, Wensing, Park: Geometric robot dynamic
identification, IEEE Transactions on Robotics 36 (2020)): the Bregman divergence of the log-determinant,

    d(P, P_0) = tr(P_0^-1 P) - log det(P_0^-1 P) - 4.

Its weight is so small that it does not move what is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.identification.pseudo_inertia import basis

__all__ = ["MIN_WEIGHT", "nearest_physical"]

MAX_INFORMATION = 1e6  # of measured directions, in inverse typical sizes; more only makes the problem ill-conditioned
MIN_WEIGHT = 1e-2  # of the divergence: moves what is measured by less than 1e-2 of its standard deviation
WEIGHTS = 10.0 ** np.arange(0.0, -2.1, -0.5)  # one after the other; larger ratios take many more Newton steps in all
MAX_STEPS = 300  # of Newton's method, for each weight; each of them is feasible and better than the one before
CENTRED, CONVERGED = 0.25, 1e-12  # largest decrement at the end of a weight, and of the last one, in weights
ROUNDING = 1e-14  # relative to the value: a smaller decrease cannot be seen
MIN_DECREASE = 0.1  # of a step, relative to that of the quadratic model
LENGTHS = 0.5 ** np.arange(21)  # of steps, relative
MIN_EIGENVALUE = 1e-6  # eigenvalue in typical sizes, of links without mass or thickness
MIN_THICKNESS = 1e-3  # smallest eigenvalue of a prior of links with mass but without thickness
MASSLESS_WEIGHT = 1e-5  # of the divergence of links without mass, relative: they can grow to what is measured
ZERO, ZERO_WEIGHT = 1e-3, 1e-2  # typical sizes of positive numbers that start at zero, and their weight, relative
MIN_COLUMN = 1e-6  # makes steps of unknowns zero that neither the measurements nor a divergence determine


def nearest_physical(
    measured: Array, determined: Array, information: Array, start: Array, scale: Array, bodies: Sequence[IntArray],
    positive: IntArray, weight: float,
) -> Array:  # fmt: skip
    """Return all unknowns, in typical sizes, as steps from their start values.

    Parameters
    ----------
    measured : (p,) array
        Step that was measured, in the determined directions.
    determined : (p, r) array
        Orthonormal basis of these directions.
    information : (r,) array
        Inverse standard deviations along them.
    start, scale : (p,) arrays
        Start values and typical sizes in SI units.
    bodies : sequence of (10,) index arrays
        Unknowns that are the inertial numbers of a link.
    positive : index array
        Unknowns that cannot be negative, such as friction.
    weight : float
        Of the divergence.
    """
    problem = _Problem(measured, (determined * np.minimum(information, MAX_INFORMATION)).T, start / scale, positive)
    problem.add_bodies(bodies, start, scale)
    x = problem.prior
    for w in (*WEIGHTS[1.01 * weight < WEIGHTS], weight):
        tolerance = CONVERGED if w == weight else CENTRED
        for _ in range(MAX_STEPS):
            value = problem.value(x, w)
            matrix, residual = problem.newton_equations(x, w)
            Q, R = np.linalg.qr(matrix)
            slope = Q.T @ residual
            step, decrement = -solve_triangular(R, slope), float(slope @ slope)
            if decrement <= max(tolerance * w, ROUNDING * abs(value)):
                break
            for length in LENGTHS:
                if problem.value(x + length * step, w) <= value - MIN_DECREASE * length * decrement:
                    x = x + length * step
                    break
            else:
                break  # the decrease is below rounding
    return x


class _Problem:
    """The objective of `nearest_physical` in typical sizes: weighted squares, divergences and the positive numbers.

    Parameters
    ----------
    measured : (p,) array
    rows : (r, p) array
        Determined directions, weighted.
    start : (p,) array
    positive : index array

    Attributes
    ----------
    prior : (p,) array
        The step that the divergence is measured from.
    """

    def __init__(self, measured: Array, rows: Array, start: Array, positive: IntArray) -> None:
        self.measured, self.rows, self.positive = measured, rows, positive
        self.first, self.sizes = start[positive], np.maximum(start[positive], ZERO)
        self.number_shares = np.where(self.first < ZERO, ZERO_WEIGHT, 1.0)
        self.prior = np.zeros(len(start))
        self.prior[positive] = self.sizes - self.first

    def add_bodies(self, bodies: Sequence[IntArray], start: Array, scale: Array) -> None:
        """Add the divergence of links, whose ten numbers have these indices."""
        self.at = np.reshape(bodies, (-1, 10)).astype(np.intp)
        bound = {*self.at.ravel().tolist(), *self.positive.tolist()}
        self.free = MIN_COLUMN * np.eye(len(start))[[k for k in range(len(start)) if k not in bound]]
        unit = np.sqrt(scale[self.at[:, [4, 4, 4, 0]]])  # kg^(1/2) m, and kg^(1/2)
        self.basis = basis() * scale[self.at][..., None, None] / (unit[:, None, :, None] * unit[:, None, None, :])
        self.offset = np.einsum("li,lijk->ljk", (start / scale)[self.at], self.basis)
        values, axes = np.linalg.eigh(self.offset)
        has_mass = values[:, -1:] > MIN_EIGENVALUE
        values = np.where(
            values < MIN_EIGENVALUE, np.where(has_mass, MIN_THICKNESS * values[:, -1:], MIN_EIGENVALUE), values
        )
        priors = (axes * values[:, None, :]) @ axes.swapaxes(1, 2)
        self.inverse = np.linalg.inv(priors)
        self.shares = np.where(has_mass[:, 0], 1.0, MASSLESS_WEIGHT)  # of the weight, by link
        for at, one, prior, offset in zip(self.at, self.basis, priors, self.offset, strict=True):
            self.prior[at] = np.linalg.lstsq(one.reshape(10, 16).T, (prior - offset).ravel(), rcond=None)[0]

    def _pseudo_inertias(self, x: Array) -> Array:
        return self.offset + np.einsum("li,lijk->ljk", x[self.at], self.basis)

    def value(self, x: Array, weight: float) -> float:
        """Return the objective at a step (p,), infinite if a body cannot exist."""
        P, numbers, off = self._pseudo_inertias(x), self.first + x[self.positive], self.rows @ (x - self.measured)
        if np.any(numbers <= 0):
            return np.inf
        try:
            diagonal = np.diagonal(np.linalg.cholesky(P), axis1=1, axis2=2)
        except np.linalg.LinAlgError:
            return np.inf
        divergence = self.shares @ (np.sum(self.inverse * P, axis=(1, 2)) - 2 * np.sum(np.log(diagonal), axis=1))
        of_numbers = self.number_shares @ (numbers / self.sizes - np.log(numbers))
        return float(0.5 * off @ off + weight * (divergence + of_numbers))

    def newton_equations(self, x: Array, weight: float) -> tuple[Array, Array]:
        """Return M and r: the gradient of the objective is M^T r, and its Hessian M^T M.

        With P = L L^T, the Hessian of the divergence is J^T J for J = L^-1 dP L^-T, and its gradient is
        J^T (L^T P_0^-1 L - 1). A solution in these factors keeps twice the digits.
        """
        p, bodies, roots = len(x), len(self.at), (weight * self.shares)[:, None] ** 0.5
        L = np.linalg.cholesky(self._pseudo_inertias(x))
        half = np.linalg.solve(L[:, None], self.basis)
        factors = np.linalg.solve(L[:, None], half.swapaxes(2, 3)).reshape(bodies, 10, 16).swapaxes(1, 2)
        of_bodies = np.zeros((bodies, 16, p))
        np.put_along_axis(of_bodies, np.repeat(self.at[:, None], 16, axis=1), factors, axis=2)
        numbers = self.first + x[self.positive]
        of_positive = np.eye(p)[self.positive] / numbers[:, None]
        root = (weight * self.number_shares) ** 0.5
        rows = (self.rows, (roots[:, :, None] * of_bodies).reshape(-1, p), root[:, None] * of_positive, self.free)
        off = roots * (L.swapaxes(1, 2) @ self.inverse @ L - np.eye(4)).reshape(bodies, 16)
        residual = (self.rows @ (x - self.measured), off.ravel(), root * (numbers / self.sizes - 1), self.free @ x)
        return np.vstack(rows), np.concatenate(residual)
