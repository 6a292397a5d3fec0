"""What acts on a mechanism, handed to the native core where it knows it: nothing, a held u, eqs. 14 and 16."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, SetPoint, Tracking
from ckc_pin.control.desired import Harmonics, Table
from ckc_pin.control.sampled import Held, Sampled
from ckc_pin.mechanism.tree import Array

__all__ = ["hand_over"]


def hand_over(controller: Controller | None, actuation: Actuation, system: Any) -> bool:
    """Tell a native level set what acts; return False where only Python knows it."""
    if controller is None:
        return True
    if not actuation.direct:
        return False
    if actuation.limit is not None:
        system.limit(actuation.limit)
    if type(controller) in (Held, Sampled):
        return True  # its u is handed over whenever it changes
    if type(controller) is SetPoint:
        target = controller.target
        system.set_point(
            controller.K_P, controller.K_V, controller.q_d, target.h, target.potential_energy
        )  # what it compensates is a constant, whichever model that is of
        return True
    if type(controller) is Tracking and controller.model is None:
        return _track(controller, system)
    return False


def _track(controller: Tracking, system: Any) -> bool:
    desired = controller.desired
    if type(desired) is Harmonics:
        waves = (desired.amplitude, desired.frequency, desired.phase)
        system.harmonics(controller.Lambda, controller.K_D, desired.offset, *waves)
        return True
    if type(desired) is Table:
        breaks, coefficients = _pieces(desired)
        system.spline(controller.Lambda, controller.K_D, breaks, coefficients)
        return True
    return False


def _pieces(table: Table) -> tuple[Array, list[Array]]:
    """Return a spline as Taylor polynomials: breaks, and by power, the highest first, a row of coefficients a piece."""
    spline = table.spline
    breaks = np.unique(spline.t)
    powers = range(spline.k, -1, -1)
    return breaks, [np.asfortranarray(spline(breaks[:-1], nu=k) / math.factorial(k)) for k in powers]
