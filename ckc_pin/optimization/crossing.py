"""Motions through singular configurations, where phi_z is singular.

There the independent coordinates do not determine the others, and det phi_z changes its sign. In other coordinates,
eq. 6 is regular. If the independent coordinates are the driven ones, the configuration is a parallel singularity (of
type 2): the motors produce no force in one direction, so that the motion must need none (Briot and Arakelian 2008).
With bounded torques, each solution of eq. 6 in the other coordinates fulfils this condition.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, islice
from math import comb

import numpy as np
from scipy.optimize import brentq

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import scale_jacobian
from ckc_pin.optimization.free_path import MAX_ATTEMPTS, find_path, is_separated
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.path import CoordinatePath
from ckc_pin.optimization.plan import Crossing
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.replay import CoordinateMotion

__all__ = ["find_crossings", "find_routes"]

MAX_CHOICES = 2000  # of coordinates that are compared
MAX_ROUTES = 4  # choices of coordinates in which a path is searched
FEW_ATTEMPTS = 96  # at a path in each of them, at first
SMALL_SINGULAR_VALUE = 1e-3  # of the scaled phi_z: below it, coordinates are not tried


def find_routes(
    mechanism: Mechanism, limits: MotionLimits, start: Array, end: Array
) -> list[tuple[Mechanism, CoordinatePath]]:
    """Find paths between two closed configurations (nq,), each in other independent coordinates.

    The coordinates that are best conditioned at both ends come first.
    """
    twins = (mechanism.with_independent(names) for names in _order_choices(mechanism, start, end))
    choices = list(islice((twin for twin in twins if not is_separated(twin, limits, start, end)), MAX_ROUTES))
    for attempts in (FEW_ATTEMPTS, MAX_ATTEMPTS):
        paths = [(planned, find_path(planned, limits, start, end, attempts)) for planned in choices]
        routes = [(planned, path) for planned, path in paths if path is not None]
        if routes:
            return routes
    return []


def _order_choices(mechanism: Mechanism, start: Array, end: Array) -> list[tuple[str, ...]]:
    """Return choices of independent coordinates, best first, by the smaller sigma_min(phi_z) of both ends."""
    jacobians = [scale_jacobian(mechanism.kinematics(q_tree).J, mechanism.tree, mechanism.closure)
                 for q_tree in (start, end)]  # fmt: skip
    rows = mechanism.independent_rows
    joints = [k for k, name in enumerate(mechanism.coordinates) if name not in mechanism.tree.free_coordinates]
    choices: list[tuple[int, ...]] = []
    if comb(len(joints), mechanism.d) <= MAX_CHOICES:
        choices = list(combinations(joints, mechanism.d))
    else:
        for q_tree in (start, end):
            best = mechanism.choose_partition(mechanism.kinematics(q_tree))
            if best is not None and set(best.q.tolist()) <= set(joints):
                choices.append(tuple(best.q.tolist()))
    independent = set(mechanism.partition.q.tolist())

    def conditioning(q: tuple[int, ...]) -> float:
        z = np.setdiff1d(np.arange(mechanism.n), q)
        return min(float(np.linalg.svd(J[rows][:, z], compute_uv=False)[-1]) for J in jacobians)

    scored = [(conditioning(q), q) for q in dict.fromkeys(choices) if set(q) != independent]
    scored = sorted((x for x in scored if x[0] > SMALL_SINGULAR_VALUE), key=lambda x: -x[0])
    return [tuple(mechanism.coordinates[k] for k in q) for _, q in scored]


def find_crossings(
    mechanism: Mechanism, dynamics: ReducedDynamics, motion: CoordinateMotion, t: Array, at: MotionInstants,
    torque: Callable[[Array], Array],
) -> tuple[Crossing, ...]:  # fmt: skip
    """Return where a motion in other coordinates passes singular configurations of a mechanism.

    There are none if the coordinates are the mechanism's independent ones.

    Parameters
    ----------
    mechanism : Mechanism
    dynamics : ReducedDynamics
        In the coordinates of the motion.
    motion : CoordinateMotion
    t : (m,) array
    at : MotionInstants
        The motion at these times.
    torque : callable
        Motor torques (k, motors) at times (k,).
    """
    if dynamics.mechanism is mechanism:  # Its loops are followed without a change of the sign of det phi_z.
        return ()
    z = mechanism.partition.z

    def determinant(time: float, sample: int) -> float:
        q_tree = dynamics.follow(at.q_tree[sample], motion(np.array([time]))[0])
        assert q_tree is not None
        return float(np.linalg.det(dynamics.jacobians(q_tree)[0][:, z]))

    signs = np.linalg.slogdet(dynamics.jacobians(at.q_tree)[:, :, z])[0]
    crossings = []
    for k in np.flatnonzero(signs[1:] * signs[:-1] < 0):
        time = float(brentq(determinant, t[k], t[k + 1], args=(k,)))
        crossings.append(Crossing(time, _unbalanced(dynamics, motion, time, at.q_tree[k], torque)))
    return tuple(crossings)


def _unbalanced(
    dynamics: ReducedDynamics, motion: CoordinateMotion, time: float, start: Array, torque: Callable[[Array], Array]
) -> float:
    q, v, a = motion(np.array([time]))
    q_tree = dynamics.follow(start, q)
    assert q_tree is not None
    direction = np.linalg.svd(dynamics.transmission(q_tree)[0])[0][:, -1]
    needed = dynamics.instants(q_tree, v, a, np.zeros((1, dynamics.motors))).force[0]
    missing = dynamics.instants(q_tree, v, a, torque(np.array([time]))).force[0]
    return float(np.abs(direction @ missing) / np.linalg.norm(needed))
