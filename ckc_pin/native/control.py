"""What acts on a mechanism as the tables that cross to C++: eqs. 14 and 16, any other controller as a call."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, SetPoint, Tracking
from ckc_pin.control.desired import Desired, Harmonics, Table
from ckc_pin.control.point_path import Circle, Line, Place, PointPath
from ckc_pin.control.sampled import Sampled
from ckc_pin.mechanism.tree import Array
from ckc_pin.native.tables import closure_table, core_table

__all__ = ["control_table"]

QUARTER = math.pi / 2


def control_table(
    controller: Controller | None, actuation: Actuation, call: Callable[[Controller], Callable[[Any], Any]]
) -> dict[str, Any]:
    """Describe what acts.

    Parameters
    ----------
    controller : Controller or None
    actuation : Actuation
    call : callable
        Makes of a controller that only Python knows a function of the loop's view of its state, to u.
    """
    at = actuation.at
    limit = np.full(len(at), np.inf) if actuation.limit is None else actuation.limit
    table: dict[str, Any] = {"actuated": at.tolist(), "direct": actuation.direct, "limit": limit}
    if isinstance(controller, Sampled):
        table |= {"sample_time": controller.sample_time, "delay": controller.delay}
        controller = controller.controller
    if controller is not None:
        table["law"] = _law(controller) or {"kind": "call", "function": call(controller)}
    return table


def _law(controller: Controller) -> dict[str, Any] | None:
    """Return eq. 14 or eq. 16; None for any other controller."""
    if type(controller) is SetPoint:
        target = controller.target  # what it compensates is a constant, whichever model that is of
        gains = {"K_P": controller.K_P, "K_V": controller.K_V}
        return {"kind": "set_point", **gains, "q_d": controller.q_d, "h_d": target.h,
                "potential": target.potential_energy}  # fmt: skip
    desired = _desired(controller.desired) if type(controller) is Tracking else None
    if type(controller) is not Tracking or desired is None:
        return None
    model = controller.model
    table = {"kind": "tracking", "Lambda": controller.Lambda, "K_D": controller.K_D, "desired": desired,
             "actual": model is not None and model.convention == "actual"}  # fmt: skip
    return table if model is None else {**table, "model": core_table(model.mechanism)}


def _desired(desired: Desired | Place) -> dict[str, Any] | None:
    match desired:
        case Harmonics():
            return _harmonics(desired.offset, desired.amplitude, desired.frequency, desired.phase)
        case Table():
            return _spline(desired)
        case PointPath():
            return _point(desired)
        case Circle():  # centre + radius (a cos(angle) + b sin(angle))
            amplitude = desired.spec.radius * np.column_stack([desired.a, desired.b])
            phase = desired.spec.phase + np.array([QUARTER, 0.0])
            return _harmonics(
                desired.centre, amplitude, np.full((3, 2), desired.spec.frequency), np.tile(phase, (3, 1))
            )
        case Line():
            amplitude = -desired.half[:, None]
            return _harmonics(
                desired.middle, amplitude, np.full((3, 1), desired.spec.frequency), np.full((3, 1), QUARTER)
            )
        case _:
            return None


def _harmonics(offset: Array, amplitude: Array, frequency: Array, phase: Array) -> dict[str, Any]:
    return {"kind": "harmonics", "offset": offset, "amplitude": amplitude, "frequency": frequency, "phase": phase}


def _spline(table: Table) -> dict[str, Any]:
    """Return a spline as Taylor polynomials: breaks, and by power, the highest first, a row of coefficients a piece."""
    spline = table.spline
    breaks = np.unique(spline.t)
    powers = range(spline.k, -1, -1)
    coefficients = [np.asfortranarray(spline(breaks[:-1], nu=k) / math.factorial(k)) for k in powers]
    return {"kind": "spline", "breaks": breaks, "coefficients": coefficients}


def _point(path: PointPath) -> dict[str, Any] | None:
    """Return a point's path: the rows of Psi, which of them are prescribed, and configurations along it."""
    point, place = path.point, _desired(path.place)
    extended, mechanism = point.extended, point.mechanism
    if place is None:
        return None
    prescribed = extended.fixing - extended.place[0]
    psi = np.concatenate([extended.free, extended.fixing])
    axis = np.array([-1] * len(extended.free) + [int(k) if k < 3 else -1 for k in prescribed])
    kept = path.start.phi[len(extended.loops) :]
    level = np.concatenate([np.zeros(len(extended.free)), kept])
    return {
        "kind": "point",
        "model": mechanism.tree.model.saveToString(),
        "place": mechanism.tree.place.tolist(),
        "closure": closure_table(extended.closure, mechanism.n),
        "psi": psi.tolist(),
        "axis": axis.tolist(),
        "level": np.where(axis >= 0, 0.0, level),
        "path": place,
        "q": mechanism.partition.q.tolist(),
        "times": path.times,
        "knots": np.asfortranarray(path.knots.T),
        "tolerance": mechanism.tolerance,
        "end": np.inf if path.leaves_at is None else path.leaves_at,
        "past_end": path.past_end,
    }
