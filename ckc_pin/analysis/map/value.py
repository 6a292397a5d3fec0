"""What has been computed as the plain value `SingularityMap`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ckc_pin.analysis.map.aspect import Grid
from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.extended import Extended, Task
from ckc_pin.kinematics.mapped import Aspect, Locus, Path, SingularityMap, Space
from ckc_pin.mechanism.batch import ManyPoses
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["located", "map_value", "name_of"]


def map_value(
    extended: Extended,
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


def _aspect(extended: Extended, grid: Grid, square: bool) -> Aspect:
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


def _positions(extended: Extended, q_tree: Array) -> Array:
    """World positions of the point at configurations (count, nq), shape (count, 3)."""
    mechanism = extended.mechanism
    frame = mechanism.points[str(extended.point)]
    pose = ManyPoses(mechanism.tree, mechanism.closure.anchors, q_tree)
    joints = mechanism.tree.model.njoints
    rotation = pose.rotation.reshape(-1, joints, 3, 3)[:, frame.joint]
    return np.asarray(rotation @ frame.translation + pose.translation.reshape(-1, joints, 3)[:, frame.joint])


def located(extended: Extended, locus: Locus) -> Locus:
    """Say where the point is along a locus."""
    return locus if extended.point is None else replace(locus, point=_positions(extended, locus.q_tree))


def _unit(mechanism: Mechanism) -> str:
    """The unit of det phi_z: metres for each row that is a length, over those of the columns that are."""
    power = int(np.sum(mechanism.closure.in_metres(mechanism.tree)))
    power -= int(np.sum(mechanism.tree.in_metres[mechanism.partition.z]))
    return "" if power == 0 else "m" if power == 1 else f"m^{power}"
