"""A singularity map in numbers: as plain data and as tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ckc_pin.kinematics.mapped import LABELS, Locus, Path, SingularityMap

__all__ = ["map_plain", "map_table", "sections_plain", "sections_table"]

POINT = 1e-9  # of the map's units: a locus no larger is a point


def map_plain(found: SingularityMap) -> dict[str, Any]:
    """Return a map's numbers as JSON-ready data; the curves as their places in the map."""
    path = found.path
    return {
        "mechanism": found.mechanism,
        "space": found.space,
        "point": found.point,
        "axes": [{"name": a.name, "unit": a.unit, "low": a.low, "high": a.high, "cells": len(a.values)}
                 for a in found.axes],
        "held": found.fixed,
        "measure": found.measure,
        "branches": [
            {"reached": float(np.mean(aspect.reached)), "least": float(np.nanmin(aspect.det_phi_z)),
             "largest": float(np.nanmax(aspect.det_phi_z))}
            for aspect in found.aspects
        ],
        "more_branches": found.more_branches,
        "loci": [
            {"kind": locus.kind, "label": LABELS[locus.kind], "closed": locus.closed, "residual": locus.residual,
             "branches": np.flatnonzero(np.any(locus.on, axis=1)).tolist(),
             "at": (locus.at[:1] if _is_point(locus) else locus.at).tolist()}
            for locus in found.loci
        ],
        "desired": None if path is None else {
            "scene": path.name, "leaves_at": path.leaves_at, "closest_t": path.closest_t, "sigma_min": path.sigma_min,
            "approaches": [{"locus": a.locus, "kind": found.loci[a.locus].kind, "distance": a.distance, "t": a.t,
                            "at": a.at.tolist(), "to": a.to.tolist()} for a in path.approaches],
        },
        "seconds": found.seconds,
        "notes": list(found.notes),
    }  # fmt: skip


def map_table(found: SingularityMap) -> Group:
    """Return a map's numbers for people."""
    space = f"place of {found.point}" if found.space == "cartesian" else "independent coordinates"
    over = ", ".join(f"{a.name} {a.low:.4g} ... {a.high:.4g} {a.unit}" for a in found.axes)
    fixed = f"; fixed: {', '.join(f'{k} = {x:.4g}' for k, x in found.fixed.items())}" if found.fixed else ""
    size = " x ".join(str(len(axis.values)) for axis in found.axes)
    parts: list[Any] = [
        Text(f"{found.mechanism}, {space}: {over}{fixed}"),
        Text(f"{size} cells, {found.seconds:.2f} s"),
    ]
    parts += ["", _branches(found), "", _loci(found) if found.loci else Text("no singular configurations found")]
    if found.path is not None:
        parts += ["", *_desired(found, found.path)]
    return Group(*parts, *(Text(note) for note in found.notes))


def sections_plain(found: Sequence[SingularityMap]) -> dict[str, Any]:
    """Return sections of a workspace as JSON-ready data."""
    return {"mechanism": found[0].mechanism, "point": found[0].point, "sections": [map_plain(one) for one in found]}


def sections_table(found: Sequence[SingularityMap]) -> Group:
    """Return sections of a workspace for people."""
    first = found[0]
    over = ", ".join(f"{a.name} {a.low:.4g} ... {a.high:.4g} {a.unit}" for a in first.axes)
    cell = float(np.prod([(a.high - a.low) / len(a.values) for a in first.axes]))
    (fixed,) = first.fixed
    table = _table(f"{fixed} (m)", "area reached (m²)", f"{first.measure} from", "to", "singular curves")
    for one in found:
        (aspect,) = one.aspects
        kinds = [_short(locus) for locus in one.loci if locus.on.any()]
        curves = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        table.add_row(f"{one.fixed[fixed]:.4f}", f"{cell * np.sum(aspect.reached):.4f}",
                      f"{np.nanmin(aspect.det_phi_z):.4g}", f"{np.nanmax(aspect.det_phi_z):.4g}", curves)  # fmt: skip
    head = f"{first.mechanism}, place of {first.point} in sections of the working mode as assembled: {over}"
    return Group(Text(head), Text(f"{first.seconds:.2f} s"), "", table)


def _branches(found: SingularityMap) -> Table:
    what = "working mode" if found.space == "cartesian" and len(found.axes) == 2 else "branch"
    table = _table(what, "reached", f"{found.measure} from", "to")
    for k, aspect in enumerate(found.aspects):
        least, largest = float(np.nanmin(aspect.det_phi_z)), float(np.nanmax(aspect.det_phi_z))
        assembled = " (as assembled)" if k == 0 else ""
        table.add_row(f"{k + 1}{assembled}", f"{np.mean(aspect.reached):.4f}", f"{least:.4g}", f"{largest:.4g}")
    if found.more_branches:
        table.add_row("others are there, or may be", "", "", "")
    return table


def _loci(found: SingularityMap) -> Group:
    table = _table("", "locus", "residual", *(f"{axis.name} ({axis.unit})" for axis in found.axes))
    for k, locus in enumerate(found.loci):
        curve = "" if _is_point(locus) else ", closed" if locus.closed else ", curve"
        table.add_row(str(k + 1), _short(locus) + curve, f"{locus.residual:.0e}", *_where(found, locus))
    kinds = dict.fromkeys(LABELS[locus.kind] for locus in found.loci)
    return Group(table, *(Text(label) for label in kinds))


def _where(found: SingularityMap, locus: Locus) -> list[str]:
    if _is_point(locus):
        return [f"{_wrapped(x, axis.turns):.9f}" for x, axis in zip(locus.at[0], found.axes, strict=True)]
    low, high = locus.at.min(axis=0), locus.at.max(axis=0)
    return [f"{a:.4f} ... {b:.4f}" for a, b in zip(low, high, strict=True)]


def _short(locus: Locus) -> str:
    return LABELS[locus.kind].partition(":")[0].partition(" (")[0]


def _desired(found: SingularityMap, path: Path) -> list[Any]:
    if path.leaves_at is not None:
        says = f"leaves the workspace at t = {path.leaves_at:.5f} s"
    else:
        says = f"stays inside; least sigma_min(phi_z) = {path.sigma_min:.4g} at t = {path.closest_t:.4f} s"
    unit = " or ".join(dict.fromkeys(axis.unit for axis in found.axes))
    table = _table("closest to locus", f"distance ({unit})", "at t (s)", "desired there")
    for a in path.approaches:
        there = "(" + ", ".join(f"{x:.5f}" for x in a.at) + ")"
        table.add_row(f"{a.locus + 1}, {_short(found.loci[a.locus])}", f"{a.distance:.6f}", f"{a.t:.5f}", there)
    return [Text(f"desired, {path.name}: {says}"), table]


def _is_point(locus: Locus) -> bool:
    return bool(np.ptp(locus.at, axis=0).max() < POINT)


def _wrapped(x: float, turns: bool) -> float:
    return (x + np.pi) % (2 * np.pi) - np.pi if turns else x


def _table(*titles: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for title in titles:
        table.add_column(title, no_wrap=True)
    return table
