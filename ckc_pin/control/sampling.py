"""A linear closed loop that is sampled and held: what a sample makes of the one before, exactly."""

from __future__ import annotations

import numpy as np

from ckc_pin.control.gradient import Feedback
from ckc_pin.mechanism.tree import Array

__all__ = ["MOST_DELAYED", "sampled_loop"]

MOST_DELAYED = 200  # samples that a delay may last for the matrix to be made


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
    if sample_time - r <= 1e-9 * sample_time:  # a delay of whole samples, but for rounding
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


def _constant_input(loop: Feedback, seconds: float) -> tuple[Array, Array]:
    """exp(A s), and the integral of exp(A s) B."""
    from scipy.linalg import expm

    states, d = loop.B.shape
    both = np.zeros((states + d, states + d))
    both[:states, :states], both[:states, states:] = loop.A, loop.B
    whole = np.asarray(expm(both * seconds))
    return whole[:states, :states], whole[:states, states:]
