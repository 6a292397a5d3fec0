"""Check that a mechanism can follow a desired trajectory: inside its workspace and away from singularities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.desired import Desired, count_cycles
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.continuation import is_local
from ckc_pin.kinematics.extended import Task, extend_closure
from ckc_pin.kinematics.nodes import follow, nodes_at
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.batch import difference_many
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["DesiredCheck", "find_workspace_exit", "follow_desired"]

MIN_SAMPLES = 1000
SAMPLES_PER_CYCLE = 32  # of the fastest wave: linear interpolation between them has an error of 0.5 %
MAX_SAMPLES = 10_000  # some seconds of computing time
POSITION_TOLERANCE = 1e-6  # rad, m, and relative: of the position after a turn
MAX_MINIMA = 5  # local minima of the singular value that are refined
BLOCK = 32  # samples that are computed together
SAFE_FRACTION = 0.1  # of the assembled singular value: samples below it are followed one by one
BISECTIONS = 50  # to 1e-15 of a sample interval

Sample = tuple[float, float, Kinematics]  # time, smallest singular value of phi_z, configuration


@dataclass(frozen=True)
class DesiredCheck:
    """Result of following a desired trajectory.

    Attributes
    ----------
    leaves_at : float or None
        When it leaves the workspace of its assembly branch, s.
    closest_t : float
        When it is closest to a singular configuration, s; `leaves_at` if it leaves.
    sigma_min : float
        Smallest singular value of phi_z at that time; zero at the edge of the workspace.
    until : float
        Time until which it was followed, s: its end, or the time that ten thousand samples of fast waves cover.
        Infinite for a set point.
    """

    leaves_at: float | None
    closest_t: float
    sigma_min: float
    until: float = np.inf


def follow_desired(
    mechanism: Mechanism, desired: Desired, t_end: float, start: Kinematics | None = None
) -> DesiredCheck:
    """Follow sigma(q_d(t)) and find where it leaves the workspace or is closest to a singularity.

    Parameters
    ----------
    mechanism : Mechanism
    desired : Desired
    t_end : float
        s.
    start : Kinematics, optional
        A configuration of the assembly branch; default: the assembled configuration.
    """
    turn = _turn_duration(mechanism, desired)
    if turn < t_end:
        check, returns = _follow(mechanism, desired, turn, start)
        if returns or check.leaves_at is not None:
            return replace(check, until=t_end) if check.leaves_at is None else check
    return _follow(mechanism, desired, t_end, start)[0]


def _turn_duration(mechanism: Mechanism, desired: Desired) -> float:
    """Return the duration of a turn, s, of a motion with constant rates that repeats itself; infinite for any other."""
    rates = getattr(desired, "constant_rate", None)
    if rates is None or np.any(rates[mechanism.tree.in_metres[mechanism.partition.q]]):
        return np.inf
    speeds = np.unique(np.abs(rates[rates != 0.0]))
    return 2 * np.pi / float(speeds[0]) if len(speeds) == 1 else np.inf


def _follow(
    mechanism: Mechanism, desired: Desired, t_end: float, start: Kinematics | None
) -> tuple[DesiredCheck, bool]:
    """Follow a trajectory until t_end (s); also return whether the configuration at the end is that at the start."""
    samples = max(MIN_SAMPLES, int(np.ceil(SAMPLES_PER_CYCLE * min(count_cycles(desired, t_end), MAX_SAMPLES))))
    times = np.linspace(0.0, t_end, samples + 1)
    corners = np.asarray(getattr(desired, "corners", ()))  # extreme positions may be there
    if len(corners) + samples <= MAX_SAMPLES:
        times = np.union1d(times, corners[(corners > 0.0) & (corners < t_end)])
    times = times[: MAX_SAMPLES + 1]
    first = sigma(mechanism, desired(0.0)[0], start)
    if first.verdict != "converged":
        return DesiredCheck(0.0, 0.0, 0.0, 0.0), False
    path = [(0.0, first.at.sigma_min(), first.at)]
    extended = extend_closure(mechanism)
    task = Task(extended, extended.joints)
    for begin in range(1, len(times), BLOCK):
        block = times[begin : begin + BLOCK]
        samples_of_block = _move_together(task, path[-1][2], desired, block)
        if samples_of_block is not None:
            path += samples_of_block
            continue
        for t in block.tolist():
            t_at, _, at = path[-1]
            moved = _move(mechanism, at, desired, t)
            if moved is None:
                return find_workspace_exit(mechanism, desired, at, t_at, t), False
            path.append((t, moved.sigma_min(), moved))
    return _find_closest(mechanism, desired, path), _is_same_position(mechanism, path[0][2], path[-1][2])


def _move_together(task: Task, at: Kinematics, desired: Desired, times: Array) -> list[Sample] | None:
    """Move from a configuration to the samples at some times, all at once.

    Each sample is reached along the straight line in q. None means that the samples have to be followed one by one:
    one is not reached, is nearly singular, or is far from the sample before it, as on another branch.
    """
    mechanism, z = task.extended.mechanism, at.partition.z
    if not len(z) or len(task.rows) < mechanism.d:  # q of a free root has no rows
        return None
    try:
        q = np.array([desired(t)[0] for t in times.tolist()])
    except NumericalError:
        return None
    start = nodes_at(task, at.q_tree[None])[np.zeros(len(times), np.intp)]
    nodes, arrived = follow(task, start, q - start.values)
    steps = difference_many(mechanism.tree, np.vstack([at.q_tree, nodes.q_tree[:-1]]), nodes.q_tree)
    if not np.all(arrived & is_local(mechanism.tree, steps)):
        return None
    values = np.linalg.svd(nodes.J[:, task.extended.loops][:, :, z], compute_uv=False)[:, len(z) - 1]
    if not values.min() > SAFE_FRACTION * mechanism.assembled.sigma_min():
        return None
    configurations = [Kinematics(at.tree, at.closure, at.partition, q_tree) for q_tree in nodes.q_tree]
    last = _move(mechanism, configurations[-1], desired, float(times[-1]), anywhere=False)  # closed to rounding
    if last is None:
        return None
    configurations[-1] = last
    return list(zip(times.tolist(), values.tolist(), configurations, strict=True))


def _is_same_position(mechanism: Mechanism, one: Kinematics, other: Kinematics) -> bool:
    """Return whether two configurations are the same up to whole turns of their joints."""
    tree = mechanism.tree
    difference = tree.to_coordinates(other.q_tree) - tree.to_coordinates(one.q_tree)
    turns = np.where(tree.in_metres, 0.0, 2 * np.pi * np.round(difference / (2 * np.pi)))
    return bool(np.all(np.abs(difference - turns) <= POSITION_TOLERANCE * np.maximum(1.0, np.abs(difference))))


def _move(
    mechanism: Mechanism, at: Kinematics, desired: Desired, t: float, *, anywhere: bool = True
) -> Kinematics | None:
    try:
        q = desired(t)[0]
    except NumericalError:  # a point's path has no q outside the workspace
        return None
    solution = sigma(mechanism, q, at, anywhere=anywhere)
    return solution.at if solution.verdict == "converged" else None


def find_workspace_exit(
    mechanism: Mechanism, desired: Desired, at: Kinematics, inside: float, outside: float
) -> DesiredCheck:
    """Bisect for the last instant at which a trajectory is in the workspace.

    Parameters
    ----------
    mechanism : Mechanism
    desired : Desired
    at : Kinematics
        The configuration at `inside`.
    inside, outside : float
        Times in and outside the workspace, s, at most a sample apart.
    """
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        moved = _move(mechanism, at, desired, middle, anywhere=False)
        if moved is None:
            outside = middle
        else:
            inside, at = middle, moved
    return DesiredCheck(inside, inside, at.sigma_min(), inside)


def _find_closest(mechanism: Mechanism, desired: Desired, path: list[Sample]) -> DesiredCheck:
    """Refine the local minima of the singular value, where the motion may also leave the workspace for a moment."""
    values = np.array([value for _, value, _ in path])
    padded = np.concatenate([[np.inf], values, [np.inf]])
    minima = np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:]))
    smallest = minima[np.argsort(values[minima], kind="stable")][:MAX_MINIMA]
    checks = [_refine_minimum(mechanism, desired, path, int(k)) for k in smallest]
    if any(check.leaves_at is not None for check in checks):
        in_order = (_refine_minimum(mechanism, desired, path, int(k)) for k in minima)
        return next(check for check in in_order if check.leaves_at is not None)
    closest = min(checks, key=lambda check: check.sigma_min)
    return replace(closest, until=path[-1][0])


def _refine_minimum(mechanism: Mechanism, desired: Desired, path: list[Sample], k: int) -> DesiredCheck:
    """Minimize the singular value between a sample's two neighbours."""
    from scipy.optimize import minimize_scalar

    (t, value, at), neighbours = path[k], path[max(k - 1, 0) : k + 2]
    outside: list[float] = []

    def singular_value(time: float) -> float:
        moved = _move(mechanism, at, desired, time, anywhere=False)
        if moved is None:
            outside.append(time)
        return 0.0 if moved is None else moved.sigma_min()

    bounds = (neighbours[0][0], neighbours[-1][0])
    minimum = minimize_scalar(singular_value, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    if outside:
        before = [sample for sample in neighbours if sample[0] < min(outside)][-1]
        return find_workspace_exit(mechanism, desired, before[2], before[0], min(outside))
    value, t = min((value, t), (float(minimum.fun), float(minimum.x)))
    return DesiredCheck(None, t, value)
