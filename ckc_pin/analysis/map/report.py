"""Tables of singularity maps for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ckc_pin.kinematics.mapped import LABELS, Locus, NearestSingular, Path, SingularityMap

__all__ = ["make_map_table", "make_sections_table", "sections_to_dict"]


def make_map_table(result: SingularityMap) -> Group:
    """Return branches, loci and the desired trajectory of a map as tables."""
    space = f"place of {result.point}" if result.space == "cartesian" else "independent coordinates"
    over = ", ".join(f"{a.name} {a.low:.4g} ... {a.high:.4g} {a.unit}" for a in result.axes)
    fixed = f"; fixed: {', '.join(f'{k} = {x:.4g}' for k, x in result.fixed.items())}" if result.fixed else ""
    size = " x ".join(str(len(axis.values)) for axis in result.axes)
    parts: list[Any] = [
        Text(f"{result.mechanism}, {space}: {over}{fixed}"),
        Text(f"{size} cells, {result.seconds:.2f} s"),
    ]
    loci = _loci_table(result) if result.loci else Text("no singular configurations found")
    parts += ["", _branch_table(result), "", loci]
    if result.path is not None:
        parts += ["", *_path_table(result, result.path)]
    return Group(*parts, *(Text(note) for note in result.notes))


def sections_to_dict(sections: Sequence[SingularityMap]) -> dict[str, Any]:
    """Return sections of a workspace as JSON-ready data."""
    first = sections[0]
    return {
        "mechanism": first.mechanism,
        "point": first.point,
        "sections": [section.to_dict() for section in sections],
    }


def make_sections_table(sections: Sequence[SingularityMap]) -> Group:
    """Return sections of a workspace as a table: height, area, range of det phi_z, singular curves."""
    first = sections[0]
    over = ", ".join(f"{a.name} {a.low:.4g} ... {a.high:.4g} {a.unit}" for a in first.axes)
    cell_area = float(np.prod([(a.high - a.low) / len(a.values) for a in first.axes]))
    (fixed,) = first.fixed
    table = _make_table(f"{fixed} (m)", "area reached (m²)", f"{first.measure} from", "to", "singular curves")
    for section in sections:
        (aspect,) = section.aspects
        kinds = [_short_label(locus) for locus in section.loci if locus.on.any()]
        curves = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        table.add_row(
            f"{section.fixed[fixed]:.4f}",
            f"{cell_area * np.sum(aspect.reached):.4f}",
            f"{np.nanmin(aspect.det_phi_z):.4g}",
            f"{np.nanmax(aspect.det_phi_z):.4g}",
            curves,
        )
    head = f"{first.mechanism}, place of {first.point} in sections of the working mode as assembled: {over}"
    return Group(Text(head), Text(f"{first.seconds:.2f} s"), "", table)


def _branch_table(result: SingularityMap) -> Table:
    kind = "working mode" if result.space == "cartesian" and len(result.axes) == 2 else "branch"
    table = _make_table(kind, "reached", f"{result.measure} from", "to")
    for k, aspect in enumerate(result.aspects):
        smallest, largest = float(np.nanmin(aspect.det_phi_z)), float(np.nanmax(aspect.det_phi_z))
        assembled = " (as assembled)" if k == 0 else ""
        table.add_row(f"{k + 1}{assembled}", f"{np.mean(aspect.reached):.4f}", f"{smallest:.4g}", f"{largest:.4g}")
    if result.more_branches:
        table.add_row("there are or may be others", "", "", "")
    return table


def _loci_table(result: SingularityMap) -> Group:
    table = _make_table("", "locus", "residual", *(f"{axis.name} ({axis.unit})" for axis in result.axes))
    for k, locus in enumerate(result.loci):
        curve = "" if locus.is_point else ", closed" if locus.closed else ", curve"
        table.add_row(str(k + 1), _short_label(locus) + curve, f"{locus.residual:.0e}", *_extent(result, locus))
    kinds = dict.fromkeys(LABELS[locus.kind] for locus in result.loci)
    return Group(table, *(Text(label) for label in kinds))


def _extent(result: SingularityMap, locus: Locus) -> list[str]:
    """Return the range of a locus along each axis, or its place if it is a point."""
    if locus.is_point:
        return [f"{_wrap(x) if axis.turns else x:.9f}" for x, axis in zip(locus.at[0], result.axes, strict=True)]
    low, high = locus.at.min(axis=0), locus.at.max(axis=0)
    return [f"{a:.4f} ... {b:.4f}" for a, b in zip(low, high, strict=True)]


def _short_label(locus: Locus) -> str:
    return LABELS[locus.kind].partition(":")[0].partition(" (")[0]


def _path_table(result: SingularityMap, path: Path) -> list[Any]:
    """Return a sentence about the desired trajectory, and its closest approach to each locus."""
    if path.leaves_at is not None:
        outcome = f"leaves the workspace at t = {path.leaves_at:.5f} s"
    else:
        outcome = f"stays inside; least sigma_min(phi_z) = {path.sigma_min:.4g} at t = {path.closest_t:.4f} s"
    unit = " or ".join(dict.fromkeys(axis.unit for axis in result.axes))
    distance = "within section" if result.fixed else "distance"
    table = _make_table("closest to locus", f"{distance} ({unit})", "at t (s)", "desired there")
    for a in path.approaches:
        place = "(" + ", ".join(f"{x:.5f}" for x in a.at) + ")"
        label = _short_label(result.loci[a.locus])
        table.add_row(f"{a.locus + 1}, {label}", f"{a.distance:.6f}", f"{a.t:.5f}", place)
    parts: list[Any] = [Text(f"desired, {path.name}: {outcome}"), table]
    if result.fixed:
        fixed = ", ".join(f"{name} = {x:.4g}" for name, x in result.fixed.items())
        parts.append(Text(f"Distances in this table are over the axes only, within this section ({fixed})."))
    if path.leaves_at is None:
        parts.append(Text(f"nearest singular phi_z in all of q: {_describe_nearest(path.nearest)}"))
    return parts


def _describe_nearest(nearest: NearestSingular | None) -> str:
    if nearest is None:
        return "none was found"
    desired, singular = ("(" + ", ".join(f"{x:.5f}" for x in q) + ")" for q in (nearest.q_d, nearest.q))
    label = LABELS[nearest.kind].partition(":")[0]
    where = f"at t = {nearest.t:.5f} s from desired {desired} to {singular}"
    return f"{nearest.distance:.6f} {nearest.unit}, {label}, {where}"


def _wrap(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _make_table(*titles: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for title in titles:
        table.add_column(title, no_wrap=True)
    return table
