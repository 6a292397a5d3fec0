"""How large dh/dq of the reduced gravity vector gets (the paper's M_1), as far as a margin from singular.

h = rho^T h' is the gradient of the potential along sigma, and rho grows without bound towards a singular
configuration. So there is no M_1 over the whole non-singular workspace; there is one for each |s| >= s_min.
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
from scripts.experiments.certificate.branch_walk import Border, follow, least, margin, way
from scripts.experiments.certificate.exploration import Explored, explore

__all__ = ["Bound", "bound_along", "chart_step", "explore_branch", "gradient_bounds", "symmetric_least"]

STARTS, APART = 2, 2  # local searches start from so many points, so many steps of the lattice apart

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
        Where.
    low : float
        Least eigenvalue of the symmetric part: what K_P has to outweigh.
    low_q : (d,) array
        Where.
    points : int
        How many configurations were looked at.
    sampled : bool
        Along random rays instead of over a lattice.
    """

    margin: float
    norm: float
    norm_q: Array
    low: float
    low_q: Array
    points: int
    sampled: bool


def symmetric_least(matrix: Array) -> float:
    """Least eigenvalue of the symmetric part of a matrix."""
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


def chart_step(mechanism: Mechanism, divisions: int) -> Array:
    """Return a turn of each angle, and the mechanism's size both ways for each length, in so many parts, (d,)."""
    metres = mechanism.tree.in_metres[mechanism.partition.q]
    return np.where(metres, 2 * mechanism.size, 2 * np.pi) / divisions


def explore_branch(mechanism: Mechanism, branch: Kinematics, divisions: int) -> Explored:
    """Explore all of a branch: a turn of every angle, lengths by the mechanism's size to either side."""
    step = chart_step(mechanism, divisions)
    angles = ~mechanism.tree.in_metres[mechanism.partition.q]
    centre, reach = mechanism.independent_part(branch.q_tree), step * divisions / 2 * (1 + 1e-9)
    limit = np.where(angles, np.inf, reach) if mechanism.d <= 2 else reach

    def inside(at: Kinematics) -> float:
        return 0.0 if np.all(np.abs(mechanism.independent_part(at.q_tree) - centre) <= limit) else np.inf

    return explore(mechanism, branch, step, inside, 0.0, np.where(angles, divisions, 0))


def gradient_bounds(mechanism: Mechanism, explored: Explored, margins: Sequence[float], step: Array) -> list[Bound]:
    """Bound dh/dq on |s| >= s_min over an explored branch, for several s_min.

    Where dh/dq grows towards singularity the bound is reached on the border |s| = s_min. So besides the nodes
    inside, the points where its edges cross the border are solved for; from the most extreme of all
    these a local search goes on, along the border where it has to.

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
        Nothing on the branch is as far from singular as that.
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
    """Search on from the lowest few that lie apart from each other."""
    order = sorted(((value(mechanism, at), k) for k, at in enumerate(ats)))
    starts: list[Kinematics] = []
    for _, k in order:
        if all(np.any(np.abs(way(mechanism, ats[k], at)) > APART * step) for at in starts):
            starts.append(ats[k])
        if len(starts) == STARTS:
            break
    found = [least(mechanism, at, lambda x: value(mechanism, x), step, admit) for at in starts]
    return min(found, key=lambda at: value(mechanism, at))


def bound_along(mechanism: Mechanism, desired: Desired, times: Iterable[float]) -> Bound:
    """Bound dh/dq along a trajectory of the independent coordinates; its margin is the least |s| on the way.

    Raises
    ------
    InputError
        It leaves the branch of the assembled configuration.
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

    straight = way(mechanism, a, b)

    @cache  # both ends are asked for again
    def gap(fraction: float) -> float:
        return margin(follow(mechanism, a, fraction * straight)[0]) - s_min

    if gap(1.0) * gap(0.0) > 0:  # the neighbour was reached another way round: there is no crossing on this line
        return a if gap(0.0) > 0 else b
    return follow(mechanism, a, float(brentq(gap, 0.0, 1.0, xtol=1e-6)) * straight)[0]


def _minus_norm(mechanism: Mechanism, at: Kinematics) -> float:
    return -float(np.linalg.norm(h_gradient(mechanism, at), 2))


def _low(mechanism: Mechanism, at: Kinematics) -> float:
    return symmetric_least(h_gradient(mechanism, at))


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
