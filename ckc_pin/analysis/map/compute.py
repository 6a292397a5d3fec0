"""Compute the singularity map of a mechanism: aspects, singular curves and a desired trajectory over two coordinates.

The axes are independent coordinates, or coordinates of a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from time import perf_counter

import numpy as np

from ckc_pin.analysis.map.desired_path import add_path, read_desired
from ckc_pin.analysis.map.loci import find_loci
from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import require_callable, require_flag, require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.extended import ExtendedClosure, Task, extend_closure, find_point
from ckc_pin.kinematics.grid import (
    COARSE_FRACTION,
    Domain,
    Grid,
    Progress,
    ProgressCounter,
    cell_centres,
    fill_grid,
    find_branches,
    make_joint_domain,
    max_distance,
)
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.mapped import Aspect, Axis, Locus, Path, SingularityMap, Space
from ckc_pin.kinematics.nodes import nodes_at
from ckc_pin.mechanism.batch import ManyPoses
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import EXPECTED_SCENE, Scene, load_scene

__all__ = ["add_positions", "make_map", "singularity_map"]

CELL_MULTIPLE = 8  # cells along an axis, so that coarse grids lie on the fine one
MIN_CELLS, MAX_CELLS = 16, 2000  # along an axis
WINDOW_CELLS = 48  # along an axis, while a Cartesian window is searched for
WINDOW_MARGIN = 3.0  # of these cells; thin corners of the workspace fall between cells
WINDOW_SEARCHES = 6
WINDOW_SHRINKAGE = 0.7  # the search ends if the next window is not smaller by this factor
MAX_JACOBIAN_BYTES = 1.5e9  # of one aspect
ROUNDED_DIGITS = 12  # of fixed values


def singularity_map(
    mechanism: Mechanism | str | FilePath,
    *,
    scene: Scene | str | FilePath | None = None,
    space: str = "joint",
    over: Sequence[str] | None = None,
    point: str | None = None,
    cells: int = 200,
    loci: bool = True,
    progress: Progress | None = None,
) -> SingularityMap:
    """Map where a mechanism can go, and where it is singular.

    Parameters
    ----------
    mechanism : Mechanism, or a name or path as for `load`
    scene : Scene, or a name or path as for `load_scene`, optional
        Its desired trajectory is drawn, and its closest approach to each locus measured. A name without a slash is a
        scene of the mechanism.
    space : "joint" or "cartesian"
        Over independent coordinates, or over the place of a point.
    over : one or two names, optional
        The axes: independent coordinates, or of x, y, z. The others are fixed as assembled. Default: the first two.
    point : str, optional
        The point whose serial singularities are searched for. Default: the first one; none without any [[point]].
    cells : int
        Along each axis; rounded up to a multiple of 8.
    loci : bool
        Search for singular configurations. Without them, the map is computed several times as fast.
    progress : callable, optional
        Called as progress(fraction), from 0 to 1.

    Raises
    ------
    InputError
        d = 0, no loops, no point for the Cartesian space, an unknown name, or a scene without a desired trajectory.
    """
    name = mechanism if isinstance(mechanism, str | FilePath) else None
    mechanism = as_mechanism(mechanism, "singularity_map")
    if scene is not None:
        require_type(scene, (Scene, str, FilePath), "singularity_map: scene", EXPECTED_SCENE)
    require_type(cells, (int, np.integer), "singularity_map: cells", "a number of cells along an axis")
    if isinstance(over, str):
        raise InputError(f"singularity_map: over: expected one or two names, as [{over!r}], got {over!r}")
    require_flag(loci, "singularity_map: loci")
    require_callable(progress, "singularity_map: progress", "a function of the completed fraction", 1)
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: d = 0, so there is nothing to map; leave out a loop")
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: without loops the mechanism is never singular; map one with loops")
    if not MIN_CELLS <= cells <= MAX_CELLS:
        raise InputError(f"cells = {cells}: expected {MIN_CELLS} to {MAX_CELLS} along an axis")
    if space not in ("joint", "cartesian"):
        raise InputError(f"space = {space!r}: expected joint or cartesian")
    if scene is not None and not isinstance(scene, Scene):
        scene = _load_scene(mechanism.name if name is None else name, scene)
    desired = None if scene is None else read_desired(scene, mechanism)
    cells = -(-cells // CELL_MULTIPLE) * CELL_MULTIPLE
    is_cartesian = space == "cartesian"
    with one_blas_thread():
        start = perf_counter()
        extended, notes = _extend_by_point(mechanism, point, needed=is_cartesian or point is not None)
        over_place = is_cartesian and mechanism.d > 1  # with one freedom, the point's path is drawn over the joint
        task, positions, names = _choose_axes(extended, over, over_place)
        _check_size(task, cells, len(positions))
        branches, has_more = find_branches(task)
        steps = ProgressCounter(progress, 1 + len(branches) * 3)
        if over_place:
            domain = _cartesian_domain(task, positions, names, branches, cells)
        else:
            domain = make_joint_domain(task, positions, names, cells)
        steps.add()
        grids = [steps.add_after(fill_grid(domain, branch)) for branch in branches]
        grids = [grid for grid in grids if grid.reached.any()]
        if not grids:
            raise InputError(f"{mechanism.name}: no cell of the map is reached from the assembled configuration")
        seconds = perf_counter() - start
        searched = find_loci(extended, domain, grids, over_place, steps) if loci else []
        curves = [add_positions(extended, locus) for locus in searched]
        path = None if desired is None else add_path(desired, mechanism, grids, curves, over_place)
        return make_map(
            extended,
            "cartesian" if is_cartesian else "joint",
            grids,
            curves,
            path=path,
            more_branches=has_more,
            seconds=seconds,
            notes=notes,
        )


def _load_scene(mechanism: str | FilePath, scene: str | FilePath) -> Scene:
    """Load a scene. A bare name such as tracking is a scene of the mechanism, such as five_bar/tracking."""
    is_bare = isinstance(scene, str) and "/" not in scene and not scene.endswith(".toml")
    return load_scene(f"{mechanism}/{scene}" if is_bare and isinstance(mechanism, str) else scene)


def _extend_by_point(
    mechanism: Mechanism, point: str | None, *, needed: bool
) -> tuple[ExtendedClosure, tuple[str, ...]]:
    """Extend the closure by the point's rows, or return a note if the point is unsuitable and not needed."""
    try:
        return extend_closure(mechanism, find_point(mechanism, point)), ()
    except InputError as error:
        if needed:
            raise
        return extend_closure(mechanism), (f"no serial singularities: {error}",)


def _choose_axes(
    extended: ExtendedClosure, over: Sequence[str] | None, over_place: bool
) -> tuple[Task, IntArray, list[str]]:
    """Return the task, the positions of the axes in its rows, and their names."""
    mechanism = extended.mechanism
    if mechanism.independent_root_coordinates and not over_place:
        raise InputError(
            f"{mechanism.name}: {mechanism.independent_root_coordinates[0]} belongs to a free root, which has no chart "
            "to draw a map over; choose joints as independent coordinates"
        )
    if over_place:
        task = Task(extended, extended.fixing)
        valid = [_row_name(task, k) for k in range(mechanism.d) if extended.fixing[k] < extended.place[0] + 3]
        if not valid:
            raise InputError(
                f"{mechanism.name}: the point {extended.point!r} cannot move as assembled; name another point"
            )
    else:
        task = Task(extend_closure(mechanism), extended.joints)
        valid = list(mechanism.independent)
    names = valid[:2] if over is None else list(over)
    unknown = [name for name in names if name not in valid]
    if unknown:
        raise InputError(f"over: unknown coordinate {unknown[0]!r}; expected one or two of {', '.join(valid)}")
    if not 1 <= len(names) <= 2 or len(set(names)) < len(names):
        raise InputError(f"over: expected one or two different names of {', '.join(valid)}")
    labels = [_row_name(task, k) for k in range(mechanism.d)]
    return task, np.array([labels.index(name) for name in names], np.intp), names


def _check_size(task: Task, cells: int, axes: int) -> None:
    """Raise InputError if the Jacobians of one aspect need too much memory."""
    mechanism = task.extended.mechanism
    bytes_per_cell = 8.0 * task.extended.closure.rows * mechanism.n
    if bytes_per_cell * cells**axes > MAX_JACOBIAN_BYTES:
        limit = int((MAX_JACOBIAN_BYTES / bytes_per_cell) ** (1 / axes))
        raise InputError(f"cells = {cells}: a map of {mechanism.name} may have at most {limit} along an axis")


# --- windows -------------------------------------------------------------------------------------------------------


def _cartesian_domain(task: Task, positions: IntArray, names: Sequence[str], branches: Array, cells: int) -> Domain:
    """Return the Cartesian window that the branches reach, found by filling ever smaller windows coarsely."""
    middle = nodes_at(task, task.extended.mechanism.q_tree[None]).values[0][positions]
    low, high = middle - max_distance(task), middle + max_distance(task)
    for _ in range(WINDOW_SEARCHES):
        domain = _box_domain(task, positions, names, low, high, WINDOW_CELLS)
        reached = np.array([fill_grid(domain, branch, COARSE_FRACTION).reached for branch in branches]).any(axis=0)
        reached = reached.reshape(domain.shape)
        cell = (high - low) / WINDOW_CELLS
        new_low, new_high = middle.copy(), middle.copy()
        for k, axis in enumerate(domain.axes):
            values = axis.values[np.any(reached, axis=1 - k)]
            new_low[k] = min(middle[k], *values) if len(values) else middle[k]
            new_high[k] = max(middle[k], *values) if len(values) else middle[k]
        new_low = np.maximum(new_low - WINDOW_MARGIN * cell, low)
        new_high = np.minimum(new_high + WINDOW_MARGIN * cell, high)
        has_shrunk = np.any(new_high - new_low < WINDOW_SHRINKAGE * (high - low))
        low, high = new_low, new_high
        if not has_shrunk:
            break
    return _box_domain(task, positions, names, low, high, cells)


def _box_domain(task: Task, positions: IntArray, names: Sequence[str], low: Array, high: Array, cells: int) -> Domain:
    axes = tuple(
        Axis(name, "m", float(a), float(b), False, cell_centres(float(a), float(b), cells))
        for name, a, b in zip(names, low, high, strict=True)
    )
    return Domain(task, positions, axes)


# --- results -------------------------------------------------------------------------------------------------------


def make_map(
    extended: ExtendedClosure,
    space: Space,
    grids: Sequence[Grid],
    loci: Sequence[Locus],
    *,
    path: Path | None = None,
    more_branches: bool,
    seconds: float,
    notes: tuple[str, ...] = (),
) -> SingularityMap:
    """Return the map of aspects, each of which reaches at least one cell, with their loci and a trajectory."""
    mechanism, domain = extended.mechanism, grids[0].domain
    is_square = mechanism.assembled.phi_z.shape[0] == mechanism.assembled.phi_z.shape[1]
    values = grids[0].values[np.flatnonzero(grids[0].reached)[0]]
    return SingularityMap(
        mechanism=mechanism.name,
        coordinates=mechanism.coordinates,
        space=space,
        point=extended.point,
        axes=domain.axes,
        fixed={_row_name(domain.task, k): float(np.round(values[k], ROUNDED_DIGITS)) + 0.0 for k in domain.fixed},
        measure="det phi_z" if is_square else "sigma_min(phi_z)",
        measure_unit=_determinant_unit(mechanism) if is_square else "",
        aspects=tuple(_make_aspect(extended, grid, is_square) for grid in grids),
        more_branches=more_branches,
        loci=tuple(loci),
        path=path,
        seconds=seconds,
        notes=notes,
    )


def add_positions(extended: ExtendedClosure, locus: Locus) -> Locus:
    """Return a locus with the positions of the point along it."""
    return locus if extended.point is None else replace(locus, point=_point_positions(extended, locus.q_tree))


def _row_name(task: Task, k: int) -> str:
    """Return the name of a row of a task: a coordinate, or an axis of the point."""
    extended, row = task.extended, int(task.rows[k])
    if len(extended.place) and row >= extended.place[0]:
        return extended.axis(row)
    return extended.mechanism.independent[k]


def _make_aspect(extended: ExtendedClosure, grid: Grid, is_square: bool) -> Aspect:
    mechanism, shape = extended.mechanism, grid.domain.shape
    inside = np.flatnonzero(grid.reached)
    phi_z = grid.J[inside][:, : len(extended.loops)][:, :, mechanism.partition.z]
    sigma_min, det = np.full(len(grid.reached), np.nan), np.full(len(grid.reached), np.nan)
    sigma_min[inside] = np.linalg.svd(phi_z, compute_uv=False)[:, -1]
    det[inside] = np.linalg.det(phi_z) if is_square else sigma_min[inside]
    coordinates = grid.q_tree
    if not mechanism.tree.is_euclidean:
        coordinates = np.full((len(grid.reached), mechanism.n), np.nan)
        coordinates[inside] = [mechanism.tree.to_coordinates(q_tree) for q_tree in grid.q_tree[inside]]
    positions = np.full((len(grid.reached), 3), np.nan)
    if extended.point is not None:
        positions[inside] = _point_positions(extended, grid.q_tree[inside])
    return Aspect(
        reached=grid.reached.reshape(shape),
        det_phi_z=det.reshape(shape),
        sigma_min=sigma_min.reshape(shape),
        q_tree=grid.q_tree.reshape(*shape, -1),
        coordinates=coordinates.reshape(*shape, -1),
        point=None if extended.point is None else positions.reshape(*shape, 3),
    )


def _point_positions(extended: ExtendedClosure, q_tree: Array) -> Array:
    """Return the world positions (count, 3) of the point at configurations (count, nq)."""
    mechanism = extended.mechanism
    frame = mechanism.points[str(extended.point)]
    pose = ManyPoses(mechanism.tree, mechanism.closure.anchors, q_tree)
    joints = mechanism.tree.model.njoints
    rotation = pose.rotation.reshape(-1, joints, 3, 3)[:, frame.joint]
    return np.asarray(rotation @ frame.translation + pose.translation.reshape(-1, joints, 3)[:, frame.joint])


def _determinant_unit(mechanism: Mechanism) -> str:
    """Return the unit of det phi_z: a power of metres, that of its rows less that of its columns."""
    power = int(np.sum(mechanism.closure.in_metres(mechanism.tree)))
    power -= int(np.sum(mechanism.tree.in_metres[mechanism.partition.z]))
    return "" if power == 0 else "m" if power == 1 else f"m^{power}"
