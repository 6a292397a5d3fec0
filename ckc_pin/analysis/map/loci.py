"""The singular configurations of a map: found from where the aspects end or come close to them, traced by continuation.

A grid cannot hit a curve. It only says where to start Newton's method on the equations of
`ckc_pin.analysis.singularities`, to which two things are added: what a map over two of more coordinates holds, and
points whose place alone does not tell the configuration, so that their frame's turn counts too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.map.grid import Domain, Grid, Steps
from ckc_pin.analysis.singular_curve import SingularCurve, trace
from ckc_pin.analysis.singularities import EXACT, SingularSystem, classify
from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.kinematics.extended import ExtendedClosure
from ckc_pin.kinematics.mapped import Kind, Locus
from ckc_pin.kinematics.nodes import shape_points
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.rank import compute_rank, scale_jacobian

__all__ = ["LocusSystem", "find_loci", "seen"]

SPARSE = 64  # cells along an axis that are looked at for starts
TRIES = 12  # starts of one aspect that lead nowhere
STEP = 0.04  # rad or m along a curve
LONGEST = 3000  # points of a curve
NEAR = 0.35  # of the mechanism's size: cells next to the end of an aspect look that much alike
SPREAD = 2.0  # times what the cells around differ: what looks less alike lies on another branch
ALIKE = 3.0  # times as far as the nearest aspect: still on this one too
GAP = 4  # points
BLOCK = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])


class LocusSystem(SingularSystem):
    """Singular configurations within a map: those of `SingularSystem` with some given rows fixed.

    Parameters
    ----------
    extended : ExtendedClosure
    serial : bool
        Whether the rows of the point stand still, or those of the independent coordinates.
    fixed : (k,) int array
        Rows of the extended closure that keep the values (k,) given.
    values : (k,) array
    """

    def __init__(self, extended: ExtendedClosure, serial: bool, fixed: IntArray, values: Array) -> None:
        super().__init__(extended.mechanism)
        self.extended = extended
        self._still = np.concatenate([extended.loops, extended.place if serial else extended.joints])
        self._where = np.concatenate([extended.loops, fixed])
        self._values = np.concatenate([np.zeros(len(extended.loops)), values])

    def rows(self, at: Kinematics) -> Array:
        """Rows of J that annul v."""
        return at.J[self._still]

    def rows_dot(self, at: Kinematics, v: Array) -> Array:
        """Their derivative along a tangent velocity."""
        return at.J_dot(v)[self._still]

    def residual(self, at: Kinematics, v: Array) -> Array:
        """Return [phi; fixed; still v; (v . v - 1) / 2]."""
        where = at.phi[self._where] - self._values
        return np.concatenate([where, self.rows(at) @ v, [0.5 * (v @ v - 1.0)]])

    def jacobian(self, at: Kinematics, v: Array) -> Array:
        """Return the residual's derivative with respect to (q', v).

        Second derivatives do not depend on their order: along a coordinate e, J(q') v changes as J does along v, times
        e. Velocities of a free root are in its own axes, which turn: their bracket makes up for that.
        """
        n, where = self.mechanism.n, at.J[self._where]
        bent = self.rows_dot(at, v) + self.rows(at) @ _bracket(at, v)
        return np.block([[where, np.zeros_like(where)], [bent, self.rows(at)], [np.zeros((1, n)), v[None, :]]])


def _bracket(at: Kinematics, v: Array) -> Array:
    """Return the matrix (n, n) of e -> [v, e], zero but for free roots."""
    matrix = np.zeros((len(v), len(v)))
    for _, k in at.tree.free_roots:
        linear, angular = (-np.cross(np.eye(3), part) for part in (v[k : k + 3], v[k + 3 : k + 6]))
        matrix[k : k + 6, k : k + 6] = np.block([[angular, linear], [np.zeros((3, 3)), angular]])
    return matrix


@dataclass
class _Found:
    serial: bool
    kind: Kind
    curve: SingularCurve
    look: Array
    at: Array
    on: BoolArray


def find_loci(
    extended: ExtendedClosure, domain: Domain, grids: Sequence[Grid], cartesian: bool, steps: Steps | None = None
) -> list[Locus]:
    """Find the singular configurations that the aspects of a map show.

    Parameters
    ----------
    extended : ExtendedClosure
        With the rows of the point whose serial singularities are wanted; without, there are none.
    domain : Domain
    grids : sequence of Grid
        Filled.
    cartesian : bool
        Whether the aspects end where the point is serially singular, instead of where phi_z is.
    steps : Steps, optional
        Called with each aspect that has been searched, once for each of the two kinds.
    """
    found: list[_Found] = []
    fixed, values = _fixed(extended, domain, grids[0])
    for serial in (False, True) if len(extended.place) else (False,):
        system = LocusSystem(extended, serial, fixed, values)
        for grid in grids:
            _search(system, serial, grid, grids, found, edges=serial == cartesian)
            if steps is not None:
                steps.step()
    found.sort(key=lambda locus: (("locked", "fold", "rank loss", "serial").index(locus.kind), *locus.at[0]))
    return [
        Locus(
            kind=locus.kind,
            q_tree=locus.curve.q_tree,
            at=locus.at,
            point=None,
            on=locus.on,
            closed=locus.curve.closed,
            residual=locus.curve.residual,
        )
        for locus in found
    ]


def _fixed(extended: ExtendedClosure, domain: Domain, grid: Grid) -> tuple[IntArray, Array]:
    """Return the fixed rows of a domain's task as rows of the closure extended by the point, and their values."""
    names = [extended.closure.names.index(domain.task.extended.closure.names[k]) for k in domain.task.rows]
    fixed = np.array(names, np.intp)[domain.fixed]
    return fixed, grid.given[np.flatnonzero(grid.reached)[0]][domain.fixed]


def _search(
    system: LocusSystem, serial: bool, grid: Grid, grids: Sequence[Grid], found: list[_Found], edges: bool
) -> None:
    cells, places, spacing = _starts(system, grid, edges)
    which = next(k for k, other in enumerate(grids) if other is grid)
    open_, failed = np.ones(len(cells), bool), 0
    for locus in found:
        _close(open_, places, spacing, grid.domain, locus, which, serial)
    while np.any(open_) and failed < TRIES:
        first = int(np.flatnonzero(open_)[0])
        open_[first] = False
        start = system.extended.kinematics(grid.q_tree[cells[first]])
        at, null, left = system.solve(start, system.null_vector(start), iterations=25)
        solved = left <= max(EXACT, system.mechanism.tolerance)
        if solved and not _known(system, at, serial, found):
            locus = _follow(system, serial, at, null, grids, edges)
            if locus.on[which].any():
                found.append(locus)
                _close(open_, places, spacing, grid.domain, locus, which, serial)
                continue
        failed += 1
        gap = grid.domain.change(np.repeat(places[first : first + 1], len(places), axis=0), places)
        open_ &= ~np.all(np.abs(gap) <= 1.5 * spacing, axis=1)


def _close(
    open_: BoolArray, places: Array, spacing: Array, domain: Domain, locus: _Found, aspect: int, serial: bool
) -> None:
    """Cross out the starts next to a locus as it is seen from an aspect."""
    if locus.serial == serial:
        for point in locus.at[locus.on[aspect]]:
            open_ &= ~np.all(np.abs(domain.change(np.repeat(point[None], len(places), 0), places)) <= 2 * spacing, 1)


def _starts(system: LocusSystem, grid: Grid, edges: bool) -> tuple[IntArray, Array, Array]:
    """Cells to start from, the most nearly singular first; their places; the spacing of the cells looked at."""
    domain, task = grid.domain, grid.domain.task
    strides = [max(1, len(axis.values) // SPARSE) for axis in domain.axes]
    rows, columns = np.arange(0, domain.shape[0], strides[0]), np.arange(0, domain.shape[1], (strides * 2)[1])
    numbers = rows[:, None] * domain.shape[1] + columns
    size = np.full(numbers.shape, np.nan)
    inside = grid.reached[numbers]
    _, jacobian = evaluate_closure(task.extended.mechanism.tree, system.extended.closure, grid.q_tree[numbers[inside]])
    size[inside] = np.linalg.svd(jacobian[:, system._still], compute_uv=False)[:, -1]
    chosen = np.zeros(size.shape, bool)
    for k, axis in enumerate(domain.axes):
        before, after = (np.roll(size, shift, k) for shift in (1, -1))
        if not axis.turns:
            for values, end in ((before, 0), (after, -1)):
                np.moveaxis(values, k, 0)[end] = np.inf  # the window's edge is none of the aspect's
        chosen |= (size <= before) & (size <= after)
        chosen |= edges & inside & (np.isnan(before) | np.isnan(after))
    picked = np.argwhere(chosen & inside)
    picked = picked[np.argsort(size[picked[:, 0], picked[:, 1]])]
    cells = np.column_stack([rows[picked[:, 0]], columns[picked[:, 1]]])
    spacing = np.array([s * (a.high - a.low) / len(a.values) for s, a in zip(strides, domain.axes, strict=True)])
    return grid.flat(cells), domain.values(cells), spacing


def _known(system: LocusSystem, at: Kinematics, serial: bool, found: list[_Found]) -> bool:
    """Whether a solution lies on a curve that has been traced, as far as its points can tell."""
    look = shape_points(system.mechanism, at.q_tree[None])
    for locus in found:
        if locus.serial == serial:
            stride = np.abs(np.diff(locus.look, axis=0)).max(initial=1e-6 * system.mechanism.size)
            if np.abs(locus.look - look).max(axis=1).min() <= stride:
                return True
    return False


def _follow(
    system: LocusSystem, serial: bool, at: Kinematics, null: Array, grids: Sequence[Grid], edges: bool
) -> _Found:
    """Trace the curve through a solution, classify it, and see which aspects show it."""
    mechanism, domain = system.mechanism, grids[0].domain
    kind = _kind(system, serial, at, null)
    if len(domain.axes) == 2:
        curve = trace(system, at, null, STEP, LONGEST)
    else:
        curve = SingularCurve(at.q_tree[None], null[None], False, float(np.abs(system.residual(at, null)).max()))
    look = shape_points(mechanism, curve.q_tree)
    given, _ = evaluate_closure(mechanism.tree, domain.task.extended.closure, curve.q_tree)
    place = given[:, domain.task.rows[domain.over]]
    return _Found(serial, kind, curve, look, place, seen(place, look, grids, edges))


def _kind(system: LocusSystem, serial: bool, at: Kinematics, null: Array) -> Kind:
    mechanism = system.mechanism
    own = mechanism.kinematics(at.q_tree)
    if not serial:
        return classify(SingularSystem(mechanism), own, null).kind
    rank = compute_rank(scale_jacobian(own.J, mechanism.tree, mechanism.closure)).rank
    return "serial" if rank == mechanism.rank else "rank loss"


def seen(place: Array, look: Array, grids: Sequence[Grid], ends: bool = False) -> BoolArray:
    """Which points of a curve (m, axes) lie on which aspect: where the cells around look alike, shape (aspects, m).

    Where an aspect `ends` on it a mechanism moves fast, and the last cells may all be on one side at some distance.
    """
    domain = grids[0].domain
    mechanism = domain.task.extended.mechanism
    away = np.full((len(grids), len(place)), np.inf)
    block = _block(domain, place)
    for aspect, grid in enumerate(grids):
        near = np.full((*block.shape, look.shape[1]), np.nan)
        there = grid.reached[block]
        near[there] = shape_points(mechanism, grid.q_tree[block[there]])
        known = np.flatnonzero(np.any(there, axis=1))
        gap = np.nanmin(np.max(np.abs(near[known] - look[known][:, None]), axis=2), axis=1)
        spread = np.max(np.nanmax(near[known], axis=1) - np.nanmin(near[known], axis=1), axis=1)
        away[aspect, known] = np.where(gap <= (NEAR * mechanism.size if ends else SPREAD * spread), gap, np.inf)
    inside = np.ones(len(place), bool)
    for k, axis in enumerate(domain.axes):
        inside &= axis.turns | ((place[:, k] >= axis.low) & (place[:, k] <= axis.high))
    on: BoolArray = np.isfinite(away) & (away <= ALIKE * away.min(axis=0)) & inside
    return _without_gaps(on) & inside


def _block(domain: Domain, place: Array) -> IntArray:
    """Numbers of the cells around places (m, axes), shape (m, 9), or (m, 3) along one axis."""
    shifts = BLOCK if len(domain.axes) == 2 else BLOCK[BLOCK[:, 1] == 0]
    cells = domain.nearest(place)[:, None] + shifts
    for k, axis in enumerate(domain.axes):
        count = len(axis.values)
        cells[..., k] = cells[..., k] % count if axis.turns else cells[..., k].clip(0, count - 1)
    return np.asarray(cells[..., 0] * domain.shape[1] + cells[..., 1])


def _without_gaps(on: BoolArray) -> BoolArray:
    """Fill gaps of a few points: next to an edge it is a matter of luck which cells are there."""
    padded = np.pad(on, ((0, 0), (GAP, GAP)))
    count = on.shape[1]
    before = np.any([padded[:, GAP - k : GAP - k + count] for k in range(GAP + 1)], axis=0)
    after = np.any([padded[:, GAP + k : GAP + k + count] for k in range(GAP + 1)], axis=0)
    return np.asarray(before & after)
