"""Durations of the fastest motions along paths, compared with TOPP-RA's own program on the reduced equations of motion.

The program is `toppra` (Pham and Pham 2018). It gets the same paths, and D q_ddot + C q_dot + h of the terms in NumPy.
"""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin import InputError, Mechanism
from ckc_pin.base.arrays import Array
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.optimization.path import make_path
from ckc_pin.optimization.spec import PathSpec

__all__ = ["CASES", "compare", "main"]

MAX_DIFFERENCE = 1e-3  # relative, of durations
LENGTH = 0.3  # of the range of s for toppra, near the durations in s: its solver fails for some paths over 0 to 1
CASES: dict[str, tuple[dict[str, Any], float]] = {  # path and torque limit
    "five_bar": ({"q": {"theta_1": [-1.434, -1.2, -1.0], "theta_3": [-1.707, -1.6, -1.9]}}, 2.0),
    "three_rrr": ({"q": {"a_1": [-0.675, -0.5, -0.4], "a_2": [1.419, 1.5, 1.3], "a_3": [3.514, 3.4, 3.5]}}, 1.0),
    "delta": ({"point": {"plate": [[0.0, 0.0, -0.2911], [0.05, 0.05, -0.27], [0.1, 0.0, -0.29]]}}, 5.0),
}


def compare(name: str, intervals: int) -> tuple[float, float]:
    """Return the durations by ckc_pin and by toppra, s."""
    table, torque = CASES[name]
    mechanism = ckc_pin.load(name)
    plan = ckc_pin.optimize(mechanism, path=table, limits={"torque": torque}, intervals=intervals)
    path = make_path(PathSpec(**table), mechanism).q
    return plan.t_end, _duration_by_toppra(mechanism, path, torque, intervals, LENGTH)


def _duration_by_toppra(
    mechanism: Mechanism, path: PiecewisePolynomial, torque: float, intervals: int, length: float
) -> float:
    try:
        interpolator, constraint, algorithm = (
            import_module(f"toppra.{part}") for part in ("interpolator", "constraint", "algorithm")
        )
    except ModuleNotFoundError as error:
        raise InputError("peer of time-optimal motions: toppra is not installed: pip install toppra") from error

    class Path(interpolator.AbstractGeometricPath):  # type: ignore[misc, name-defined]
        dof, path_interval, waypoints, duration = mechanism.d, np.array([0.0, length]), None, length

        def __call__(self, s: Any, order: int = 0) -> Array:
            values = path(np.atleast_1d(np.asarray(s, dtype=float)) / length)[order] / length**order
            return values if np.ndim(s) else values[0]

    def torques(q: Array, q_dot: Array, q_ddot: Array) -> Array:
        terms = ckc_pin.terms(mechanism, q, q_dot)
        return np.asarray(terms.D @ q_ddot + terms.C @ q_dot + terms.h)

    limits = np.tile([-torque, torque], (mechanism.d, 1))
    of_torque = constraint.JointTorqueConstraint(torques, limits, np.zeros(mechanism.d),
                                                 constraint.DiscretizationType.Collocation)  # fmt: skip
    s = length * (1 - np.cos(np.pi * np.linspace(0.0, 1.0, intervals + 1))) / 2
    solver = algorithm.TOPPRA([of_torque], Path(), gridpoints=s, solver_wrapper="seidel")
    _, speeds, _ = solver.compute_parameterization(0.0, 0.0)
    return float(np.sum(2 * np.diff(s) / (speeds[1:] + speeds[:-1])))


def main(names: Collection[str], intervals: int) -> int:
    """Print durations of both programs; return 1 if they differ too much."""
    print("| mechanism | ckc_pin | toppra | difference |")
    print("|---|---|---|---|")
    missed = 0
    for name in names:
        one, other = compare(name, intervals)
        print(f"| {name} | {one:.6f} s | {other:.6f} s | {abs(one / other - 1):.4%} |", flush=True)
        missed |= abs(one / other - 1) > MAX_DIFFERENCE
    return int(missed)
