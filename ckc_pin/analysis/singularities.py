"""Singular configurations, found by solving for them.

A configuration is singular when the mechanism has a velocity v that keeps still what should determine it:

    phi(q') = 0,    J(q') v = 0,    S(q') v = 0,    |v| = 1

With S v = q_dot that is a singular phi_z, what the paper calls singular and the literature on parallel robots
a parallel singularity (second kind): the independent coordinates stand still and the mechanism still moves.
With S v the velocity of one of the mechanism's points it is a serial singularity (first kind) of that point.
Nothing here knows the five-bar: J, S and their derivatives along tangent velocities are all there is.

These are d - 1 dimensional sets: points of a mechanism of one freedom, curves of one of two
(`ckc_pin.analysis.singular_curve` follows them), and surfaces of one of more, of which `search_singular` samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.assembly import close_loops
from ckc_pin.kinematics.continuation import MAX_NEWTON_STEP
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose, Rate
from ckc_pin.mechanism.rank import RANK_TOLERANCE, choose_dependent, compute_rank, scale_jacobian
from ckc_pin.mechanism.spec import LoopSpec

__all__ = ["Kind", "SingularPoint", "SingularSystem", "classify", "find_singular", "search_singular"]

Kind = Literal["locked", "fold", "serial", "rank loss"]

EXACT = 1e-12  # residual of the equations above (m, rad and pure numbers) that counts as solved
PROBE = 0.1  # rad or m: how far a locked mechanism is moved to see that q really stands still


@dataclass(frozen=True)
class SingularPoint:
    """A singular configuration and what is lost there.

    Attributes
    ----------
    at : Kinematics
        The closure's terms there; `at.q_tree` is the configuration.
    null : (n,) array
        The velocity v of the module's docstring, |v| = 1.
    kind : "locked", "fold", "serial" or "rank loss"
        "locked": q stands still over a finite motion along v (type 1 of the paper's five-bar). "fold": two
        assembly branches meet, q can go to one side only (its type 2). "serial": of a point. "rank loss": J
        itself loses rank, and the mechanism has more freedoms there than elsewhere.
    fold : float
        y . d^2 phi[v, v] with y the unit vector that phi_z^T annuls: how sharply two branches meet, zero where
        none do; metres or radians per unit squared. NaN for a serial point.
    rank_J, freedoms : int
        Rank of J there and n minus it.
    sigma_min_J : float
        The singular value of J that decides on its rank.
    sigma_min_phi_z : float
    q_rank : int
        Rank of the allowed velocities' part in q; d where q is a chart.
    chart : tuple of str
        Coordinates that determine the mechanism there, the best conditioned by a pivoted factorization.
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
    """The equations of the module's docstring in the unknowns (q', v), 2 n of them.

    Parameters
    ----------
    mechanism : Mechanism
    point : str, optional
        A point of the mechanism to hold instead of q: its serial singularities.

    Raises
    ------
    InputError
        No such point.
    """

    def __init__(self, mechanism: Mechanism, point: str | None = None) -> None:
        self.mechanism = mechanism
        self.point = point
        self._fixed = _point_rows(mechanism, point) if point is not None else None
        self._select = np.zeros((mechanism.d, mechanism.n))
        self._select[np.arange(mechanism.d), mechanism.partition.q] = 1.0

    def rows(self, at: Kinematics) -> Array:
        """Return [J; S], whose null vector v is, shape (rows + fixed, n)."""
        if self._fixed is None:
            return np.vstack([at.J, self._select])
        return np.vstack([at.J, self._fixed.jacobian(self._pose(at))])

    def rows_dot(self, at: Kinematics, v: Array) -> Array:
        """Return the derivative of [J; S] along a tangent velocity, same shape."""
        if self._fixed is None:
            return np.vstack([at.J_dot(v), np.zeros_like(self._select)])
        pose = self._pose(at)
        return np.vstack([at.J_dot(v), self._fixed.jacobian_dot(pose, Rate(pose, v))])

    def residual(self, at: Kinematics, v: Array) -> Array:
        """Return [phi; J v; S v; (v . v - 1) / 2]."""
        return np.concatenate([at.phi, self.rows(at) @ v, [0.5 * (v @ v - 1.0)]])

    def jacobian(self, at: Kinematics, v: Array) -> Array:
        """Return the residual's derivative with respect to (q', v), 2 n columns."""
        n, rows = self.mechanism.n, self.rows(at)
        bent = np.column_stack([self.rows_dot(at, e) @ v for e in np.eye(n)])
        return np.block([[at.J, np.zeros_like(at.J)], [bent, rows], [np.zeros((1, n)), v[None, :]]])

    def null_vector(self, at: Kinematics) -> Array:
        """Return the unit velocity that [J; S] comes closest to annulling, shape (n,)."""
        return np.asarray(np.linalg.svd(self.rows(at))[2][-1])

    def solve(self, at: Kinematics, v: Array, iterations: int = 60) -> tuple[Kinematics, Array, float]:
        """Solve by Gauss-Newton with shortest steps; return (q', v) reached and the largest residual left."""
        residual = self.residual(at, v)
        tolerance = max(EXACT, self.mechanism.tolerance)
        for _ in range(iterations):
            if np.abs(residual).max() <= tolerance:
                break
            step = -np.linalg.lstsq(self.jacobian(at, v), residual, rcond=1e-10)[0]
            scale = min(1.0, MAX_NEWTON_STEP / np.abs(step / np.tile(at.tree.step_scale, 2)).max())
            while scale > 1e-6:
                trial, v_trial = at.integrate(scale * step[: self.mechanism.n]), v + scale * step[self.mechanism.n :]
                left = self.residual(trial, v_trial)
                if np.linalg.norm(left) < np.linalg.norm(residual):
                    at, v, residual = trial, v_trial, left
                    break
                scale /= 2
            else:
                break
        return at, v, float(np.abs(residual).max())

    def _pose(self, at: Kinematics) -> Pose:
        fixed = self._fixed
        if fixed is None:
            raise ValueError("q is fixed, not a point")
        return Pose(self.mechanism.tree, fixed.anchors, at.q_tree)


def find_singular(mechanism: Mechanism, q_start: Array | None = None, point: str | None = None) -> SingularPoint:
    """Solve for a singular configuration near a start.

    Parameters
    ----------
    mechanism : Mechanism
    q_start : (nq,) array, optional
        Pinocchio's q, closed or not; default: as assembled.
    point : str, optional
        A point of the mechanism whose serial singularity is wanted, instead of a singular phi_z.

    Raises
    ------
    InputError
        No such point, a start of the wrong shape.
    NumericalError
        None found from there.
    """
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: it has no loops, so phi_z cannot be singular")
    q_start = mechanism.q_tree if q_start is None else q_start
    if q_start.shape != (mechanism.tree.nq,) or not np.all(np.isfinite(q_start)):
        raise InputError(f"q_start: {mechanism.tree.nq} finite numbers needed, got shape {q_start.shape}")
    system = SingularSystem(mechanism, point)
    start = mechanism.kinematics(q_start)
    at, v, left = system.solve(start, system.null_vector(start))
    if left > max(EXACT, mechanism.tolerance):
        raise NumericalError(
            f"no singular configuration found from this start: the equations are left at {left:.3g}; start elsewhere",
            q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
        )
    return classify(system, at, v)


def search_singular(mechanism: Mechanism, count: int, seed: int = 0, point: str | None = None) -> list[SingularPoint]:
    """Solve for singular configurations from random closed configurations; those found, in order.

    The starts are closed from tangent steps of up to pi (rad or m) off the assembled configuration.
    """
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        guess = mechanism.tree.integrate(mechanism.q_tree, random.uniform(-np.pi, np.pi, mechanism.n))
        closed = close_loops(mechanism.tree, mechanism.closure, guess, np.ones(mechanism.n), mechanism.tolerance)
        try:
            found.append(find_singular(mechanism, closed.q_tree, point))
        except NumericalError:
            continue
    return found


def classify(system: SingularSystem, at: Kinematics, v: Array) -> SingularPoint:
    """Say what kind of singular configuration a solution is, and what is lost and what is left there."""
    mechanism = system.mechanism
    J = scale_jacobian(at.J, mechanism.tree, mechanism.closure)
    rank = compute_rank(J).rank
    allowed = np.linalg.svd(J)[2][rank:]
    q_part = np.linalg.svd(allowed[:, at.partition.q], compute_uv=False)
    fold, kind = float("nan"), "serial" if system.point is not None else _kind(at, v, mechanism.tolerance)
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
    """Return the coordinates that determine the mechanism best there, and sigma_min of their phi_z."""
    blocks = [np.arange(v, v + 6) for _, v in mechanism.tree.free_roots]
    z = choose_dependent(J, rank, blocks)
    if z is None:
        return (), 0.0
    names = tuple(mechanism.coordinates[k] for k in np.setdiff1d(np.arange(mechanism.n), z))
    return names, float(np.linalg.svd(at.J[:, z], compute_uv=False)[-1])


def _kind(at: Kinematics, v: Array, tolerance: float) -> Literal["locked", "fold"]:
    """Tell whether the loops close again with q fixed and z moved along v by a finite amount, singular there too.

    Where two branches only meet, the way back to the meeting point is all that closes.
    """
    z, moved = at.partition.z, at.integrate(PROBE * v)
    for _ in range(60):
        if np.abs(moved.phi).max() <= tolerance:
            break
        step = np.zeros(at.tree.n)
        step[z] = -np.linalg.lstsq(moved.phi_z, moved.phi, rcond=1e-8)[0]
        moved = moved.integrate(step)
    went = at.tree.difference(at.q_tree, moved.q_tree)
    closed = np.abs(moved.phi).max() <= tolerance
    singular = moved.margin() <= 1e-6
    return "locked" if closed and singular and v @ went > PROBE / 2 else "fold"


def _point_rows(mechanism: Mechanism, point: str) -> Closure:
    """Return the position of a named point as rows of the same primitives that loops are made of."""
    frames = {p.name: p.frame for p in mechanism.spec.point}
    if point not in frames:
        raise InputError(f"no point {point!r} in {mechanism.name}; there are {', '.join(frames) or 'none'}")
    builder = ClosureBuilder(mechanism.tree, mechanism.frames)
    builder.add_loop(LoopSpec(name=point, type="point", frame_a=frames[point], frame_b="world", rows_in="world"))
    return builder.build()
