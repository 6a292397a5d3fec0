"""Torques over time, as a drive has recorded them: from a CSV file to the motors."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.control.desired import read_columns
from ckc_pin.control.spec import TorquesSpec
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Torques", "read_torques"]


class Torques:
    """The motors' torques by time, each until the next one, or on lines between them.

    Parameters
    ----------
    times : (k,) array
        Increasing, s, the first at most 0.
    values : (k, motors) array
        N m or N.
    lines : bool
        Interpolate, else hold.
    """

    def __init__(self, times: Array, values: Array, *, lines: bool) -> None:
        first = max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0)
        self.times, self.values, self.lines = times[first:], values[first:], lines

    def tau(self, t: float, terms: Terms) -> Array:
        """Return the torques at time t (s), shape (motors,)."""
        if self.lines:
            return np.array([np.interp(t, self.times, column) for column in self.values.T])
        return np.asarray(self.values[max(int(np.searchsorted(self.times, t, side="right")) - 1, 0)])


def read_torques(spec: TorquesSpec, mechanism: Mechanism, sources: Sources, t_end: float) -> Torques:
    """Read the file: `t` and a column for each motor.

    Raises
    ------
    InputError
        Another file than that, with gaps, or too short for the run.
    """
    times, values = read_columns(sources.text(spec.file), mechanism.actuated, spec.file, 2, "torques over time need")
    lines = spec.interpolation == "linear"
    end = float(times[-1] if lines else 2 * times[-1] - times[-2])
    if end < t_end * (1 - 1e-9):
        raise InputError(
            f"{spec.file}: ends at t = {end:g} s, the scene at t_end = {t_end:g} s; record longer or shorten the run"
        )
    return Torques(times, values, lines=lines)
