"""Plan a motion from one configuration to another: ends, initial guess, optimal control, and refinement of the mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, Immutable
from ckc_pin.base.sources import Sources
from ckc_pin.control.point_path import make_desired
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.point import Point
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.along_path import find_fastest, minimum_norm_within, path_dynamics
from ckc_pin.optimization.collocation import MIN_DURATION, TOLERANCE, Collocation
from ckc_pin.optimization.dry_friction import FrictionKnots
from ckc_pin.optimization.free_path import search_path
from ckc_pin.optimization.guess_motions import Joined, Slowed, SmoothMotion, UniformMotion, scale_durations
from ckc_pin.optimization.ipopt import Ipopt
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import DEGREE, Guess, Mesh, Solution, times
from ckc_pin.optimization.path import PathMotion
from ckc_pin.optimization.phase_dynamics import PhaseDynamics
from ckc_pin.optimization.plan import JUMP_GAP, CoordinateMotion, Cycle, Plan, find_active, measure, replay_plan
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.route import Route
from ckc_pin.optimization.spec import MinimizeSpec, OptimizeSpec, StateSpec

__all__ = [
    "EndState",
    "guess_motion",
    "interpolation",
    "plan_between",
    "read_desired_motion",
    "refuse_unsupported",
    "require_inside",
    "require_regular",
    "require_solved",
    "resolve_state",
    "sample_motion",
]

FIRST_INTERVALS = 40
MAX_MESHES = 16
MAX_DOUBLINGS = 3  # of all intervals, because the replay misses the end; others are where limits are exceeded
MAX_ITERATIONS = 400  # of IPOPT on one mesh
REPLAY_ERROR = 1e-6  # rad, rad/s, m, m/s: of the replay at the end
GUESS_PLACES = 100  # of the path of the initial guess
SAMPLES_PER_INTERVAL = 5
SLOWER = 1.05  # initial guess's duration, relative to the fastest one along its path
UNEVEN = 1.3  # duration of a turn of the initial guess, relative to that at the limit of a rate
RETRY_SLOWER = 2.0  # the duration of a second initial guess, relative to the first one
UNBOUNDED_FACTOR = (
    1.1  # durations below this multiple of the smallest one that the optimizer may choose have no lower bound
)
SIDE = 1e-9  # of the duration, from the end of a phase to where its torque is taken from a guess
EXCESS = 1e-3  # relative: intervals in which a limit is exceeded by more are divided


@dataclass(frozen=True, eq=False)
class EndState(Immutable):
    """A configuration with rates of the independent coordinates."""

    at: Kinematics
    q: Array
    rates: Array


def plan_between(
    dynamics: ReducedDynamics, spec: OptimizeSpec, limits: MotionLimits, sources: Sources, names: Sequence[str],
    states: Sequence[EndState], route: Route, progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from one configuration to another through places.

    Parameters
    ----------
    names : sequence of str
        Keys of the places.
    states : sequence of EndState
        Configurations of the places.
    route : Route
        What is given of the places.

    Raises
    ------
    InputError
        An end that is unknown, out of reach, or outside the limits.
    NumericalError
        No motion fulfils the limits, or the optimizer does not find one.
    """
    mechanism, start = dynamics.mechanism, states[0]
    for state, name in zip(states, names, strict=True):
        require_inside(mechanism, limits, state, name)
    for state, name in zip(states[1:], names[1:], strict=True):
        require_regular(dynamics, limits, start, state, name)
    desired = None if spec.desired is None else read_desired_motion(spec.desired, mechanism, sources, limits.time)
    limits = replace(limits, time=route.time)
    turns = route.places.turns is not None and bool(route.places.turns.any())
    motion = guess_route(route.members, spec.minimize, limits, states, route.places.t, turns=turns)
    ends = motion.corners
    mesh = base = Mesh.uniform(spec.intervals or FIRST_INTERVALS, np.diff(ends))
    torque: Callable[[Array], Array] | None = None
    iterations, doublings, friction = 0, 0, FrictionKnots(dynamics)
    for attempt in range(MAX_MESHES):
        guess = sample_motion(dynamics, limits, motion, mesh, start.at.q_tree, torque, ends, route.members)
        gauss_times = times(mesh.gauss_places(), ends)
        friction.begin_mesh(guess.q_tree, motion(gauss_times)[1])
        problem = Collocation(dynamics, limits, spec.minimize, guess, start.at.q_tree, route.places,
                              None if desired is None else desired(gauss_times), route.members)  # fmt: skip
        optimizer = Ipopt(problem, iterations=MAX_ITERATIONS, tolerance=TOLERANCE, warm=torque is not None)
        solution, _ = problem.solve(guess, optimizer)
        iterations += solution.iterations
        duration = _duration(spec.minimize, limits, RETRY_SLOWER * float(ends[-1]))
        if attempt == 0 and not solution.is_optimum and duration > ends[-1] and not route.has_times:
            motion = Slowed(motion, duration)  # The optimizer often succeeds from a slower motion.
            ends = ends * (duration / ends[-1])
            continue
        require_solved(solution)
        _require_durations(solution, guess, names)
        friction.end_mesh()
        plan, exceeded = _assemble(dynamics, limits, spec.minimize, solution, iterations, start, route)
        progress((attempt + 1) / MAX_MESHES)
        misses = plan.replay.error > REPLAY_ERROR
        halves = misses and not friction.is_present and doublings < MAX_DOUBLINGS
        moves = friction.is_smoothed or (friction.is_present and misses)
        if not halves and not moves and not exceeded.intervals.any():
            return plan
        doublings += halves
        if exceeded.intervals.any() or halves:
            base = mesh.divide(exceeded.intervals | halves)
        mesh = friction.insert(base, exceeded.samples, exceeded.rates)
        motion, ends = solution.motion(), solution.values.ends
        torque = interpolation(solution.values.torque_t, solution.values.torque)
    if not exceeded.intervals.any():
        return plan
    raise NumericalError(
        f"optimize: budget: after {MAX_MESHES} meshes, {exceeded.name} still exceeds its limit by {exceeded.size:.1%} "
        "between the points of the mesh; give more intervals, or a wider limit"
    )


def read_desired_motion(
    table: dict[str, Any], mechanism: Mechanism, sources: Sources, t_end: float
) -> Callable[[Array], Array]:
    """Return the function that gives desired independent coordinates (m, d) at times (m,) (InputError)."""
    try:
        desired = make_desired(table, mechanism, sources, t_end)
    except InputError as error:
        raise InputError(str(error).replace("controller.desired", "desired")) from None
    end = float(getattr(desired, "end", np.inf))
    return lambda t: np.array([desired(x)[0] for x in np.minimum(t, end).tolist()])


def interpolation(times: Array, values: Array) -> Callable[[Array], Array]:
    """Return the function of times (m,) that connects rows (k, columns) by straight lines."""
    return lambda t: np.array([np.interp(t, times, x) for x in values.T]).T.reshape(len(t), -1)


# --- ends ----------------------------------------------------------------------------------------


def refuse_unsupported(
    mechanism: Mechanism, minimize: MinimizeSpec, limits: MotionLimits, desired: dict[str, Any] | None
) -> None:
    """Refuse what a motion between configurations does not support, and a problem without a solution."""
    if not any(getattr(minimize, name) for name in minimize.__struct_fields__):
        raise InputError("optimize: minimize: every weight is zero; give one above zero, as time = 1.0")
    if bool(minimize.tracking) != (desired is not None):
        present, missing = ("desired", "minimize.tracking") if desired else ("minimize.tracking", "desired")
        raise InputError(f"optimize: {present} needs {missing}; give both or none")
    if minimize.tracking and (minimize.time or not np.isfinite(limits.time)):
        raise InputError(
            "optimize: minimize.tracking: the duration is limits.time; "
            + ("remove minimize.time" if minimize.time else "give it")
        )
    if not minimize.time and not np.isfinite(limits.time):
        raise InputError(
            "optimize: minimize: without a weight of time the duration has no bound; give limits.time, or minimize.time"
        )
    if not mechanism.motors.names:
        raise InputError(f"optimize: {mechanism.name} has no motors; add [[motor]] or actuated to the mechanism's file")
    if (
        minimize.time
        and not np.isfinite(
            np.concatenate(
                [limits.torque.ravel(), limits.rate, limits.acceleration, limits.jerk, limits.power, limits.speed]
            )
        ).any()
    ):
        raise InputError("optimize: limits: nothing limits the speed; give torque, rate or acceleration")


def resolve_state(mechanism: Mechanism, spec: StateSpec, branch: Kinematics, name: str) -> EndState:
    """Return the configuration that a table describes, on a branch (InputError)."""
    where = f"optimize: {name}"
    ways = [key for key in ("q", "point", "at") if getattr(spec, key) is not None]
    if len(ways) != 1:
        raise InputError(f"{where}: expected one of q, point and at, got {' and '.join(ways) or 'none'}")
    rates = mechanism.vector(spec.q_dot, mechanism.independent, f"{where}.q_dot", fill=0.0)
    if spec.at is not None:
        at = mechanism.assembled if spec.at == "assembled" else stable_equilibrium(mechanism)
        return EndState(at, mechanism.independent_part(at.q_tree), rates)
    if spec.point is not None:
        if len(spec.point) != 1:
            raise InputError(f"{where}.point: expected one point, got {', '.join(spec.point) or 'none'}")
        ((point, position),) = spec.point.items()
        try:
            inverse = Point(mechanism, point).inverse(position, branch)
        except InputError as error:
            raise InputError(f"{where}.point: unreachable: {error}") from None
        return EndState(inverse.at, inverse.q, rates)
    assert spec.q is not None
    q = mechanism.vector(spec.q, mechanism.independent, f"{where}.q")
    solution = sigma(mechanism, q, branch)
    if solution.verdict != "converged":
        raise InputError(f"{where}.q: unreachable: q is {solution.verdict}: {solution.reason}")
    return EndState(solution.at, q, rates)


def require_inside(mechanism: Mechanism, limits: MotionLimits, state: EndState, name: str) -> None:
    """Require that a configuration and its rates are within the limits (InputError)."""
    numbers = mechanism.tree.to_coordinates(state.at.q_tree)
    beyond = np.maximum(limits.q[0] - numbers, numbers - limits.q[1])
    k = int(np.argmax(beyond))
    if beyond[k] > 1e-9:
        raise InputError(
            f"optimize: {name}: {mechanism.coordinates[k]} = {numbers[k]:.4g} is outside its limits "
            f"[{limits.q[0, k]:.4g}, {limits.q[1, k]:.4g}]; change it or limits.q"
        )
    distances = mechanism.point_positions(state.at.q_tree)
    for point, centre, radius in limits.spheres:
        if (distance := float(np.linalg.norm(distances[point] - centre))) < radius * (1 - 1e-9):
            raise InputError(
                f"optimize: {name}: the point {point!r} is {distance:.4g} m from the centre of a sphere of "
                f"limits.keep_out with radius {radius:g} m; change it or the sphere"
            )
    fast = np.abs(state.rates) > limits.rate[mechanism.partition.q]
    if fast.any():
        k = int(np.argmax(fast))
        raise InputError(
            f"optimize: {name}.q_dot: {mechanism.independent[k]} = {state.rates[k]:.4g} is above limits.rate = "
            f"{limits.rate[mechanism.partition.q[k]]:g}"
        )


def require_regular(
    dynamics: ReducedDynamics, limits: MotionLimits, start: EndState, end: EndState, name: str = "to"
) -> None:
    """Require that an end is within the limit of singularity (InputError)."""
    margin = dynamics.margins(np.array([start.at.q_tree, end.at.q_tree]))[1]
    if margin < limits.singularity:
        raise InputError(
            f"optimize: {name}: sigma_min(phi_z) is {margin:.3g} of its value at the start, below limits.singularity = "
            f"{limits.singularity:g}; change one of them"
        )


# --- initial guess -------------------------------------------------------------------------------


def guess_motion(
    dynamics: ReducedDynamics, minimize: MinimizeSpec, limits: MotionLimits, start: EndState, end: EndState
) -> CoordinateMotion:
    """Return a motion between the ends: the fastest one along a path that the loops can follow, or a smooth one."""
    path = search_path(dynamics.mechanism, limits, start.at.q_tree, end.at.q_tree)
    at_rest = not start.rates.any() and not end.rates.any()
    moves = np.abs(end.q - start.q).max() > 0
    s = (1 - np.cos(np.pi * np.linspace(0.0, 1.0, GUESS_PLACES + 1))) / 2
    along = path_dynamics(dynamics, path, s)
    if at_rest and moves:
        try:
            profile, _ = find_fastest(dynamics, along, limits)
            return Slowed(PathMotion(path, profile), _duration(minimize, limits, SLOWER * float(profile.t[-1])))
        except (InputError, NumericalError):
            pass
    force = np.abs(along.inertia).max() * 6
    available = np.where(np.isfinite(limits.torque), np.abs(limits.torque), 0).max(initial=0.0)
    available = available or max(float(np.abs(along.static).max()), 1e-3 * force)
    duration = _duration(minimize, limits, max(float(np.sqrt(force / available)), 1e-2))
    return Slowed(SmoothMotion(path.q, start.rates, end.rates, duration), duration)


def guess_route(
    members: Sequence[ReducedDynamics], minimize: MinimizeSpec, limits: MotionLimits, states: Sequence[EndState],
    t: Array, *, turns: bool = False,
) -> CoordinateMotion:  # fmt: skip
    """Return a motion through places, whose corners are its ends and the times of the places.

    Parameters
    ----------
    members : sequence of ReducedDynamics
        Of the phases.
    t : (places,) array
        Times of the places. NaN: free.
    turns : bool
        The motion repeats after whole turns, so that it need not rest at its ends.
    """
    if len(states) == 2:
        motion = guess_motion(members[0], minimize, limits, *states)
        if not turns:
            return motion
        way = states[1].q - states[0].q
        fastest = float(np.max(np.abs(way) / limits.rate[members[0].q_at])) or float(motion.corners[-1])
        return UniformMotion(states[0].q, states[1].q, _duration(minimize, limits, UNEVEN * fastest))
    legs = [guess_motion(dynamics, MinimizeSpec(time=1.0), limits, *pair)
            for dynamics, pair in zip(members, pairwise(states), strict=True)]  # fmt: skip
    durations, t = np.array([leg.corners[-1] for leg in legs]), np.array(t)
    if np.isnan(t[-1]) and (not minimize.time or scale_durations(durations, t).sum() > limits.time):
        t[-1] = limits.time
    durations = scale_durations(durations, t)
    return Joined([Slowed(leg, duration) for leg, duration in zip(legs, durations.tolist(), strict=True)])


def _duration(minimize: MinimizeSpec, limits: MotionLimits, fastest: float) -> float:
    if not minimize.time:
        return limits.time
    return min(fastest, limits.time)


def sample_motion(
    dynamics: ReducedDynamics, limits: MotionLimits, motion: CoordinateMotion, mesh: Mesh, start: Array,
    torque: Callable[[Array], Array] | None, ends: Array | None = None, members: Sequence[ReducedDynamics] = (),
) -> Guess:  # fmt: skip
    """Return a motion on a mesh as an initial guess, with its torques or those of inverse dynamics.

    The loops are followed from the closed configuration `start` (nq,). `ends` are those of the phases, s, and
    `members` their dynamics.
    """
    ends = motion.corners[[0, -1]] if ends is None else ends
    t = np.sort(times(np.concatenate([mesh.knots, mesh.gauss_places()]), ends))
    is_knot = np.isin(np.arange(len(t)), np.arange(0, len(t), DEGREE + 1))
    q, v, a = motion(t)
    q_tree = dynamics.follow(start, q)
    if q_tree is None:
        raise NumericalError("optimize: stuck: the loops do not close along the initial guess")
    # Where a phase ends, torques are those just before and just after it.
    before_or_after = np.where(np.diff(mesh.knot, append=-1) == 0, -1, np.diff(mesh.knot, prepend=-1) == 0)
    torque_t = t[is_knot][mesh.knot] + SIDE * ends[-1] * before_or_after
    if torque is None:
        knots = q_tree[is_knot][mesh.knot]
        _, rates, accelerations = motion(torque_t)
        of_phases = PhaseDynamics(members or [dynamics] * mesh.phases, mesh.phase_of_knots)
        at = of_phases.instants(knots, rates, accelerations, np.zeros((len(knots), dynamics.motors)))
        transmission = np.einsum("mnd,kn->mdk", dynamics.rho(knots), dynamics.mechanism.motors.transmission)
        tau = np.clip(minimum_norm_within(transmission, at.force, limits.torque), *limits.torque)
    else:
        tau = torque(torque_t)
    accelerations = a[~is_knot].reshape(len(mesh.knots) - 1, DEGREE, -1)
    return Guess(mesh, np.diff(ends), q[is_knot], v[is_knot], accelerations, tau, q_tree[~is_knot])


# --- result --------------------------------------------------------------------------------------


def require_solved(solution: Solution) -> None:
    """Raise NumericalError with the reason if the optimizer has found no optimum."""
    if solution.is_optimum:
        return
    label, size = solution.violation
    if solution.status == "Infeasible_Problem_Detected":
        raise NumericalError(
            f"optimize: infeasible: no motion near the initial guess fulfils all limits; the largest violation, of "
            f"{label}, is {size:.3g}; raise torque, time or the other limits"
        )
    if solution.status == "Maximum_Iterations_Exceeded":
        raise NumericalError(
            f"optimize: budget: no optimum after {solution.iterations} iterations; the largest violation, of {label}, "
            f"is {size:.3g}"
        )
    raise NumericalError(
        f"optimize: stuck: IPOPT reports {solution.status} after {solution.iterations} iterations; the largest "
        f"violation, of {label}, is {size:.3g}; give other intervals or another start"
    )


def _require_durations(solution: Solution, guess: Guess, names: Sequence[str]) -> None:
    """Raise NumericalError if a phase has no shortest duration."""
    short = solution.values.durations < UNBOUNDED_FACTOR * MIN_DURATION * guess.durations
    if short.any():
        k = int(np.argmax(short))
        raise NumericalError(
            f"optimize: unbounded: the motion from {names[k]} to {names[k + 1]} becomes arbitrarily short; give "
            "limits.rate, a weight of effort or another place"
        )


@dataclass(frozen=True, eq=False)
class Exceeded(Immutable):
    """Intervals in which limits are exceeded by more than `EXCESS`, and the worst quantity with its relative excess.

    `samples` (m,) are places in units of the mesh, with v' `rates` (m, n).
    """

    intervals: BoolArray
    name: str
    size: float
    samples: Array
    rates: Array


def _assemble(
    dynamics: ReducedDynamics, limits: MotionLimits, minimize: MinimizeSpec, solution: Solution, iterations: int,
    start: EndState, route: Route,
) -> tuple[Plan, Exceeded]:  # fmt: skip
    mechanism, values = dynamics.mechanism, solution.values
    moving, ends = solution.motion(), values.ends
    knots, torque = values.mesh.knots, np.clip(values.torque, *limits.torque)
    parts = np.arange(SAMPLES_PER_INTERVAL) / SAMPLES_PER_INTERVAL
    samples = np.append((knots[:-1, None] + values.mesh.steps[:, None] * parts).ravel(), knots[-1])
    # Quantities jump where a phase ends. They are sampled just before it, too.
    t = np.sort(np.concatenate([times(samples, ends), ends[1:-1] - JUMP_GAP * ends[-1]]))
    is_sample = ~np.isin(t, ends[1:-1] - JUMP_GAP * ends[-1])
    q, v, a = moving(t)
    q_tree = dynamics.follow(start.at.q_tree, q)
    if q_tree is None:
        raise NumericalError(
            "optimize: stuck: the loops do not close between the points of the mesh; give more intervals"
        )
    tau = interpolation(values.torque_t, torque)(t)
    phase = route.phase_of(t, ends)
    t = t + route.offsets[phase]
    for k in np.flatnonzero(route.rests)[::-1].tolist():
        row, gap = int(np.searchsorted(phase, k, side="right")), JUMP_GAP * ends[-1]
        is_end = row == len(phase)
        begin = ends[k + 1] + route.offsets[k]
        rest = [begin + gap * is_end, begin + route.rests[k] - gap * (not is_end)]
        t, is_sample = np.insert(t, row, rest), np.insert(is_sample, row, [False, False])
        phase = np.insert(phase, row, [k, k])
        still = q_tree[row - is_end], np.zeros(dynamics.d), np.zeros(dynamics.d), route.rest_torque[k]
        q_tree, v, a, tau = (
            np.insert(x, [row, row], rest_row, axis=0) for x, rest_row in zip((q_tree, v, a, tau), still, strict=True)
        )
    at = PhaseDynamics(route.members, phase).instants(q_tree, v, a, tau)
    quantities, margin = measure(dynamics, limits, at)
    motion = route.motion(solution)
    torque_t, torque = route.torques(values, torque)
    cycle = None if route.places.turns is None else Cycle(route.places.turns)
    sections = route.sections(ends)
    replay = replay_plan(dynamics, motion, torque_t, torque, q_tree, cycle, sections)
    warnings = []
    if replay.error > REPLAY_ERROR:
        remedy = "give more intervals"
        if mechanism.joints.friction.any():
            remedy = "joints with dry friction may stick, which the plan does not foresee; track the motion"
        warnings.append(f"the replay misses the end by {replay.error:.1e}; {remedy}")
    at_rest = {"time": float(route.rests.sum()), "effort": float(route.rests @ (route.rest_torque**2).sum(axis=1))}
    solved = {name: x + at_rest.get(name, 0.0) for name, x in solution.parts.items()}
    plan = Plan(
        mechanism=mechanism, status="solved", message="a local optimum", t_end=float(motion.corners[-1]),
        cost=sum(getattr(minimize, name) * x for name, x in solved.items()), parts=solved, iterations=iterations,
        motion=motion, torque_t=torque_t, torque=torque, t=t, quantities=quantities, margin=margin, limits=limits,
        active=tuple(find_active(limits, t, quantities, margin)), replay=replay, warnings=tuple(warnings),
        via_t=tuple((ends[1:-1] + route.offsets[1:] - route.rests[:-1]).tolist()), cycle=cycle, sections=sections,
    )  # fmt: skip
    return plan, _find_excess(limits, quantities[is_sample], margin[is_sample], samples, at.v_tree[is_sample])


def _find_excess(limits: MotionLimits, quantities: Array, margin: Array, samples: Array, rates: Array) -> Exceeded:
    """Find the intervals in which limits are exceeded, from samples of them and of the end."""
    size = np.maximum(np.abs(quantities).max(axis=0), 1e-12)
    if limits.spheres:
        size[-len(limits.spheres) :] = [radius for _, _, radius in limits.spheres]
    relative = limits.excess(quantities) / size
    close = 1 - margin[:, None] / limits.singularity if limits.singularity else np.zeros((len(margin), 0))
    relative = np.hstack([relative, close])
    at = relative > EXCESS
    inside: BoolArray = np.asarray(at[:-1].reshape(-1, SAMPLES_PER_INTERVAL * at.shape[1]).any(axis=1))
    inside[-1] |= at[-1].any()
    worst = np.unravel_index(int(np.argmax(relative)), relative.shape)
    name = (*limits.names, "sigma_min")[int(worst[1])]
    return Exceeded(inside, name, float(relative[worst]), samples, rates)
