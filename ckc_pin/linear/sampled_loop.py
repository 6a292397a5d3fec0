"""A linear closed loop that is sampled and held, exactly: from one sample to the next, and along a motion."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.linear.closed_loop import Feedback

__all__ = ["MOST_DELAYED", "MOST_SAMPLES", "sampled_loop", "sampled_motion"]

MOST_DELAYED = 200  # samples that a delay may last for the matrix to be made
MOST_SAMPLES = 50_000  # along a motion
ONE = 1e-9  # of a sample time: instants nearer than that are one


def sampled_loop(loop: Feedback, sample_time: float, delay: float) -> Array:
    """Return the matrix from one sample to the next, of the state and of the u that are under way.

    u = K x(k T) acts from k T + delay on until the next one does. With delay = m T + r, 0 <= r < T, what acts after
    k T is u of the sample k - m - 1, and after k T + r that of k - m.

    Parameters
    ----------
    sample_time, delay : float
        T > 0, s; at most `MOST_DELAYED` samples.

    Returns
    -------
    (2 d + d (m + 1),) square array
        Of x(k T), and of the u of the samples k - 1, k - 2, ..., k - m - 1. Stable where all eigenvalues are within the
        unit circle.
    """
    m, r = divmod(delay, sample_time)
    if sample_time - r <= ONE * sample_time:  # a delay of whole samples, but for rounding
        m, r = m + 1, 0.0
    states, d, before = *loop.B.shape, int(m) + 1
    late, soon = _constant_input(loop, r), _constant_input(loop, sample_time - r)
    after = soon[0]
    matrix = np.zeros((states + d * before, states + d * before))
    matrix[:states, :states] = after @ late[0]
    oldest = states + d * (before - 1)
    matrix[:states, oldest:] = after @ late[1]
    if m:  # u of the sample k - m
        matrix[:states, oldest - d : oldest] += soon[1]
    else:
        matrix[:states, :states] += soon[1] @ loop.K
    matrix[states : states + d, :states] = loop.K
    matrix[states + d :, states:oldest] = np.eye(d * (before - 1))
    return matrix


def sampled_motion(
    pieces: Sequence[Feedback], dt: float, start: Array, sample_time: float, delay: float
) -> list[tuple[Array, float]]:
    """Return what states become along a motion whose loop is another one in each piece of time.

    Parameters
    ----------
    pieces : sequence of Feedback
    dt : float
        How long each lasts, s.
    start : (2 d, k) array
        States as columns; no u acts before that of the first sample does.
    sample_time, delay : float
        As of `sampled_loop`.

    Returns
    -------
    list of ((2 d, k) array, float)
        At the start and at the end of each piece: the states divided by a factor that keeps them numbers, and its
        logarithm.
    """
    near, end = ONE * sample_time, len(pieces) * dt
    samples = sample_time * np.arange(int((end + near) / sample_time) + 1)
    instants = np.sort(np.concatenate([samples, samples + delay, dt * np.arange(len(pieces) + 1)]))
    instants = instants[np.concatenate([[True], np.diff(instants) > near]) & (instants <= end + near)]

    @cache
    def constant_input(piece: int, spans: int) -> tuple[Array, Array]:
        return _constant_input(pieces[piece], near * spans)

    x, u, number, log = start, np.zeros((pieces[0].B.shape[1], start.shape[1])), 0, 0.0
    found = [(x, log)]
    under_way: deque[tuple[float, Array]] = deque()
    for t, then in pairwise(instants):
        piece = min(int((t + near) / dt), len(pieces) - 1)
        if number < len(samples) and samples[number] <= t + near:
            under_way.append((samples[number] + delay, _gain(pieces, samples[number] / dt) @ x))
            number += 1
        while under_way and under_way[0][0] <= t + near:
            u = under_way.popleft()[1]
        state, force = constant_input(piece, round((then - t) / near))
        x = state @ x + force @ u
        if int((then + near) / dt) > piece:
            size = max(1e-300, *(float(np.abs(y).max()) for y in (x, u, *(y for _, y in under_way))))
            x, u, log = x / size, u / size, log + float(np.log(size))
            under_way = deque((when, y / size) for when, y in under_way)
            found.append((x, log))
    return found


def _gain(pieces: Sequence[Feedback], t: float) -> Array:
    """K at an instant, in pieces, on a line between those of two middles."""
    k = min(max(int(t - 0.5), 0), max(len(pieces) - 2, 0))
    one, two = pieces[k].K, pieces[min(k + 1, len(pieces) - 1)].K
    return np.asarray(one + (t - 0.5 - k) * (two - one))


def _constant_input(loop: Feedback, seconds: float) -> tuple[Array, Array]:
    """exp(A s), and the integral of exp(A s) B."""
    from scipy.linalg import expm

    states, d = loop.B.shape
    both = np.zeros((states + d, states + d))
    both[:states, :states], both[:states, states:] = loop.A, loop.B
    whole = np.asarray(expm(both * seconds))
    return whole[:states, :states], whole[:states, states:]
