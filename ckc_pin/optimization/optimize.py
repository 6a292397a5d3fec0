"""Plan a motion: the entry points of `optimize`, from a file or from Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.validation import describe_value, require_callable, require_table
from ckc_pin.dynamics.inverse import friction_force
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import as_mechanism, load_beside
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.along_path import (
    PathDynamics,
    find_fastest,
    follow_places,
    minimum_norm_within,
    path_dynamics,
)
from ckc_pin.optimization.end_states import (
    refuse_unsupported,
    refuse_with_crossings,
    require_inside,
    require_regular,
    resolve_state,
)
from ckc_pin.optimization.free_path import search_path
from ckc_pin.optimization.limits import MotionLimits, make_limits
from ckc_pin.optimization.path import CoordinatePath, PathMotion, make_path
from ckc_pin.optimization.places import resolve_places
from ckc_pin.optimization.plan import JUMP_GAP, Plan, find_active, measure, replay_plan
from ckc_pin.optimization.point_to_point import plan_between
from ckc_pin.optimization.reduced import MotionInstants, ReducedDynamics
from ckc_pin.optimization.route import Route
from ckc_pin.optimization.spec import (
    OptimizeSpec,
    PathSpec,
    StateSpec,
    make_spec,
    read_optimize,
)
from ckc_pin.optimization.speed_profile import SpeedProfile
from ckc_pin.scene.arguments import embed_file

__all__ = ["optimize", "optimize_file", "read_arguments"]

PATH_INTERVALS = 200
MAX_REFINEMENTS = 40  # of the grid
CHECKS_PER_INTERVAL = 7  # instants at which limits are checked between two points of the grid
SWITCH_REFINEMENTS = 3  # of the grid where s_ddot jumps
SWITCH_JUMP = 0.1  # of the range of s_ddot
DIVISION = 4  # parts of an interval inside which a limit is exceeded
MIN_SPACING = 1e-7  # of the points of the first grid
LIMIT_TOLERANCE = 2e-5  # relative: limits are narrowed by it on the grid, and by half of it between its points
FORCE_TOLERANCE = 1e-8  # relative to the largest force: what torques within limits may fail to produce
TORQUE_TOLERANCE = 1e-6  # relative to the largest torque: error of linear interpolation between rows
MAX_ROWS = 32  # of the torques' table in an interval


def optimize(
    mechanism: Mechanism | str | Path,
    *,
    start: Mapping[str, Any] | None = None,
    to: Mapping[str, Any] | None = None,
    via: Sequence[Mapping[str, Any]] | None = None,
    periodic: Mapping[str, Any] | None = None,
    path: Mapping[str, Any] | None = None,
    minimize: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    cross_singularities: bool = False,
    desired: Mapping[str, Any] | None = None,
    intervals: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Plan:
    """Plan a motion of a mechanism, from one configuration to another or along a path, within limits.

    Parameters
    ----------
    mechanism : Mechanism, str or Path
    start, to : mapping, optional
        The keys of ``[from]`` and ``[to]``: ``{"q": {"theta_1": -1.2, "theta_3": -1.9}}``,
        ``{"point": {"tip": [0.1, -0.4, 0.0]}}`` or ``{"at": "equilibrium"}``. The start is as assembled by default.
    via : sequence of mappings, optional
        The keys of each ``[[via]]``, places that the motion passes: ``[{"q": {"theta_1": -1.2}, "dwell": 0.1}]``.
    periodic : mapping, optional
        The keys of ``[periodic]``, of a motion that repeats: ``{"turns": {"crank": 1}}``. Then there is no `to`, and
        coordinates and rates that `start` does not name are free.
    path : mapping, optional
        The keys of ``[path]``, of the fastest motion along one:
        ``{"q": {"theta_1": [-1.2, -1.0], "theta_3": [-1.9, -1.7]}}``, or
        ``{"point": {"tip": [[0.1, -0.4, 0.0], [0.2, -0.4, 0.0]]}}``. With ``{"shape": "free"}``, a path from `start` to
        `to` is searched that keeps the limits and does not reach a singular configuration.
    minimize, limits : mapping, optional
        The keys of ``[minimize]`` and ``[limits]``: ``{"time": 1.0}``, ``{"torque": 3.0, "rate": 5.0}``.
    cross_singularities : bool
        Singular configurations may be crossed, as the key of the file.
    desired : mapping, optional
        The motion that ``minimize["tracking"]`` refers to: ``{"file": {"t": t, "theta_1": x, "theta_3": y}}``, or the
        other keys of a tracking controller's ``desired``.
    intervals : int, optional
        Intervals of the grid.
    progress : callable, optional
        Called as progress(fraction).

    Raises
    ------
    InputError, MechanismError
        Unknown names, or a path out of reach.
    NumericalError
        No motion fulfils the limits.
    """
    mechanism = as_mechanism(mechanism, "optimize")
    require_callable(progress, "optimize: progress", "a function of the fraction", 1)
    tables = {"from": start, "to": to, "periodic": periodic, "path": path, "minimize": minimize, "limits": limits,
              "desired": desired}  # fmt: skip
    spec, sources = read_arguments(
        mechanism, tables, intervals, "optimize", via, cross_singularities=cross_singularities
    )
    return _optimize(mechanism, spec, sources, progress or (lambda fraction: None))


def read_arguments(
    mechanism: Mechanism,
    tables: Mapping[str, Any],
    intervals: int | None,
    where: str,
    via: Any = None,
    **keys: Any,
) -> tuple[OptimizeSpec, Sources]:
    """Return the task that the tables and other keys of a file, from Python, describe; tables of None are absent.

    Raises
    ------
    InputError
        Unknown keys or wrong values.
    """
    data: dict[str, Any] = {"mechanism": mechanism.name, **keys}
    for name, table in tables.items():
        if table is not None:
            require_table(table, f"{where}: {name}", f"a table with the keys of [{name}]")
            data[name] = _to_data(table)
    if via is not None:
        if isinstance(via, str) or not isinstance(via, Sequence):
            raise InputError(f"{where}: via: expected a list of tables, got {describe_value(via)}")
        for k, table in enumerate(via):
            require_table(table, f"{where}: via[{k}]", "a table with the keys of [[via]]")
        data["via"] = _to_data(via)
    if intervals is not None:
        data["intervals"] = intervals
    texts: dict[str, str] = {}
    embed_file(data.get("desired"), "desired.csv", texts, f"{where}: desired.file", reads_paths=True)
    return make_spec(data, where), Sources(where, None, texts)


def optimize_file(path: str | Path, progress: Callable[[float], None] | None = None) -> Plan:
    """Plan the motion that a file describes; errors as of `optimize`."""
    spec, sources = read_optimize(path)
    mechanism = load_beside(spec.mechanism, Path(path).parent, spec.parameters)
    return _optimize(mechanism, spec, sources, progress or (lambda fraction: None))


def _to_data(value: Any) -> Any:
    """Return tables and arrays as dictionaries and lists."""
    if isinstance(value, Mapping):
        return {key: _to_data(x) for key, x in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_to_data(x) for x in value] if isinstance(value, list | tuple) else value


def _optimize(mechanism: Mechanism, spec: OptimizeSpec, sources: Sources, progress: Callable[[float], None]) -> Plan:
    mechanism.refuse_prescribed_joints("optimize")
    if not mechanism.d:
        raise InputError(f"optimize: {mechanism.name} has no freedoms, so that nothing moves")
    is_free = spec.path is not None and spec.path.shape == "free"
    if spec.periodic is not None and (spec.to is not None or spec.path is not None):
        other = "to" if spec.to is not None else "path"
        raise InputError(f"optimize: {other}: a periodic motion ends where it begins; remove {other} or periodic")
    if spec.periodic is None and (spec.path is None or is_free) == (spec.to is None):
        got = "neither" if spec.to is None else "both"
        raise InputError(f'optimize: expected either `to` or `path`, got {got}; path.shape = "free" needs both')
    if spec.via and spec.path is not None:
        raise InputError("optimize: via: a motion along a path passes the places of the path; remove via or path")
    limits = make_limits(spec.limits, mechanism)
    with one_blas_thread():
        if spec.path is None:
            return _between_places(mechanism, spec, limits, sources, progress)
        return _along_path(mechanism, spec, spec.path, limits)


def _between_places(
    mechanism: Mechanism, spec: OptimizeSpec, limits: MotionLimits, sources: Sources,
    progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from one configuration to another, or a periodic one."""
    period = None if spec.periodic is None else spec.periodic.time
    if period is not None:
        if period > limits.time:
            raise InputError(f"optimize: periodic.time: {period:g} s is above limits.time = {limits.time:g} s")
        limits = replace(limits, time=period)
        if spec.minimize.time:
            raise InputError("optimize: periodic.time: the period is given, which minimize.time does not change; give "
                             "another weight, as effort = 1.0")  # fmt: skip
    refuse_unsupported(mechanism, spec.minimize, limits, spec.desired)
    if spec.cross_singularities:
        refuse_with_crossings(spec)
    dynamics = ReducedDynamics(mechanism)
    resolved = resolve_places(dynamics, spec, limits.time)
    route = Route.of(resolved.members, limits, resolved.places, resolved.stays, [x.at.q_tree for x in resolved.states])
    plan = plan_between(dynamics, spec, limits, sources, resolved.names, resolved.states, route, progress)
    return replace(plan, via_t=(0.0, *plan.via_t)) if resolved.names[0] == "via[0]" else plan


def _along_path(mechanism: Mechanism, spec: OptimizeSpec, table: PathSpec, limits: MotionLimits) -> Plan:
    """Plan the fastest motion along a path."""
    _refuse_on_path(spec, is_free=table.shape == "free")
    dynamics = ReducedDynamics(mechanism)
    path = make_path(table, mechanism) if table.shape != "free" else _find_free_path(dynamics, spec, table, limits)
    motion, sweeps = _refine_profile(dynamics, path, limits, spec.intervals)
    t_end = float(motion.corners[-1])
    if t_end > limits.time:
        raise InputError(
            f"optimize: infeasible: limits.time = {limits.time:g} s: the fastest motion takes {t_end:.6g} s"
        )
    t, at, torque = _torque_table(dynamics, motion, limits.narrowed(LIMIT_TOLERANCE / 2))
    quantities, margin = measure(mechanism, dynamics, limits, at)
    replay = replay_plan(mechanism, dynamics, motion, at, t, torque)
    return Plan(
        mechanism=mechanism, status="solved", message="the fastest motion along the path", t_end=t_end,
        cost=t_end * spec.minimize.time, parts={"time": t_end}, iterations=sweeps,
        coordinates=mechanism.independent, motion=motion, torque_t=t, torque=torque, t=t,
        quantities=quantities, margin=margin, limits=limits,
        active=tuple(find_active(limits, t, quantities, margin)), replay=replay, warnings=path.warnings,
    )  # fmt: skip


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
    dynamics: ReducedDynamics, path: CoordinatePath, limits: MotionLimits, intervals: int | None
) -> tuple[PathMotion, int]:
    """Return the fastest motion along a path. Intervals inside which a limit is exceeded are divided."""
    s = (1 - np.cos(np.pi * np.linspace(0.0, 1.0, (intervals or PATH_INTERVALS) + 1))) / 2
    s = np.union1d(s, np.clip(path.q.breaks, 0.0, 1.0))
    s = s[np.concatenate([[True], np.diff(s) > MIN_SPACING])]
    narrowed, between, total = limits.narrowed(LIMIT_TOLERANCE), limits.narrowed(LIMIT_TOLERANCE / 2), 0
    inside = np.linspace(0.0, 1.0, CHECKS_PER_INTERVAL + 2)[1:-1]
    suspect: BoolArray | None = None  # intervals to check; all of them before the end
    for round_ in range(MAX_REFINEMENTS):
        along = path_dynamics(dynamics, path, s)
        _require_within(limits, along, dynamics)
        profile, sweeps = find_fastest(dynamics, along, narrowed)
        motion, total = PathMotion(path, profile), total + sweeps
        exceeded = _exceeds_inside(dynamics, motion, between, inside, suspect)
        if round_ < SWITCH_REFINEMENTS:
            exceeded |= _switches(profile)
        if not exceeded.any() and suspect is not None:
            exceeded = _exceeds_inside(dynamics, motion, between, inside, None)
        if not exceeded.any():
            break
        exceeded[1:] |= exceeded[:-1].copy()
        exceeded[:-1] |= exceeded[1:].copy()
        counts = np.where(exceeded, DIVISION, 1)
        suspect = np.repeat(exceeded, counts)
        s = np.append(np.repeat(s[:-1], counts) + np.repeat(np.diff(s), counts) * _parts(counts), s[-1])
    return motion, total


def _switches(profile: SpeedProfile) -> BoolArray:
    """Return whether s_ddot jumps at an end of each interval. The jump is at some place in one of them."""
    u = np.diff(profile.b) / (2 * np.diff(profile.s))
    jumps = np.abs(np.diff(u)) > SWITCH_JUMP * np.ptp(u)
    return np.asarray(np.append(jumps, False) | np.append(False, jumps))


def _parts(counts: IntArray) -> Array:
    """Return 0, 1 / n, ..., (n - 1) / n for each n of counts, one after the other."""
    return np.concatenate([np.arange(n) / n for n in counts.tolist()])


def _exceeds_inside(
    dynamics: ReducedDynamics, motion: PathMotion, limits: MotionLimits, inside: Array, which: BoolArray | None
) -> BoolArray:
    """Return whether the motion exceeds limits inside each interval, (intervals,); False where it is not checked."""
    corners = motion.corners
    at = np.arange(len(corners) - 1) if which is None else np.flatnonzero(which)
    t = corners[at, None] + np.diff(corners)[at, None] * inside
    instants, missing = _instants(dynamics, motion, t.ravel(), limits)
    excess = limits.excess(measure(dynamics.mechanism, dynamics, limits, instants)[0]).max(axis=1)
    exceeded = np.zeros(len(corners) - 1, dtype=bool)
    exceeded[at] = ((excess > 0) | (missing > FORCE_TOLERANCE)).reshape(t.shape).any(axis=1)
    return exceeded


def _instants(
    dynamics: ReducedDynamics, motion: PathMotion, t: Array, limits: MotionLimits
) -> tuple[MotionInstants, Array]:
    """Return a motion with the motor torques of smallest norm within limits, and the force that they do not produce.

    The force (m,) is relative to the largest one.
    """
    mechanism = dynamics.mechanism
    _, v, a = motion(t)
    # The loops are followed through all corners, because the path may bend between the instants.
    places = np.union1d(t, motion.corners)
    q_tree = follow_places(dynamics, motion(places)[0], places, motion.path.start)[np.searchsorted(places, t)]
    at = dynamics.instants(q_tree, v, a, np.zeros((len(t), dynamics.motors)))
    rho = dynamics.rho(q_tree)
    friction = friction_force(mechanism, at.v_tree)
    force = at.force - np.einsum("mnd,mn->md", rho, friction)
    transmission = np.einsum("mnd,kn->mdk", rho, mechanism.motors.transmission)
    tau = minimum_norm_within(transmission, force, limits.torque)
    tau = np.clip(tau, *limits.torque)
    missing = np.abs(np.einsum("mdk,mk->md", transmission, tau) - force).max(axis=1) / np.abs(force).max()
    return dynamics.instants(q_tree, v, a, tau), missing


def _torque_table(
    dynamics: ReducedDynamics, motion: PathMotion, limits: MotionLimits
) -> tuple[Array, MotionInstants, Array]:
    """Return times, instants and motor torques of a table that is interpolated linearly.

    The table's torques have the same impulse between two rows as those of the motion: they differ from them by
    -h^2 / 12 of the second derivative, with h the distance of rows.
    """
    corners = motion.corners
    gap = np.minimum(JUMP_GAP * corners[-1], np.diff(corners) / 4)
    begin, end = corners[:-1] + gap / 2, corners[1:] - gap / 2
    begin[0], end[-1] = 0.0, corners[-1]
    three = np.stack([begin, (begin + end) / 2, end], axis=1)
    tau = _instants(dynamics, motion, three.ravel(), limits)[0].tau.reshape(*three.shape, -1)
    bend = tau[:, [0, 2]].mean(axis=1) - tau[:, 1]
    size = np.abs(bend).max(axis=1) / np.abs(tau).max()
    parts = np.clip(np.ceil(np.sqrt(size / TORQUE_TOLERANCE)), 1, MAX_ROWS).astype(int)
    t = np.concatenate([np.linspace(a, b, n + 1) for a, b, n in zip(begin, end, parts, strict=True)])
    instants, _ = _instants(dynamics, motion, t, limits)
    correction = np.repeat(2 / 3 * bend / parts[:, None] ** 2, parts + 1, axis=0)
    return t, instants, instants.tau - correction


def _refuse_on_path(spec: OptimizeSpec, *, is_free: bool) -> None:
    minimize, limits = spec.minimize, spec.limits
    if spec.cross_singularities:
        raise InputError("optimize: cross_singularities: a motion along a path stays in its aspect; remove one of them")
    other = [name for name in ("effort", "energy", "jerk", "peak_torque", "tracking") if getattr(minimize, name)]
    if other:
        raise InputError(
            f"optimize: minimize.{other[0]}: a motion along a path is time-optimal; remove it, or give `to` instead"
        )
    if not minimize.time:
        raise InputError("optimize: minimize.time: expected a weight above zero")
    for name in ("torque_rate", "power", "jerk") if is_free else ("torque_rate", "keep_out", "power", "jerk"):
        if getattr(limits, name):
            raise InputError(f"optimize: limits.{name}: not supported along a path; remove it")


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
