"""Weighted least squares of equations that are linear in unknowns, and what they determine.

Unknowns are in units of their typical sizes. A direction of the unknowns is determined if its standard deviation is
smaller than half of such a unit. Every other direction is left out of the solution and of all that is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.base.linear_algebra import pivoted_columns

__all__ = ["LinearFit", "Prior", "fit_linear", "no_prior"]

Prior = tuple[Array, Array]  # equations (k, p) and right-hand sides (k,), both in standard deviations

STRUCTURAL_RANK_TOLERANCE = 1e-10  # of the largest singular value: smaller ones are rounding
MAX_STD = 0.5  # of a determined direction, in typical sizes
HUBER = 2.5  # standard deviations from which residuals are weighted down
MAX_PASSES, PASS_TOLERANCE = 30, 1e-6
WHITE = 0.05  # largest autocorrelation of residuals that count as independent
MAX_LAG = 0.05  # of the number of instants
NOISE_FLOOR = 1e-13  # of the largest right-hand side


class LinearFit(Immutable, frozen=True):
    """Solution of columns x = right in the least-squares sense, in typical sizes.

    Attributes
    ----------
    x : (p,) array
        The solution in the determined directions, zero in the others.
    covariance : (p, p) array
        Of x.
    determined : (p, r) array
        Orthonormal basis of the determined directions.
    information : (r,) array
        Inverse standard deviations along these directions for independent residuals.
    by_data : (p, k) array
        Orthonormal basis of the directions that are determined without the prior.
    influence : (m, r, d) array
        Derivatives of the solution along the determined directions with respect to the right-hand sides.
    residual : (m, d) array
    noise : (d, d) array
        Covariance of the residuals of one instant.
    weights : (m,) array
        Of the instants.
    by_prior : (r, r) array
        Part of the covariance along the determined directions that comes from errors of the prior.
    correlation_time : int
        Instants over which residuals are correlated, 0 if they are independent.
    condition : float
        Of the columns in the determined directions.
    rank : int
        Number of singular values above rounding errors.
    """

    x: Array
    covariance: Array
    determined: Array
    information: Array
    by_data: Array
    influence: Array
    residual: Array
    noise: Array
    weights: Array
    by_prior: Array
    correlation_time: int
    condition: float
    rank: int

    def with_errors(self, errors: Sequence[Array], expected: Callable[[int], Array]) -> LinearFit:
        """Take errors into account that are known to be in the residuals, and do not average out as noise does.

        Parameters
        ----------
        errors : sequence of (r, any) arrays
            Steps along the determined directions, of unit variance each.
        expected : callable
            The covariance (d, d) of these errors at instants that are `lag` apart.
        """
        sizes = np.linalg.cholesky(self.noise)
        whitening = np.linalg.inv(sizes)
        lag = _correlation_time(
            self.residual @ whitening.T, lambda k: float(np.trace(whitening @ expected(k) @ whitening.T))
        )
        covariance = self.covariance
        if not lag:
            values, vectors = np.linalg.eigh(np.eye(len(sizes)) - whitening @ expected(0) @ whitening.T)
            steps = self.influence @ (sizes @ vectors * np.sqrt(np.maximum(values, 0.0)))
            inside = np.einsum("kri,ksi->rs", steps / self.weights[:, None, None], steps) + self.by_prior
            covariance = self.determined @ inside @ self.determined.T
        for x in errors:
            covariance = covariance + self.determined @ x @ x.T @ self.determined.T
        return replace(self, covariance=covariance, correlation_time=lag)

    def combinations(self, tolerance: float) -> tuple[IntArray, Array]:
        """Return one unknown for each direction that data determine, and coefficients (k, p) of what they determine.

        Each combination contains its own unknown with coefficient 1, and none of the other chosen ones. Coefficients
        below `tolerance` of the largest one, in typical sizes, are rounding.
        """
        along = self.by_data.T @ self.determined
        order, _ = pivoted_columns(along * self.information @ self.determined.T)
        chosen = np.sort(order[: self.by_data.shape[1]])
        coefficients = np.linalg.solve(self.by_data[chosen].T, self.by_data.T)
        largest = np.abs(coefficients).max(axis=1, initial=0.0, keepdims=True)
        return chosen, np.where(np.abs(coefficients) > tolerance * largest, coefficients, 0.0)


def no_prior(p: int) -> Prior:
    """Return a prior of p unknowns that says nothing."""
    return np.zeros((0, p)), np.zeros(0)


def fit_linear(
    columns: Array, right: Array, prior: Prior, *, robust: bool = False, noise: Array | None = None,
    smallest: float = 0.0,
) -> LinearFit:  # fmt: skip
    """Solve columns x = right, (m, d, p) and (m, d), by iteratively reweighted least squares.

    The d equations of one instant are weighted by the inverse covariance of their residuals, which is estimated. With
    `robust`, instants with large residuals have less weight (Huber).

    Parameters
    ----------
    prior : pair of (k, p) and (k,) arrays
        Equations of unit variance that are known beforehand.
    noise : (m, d, d) array, optional
        Covariances of the equations that are known; estimated if absent.
    smallest : float
        Singular values of the weighted columns up to this one are errors of the columns.
    """
    m, d, p = columns.shape
    floor = NOISE_FLOOR * max(float(np.abs(right).max(initial=0.0)), 1e-300)
    weights, covariance = np.ones(m), np.eye(d)
    x = np.zeros(p)
    for k in range(MAX_PASSES):
        whitening = np.linalg.inv(np.linalg.cholesky(covariance if noise is None else noise))
        A = (whitening @ columns) * np.sqrt(weights)[:, None, None]
        b = np.einsum("...ij,...j->...i", whitening, right) * np.sqrt(weights)[:, None]
        svd = _Svd.of(A, b, prior, smallest)
        previous, x = x, svd.solve(svd.rank)
        residual = right - columns @ x
        if robust:
            sizes = np.linalg.norm(np.einsum("...ij,...j->...i", whitening, residual), axis=1) / np.sqrt(d)
            scale = max(float(np.median(sizes)) / 0.6745, 1e-300) if noise is None else 1.0
            weights = np.minimum(1.0, HUBER * scale / np.maximum(sizes, 1e-300))
        if noise is None:
            used = weights.sum() - float(np.sum(svd.u[: m * d, : svd.rank] ** 2)) / d
            covariance = np.einsum("k,ki,kj->ij", weights, residual, residual) / max(used, 1.0) + floor**2 * np.eye(d)
        is_final = noise is not None and not robust
        if is_final or (
            np.linalg.norm(x - previous) <= PASS_TOLERANCE * max(float(np.linalg.norm(x)), 1e-300) and k > 1
        ):
            break
    return _solution(
        A, b, svd, prior, residual, covariance if noise is None else noise.mean(axis=0), whitening, weights, smallest
    )


class _Svd(NamedTuple):
    """Singular value decomposition of weighted equations, with those of a prior below, and their right-hand side."""

    u: Array
    s: Array
    v: Array
    right: Array
    rank: int

    @classmethod
    def of(cls, A: Array, b: Array, prior: Prior, smallest: float) -> _Svd:
        rows, target = prior
        u, s, v = np.linalg.svd(np.vstack([A.reshape(-1, A.shape[2]), rows]), full_matrices=False)
        rank = int(np.sum(s > max(STRUCTURAL_RANK_TOLERANCE * float(s[0]), smallest, 1e-300)))
        return cls(u, s, v, np.concatenate([b.ravel(), target]), rank)

    def solve(self, count: int) -> Array:
        """Return the solution in the directions of the `count` largest singular values."""
        return np.asarray(self.v[:count].T @ ((self.u[:, :count].T @ self.right) / self.s[:count]))

    @property
    def determined(self) -> int:
        """Number of directions with a small standard deviation."""
        return int(np.sum(self.s[: self.rank] > 1.0 / MAX_STD))


def _solution(
    A: Array, b: Array, svd: _Svd, prior: Prior, residual: Array, noise: Array, whitening: Array, weights: Array,
    smallest: float,
) -> LinearFit:  # fmt: skip
    """Keep the determined directions, and estimate the covariance of x."""
    p, keep, s = A.shape[2], svd.determined, svd.s
    basis = svd.v[:keep].T
    by_data = _Svd.of(A, b, no_prior(p), smallest) if len(prior[0]) else svd
    whitened = b - A @ svd.solve(svd.rank)
    lag = _correlation_time(whitened)
    scores = np.einsum("kdp,kd->kp", A @ basis, whitened)
    meat, of_prior = np.diag(s[:keep] ** 2), (prior[0] @ basis).T @ (prior[0] @ basis)
    squares = np.outer(s[:keep] ** 2, s[:keep] ** 2)
    if lag:
        meat = scores.T @ scores + of_prior
        for k in range(1, lag + 1):
            product = scores[k:].T @ scores[:-k]
            meat += (1 - k / (lag + 1)) * (product + product.T)
    inside = meat / squares
    condition = float(s[0] / s[keep - 1]) if keep else float("inf")
    influence = ((A @ basis) * np.sqrt(weights)[:, None, None] / s[:keep] ** 2).swapaxes(1, 2) @ whitening
    return LinearFit(
        svd.solve(keep), basis @ inside @ basis.T if keep else np.zeros((p, p)), basis, s[:keep],
        by_data.v[: by_data.determined].T, influence, residual, noise, weights,
        of_prior / squares, lag, condition, svd.rank,
    )  # fmt: skip


def _correlation_time(residual: Array, expected: Callable[[int], float] = lambda lag: 0.0) -> int:
    """Return the number of instants after which residuals are as correlated as expected; 0 if neighbours are.

    Parameters
    ----------
    residual : (m, d) array
    expected : callable
        Mean product of residuals that are `lag` instants apart, which is known.
    """
    centred = residual - residual.mean(axis=0)
    power = float(np.sum(centred**2))
    for lag in range(1, max(2, int(MAX_LAG * len(residual)))):
        excess = float(np.sum(centred[lag:] * centred[:-lag])) - expected(lag) * (len(residual) - lag)
        if power <= 0 or excess <= WHITE * power:
            return 0 if lag == 1 else 2 * lag
    return int(MAX_LAG * len(residual))
