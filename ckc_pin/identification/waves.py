"""Band-limited functions fitted to a measured quantity: waves whose period is twice the length of the record.

A smooth motion has no frequencies above some limit. Noise of higher ones is then filtered out completely, whereas a
spline with enough knots for the motion passes noise up to 1.6 times the limit: four times the variance or more in
accelerations. As the period is longer than the record, the motion need not be periodic (a Fourier extension). The
amplitudes have normal distributions with the standard deviation of the measurements, which decides what the record
leaves open, at its ends and in gaps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.identification.smooth_fit import SmoothFit, describe_errors

__all__ = ["WaveFit", "fit_waves"]

PERIOD = 2.0  # lengths of the record
GROWTH = 1.06  # between numbers of waves that are compared
MORE_WAVES = 1.15  # times the best number: what cross-validation leaves out is small beside the noise of values only
MIN_SHARE, MAX_SHARE = 0.3, 1.3  # of the knot intervals of the best spline: numbers of waves that are compared
MAX_WAVES = 300  # of which the normal equations are solved in reasonable time
MIN_NOISE = 1e-5  # relative to the measurements; less is lost in the rounding errors of the normal equations
MIN_MEASUREMENTS_PER_NUMBER = 2.0


class WaveFit(SmoothFit, frozen=True):
    """Waves fitted to one measured quantity.

    Attributes
    ----------
    centre, offset : float
        Of the times, s, and of the values.
    omega : (K,) array
        Angular frequencies, rad/s.
    amplitudes : (1 + 2 K,) array
        Of a constant, the cosines and the sines.
    factor : (1 + 2 K, 1 + 2 K) array
        Its product with its transpose is the covariance of the amplitudes for unit noise.
    """

    centre: float
    offset: float
    omega: Array
    amplitudes: Array
    factor: Array

    def values(self, t: Array) -> Array:
        """Return value, rate and acceleration, shape (3, len(t))."""
        rows = [_waves(t - self.centre, self.omega, k) @ self.amplitudes for k in range(3)]
        return np.array([rows[0] + self.offset, *rows[1:]])

    def errors(self, t: Array, gains: Array) -> Array:
        """Return errors of sums of gains times value, rate and acceleration; see `SmoothFit.errors`."""
        sums = sum(gain.T @ _waves(t - self.centre, self.omega, k) for k, gain in enumerate(gains))
        return np.asarray(self.noise * (sums @ self.factor))


class _Solution(NamedTuple):
    """Waves fitted to measurements: their score of cross-validation, amplitudes, and the factor of the covariance."""

    score: float
    waves: int
    amplitudes: Array
    factor: Array
    noise: float


def fit_waves(t: Array, y: Array, intervals: int, score: float, noise: float | None) -> WaveFit | None:
    """Fit waves to measurements, and return them if their score of cross-validation is lower than that of a spline.

    Parameters
    ----------
    t, y : (m,) arrays
    intervals : int
        Knot intervals of the best spline.
    score : float
        Its score, about the variance of the noise.
    noise : float, optional
        Standard deviation of a measurement, estimated if absent.
    """
    size, length = float(np.std(y)), t[-1] - t[0]
    limit = int(min(MAX_WAVES, (len(t) / MIN_MEASUREMENTS_PER_NUMBER - 1) / 2))
    counts = np.unique(np.round(MIN_SHARE * intervals * GROWTH ** np.arange(27)).astype(int))
    counts = counts[(counts >= 2) & (counts <= min(MAX_SHARE * intervals, limit / MORE_WAVES))]
    if not len(counts) or score**0.5 < MIN_NOISE * size:
        return None
    centre, offset = float(t.mean()), float(y.mean())
    largest = int(np.ceil(MORE_WAVES * counts[-1]))
    omega = 2 * np.pi * np.arange(1, largest + 1) / (PERIOD * length)
    rows = _waves(t - centre, omega, 0)
    equations = rows.T @ rows, rows.T @ (y - offset), float(np.sum((y - offset) ** 2)), len(t)
    best = min((_solve(*equations, int(count), score / size**2) for count in counts), key=lambda x: x.score)
    if best.score > score:
        return None
    chosen = _solve(*equations, int(np.ceil(MORE_WAVES * best.waves)), score / size**2)
    omega = omega[: chosen.waves]
    noise = chosen.noise if noise is None else noise

    def variance(at: Array, order: int) -> Array:
        return np.asarray(np.sum((_waves(at - centre, omega, order) @ chosen.factor) ** 2, axis=1))

    std, span = describe_errors(variance, t)
    return WaveFit(
        noise, noise * std, length / chosen.waves, span, centre, offset, omega, chosen.amplitudes, chosen.factor
    )


def _waves(t: Array, omega: Array, order: int) -> Array:
    """Return a derivative of a constant, cosines and sines in turn, shape (m, 1 + 2 K)."""
    phases = np.outer(t, omega) + order * np.pi / 2
    waves = np.stack([np.cos(phases), np.sin(phases)], axis=2) * (omega**order)[:, None]
    return np.hstack([np.full((len(t), 1), float(order == 0)), waves.reshape(len(t), -1)])


def _solve(gram: Array, right: Array, power: float, measured: int, count: int, weight: float) -> _Solution:
    """Solve the normal equations of a constant and `count` waves, whose amplitudes have a weight."""
    n = 1 + 2 * count
    values, vectors = np.linalg.eigh(gram[:n, :n])
    values = np.maximum(values, 0.0)
    along = vectors.T @ right[:n]
    solution = along / (values + weight)
    misfit = max(power - float(2 * solution @ along - values @ solution**2), 0.0)
    free = measured - float(np.sum(values / (values + weight)))
    score = misfit / measured / (free / measured) ** 2
    return _Solution(score, count, vectors @ solution, vectors / np.sqrt(values + weight), (misfit / free) ** 0.5)
