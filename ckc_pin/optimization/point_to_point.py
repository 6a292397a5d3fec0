"""Plan a motion from one configuration to another: optimal control, refinement of the mesh, and the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, BoolArray, Immutable
from ckc_pin.base.sources import Sources
from ckc_pin.control.point_path import make_desired
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.collocation import MIN_DURATION, TOLERANCE, Collocation
from ckc_pin.optimization.crossing import find_crossings
from ckc_pin.optimization.dry_friction import FrictionKnots
from ckc_pin.optimization.end_states import EndState, require_inside, require_regular
from ckc_pin.optimization.first_guess import FirstGuess, Way, find_guesses, interpolation, sample_motion
from ckc_pin.optimization.ipopt import Ipopt
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import Guess, Mesh, Solution, times
from ckc_pin.optimization.phase_dynamics import PhaseDynamics
from ckc_pin.optimization.plan import Plan, find_active, measure
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.replay import JUMP_GAP, REPLAY_ERROR, Cycle, replay_plan, replay_warnings, require_replayed
from ckc_pin.optimization.route import Route
from ckc_pin.optimization.spec import MinimizeSpec, OptimizeSpec

__all__ = ["plan_between", "read_desired_motion", "require_solved"]

FIRST_INTERVALS = 40
MAX_MESHES = 16
MAX_DOUBLINGS = 3  # of all intervals, because the replay misses the end; others are where limits are exceeded
MAX_ITERATIONS = 400  # of IPOPT on one mesh
FEW_ITERATIONS = 100  # of it, where other initial guesses may be better
SAMPLES_PER_INTERVAL = 5
UNBOUNDED_FACTOR = 1.1  # shorter durations, relative to the smallest that the optimizer may choose, are unbounded
EXCESS = 1e-3  # relative: intervals in which a limit is exceeded by more are divided


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
        require_regular(mechanism, limits, start, state, name)
    desired = None if spec.desired is None else read_desired_motion(spec.desired, mechanism, sources, limits.time)
    limits = replace(limits, time=route.time)
    error: NumericalError | None = None
    for guess in find_guesses(Way(dynamics, states, route), spec, limits):
        try:
            return _plan_from(mechanism, guess, spec, limits, desired, names, progress)
        except NumericalError as failure:
            error = error or failure
    raise error or NumericalError(
        "optimize: stuck: no path from `from` to `to` was found, also not through singular configurations"
    )


def _plan_from(
    mechanism: Mechanism, first: FirstGuess, spec: OptimizeSpec, limits: MotionLimits,
    desired: Callable[[Array], Array] | None, names: Sequence[str], progress: Callable[[float], None],
) -> Plan:  # fmt: skip
    """Plan a motion from an initial guess."""
    dynamics, route, start = first.way.dynamics, first.way.route, first.way.states[0]
    motion, ends, torque = first.motion, first.ends, first.torque
    mesh = base = Mesh.uniform(spec.intervals or FIRST_INTERVALS, np.diff(ends))
    first_iterations = FEW_ITERATIONS if spec.cross_singularities and torque is None else MAX_ITERATIONS
    iterations, doublings, friction = 0, 0, FrictionKnots(dynamics)
    for attempt in range(MAX_MESHES):
        guess = sample_motion(dynamics, limits, motion, mesh, start.at.q_tree, torque, ends, route.members)
        gauss_times = times(mesh.gauss_places(), ends)
        friction.begin_mesh(guess.q_tree, motion(gauss_times)[1])
        problem = Collocation(dynamics, limits, spec.minimize, guess, start.at.q_tree, route.places,
                              None if desired is None else desired(gauss_times), route.members)  # fmt: skip
        optimizer = Ipopt(problem, iterations=MAX_ITERATIONS if attempt else first_iterations, tolerance=TOLERANCE,
                          warm=attempt > 0)  # fmt: skip
        solution, _ = problem.solve(guess, optimizer)
        iterations += solution.iterations
        require_solved(solution)
        _require_durations(solution, guess, names)
        friction.end_mesh()
        plan, exceeded = _assemble(mechanism, dynamics, limits, spec.minimize, solution, iterations, start, route)
        progress((attempt + 1) / MAX_MESHES)
        misses = plan.replay.error > REPLAY_ERROR
        halves = misses and not friction.is_present and doublings < MAX_DOUBLINGS
        moves = friction.is_smoothed or (friction.is_present and misses)
        if not halves and not moves and not exceeded.intervals.any():
            require_replayed(mechanism, plan.replay, plan.t_end)
            return plan
        doublings += halves
        if exceeded.intervals.any() or halves:
            base = mesh.divide(exceeded.intervals | halves)
        mesh = friction.insert(base, exceeded.samples, exceeded.rates)
        motion, ends = solution.motion(), solution.values.ends
        torque = interpolation(solution.values.torque_t, solution.values.torque)
    if not exceeded.intervals.any():
        require_replayed(mechanism, plan.replay, plan.t_end)
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


class Exceeded(Immutable, frozen=True):
    """Intervals in which limits are exceeded by more than `EXCESS`, and the worst quantity with its relative excess.

    `samples` (m,) are places in units of the mesh, with v' `rates` (m, n).
    """

    intervals: BoolArray
    name: str
    size: float
    samples: Array
    rates: Array


def _assemble(
    mechanism: Mechanism, dynamics: ReducedDynamics, limits: MotionLimits, minimize: MinimizeSpec, solution: Solution,
    iterations: int, start: EndState, route: Route,
) -> tuple[Plan, Exceeded]:  # fmt: skip
    values = solution.values
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
    quantities = measure(mechanism, dynamics, limits, at)
    margin = dynamics.margins(at.q_tree, mechanism.partition.z)
    motion = route.motion(solution)
    torque_t, torque = route.torques(values, torque)
    cycle = None if route.places.turns is None else Cycle(route.places.turns)
    sections = route.sections(ends)
    replay = replay_plan(mechanism, dynamics, motion, at, torque_t, torque, cycle, sections)
    at_rest = {"time": float(route.rests.sum()), "effort": float(route.rests @ (route.rest_torque**2).sum(axis=1))}
    solved = {name: x + at_rest.get(name, 0.0) for name, x in solution.parts.items()}
    plan = Plan(
        mechanism=mechanism, status="solved", message="a local optimum", t_end=float(motion.corners[-1]),
        cost=sum(getattr(minimize, name) * x for name, x in solved.items()), parts=solved, iterations=iterations,
        coordinates=dynamics.mechanism.independent, motion=motion, torque_t=torque_t, torque=torque, t=t,
        quantities=quantities, margin=margin, limits=limits, replay=replay,
        active=tuple(find_active(limits, t, quantities, margin)), warnings=replay_warnings(mechanism, replay),
        crossings=find_crossings(mechanism, dynamics, motion, t, at, interpolation(torque_t, torque)),
        via_t=tuple((ends[1:-1] + route.offsets[1:] - route.rests[:-1]).tolist()), cycle=cycle, sections=sections,
    )  # fmt: skip
    return plan, _find_excess(limits, quantities[is_sample], margin[is_sample], samples, at.v_tree[is_sample])


def _find_excess(limits: MotionLimits, quantities: Array, margin: Array, samples: Array, rates: Array) -> Exceeded:
    """Find the intervals in which limits are exceeded, from samples of them and of the end."""
    relative = limits.excess(quantities) / limits.sizes(quantities)
    close = 1 - margin[:, None] / limits.singularity if limits.singularity else np.zeros((len(margin), 0))
    relative = np.hstack([relative, close])
    at = relative > EXCESS
    inside: BoolArray = np.asarray(at[:-1].reshape(-1, SAMPLES_PER_INTERVAL * at.shape[1]).any(axis=1))
    inside[-1] |= at[-1].any()
    worst = np.unravel_index(int(np.argmax(relative)), relative.shape)
    name = (*limits.names, "sigma_min")[int(worst[1])]
    return Exceeded(inside, name, float(relative[worst]), samples, rates)
