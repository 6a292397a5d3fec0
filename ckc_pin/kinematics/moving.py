"""Move a mechanism by hand: one coordinate to a value, or a point towards a target, with all loops closed.

A movement follows the constraint manifold by continuation (`follow`) from the present configuration. It ends early at
a stop, where phi_z becomes singular, or where nothing comes nearer to the target, and says which of these it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.kinematics.continuation import follow, same_branch
from ckc_pin.kinematics.sigma import newton, predict
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.mechanism.pose import Anchors, Pose

__all__ = ["Movement", "drag_point", "move_coordinate", "move_independent"]

MAX_STEP = 0.25  # rad, or mechanism sizes, of any coordinate: longest tangent step
MIN_PIECE = 1e-7  # of a tangent step to the value of a coordinate
MIN_DRAG_PIECE = 1e-2  # of any other tangent step
MAX_SHORTENINGS = 8  # of a tangent step that does not come nearer
SINGULAR_MARGIN = 1e-7  # of `Kinematics.margin`: a movement ends before phi_z is nearer to singular
NEARLY_SINGULAR_MARGIN = 3e-3  # where a movement that ends is said to end at a singular configuration
STOP_TOLERANCE = 1e-9  # rad, or mechanism sizes: a coordinate this close is at its stop
REACHED_TOLERANCE = 1e-12  # rad, or mechanism sizes: distance from the value of a coordinate
POINT_TOLERANCE = 1e-9  # mechanism sizes: distance of a point from its target
DRAG_MARGIN = 1e-3  # of `Kinematics.margin`: a drag does not come nearer to singular
DIFFERENCE_STEP = 1e-6  # rad, or mechanism sizes
DAMPING = 1e-6  # of the largest squared singular value of the point's Jacobian
MIN_PROGRESS = 1e-8  # relative decrease of the distance below which a drag has reached its end
MIN_RATE = 1e-9  # relative rate below which a tangent vector does not move a coordinate
SINGULAR = "phi_z is singular there"


@dataclass(frozen=True)
class Movement:
    """Outcome of a movement.

    Attributes
    ----------
    at : Kinematics
        The configuration that was reached.
    reached : bool
        Whether it is the target.
    end : str
        Why the movement cannot go on, in words; "" if the target was reached, or after the last permitted step.
    """

    at: Kinematics
    reached: bool
    end: str = ""


def move_coordinate(mechanism: Mechanism, at: Kinematics, name: str, value: float, max_steps: int = 100) -> Movement:
    """Move one coordinate of the tree to a value, on the present assembly branch and within the stops of all joints.

    The other independent coordinates stay where they are if the coordinate is independent. Otherwise all of them take
    the shortest way.

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics
        A closed configuration.
    name : str
        A coordinate of the tree.
    value : float
        rad or m.
    max_steps : int
        Most tangent steps; after these the movement has neither reached its target nor ended.

    Returns
    -------
    Movement

    Raises
    ------
    MechanismError
        The mechanism has no such coordinate.
    """
    tree = mechanism.tree
    k = int(tree.indices((name,), "coordinate")[0])
    if name in mechanism.prescribed:
        return Movement(at, False, f"the motion of {name} is prescribed")
    if k in mechanism.partition.q and not mechanism.splits_root:
        return move_independent(mechanism, at, {name: value}, max_steps)
    clipped = float(np.clip(value, mechanism.joints.lower[k], mechanism.joints.upper[k]))
    movement = _approach(
        mechanism,
        at,
        lambda x: np.array([clipped - tree.to_coordinates(x.q_tree)[k]]),
        lambda x: _coordinate_rate(x, k),
        REACHED_TOLERANCE * float(tree.step_scale[k]),
        max_steps,
        SINGULAR_MARGIN,
        f"{name} cannot go any further on this branch",
    )
    if movement.reached and clipped != value:
        return Movement(movement.at, False, _describe_stop(mechanism, k, clipped < value))
    return movement


def move_independent(
    mechanism: Mechanism, at: Kinematics, values: Mapping[str, float], max_steps: int = 100
) -> Movement:
    """Move independent coordinates to values, on a straight line in q; see `move_coordinate`.

    Raises
    ------
    InputError
        A coordinate is not independent.
    """
    mechanism.vector(values, mechanism.independent, "q", fill=0.0)
    if mechanism.splits_root:
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    tree, joints = mechanism.tree, mechanism.joints
    ks = [tree.index[name] for name in values]
    clipped = np.clip(list(values.values()), joints.lower[ks], joints.upper[ks])

    def remaining(configuration: Kinematics) -> Array:
        numbers = tree.to_coordinates(configuration.q_tree)
        numbers[ks] = clipped
        return tree.difference(configuration.q_tree, tree.from_coordinates(numbers))

    movement = _follow_q(mechanism, at, remaining, max_steps)
    beyond = [k for k, value, stop in zip(ks, values.values(), clipped, strict=True) if value != stop]
    if movement.reached and beyond:
        k = beyond[0]
        return Movement(
            movement.at, False, _describe_stop(mechanism, k, values[mechanism.coordinates[k]] > joints.upper[k])
        )
    return movement


def drag_point(
    mechanism: Mechanism,
    at: Kinematics,
    joint: int,
    point: Array,
    target: Array,
    normal: Array | None = None,
    max_steps: int = 4,
) -> Movement:
    """Move a point of a body as near to a target as the loops and stops permit, on the present assembly branch.

    Each step is a damped Gauss-Newton step in the tangent space of the constraint manifold, in which angles and lengths
    count alike (`Tree.step_scale`). Coordinates at their stops do not move outwards.

    Parameters
    ----------
    mechanism : Mechanism
    at : Kinematics
        A closed configuration.
    joint : int
        Number of the joint that moves the body.
    point : (3,) array
        Position in the body's axes, m.
    target : (3,) array
        Position in the world, m.
    normal : (3,) array, optional
        Direction in the world in which the distance does not count, as that of view.
    max_steps : int
        Most tangent steps; after these the movement has neither reached its target nor ended.

    Returns
    -------
    Movement
    """
    tree = mechanism.tree
    ends = Anchors(np.array([joint], dtype=np.intp), point.reshape(1, 3), np.zeros(0, np.intp), np.zeros((0, 3)))
    projection = np.eye(3)
    if normal is not None:
        unit = normal / max(float(np.linalg.norm(normal)), 1e-300)
        projection -= np.outer(unit, unit)

    def offset(configuration: Kinematics) -> Array:
        pose = Pose(tree, ends, configuration.q_tree)
        return np.asarray(projection @ (target - pose.rotation[joint] @ point - pose.translation[joint]))

    def jacobian(configuration: Kinematics) -> Array:
        return np.asarray(projection @ Pose(tree, ends, configuration.q_tree).p_jacobian[0])

    tolerance = POINT_TOLERANCE * mechanism.size
    return _approach(mechanism, at, offset, jacobian, tolerance, max_steps, DRAG_MARGIN, "the point cannot come nearer")


# --- the two ways to move ------------------------------------------------------------------------


def _follow_q(
    mechanism: Mechanism, at: Kinematics, remaining: Callable[[Kinematics], Array], max_steps: int
) -> Movement:
    """Follow the straight line in q to a target; `remaining` returns the tangent vector (n,) to it."""
    q, tree = mechanism.partition.q, mechanism.tree
    for _ in range(max_steps + 1):
        dq = remaining(at)[q]
        if np.all(np.abs(dq) <= REACHED_TOLERANCE * tree.step_scale[q]):
            return Movement(at, True)
        step = np.asarray(at.rho @ dq)
        longest = float(tree.step_size(step))
        at, done, end = _take_step(mechanism, at, step * min(1.0, MAX_STEP / longest), SINGULAR_MARGIN, to_its_end=True)
        if done < 1.0:
            return Movement(at, False, end)
    return Movement(at, False)


def _approach(
    mechanism: Mechanism,
    at: Kinematics,
    offset: Callable[[Kinematics], Array],
    jacobian: Callable[[Kinematics], Array],
    tolerance: float,
    max_steps: int,
    min_margin: float,
    turning_point: str,
) -> Movement:
    """Reduce a remaining distance by damped Gauss-Newton steps in the tangent space of the constraint manifold.

    Parameters
    ----------
    offset : callable
        Returns the remaining distance (k,) at a configuration.
    jacobian : callable
        Returns the derivative of what shall cover that distance with respect to the tangent coordinates, (k, n).
    min_margin : float
        Of `Kinematics.margin`: how near to singular phi_z may come.
    turning_point : str
        The reason if no direction comes nearer.
    """
    miss = offset(at)
    for _ in range(max_steps):
        if np.linalg.norm(miss) <= tolerance:
            return Movement(at, True)
        if not mechanism.d:
            return Movement(at, False, "the loops leave no freedom (d = 0)")
        step, blocked = _damped_step(mechanism, at, jacobian(at), miss)
        trial, closer, end = _search_line(mechanism, at, step, offset, miss, min_margin)
        slides = end == SINGULAR and trial is at
        if slides:  # along the singular configurations
            step, blocked = _damped_step(mechanism, at, jacobian(at), miss, 2.0 * min_margin)
            trial, closer, _ = _search_line(mechanism, at, step, offset, miss, min_margin)
        progress = _relative_progress(miss, closer)
        at, miss = trial, closer
        if progress < MIN_PROGRESS and np.linalg.norm(miss) > tolerance:
            return Movement(at, False, end or blocked or turning_point)
        if slides:  # Such a step takes as long as the others together.
            break
    return Movement(at, bool(np.linalg.norm(miss) <= tolerance))


def _relative_progress(before: Array, after: Array) -> float:
    return 1.0 - float(np.linalg.norm(after)) / float(np.linalg.norm(before))


def _search_line(
    mechanism: Mechanism,
    at: Kinematics,
    step: Array,
    offset: Callable[[Kinematics], Array],
    miss: Array,
    min_margin: float,
) -> tuple[Kinematics, Array, str]:
    """Take a tangent step, shortened until the remaining distance decreases; return where it leads and why it ended."""
    longest = float(mechanism.tree.step_size(step)) if np.any(step) else 0.0
    step = step * min(1.0, MAX_STEP / longest) if longest > 0.0 else step
    step = step * _fraction_to_stops(mechanism, at, step)
    for _ in range(MAX_SHORTENINGS if longest > 0.0 else 0):
        trial, done, end = _take_step(mechanism, at, step, min_margin, to_its_end=False)
        closer = offset(trial)
        if np.linalg.norm(closer) < np.linalg.norm(miss) or (done < 1.0 and trial is at):
            return trial, closer, end
        step = 0.25 * step  # the manifold bends away
    return at, miss, ""


def _fraction_to_stops(mechanism: Mechanism, at: Kinematics, step: Array) -> float:
    """Return the fraction of a tangent step at which the first coordinate reaches its stop, to first order."""
    joints, numbers = mechanism.joints, mechanism.tree.to_coordinates(at.q_tree)
    distances = np.where(step > 0.0, joints.upper - numbers, numbers - joints.lower)
    moves = np.isfinite(distances) & (distances > STOP_TOLERANCE * mechanism.tree.step_scale) & (step != 0.0)
    return float(np.min(distances[moves] / np.abs(step[moves]), initial=1.0))


# --- tangent steps -------------------------------------------------------------------------------


def _damped_step(
    mechanism: Mechanism, at: Kinematics, jacobian: Array, miss: Array, margin: float | None = None
) -> tuple[Array, str]:
    """Return the tangent step that reduces a distance, and the stops that block it in words.

    Coordinates at their stops do not move outwards. With `margin` the step leads to this value of `Kinematics.margin`,
    to first order, if the present one is smaller, and does not decrease it otherwise.
    """
    tree, joints = mechanism.tree, mechanism.joints
    basis = _tangent_basis(at)
    scaled = basis / tree.step_scale[:, np.newaxis]
    numbers, tolerance = tree.to_coordinates(at.q_tree), STOP_TOLERANCE * tree.step_scale
    at_lower, at_upper = numbers <= joints.lower + tolerance, numbers >= joints.upper - tolerance
    rows, values = np.zeros((0, basis.shape[1])), np.zeros(0)
    if margin is not None:
        rows, values = _margin_slopes(at, basis)[np.newaxis], np.array([max(0.0, margin - at.margin())])
    blocked: list[int] = []
    while True:
        restoring, tangents = _solve_rows(rows, values)
        free = basis @ tangents
        slope = jacobian @ free
        gram = slope.T @ slope
        damping = DAMPING * max(float(np.trace(gram)), 1e-300)
        remaining = miss - jacobian @ (basis @ restoring)
        step = basis @ restoring + free @ np.linalg.solve(gram + damping * np.eye(len(gram)), slope.T @ remaining)
        outwards = (at_lower & (step < -tolerance)) | (at_upper & (step > tolerance))
        outwards[blocked] = False
        if not outwards.any():
            return np.asarray(step), "; ".join(_describe_stop(mechanism, k, bool(at_upper[k])) for k in blocked)
        blocked.append(int(np.argmax(np.where(outwards, np.abs(step) / tree.step_scale, 0.0))))
        rows, values = np.vstack([rows, scaled[blocked[-1]]]), np.append(values, 0.0)


def _solve_rows(rows: Array, values: Array) -> tuple[Array, Array]:
    """Return the minimum-norm y of rows y = values, and the vectors that the rows map to zero as columns."""
    u, singular, v = np.linalg.svd(rows)
    rank = int(np.sum(singular > MIN_RATE * max(1.0, singular.max(initial=0.0))))
    return np.asarray(v[:rank].T @ ((u.T @ values)[:rank] / singular[:rank])), np.asarray(v[rank:].T)


def _tangent_basis(at: Kinematics) -> Array:
    """Return tangent vectors of the manifold, shape (n, d), orthonormal after division by `Tree.step_scale`."""
    scale = at.tree.step_scale[:, np.newaxis]
    rho = at.rho / scale
    return np.asarray(scale * np.linalg.qr(rho / np.maximum(np.linalg.norm(rho, axis=0), 1e-300))[0])


def _coordinate_rate(at: Kinematics, k: int) -> Array:
    """Return the derivative of a coordinate's number with respect to the tangent coordinates, (1, n)."""
    tree = at.tree
    if tree.coordinates[k] not in tree.free_coordinates:
        return np.eye(tree.n)[[k]]
    numbers = tree.to_coordinates(at.q_tree)  # position and rotation vector of a free root, by differences
    h = DIFFERENCE_STEP * tree.step_scale
    return np.array(
        [
            [
                (tree.to_coordinates(tree.integrate(at.q_tree, h * unit))[k] - numbers[k]) / h[i]
                for i, unit in enumerate(np.eye(tree.n))
            ]
        ]
    )


def _margin_slopes(at: Kinematics, basis: Array) -> Array:
    """Return the derivatives of `Kinematics.margin` along tangent vectors, shape (d,), by differences."""
    margin = at.margin()
    slopes = [(at.integrate(DIFFERENCE_STEP * column).margin() - margin) / DIFFERENCE_STEP for column in basis.T]
    return np.array(slopes)


def _take_step(
    mechanism: Mechanism, at: Kinematics, step: Array, min_margin: float, *, to_its_end: bool
) -> tuple[Kinematics, float, str]:
    """Follow a tangent step; return the last configuration, the fraction that was followed, and why it ended.

    Parameters
    ----------
    min_margin : float
        Of `Kinematics.margin`: how near to singular phi_z may come.
    to_its_end : bool
        Follow the step up to where it cannot be followed any further. Otherwise the longest of its halves, quarters and
        so on that can be followed at once is taken, which costs a tenth and is enough if other steps follow.
    """
    dq, joints, tree = step[mechanism.partition.q], mechanism.joints, mechanism.tree
    start = tree.to_coordinates(at.q_tree)
    lower, upper = np.minimum(joints.lower, start), np.maximum(joints.upper, start)
    tolerance = STOP_TOLERANCE * tree.step_scale
    end = ""

    def advance(present: Kinematics, _: float, part: float) -> Kinematics | None:
        nonlocal end
        end = SINGULAR
        trial = newton(predict(present, part * dq), 0.0, mechanism.tolerance)
        if (
            not trial.converged
            or not same_branch(present, trial.at)
            or trial.at.margin() < min(min_margin, 0.999 * present.margin())
        ):
            return None
        numbers = tree.to_coordinates(trial.at.q_tree)
        beyond = np.flatnonzero((numbers < lower - tolerance) | (numbers > upper + tolerance))
        if len(beyond):
            end = _describe_stop(mechanism, int(beyond[0]), bool(numbers[beyond[0]] > upper[beyond[0]]))
            return None
        return trial.at

    if to_its_end:
        reached, done = follow(at, advance, MIN_PIECE)
    else:
        reached, done, part = at, 0.0, 1.0
        while done == 0.0 and part >= MIN_DRAG_PIECE:
            trial = advance(at, 0.0, part)
            reached, done, part = (at, 0.0, 0.5 * part) if trial is None else (trial, part, part)
    if done < 1.0 and end == SINGULAR and reached.margin() > NEARLY_SINGULAR_MARGIN:
        end = "the loops cannot be kept closed any further"
    return reached, done, end if done < 1.0 else ""


# --- words ---------------------------------------------------------------------------------------


def _describe_stop(mechanism: Mechanism, k: int, is_upper: bool) -> str:
    stop = (mechanism.joints.upper if is_upper else mechanism.joints.lower)[k]
    unit = mechanism.tree.units()[k]
    return f"{mechanism.coordinates[k]} is at its {'upper' if is_upper else 'lower'} stop, {stop:.4g} {unit}"
