"""Limits of the state at each instant of a motion: dependent coordinates, shafts, power, regions, and singularities."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.state_functions import ExpressionFunctions, SmallestSingularValue, StateFunctions

__all__ = ["StateLimits"]

ROUNDING = 1e-3  # of a sphere's radius

Row = tuple[str, Any, float, float]  # label, expression, lower and upper limit


class StateLimits:
    """Functions of the state with lower and upper limits.

    Limits of independent coordinates and of torques are left out: they are linear in the optimizer's variables.

    Parameters
    ----------
    dynamics : ReducedDynamics
    limits : MotionLimits
    start : (nq,) array
        Configuration to whose smallest singular value of phi_z `limits.singularity` is relative.
    power_unit : float
        W, of the total power, and of each motor's.
    with_power : bool
        Adds the mechanical power of each motor in its unit, as the last functions, at most 0.

    Attributes
    ----------
    labels : tuple of str
    bounds : (2, functions) array
    """

    def __init__(
        self, dynamics: ReducedDynamics, limits: MotionLimits, start: Array, power_unit: float, *, with_power: bool
    ) -> None:
        rows = [row for row in _limited(dynamics, limits, power_unit) if np.isfinite(row[2:]).any()]
        if with_power:
            motors, power = dynamics.mechanism.motors.names, _power(dynamics)
            rows += [(f"energy.{name}", power[k] / power_unit, -np.inf, 0.0) for k, name in enumerate(motors)]
        labels, bounds = [row[0] for row in rows], [row[2:] for row in rows]
        self._parts: list[tuple[StateFunctions, slice]] = []
        if limits.singularity and len(dynamics.z_at):
            measure = SmallestSingularValue(dynamics, dynamics.smallest_singular_values(start[None])[0])
            self._parts.append((measure, slice(0, 1)))
            labels.insert(0, "sigma_min")
            bounds.insert(0, (limits.singularity, np.inf))
        if rows:
            columns = slice(len(labels) - len(rows), len(labels))
            self._parts.append((ExpressionFunctions(dynamics, [row[1] for row in rows]), columns))
        self.labels = tuple(labels)
        self.bounds: Array = np.array(bounds).reshape(-1, 2).T

    def values(self, at: MotionInstants) -> Array:
        """Return the functions' values, (m, functions)."""
        return np.hstack([np.zeros((len(at.q_tree), 0)), *(part.values(at) for part, _ in self._parts)])

    def gradients(self, at: MotionInstants) -> Array:
        """Return the derivatives by the state, (m, functions, entries)."""
        return np.concatenate([part.gradients(at) for part, _ in self._parts], axis=1)

    def add_hessian(self, total: Array, at: MotionInstants, by_x: Array, weights: Array) -> None:
        """Add the second derivatives of weights times the functions, without those of the state by x.

        Parameters
        ----------
        total : (m, size, size) array
        at : MotionInstants
        by_x : (m, entries, size) array
            Derivatives of the state by x.
        weights : (m, functions) array
        """
        for part, columns in self._parts:
            entries, second = part.hessian(at, weights[:, columns])
            if len(entries):
                some = by_x[:, entries]
                total += some.transpose(0, 2, 1) @ second @ some


def _limited(dynamics: ReducedDynamics, limits: MotionLimits, power_unit: float) -> list[Row]:
    """Return the limited quantities in units of about their size."""
    import casadi as cs

    mechanism = dynamics.mechanism
    tree, names, motors = mechanism.tree, mechanism.coordinates, mechanism.motors.names
    q, v, a, _ = dynamics.state_symbols
    rows: list[Row] = []
    for k in dynamics.z_at.tolist():
        unit = float(tree.step_scale[k])
        low, high = (limits.q[:, k] / unit).tolist()
        if np.isfinite([low, high]).any():
            rows.append((names[k], q[int(tree.q_index[k])] / unit, low, high))
        rows += [_symmetric(f"v.{names[k]}", v[k], limits.rate[k]),
                 _symmetric(f"a.{names[k]}", a[k], limits.acceleration[k])]  # fmt: skip
    speed, power = cs.mtimes(cs.sparsify(cs.DM(mechanism.motors.transmission)), v), _power(dynamics)
    for k, name in enumerate(motors):
        rows += [_symmetric(f"speed.{name}", speed[k], limits.speed[k]),
                 _symmetric(f"power.{name}", power[k], limits.power[k])]  # fmt: skip
    rows.append(("total_power", cs.sum1(power) / power_unit, -np.inf, limits.total_power / power_unit))
    points = dict(zip(mechanism.points, cs.vertsplit(dynamics.points, 3), strict=True)) if limits.spheres else {}
    for label, (point, centre, radius) in zip(limits.sphere_names, limits.spheres, strict=True):
        # The distance is nearly linear in the position; a small part of the radius makes it smooth at the centre.
        distance = cs.sqrt(cs.sumsqr(points[point] - cs.DM(centre)) + (ROUNDING * radius) ** 2)
        rows.append((label, distance / mechanism.size, radius / mechanism.size, np.inf))
    return rows


def _symmetric(label: str, expression: Any, limit: float) -> Row:
    unit = float(limit) if np.isfinite(limit) else 1.0
    return label, expression / unit, -float(limit) / unit, float(limit) / unit


def _power(dynamics: ReducedDynamics) -> Any:
    """Return the mechanical power of each motor."""
    import casadi as cs

    _, v, _, tau = dynamics.state_symbols
    return tau * cs.mtimes(cs.sparsify(cs.DM(dynamics.mechanism.motors.transmission)), v)
