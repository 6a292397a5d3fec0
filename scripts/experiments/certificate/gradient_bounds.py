"""Bounds on dh/dq of the reduced gravity vector (the paper's M_1) at a margin from singular configurations.

h = rho^T h' is the gradient of the potential along sigma, and rho is unbounded near singular configurations. There is
therefore no M_1 over the whole non-singular workspace, but one for each |s| >= s_min.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.desired import Desired
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.errors import InputError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.certificate.branch_walk import Border, find_minimum, follow, margin, wrapped_difference
from scripts.experiments.certificate.exploration import Explored, explore

__all__ = ["Bound", "bound_along", "chart_step", "explore_branch", "gradient_bounds", "min_symmetric_eigenvalue"]

STARTS = 2  # of local searches
MIN_START_DISTANCE = 2  # between them, steps of the lattice

Value = Callable[[Mechanism, Kinematics], float]


@dataclass(frozen=True)
class Bound:
    """The largest dh/dq where |s| >= margin.

    Attributes
    ----------
    margin : float
        s_min, see `scripts.experiments.certificate.branch_walk.margin`.
    norm : float
        Largest spectral norm |dh/dq|, the paper's M_1: N m/rad between angles.
    norm_q : (d,) array
        The configuration.
    low : float
        Smallest eigenvalue of the symmetric part, which K_P has to outweigh.
    low_q : (d,) array
        The configuration.
    points : int
        Number of configurations evaluated.
    sampled : bool
        Whether random rays were followed instead of a lattice.
    """

    margin: float
    norm: float
    norm_q: Array
    low: float
    low_q: Array
    points: int
    sampled: bool


def min_symmetric_eigenvalue(matrix: Array) -> float:
    """Return the smallest eigenvalue of the symmetric part of a matrix."""
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


def chart_step(mechanism: Mechanism, divisions: int) -> Array:
    """Return the step (d,) of a lattice over a full turn of angles, and twice the mechanism's size for lengths."""
    metres = mechanism.tree.in_metres[mechanism.partition.q]
    return np.where(metres, 2 * mechanism.size, 2 * np.pi) / divisions


def explore_branch(mechanism: Mechanism, branch: Kinematics, divisions: int) -> Explored:
    """Explore a whole branch: a full turn of every angle, lengths by the mechanism's size to both sides."""
    step = chart_step(mechanism, divisions)
    angles = ~mechanism.tree.in_metres[mechanism.partition.q]
    centre, reach = mechanism.independent_part(branch.q_tree), step * divisions / 2 * (1 + 1e-9)
    limit = np.where(angles, np.inf, reach) if mechanism.d <= 2 else reach

    def inside(at: Kinematics) -> float:
        return 0.0 if np.all(np.abs(mechanism.independent_part(at.q_tree) - centre) <= limit) else np.inf

    return explore(mechanism, branch, step, inside, 0.0, np.where(angles, divisions, 0))


def gradient_bounds(mechanism: Mechanism, explored: Explored, margins: Sequence[float], step: Array) -> list[Bound]:
    """Bound dh/dq on |s| >= s_min over an explored branch, for several s_min.

    If dh/dq grows towards a singular configuration, the bound is attained on the border |s| = s_min. Besides the nodes
    inside, the points where edges cross the border are therefore computed. Local searches continue from the most
    extreme points, along the border if necessary.

    Parameters
    ----------
    mechanism : Mechanism
    explored : Explored
        From `explore_branch`.
    margins : sequence of float
        s_min, each in (0, 1).
    step : (d,) array
        That of the exploration.

    Raises
    ------
    InputError
        No configuration on the branch has that margin.
    """
    volumes = [margin(at) for at in explored.nodes]
    edges = [(i, explored.nodes[j], volumes[j]) for i, j in explored.edges]
    edges += [(end.node, end.at, margin(end.at)) for end in explored.ends]
    bounds = []
    for s_min in margins:
        ats = [at for at, volume in zip(explored.nodes, volumes, strict=True) if volume >= s_min]
        ats += [
            _crossing(mechanism, explored.nodes[i], there, s_min)
            for i, there, volume in edges
            if (volumes[i] - s_min) * (volume - s_min) < 0
        ]
        if not ats:
            raise InputError(f"{mechanism.name}: no configuration found with |s| >= {s_min:g}")
        admit = Border(mechanism, s_min)
        norm, low = (_extreme(mechanism, ats, value, step, admit) for value in (_minus_norm, _low))
        bounds.append(_bound(mechanism, s_min, norm, low, len(ats), explored.sampled))
    return bounds


def _extreme(mechanism: Mechanism, ats: list[Kinematics], value: Value, step: Array, admit: Border) -> Kinematics:
    """Minimize a value from the lowest points that are not close to each other."""
    order = sorted(((value(mechanism, at), k) for k, at in enumerate(ats)))
    starts: list[Kinematics] = []
    for _, k in order:
        if all(np.any(np.abs(wrapped_difference(mechanism, ats[k], at)) > MIN_START_DISTANCE * step) for at in starts):
            starts.append(ats[k])
        if len(starts) == STARTS:
            break
    minima = [find_minimum(mechanism, at, lambda x: value(mechanism, x), step, admit) for at in starts]
    return min(minima, key=lambda at: value(mechanism, at))


def bound_along(mechanism: Mechanism, desired: Desired, times: Iterable[float]) -> Bound:
    """Bound dh/dq along a trajectory of the independent coordinates; its margin is the smallest |s| on it.

    Raises
    ------
    InputError
        The trajectory leaves the branch of the assembled configuration.
    """
    ats, at = [], mechanism.assembled
    for t in times:
        at, reached = follow(mechanism, at, desired(t)[0] - mechanism.independent_part(at.q_tree))
        if reached < 1.0:
            raise InputError(f"the trajectory leaves the branch before t = {t:g} s")
        ats.append(at)
    norm, low = min(ats, key=lambda at: _minus_norm(mechanism, at)), min(ats, key=lambda at: _low(mechanism, at))
    return _bound(mechanism, min(margin(at) for at in ats), norm, low, len(ats), sampled=False)


def _crossing(mechanism: Mechanism, a: Kinematics, b: Kinematics, s_min: float) -> Kinematics:
    """Solve for |s| = s_min on the straight line between two neighbours."""
    from scipy.optimize import brentq

    straight = wrapped_difference(mechanism, a, b)

    @cache  # both ends are evaluated twice
    def gap(fraction: float) -> float:
        return margin(follow(mechanism, a, fraction * straight)[0]) - s_min

    if gap(1.0) * gap(0.0) > 0:  # the neighbour was reached by another route, so this line has no crossing
        return a if gap(0.0) > 0 else b
    return follow(mechanism, a, float(brentq(gap, 0.0, 1.0, xtol=1e-6)) * straight)[0]


def _minus_norm(mechanism: Mechanism, at: Kinematics) -> float:
    return -float(np.linalg.norm(h_gradient(mechanism, at), 2))


def _low(mechanism: Mechanism, at: Kinematics) -> float:
    return min_symmetric_eigenvalue(h_gradient(mechanism, at))


def _bound(mechanism: Mechanism, s_min: float, norm: Kinematics, low: Kinematics, points: int, sampled: bool) -> Bound:
    return Bound(
        margin=s_min,
        norm=-_minus_norm(mechanism, norm),
        norm_q=mechanism.independent_part(norm.q_tree),
        low=_low(mechanism, low),
        low_q=mechanism.independent_part(low.q_tree),
        points=points,
        sampled=sampled,
    )
