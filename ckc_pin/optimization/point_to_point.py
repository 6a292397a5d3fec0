"""Plan a motion from one configuration to another: ends, initial guess, optimal control, and refinement of the mesh."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, Immutable
from ckc_pin.base.sources import Sources
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.control.point_path import make_desired
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.point import Point
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.along_path import PathDynamics, find_fastest, minimum_norm_within, path_dynamics
from ckc_pin.optimization.collocation import TOLERANCE, Collocation
from ckc_pin.optimization.crossing import find_crossings, find_routes
from ckc_pin.optimization.dry_friction import FrictionKnots
from ckc_pin.optimization.free_path import FreeSpace, find_path, is_separated, search_path
from ckc_pin.optimization.ipopt import Ipopt
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import DEGREE, Ends, Guess, Solution, gauss_points
from ckc_pin.optimization.path import CoordinatePath, PathMotion
from ckc_pin.optimization.plan import CoordinateMotion, Plan, find_active, measure, replay_plan
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.spec import MinimizeSpec, OptimizeSpec, StateSpec
from ckc_pin.scene.initial import find_branch

__all__ = [
    "EndState",
    "gauss_places",
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
FEW_ITERATIONS = 100  # of it, where other initial guesses may be better
EFFORT_GUESS_ITERATIONS = 200
REPLAY_ERROR = 1e-6  # rad, rad/s, m, m/s: of the replay at the end
GUESS_PLACES = 100  # of the path of the initial guess
SAMPLES_PER_INTERVAL = 5
MAX_UNWOUND_RESIDUAL = 1e-9  # m, rad: change of phi by whole turns of dependent joints
SLOWER = 1.05  # initial guess's duration, relative to the fastest one along its path
RETRY_SLOWER = 2.0  # the duration of a second initial guess, relative to the first one
EFFORT_GUESS_INTERVALS = 20, 40, 80  # of meshes of initial guesses of minimum effort
EFFORT_GUESS_TOLERANCE = 1e-6
EFFORT_GUESS_DURATIONS = (1.0, 0.85, 0.6, 1.4, 2.0)  # of initial guesses of minimum effort, relative to a typical one
WIDER = 10.0  # limits of torques of these guesses, relative to the plan's
EXCESS = 1e-3  # relative: intervals in which a limit is exceeded by more are divided


Torques = Callable[[Array], Array]  # motor torques (m, motors) at times (m,)


@dataclass(frozen=True, eq=False)
class EndState(Immutable):
    """A configuration with rates of the independent coordinates."""

    at: Kinematics
    q: Array
    rates: Array


def plan_between(
    mechanism: Mechanism, spec: OptimizeSpec, limits: MotionLimits, sources: Sources,
    progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from one configuration to another.

    Raises
    ------
    InputError
        An end that is unknown, out of reach, or outside the limits.
    NumericalError
        No motion fulfils the limits, or the optimizer does not find one.
    """
    assert spec.to is not None
    refuse_unsupported(mechanism, spec.minimize, limits, spec.desired)
    if spec.cross_singularities:
        _refuse_with_crossings(spec)
    start = resolve_state(mechanism, spec.start, mechanism.assembled, "from")
    end = resolve_state(mechanism, spec.to, start.at, "to")
    for state, name in ((start, "from"), (end, "to")):
        require_inside(mechanism, limits, state, name)
    require_regular(mechanism, limits, start, end)
    desired = None if spec.desired is None else read_desired_motion(spec.desired, mechanism, sources, limits.time)
    error: NumericalError | None = None
    for dynamics, motion, torque in _find_guesses(mechanism, spec, limits, (start, end)):
        try:
            return _plan_from(mechanism, dynamics, motion, torque, spec, limits, (start, end), desired, progress)
        except NumericalError as failure:
            error = error or failure
    raise error or NumericalError(
        "optimize: stuck: no path from `from` to `to` was found, also not through singular configurations"
    )


def _find_guesses(
    mechanism: Mechanism, spec: OptimizeSpec, limits: MotionLimits, states: tuple[EndState, EndState]
) -> Iterator[tuple[ReducedDynamics, CoordinateMotion, Torques | None]]:
    """Find initial guesses with their torques, or None, and the dynamics in whose coordinates they are.

    One guess along each of the paths comes first, then the next ones.
    """
    ends = states[0].at.q_tree, states[1].at.q_tree
    if not spec.cross_singularities:
        routes = [(mechanism, search_path(mechanism, limits, *ends))]
    else:
        path = None if is_separated(mechanism, limits, *ends) else find_path(mechanism, limits, *ends)
        routes = find_routes(mechanism, limits, *ends) if path is None else [(mechanism, path)]
    along = [(ReducedDynamics(planned), path) for planned, path in routes]
    each = [_first_guesses(dynamics, path, spec.minimize, limits, states, crosses=spec.cross_singularities)
            for dynamics, path in along]  # fmt: skip
    for row in zip_longest(*each):
        yield from ((along[k][0], *guess) for k, guess in enumerate(row) if guess is not None)


def _plan_from(
    mechanism: Mechanism, dynamics: ReducedDynamics, motion: CoordinateMotion, torque: Torques | None,
    spec: OptimizeSpec, limits: MotionLimits, states: tuple[EndState, EndState],
    desired: Callable[[Array], Array] | None, progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from an initial guess."""
    start, end = (_in_coordinates(dynamics.mechanism, state) for state in states)
    first_iterations = FEW_ITERATIONS if spec.cross_singularities and torque is None else MAX_ITERATIONS
    ends = Ends(np.array([start.q, end.q]), np.array([start.rates, end.rates]))
    mesh = base = np.linspace(0.0, 1.0, (spec.intervals or FIRST_INTERVALS) + 1)
    iterations, doublings, friction = 0, 0, FrictionKnots(dynamics)
    for attempt in range(MAX_MESHES):
        guess = sample_motion(dynamics, limits, motion, mesh, start.at.q_tree, torque)
        friction.begin_mesh(guess.q_tree, motion(guess.duration * gauss_places(mesh))[1])
        problem = Collocation(dynamics, limits, spec.minimize, guess, start.at.q_tree,
                              fixed_duration=desired is not None)  # fmt: skip
        problem.set_ends(ends, None if desired is None else desired(limits.time * gauss_places(mesh)))
        optimizer = Ipopt(problem, iterations=MAX_ITERATIONS if attempt else first_iterations, tolerance=TOLERANCE,
                          warm=attempt > 0)  # fmt: skip
        solution, _ = problem.solve(guess, optimizer)
        iterations += solution.iterations
        require_solved(solution)
        friction.end_mesh()
        plan, exceeded = _assemble(mechanism, dynamics, limits, solution, iterations, start)
        progress((attempt + 1) / MAX_MESHES)
        misses = plan.replay.error > REPLAY_ERROR
        halves = misses and not friction.is_present and doublings < MAX_DOUBLINGS
        moves = friction.is_smoothed or (friction.is_present and misses)
        if not halves and not moves and not exceeded.intervals.any():
            return plan
        doublings += halves
        if exceeded.intervals.any() or halves:
            base = _divide(mesh, exceeded.intervals | halves)
        mesh = friction.insert(base, plan)
        motion, torque = plan.motion, interpolation(plan.torque_t, plan.torque)
    if not exceeded.intervals.any():
        return plan
    raise NumericalError(
        f"optimize: budget: after {MAX_MESHES} meshes, {exceeded.name} still exceeds its limit by {exceeded.size:.1%} "
        "between the points of the mesh; give more intervals, or a wider limit"
    )


def gauss_places(mesh: Array) -> Array:
    """Return the Gauss points of a mesh from 0 to 1."""
    return np.asarray((mesh[:-1, None] + np.diff(mesh)[:, None] * gauss_points()[0]).ravel())


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


def _divide(mesh: Array, intervals: BoolArray) -> Array:
    """Return a mesh with intervals and their neighbours halved."""
    halved = intervals.copy()
    halved[1:] |= intervals[:-1]
    halved[:-1] |= intervals[1:]
    return np.sort(np.concatenate([mesh, ((mesh[1:] + mesh[:-1]) / 2)[halved]]))


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
    independent = {key: value for key, value in spec.q.items() if key not in mechanism.dependent}
    q = mechanism.vector(independent, mechanism.independent, f"{where}.q")
    if len(independent) < len(spec.q):
        try:
            branch = find_branch(mechanism, spec.q)
        except InputError as error:
            raise InputError(str(error).replace("initial.q", f"{where}.q")) from None
    solution = sigma(mechanism, q, branch)
    if solution.verdict != "converged":
        raise InputError(f"{where}.q: unreachable: q is {solution.verdict}: {solution.reason}")
    return EndState(_unwind(solution.at, branch), q, rates)


def _unwind(at: Kinematics, reference: Kinematics) -> Kinematics:
    """Return a configuration with its dependent angles within half a turn of another configuration's.

    Couplings of joints may forbid this. The configuration is returned as it is then.
    """
    tree = at.tree
    angles = [k for k in at.partition.z if not tree.in_metres[k] and tree.coordinates[k] not in tree.free_coordinates]
    turning = tree.q_index[angles]
    q_tree = np.array(at.q_tree)
    q_tree[turning] -= 2 * np.pi * np.round((q_tree - reference.q_tree)[turning] / (2 * np.pi))
    unwound = Kinematics(tree, at.closure, at.partition, q_tree)
    is_closed = np.abs(unwound.phi - at.phi).max(initial=0.0) < MAX_UNWOUND_RESIDUAL
    return unwound if is_closed else at


def _in_coordinates(planned: Mechanism, state: EndState) -> EndState:
    """Return a state in the independent coordinates of another partition."""
    at = planned.kinematics(state.at.q_tree)
    v_tree = state.at.rho @ state.rates
    return EndState(at, planned.independent_part(at.q_tree), v_tree[planned.partition.q])


def _refuse_with_crossings(spec: OptimizeSpec) -> None:
    """Refuse what refers to the independent coordinates or to singular configurations."""
    for table, names in ((spec.limits, ("singularity", "jerk")), (spec.minimize, ("jerk", "tracking"))):
        for name in names:
            if getattr(table, name):
                where = "limits" if table is spec.limits else "minimize"
                raise InputError(
                    f"optimize: {where}.{name}: not supported with cross_singularities; remove one of them"
                )


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


def require_regular(mechanism: Mechanism, limits: MotionLimits, start: EndState, end: EndState) -> None:
    """Require that the end is within the limit of singularity (InputError)."""
    if not limits.singularity:
        return
    space = FreeSpace(mechanism, limits, start.at.q_tree)
    smallest = [float(space.sigma_min(space.node(state.at.q_tree))[0]) for state in (start, end)]
    margin = smallest[1] / smallest[0] if mechanism.dependent else 1.0
    if margin < limits.singularity:
        raise InputError(
            f"optimize: to: sigma_min(phi_z) is {margin:.3g} of its value at the start, below limits.singularity = "
            f"{limits.singularity:g}; change one of them"
        )


# --- initial guess -------------------------------------------------------------------------------


def _first_guesses(
    dynamics: ReducedDynamics, path: CoordinatePath, minimize: MinimizeSpec, limits: MotionLimits,
    states: tuple[EndState, EndState], *, crosses: bool,
) -> Iterator[tuple[CoordinateMotion, Torques | None] | None]:  # fmt: skip
    """Find initial guesses along a path, one after the other, with their torques or None; None if a search fails.

    The optimizer often succeeds from a slower motion, and from one of minimum effort with wider limits of torques.
    """
    start, end = (_in_coordinates(dynamics.mechanism, state) for state in states)
    motion = guess_motion(dynamics, path, minimize, limits, start, end)
    is_first = not crosses or isinstance(motion.motion, PathMotion)
    yield (motion, None) if is_first else None
    duration = _duration(minimize, limits, RETRY_SLOWER * motion.duration)
    if duration > motion.duration and not crosses:
        yield Slowed(motion, duration), None
    ends = Ends(np.array([start.q, end.q]), np.array([start.rates, end.rates]))
    typical = _typical_duration(_compute_path_terms(dynamics, path), limits, np.median)
    for duration in dict.fromkeys(_duration(minimize, limits, factor * typical) for factor in EFFORT_GUESS_DURATIONS):
        solution = _minimize_effort(dynamics, path, replace(limits, torque=limits.torque * WIDER, time=duration), ends,
                                    start.at.q_tree)  # fmt: skip
        wide_motion = solution.motion()
        torque = interpolation(wide_motion.corners, solution.values.torque)
        yield (wide_motion, torque) if solution.is_optimum else None
    if not is_first:
        yield motion, None


def _minimize_effort(
    dynamics: ReducedDynamics, path: CoordinatePath, limits: MotionLimits, ends: Ends, start: Array
) -> Solution:
    """Return a motion of minimum effort with the duration `limits.time`, on a mesh that is fine enough for the path."""
    smooth = SmoothMotion(path.q, ends.rates[0], ends.rates[1], limits.time)
    for intervals in EFFORT_GUESS_INTERVALS:
        guess = sample_motion(dynamics, limits, smooth, np.linspace(0.0, 1.0, intervals + 1), start, None)
        problem = Collocation(dynamics, limits, MinimizeSpec(effort=1.0), guess, start, fixed_duration=True)
        problem.set_ends(ends)
        optimizer = Ipopt(problem, iterations=EFFORT_GUESS_ITERATIONS, tolerance=EFFORT_GUESS_TOLERANCE, warm=False)
        solution, _ = problem.solve(guess, optimizer)
        if solution.status != "Invalid_Number_Detected":  # The loops close along the polynomials of this mesh.
            break
    return solution


def guess_motion(
    dynamics: ReducedDynamics, path: CoordinatePath, minimize: MinimizeSpec, limits: MotionLimits, start: EndState,
    end: EndState,
) -> Slowed:  # fmt: skip
    """Return a motion along a path between the ends: the fastest one, or a smooth one."""
    at_rest = not start.rates.any() and not end.rates.any()
    moves = np.abs(end.q - start.q).max() > 0
    along = _compute_path_terms(dynamics, path)
    if at_rest and moves:
        try:
            profile, _ = find_fastest(dynamics, along, limits)
            return Slowed(PathMotion(path, profile), _duration(minimize, limits, SLOWER * float(profile.t[-1])))
        except (InputError, NumericalError):
            pass
    duration = _duration(minimize, limits, _typical_duration(along, limits, np.max))
    return Slowed(SmoothMotion(path.q, start.rates, end.rates, duration), duration)


def _compute_path_terms(dynamics: ReducedDynamics, path: CoordinatePath) -> PathDynamics:
    return path_dynamics(dynamics, path, (1 - np.cos(np.pi * np.linspace(0.0, 1.0, GUESS_PLACES + 1))) / 2)


def _typical_duration(along: PathDynamics, limits: MotionLimits, reduce: Callable[[Array], Any]) -> float:
    """Return about the time that a motion along a path takes, s, by the largest or the median inertia."""
    force = float(reduce(np.abs(along.inertia).max(axis=1))) * 6
    available = np.where(np.isfinite(limits.torque), np.abs(limits.torque), 0).max(initial=0.0)
    available = available or max(float(np.abs(along.static).max()), 1e-3 * force)
    return max(float(np.sqrt(force / available)), 1e-2)


def _duration(minimize: MinimizeSpec, limits: MotionLimits, fastest: float) -> float:
    if not minimize.time:
        return limits.time
    return min(fastest, limits.time)


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Motion along a path with a cubic polynomial of time, plus cubics that give the rates at the ends."""

    path: PiecewisePolynomial
    start: Array
    end: Array
    duration: float

    @property
    def corners(self) -> Array:
        """Both ends, s."""
        return np.array([0.0, self.duration])

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        T = self.duration
        x = t / T
        s, s_dot, s_ddot = 3 * x**2 - 2 * x**3, (6 * x - 6 * x**2) / T, (6 - 12 * x) / T**2
        q, q_s, q_ss = self.path(s)
        first = np.array([x - 2 * x**2 + x**3, (1 - 4 * x + 3 * x**2) / T, (-4 + 6 * x) / T**2])
        last = np.array([x**3 - x**2, (3 * x**2 - 2 * x) / T, (6 * x - 2) / T**2])
        more = [T * (np.outer(a, self.start) + np.outer(b, self.end)) for a, b in zip(first, last, strict=True)]
        return (q + more[0], q_s * s_dot[:, None] + more[1],
                q_s * s_ddot[:, None] + q_ss * s_dot[:, None] ** 2 + more[2])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Slowed:
    """A motion with another duration."""

    motion: CoordinateMotion
    duration: float

    @property
    def corners(self) -> Array:
        """Both ends, s."""
        return np.array([0.0, self.duration])

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Return values, rates and accelerations, (m, d) each, at times t (m,)."""
        factor = float(self.motion.corners[-1]) / self.duration
        q, v, a = self.motion(np.minimum(t * factor, self.motion.corners[-1]))
        return q, v * factor, a * factor**2


def sample_motion(
    dynamics: ReducedDynamics, limits: MotionLimits, motion: CoordinateMotion, mesh: Array, start: Array,
    torque: Callable[[Array], Array] | None,
) -> Guess:  # fmt: skip
    """Return a motion on a mesh as an initial guess, with its torques or those of inverse dynamics.

    The loops are followed from the closed configuration `start` (nq,).
    """
    duration = float(motion.corners[-1])
    t = duration * np.sort(np.concatenate([mesh, gauss_places(mesh)]))
    is_knot = np.isin(np.arange(len(t)), np.arange(0, len(t), DEGREE + 1))
    q, v, a = motion(t)
    q_tree = dynamics.follow(start, q)
    if q_tree is None:
        raise NumericalError("optimize: stuck: the loops do not close along the initial guess")
    knots = q_tree[is_knot]
    if torque is None:
        at = dynamics.instants(knots, v[is_knot], a[is_knot], np.zeros((len(mesh), dynamics.motors)))
        transmission = np.einsum("mnd,kn->mdk", dynamics.rho(knots), dynamics.mechanism.motors.transmission)
        tau = np.clip(minimum_norm_within(transmission, at.force, limits.torque), *limits.torque)
    else:
        tau = torque(t[is_knot])
    accelerations = a[~is_knot].reshape(len(mesh) - 1, DEGREE, -1)
    return Guess(mesh, duration, q[is_knot], v[is_knot], accelerations, tau, q_tree[~is_knot])


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


@dataclass(frozen=True, eq=False)
class Exceeded(Immutable):
    """Intervals in which limits are exceeded by more than `EXCESS`, and the worst quantity with its relative excess."""

    intervals: BoolArray
    name: str
    size: float


def _assemble(
    mechanism: Mechanism, dynamics: ReducedDynamics, limits: MotionLimits, solution: Solution, iterations: int,
    start: EndState,
) -> tuple[Plan, Exceeded]:  # fmt: skip
    values = solution.values
    motion = solution.motion()
    torque = np.clip(values.torque, *limits.torque)
    knots = motion.corners
    parts = np.arange(SAMPLES_PER_INTERVAL) / SAMPLES_PER_INTERVAL
    t = np.append((knots[:-1, None] + np.diff(knots)[:, None] * parts).ravel(), knots[-1])
    q, v, a = motion(t)
    q_tree = dynamics.follow(start.at.q_tree, q)
    if q_tree is None:
        raise NumericalError(
            "optimize: stuck: the loops do not close between the points of the mesh; give more intervals"
        )
    torques = interpolation(knots, torque)
    at = dynamics.instants(q_tree, v, a, torques(t))
    quantities, margin = measure(mechanism, dynamics, limits, at)
    replay = replay_plan(mechanism, dynamics, motion, at, knots, torque)
    warnings = []
    if replay.error > REPLAY_ERROR:
        remedy = "give more intervals"
        if mechanism.joints.friction.any():
            remedy = "joints with dry friction may stick, which the plan does not foresee; track the motion"
        warnings.append(f"the replay misses the end by {replay.error:.1e}; {remedy}")
    plan = Plan(
        mechanism=mechanism, status="solved", message="a local optimum", t_end=values.duration, cost=solution.cost,
        parts=solution.parts, iterations=iterations, coordinates=dynamics.mechanism.independent, motion=motion,
        torque_t=knots, torque=torque, t=t, quantities=quantities, margin=margin, limits=limits,
        active=tuple(find_active(limits, t, quantities, margin)),
        crossings=find_crossings(mechanism, dynamics, motion, t, at, torques), replay=replay,
        warnings=tuple(warnings),
    )  # fmt: skip
    return plan, _find_excess(limits, quantities, margin)


def _find_excess(limits: MotionLimits, quantities: Array, margin: Array) -> Exceeded:
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
    return Exceeded(inside, (*limits.names, "sigma_min")[int(worst[1])], float(relative[worst]))
