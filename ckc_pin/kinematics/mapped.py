"""The singularity map of a mechanism as data: workspace, branches and curves of singular configurations."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.tables import require_distinct, to_csv_text, to_data_frame
from ckc_pin.base.validation import require_path

if TYPE_CHECKING:
    import pandas

    from ckc_pin.view.inline import Figures

__all__ = [
    "LABELS",
    "Approach",
    "Aspect",
    "Axis",
    "Kind",
    "Locus",
    "NearestSingular",
    "Path",
    "SingularityMap",
    "Space",
]

Space = Literal["joint", "cartesian"]
Kind = Literal["locked", "fold", "rank loss", "serial"]

POINT_TOLERANCE = 1e-9  # rad or m; a locus of a smaller extent in the map is a point

# Types of singular configurations, in the paper's terms and in those of parallel robots.
LABELS: dict[Kind, str] = {
    "locked": "type 1: parallel (second kind), q locked",
    "fold": "type 2: parallel (second kind), two branches meet",
    "rank loss": "J loses rank",
    "serial": "serial (first kind): q moves, the point does not",
}


@dataclass(frozen=True)
class Axis:
    """One axis of a map.

    Attributes
    ----------
    name : str
        A coordinate, or x, y, z of a point.
    unit : "rad" or "m"
    low, high : float
    turns : bool
        Whether the axis is a full turn, so that both ends are the same.
    values : (count,) array
        Centres of the cells.
    """

    name: str
    unit: str
    low: float
    high: float
    turns: bool
    values: Array


@dataclass(frozen=True)
class Aspect:
    """The region that one branch reaches without passing a singular configuration.

    A branch is an assembly branch in joint space, and a working mode in Cartesian space.

    Attributes
    ----------
    reached : (n_1, n_2) array of bool
        n_2 = 1 in a map over one coordinate.
    det_phi_z : (n_1, n_2) array
        NaN where not reached. The smallest singular value if phi_z is not square.
    sigma_min : (n_1, n_2) array
        Smallest singular value of phi_z, NaN where not reached.
    q_tree : (n_1, n_2, nq) array
        The configurations, NaN where not reached.
    coordinates : (n_1, n_2, n) array
        The same by coordinate; a free root has its position and rotation vector.
    point : (n_1, n_2, 3) array or None
        Position of the mechanism's point, metres.
    """

    reached: BoolArray
    det_phi_z: Array
    sigma_min: Array
    q_tree: Array
    coordinates: Array
    point: Array | None


@dataclass(frozen=True)
class Locus:
    """A curve of singular configurations; a point where q is locked, or in a map over one axis.

    Attributes
    ----------
    kind : "locked" (type 1), "fold" (type 2), "rank loss" or "serial"
    q_tree : (m, nq) array
        Configurations along the curve.
    at : (m, axes) array
        Coordinates in the map; angles are not wrapped.
    point : (m, 3) array or None
    on : (aspects, m) array of bool
        Whether each aspect borders on each point of the curve.
    closed : bool
    residual : float
        Largest residual of the singularity equations, m and rad.
    """

    kind: Kind
    q_tree: Array
    at: Array
    point: Array | None
    on: BoolArray
    closed: bool
    residual: float

    @property
    def is_point(self) -> bool:
        """Whether the map shows the curve as one point, because only coordinates that are not its axes change."""
        return bool(np.ptp(self.at, axis=0).max() < POINT_TOLERANCE)


@dataclass(frozen=True)
class Approach:
    """The closest approach of a trajectory to a locus, in the units of the map.

    The distance is measured over the axes of the map. If the map has fixed coordinates, both are within its section:
    the locus of other sections may be nearer, and the trajectory need not be in the section. `NearestSingular` is
    measured in all of q.

    Attributes
    ----------
    locus : int
        Number of the locus.
    distance, t : float
    at, to : (axes,) arrays
        Nearest points of the trajectory and of the locus.
    """

    locus: int
    distance: float
    t: float
    at: Array
    to: Array


@dataclass(frozen=True)
class NearestSingular:
    """The singular configuration on a trajectory's assembly branch that is nearest to the trajectory in all of q.

    Attributes
    ----------
    kind : "locked", "fold" or "rank loss"
        phi_z is singular there.
    distance : float
        Smallest |q_s - q_d(t)|.
    unit : "rad", "m" or "rad or m"
        Of the independent coordinates, whose squares are added without weights.
    t : float
        s.
    q_d, q : (d,) arrays
        The trajectory at t, and the singular configuration q_s, in `independent` order.
    """

    kind: Kind
    distance: float
    unit: str
    t: float
    q_d: Array
    q: Array


@dataclass(frozen=True)
class Path:
    """The desired trajectory of a scene in the map.

    Attributes
    ----------
    name : str
    t : (m,) array
        Seconds; in Cartesian space until the trajectory cannot be followed further.
    at : (m, axes) array
    on : (aspects, m) array of bool
        Whether each aspect contains each point of the trajectory.
    leaves_at : float or None
    closest_t, sigma_min : float
        Time at which phi_z is closest to singular, and its smallest singular value then.
    approaches : tuple of Approach
        The closest approach to each locus, the nearest first.
    nearest : NearestSingular or None
        None if the trajectory leaves the workspace, or if none was found.
    """

    name: str
    t: Array
    at: Array
    on: BoolArray
    leaves_at: float | None
    closest_t: float
    sigma_min: float
    approaches: tuple[Approach, ...]
    nearest: NearestSingular | None


@dataclass(frozen=True, repr=False)
class SingularityMap(HasSummary):
    """Workspace, branches and singular configurations of a mechanism, as in Fig. 2 of the paper.

    Attributes
    ----------
    mechanism : str
    coordinates : tuple of str
        Names of the tree's coordinates.
    space : "joint" or "cartesian"
    point : str or None
        The point for serial singularities and for Cartesian space.
    axes : tuple of Axis
        One or two.
    fixed : dict of str to float
        Values of the coordinates that are not axes.
    measure : "det phi_z" or "sigma_min(phi_z)"
    measure_unit : str
    aspects : tuple of Aspect
        The assembled branch first.
    more_branches : bool
        Whether the mechanism has further branches.
    loci : tuple of Locus
    path : Path or None
    seconds : float
        Computing time of the aspects, s.
    notes : tuple of str
    """

    mechanism: str
    coordinates: tuple[str, ...]
    space: Space
    point: str | None
    axes: tuple[Axis, ...]
    fixed: dict[str, float]
    measure: str
    measure_unit: str
    aspects: tuple[Aspect, ...]
    more_branches: bool
    loci: tuple[Locus, ...]
    path: Path | None
    seconds: float
    notes: tuple[str, ...] = field(default=())

    def summary(self) -> Summary:
        """Return axes, fixed coordinates, branches, loci, the desired trajectory and notes."""
        rows: list[Row] = [(a.name, f"{a.low:.4g} to {a.high:.4g} {a.unit}, {len(a.values)} cells") for a in self.axes]
        rows += (
            [("fixed", format_quantities(list(self.fixed), np.array(list(self.fixed.values()))))] if self.fixed else []
        )
        rows.append(("branches", f"{len(self.aspects)}{', and more' if self.more_branches else ''}"))
        rows.append(("loci", f"{len(self.loci)}: where {self.measure} or J is singular"))
        if self.path is not None:
            rows.append(("desired", self.path.name))
        rows += [("note", note) for note in self.notes]
        where = "independent coordinates" if self.point is None or self.space == "joint" else f"place of {self.point}"
        return Summary(f"Singularity map of {self.mechanism} over {where}", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of the map as JSON-ready data, with the loci as curves over the map's axes."""
        path = self.path
        return {
            "mechanism": self.mechanism,
            "space": self.space,
            "point": self.point,
            "axes": [
                {"name": a.name, "unit": a.unit, "low": a.low, "high": a.high, "cells": len(a.values)}
                for a in self.axes
            ],
            "held": self.fixed,
            "measure": self.measure,
            "branches": [
                {
                    "reached": float(np.mean(aspect.reached)),
                    "least": float(np.nanmin(aspect.det_phi_z)),
                    "largest": float(np.nanmax(aspect.det_phi_z)),
                }
                for aspect in self.aspects
            ],
            "more_branches": self.more_branches,
            "loci": [
                {
                    "kind": locus.kind,
                    "label": LABELS[locus.kind],
                    "closed": locus.closed,
                    "residual": locus.residual,
                    "branches": np.flatnonzero(np.any(locus.on, axis=1)).tolist(),
                    "at": (locus.at[:1] if locus.is_point else locus.at).tolist(),
                }
                for locus in self.loci
            ],
            "desired": None
            if path is None
            else {
                "scene": path.name,
                "leaves_at": path.leaves_at,
                "closest_t": path.closest_t,
                "sigma_min": path.sigma_min,
                "within_section": bool(self.fixed),
                "approaches": [
                    {
                        "locus": a.locus,
                        "kind": self.loci[a.locus].kind,
                        "distance": a.distance,
                        "t": a.t,
                        "at": a.at.tolist(),
                        "to": a.to.tolist(),
                    }
                    for a in path.approaches
                ],
                "nearest": None
                if path.nearest is None
                else {
                    "kind": path.nearest.kind,
                    "distance": path.nearest.distance,
                    "unit": path.nearest.unit,
                    "t": path.nearest.t,
                    "q_d": path.nearest.q_d.tolist(),
                    "q": path.nearest.q.tolist(),
                },
            },
            "seconds": self.seconds,
            "notes": list(self.notes),
        }

    def plot(self) -> Figures:
        """Draw the map. A notebook shows the figure and `save(folder)` writes it."""
        import ckc_pin

        return ckc_pin.plot(self)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the reached cells as a pandas DataFrame by branch (needs the extra `data`).

        A row is a cell that a branch reaches. The columns are the tree's coordinates, the position of the map's point
        if it has one, as ``tip.x``, the smallest singular value of phi_z, ``sigma_min``, and ``det_phi_z`` if phi_z is
        square. The index is the number of the branch, 1 for the assembled one.
        """
        return to_data_frame("branch", *self._table("SingularityMap.to_pandas"))

    def to_csv(self, path: str | FilePath) -> FilePath:
        """Write the table of `to_pandas` as CSV, with all digits of each number.

        Raises
        ------
        InputError
            The file cannot be written, or a joint has the name of another column.
        """
        require_path(path, "SingularityMap.to_csv: path")
        write_atomic(FilePath(path), to_csv_text("branch", *self._table("SingularityMap.to_csv")))
        return FilePath(path)

    def _table(self, where: str) -> tuple[IntArray, dict[str, Array]]:
        """Return the branch of each reached cell, and the columns by name."""
        blocks = [np.concatenate([aspect.coordinates[aspect.reached] for aspect in self.aspects])]
        names = list(self.coordinates)
        points = [aspect.point[aspect.reached] for aspect in self.aspects if aspect.point is not None]
        if points:
            blocks.append(np.concatenate(points))
            names += [f"{self.point}.{axis}" for axis in "xyz"]
        for name in ("sigma_min", "det_phi_z") if self.measure.startswith("det") else ("sigma_min",):
            blocks.append(np.concatenate([getattr(aspect, name)[aspect.reached] for aspect in self.aspects])[:, None])
            names.append(name)
        branches = np.repeat(np.arange(1, len(self.aspects) + 1), [aspect.reached.sum() for aspect in self.aspects])
        return branches, require_distinct(zip(names, np.hstack(blocks).T, strict=True), "branch", where)

    @property
    def counts(self) -> IntArray:
        """Number of aspects that reach each cell, shape (n_1, n_2)."""
        return np.sum([aspect.reached for aspect in self.aspects], axis=0, dtype=np.intp)
