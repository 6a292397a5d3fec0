"""Initial guesses of motions through places, for optimal control."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise, product, zip_longest
from typing import Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.control.piecewise import PiecewisePolynomial
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.along_path import PathDynamics, find_fastest, minimum_norm_within, path_dynamics
from ckc_pin.optimization.collocation import Collocation
from ckc_pin.optimization.crossing import find_routes
from ckc_pin.optimization.end_states import EndState, in_coordinates
from ckc_pin.optimization.free_path import find_path, is_separated, search_path
from ckc_pin.optimization.guess_motions import Joined, Slowed, SmoothMotion, scale_durations
from ckc_pin.optimization.ipopt import Ipopt
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.mesh_motion import DEGREE, Guess, Mesh, Places, Solution, times
from ckc_pin.optimization.path import CoordinatePath, PathMotion
from ckc_pin.optimization.phase_dynamics import PhaseDynamics
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.replay import CoordinateMotion
from ckc_pin.optimization.route import Route
from ckc_pin.optimization.spec import MinimizeSpec, OptimizeSpec

__all__ = ["FirstGuess", "Way", "find_guesses", "guess_between", "interpolation", "sample_motion"]

GUESS_PLACES = 100  # of the path of the initial guess
SLOWER = 1.05  # initial guess's duration, relative to the fastest one along its path
UNEVEN = 1.3  # duration of a turn of the initial guess, relative to that at the limit of a rate
RETRY_SLOWER = 2.0  # the duration of a second initial guess, relative to the first one
EFFORT_GUESS_INTERVALS = 20, 40, 80  # of meshes of initial guesses of minimum effort
EFFORT_GUESS_TOLERANCE = 1e-6
EFFORT_GUESS_ITERATIONS = 200
EFFORT_GUESS_DURATIONS = (1.0, 0.85, 0.6, 1.4, 2.0)  # of initial guesses of minimum effort, relative to a typical one
WIDER = 10.0  # limits of torques of these guesses, relative to the plan's
SIDE = 1e-9  # of the duration, from the end of a phase to where its torque is taken from a guess

Torques = Callable[[Array], Array]  # motor torques (m, motors) at times (m,)


class Way(Immutable, frozen=True):
    """Places of a motion in the coordinates that it is planned in."""

    dynamics: ReducedDynamics
    states: Sequence[EndState]
    route: Route

    def in_coordinates(self, planned: Mechanism) -> Way:
        """Return a motion from one place to another in the independent coordinates of another partition."""
        if planned is self.dynamics.mechanism:
            return self
        dynamics = ReducedDynamics(planned)
        states = [in_coordinates(planned, state) for state in self.states]
        places = Places(np.array([x.q for x in states]), np.array([x.rates for x in states]), self.route.places.t)
        return Way(dynamics, states, replace(self.route, places=places, members=(dynamics,)))


class FirstGuess(Immutable, frozen=True):
    """An initial guess of the optimizer: a motion, the times of its places, s, and its torques if there are any."""

    way: Way
    motion: CoordinateMotion
    ends: Array
    torque: Torques | None = None


def find_guesses(way: Way, spec: OptimizeSpec, limits: MotionLimits) -> Iterator[FirstGuess]:
    """Find initial guesses, one after the other.

    If singular configurations may be crossed, one guess along each of the paths comes first, then the next ones.
    """
    if not spec.cross_singularities:
        turns = way.route.places.turns is not None and bool(way.route.places.turns.any())
        t = way.route.places.t
        motion = _guess_route(way.route.members, spec.minimize, limits, way.states, t, turns=turns)
        ends = motion.corners
        yield FirstGuess(way, motion, ends)
        duration = _duration(spec.minimize, limits, RETRY_SLOWER * float(ends[-1]))
        if duration > ends[-1] and not way.route.has_times:
            # The optimizer often succeeds from a slower motion.
            yield FirstGuess(way, Slowed(motion, duration), ends * (duration / ends[-1]))
        return
    mechanism, (start, end) = way.dynamics.mechanism, [state.at.q_tree for state in way.states]
    path = None if is_separated(mechanism, limits, start, end) else find_path(mechanism, limits, start, end)
    routes = find_routes(mechanism, limits, start, end) if path is None else [(mechanism, path)]
    ways = [way.in_coordinates(planned) for planned, _ in routes]
    guesses = [_guess_along(one, path, spec.minimize, limits) for one, (_, path) in zip(ways, routes, strict=True)]
    for row in zip_longest(*guesses):
        yield from (guess for guess in row if guess is not None)


def interpolation(times: Array, values: Array) -> Torques:
    """Return the function of times (m,) that interpolates the rows (k, columns) of a table linearly."""
    return lambda t: np.array([np.interp(t, times, x) for x in values.T]).T.reshape(len(t), -1)


def _guess_along(
    way: Way, path: CoordinatePath, minimize: MinimizeSpec, limits: MotionLimits
) -> Iterator[FirstGuess | None]:
    """Find initial guesses along a path, one after the other; None if a search fails.

    The optimizer often succeeds from a motion of minimum effort with wider limits of torques.
    """
    start, end = way.states
    motion = _guess_motion_along(way.dynamics, path, minimize, limits, start, end)
    is_first = isinstance(motion.motion, PathMotion)
    fastest = FirstGuess(way, motion, motion.corners)
    yield fastest if is_first else None
    typical = _typical_duration(_compute_path_terms(way.dynamics, path), limits, np.median)
    durations = dict.fromkeys(_duration(minimize, limits, factor * typical) for factor in EFFORT_GUESS_DURATIONS)
    for duration, intervals in product(durations, EFFORT_GUESS_INTERVALS):
        wide = replace(limits, torque=limits.torque * WIDER, time=duration)
        solution = _minimize_effort(way, path, wide, intervals)
        wide_motion = solution.motion()
        torque = interpolation(solution.values.torque_t, solution.values.torque)
        yield FirstGuess(way, wide_motion, solution.values.ends, torque) if solution.is_optimum else None
    if not is_first:
        yield fastest


def _minimize_effort(way: Way, path: CoordinatePath, limits: MotionLimits, intervals: int) -> Solution:
    """Return a motion of minimum effort with the duration `limits.time`."""
    start, end = way.states
    smooth = SmoothMotion(path.q, start.rates, end.rates, limits.time)
    places = replace(way.route.places, t=np.array([0.0, limits.time]))
    mesh = Mesh.uniform(intervals, np.array([limits.time]))
    guess = sample_motion(way.dynamics, limits, smooth, mesh, start.at.q_tree, None)
    problem = Collocation(way.dynamics, limits, MinimizeSpec(effort=1.0), guess, start.at.q_tree, places)
    optimizer = Ipopt(problem, iterations=EFFORT_GUESS_ITERATIONS, tolerance=EFFORT_GUESS_TOLERANCE, warm=False)
    return problem.solve(guess, optimizer)[0]


def _guess_motion_along(
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


def guess_between(
    dynamics: ReducedDynamics, minimize: MinimizeSpec, limits: MotionLimits, start: EndState, end: EndState
) -> Slowed:
    """Return a motion between the ends along a path that the loops can follow."""
    path = search_path(dynamics.mechanism, limits, start.at.q_tree, end.at.q_tree)
    return _guess_motion_along(dynamics, path, minimize, limits, start, end)


def _guess_route(
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
        motion = guess_between(members[0], minimize, limits, *states)
        if not turns:
            return motion
        way = states[1].q - states[0].q
        fastest = float(np.max(np.abs(way) / limits.rate[members[0].q_at])) or float(motion.corners[-1])
        ends = np.array([0.0, _duration(minimize, limits, UNEVEN * fastest)])
        return PiecewisePolynomial(ends, np.array([[way / ends[1]], [states[0].q]]), corners=ends)
    legs = [guess_between(dynamics, MinimizeSpec(time=1.0), limits, *pair)
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
    torque: Torques | None, ends: Array | None = None, members: Sequence[ReducedDynamics] = (),
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
        tau = minimum_norm_within(dynamics.transmission(knots), at.force, limits.torque)
    else:
        tau = torque(torque_t)
    accelerations = a[~is_knot].reshape(len(mesh.knots) - 1, DEGREE, -1)
    return Guess(mesh, np.diff(ends), q[is_knot], v[is_knot], accelerations, tau, q_tree[~is_knot])
