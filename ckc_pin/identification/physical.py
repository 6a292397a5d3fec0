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

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import NumericalError
from ckc_pin.identification.pseudo_inertia import basis

__all__ = ["nearest_physical"]

MAX_INFORMATION = 1e3  # of measured directions, in inverse typical sizes; more only makes the problem ill-conditioned
WEIGHTS = (1e-1, 1e-3, 1e-5, 1e-7)  # of the divergence, one after the other
MAX_STEPS, STEP_TOLERANCE = 500, 1e-12
MIN_EIGENVALUE = 1e-6  # of a prior, relative to its largest in typical sizes: links without mass


def nearest_physical(
    measured: Array, determined: Array, information: Array, start: Array, scale: Array, bodies: Sequence[IntArray],
    positive: IntArray,
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

    Raises
    ------
    NumericalError
        Newton's method does not converge.
    """
    rows = (determined * np.minimum(information, MAX_INFORMATION)).T
    terms = [_Divergence(at, start, scale) for at in bodies]
    x = np.zeros(len(start))
    for term in terms:
        x[term.at] = term.first - start[term.at] / scale[term.at]
    prior = np.maximum(start[positive] / scale[positive], 1e-3)
    x[positive] = prior - start[positive] / scale[positive]
    for weight in WEIGHTS:
        for _ in range(MAX_STEPS):
            value, gradient, hessian = _objective(x, rows, measured, terms, positive, prior, start / scale, weight)
            step = -np.linalg.solve(hessian, gradient)
            if -gradient @ step <= STEP_TOLERANCE * weight:
                break
            length = 1.0
            while length > 1e-10:
                trial = x + length * step
                if _objective(trial, rows, measured, terms, positive, prior, start / scale, weight)[0] < value:
                    break
                length /= 2
            else:
                break  # the decrease is below rounding
            x = x + length * step
        else:
            raise NumericalError(
                "identify: no physically consistent parameters were found; Newton's method did not converge"
            )
    return x


class _Divergence:
    """d(P, P_0) of one link, of its numbers in typical sizes."""

    def __init__(self, at: IntArray, start: Array, scale: Array) -> None:
        self.at = at
        unit = np.sqrt(scale[at[[4, 4, 4, 0]]])  # kg^(1/2) m, and kg^(1/2)
        self.basis = basis() * scale[at][:, None, None] / np.outer(unit, unit)
        self.offset = np.einsum("i,ijk->jk", start[at] / scale[at], self.basis)
        values, axes = np.linalg.eigh(self.offset)
        values = np.maximum(values, MIN_EIGENVALUE * max(float(values[-1]), 1.0))
        prior = (axes * values) @ axes.T
        self.inverse = np.linalg.inv(prior)
        self.first = np.linalg.lstsq(self.basis.reshape(10, 16).T, prior.ravel(), rcond=None)[0]

    def evaluate(self, x: Array) -> tuple[float, Array, Array] | None:
        """Return value, gradient and Hessian at a step (10,); None if the body cannot exist."""
        P = self.offset + np.einsum("i,ijk->jk", x, self.basis)
        try:
            L = np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return None
        slopes = np.linalg.solve(P, self.basis)
        value = float(np.sum(self.inverse * P)) - 2 * float(np.sum(np.log(np.diag(L))))
        gradient = np.einsum("jk,ijk->i", self.inverse, self.basis) - np.trace(slopes, axis1=1, axis2=2)
        return value, gradient, np.einsum("ajk,bkj->ab", slopes, slopes)


def _objective(
    x: Array, rows: Array, measured: Array, terms: Sequence[_Divergence], positive: IntArray, prior: Array,
    start: Array, weight: float,
) -> tuple[float, Array, Array]:  # fmt: skip
    off = rows @ (x - measured)
    value, gradient, hessian = 0.5 * float(off @ off), rows.T @ off, rows.T @ rows
    hessian += 1e-12 * np.eye(len(x))
    for term in terms:
        part = term.evaluate(x[term.at])
        if part is None:
            return np.inf, gradient, hessian
        value += weight * part[0]
        gradient[term.at] += weight * part[1]
        hessian[np.ix_(term.at, term.at)] += weight * part[2]
    numbers = start[positive] + x[positive]
    if np.any(numbers <= 0):
        return np.inf, gradient, hessian
    value += weight * float(np.sum(numbers / prior - np.log(numbers)))
    gradient[positive] += weight * (1 / prior - 1 / numbers)
    hessian[positive, positive] += weight / numbers**2
    return value, gradient, hessian
