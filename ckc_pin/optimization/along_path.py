"""Time-optimal motion along a path: limits of motors, rates and accelerations as rows of s_ddot and s_dot^2.

With q = q(s), the force that the motors have to produce is a1 s_ddot + a2 s_dot^2 + a3 by eq. 6, plus dampers' forces
proportional to s_dot. The motors can produce the forces rho^T G^T tau within a zonotope, whose facets are the rows.
They are exact for redundant motors too.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.dynamics.inverse import friction_force
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.native import _core
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.path import CoordinatePath
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.speed_profile import (
    Blocked,
    SpeedProfile,
    SpeedRows,
    estimate_slopes,
    fastest_profile,
)

__all__ = ["PathDynamics", "find_fastest", "largest_path_rates", "minimum_norm_within", "path_dynamics"]

MAX_SWEEPS = 12
MAX_SLOPE_SWEEPS = 4  # then the slopes of s_ddot stay as they are, so that dampers' forces converge
SWEEP_TOLERANCE = 1e-10  # relative change of s_dot^2
MAX_FACETS = 2000  # of the motors' zonotope at one place
FORCE_TOLERANCE = 1e-9  # relative to the largest force
SMALL_WEIGHT = 1e-7
FACET_CHUNK = 50_000  # systems of equations that are solved together


class PathDynamics(Immutable, frozen=True):
    """The reduced equations of motion along a path, at m places.

    Attributes
    ----------
    s : (m,) array
    q_tree : (m, nq) array
    v_tree : (m, n) array
        v' for s_dot = 1.
    a_tree : (m, n) array
        v'_dot for s_dot = 1 and s_ddot = 0.
    inertia, centrifugal, damping, static : (m, d) arrays
        Forces by s_ddot, s_dot^2, s_dot, and at rest; dry friction of the motion along the path is part of the last.
    transmission : (m, d, motors) array
        rho^T G^T.
    """

    s: Array
    q_tree: Array
    v_tree: Array
    a_tree: Array
    inertia: Array
    centrifugal: Array
    damping: Array
    static: Array
    transmission: Array

    def force(self, u: Array, b: Array) -> Array:
        """Return the forces that the motors have to produce at all places, (m, d)."""
        u, b = u[:, None], np.maximum(b, 0.0)[:, None]
        return self.inertia * u + self.centrifugal * b + self.damping * np.sqrt(b) + self.static


def path_dynamics(
    dynamics: ReducedDynamics, path: CoordinatePath, s: Array, closed: PathDynamics | None = None
) -> PathDynamics:
    """Return the equations of motion at places of a path, with closed configurations as in `follow_places`.

    Raises
    ------
    InputError
        The loops do not let the mechanism follow the path.
    """
    q, q_s, q_ss = path.q(s)
    q_tree = follow_places(dynamics, path, s, closed)
    zero, no_torque = np.zeros_like(q), np.zeros((len(s), dynamics.motors))
    at_rest = dynamics.instants(q_tree, zero, zero, no_torque)
    forth = dynamics.instants(q_tree, q_s, q_ss, no_torque)
    back = dynamics.instants(q_tree, -q_s, q_ss, no_torque)
    pushed = dynamics.instants(q_tree, zero, q_s, no_torque)
    friction = friction_force(dynamics.mechanism, forth.v_tree)
    return PathDynamics(
        s=s,
        q_tree=q_tree,
        v_tree=forth.v_tree,
        a_tree=forth.a_tree,
        inertia=pushed.force - at_rest.force,
        centrifugal=(forth.force + back.force) / 2 - at_rest.force,
        damping=(forth.force - back.force) / 2,
        static=at_rest.force - np.einsum("mnd,mn->md", dynamics.rho(q_tree), friction),
        transmission=dynamics.transmission(q_tree),
    )


def follow_places(
    dynamics: ReducedDynamics, path: CoordinatePath, s: Array, closed: PathDynamics | None = None
) -> Array:
    """Return closed configurations at places s (m,) of a path, each followed from the one before it.

    Parameters
    ----------
    dynamics : ReducedDynamics
    path : CoordinatePath
    s : (m,) array
        Not decreasing.
    closed : PathDynamics, optional
        Places with known closed configurations, from which the places behind them are closed together.

    Raises
    ------
    InputError
        The loops do not close.
    """
    if closed is not None:
        before = np.maximum(np.searchsorted(closed.s, s, side="right") - 1, 0)
        q_tree = dynamics.close(closed.q_tree[before], path.q(s)[0])
        if q_tree is not None:
            return q_tree
        # The path may bend between the places.
        places = np.union1d(s, closed.s)
        return follow_places(dynamics, path, places)[np.searchsorted(places, s)]
    mechanism, q = dynamics.mechanism, path.q(s)[0]
    start = mechanism.q_tree if path.start is None else path.start
    q_tree = dynamics.follow(start, q)
    if q_tree is None:
        count = next(k for k in range(len(q)) if dynamics.follow(start, q[: k + 1]) is None)
        place = ", ".join(f"{name} = {x:.4g}" for name, x in zip(mechanism.independent, q[count], strict=True))
        raise InputError(
            f"optimize: path: the loops cannot be kept closed on this branch at s = {s[count]:.4f} ({place}); choose a "
            "path within the workspace"
        )
    return q_tree


def find_fastest(dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits) -> tuple[SpeedProfile, int]:
    """Return the fastest motion along a path, from rest to rest, and the number of sweeps.

    Raises
    ------
    InputError
        No motor moves a freedom, or nothing limits the speed.
    NumericalError
        At some place no speed fulfils the limits.
    """
    normals, reach = _torque_facets(dynamics, path, limits)
    labels = _facet_names(dynamics, normals.shape[1])
    largest = largest_path_rates(dynamics, path, limits)
    b, slopes, sweeps = None, np.zeros(len(path.s) - 1), 0
    for sweeps in range(1, MAX_SWEEPS + 1):
        rows, names = _rows(dynamics, path, limits, normals, reach, largest, b, labels)
        result = fastest_profile(path.s, rows, 0.0, 0.0, slopes)
        if isinstance(result, Blocked):
            if b is not None and not np.any(path.damping):  # the last sweep fulfils the limits with other slopes
                break
            raise NumericalError(
                f"optimize: infeasible: at s = {path.s[result.interval]:.4f} of the path no speed is within the limits "
                f"of {names[result.row % len(names)]}; raise them or change the path"
            )
        change = np.inf if b is None else np.abs(result - b).max() / result.max()
        b, used_slopes = result, slopes
        if not np.all(b[1:-1] > 0):
            k = 1 + int(np.argmin(b[1:-1]))
            raise NumericalError(
                f"optimize: infeasible: the motion has to stop at s = {path.s[k]:.4f} of the path; raise the limits"
            )
        if change <= SWEEP_TOLERANCE:
            break
        if sweeps < MAX_SLOPE_SWEEPS:
            slopes = estimate_slopes(path.s, b)
    assert b is not None
    return SpeedProfile(path.s, b, used_slopes), sweeps


def _torque_facets(dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits) -> tuple[Array, Array]:
    """Return normals (m, facets, d) and largest values (m, 2, facets) of the forces that the motors can produce."""
    d, motors = dynamics.d, dynamics.motors
    names = dynamics.mechanism.motors.names
    transmission = path.transmission
    if motors == 0 or np.any(np.linalg.matrix_rank(transmission) < d):
        raise InputError(
            f"optimize: the motors {', '.join(names) or '(none)'} do not drive all {d} freedoms along the path, so "
            "that it cannot be followed"
        )
    finite = np.isfinite(limits.torque)
    if not finite.any():
        return np.zeros((len(path.s), 0, d)), np.zeros((len(path.s), 2, 0))
    chosen = list(combinations(range(motors), d - 1))
    if len(chosen) > MAX_FACETS:
        raise InputError(
            f"optimize: {motors} motors for {d} freedoms have {len(chosen)} limiting combinations; "
            f"at most {MAX_FACETS} are supported"
        )
    if motors == d:
        inverse = np.linalg.inv(transmission)  # rows: the force along which only one motor acts
        normals = inverse
    else:
        normals = np.empty((len(path.s), len(chosen), d))
        step = max(1, FACET_CHUNK // len(chosen))
        for begin in range(0, len(path.s), step):
            columns = transmission[begin : begin + step][:, :, np.array(chosen, dtype=np.intp)].transpose(0, 2, 1, 3)
            u, values, _ = np.linalg.svd(columns, full_matrices=True)
            normals[begin : begin + step] = u[:, :, :, -1]
            if d > 1:  # motors that act along fewer directions bound nothing
                flat = values[..., -1] <= 1e-9 * values[..., :1].max(axis=-1)
                normals[begin : begin + step][flat] = 0.0
    per_motor = normals @ transmission
    per_motor[np.abs(per_motor) < 1e-12 * np.abs(per_motor).max()] = 0.0
    with np.errstate(invalid="ignore"):
        products = np.array([np.where(per_motor == 0, 0.0, per_motor * limit) for limit in limits.torque])
    reach = np.stack([-products.min(axis=0).sum(axis=-1), products.max(axis=0).sum(axis=-1)], axis=1)
    return np.asarray(normals, dtype=float), reach


def _facet_names(dynamics: ReducedDynamics, count: int) -> list[str]:
    motors = dynamics.mechanism.motors.names
    if count == len(motors):
        return [f"tau.{name}" for name in motors]
    return ["the motors together"] * count


def largest_path_rates(dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits) -> Array:
    """Return the largest s_dot^2 that limits of rates and shaft speeds admit."""
    shafts = path.v_tree @ dynamics.mechanism.motors.transmission.T
    with np.errstate(divide="ignore"):
        rates = (limits.rate / np.abs(path.v_tree)).min(axis=1, initial=np.inf)
        speeds = (limits.speed / np.abs(shafts)).min(axis=1, initial=np.inf)
    return np.minimum(rates, speeds) ** 2


def _rows(
    dynamics: ReducedDynamics, path: PathDynamics, limits: MotionLimits, normals: Array, reach: Array, largest: Array,
    b: Array | None, labels: list[str],
) -> tuple[SpeedRows, list[str]]:  # fmt: skip
    """Return the rows of all limits, with dampers' forces linearized about the last b, and the rows' names."""
    centrifugal, static = path.centrifugal, path.static
    if b is not None:
        speed = np.sqrt(b)[:, None]
        slope = np.where(speed > 0, path.damping / (2 * np.where(speed > 0, speed, 1.0)), 0.0)
        centrifugal, static = centrifugal + slope, static + path.damping * speed / 2
    alpha = np.einsum("mfd,md->mf", normals, path.inertia)
    beta = np.einsum("mfd,md->mf", normals, centrifugal)
    rest = np.einsum("mfd,md->mf", normals, static)
    accelerated = np.flatnonzero(np.isfinite(limits.acceleration))
    by_u, by_b = path.v_tree[:, accelerated], path.a_tree[:, accelerated]
    size = np.broadcast_to(limits.acceleration[accelerated], by_u.shape)
    alpha = np.hstack([alpha, -alpha, by_u, -by_u])
    beta = np.hstack([beta, -beta, by_b, -by_b])
    gamma = np.hstack([reach[:, 1] - rest, reach[:, 0] + rest, size, size])
    coordinates = [f"a.{dynamics.mechanism.coordinates[k]}" for k in accelerated]
    names = np.array([*labels, *labels, *coordinates, *coordinates], dtype=object)
    used = np.isfinite(gamma).any(axis=0)
    gamma = np.where(np.isfinite(gamma), gamma, 1e300)
    largest = np.where(np.isfinite(largest), largest, _reachable_b(path, alpha[:, used], beta[:, used], gamma[:, used]))
    return SpeedRows(alpha[:, used], beta[:, used], gamma[:, used], largest), names[used].tolist()


def _reachable_b(path: PathDynamics, alpha: Array, beta: Array, gamma: Array) -> Array:
    """Return a bound of s_dot^2 at all places: each place's, or what the accelerations since the start allow."""
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.where(alpha > 0, gamma / alpha, np.inf).min(axis=1, initial=np.inf)
    if not np.isfinite(up).all():
        raise InputError("optimize: limits: nothing limits the speed along the path; give torque, rate or acceleration")
    reached = 1e3 * 2 * np.ptp(path.s) * max(float(np.abs(up).max()), 1e-300)
    return _core.largest_b(alpha, beta, gamma, bound=reached)


def minimum_norm_within(transmission: Array, force: Array, limit: Array) -> Array:
    """Return the torques (m, motors) of smallest norm within limits (2, motors) that produce forces (m, d).

    Torques of motors that are not redundant are clipped at their limits. Of redundant motors, the torque that exceeds
    its limits most is set to the limit, and the others are distributed again. Where that fails, bounded least squares
    decide.
    """
    tau = np.einsum("mkd,md->mk", np.linalg.pinv(transmission), force)
    motors, at = transmission.shape[2], np.arange(len(force))
    if motors <= transmission.shape[1]:
        return np.clip(tau, *limit)
    fixed = np.zeros(tau.shape, dtype=bool)
    for _ in range(motors):
        beyond = np.where(fixed, -1.0, np.maximum(limit[0] - tau, tau - limit[1]))
        worst = beyond.argmax(axis=1)
        exceeded = beyond[at, worst] > 0
        if not exceeded.any():
            break
        fixed[at[exceeded], worst[exceeded]] = True
        fixed_torque = np.where(fixed, np.clip(tau, *limit), 0.0)
        rest = force - np.einsum("mdk,mk->md", transmission, fixed_torque)
        free = np.where(fixed[:, None, :], 0.0, transmission)
        tau = fixed_torque + np.where(fixed, 0.0, np.einsum("mkd,md->mk", np.linalg.pinv(free, rcond=1e-9), rest))
    tau = np.clip(tau, *limit)
    missing = np.abs(np.einsum("mdk,mk->md", transmission, tau) - force).max(axis=1)
    for k in np.flatnonzero(missing > FORCE_TOLERANCE * np.abs(force).max()):
        from scipy.optimize import lsq_linear

        # A small weight of the torques makes them unique.
        matrix = np.vstack([transmission[k], SMALL_WEIGHT * np.eye(motors)])
        tau[k] = lsq_linear(matrix, np.append(force[k], np.zeros(motors)), bounds=limit, method="bvls").x
    return tau
