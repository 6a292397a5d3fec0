"""Limits of a planned motion: those of a plan's file, and those of joints and motors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.validation import suggest_name
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.motors import torque_limits
from ckc_pin.optimization.spec import LimitsSpec

__all__ = ["MotionLimits", "make_limits"]


class MotionLimits(Immutable, frozen=True):
    """Limits of a motion; infinite where there is none.

    Attributes
    ----------
    q : (2, n) array
        Lower and upper, of all coordinates.
    rate, acceleration : (n,) arrays
    torque : (2, motors) array
    speed, power : (motors,) arrays
        Of the shafts.
    total_power : float
        W, upper limit of the sum over all motors.
    torque_rate : (motors,) array
    jerk : (d,) array
        Of the independent coordinates.
    time : float
        s.
    singularity : float
        Smallest singular value of phi_z, relative to the start; 0 if there is no limit.
    spheres : tuple of (str, (3,) array, float)
        Point, centre and radius.
    sphere_names : tuple of str
    names : tuple of str
        Coordinates, rates, accelerations, shaft speeds, torques, power, their total, and distances of points from
        spheres' centres.
    """

    q: Array
    rate: Array
    acceleration: Array
    torque: Array
    speed: Array
    power: Array
    total_power: float
    torque_rate: Array
    jerk: Array
    time: float
    singularity: float
    spheres: tuple[tuple[str, Array, float], ...]
    sphere_names: tuple[str, ...]
    names: tuple[str, ...]

    def narrowed(self, part: float) -> MotionLimits:
        """Return the limits of rates, accelerations and motors narrowed by a part of themselves."""
        return replace(self, rate=self.rate * (1 - part), acceleration=self.acceleration * (1 - part),
                       torque=self.torque * (1 - part), speed=self.speed * (1 - part),
                       power=self.power * (1 - part), total_power=self.total_power * (1 - part))  # fmt: skip

    def excess(self, quantities: Array) -> Array:
        """Return by how much quantities (m, names) exceed the limits, at most 0 inside, (m, names)."""
        lower, upper = self.bounds()
        return np.maximum(lower - quantities, quantities - upper)

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper limits of the quantities of `names`."""
        radius = np.array([radius for _, _, radius in self.spheres])
        lower = [self.q[0], -self.rate, -self.acceleration, -self.speed, self.torque[0], -self.power, [-np.inf], radius]
        upper = [self.q[1], self.rate, self.acceleration, self.speed, self.torque[1], self.power, [self.total_power],
                 np.full(len(radius), np.inf)]  # fmt: skip
        return np.concatenate(lower), np.concatenate(upper)

    def sizes(self, quantities: Array) -> Array:
        """Return the sizes of quantities (m, names) that an excess is relative to, (names,)."""
        largest = np.abs(quantities).max(axis=0)
        first = len(self.names) - len(self.spheres)
        largest[first:] = [radius for _, _, radius in self.spheres]
        if np.isfinite(self.total_power):
            largest[self.names.index("total_power")] = self.total_power
        return np.maximum(largest, 1e-12)


def make_limits(spec: LimitsSpec, mechanism: Mechanism) -> MotionLimits:
    """Return the limits of a plan (InputError)."""
    where, motors = "optimize: limits", mechanism.motors
    names = mechanism.coordinates
    q = np.array(mechanism.tree.limits())
    q[0], q[1] = np.maximum(q[0], mechanism.joints.lower), np.minimum(q[1], mechanism.joints.upper)
    for name, pair in spec.q.items():
        k = _index(name, names, f"{where}.q", "coordinate")
        if name in mechanism.tree.free_coordinates and not mechanism.tree.in_metres[k]:
            raise InputError(f"{where}.q.{name}: rotations of a free root have no limits; remove it")
        if not pair[0] < pair[1]:
            raise InputError(f"{where}.q.{name}: expected [lower, upper], got [{pair[0]:g}, {pair[1]:g}]")
        q[:, k] = max(q[0, k], pair[0]), min(q[1, k], pair[1])
    torque = np.array(motors.torque_limit)
    if isinstance(spec.torque, Mapping):
        for name, limit in spec.torque.items():
            k = _index(name, motors.names, f"{where}.torque", "motor")
            lower, upper = torque_limits(limit, f"{where}.torque.{name}")
            torque[:, k] = max(torque[0, k], lower), min(torque[1, k], upper)
    elif spec.torque != "motors":
        lower, upper = torque_limits(spec.torque, f"{where}.torque")
        torque = np.array([np.maximum(torque[0], lower), np.minimum(torque[1], upper)])
    spheres: list[tuple[str, Array, float]] = []
    for k, region in enumerate(spec.keep_out):
        for name in region.points:
            _index(name, tuple(mechanism.points), f"{where}.keep_out[{k}].points", "point")
            spheres.append((name, np.array(region.sphere.centre), region.sphere.radius))
    points = [name for name, _, _ in spheres]
    repeated = len(set(points)) < len(points)
    sphere_names = tuple(f"distance.{name}.{k + 1}" if repeated else f"distance.{name}"
                         for k, name in enumerate(points))  # fmt: skip
    prefixed = [f"{kind}.{x}" for kind, members in (("v", names), ("a", names), ("speed", motors.names),
                ("tau", motors.names), ("power", motors.names)) for x in members]  # fmt: skip
    return MotionLimits(
        q=q,
        rate=_by_name(spec.rate, names, mechanism.independent, f"{where}.rate", "coordinate"),
        acceleration=_by_name(spec.acceleration, names, mechanism.independent, f"{where}.acceleration", "coordinate"),
        torque=torque,
        speed=np.array(motors.speed_limit),
        power=_by_name(spec.power, motors.names, motors.names, f"{where}.power", "motor"),
        total_power=np.inf if spec.total_power is None else spec.total_power,
        jerk=_by_name(spec.jerk, mechanism.independent, mechanism.independent, f"{where}.jerk", "coordinate"),
        torque_rate=_by_name(spec.torque_rate, motors.names, motors.names, f"{where}.torque_rate", "motor"),
        time=np.inf if spec.time is None else spec.time,
        singularity=spec.singularity or 0.0,
        spheres=tuple(spheres),
        sphere_names=sphere_names,
        names=(*names, *prefixed, "total_power", *sphere_names),
    )


def _by_name(
    limit: float | Mapping[str, float] | None, names: Sequence[str], members: Sequence[str], where: str, what: str
) -> Array:
    """Return limits by name; a number is a limit of `members`."""
    limits = np.full(len(names), np.inf)
    table = limit if isinstance(limit, Mapping) else dict.fromkeys(members, np.inf if limit is None else limit)
    for name, value in table.items():
        limits[_index(name, names, where, what)] = value
    return limits


def _index(name: str, names: Sequence[str], where: str, what: str) -> int:
    if name not in names:
        raise InputError(
            f"{where}: no {what} {name!r}; there are {', '.join(names) or 'none'}{suggest_name(name, names)}"
        )
    return list(names).index(name)
