"""Plan a motion along a path: the fastest one, or one of another cost, on a grid that limits refine."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.dynamics.inverse import friction_force
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.along_path import (
    PathDynamics,
    find_fastest,
    follow_places,
    minimum_norm_within,
    path_dynamics,
)
from ckc_pin.optimization.end_states import refuse_unsupported, require_inside, require_regular, resolve_state
from ckc_pin.optimization.free_path import search_path
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.path import CoordinatePath, PathMotion, make_path
from ckc_pin.optimization.plan import Plan, find_active, measure
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.replay import JUMP_GAP, REPLAY_ERROR, replay_plan, replay_warnings, require_replayed
from ckc_pin.optimization.smooth_profile import optimize_profile
from ckc_pin.optimization.spec import OptimizeSpec, PathSpec, StateSpec
from ckc_pin.optimization.speed_profile import SpeedProfile

__all__ = ["plan_along"]

PATH_INTERVALS = 200
MAX_REFINEMENTS = 40  # of the grid
CHECKS_PER_INTERVAL = 7  # instants at which limits are checked between two points of the grid
SWITCH_REFINEMENTS = 3  # of the grid where s_ddot jumps
SWITCH_JUMP = 0.1  # of the range of s_ddot
DIVISION = 4  # parts of an interval inside which a limit is exceeded
MIN_SPACING = 1e-7  # of the points of the first grid
LIMIT_TOLERANCE = 2e-5  # relative: limits are narrowed by it on the grid, and by half of it between its points
FORCE_TOLERANCE = 1e-8  # relative to the largest force: what torques within limits may fail to produce
# Tables of torques; another one follows if the replay misses the end. Errors of linear interpolation between rows,
# relative to the largest torque, and the most rows in an interval.
TABLES = ((1e-6, 32), (1e-8, 512))
TIME_TOLERANCE = 1e-6  # relative, of limits.time
INTERVAL_TIME_TOLERANCE = 1e-3  # of the duration: error of the time of an interval, above which it is divided
DURATION_GUESS = 1.0  # s: of the initial guess if nothing limits the speed


def plan_along(mechanism: Mechanism, spec: OptimizeSpec, table: PathSpec, limits: MotionLimits) -> Plan:
    """Plan a motion along a path, from rest to rest.

    Raises
    ------
    InputError
        An unknown name, an option that paths do not support, or a path out of reach or outside the limits.
    NumericalError
        No motion fulfils the limits, or the optimizer does not find one.
    """
    _refuse_on_path(spec, is_free=table.shape == "free")
    refuse_unsupported(mechanism, spec.minimize, limits, spec.desired)
    dynamics = ReducedDynamics(mechanism)
    path = make_path(table, mechanism) if table.shape != "free" else _find_free_path(dynamics, spec, table, limits)
    motion, along, iterations, parts = _refine_profile(dynamics, path, limits, spec)
    t_end = float(motion.corners[-1])
    for tolerance, rows in TABLES:
        t, at, torque = _torque_table(dynamics, motion, along, limits.narrowed(LIMIT_TOLERANCE / 2), tolerance, rows)
        replay = replay_plan(mechanism, dynamics, motion, at, t, torque)
        if replay.error <= REPLAY_ERROR:
            break
    require_replayed(mechanism, replay, t_end)
    quantities, margin = measure(mechanism, dynamics, limits, at), dynamics.margins(at.q_tree)
    return Plan(
        mechanism=mechanism, status="solved", t_end=t_end,
        message="the fastest motion along the path" if _is_fastest(spec, limits) else "a local optimum along the path",
        cost=sum(getattr(spec.minimize, name) * x for name, x in parts.items()), parts=parts, iterations=iterations,
        coordinates=mechanism.independent, motion=motion, torque_t=t, torque=torque, t=t,
        quantities=quantities, margin=margin, limits=limits,
        active=tuple(find_active(limits, t, quantities, margin)), replay=replay,
        warnings=(*path.warnings, *replay_warnings(mechanism, replay)),
    )  # fmt: skip


def _is_fastest(spec: OptimizeSpec, limits: MotionLimits) -> bool:
    """Whether the cost is the duration alone, within limits that the sweeps of `find_fastest` keep."""
    weights = [name for name in spec.minimize.__struct_fields__ if getattr(spec.minimize, name)]
    others = np.concatenate([limits.torque_rate, limits.power, [limits.total_power], limits.jerk])
    return weights == ["time"] and not np.isfinite(others).any()


def _find_free_path(
    dynamics: ReducedDynamics, spec: OptimizeSpec, table: PathSpec, limits: MotionLimits
) -> CoordinatePath:
    """Return a path from one configuration to another within the limits."""
    assert spec.to is not None
    places = [key for key in ("q", "point", "rounding") if getattr(table, key) is not None]
    if places:
        raise InputError(f'optimize: path.{places[0]} does not belong to shape = "free"; remove it')
    mechanism = dynamics.mechanism
    start = resolve_state(mechanism, spec.start or StateSpec(at="assembled"), mechanism.assembled, "from")
    end = resolve_state(mechanism, spec.to, start.at, "to")
    for state, name in ((start, "from"), (end, "to")):
        require_inside(mechanism, limits, state, name)
        if state.rates.any():
            raise InputError(f"optimize: {name}.q_dot: a motion along a path begins and ends at rest; remove it")
    require_regular(mechanism, limits, start, end)
    if not np.any(end.q != start.q):
        raise InputError("optimize: to: the same configuration as `from`; give another one")
    return search_path(mechanism, limits, start.at.q_tree, end.at.q_tree)


def _refine_profile(
    dynamics: ReducedDynamics, path: CoordinatePath, limits: MotionLimits, spec: OptimizeSpec
) -> tuple[PathMotion, PathDynamics, int, dict[str, float]]:
    """Return the best motion along a path, the dynamics on its grid, iterations, and the parts of its cost.

    Intervals inside which a limit is exceeded are divided.
    """
    s = (1 - np.cos(np.pi * np.linspace(0.0, 1.0, (spec.intervals or PATH_INTERVALS) + 1))) / 2
    s = np.union1d(s, np.clip(path.q.breaks, 0.0, 1.0))
    s = s[np.concatenate([[True], np.diff(s) > MIN_SPACING])]
    narrowed, between, total = limits.narrowed(LIMIT_TOLERANCE), limits.narrowed(LIMIT_TOLERANCE / 2), 0
    inside = np.linspace(0.0, 1.0, CHECKS_PER_INTERVAL + 2)[1:-1]
    along: PathDynamics | None = None
    suspect: BoolArray | None = None  # intervals to check; all of them before the end
    is_fastest = _is_fastest(spec, limits)
    time, corrected = limits.time, limits.time  # of the optimizer, whose durations have errors of its grid
    for round_ in range(MAX_REFINEMENTS):
        along = path_dynamics(dynamics, path, s, along)
        _require_within(limits, along, dynamics)
        if _is_bounded(limits):
            profile, iterations = find_fastest(dynamics, along, narrowed)
            _require_time(profile, limits)
        else:
            profile, iterations = _make_triangle(s, limits.time), 0
        parts = {"time": float(profile.t[-1])}
        if not is_fastest:
            time = corrected
            optimum = optimize_profile(dynamics, along, replace(narrowed, time=time), spec.minimize, profile)
            profile, iterations, parts = optimum.profile, optimum.iterations, optimum.parts
            parts |= {"time": float(profile.t[-1])} if "time" in parts else {}
            corrected = _correct_time(profile, limits.time, time)
        motion, total = PathMotion(path, profile), total + iterations
        exceeded = _exceeds_inside(dynamics, motion, along, between, inside, suspect)
        if not is_fastest:
            exceeded |= _misses_time(profile)
        elif round_ < SWITCH_REFINEMENTS:
            exceeded |= _switches(profile)
        if not exceeded.any() and suspect is not None:
            exceeded = _exceeds_inside(dynamics, motion, along, between, inside, None)
        if not exceeded.any() and corrected == time:
            return motion, along, total, parts
        if not exceeded.any():
            suspect = None
            continue
        exceeded[1:] |= exceeded[:-1].copy()
        exceeded[:-1] |= exceeded[1:].copy()
        counts = np.where(exceeded, DIVISION, 1)
        suspect = np.repeat(exceeded, counts)
        s = np.append(np.repeat(s[:-1], counts) + np.repeat(np.diff(s), counts) * _parts(counts), s[-1])
    raise NumericalError(
        f"optimize: stuck: limits are exceeded between the points of a grid of {len(s) - 1} intervals along the path; "
        "give other intervals or limits"
    )


def _require_time(profile: SpeedProfile, limits: MotionLimits) -> None:
    """Require that the fastest motion takes at most `limits.time` (InputError)."""
    if profile.t[-1] > limits.time * (1 + TIME_TOLERANCE):
        raise InputError(
            f"optimize: infeasible: limits.time = {limits.time:g} s: the fastest motion takes {profile.t[-1]:.6g} s"
        )


def _is_bounded(limits: MotionLimits) -> bool:
    """Whether torques, rates or accelerations have limits, so that there is a fastest motion."""
    return bool(np.isfinite(np.hstack([limits.torque.ravel(), limits.rate, limits.acceleration, limits.speed])).any())


def _make_triangle(s: Array, duration: float) -> SpeedProfile:
    """Return the profile that accelerates uniformly up to the middle, and brakes from there on."""
    acceleration = 4 / (duration if np.isfinite(duration) else DURATION_GUESS) ** 2
    return SpeedProfile(s, 2 * acceleration * np.minimum(s - s[0], s[-1] - s), np.zeros(len(s) - 1))


def _correct_time(profile: SpeedProfile, limit: float, time: float) -> float:
    """Return the limit of the optimizer's duration with which its motion takes the time `limit`.

    Its present limit is returned if the motion keeps it, and takes this time or is free to take less.
    """
    misses = float(profile.t[-1]) / limit - 1
    is_free = _uniform_times(profile).sum() < time * (1 - TIME_TOLERANCE)
    is_on_time = misses < TIME_TOLERANCE and (is_free or misses > -TIME_TOLERANCE)
    return time if is_on_time else time / (1 + misses)


def _uniform_times(profile: SpeedProfile) -> Array:
    """Return the times that uniform acceleration between its ends takes in each interval, s."""
    speed = np.sqrt(profile.b)
    return np.asarray(2 * np.diff(profile.s) / (speed[1:] + speed[:-1]))


def _misses_time(profile: SpeedProfile) -> BoolArray:
    """Return whether uniform acceleration takes another time than the motion, in each interval."""
    missed = np.abs(np.diff(profile.t) - _uniform_times(profile))
    return np.asarray(missed > INTERVAL_TIME_TOLERANCE * profile.t[-1])


def _switches(profile: SpeedProfile) -> BoolArray:
    """Return whether s_ddot jumps at an end of each interval. The jump is at some place in one of them."""
    u = np.diff(profile.b) / (2 * np.diff(profile.s))
    jumps = np.abs(np.diff(u)) > SWITCH_JUMP * np.ptp(u)
    return np.asarray(np.append(jumps, False) | np.append(False, jumps))


def _parts(counts: IntArray) -> Array:
    """Return 0, 1 / n, ..., (n - 1) / n for each n of counts, one after the other."""
    return np.concatenate([np.arange(n) / n for n in counts.tolist()])


def _exceeds_inside(
    dynamics: ReducedDynamics, motion: PathMotion, along: PathDynamics, limits: MotionLimits, inside: Array,
    which: BoolArray | None,
) -> BoolArray:  # fmt: skip
    """Return whether the motion exceeds limits inside each interval, (intervals,); False where it is not checked."""
    corners = motion.corners
    at = np.arange(len(corners) - 1) if which is None else np.flatnonzero(which)
    t = corners[at, None] + np.diff(corners)[at, None] * inside
    instants, missing = _instants(dynamics, motion, along, t.ravel(), limits)
    excess = limits.excess(measure(dynamics.mechanism, dynamics, limits, instants)).max(axis=1)
    exceeded = np.zeros(len(corners) - 1, dtype=bool)
    exceeded[at] = ((excess > 0) | (missing > FORCE_TOLERANCE)).reshape(t.shape).any(axis=1)
    return exceeded


def _instants(
    dynamics: ReducedDynamics, motion: PathMotion, along: PathDynamics, t: Array, limits: MotionLimits
) -> tuple[MotionInstants, Array]:
    """Return a motion with the motor torques of smallest norm within limits, and the force that they do not produce.

    The force (m,) is relative to the largest one.
    """
    _, v, a = motion(t)
    q_tree = follow_places(dynamics, motion.path, motion.profile(t)[0], along)
    at = dynamics.instants(q_tree, v, a, np.zeros((len(t), dynamics.motors)))
    friction = friction_force(dynamics.mechanism, at.v_tree)
    force = at.force - np.einsum("mnd,mn->md", dynamics.rho(q_tree), friction)
    transmission = dynamics.transmission(q_tree)
    tau = minimum_norm_within(transmission, force, limits.torque)
    missing = np.abs(np.einsum("mdk,mk->md", transmission, tau) - force).max(axis=1) / np.abs(force).max()
    return dynamics.with_torques(at, tau), missing


def _torque_table(
    dynamics: ReducedDynamics, motion: PathMotion, along: PathDynamics, limits: MotionLimits, tolerance: float,
    max_rows: int,
) -> tuple[Array, MotionInstants, Array]:  # fmt: skip
    """Return times, instants and motor torques of a table that is interpolated linearly.

    The table's torques have the same impulse between two rows as those of the motion: they differ from them by
    -h^2 / 12 of the second derivative, with h the distance of rows.
    """
    corners = motion.corners
    gap = np.minimum(JUMP_GAP * corners[-1], np.diff(corners) / 4)
    begin, end = corners[:-1] + gap / 2, corners[1:] - gap / 2
    begin[0], end[-1] = 0.0, corners[-1]
    three = np.stack([begin, (begin + end) / 2, end], axis=1)
    tau = _instants(dynamics, motion, along, three.ravel(), limits)[0].tau.reshape(*three.shape, -1)
    bend = tau[:, [0, 2]].mean(axis=1) - tau[:, 1]
    size = np.abs(bend).max(axis=1) / np.abs(tau).max()
    parts = np.clip(np.ceil(np.sqrt(size / tolerance)), 1, max_rows).astype(int)
    t = np.concatenate([np.linspace(a, b, n + 1) for a, b, n in zip(begin, end, parts, strict=True)])
    instants, _ = _instants(dynamics, motion, along, t, limits)
    correction = np.repeat(2 / 3 * bend / parts[:, None] ** 2, parts + 1, axis=0)
    return t, instants, instants.tau - correction


def _refuse_on_path(spec: OptimizeSpec, *, is_free: bool) -> None:
    minimize, limits = spec.minimize, spec.limits
    if spec.cross_singularities:
        raise InputError("optimize: cross_singularities: a motion along a path stays in its aspect; remove one of them")
    if minimize.tracking:
        raise InputError("optimize: minimize.tracking: not supported along a path; give `to` instead, or remove it")
    if limits.keep_out and not is_free:
        raise InputError("optimize: limits.keep_out: not supported along a path; remove it")


def _require_within(limits: MotionLimits, along: PathDynamics, dynamics: ReducedDynamics) -> None:
    """Refuse a path that leaves the limits of coordinates, or comes too close to a singularity."""
    mechanism, s = dynamics.mechanism, along.s
    numbers = np.array([mechanism.tree.to_coordinates(one) for one in along.q_tree])
    beyond = np.maximum(limits.q[0] - numbers, numbers - limits.q[1])
    k = int(np.argmax(beyond.max(axis=0)))
    if beyond.max() > 1e-9:
        m = int(np.argmax(beyond[:, k]))
        raise InputError(
            f"optimize: path: {mechanism.coordinates[k]} = {numbers[m, k]:.4g} at s = {s[m]:.4f} is outside its limits "
            f"[{limits.q[0, k]:.4g}, {limits.q[1, k]:.4g}]; change the path or limits.q"
        )
    margin = dynamics.margins(along.q_tree)
    if margin.min() < limits.singularity:
        m = int(np.argmin(margin))
        raise InputError(
            f"optimize: path: sigma_min(phi_z) is {margin[m]:.3g} of its value at the start at s = {s[m]:.4f}, below "
            f"limits.singularity = {limits.singularity:g}; change the path"
        )
