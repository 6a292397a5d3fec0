"""Assembly: a closed configuration near a guess, and the `Mechanism` that is split into q and z there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.errors import MechanismError
from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.linkage import Linkage
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import Overrides
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import count_freedoms
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.mechanism.tree import Tree

__all__ = ["Assembly", "assemble_mechanism", "close_loops"]

RESTARTS = 20
EXACT = 1e-10  # |phi| in units of the mechanism's size that a closed mechanism of exact data reaches
ROUNDED = 1e-5  # the same when the numbers in the files are rounded to six digits: 2.35619 rad is 5e-6 off
PERTURBATION = 0.02  # rad, or of the mechanism's size: how far along the tangent a singular start is looked at
PERTURBATIONS = 2


@dataclass(frozen=True)
class Assembly:
    """The best configuration found, and what is left of phi there."""

    q_tree: Array
    residual: float
    largest_residuals: dict[str, float]


def close_loops(
    tree: Tree,
    closure: Closure,
    q_tree: Array,
    free: Array,
    tolerance: float,
    restarts: int = RESTARTS,
    within: tuple[Array, Array] | None = None,
    rounded: float = 0.0,
) -> Assembly:
    """Close the loops from a guess by damped Gauss-Newton, moving as little as it takes.

    Parameters
    ----------
    tree, closure : Tree, Closure
    q_tree : (nq,) array
        The guess.
    free : (n,) array of 0 or 1
        Coordinates that may move. All others keep their guess.
    tolerance : float
        Largest |phi| that counts as closed.
    restarts : int
        How many perturbed starts to try when the guess itself does not lead there.
    within : pair of (n,) arrays, or None
        Bounds of the coordinates. What one is beyond them counts as open too, in its own unit.
    rounded : float
        What |phi| may be in the end where rows contradict each other so far: no other start is looked for then, which
        would end at another configuration for the sake of a miss that is a little less.

    Returns
    -------
    Assembly
        From the guess itself when that closes; otherwise the first of some perturbed restarts that does, or the best.
    """

    def at(q: Array) -> tuple[Array, Callable[[], Array]]:
        pose = Pose(tree, closure.anchors, q)
        phi = closure.phi(pose)
        if within is None:
            return phi, lambda: closure.jacobian(pose) * free
        numbers = tree.to_coordinates(q)
        beyond = numbers - np.clip(numbers, *within)
        rows = np.eye(tree.n)[beyond != 0]
        return np.concatenate([phi, beyond[beyond != 0]]), lambda: np.vstack([closure.jacobian(pose), rows]) * free

    def outcome(start: Array) -> tuple[Assembly, bool]:
        """Where a start leads, and whether that is closed as far as the numbers allow."""
        q = _gauss_newton(tree, start, at, tolerance)
        phi, _ = at(q)
        open_, beyond = (float(np.abs(part).max(initial=0.0)) for part in np.split(phi, [closure.rows]))
        found = Assembly(q, max(open_, beyond), closure.largest_residuals(phi[: closure.rows]))
        return found, open_ <= max(tolerance, rounded) and beyond <= tolerance

    random = np.random.default_rng(0)  # the same answer every time
    best, closed = outcome(q_tree)
    for attempt in range(restarts):
        if closed:
            break
        spread = 0.1 * 1.4**attempt
        trial, closed = outcome(
            tree.integrate(q_tree, free * tree.step_scale * random.uniform(-spread, spread, tree.n))
        )
        if closed or trial.residual < best.residual:
            best = trial
    return best


def _gauss_newton(
    tree: Tree, q: Array, at: Callable[[Array], tuple[Array, Callable[[], Array]]], tolerance: float
) -> Array:
    """Minimum-norm steps, shortened until |phi| falls; ends at a solution or a stationary point."""
    phi, jacobian = at(q)
    for _ in range(100):
        if np.abs(phi).max(initial=0.0) <= 1e-3 * tolerance:
            break
        part: Array = -np.asarray(np.linalg.lstsq(jacobian() * tree.step_scale, phi, rcond=1e-6)[0], dtype=float)
        longest, step = float(np.abs(part).max(initial=0.0)), part * tree.step_scale
        scale = min(1.0, 0.5 / longest) if longest > 0 else 0.0
        while scale > 1e-6:
            trial = tree.integrate(q, scale * step)
            phi_trial, jacobian_trial = at(trial)
            if np.linalg.norm(phi_trial) < (1 - 1e-4 * scale) * np.linalg.norm(phi):
                q, phi, jacobian = trial, phi_trial, jacobian_trial
                break
            scale /= 2
        else:
            break
    return q


def assemble_mechanism(spec: MechanismSpec, sources: Sources, overrides: Overrides | None = None) -> Mechanism:
    """Assemble a mechanism from what its files say, with numbers changed by name.

    Raises
    ------
    MechanismError
        Unknown names, loops that cannot be closed from q_guess, coordinates that cannot serve as q.
    """
    linkage = Linkage(spec, sources, overrides)
    tree, closure, size = linkage.tree, linkage.closure, linkage.size
    with one_blas_thread():
        guess = tree.vector(spec.q_guess, tree.coordinates, "q_guess", fill=0.0)
        closed = _close(linkage, tree.from_coordinates(guess))
        lengths = bool(np.all(closure.in_metres(tree)))
        rounding = 1e-13 * (size if lengths else max(size, 1.0))
        tolerance = rounding if closed.residual <= EXACT * size else 10 * closed.residual
        accept = max(tolerance, rounding)

        def nearby(tangent: Array) -> list[Array]:
            return _nearby(tree, closure, closed.q_tree, tangent, accept)

        freedoms = count_freedoms(tree, closure, closed.q_tree, nearby)
        return Mechanism(linkage, closed.q_tree, closed.residual, tolerance, freedoms)


def _nearby(tree: Tree, closure: Closure, q_tree: Array, tangent: Array, accept: float) -> list[Array]:
    """Closed configurations a small step along the tangent space, where there are any."""
    random = np.random.default_rng(0)
    found = []
    for _ in range(PERTURBATIONS if len(tangent) else 0):
        step = random.uniform(-1.0, 1.0, len(tangent)) @ tangent
        step *= PERTURBATION / np.abs(step).max() * tree.step_scale
        closed = close_loops(tree, closure, tree.integrate(q_tree, step), np.ones(tree.n), accept, restarts=0)
        if closed.residual <= 10 * accept:
            found.append(closed.q_tree)
    return found


def _close(linkage: Linkage, start: Array) -> Assembly:
    """Assemble near a guess, within the joints' stops where that can be."""
    scale = linkage.size
    closed = _nearest(linkage, start)
    if closed.residual > ROUNDED * scale:
        raise MechanismError(f"{linkage.sources.name}: {_why_not_closed(linkage, closed, start)}")
    reversed_ = linkage.closure.reversed_hinges(Pose(linkage.tree, linkage.closure.anchors, closed.q_tree))
    if reversed_:
        raise MechanismError(
            f"{linkage.sources.name}: loop {reversed_[0]!r} closes with its axes against each other (a . b < 0); "
            "turn axis_b around, or give a [q_guess] on the other branch"
        )
    closed = _within_stops(linkage, closed)
    if closed.residual > EXACT * scale:
        linkage.warnings.append(
            f"the loops close to {closed.residual:.2g} only, not to rounding: "
            "numbers in the files are rounded, or redundant rows contradict each other slightly"
        )
    return closed


def _nearest(linkage: Linkage, start: Array, within: tuple[Array, Array] | None = None) -> Assembly:
    """Assemble with the independent coordinates held at their guess; if that fails, with all free."""
    closed: Assembly | None = None
    tree, exact, rounded = linkage.tree, EXACT * linkage.size, ROUNDED * linkage.size
    if linkage.spec.independent is not None:
        free = np.ones(tree.n)
        free[tree.indices(tuple(linkage.spec.independent), "independent")] = 0.0
        closed = close_loops(tree, linkage.closure, start, free, exact, within=within, rounded=rounded)
    if closed is None or closed.residual > rounded:
        closed = close_loops(tree, linkage.closure, start, np.ones(tree.n), exact, within=within, rounded=rounded)
    return closed


def _within_stops(linkage: Linkage, closed: Assembly) -> Assembly:
    """Go from a configuration beyond stops, where no run can start, to one within them near it, if there is one."""
    tree, joints = linkage.tree, linkage.joints
    numbers = tree.to_coordinates(closed.q_tree)
    beyond = np.abs(numbers - np.clip(numbers, joints.lower, joints.upper)) > EXACT * tree.step_scale
    if not np.any(beyond):
        return closed
    inside = _nearest(linkage, closed.q_tree, (joints.lower, joints.upper))
    pose = Pose(tree, linkage.closure.anchors, inside.q_tree)
    if inside.residual > ROUNDED * linkage.size or linkage.closure.reversed_hinges(pose):
        return closed
    there = tree.to_coordinates(inside.q_tree)
    moved = [f"{tree.coordinates[k]} = {there[k]:.4g} (without them {numbers[k]:.4g})" for k in np.flatnonzero(beyond)]
    linkage.warnings.append(f"q_guess leads beyond joints' stops; assembled within them: {', '.join(moved)}")
    return inside


def _why_not_closed(linkage: Linkage, best: Assembly, start: Array) -> str:
    """Name the loop with the largest miss, loops that cannot close even alone, and what to do."""
    loop, miss = max(best.largest_residuals.items(), key=lambda item: item[1])
    message = f"not closed: nearest miss {miss:.3g} m at loop {loop}"
    if miss > 1000 * linkage.size:
        return f"{message}, {miss / linkage.size:.0f} times the mechanism's size of {linkage.size:.3g} m: units?"
    alone = []
    for name in dict.fromkeys(name for name, _ in linkage.closure.names):
        single = linkage.closure.select_loop(name)
        closed = close_loops(linkage.tree, single, start, np.ones(linkage.tree.n), EXACT * linkage.size)
        if closed.residual > ROUNDED * linkage.size:
            alone.append(f"{name} (miss {closed.residual:.3g})")
    if alone:
        message += f"; cannot close even alone: {', '.join(alone)}"
    elif len(best.largest_residuals) > 1:
        others = ", ".join(f"{k} {x:.3g}" for k, x in best.largest_residuals.items() if x > ROUNDED * linkage.size)
        message += f"; each loop closes alone, together they contradict each other ({others})"
    return f"{message}. Check the loops' frames and types, or give a [q_guess] nearer to a closed configuration"
