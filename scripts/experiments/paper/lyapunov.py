"""Compare the numerical derivative of a run's Lyapunov function with the rate that the paper gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.run.run import Run

__all__ = ["Record", "derivative", "record"]

DEGREE = 7  # degree of the spline through the recorded values
ROUNDING = 8  # rounding error in units of the floating-point spacing of the energies


@dataclass(frozen=True)
class Record:
    """A Lyapunov function along a run, with its measured and predicted rates.

    Attributes
    ----------
    t, value : (m,) arrays
        s, J.
    rate : (m,) array
        Derivative of the recorded values by a spline of degree DEGREE, independent of the equations, W.
    predicted : (m,) array
        The paper's right-hand side at the recorded states, W.
    largest_increase : float
        Largest increase from one output instant to the next, J; negative if the value always decreases.
    round_off : float
        Error bound of the value from rounding and from the tolerance of phi, J.
    """

    t: Array
    value: Array
    rate: Array
    predicted: Array
    largest_increase: float
    round_off: float

    @property
    def mismatch(self) -> float:
        """Largest difference of measured and predicted rate, relative to the largest prediction."""
        return float(np.abs(self.rate - self.predicted).max() / np.abs(self.predicted).max())

    @property
    def monotone(self) -> bool:
        """Whether every increase is within the rounding error."""
        return self.largest_increase <= self.round_off


def record(run: Run, predicted: Callable[[int], float]) -> Record:
    """Compare a run's Lyapunov function with its predicted rate.

    Parameters
    ----------
    run : Run
        Run of a controller with a Lyapunov function, with many output instants.
    predicted : callable
        Returns the predicted rate in W for a row of the run.
    """
    if run.lyapunov is None:
        raise ValueError("the run's controller has no Lyapunov function")
    largest = max(float(np.abs(run.energy).max()), float(np.abs(run.lyapunov).max()))
    # A residual phi changes the potential energy by lambda . phi, at both instants of a difference.
    forces = sum(np.abs(force).sum(axis=1) for force in run.loop_forces().values())
    unclosed = 2 * run.mechanism.tolerance * float(np.max(forces))
    return Record(
        t=run.t,
        value=run.lyapunov,
        rate=derivative(run.t, run.lyapunov),
        predicted=np.array([predicted(k) for k in range(len(run.t))]),
        largest_increase=float(np.diff(run.lyapunov).max()),
        round_off=ROUNDING * float(np.spacing(largest)) + unclosed,
    )


def derivative(t: Array, value: Array) -> Array:
    """Return the derivative of samples by an interpolating spline, shape (m,)."""
    from scipy.interpolate import make_interp_spline

    return np.asarray(make_interp_spline(t, value, k=DEGREE).derivative()(t))
