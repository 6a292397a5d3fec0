"""What is said of a closed loop's stability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ckc_pin.base.arrays import Array

__all__ = ["Stability", "time_constant"]


@dataclass(frozen=True)
class Stability:
    """The closed loop about its target, linearized exactly.

    Attributes
    ----------
    stable : bool or None
        None where it is not known; what is not known besides is None too.
    reason : str or None
        Why not.
    eigenvalues : (2 d,) complex array or None
        Of the closed loop at its target, 1/s, in falling order of real parts; of tracking at the start of the motion,
        where they say nothing about the rest of it.
    least_K_P : (d, d) array or None
        Of a set point: the least multiple of its K_P with K_P + dh/dq positive definite, from which on eq. 14 is
        stable; zero where it is without any. None where it rests off its target, for where depends on K_P.
    least_eigenvalue : float or None
        Of a set point: of K_P + dh/dq, N m/rad; the stiffness that is left in its weakest direction.
    offset : (d,) array or None
        Of a set point where it rests, from its target, rad, m: not zero where what the controller compensates is
        another model's h. Of tracking how far the motion, started as desired, goes off the desired one at most, by
        sampling, delay, friction or another model.
    slowest : float or None
        Time constant of the slowest decay, s: infinite where there is none. Of tracking, of the whole motion.
    growth, largest_growth : float or None
        Of tracking: by how much the variational equation multiplies the worst error of state until the end of the
        motion, and at most on the way, measured by the root of eq. 18's function.
    sampled : bool
        Whether the verdict, `slowest` and `growth` are those of the loop as it is sampled and delayed.
    multiplier : float or None
        Of a set point that is sampled: the largest factor of an error from one sample to the next, delay included.
    leaves_out : tuple of str
        What of the scene the linear model does not have: "sensor and drive", "torque limits", "stops", "dry friction".
    """

    stable: bool | None
    reason: str | None = None
    eigenvalues: NDArray[np.complex128] | None = None
    least_K_P: Array | None = None
    least_eigenvalue: float | None = None
    offset: Array | None = None
    slowest: float | None = None
    growth: float | None = None
    largest_growth: float | None = None
    sampled: bool = False
    multiplier: float | None = None
    leaves_out: tuple[str, ...] = ()


def time_constant(rate: float) -> float:
    """Return the time in which what changes at a rate, 1/s, falls to 1/e of it, s: infinite where it does not."""
    return -1.0 / rate if rate < 0 else float("inf")
