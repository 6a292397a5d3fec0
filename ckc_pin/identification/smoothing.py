"""Smooth functions of time fitted to measured quantities: splines, or waves if cross-validation prefers them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.identification.records import Record
from ckc_pin.identification.smooth_fit import SmoothFit
from ckc_pin.identification.splines import MIN_MEASUREMENTS, choose_knots, fit_spline
from ckc_pin.identification.waves import fit_waves

__all__ = ["fit_record", "fit_smooth"]


def fit_record(record: Record, names: Sequence[str]) -> dict[str, SmoothFit]:
    """Fit smooth functions to measured quantities of a record (InputError)."""
    return {
        name: fit_smooth(f"{record.source}: {name}", record.times(name), record.values[name], record.noise.get(name))
        for name in names
    }


def fit_smooth(name: str, t: Array, y: Array, noise: float | None = None) -> SmoothFit:
    """Fit a smooth function to measurements y at increasing times t, which may be unequal; NaN marks gaps.

    Messages call the quantity `name`.

    Raises
    ------
    InputError
        Fewer than sixteen measurements.
    """
    measured = np.isfinite(y)
    t, y = t[measured], y[measured]
    if len(t) < MIN_MEASUREMENTS:
        raise InputError(f"identify: {name}: {len(t)} values; at least {MIN_MEASUREMENTS} are needed")
    knots = choose_knots(t, y)
    return fit_waves(t, y, knots.intervals, knots.score, noise) or fit_spline(t, y, knots, noise)
