"""`singularity_map`: aspects, loci and a trajectory over two coordinates, joints or those of a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from time import perf_counter

import numpy as np

from ckc_pin.analysis.map.approach import add_path, read_wanted
from ckc_pin.analysis.map.grid import HURRIED, Domain, Grid, Progress, Steps, fill, joint_axis, middles, reach
from ckc_pin.analysis.map.loci import find_loci
from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.validation import require_callable, require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.extended import ExtendedClosure, Task, extend_closure, find_point
from ckc_pin.kinematics.loading import as_mechanism
from ckc_pin.kinematics.mapped import Aspect, Axis, Locus, Path, SingularityMap, Space
from ckc_pin.kinematics.nodes import find_solutions, nodes_at
from ckc_pin.mechanism.batch import ManyPoses
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import EXPECTED_SCENE, Scene, load_scene

__all__ = ["located", "map_value", "name_of", "singularity_map"]


MOST = 4  # branches drawn
LARGEST = 12  # dependent coordinates: of larger mechanisms, and of free bodies, the assembled branch alone is mapped
MULTIPLE = 8  # of cells along an axis, so that coarse grids lie on the fine one
MARGIN = 3.0  # cells of a first look around what it finds: thin corners fall between cells
FIRST_LOOK = 48  # cells along an axis while a Cartesian window is looked for
CELLS = (16, 2000)
MEMORY = 1.5e9  # bytes that the Jacobians of one aspect may take


def singularity_map(
    mechanism: Mechanism | str | FilePath,
    *,
    scene: Scene | str | FilePath | None = None,
    space: str = "joint",
    over: Sequence[str] | None = None,
    point: str | None = None,
    cells: int = 200,
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
        The axes: independent coordinates, or of x, y, z. All others are fixed as assembled. Default: the first two.
    point : str, optional
        The point whose serial singularities are wanted, default the first one. Without any [[point]] there are none.
    cells : int
        Along each axis; rounded up to a multiple of 8.
    progress : callable, optional
        Called as progress(part done).

    Raises
    ------
    InputError
        d = 0, no loops, no point for the Cartesian space, unknown names, a scene without a desired trajectory.
    """
    found = as_mechanism(mechanism, "singularity_map")
    if scene is not None:
        require_type(scene, (Scene, str, FilePath), "singularity_map: scene", EXPECTED_SCENE)
    require_type(cells, (int, np.integer), "singularity_map: cells", "a number of cells along an axis")
    if isinstance(over, str):
        raise InputError(f"singularity_map: over: expected one or two names, as [{over!r}], got {over!r}")
    require_callable(progress, "singularity_map: progress", "a function of the part that is done", 1)
    named = mechanism if isinstance(mechanism, str | FilePath) else mechanism.name
    mechanism = found
    if mechanism.d == 0:
        raise InputError(
            f"{mechanism.name}: d = 0, the loops leave no freedom, there is nothing to map; leave out a loop"
        )
    if not mechanism.dependent:
        raise InputError(f"{mechanism.name}: it has no loops, so it can go anywhere; map one that has")
    if not CELLS[0] <= cells <= CELLS[1]:
        raise InputError(f"cells = {cells}: from {CELLS[0]} to {CELLS[1]} along an axis")
    if space not in ("joint", "cartesian"):
        raise InputError(f"space {space!r}: joint or cartesian")
    loaded = None if scene is None else scene if isinstance(scene, Scene) else _scene(named, scene)
    wanted = None if loaded is None else read_wanted(loaded, mechanism)
    cells = -(-cells // MULTIPLE) * MULTIPLE
    cartesian = space == "cartesian"
    with one_blas_thread():
        began = perf_counter()
        extended, notes = _with_point(mechanism, point, needed=cartesian or point is not None)
        planar = cartesian and mechanism.d > 1  # of one freedom: its point's path over the joint
        task, chosen, names = _task(extended, over, planar)
        _refuse_large(task, cells, len(chosen))
        starts, more = _branches(task)
        steps = Steps(progress, 1 + len(starts) * 3)
        domain = _window(task, chosen, names, starts, cells) if planar else _joints(task, chosen, names, cells)
        steps.step()
        grids = [steps.after(fill(domain, start)) for start in starts]
        grids = [grid for grid in grids if grid.reached.any()]
        if not grids:
            raise InputError(f"{mechanism.name}: no cell of the map is reached from where it is assembled")
        seconds = perf_counter() - began
        loci = [located(extended, locus) for locus in find_loci(extended, domain, grids, planar, steps)]
        path = None if wanted is None else add_path(wanted, mechanism, grids, loci, planar)
        return map_value(
            extended,
            "cartesian" if cartesian else "joint",
            grids,
            loci,
            path=path,
            more_branches=more,
            seconds=seconds,
            notes=notes,
        )


def _branches(task: Task) -> tuple[Array, bool]:
    """Return a configuration of each branch to be mapped, and whether there are or may be more."""
    mechanism = task.extended.mechanism
    if not mechanism.tree.is_euclidean or len(mechanism.dependent) > LARGEST:
        return mechanism.q_tree[None], True
    found = find_solutions(task, nodes_at(task, mechanism.q_tree[None]).values[0], MOST + 1)
    return found[:MOST], len(found) > MOST


def _scene(mechanism: str | FilePath, scene: str | FilePath) -> Scene:
    """Load a scene: tracking of five_bar is five_bar/tracking."""
    plain = isinstance(scene, str) and "/" not in scene and not scene.endswith(".toml")
    return load_scene(f"{mechanism}/{scene}" if plain and isinstance(mechanism, str) else scene)


def _with_point(mechanism: Mechanism, point: str | None, *, needed: bool) -> tuple[ExtendedClosure, tuple[str, ...]]:
    """Add the point's rows; where it is not needed a point that will not do is a note."""
    try:
        return extend_closure(mechanism, find_point(mechanism, point)), ()
    except InputError as error:
        if needed:
            raise
        return extend_closure(mechanism), (f"no serial singularities: {error}",)


def _task(extended: ExtendedClosure, over: Sequence[str] | None, cartesian: bool) -> tuple[Task, IntArray, list[str]]:
    """Choose the given rows and which of them are the axes."""
    mechanism = extended.mechanism
    if (root := mechanism.independent_root_coordinates) and not cartesian:
        raise InputError(
            f"{mechanism.name}: the independent coordinate {root[0]!r} belongs to a free root, and a map needs joint "
            "coordinates; choose joints as independent coordinates"
        )
    if cartesian:
        task = Task(extended, extended.fixing)
        valid = [name_of(task, k) for k in range(mechanism.d) if extended.fixing[k] < extended.place[0] + 3]
        if not valid:
            raise InputError(f"{mechanism.name}: the point {extended.point!r} stands still as assembled; name another")
    else:
        task = Task(extend_closure(mechanism), extended.joints)
        valid = list(mechanism.independent)
    names = valid[:2] if over is None else list(over)
    unknown = [name for name in names if name not in valid]
    if unknown:
        raise InputError(f"over: no coordinate {unknown[0]!r} to map over; there are {', '.join(valid)}")
    if not 1 <= len(names) <= 2 or len(set(names)) < len(names):
        raise InputError(f"over: one or two different names of {', '.join(valid)}")
    labels = [name_of(task, k) for k in range(mechanism.d)]
    return task, np.array([labels.index(name) for name in names], np.intp), names


def _refuse_large(task: Task, cells: int, axes: int) -> None:
    mechanism = task.extended.mechanism
    size = 8.0 * cells**axes * task.extended.closure.rows * mechanism.n
    if size > MEMORY:
        most = int((MEMORY / (size / cells**axes)) ** (1 / axes))
        raise InputError(f"cells = {cells}: a map of {mechanism.name} takes at most {most} along an axis")


def _joints(task: Task, chosen: IntArray, names: Sequence[str], cells: int) -> Domain:
    return Domain(task, chosen, tuple(joint_axis(task, int(k), name, cells) for k, name in zip(chosen, names,
                                                                                             strict=True)))  # fmt: skip


def _window(task: Task, chosen: IntArray, names: Sequence[str], starts: Array, cells: int) -> Domain:
    """Return the Cartesian window that the branches reach: looked at in ever smaller ones that still hold them."""
    middle = nodes_at(task, task.extended.mechanism.q_tree[None]).values[0][chosen]
    low, high = middle - reach(task), middle + reach(task)
    for _ in range(6):
        domain = _box(task, chosen, names, low, high, FIRST_LOOK)
        reached = np.array([fill(domain, start, HURRIED).reached for start in starts]).any(axis=0).reshape(domain.shape)
        cell = (high - low) / FIRST_LOOK
        tight_low, tight_high = middle.copy(), middle.copy()
        for k, axis in enumerate(domain.axes):
            inside = axis.values[np.any(reached, axis=1 - k)]
            tight_low[k] = min(middle[k], *inside) if len(inside) else middle[k]
            tight_high[k] = max(middle[k], *inside) if len(inside) else middle[k]
        tight_low, tight_high = np.maximum(tight_low - MARGIN * cell, low), np.minimum(tight_high + MARGIN * cell, high)
        shrinks = np.any(tight_high - tight_low < 0.7 * (high - low))
        low, high = tight_low, tight_high
        if not shrinks:
            break
    return _box(task, chosen, names, low, high, cells)


def _box(task: Task, chosen: IntArray, names: Sequence[str], low: Array, high: Array, cells: int) -> Domain:
    axes = tuple(
        Axis(name, "m", float(a), float(b), False, middles(float(a), float(b), cells))
        for name, a, b in zip(names, low, high, strict=True)
    )
    return Domain(task, chosen, axes)


# --- What has been computed as the plain value `SingularityMap`.


def map_value(
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
    """Put aspects that reach something, their loci and a trajectory together."""
    mechanism, domain = extended.mechanism, grids[0].domain
    square = mechanism.assembled.phi_z.shape[0] == mechanism.assembled.phi_z.shape[1]
    start = grids[0].given[np.flatnonzero(grids[0].reached)[0]]
    return SingularityMap(
        mechanism=mechanism.name,
        space=space,
        point=extended.point,
        axes=domain.axes,
        fixed={name_of(domain.task, k): float(np.round(start[k], 12)) + 0.0 for k in domain.fixed},
        measure="det phi_z" if square else "sigma_min(phi_z)",
        measure_unit=_unit(mechanism) if square else "",
        aspects=tuple(_aspect(extended, grid, square) for grid in grids),
        more_branches=more_branches,
        loci=tuple(loci),
        path=path,
        seconds=seconds,
        notes=notes,
    )


def name_of(task: Task, k: int) -> str:
    """Name a given row of a task."""
    extended, row = task.extended, int(task.rows[k])
    if len(extended.place) and row >= extended.place[0]:
        return extended.axis(row)
    return extended.mechanism.independent[k]


def _aspect(extended: ExtendedClosure, grid: Grid, square: bool) -> Aspect:
    mechanism, shape = extended.mechanism, grid.domain.shape
    inside = np.flatnonzero(grid.reached)
    phi_z = grid.J[inside][:, : len(extended.loops)][:, :, mechanism.partition.z]
    det = np.full(len(grid.reached), np.nan)
    det[inside] = np.linalg.det(phi_z) if square else np.linalg.svd(phi_z, compute_uv=False)[:, -1]
    place = np.full((len(grid.reached), 3), np.nan)
    if extended.point is not None:
        place[inside] = _positions(extended, grid.q_tree[inside])
    return Aspect(
        reached=grid.reached.reshape(shape),
        det_phi_z=det.reshape(shape),
        q_tree=grid.q_tree.reshape(*shape, -1),
        point=None if extended.point is None else place.reshape(*shape, 3),
    )


def _positions(extended: ExtendedClosure, q_tree: Array) -> Array:
    """World positions of the point at configurations (count, nq), shape (count, 3)."""
    mechanism = extended.mechanism
    frame = mechanism.points[str(extended.point)]
    pose = ManyPoses(mechanism.tree, mechanism.closure.anchors, q_tree)
    joints = mechanism.tree.model.njoints
    rotation = pose.rotation.reshape(-1, joints, 3, 3)[:, frame.joint]
    return np.asarray(rotation @ frame.translation + pose.translation.reshape(-1, joints, 3)[:, frame.joint])


def located(extended: ExtendedClosure, locus: Locus) -> Locus:
    """Say where the point is along a locus."""
    return locus if extended.point is None else replace(locus, point=_positions(extended, locus.q_tree))


def _unit(mechanism: Mechanism) -> str:
    """The unit of det phi_z: metres for each row that is a length, over those of the columns that are."""
    power = int(np.sum(mechanism.closure.in_metres(mechanism.tree)))
    power -= int(np.sum(mechanism.tree.in_metres[mechanism.partition.z]))
    return "" if power == 0 else "m" if power == 1 else f"m^{power}"
