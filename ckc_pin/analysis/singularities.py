"""Find singular configurations by solving equations for them.

A configuration is singular if the mechanism has a velocity v although the quantities that should determine its motion
do not change:

    phi(q') = 0,    J(q') v = 0,    S(q') v = 0,    |v| = 1

- With S v = q_dot, phi_z is singular: the independent coordinates stand still and the mechanism still moves. This is
  the paper's singularity, and a parallel singularity (second kind) in the literature on parallel robots.
- With S v the velocity of a point of the mechanism, this is a serial singularity (first kind) of that point.

The equations need J, S and their derivatives along tangent velocities only. They hold for every mechanism.

The solutions form sets of dimension d - 1: points of a mechanism with one freedom, curves of one with two
(`ckc_pin.analysis.singular_curve` traces them), and surfaces of one with three. `search_singular` finds samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.closing import close_loops
from ckc_pin.kinematics.continuation import MAX_NEWTON_STEP
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose, Rate
from ckc_pin.mechanism.rank import RANK_TOLERANCE, choose_dependent, compute_rank, scale_jacobian
from ckc_pin.mechanism.spec import LoopSpec

__all__ = [
    "RESIDUAL_TOLERANCE",
    "Kind",
    "SingularPoint",
    "SingularSystem",
    "classify_solution",
    "find_singular",
    "search_singular",
]

Kind = Literal["locked", "fold", "serial", "rank loss"]

RESIDUAL_TOLERANCE = 1e-12  # m, rad and pure numbers
MIN_STEP_FRACTION = 1e-6  # of a Newton step, before the line search gives up
LEAST_SQUARES_TOLERANCE = 1e-10  # relative cutoff of singular values in a Newton step
PROBE_DISTANCE = 0.1  # rad or m; how far a locked mechanism is moved to check that q stands still
PROBE_ITERATIONS = 60
PROBE_CUTOFF = 1e-8  # relative cutoff of singular values while z closes the loops
PROBE_MARGIN = 1e-6  # scaled sigma_min(phi_z) below which the probed configuration is singular, too


@dataclass(frozen=True)
class SingularPoint:
    """A singular configuration and its properties.

    Attributes
    ----------
    at : Kinematics
        The closure's terms there; `at.q_tree` is the configuration.
    null : (n,) array
        The null velocity v of the module's docstring, |v| = 1.
    kind : "locked", "fold", "serial" or "rank loss"
        "locked": q stands still during a finite motion along v (type 1 of the paper's five-bar). "fold": two assembly
        branches meet, and q can move to one side only (its type 2). "serial": of a point. "rank loss": J itself loses
        rank, and the mechanism has more freedoms there than elsewhere.
    fold : float
        y . d^2 phi[v, v] with y the unit vector for which y^T phi_z = 0: the curvature with which two branches meet,
        zero where none do; metres or radians per unit squared. NaN for a serial point.
    rank_J, freedoms : int
        Rank of J there, and n minus that rank.
    sigma_min_J : float
        The singular value of J that decides on its rank.
    sigma_min_phi_z : float
    q_rank : int
        Rank of the q part of the admissible velocities; d where q is a chart.
    chart : tuple of str
        Coordinates that determine the configuration there, the best conditioned by a pivoted factorization.
    chart_sigma_min : float
        Smallest singular value of their phi_z.
    """

    at: Kinematics
    null: Array
    kind: Kind
    fold: float
    rank_J: int
    freedoms: int
    sigma_min_J: float
    sigma_min_phi_z: float
    q_rank: int
    chart: tuple[str, ...]
    chart_sigma_min: float


class SingularSystem:
    """Equations of singular configurations in the 2 n unknowns (q', v), see the module's docstring.

    Parameters
    ----------
    mechanism : Mechanism
    point : str, optional
        A point of the mechanism that stands still instead of q: its serial singularities.

    Raises
    ------
    InputError
        The mechanism has no such point.
    """

    def __init__(self, mechanism: Mechanism, point: str | None = None) -> None:
        self.mechanism = mechanism
        self.point = point
        self._point_closure = _point_closure(mechanism, point) if point is not None else None
        self._select_q = np.zeros((mechanism.d, mechanism.n))
        self._select_q[np.arange(mechanism.d), mechanism.partition.q] = 1.0

    def rows(self, at: Kinematics) -> Array:
        """Return [J; S], whose null vector v is, shape (rows of J + rows of S, n)."""
        if self._point_closure is None:
            return np.vstack([at.J, self._select_q])
        return np.vstack([at.J, self._point_closure.jacobian(self._point_pose(at))])

    def rows_dot(self, at: Kinematics, v: Array) -> Array:
        """Return the derivative of [J; S] along a tangent velocity, same shape."""
        if self._point_closure is None:
            return np.vstack([at.J_dot(v), np.zeros_like(self._select_q)])
        pose = self._point_pose(at)
        return np.vstack([at.J_dot(v), self._point_closure.jacobian_dot(pose, Rate(pose, v))])

    def residual(self, at: Kinematics, v: Array) -> Array:
        """Return [phi; J v; S v; (v . v - 1) / 2]."""
        return np.concatenate([at.phi, self.rows(at) @ v, [0.5 * (v @ v - 1.0)]])

    def jacobian(self, at: Kinematics, v: Array) -> Array:
        """Return the residual's derivative with respect to (q', v), with 2 n columns."""
        n, rows = self.mechanism.n, self.rows(at)
        derivative = np.column_stack([self.rows_dot(at, e) @ v for e in np.eye(n)])
        return np.block([[at.J, np.zeros_like(at.J)], [derivative, rows], [np.zeros((1, n)), v[None, :]]])

    def null_vector(self, at: Kinematics) -> Array:
        """Return the unit velocity for which |[J; S] v| is smallest, shape (n,)."""
        return np.asarray(np.linalg.svd(self.rows(at))[2][-1])

    def solve(self, at: Kinematics, v: Array, iterations: int = 60) -> tuple[Kinematics, Array, float]:
        """Solve by Gauss-Newton with minimum-norm steps and a line search.

        Returns
        -------
        at, v
            The last iterate.
        residual : float
            Its largest residual.
        """
        residual = self.residual(at, v)
        tolerance = max(RESIDUAL_TOLERANCE, self.mechanism.tolerance)
        n = self.mechanism.n
        for _ in range(iterations):
            if np.abs(residual).max() <= tolerance:
                break
            step = -np.linalg.lstsq(self.jacobian(at, v), residual, rcond=LEAST_SQUARES_TOLERANCE)[0]
            scale = min(1.0, MAX_NEWTON_STEP / np.abs(step / np.tile(at.tree.step_scale, 2)).max())
            while scale > MIN_STEP_FRACTION:
                trial_at, trial_v = at.integrate(scale * step[:n]), v + scale * step[n:]
                trial_residual = self.residual(trial_at, trial_v)
                if np.linalg.norm(trial_residual) < np.linalg.norm(residual):
                    at, v, residual = trial_at, trial_v, trial_residual
                    break
                scale /= 2
            else:
                break
        return at, v, float(np.abs(residual).max())

    def _point_pose(self, at: Kinematics) -> Pose:
        closure = self._point_closure
        if closure is None:
            raise ValueError("this system has no point")
        return Pose(self.mechanism.tree, closure.anchors, at.q_tree)


def find_singular(mechanism: Mechanism, q_start: Array | None = None, point: str | None = None) -> SingularPoint:
    """Solve for a singular configuration near a start.

    Parameters
    ----------
    mechanism : Mechanism
    q_start : (nq,) array, optional
        Pinocchio's q, with the loops closed or not; default: as assembled.
    point : str, optional
        Find a serial singularity of this point, instead of a singular phi_z.

    Raises
    ------
    InputError
        An unknown point, or a start of the wrong shape.
    NumericalError
        The solver did not converge from this start.
    """
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: without loops there is no phi_z that could be singular")
    q_start = mechanism.q_tree if q_start is None else q_start
    if q_start.shape != (mechanism.tree.nq,) or not np.all(np.isfinite(q_start)):
        raise InputError(f"q_start: expected {mechanism.tree.nq} finite numbers, got shape {q_start.shape}")
    system = SingularSystem(mechanism, point)
    start = mechanism.kinematics(q_start)
    at, v, residual = system.solve(start, system.null_vector(start))
    if residual > max(RESIDUAL_TOLERANCE, mechanism.tolerance):
        raise NumericalError(
            f"no singular configuration found from this start: the residual remains {residual:.3g}; start elsewhere",
            q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
        )
    return classify_solution(system, at, v)


def search_singular(mechanism: Mechanism, count: int, seed: int = 0, point: str | None = None) -> list[SingularPoint]:
    """Solve for singular configurations from random starts; return those that converged, in order.

    Starts are random tangent steps of up to pi (rad or m) from the assembled configuration, with the loops closed.
    """
    random = np.random.default_rng(seed)
    points = []
    for _ in range(count):
        guess = mechanism.tree.integrate(mechanism.q_tree, random.uniform(-np.pi, np.pi, mechanism.n))
        start = close_loops(mechanism.tree, mechanism.closure, guess, np.ones(mechanism.n), mechanism.tolerance)
        try:
            points.append(find_singular(mechanism, start.q_tree, point))
        except NumericalError:
            continue
    return points


def classify_solution(system: SingularSystem, at: Kinematics, v: Array) -> SingularPoint:
    """Return a solution of the equations with its kind, its ranks and a chart there."""
    mechanism = system.mechanism
    J = scale_jacobian(at.J, mechanism.tree, mechanism.closure)
    rank = compute_rank(J).rank
    admissible = np.linalg.svd(J)[2][rank:]
    q_part = np.linalg.svd(admissible[:, at.partition.q], compute_uv=False)
    fold, kind = float("nan"), "serial" if system.point is not None else _distinguish(at, v, mechanism.tolerance)
    if system.point is None:
        y = np.linalg.svd(at.phi_z, full_matrices=False)[0][:, -1]
        fold = float(y @ (at.J_dot(v) @ v))
    chart, chart_sigma_min = _best_chart(mechanism, at, J, rank)
    return SingularPoint(
        at=at,
        null=v,
        kind="rank loss" if rank < mechanism.rank else kind,
        fold=fold,
        rank_J=rank,
        freedoms=mechanism.n - rank,
        sigma_min_J=float(np.linalg.svd(at.J, compute_uv=False)[mechanism.rank - 1]),
        sigma_min_phi_z=at.sigma_min(),
        q_rank=int(np.sum(q_part > RANK_TOLERANCE)),
        chart=chart,
        chart_sigma_min=chart_sigma_min,
    )


def _best_chart(mechanism: Mechanism, at: Kinematics, J: Array, rank: int) -> tuple[tuple[str, ...], float]:
    """Return the best conditioned chart at a configuration, and the smallest singular value of its phi_z."""
    blocks = [np.arange(v, v + 6) for _, v in mechanism.tree.free_roots]
    z = choose_dependent(J, rank, blocks)
    if z is None:
        return (), 0.0
    names = tuple(mechanism.coordinates[k] for k in np.setdiff1d(np.arange(mechanism.n), z))
    return names, float(np.linalg.svd(at.J[:, z], compute_uv=False)[-1])


def _distinguish(at: Kinematics, v: Array, tolerance: float) -> Literal["locked", "fold"]:
    """Return whether a singular configuration is locked or a fold.

    The mechanism is moved a finite distance along v, and z closes the loops with q fixed. If it is locked, it closes at
    that distance, in a singular configuration again. At a fold it closes only back at the start.
    """
    z, probed = at.partition.z, at.integrate(PROBE_DISTANCE * v)
    for _ in range(PROBE_ITERATIONS):
        if np.abs(probed.phi).max() <= tolerance:
            break
        step = np.zeros(at.tree.n)
        step[z] = -np.linalg.lstsq(probed.phi_z, probed.phi, rcond=PROBE_CUTOFF)[0]
        probed = probed.integrate(step)
    displacement = at.tree.difference(at.q_tree, probed.q_tree)
    is_closed = np.abs(probed.phi).max() <= tolerance
    is_singular = probed.margin() <= PROBE_MARGIN
    return "locked" if is_closed and is_singular and v @ displacement > PROBE_DISTANCE / 2 else "fold"


def _point_closure(mechanism: Mechanism, point: str) -> Closure:
    """Return the world position of a named point as constraint rows."""
    frames = {p.name: p.frame for p in mechanism.spec.point}
    if point not in frames:
        raise InputError(f"{mechanism.name}: no point {point!r}; there are {', '.join(frames) or 'none'}")
    builder = ClosureBuilder(mechanism.tree, mechanism.frames)
    builder.add_loop(LoopSpec(name=point, type="point", frame_a=frames[point], frame_b="world", rows_in="world"))
    return builder.build()
