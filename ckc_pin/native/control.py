"""Tables that describe controllers and motors to the C++ core.

Eqs. 14 and 16 and torques over time run in the core; any other controller is called from it. The allocation of a force
to the motors can also be computed alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation, Effort, require_u
from ckc_pin.control.controllers import (
    Controller,
    RecordedTorques,
    SetPoint,
    TorqueController,
    Tracking,
    has_state,
    initial_state,
    is_torque_controller,
)
from ckc_pin.control.desired import Desired, Harmonics, Sum
from ckc_pin.control.forces import BodyForce
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.control.point_path import Circle, Line, PointPath, PointTrajectory
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.spec import DriveSpec, SensorSpec
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.native.tables import closure_table, core_table, packed

__all__ = [
    "actuation_table",
    "allocate",
    "apply_u",
    "breakpoints_table",
    "control_table",
    "force_tables",
    "law_table",
    "prescribed_tables",
]

QUARTER = math.pi / 2
RELATIVE_TOLERANCE = 1e-9  # of the shortest time between breakpoints: instants closer than this are one
TIME_TOLERANCE = 1e-9  # s, and relative to the time: breaks of a desired motion closer than this are one


def control_table(
    controller: Controller | TorqueController | Sampled | None,
    actuation: Actuation,
    call: Callable[[Any, str], Callable[..., Any]],
    *,
    differentiates: bool = False,
) -> dict[str, Any]:
    """Return the table of a controller, its sampling and its motors.

    Parameters
    ----------
    controller : Controller, TorqueController, Sampled or None
    actuation : Actuation
    call : callable
        Wraps a method of a controller that the core does not implement, "u", "tau" or "state_dot", as a function of
        the core's view of the state.
    differentiates : bool
        The core differentiates such a controller with respect to the state by finite differences.

    Raises
    ------
    InputError
        The controller has neither u nor tau, or a sensor or drive names a coordinate or motor that does not exist.
    """
    table = actuation_table(actuation)
    if isinstance(controller, Sampled):
        clock, controller = controller, controller.controller
        table["clock"] = _clock(clock.sample_time, clock.delay)
        closes = type(controller) is not SetPoint or (clock.drive is not None and not actuation.is_direct)
        if clock.sensor is not None:
            table["sensor"] = _sensor(clock.sensor, actuation.mechanism, clock.sample_time, closes=closes)
        if clock.drive is not None:
            table["drive"] = _drive(clock.drive, actuation)
    if controller is None:
        return table
    torques = is_torque_controller(controller)
    if type(controller) is RecordedTorques:
        spacing = float(np.diff(controller.times).min(initial=np.inf))
        if not controller.interpolates:
            table["clock"] = _clock(min(spacing, 1.0), times=controller.times)
    table["law"] = law_table(controller) or {
        "kind": "call",
        "function": call(controller, "tau" if torques else "u"),
        "state_rate": call(controller, "state_dot") if has_state(controller) else None,
        "initial_state": initial_state(controller),
        "outputs_torques": torques,
        "differentiates": differentiates,
    }
    return table


def breakpoints_table(
    functions: Iterable[Any], switches: Sequence[float] = (), later: Iterable[Any] = ()
) -> dict[str, Any] | None:
    """Return the table of the instants at which functions of time, or low derivatives, jump; None if there are none.

    Parameters
    ----------
    functions : iterable of callables
        Their attribute `corners`, if they have one, lists these times, s.
    switches : sequence of float
        Instants at which prescribed motions begin and end, s.
    later : iterable of callables
        Motions that begin in the run, whose times are counted from there. The loop adds them.
    """
    times, *others = (
        _distinct(np.sort(np.concatenate([np.zeros(0), *lists])))
        for lists in [[np.array(switches, float), *map(_corners, functions)], *([_corners(f)] for f in later)]
    )
    if not len(times) and not others:
        return None
    spacing = min(float(np.diff(t, prepend=0.0).min(initial=1.0)) for t in (times, *others))
    return {"times": times, "tolerance": RELATIVE_TOLERANCE * spacing}


def _corners(function: Any) -> Array:
    return np.asarray(getattr(function, "corners", np.zeros(0)), dtype=float)


def force_tables(
    forces: Sequence[BodyForce], call: Callable[[BodyForce], Callable[..., Any]] | None = None
) -> list[dict[str, Any]]:
    """Return the tables of forces on links. `call` wraps those that are functions of the state."""
    tables = []
    for force in forces:
        table: dict[str, Any] = {
            "joint": force.frame.joint,
            "origin": force.frame.translation,
            "in_world": force.in_world,
            "axes": np.asfortranarray(force.frame.rotation),
        }
        if force.over_time is None and call:
            table["function"] = call(force)
        elif force.is_constant and force.over_time is not None:
            table["constant"] = force.over_time(0.0)[0]
        else:
            table["values"] = _spline(force.over_time)
        tables.append(table)
    return tables


def actuation_table(actuation: Actuation) -> dict[str, Any]:
    """Return the table of the allocation of generalized forces to motors."""
    return {
        "transmission": np.asfortranarray(actuation.motors.transmission),
        "direct": actuation.is_direct,
        "lower": actuation.limit[0],
        "upper": actuation.limit[1],
        "weights": actuation.weights,
        "preload": actuation.preload,
    }


def allocate(transmission: Array, u: Array, limit: Array, weights: Array, preload: Array) -> Array:
    """Return the motor torques with u = transmission tau that are nearest to a preload, within limits.

    If no torques within the limits give u, the deviation from u is penalized. Each row of u is measured by what one
    unit of all motors contributes to it, so the torques stay almost continuous there.

    Parameters
    ----------
    transmission : (d, m) array
    u : (d,) array
    limit : (2, m) array
        Lower and upper limits of the torques, which may be infinite.
    weights, preload : (m,) arrays
        The torques minimize ``sum(weights * (tau - preload)**2)`` within the limits.

    Returns
    -------
    (m,) array
    """
    return _core.allocate(np.asfortranarray(transmission, dtype=float), u, limit[0], limit[1], weights, preload)


def apply_u(actuation: Actuation, terms: Terms, u: Array) -> Effort:
    """Return motor torques for u, within limits. `allocate` shares u among redundant motors.

    Raises
    ------
    InputError
        u has the wrong shape.
    NumericalError
        u is not finite.
    """
    u = require_u(u, actuation.mechanism)
    if not np.isfinite(u).all():
        raise NumericalError(f"the controller's u is not finite: {u.tolist()}")
    if actuation.is_direct:
        tau = np.clip(u, *actuation.limit)
        return Effort(tau, actuation.motors.force(tau), tau)
    transmission = (actuation.motors.transmission @ terms.rho).T  # u = transmission tau
    tau = allocate(transmission, u, actuation.limit, actuation.weights, actuation.preload)
    return Effort(tau, actuation.motors.force(tau), transmission @ tau)


def prescribed_tables(
    mechanism: Mechanism, motions: Sequence[Desired], switches: Sequence[dict[str, Any]], *, smooth_friction: bool
) -> list[dict[str, Any]]:
    """Return the tables of the prescribed joints of a mechanism.

    Parameters
    ----------
    mechanism : Mechanism
    motions : sequence of Desired
        Motion of each joint over the time since it began.
    switches : sequence of dict
        Where each motion begins and ends (`ckc_pin.run.events.switch_tables`).
    smooth_friction : bool
        Whether friction is a force of the mechanism, which no motor has to overcome in addition.
    """
    assembled, tables = mechanism.tree.to_coordinates(mechanism.q_tree), []
    for k, row, motion, switch in zip(
        mechanism.prescribed_at, mechanism.prescribed_rows, motions, switches, strict=True
    ):
        motor, is_free = mechanism.motors.motor_on(k), switch["begins_with"] or np.isfinite(switch["begins_at"])
        assert motor is not None
        tables.append(
            {
                "coordinate": int(k),
                "row": row,
                "motor": motor,
                "offset": float(assembled[k] if is_free else motion(0.0)[0][0]),
                "gear": float(mechanism.motors.transmission[motor, k]),
                "friction": 0.0 if smooth_friction else float(mechanism.joints.friction[k]),
                "motion": _desired(motion),
                "corners": _corners(motion),
                **switch,
            }
        )
    return tables


def _clock(period: float, delay: float = 0.0, times: Array | None = None) -> dict[str, Any]:
    return {"period": period, "delay": delay, "times": np.zeros(0) if times is None else times}


def _distinct(times: Sequence[float] | Array) -> Array:
    """Return the positive ones of increasing times, without those that differ from another one by rounding only."""
    times = np.asarray(times, dtype=float)
    times = times[times > TIME_TOLERANCE]
    return times[np.diff(times, prepend=0.0) > TIME_TOLERANCE * np.maximum(1.0, times)]


def _sensor(sensor: SensorSpec, mechanism: Mechanism, period: float, *, closes: bool) -> dict[str, Any]:
    """Return the table of a sensor; `closes`: the controller needs more than q and q_dot, so the loops are closed."""
    table: dict[str, Any] = {
        "differentiates": sensor.rate == "difference",
        "smoothing": 1.0 if sensor.filter is None else -math.expm1(-period / sensor.filter),
        "seed": sensor.seed,
    }
    names = mechanism.independent
    for key in ("resolution", "q_noise", "q_dot_noise"):
        value = getattr(sensor, key)
        values = value if isinstance(value, dict) else dict.fromkeys(names, value)
        table[key] = mechanism.vector(values, names, f"controller.sensor.{key}", fill=0.0)
    return {**table, "observer": core_table(mechanism)} if closes else table


def _drive(drive: DriveSpec, actuation: Actuation) -> dict[str, Any]:
    table = {}
    for key, name, absent in (("resolution", "torque_resolution", 0.0), ("rate", "torque_rate", np.inf)):
        value = getattr(drive, name)
        values = value if isinstance(value, dict) else dict.fromkeys(actuation.motors.names, value or absent)
        table[key] = actuation.motors.vector(values, f"controller.drive.{name}", absent)
    return table


def law_table(controller: Controller | TorqueController) -> dict[str, Any] | None:
    """Return the table of eq. 14, eq. 16 or torques over time; None for any other controller."""
    if type(controller) is RecordedTorques:
        tau = np.asfortranarray(controller.values.T)
        return {"kind": "torques", "times": controller.times, "tau": tau, "interpolates": controller.interpolates}
    if type(controller) is SetPoint:
        target = controller.target  # the compensated forces are constant, also if they are another model's
        gains = {"K_P": controller.K_P, "K_V": controller.K_V}
        return {"kind": "set_point", **gains, "q_d": controller.q_d, "h_d": target.h,
                "potential": target.potential_energy}  # fmt: skip
    if type(controller) is JointServo:
        servos: dict[str, Any] = {
            "kind": "joint_servo",
            "servos": controller.servo_tables(),
            "desired": _desired(controller.desired),
        }
        if controller.gravity:
            balance = actuation_table(controller.balance)
            unlimited = np.full(len(balance["upper"]), np.inf)
            servos["gravity"] = {**balance, "lower": -unlimited, "upper": unlimited}
        return servos
    desired = _desired(controller.desired) if type(controller) is Tracking else None
    if type(controller) is not Tracking or desired is None:
        return None
    model = controller.model
    table = {"kind": "tracking", "Lambda": controller.Lambda, "K_D": controller.K_D, "desired": desired,
             "actual": model is not None and model.convention == "actual"}  # fmt: skip
    return table if model is None else {**table, "model": core_table(model.mechanism)}


def _desired(desired: Desired | PointTrajectory) -> dict[str, Any] | None:
    match desired:
        case Harmonics():
            return _harmonics(desired.offset, desired.amplitude, desired.frequency, desired.phase)
        case PiecewisePolynomial():
            return _spline(desired)
        case Sum():
            return {"kind": "sum", "parts": [_desired(desired.harmonics), _spline(desired.polynomial)]}
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


def _spline(motion: PiecewisePolynomial | None) -> dict[str, Any]:
    assert motion is not None
    coefficients = [np.asfortranarray(c) for c in motion.coefficients]
    return {"kind": "spline", "breaks": motion.breaks, "coefficients": coefficients}


def _point(path: PointPath) -> dict[str, Any] | None:
    """Return the table of a point's path: rows of Psi, which of them are prescribed, configurations along it."""
    point, place = path.point, _desired(path.path)
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
        "model": packed(mechanism.tree.model),
        "q_index": mechanism.tree.q_index.tolist(),
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
        "past_end": path.exit_message,
    }
