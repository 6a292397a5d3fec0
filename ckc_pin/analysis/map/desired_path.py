"""Place a desired trajectory in a map, and measure its closest approach to each locus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.map.loci import find_aspects
from ckc_pin.analysis.map.nearest import find_nearest_singular
from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.control.desired import Desired
from ckc_pin.control.point_path import PointPath
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.errors import InputError
from ckc_pin.kinematics.grid import Domain, Grid
from ckc_pin.kinematics.mapped import Approach, Locus, Path
from ckc_pin.kinematics.nodes import shape_points
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["DesiredTrajectory", "add_path", "read_desired"]

SAMPLES = 2000  # of a trajectory
BATCH_SAMPLES = 200  # compared with a locus at a time
SPLINE_POINTS = 6  # of a locus on each side of the closest one
MAX_ITERATIONS = 400  # of the local minimization

PlaceAt = Callable[[float], Array]  # from a time to a place in the map


@dataclass(frozen=True)
class DesiredTrajectory:
    """A scene's desired trajectory: q_d at instants t (s), and whether the mechanism can follow it."""

    name: str
    desired: Desired
    t: Array
    check: DesiredCheck


def read_desired(scene: Scene, mechanism: Mechanism) -> DesiredTrajectory:
    """Return a scene's desired trajectory. A set point is a trajectory with one instant.

    Raises
    ------
    InputError
        The scene has another mechanism, or no desired trajectory.
    """
    scene_mech = load_scene_mechanism(scene)
    scene_mech.refuse_prescribed_joints("--scene")
    if scene_mech.coordinates != mechanism.coordinates or scene_mech.independent != mechanism.independent:
        raise InputError(f"--scene {scene.name}: its mechanism is {scene_mech.name}, the map's is {mechanism.name}")
    controller = build_scene_controller(scene, mechanism)
    if isinstance(controller, SetPoint):
        target, zero = controller.target.q, np.zeros(mechanism.d)
        check = DesiredCheck(None, 0.0, controller.target.at.sigma_min())
        return DesiredTrajectory(scene.name, lambda t: (target, zero, zero), np.zeros(1), check)
    if not isinstance(controller, Tracking):
        raise InputError(
            f"--scene {scene.name}: it has no desired trajectory; name a scene with set-point or tracking control"
        )
    check = follow_desired(mechanism, controller.desired, scene.spec.t_end)
    t = np.linspace(0.0, scene.spec.t_end, SAMPLES + 1)
    if check.leaves_at is not None and isinstance(controller.desired, PointPath):
        t = t[t <= check.leaves_at]  # q_d does not exist later
    return DesiredTrajectory(scene.name, controller.desired, t, check)


def add_path(
    trajectory: DesiredTrajectory,
    mechanism: Mechanism,
    grids: Sequence[Grid],
    loci: Sequence[Locus],
    is_cartesian: bool,
) -> Path:
    """Return a desired trajectory as a path in a map, with its closest approach to each locus and in all of q."""
    desired, t, check, domain = trajectory.desired, trajectory.t, trajectory.check, grids[0].domain
    if check.leaves_at is not None and is_cartesian:
        t = t[t <= check.leaves_at]
    follower = _Follower(mechanism, domain, is_cartesian)
    places = np.array([follower(desired(float(x))[0]) for x in t])
    if is_cartesian:
        on = find_aspects(places, shape_points(mechanism, np.array(follower.configurations)), grids)
    else:  # q_d is compared with the assembled branch, whether it can be reached or not
        on = np.repeat(np.arange(len(grids))[:, None] == 0, len(t), axis=1)
    approaches = [
        _closest_approach(
            domain, k, locus, _compared_points(locus, is_cartesian), t, places, on, lambda x: follower(desired(x)[0])
        )
        for k, locus in enumerate(loci)
    ]
    return Path(
        name=trajectory.name,
        t=t,
        at=places,
        on=on,
        leaves_at=check.leaves_at,
        closest_t=check.closest_t,
        sigma_min=check.sigma_min,
        approaches=tuple(sorted((a for a in approaches if a is not None), key=lambda a: a.distance)),
        nearest=None if check.leaves_at is not None else find_nearest_singular(mechanism, desired, t),
    )


class _Follower:
    """Map q_d to a place in the map: q_d itself, or the point's position on the branch that is being followed."""

    def __init__(self, mechanism: Mechanism, domain: Domain, is_cartesian: bool) -> None:
        self.mechanism = mechanism
        self.domain = domain
        self.is_cartesian = is_cartesian
        self.at: Kinematics | None = None
        self.configurations: list[Array] = []

    def __call__(self, q: Array) -> Array:
        if not self.is_cartesian:
            return q[self.domain.over]
        rows = self.domain.task.rows[self.domain.over]
        self.at = sigma(self.mechanism, q, self.at).at
        self.configurations.append(self.at.q_tree)
        values, _ = evaluate_closure(self.mechanism.tree, self.domain.task.extended.closure, self.at.q_tree[None])
        return np.asarray(values[0, rows])


def _compared_points(locus: Locus, is_cartesian: bool) -> BoolArray:
    """Return which points of a locus are compared with a trajectory on each aspect, shape (aspects, m).

    These are the points seen from the aspect. Where aspects end on the locus, or the map shows it as one point, all
    points that any aspect sees are compared, because any of their configurations stands for the others.
    """
    is_border = (locus.kind == "serial") == is_cartesian
    if is_border or locus.is_point:
        return np.repeat(np.any(locus.on, axis=1, keepdims=True), locus.on.shape[1], axis=1)
    return locus.on


def _closest_approach(
    domain: Domain,
    number: int,
    locus: Locus,
    compared: BoolArray,
    t: Array,
    places: Array,
    on: BoolArray,
    place_at: PlaceAt,
) -> Approach | None:
    """Return the closest approach of a trajectory to a locus; None if they share no aspect.

    All samples are compared. The closest pair is refined on smooth curves through its neighbours, to about 1e-7 of the
    map's units.

    Parameters
    ----------
    domain : Domain
    number : int
        Of the locus.
    locus : Locus
    compared, on : (aspects, m) arrays of bool
        Which points of the locus and of the trajectory are on which aspect. Only points on one aspect are compared.
    t, places : arrays
        Of the trajectory.
    place_at : callable
        Place of the trajectory at a time.
    """
    closest = np.inf, 0, 0
    points = np.flatnonzero(compared.any(axis=0))
    for i in range(0, len(places) if len(points) else 0, BATCH_SAMPLES):
        batch = slice(i, i + BATCH_SAMPLES)
        samples = places[batch]
        gap = domain.difference(np.repeat(samples, len(points), axis=0), np.tile(locus.at[points], (len(samples), 1)))
        share_aspect = on[:, batch].T.astype(int) @ compared[:, points].astype(int) > 0
        distances = np.where(share_aspect.ravel(), np.linalg.norm(gap, axis=1), np.inf)
        k = int(np.argmin(distances))
        if distances[k] < closest[0]:
            closest = float(distances[k]), i + k // len(points), int(points[k % len(points)])
    if not np.isfinite(closest[0]):
        return None
    _, sample, point = closest
    curve, first, last = _smooth_curve(locus, point)
    dt = max(float(t[-1] - t[0]) / max(len(t) - 1, 1), 1e-300)

    def ends(x: Array) -> tuple[float, Array, Array]:
        """Return time and both places at offsets (samples, points) from the closest pair."""
        time = float(np.clip(t[sample] + x[0] * dt, t[0], t[-1]))
        return time, place_at(time), np.asarray(curve(float(np.clip(point + x[1], first, last))))

    def distance(x: Array) -> float:
        _, place, target = ends(x)
        return float(np.linalg.norm(domain.difference(place[None], target[None])))

    from scipy.optimize import minimize

    simplex = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    options = {"xatol": 1e-9, "fatol": 1e-15, "maxiter": MAX_ITERATIONS, "initial_simplex": simplex}
    bounds = [(-SPLINE_POINTS, SPLINE_POINTS)] * 2
    minimum = minimize(distance, simplex[0], method="Nelder-Mead", bounds=bounds, options=options)
    time, place, target = ends(minimum.x)
    return Approach(number, distance(minimum.x), time, place, target)


def _smooth_curve(locus: Locus, point: int) -> tuple[Callable[[float], Array], float, float]:
    """Return a spline through the points of a locus near one of them, and the range of its parameter, a number."""
    places = locus.at
    if len(places) < 2 * SPLINE_POINTS or locus.is_point:
        return lambda s: places[point], float(point), float(point)
    from scipy.interpolate import make_interp_spline

    first = int(np.clip(point - SPLINE_POINTS, 0, len(places) - 2 * SPLINE_POINTS))
    numbers = np.arange(first, first + 2 * SPLINE_POINTS)
    return make_interp_spline(numbers, places[numbers], k=5), first + 1.0, first + 2.0 * SPLINE_POINTS - 2.0
