"""Assembly: find a closed configuration near a guess, and create the `Mechanism` there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from itertools import islice

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.errors import MechanismError
from ckc_pin.kinematics.closing import EXACT_TOLERANCE, ROUNDED_TOLERANCE, Assembly, close_loops, find_nearby
from ckc_pin.kinematics.continuation import same_branch
from ckc_pin.kinematics.loop_types import describe_locking_loops, list_closing_types
from ckc_pin.kinematics.sigma import follow_sigma, newton, sigma
from ckc_pin.mechanism.closure import ClosureBuilder
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.couplings import coefficients_of, coupled_joints, curve_of
from ckc_pin.mechanism.linkage import Linkage
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import count_freedoms
from ckc_pin.mechanism.spec import CouplingSpec, MechanismSpec
from ckc_pin.mechanism.warnings import find_model_warnings

__all__ = ["OpenLoopsError", "assemble_mechanism", "open_loops", "reassemble"]


class OpenLoopsError(MechanismError):
    """The loops cannot be closed from the guess, whichever coordinates are independent."""


def assemble_mechanism(
    spec: MechanismSpec,
    sources: Sources,
    overrides: Overrides | None = None,
    prescribed: Mapping[str, float | None] | None = None,
    explain: bool = True,
) -> Mechanism:
    """Assemble a mechanism from its files, with overrides of its parameters and positions of prescribed joints by name.

    `explain`: whether the message about open loops gives the reason. Finding it takes longer than an assembly.

    Raises
    ------
    MechanismError
        Unknown names, loops that cannot be closed from q_guess, or unsuitable independent coordinates.
    """
    linkage = Linkage(spec, sources, overrides)
    tree = linkage.tree
    with one_blas_thread(size=_size(linkage)):
        guess = tree.vector(spec.q_guess, tree.coordinates, "q_guess", fill=0.0)
        guess = _apply_couplings(linkage, guess)
        mechanism = _create_mechanism(linkage, _assemble(linkage, tree.from_coordinates(guess), explain))
        if linkage.spec.independent is None:
            mechanism = _restore_guess(linkage, mechanism)
        if prescribed:
            for name in prescribed:
                tree.joint_index(name, "prescribed")
            assembled = tree.to_coordinates(mechanism.q_tree)
            positions = {
                name: float(assembled[tree.index[name]]) if value is None else value
                for name, value in prescribed.items()
            }
            with_rows = Linkage(spec, sources, overrides, positions)
            mechanism = _prescribe(with_rows, linkage, mechanism, positions)
        elif locking := describe_locking_loops(mechanism):
            mechanism.warnings.append(f"the loops leave no freedom (d = 0): {locking}")
        mechanism.warnings += find_model_warnings(mechanism)
        return mechanism


def open_loops(spec: MechanismSpec, sources: Sources, q_tree: Mapping[str, float]) -> tuple[Mechanism, Mechanism]:
    """Return a mechanism whose loops cannot be closed: as a tree without its loops, and with open loops.

    The first can be moved like any mechanism. The second is for display only: its terms exist, but its loops are open.

    Parameters
    ----------
    spec, sources : MechanismSpec, Sources
    q_tree : mapping
        Where both stand, by coordinate, such as `MechanismError.q_tree`.
    """
    spec = msgspec.structs.replace(spec, independent=None, q_guess=dict(q_tree))
    as_tree = assemble_mechanism(msgspec.structs.replace(spec, loop=[], coupling=[]), sources)
    linkage = Linkage(spec, sources, None)
    at = Kinematics(linkage.tree, linkage.closure, as_tree.partition, as_tree.q_tree)
    with one_blas_thread(size=_size(linkage)):
        opened = _create_mechanism(linkage, _measure(linkage, at))
    return as_tree, opened


def reassemble(mechanism: Mechanism, overrides: Overrides, at: Kinematics) -> tuple[Mechanism, Kinematics]:
    """Assemble a mechanism with other parameter values on the branch of a closed configuration, at the same q.

    The residual phi of the configuration in the new mechanism is reduced to zero along a straight line, by z alone. If
    this is not possible, all coordinates move as little as possible. The new mechanism's assembled configuration
    follows from the old one in the same way, or is the configuration if that fails.

    Parameters
    ----------
    mechanism : Mechanism
    overrides : mapping
        Parameter values by name, with those that the mechanism has already.
    at : Kinematics
        A closed configuration of the mechanism, or of it with other parameter values.

    Returns
    -------
    Mechanism, Kinematics
        The new mechanism, with the same independent coordinates, and its configuration.

    Raises
    ------
    InputError, MechanismError
        Invalid values; or the loops cannot be closed near the configuration on its branch.
    """
    home = mechanism.tree.to_coordinates(mechanism.q_tree)
    positions = {name: float(home[mechanism.tree.index[name]]) for name in mechanism.prescribed}
    linkage = Linkage(mechanism.spec, mechanism.sources, overrides, positions)
    with one_blas_thread(size=_size(linkage)):
        here = _close_on_branch(linkage, at, mechanism.tolerance)
        try:
            assembled = _close_on_branch(linkage, mechanism.assembled, mechanism.tolerance)
        except MechanismError:
            assembled = here
        rebuilt = _create_mechanism(linkage, assembled, mechanism.independent)
        rebuilt.warnings += find_model_warnings(rebuilt)
    return rebuilt, rebuilt.kinematics(here.q_tree)


def _size(linkage: Linkage) -> int:
    """Return a bound of the numbers of rows and columns of all matrices in an assembly."""
    return linkage.tree.n + linkage.closure.rows


def _close_on_branch(linkage: Linkage, at: Kinematics, tolerance: float) -> Assembly:
    """Close the loops of a linkage near a closed configuration of another one, on its branch (MechanismError)."""
    start = Kinematics(linkage.tree, linkage.closure, at.partition, at.q_tree)
    rounded = ROUNDED_TOLERANCE * linkage.size
    moved = follow_sigma(start, np.zeros(len(at.partition.q)), 0.0, tolerance, anywhere=False)
    closed = _measure(linkage, moved.at)
    if moved.verdict != "converged" or closed.residual > rounded:
        free, exact = np.ones(linkage.tree.n), EXACT_TOLERANCE * linkage.size
        closed = close_loops(linkage.tree, linkage.closure, at.q_tree, free, exact, restarts=0, rounded=rounded)
    if closed.residual > rounded:
        loop, miss = max(closed.largest_residuals.items(), key=lambda item: item[1])
        raise MechanismError(f"not closed: nearest miss {miss:.3g} m at loop {loop}")
    end = Kinematics(linkage.tree, linkage.closure, at.partition, closed.q_tree)
    if not same_branch(at, end) or linkage.closure.reversed_hinges(end.pose):
        raise MechanismError("the loops close on another assembly branch only, behind a singular configuration")
    return closed


def _measure(linkage: Linkage, at: Kinematics) -> Assembly:
    """Return a configuration with its residuals."""
    residuals = linkage.closure.largest_residuals(at.phi)
    return Assembly(at.q_tree, float(np.abs(at.phi).max(initial=0.0)), residuals)


def _prescribe(linkage: Linkage, free_linkage: Linkage, free: Mechanism, prescribed: Mapping[str, float]) -> Mechanism:
    """Create a mechanism with prescribed joints, on the branch of the mechanism without them.

    Parameters
    ----------
    linkage : Linkage
        With the rows of the prescribed joints.
    free_linkage, free : Linkage, Mechanism
        Without them, as assembled.
    prescribed : mapping of str to float
        Positions of the joints, rad or m.

    Raises
    ------
    MechanismError
        The loops cannot be closed with these positions.
    """
    tree, q_tree = linkage.tree, free.q_tree
    at = tree.indices(tuple(prescribed), "prescribed")
    independent = free.complete_independent(tuple(prescribed))
    reached = False
    if independent is not None:
        base = _create_mechanism(free_linkage, Assembly(free.q_tree, free.residual, {}), independent)
        numbers = tree.to_coordinates(free.q_tree)
        q = np.array([prescribed.get(name, numbers[tree.index[name]]) for name in base.independent])
        moved = sigma(base, q, anywhere=False)
        reached = moved.verdict == "converged"
        q_tree = moved.at.q_tree if reached else q_tree
    numbers = tree.to_coordinates(q_tree)
    numbers[at] = list(prescribed.values())
    mechanism = _create_mechanism(linkage, _assemble(linkage, tree.from_coordinates(numbers)))
    if not reached:
        positions = ", ".join(f"{name} = {value:.6g}" for name, value in prescribed.items())
        mechanism.warnings.append(
            f"prescribed: {positions} is not reached from q_guess on its branch; the mechanism may be on another one"
        )
    return mechanism


def _create_mechanism(linkage: Linkage, closed: Assembly, independent: tuple[str, ...] | None = None) -> Mechanism:
    """Create the mechanism at a closed configuration, with the tolerance to which its loops close."""
    tree, closure, size = linkage.tree, linkage.closure, linkage.size
    lengths = bool(np.all(closure.in_metres(tree)))
    rounding = 1e-13 * (size if lengths else max(size, 1.0))
    tolerance = rounding if closed.residual <= EXACT_TOLERANCE * size else 10 * closed.residual
    accept = max(tolerance, rounding)

    def nearby(tangent: Array) -> list[Array]:
        return find_nearby(tree, closure, closed.q_tree, tangent, accept)

    freedoms = count_freedoms(tree, closure, closed.q_tree, nearby)
    return Mechanism(linkage, closed.q_tree, closed.residual, tolerance, freedoms, independent)


def _apply_couplings(linkage: Linkage, guess: Array) -> Array:
    """Return a guess that satisfies the couplings: the first joint of each one gets the value that the others imply.

    If it has an entry in q_guess, the next joint without one follows instead, and none if all have one.
    """
    tree, guess = linkage.tree, guess.copy()
    placed, pending = set(linkage.spec.q_guess), list(linkage.couplings)
    while pending:
        coupling = _next_coupling(pending, placed)
        pending.remove(coupling)
        coefficients, curve = coefficients_of(coupling), curve_of(coupling)
        follower = next((x for x in coupled_joints(coupling) if x not in placed and coefficients.get(x)), None)
        if follower is not None:
            total = (
                coupling.offset if curve is None else coupling.offset + curve(guess[tree.index[str(coupling.other)]])
            )
            total -= sum(x * guess[tree.index[name]] for name, x in coefficients.items() if name != follower)
            guess[tree.index[follower]] = total / coefficients[follower]
        placed |= set(coupled_joints(coupling))
    return guess


def _next_coupling(pending: list[CouplingSpec], placed: set[str]) -> CouplingSpec:
    """Return a coupling of a joint whose value is known, else one whose master follows no other joint."""
    for coupling in pending:
        if placed.intersection(coupled_joints(coupling)):
            return coupling
    followers = {coupled_joints(coupling)[0] for coupling in pending}
    return next((x for x in pending if followers.isdisjoint(coupled_joints(x)[1:])), pending[0])


def _restore_guess(linkage: Linkage, mechanism: Mechanism) -> Mechanism:
    """Move an assembled mechanism so that the independent coordinates which it chose have their values of q_guess.

    The closed configuration nearest to the guess differs from it in all coordinates. The mechanism stays as it is if
    the loops cannot be closed with these values on its branch, or only beyond stops.
    """
    tree, guess = linkage.tree, linkage.spec.q_guess
    numbers, at_q = tree.to_coordinates(mechanism.q_tree), mechanism.partition.q
    q = np.array([guess.get(name, numbers[tree.index[name]]) for name in mechanism.independent])
    if np.array_equal(q, numbers[at_q]) or mechanism.splits_root or mechanism.freedoms.singular:
        return mechanism
    moved = sigma(mechanism, q, anywhere=False)
    if moved.verdict != "converged":
        return mechanism
    end = tree.to_coordinates(moved.at.q_tree)
    end[at_q] = q  # The steps to q add up to it except for rounding.
    closed = newton(mechanism.kinematics(tree.from_coordinates(end)), 0.0, mechanism.tolerance)
    accepted = np.maximum(_excess(linkage, numbers), EXACT_TOLERANCE * tree.step_scale)
    is_beyond_stop = np.any(_excess(linkage, tree.to_coordinates(closed.at.q_tree)) > accepted)
    if not closed.converged or is_beyond_stop or linkage.closure.reversed_hinges(closed.at.pose):
        return mechanism
    try:
        return _create_mechanism(linkage, _measure(linkage, closed.at), mechanism.independent)
    except MechanismError:  # phi_z is singular at the guess
        return mechanism


def _excess(linkage: Linkage, numbers: Array) -> Array:
    """Return how far each coordinate is beyond its stops, 0 within them, shape (n,)."""
    return np.abs(numbers - np.clip(numbers, linkage.joints.lower, linkage.joints.upper))


def _assemble(linkage: Linkage, start: Array, explain: bool = True) -> Assembly:
    """Close the loops near a guess, within the stops of the joints if possible.

    Other guesses are not tried if one of several loops stays open even without the others.
    """
    scale = linkage.size
    open_alone = cache(lambda: dict(islice(_loops_open_alone(linkage, start), None if explain else 1)))
    closed = _close_near(linkage, start, may_restart=lambda: len(linkage.spec.loop) == 1 or not open_alone())
    if closed.residual > ROUNDED_TOLERANCE * scale:
        why = _why_not_closed(linkage, closed, start, open_alone()) if explain else "not closed"
        nearest = linkage.tree.named(linkage.tree.to_coordinates(closed.q_tree))
        raise OpenLoopsError(f"{linkage.sources.name}: {why}", q_tree=nearest)
    reversed_ = linkage.closure.reversed_hinges(Pose(linkage.tree, linkage.closure.anchors, closed.q_tree))
    if reversed_:
        raise MechanismError(
            f"{linkage.sources.name}: loop {reversed_[0]!r} closes with its axes against each other (a . b < 0); "
            "reverse axis_b, or give a [q_guess] on the other branch"
        )
    closed = _move_within_stops(linkage, closed)
    if closed.residual > EXACT_TOLERANCE * scale:
        linkage.warnings.append(
            f"the loops close to {closed.residual:.2g} only, not to rounding: "
            "numbers in the files are rounded, or redundant rows contradict each other slightly"
        )
    return closed


def _close_near(
    linkage: Linkage,
    start: Array,
    bounds: tuple[Array, Array] | None = None,
    may_restart: Callable[[], bool] = lambda: True,
) -> Assembly:
    """Close the loops with the independent coordinates fixed at their guess; if that fails, with all coordinates."""
    closed: Assembly | None = None
    tree, exact, rounded = linkage.tree, EXACT_TOLERANCE * linkage.size, ROUNDED_TOLERANCE * linkage.size

    def close(free: Array) -> Assembly:
        closure = linkage.closure
        return close_loops(tree, closure, start, free, exact, bounds=bounds, rounded=rounded, may_restart=may_restart)

    if linkage.spec.independent is not None:
        free = np.ones(tree.n)
        fixed = [name for name in linkage.spec.independent if name not in linkage.prescribed]
        free[tree.indices(tuple(fixed), "independent")] = 0.0
        closed = close(free)
    if closed is None or closed.residual > rounded:
        closed = close(np.ones(tree.n))
    return closed


def _loops_open_alone(linkage: Linkage, start: Array) -> Iterator[tuple[str, float]]:
    """Yield the loops that cannot close near a guess even without the others, with their smallest |phi|."""
    tree = linkage.tree
    for loop in linkage.spec.loop:
        builder = ClosureBuilder(tree, linkage.frames)
        builder.add_loop(loop)
        closed = close_loops(tree, builder.build(), start, np.ones(tree.n), EXACT_TOLERANCE * linkage.size)
        if closed.residual > ROUNDED_TOLERANCE * linkage.size:
            yield loop.name, closed.residual


def _move_within_stops(linkage: Linkage, closed: Assembly) -> Assembly:
    """Move a configuration beyond stops, where no run can start, to a nearby one within them if there is one."""
    tree, joints = linkage.tree, linkage.joints
    numbers = tree.to_coordinates(closed.q_tree)
    beyond = _excess(linkage, numbers) > EXACT_TOLERANCE * tree.step_scale
    if not np.any(beyond):
        return closed
    within = _close_near(linkage, closed.q_tree, (joints.lower, joints.upper))
    pose = Pose(tree, linkage.closure.anchors, within.q_tree)
    if within.residual > ROUNDED_TOLERANCE * linkage.size or linkage.closure.reversed_hinges(pose):
        return closed
    new = tree.to_coordinates(within.q_tree)
    moved = [f"{tree.coordinates[k]} = {new[k]:.4g} (without stops {numbers[k]:.4g})" for k in np.flatnonzero(beyond)]
    linkage.warnings.append(f"q_guess leads beyond stops of joints; assembled within the stops: {', '.join(moved)}")
    return within


def _why_not_closed(linkage: Linkage, best: Assembly, start: Array, open_alone: Mapping[str, float]) -> str:
    """Describe the loop with the largest residual, loops that cannot close even alone, and remedies."""
    loop, miss = max((open_alone or best.largest_residuals).items(), key=lambda item: item[1])
    message = f"not closed: nearest miss {miss:.3g} m at loop {loop}"
    if miss > 1000 * linkage.size:
        return (
            f"{message}, {miss / linkage.size:.0f} times the mechanism's size of {linkage.size:.3g} m; check the units"
        )
    types = []
    if not open_alone.keys() - {loop}:
        types = list_closing_types(linkage.tree, linkage.frames, linkage.spec.loop, linkage.couplings, loop, start)
    if types:
        message += f"; all loops would close if loop {loop} had type {' or '.join(types)}"
    if open_alone:
        alone = ", ".join(f"{name} (miss {miss:.3g})" for name, miss in open_alone.items())
        message += f"; cannot close even alone: {alone}"
    elif len(best.largest_residuals) > 1:
        others = ", ".join(
            f"{k} {x:.3g}" for k, x in best.largest_residuals.items() if x > ROUNDED_TOLERANCE * linkage.size
        )
        message += f"; each loop closes alone, together they contradict each other ({others})"
    return f"{message}. Check the loops' frames and types, or give a [q_guess] nearer to a closed configuration"
