"""A desired trajectory in a map, and how close it comes to each locus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.map.grid import Domain, Grid
from ckc_pin.analysis.map.loci import seen
from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.desired import Desired
from ckc_pin.control.point_path import PointPath
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.errors import InputError
from ckc_pin.kinematics.mapped import Approach, Locus, Path
from ckc_pin.kinematics.nodes import shape_points
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["Wanted", "add_path", "read_wanted"]

SAMPLES = 2000
BATCH = 200  # samples compared with a locus at a time
POINT = 1e-9  # of the map's units: a locus no larger is a point
SIDE = 6  # points of a locus on each side of the closest one

Place = Callable[[float], Array]


@dataclass(frozen=True)
class Wanted:
    """A scene's desired trajectory: q_d at instants t (s), and whether it stays where the mechanism can follow."""

    name: str
    desired: Desired
    t: Array
    check: DesiredCheck


def read_wanted(scene: Scene, mechanism: Mechanism) -> Wanted:
    """Return what a scene's controller wants; a set point is a trajectory of one instant.

    Raises
    ------
    InputError
        The scene has another mechanism, or no desired trajectory.
    """
    own = load_scene_mechanism(scene)
    if own.coordinates != mechanism.coordinates or own.independent != mechanism.independent:
        raise InputError(f"--scene {scene.name}: it is of {own.name}, the map of {mechanism.name}")
    controller = build_scene_controller(scene, mechanism)
    if isinstance(controller, SetPoint):
        target, still = controller.target.q, np.zeros(mechanism.d)
        check = DesiredCheck(None, 0.0, controller.target.at.sigma_min())
        return Wanted(scene.name, lambda t: (target, still, still), np.zeros(1), check)
    if not isinstance(controller, Tracking):
        raise InputError(f"--scene {scene.name}: it has no controller, so nothing is desired; give one that has")
    check = follow_desired(mechanism, controller.desired, scene.spec.t_end)
    t = np.linspace(0.0, scene.spec.t_end, SAMPLES + 1)
    if check.leaves_at is not None and isinstance(controller.desired, PointPath):
        t = t[t <= check.leaves_at]  # beyond there is no q_d
    return Wanted(scene.name, controller.desired, t, check)


def add_path(
    wanted: Wanted, mechanism: Mechanism, grids: Sequence[Grid], loci: Sequence[Locus], cartesian: bool
) -> Path:
    """Draw a desired trajectory into a map and measure its closest approaches."""
    desired, t, check = wanted.desired, wanted.t, wanted.check
    if check.leaves_at is not None and cartesian:
        t = t[t <= check.leaves_at]
    follower = _Follower(mechanism, grids[0].domain, cartesian)
    way, on = _way(follower, desired, t, grids)
    found = [
        _closest(grids[0].domain, k, locus, _shown(locus, cartesian), t, way, on, lambda x: follower(desired(x)[0]))
        for k, locus in enumerate(loci)
    ]
    return Path(
        name=wanted.name,
        t=t,
        at=way,
        on=on,
        leaves_at=check.leaves_at,
        closest_t=check.closest_t,
        sigma_min=check.sigma_min,
        approaches=tuple(sorted((a for a in found if a is not None), key=lambda approach: approach.distance)),
    )


def _shown(locus: Locus, cartesian: bool) -> BoolArray:
    """Which points of a locus are compared, shape (aspects, m).

    All of one where an aspect ends, as far as it is seen at all, and of one that the map shows as a point: there any
    of its configurations stands for all.
    """
    ends = (locus.kind == "serial") == cartesian
    if ends or np.ptp(locus.at, axis=0).max() < POINT:
        return np.repeat(np.any(locus.on, axis=1, keepdims=True), locus.on.shape[1], axis=1)
    return locus.on


def _way(follower: _Follower, desired: Desired, t: Array, grids: Sequence[Grid]) -> tuple[Array, BoolArray]:
    """Places along the trajectory, (m, axes), and which aspects they lie on, (aspects, m) of bool."""
    way = np.array([follower(desired(float(x))[0]) for x in t])
    if not follower.cartesian:  # q_d, reached or not, is compared with the assembled branch
        return way, np.repeat(np.arange(len(grids))[:, None] == 0, len(t), axis=1)
    return way, seen(way, shape_points(follower.mechanism, np.array(follower.passed)), grids)


class _Follower:
    """From q_d to a place in the map: itself, or where the point is on the branch that has been followed."""

    def __init__(self, mechanism: Mechanism, domain: Domain, cartesian: bool) -> None:
        self.mechanism = mechanism
        self.domain = domain
        self.cartesian = cartesian
        self.at: Kinematics | None = None
        self.passed: list[Array] = []

    def __call__(self, q: Array) -> Array:
        rows = self.domain.task.rows[self.domain.over]
        if not self.cartesian:
            return q[self.domain.over]
        self.at = sigma(self.mechanism, q, self.at).at
        self.passed.append(self.at.q_tree)
        given, _ = evaluate_closure(self.mechanism.tree, self.domain.task.extended.closure, self.at.q_tree[None])
        return np.asarray(given[0, rows])


def _closest(
    domain: Domain, k: int, locus: Locus, shown: BoolArray, t: Array, way: Array, on: BoolArray, place: Place
) -> Approach | None:
    """Compare all samples; then refine on smooth curves through their neighbours, to about 1e-7 of the map's units.

    Parameters
    ----------
    shown, on : (aspects, m) arrays of bool
        Which points of the locus and of the trajectory lie on which aspect; those of one are compared.
    place : callable
        Where the trajectory is at a time.
    """
    best = np.inf, 0, 0
    points = np.flatnonzero(shown.any(axis=0))
    for i in range(0, len(way) if len(points) else 0, BATCH):
        part = slice(i, i + BATCH)
        gap = domain.change(np.repeat(way[part], len(points), axis=0), np.tile(locus.at[points], (len(way[part]), 1)))
        together = on[:, part].T.astype(int) @ shown[:, points].astype(int) > 0
        gaps = np.where(together.ravel(), np.linalg.norm(gap, axis=1), np.inf)
        low = int(np.argmin(gaps))
        if gaps[low] < best[0]:
            best = float(gaps[low]), i + low // len(points), int(points[low % len(points)])
    if not np.isfinite(best[0]):
        return None
    _, sample, point = best
    curve, low_s, high_s = _curve(locus.at, point)
    step = max(float(t[-1] - t[0]) / max(len(t) - 1, 1), 1e-300)

    def ends(x: Array) -> tuple[float, Array, Array]:
        time = float(np.clip(t[sample] + x[0] * step, t[0], t[-1]))
        return time, place(time), np.asarray(curve(float(np.clip(point + x[1], low_s, high_s))))

    def distance(x: Array) -> float:
        _, here, there = ends(x)
        return float(np.linalg.norm(domain.change(here[None], there[None])))

    from scipy.optimize import minimize

    simplex = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    options = {"xatol": 1e-9, "fatol": 1e-15, "maxiter": 400, "initial_simplex": simplex}
    finer = minimize(distance, simplex[0], method="Nelder-Mead", bounds=[(-SIDE, SIDE), (-SIDE, SIDE)], options=options)
    time, here, there = ends(finer.x)
    return Approach(k, distance(finer.x), time, here, there)


def _curve(at: Array, point: int) -> tuple[Callable[[float], Array], float, float]:
    """Return a smooth curve through a locus next to one of its points, by number, and how far it may be used."""
    if len(at) < 2 * SIDE or np.ptp(at, axis=0).max() < POINT:
        return lambda s: at[point], float(point), float(point)
    from scipy.interpolate import make_interp_spline

    low = int(np.clip(point - SIDE, 0, len(at) - 2 * SIDE))
    numbers = np.arange(low, low + 2 * SIDE)
    return make_interp_spline(numbers, at[numbers], k=5), low + 1.0, low + 2.0 * SIDE - 2.0
