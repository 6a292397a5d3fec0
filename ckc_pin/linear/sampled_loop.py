"""Exact discretization of linear closed loops with sampling and delay (zero-order hold)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.linear.closed_loop import Feedback

__all__ = ["MAX_DELAY_SAMPLES", "MAX_MOTION_SAMPLES", "build_sampled_loop", "propagate_sampled_loop"]

MAX_DELAY_SAMPLES = 200  # the size of the sampled loop's matrix grows with the delay
MAX_MOTION_SAMPLES = 50_000  # along a motion
TIME_TOLERANCE = 1e-9  # relative to the sample time; instants closer to each other are equal


def build_sampled_loop(loop: Feedback, sample_time: float, delay: float) -> Array:
    """Return the matrix that maps the state at a sample to the state at the next sample.

    ``u = K x(k T)`` acts from ``k T + delay`` until the next u does. With ``delay = m T + r`` and ``0 <= r < T``, the u
    of sample k - m - 1 acts after ``k T``, and the u of sample k - m after ``k T + r``.

    Parameters
    ----------
    loop : Feedback
    sample_time, delay : float
        s. The delay is at most `MAX_DELAY_SAMPLES` samples.

    Returns
    -------
    (2 d + d (m + 1),) square array
        It acts on x(k T) and on the u of samples k - 1, k - 2, ..., k - m - 1. The loop is stable if all eigenvalues
        are inside the unit circle.
    """
    m, r = divmod(delay, sample_time)
    if sample_time - r <= TIME_TOLERANCE * sample_time:  # a whole number of samples up to rounding
        m, r = m + 1, 0.0
    states, d, pending = *loop.B.shape, int(m) + 1
    before, after = _integrate_constant_input(loop, r), _integrate_constant_input(loop, sample_time - r)
    matrix = np.zeros((states + d * pending, states + d * pending))
    matrix[:states, :states] = after[0] @ before[0]
    oldest = states + d * (pending - 1)
    matrix[:states, oldest:] = after[0] @ before[1]
    if m:  # the u of sample k - m is part of the state
        matrix[:states, oldest - d : oldest] += after[1]
    else:
        matrix[:states, :states] += after[1] @ loop.K
    matrix[states : states + d, :states] = loop.K
    matrix[states + d :, states:oldest] = np.eye(d * (pending - 1))
    return matrix


def propagate_sampled_loop(
    pieces: Sequence[Feedback], dt: float, start: Array, sample_time: float, delay: float
) -> list[tuple[Array, float]]:
    """Propagate states through a sampled loop whose linearization is piecewise constant in time.

    Parameters
    ----------
    pieces : sequence of Feedback
    dt : float
        Duration of each piece, s.
    start : (2 d, k) array
        Initial states as columns. No u acts before that of the first sample.
    sample_time, delay : float
        As in `build_sampled_loop`.

    Returns
    -------
    list of ((2 d, k) array, float)
        At the start and at the end of each piece: the states divided by a positive factor, and the factor's logarithm.
        The factor prevents overflow.
    """
    tolerance, end = TIME_TOLERANCE * sample_time, len(pieces) * dt
    samples = sample_time * np.arange(int((end + tolerance) / sample_time) + 1)
    instants = np.sort(np.concatenate([samples, samples + delay, dt * np.arange(len(pieces) + 1)]))
    instants = instants[np.concatenate([[True], np.diff(instants) > tolerance]) & (instants <= end + tolerance)]

    @cache
    def integrate(piece: int, duration_in_tolerances: int) -> tuple[Array, Array]:
        return _integrate_constant_input(pieces[piece], tolerance * duration_in_tolerances)

    x, u, number, log = start, np.zeros((pieces[0].B.shape[1], start.shape[1])), 0, 0.0
    states = [(x, log)]
    pending: deque[tuple[float, Array]] = deque()
    for t, next_t in pairwise(instants):
        piece = min(int((t + tolerance) / dt), len(pieces) - 1)
        if number < len(samples) and samples[number] <= t + tolerance:
            pending.append((samples[number] + delay, _interpolate_gain(pieces, samples[number] / dt) @ x))
            number += 1
        while pending and pending[0][0] <= t + tolerance:
            u = pending.popleft()[1]
        x_by_x, x_by_u = integrate(piece, round((next_t - t) / tolerance))
        x = x_by_x @ x + x_by_u @ u
        if int((next_t + tolerance) / dt) > piece:
            size = max(1e-300, *(float(np.abs(y).max()) for y in (x, u, *(y for _, y in pending))))
            x, u, log = x / size, u / size, log + float(np.log(size))
            pending = deque((when, y / size) for when, y in pending)
            states.append((x, log))
    return states


def _interpolate_gain(pieces: Sequence[Feedback], position: float) -> Array:
    """Interpolate K linearly between the middles of two pieces; `position` is a time divided by `dt`."""
    k = min(max(int(position - 0.5), 0), max(len(pieces) - 2, 0))
    first, second = pieces[k].K, pieces[min(k + 1, len(pieces) - 1)].K
    return np.asarray(first + (position - 0.5 - k) * (second - first))


def _integrate_constant_input(loop: Feedback, duration: float) -> tuple[Array, Array]:
    """Return exp(A t), and the integral of exp(A t) B from 0 to t, for a duration t in s."""
    from scipy.linalg import expm

    states, d = loop.B.shape
    augmented = np.zeros((states + d, states + d))
    augmented[:states, :states], augmented[:states, states:] = loop.A, loop.B
    exponential = np.asarray(expm(augmented * duration))
    return exponential[:states, :states], exponential[:states, states:]
