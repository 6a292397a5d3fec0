"""Find the singular configurations that a map shows, and trace their curves by continuation.

A grid of cells does not contain a curve. It only provides starts for Newton's method on the equations of
`ckc_pin.analysis.singularities`: cells where an aspect ends, or where the Jacobian is nearly singular. Two things are
added to these equations. The rows that a map fixes keep their values. And where a point's position alone does not
determine the configuration, the rotation of its frame counts, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.singular_curve import SingularCurve, trace_curve
from ckc_pin.analysis.singularities import RESIDUAL_TOLERANCE, SingularSystem, classify_solution
from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.kinematics.extended import ExtendedClosure
from ckc_pin.kinematics.grid import Domain, Grid, ProgressCounter
from ckc_pin.kinematics.mapped import Kind, Locus
from ckc_pin.kinematics.nodes import shape_points
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.rank import compute_rank, scale_jacobian

__all__ = ["LocusSystem", "find_aspects", "find_loci"]

START_CELLS = 64  # along an axis, among which starts are searched for
MAX_FAILED_STARTS = 12  # of one aspect
NEWTON_ITERATIONS = 25
CURVE_STEP = 0.04  # rad or m
MAX_CURVE_POINTS = 3000
BORDER_TOLERANCE = 0.35  # of the mechanism's size; a curve on an aspect's border looks this similar to the last cells
SPREAD_FACTOR = 2.0  # a point is on an aspect if it differs from the cells around by less than this times their spread
SIMILARITY_FACTOR = 3.0  # a point is also on aspects that are this many times as far away as the nearest one
MAX_GAP = 4  # points; shorter gaps in a curve's visible part are closed
NEIGHBOURHOOD = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
KIND_ORDER = ("locked", "fold", "rank loss", "serial")


class LocusSystem(SingularSystem):
    """Equations of singular configurations within a map: those of `SingularSystem`, with some rows fixed.

    Parameters
    ----------
    extended : ExtendedClosure
    serial : bool
        Whether the rows of the point stand still, instead of those of the independent coordinates.
    fixed : (k,) int array
        Rows of the extended closure that keep their values.
    values : (k,) array
        These values.
    """

    def __init__(self, extended: ExtendedClosure, serial: bool, fixed: IntArray, values: Array) -> None:
        super().__init__(extended.mechanism)
        self.extended = extended
        self._still_rows = np.concatenate([extended.loops, extended.place if serial else extended.joints])
        self._fixed_rows = np.concatenate([extended.loops, fixed])
        self._values = np.concatenate([np.zeros(len(extended.loops)), values])

    def rows(self, at: Kinematics) -> Array:
        """Return the rows of J whose null vector v is."""
        return at.J[self._still_rows]

    def rows_dot(self, at: Kinematics, v: Array) -> Array:
        """Return the derivative of `rows` along a tangent velocity."""
        return at.J_dot(v)[self._still_rows]

    def residual(self, at: Kinematics, v: Array) -> Array:
        """Return [phi; fixed rows - values; rows v; (v . v - 1) / 2]."""
        fixed = at.phi[self._fixed_rows] - self._values
        return np.concatenate([fixed, self.rows(at) @ v, [0.5 * (v @ v - 1.0)]])

    def jacobian(self, at: Kinematics, v: Array) -> Array:
        """Return the residual's derivative with respect to (q', v).

        Second derivatives commute: the derivative of J(q') v along a coordinate e is J_dot(v) e. The tangent velocities
        of a free root are in rotating axes and do not commute. Their Lie bracket corrects for that.
        """
        n, fixed = self.mechanism.n, at.J[self._fixed_rows]
        derivative = self.rows_dot(at, v) + self.rows(at) @ _lie_bracket(at, v)
        return np.block([[fixed, np.zeros_like(fixed)], [derivative, self.rows(at)], [np.zeros((1, n)), v[None, :]]])


def _lie_bracket(at: Kinematics, v: Array) -> Array:
    """Return the matrix (n, n) of e -> [v, e], which is zero except for free roots."""
    matrix = np.zeros((len(v), len(v)))
    for _, k in at.tree.free_roots:
        linear, angular = (-np.cross(np.eye(3), part) for part in (v[k : k + 3], v[k + 3 : k + 6]))
        matrix[k : k + 6, k : k + 6] = np.block([[angular, linear], [np.zeros((3, 3)), angular]])
    return matrix


@dataclass
class _TracedLocus:
    """A traced curve.

    Attributes
    ----------
    serial : bool
    kind : str
    curve : SingularCurve
    shapes : (m, k) array
        `shape_points` of the configurations.
    places : (m, axes) array
    on : (aspects, m) array of bool
    """

    serial: bool
    kind: Kind
    curve: SingularCurve
    shapes: Array
    places: Array
    on: BoolArray


def find_loci(
    extended: ExtendedClosure,
    domain: Domain,
    grids: Sequence[Grid],
    is_cartesian: bool,
    progress: ProgressCounter | None = None,
) -> list[Locus]:
    """Find the curves of singular configurations that the aspects of a map show.

    Parameters
    ----------
    extended : ExtendedClosure
        With the rows of the point whose serial singularities are searched for; without a point there are none.
    domain : Domain
    grids : sequence of Grid
        Filled.
    is_cartesian : bool
        Whether the aspects end at serial singularities of the point, instead of at singular phi_z.
    progress : ProgressCounter, optional
        Counts each aspect that has been searched, once for each of the two kinds of singularities.
    """
    loci: list[_TracedLocus] = []
    fixed, values = _fixed_rows(extended, domain, grids[0])
    for serial in (False, True) if len(extended.place) else (False,):
        system = LocusSystem(extended, serial, fixed, values)
        for aspect in range(len(grids)):
            _search_aspect(system, serial, aspect, grids, loci, is_border=serial == is_cartesian)
            if progress is not None:
                progress.add()
    loci.sort(key=lambda locus: (KIND_ORDER.index(locus.kind), *locus.places[0]))
    return [
        Locus(
            kind=locus.kind,
            q_tree=locus.curve.q_tree,
            at=locus.places,
            point=None,
            on=locus.on,
            closed=locus.curve.closed,
            residual=locus.curve.residual,
        )
        for locus in loci
    ]


def _fixed_rows(extended: ExtendedClosure, domain: Domain, grid: Grid) -> tuple[IntArray, Array]:
    """Return the fixed rows of a domain as rows of the extended closure, and their values."""
    numbers = [extended.closure.names.index(domain.task.extended.closure.names[k]) for k in domain.task.rows]
    fixed = np.array(numbers, np.intp)[domain.fixed]
    return fixed, grid.values[np.flatnonzero(grid.reached)[0]][domain.fixed]


def _search_aspect(
    system: LocusSystem, serial: bool, aspect: int, grids: Sequence[Grid], loci: list[_TracedLocus], is_border: bool
) -> None:
    """Trace the curves in one aspect's grid that are not in `loci` yet, and append them to `loci`."""
    grid = grids[aspect]
    domain = grid.domain
    cells, places, spacing = _find_starts(system, grid, is_border)
    is_open, failed = np.ones(len(cells), bool), 0
    for locus in loci:
        _discard_starts(is_open, places, spacing, domain, locus, aspect, serial)
    while np.any(is_open) and failed < MAX_FAILED_STARTS:
        first = int(np.flatnonzero(is_open)[0])
        is_open[first] = False
        start = system.extended.kinematics(grid.q_tree[cells[first]])
        at, null, residual = system.solve(start, system.null_vector(start), iterations=NEWTON_ITERATIONS)
        is_solved = residual <= max(RESIDUAL_TOLERANCE, system.mechanism.tolerance)
        if is_solved and not _is_on_curve(system, at, serial, loci):
            locus = _trace_locus(system, serial, at, null, grids, is_border)
            if locus.on[aspect].any():
                loci.append(locus)
                _discard_starts(is_open, places, spacing, domain, locus, aspect, serial)
                continue
        failed += 1
        gap = domain.difference(np.repeat(places[first : first + 1], len(places), axis=0), places)
        is_open &= ~np.all(np.abs(gap) <= 1.5 * spacing, axis=1)


def _discard_starts(
    is_open: BoolArray,
    places: Array,
    spacing: Array,
    domain: Domain,
    locus: _TracedLocus,
    aspect: int,
    serial: bool,
) -> None:
    """Discard the starts next to the part of a locus that an aspect shows."""
    if locus.serial == serial:
        for point in locus.places[locus.on[aspect]]:
            gap = domain.difference(np.repeat(point[None], len(places), 0), places)
            is_open &= ~np.all(np.abs(gap) <= 2 * spacing, 1)


def _find_starts(system: LocusSystem, grid: Grid, is_border: bool) -> tuple[IntArray, Array, Array]:
    """Return cells to start from, the most nearly singular first, their places, and the spacing of the cells searched.

    These are local minima of the smallest singular value and, if aspects end on the locus, cells at the end.
    """
    domain, task = grid.domain, grid.domain.task
    strides = [max(1, len(axis.values) // START_CELLS) for axis in domain.axes]
    rows, columns = np.arange(0, domain.shape[0], strides[0]), np.arange(0, domain.shape[1], (strides * 2)[1])
    numbers = rows[:, None] * domain.shape[1] + columns
    sigma_min = np.full(numbers.shape, np.nan)
    inside = grid.reached[numbers]
    _, J = evaluate_closure(task.extended.mechanism.tree, system.extended.closure, grid.q_tree[numbers[inside]])
    sigma_min[inside] = np.linalg.svd(J[:, system._still_rows], compute_uv=False)[:, -1]
    is_start = np.zeros(sigma_min.shape, bool)
    for k, axis in enumerate(domain.axes):
        before, after = (np.roll(sigma_min, shift, k) for shift in (1, -1))
        if not axis.turns:
            for values, end in ((before, 0), (after, -1)):
                np.moveaxis(values, k, 0)[end] = np.inf  # the end of the window is not the end of the aspect
        is_start |= (sigma_min <= before) & (sigma_min <= after)
        is_start |= is_border & inside & (np.isnan(before) | np.isnan(after))
    starts = np.argwhere(is_start & inside)
    starts = starts[np.argsort(sigma_min[starts[:, 0], starts[:, 1]])]
    cells = np.column_stack([rows[starts[:, 0]], columns[starts[:, 1]]])
    spacing = np.array([s * (a.high - a.low) / len(a.values) for s, a in zip(strides, domain.axes, strict=True)])
    return grid.numbers(cells), domain.values(cells), spacing


def _is_on_curve(system: LocusSystem, at: Kinematics, serial: bool, loci: list[_TracedLocus]) -> bool:
    """Whether a solution lies on a traced curve, as far as the curve's points can tell."""
    shape = shape_points(system.mechanism, at.q_tree[None])
    for locus in loci:
        if locus.serial == serial:
            stride = np.abs(np.diff(locus.shapes, axis=0)).max(initial=1e-6 * system.mechanism.size)
            if np.abs(locus.shapes - shape).max(axis=1).min() <= stride:
                return True
    return False


def _trace_locus(
    system: LocusSystem, serial: bool, at: Kinematics, null: Array, grids: Sequence[Grid], is_border: bool
) -> _TracedLocus:
    """Trace the curve through a solution, classify it, and find which aspects show it."""
    mechanism, domain = system.mechanism, grids[0].domain
    kind = _classify(system, serial, at, null)
    if len(domain.axes) == 2:
        curve = trace_curve(system, at, null, CURVE_STEP, MAX_CURVE_POINTS)
    else:
        residual = float(np.abs(system.residual(at, null)).max())
        curve = SingularCurve(at.q_tree[None], null[None], closed=False, residual=residual)
    shapes = shape_points(mechanism, curve.q_tree)
    values, _ = evaluate_closure(mechanism.tree, domain.task.extended.closure, curve.q_tree)
    places = values[:, domain.task.rows[domain.over]]
    on = find_aspects(places, shapes, grids, is_border=is_border)
    return _TracedLocus(serial, kind, curve, shapes, places, on)


def _classify(system: LocusSystem, serial: bool, at: Kinematics, null: Array) -> Kind:
    mechanism = system.mechanism
    without_point = mechanism.kinematics(at.q_tree)
    if not serial:
        return classify_solution(SingularSystem(mechanism), without_point, null).kind
    rank = compute_rank(scale_jacobian(without_point.J, mechanism.tree, mechanism.closure)).rank
    return "serial" if rank == mechanism.rank else "rank loss"


# --- aspects that show a curve -------------------------------------------------------------------------------------


def find_aspects(places: Array, shapes: Array, grids: Sequence[Grid], is_border: bool = False) -> BoolArray:
    """Return which points of a curve are on which aspect, shape (aspects, m).

    A point is on an aspect if its configuration resembles those of the cells around it.

    Parameters
    ----------
    places : (m, axes) array
    shapes : (m, k) array
        `shape_points` of the configurations.
    grids : sequence of Grid
    is_border : bool
        Whether aspects end on the curve. Configurations change fast there, and the last cells may be on one side only,
        so a larger difference is accepted.
    """
    domain = grids[0].domain
    mechanism = domain.task.extended.mechanism
    distance = np.full((len(grids), len(places)), np.inf)
    around = _cells_around(domain, places)
    for aspect, grid in enumerate(grids):
        cell_shapes = np.full((*around.shape, shapes.shape[1]), np.nan)
        reached = grid.reached[around]
        cell_shapes[reached] = shape_points(mechanism, grid.q_tree[around[reached]])
        points = np.flatnonzero(np.any(reached, axis=1))
        neighbours = cell_shapes[points]
        gap = np.nanmin(np.max(np.abs(neighbours - shapes[points][:, None]), axis=2), axis=1)
        spread = np.max(np.nanmax(neighbours, axis=1) - np.nanmin(neighbours, axis=1), axis=1)
        max_gap = BORDER_TOLERANCE * mechanism.size if is_border else SPREAD_FACTOR * spread
        distance[aspect, points] = np.where(gap <= max_gap, gap, np.inf)
    inside = np.ones(len(places), bool)
    for k, axis in enumerate(domain.axes):
        inside &= axis.turns | ((places[:, k] >= axis.low) & (places[:, k] <= axis.high))
    on: BoolArray = np.isfinite(distance) & (distance <= SIMILARITY_FACTOR * distance.min(axis=0)) & inside
    return _close_gaps(on) & inside


def _cells_around(domain: Domain, places: Array) -> IntArray:
    """Return the numbers of the cells around places (m, axes), shape (m, 9), or (m, 3) along one axis."""
    shifts = NEIGHBOURHOOD if len(domain.axes) == 2 else NEIGHBOURHOOD[NEIGHBOURHOOD[:, 1] == 0]
    cells = domain.nearest_cells(places)[:, None] + shifts
    for k, axis in enumerate(domain.axes):
        count = len(axis.values)
        cells[..., k] = cells[..., k] % count if axis.turns else cells[..., k].clip(0, count - 1)
    return np.asarray(cells[..., 0] * domain.shape[1] + cells[..., 1])


def _close_gaps(on: BoolArray) -> BoolArray:
    """Close gaps of a few points. Next to the end of an aspect it is accidental which cells are reached."""
    padded = np.pad(on, ((0, 0), (MAX_GAP, MAX_GAP)))
    count = on.shape[1]
    before = np.any([padded[:, MAX_GAP - k : MAX_GAP - k + count] for k in range(MAX_GAP + 1)], axis=0)
    after = np.any([padded[:, MAX_GAP + k : MAX_GAP + k + count] for k in range(MAX_GAP + 1)], axis=0)
    return np.asarray(before & after)
