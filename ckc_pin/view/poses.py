"""Panels in space: a mechanism's poses on planes that have names, hinges as rings, slides as rails and sliders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.view import style
from ckc_pin.view.canvas import Slot
from ckc_pin.view.group import Group, columns
from ckc_pin.view.labels import rate_symbol, symbol, with_unit
from ckc_pin.view.outline import base, outline
from ckc_pin.view.panels import unit_of
from ckc_pin.view.skeleton import Placements, Projection, placements

__all__ = ["INITIAL", "PATH", "TARGET", "configuration_space", "linkage", "snapshots"]

SNAPSHOTS = 5
WIDEST = 0.85  # of the colour map: beyond it is too pale for print
RING = 3.4  # pt
INITIAL, TARGET, PATH = style.COLOURS[:3]


def configuration_space(slot: Slot, group: Group) -> None:
    """Draw two independent coordinates against each other, or the phase plane of a single one."""
    (ax,) = slot.axes()
    single = len(group.independent) == 1
    for run, shape in zip(group.runs, group.lines, strict=True):
        own = columns(run, run.independent)
        x, y = _two(run, run.q_tree[:, own], run.v_tree[:, own])
        ax.plot(x, y, color=PATH, **shape)
        ax.plot(x[:1], y[:1], linestyle="none", marker="o", markersize=4.5, color=PATH)
    for run, wanted in group.desired:
        x, y = _two(run, wanted.q, wanted.q_dot)
        if len(np.unique(np.column_stack([x, y]), axis=0)) == 1:
            ax.plot(x[:1], y[:1], linestyle="none", marker="x", markersize=5.5, color="black")
        else:
            ax.plot(x, y, linestyle=":", linewidth=1.2, color="black")
    names = group.independent[:2]
    own_units = [unit_of(group, name) for name in names]
    shown = [with_unit(symbol(name), unit) for name, unit in zip(names, own_units, strict=True)]
    ax.set_xlabel(shown[0])
    ax.set_ylabel(with_unit(rate_symbol(names[0]), f"{own_units[0]}/s") if single else shown[1])
    ax.margins(0.08)
    if not single and len(set(own_units)) == 1:
        ax.set_aspect("equal", adjustable="datalim")


def _two(run: Run, q: Array, q_dot: Array) -> tuple[Array, Array]:
    return (q[:, 0], q_dot[:, 0]) if len(run.independent) == 1 else (q[:, 0], q[:, 1])


def linkage(slot: Slot, group: Group, plane: Projection) -> None:
    """Draw the initial configuration in blue, the desired ones in red, and the ways of the points between."""
    mechanism, run = group.mechanism, group.runs[0]
    (ax,) = slot.axes()
    poses = [(mechanism.tree.from_coordinates(run.q_tree[0]), INITIAL)]
    for _, wanted in group.desired:
        target = sigma(mechanism, wanted.q[-1])
        if target.verdict == "converged":
            poses.append((target.at.q_tree, TARGET))
    rows = np.array([row for row, _ in poses])
    for path in run.points.values():
        ax.plot(*(plane.axes @ path.T), color=style.GREY, linewidth=0.8, linestyle=":")
    moved = placements(mechanism, rows)
    _base(ax, mechanism, moved, plane)
    for k, (_, colour) in enumerate(poses):
        _pose(ax, mechanism, moved.row(k), plane, colour, 1.8)
    _frame(ax, plane)


def snapshots(slots: Sequence[Slot], group: Group, planes: Sequence[Projection]) -> Any:
    """Draw the first run's poses at equal times on planes, the first and the last broader; return the colours."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    mechanism, run = group.mechanism, group.runs[0]
    end = min(group.shown, float(run.t[-1]))
    dark = ListedColormap(colormaps["viridis"](np.linspace(0.0, WIDEST, 256)))
    shades = ScalarMappable(Normalize(0.0, end or 1.0), dark)
    rows = [run.at(float(t)) for t in np.linspace(0.0, end, SNAPSHOTS)]
    moved = placements(mechanism, np.array([mechanism.tree.from_coordinates(run.q_tree[row]) for row in rows]))
    for slot, plane in zip(slots, planes, strict=True):
        (ax,) = slot.axes()
        for path in run.points.values():
            ax.plot(*(plane.axes @ path[run.t <= end].T), color=style.GREY, linewidth=0.8, linestyle=":")
        _base(ax, mechanism, moved, plane)
        for k, row in enumerate(rows):
            _pose(ax, mechanism, moved.row(k), plane, shades.to_rgba(run.t[row]),
                  1.8 if k in (0, len(rows) - 1) else 0.9)  # fmt: skip
        _frame(ax, plane)
    return shades


# --- parts ---------------------------------------------------------------------------------------


def _base(ax: Any, mechanism: Mechanism, moved: Placements, plane: Projection) -> None:
    """Draw what stands still: the base, and its rails as far as sliders go on them in the poses shown."""
    bars, rails = base(mechanism, moved, plane)
    for bar in bars:
        ax.plot(*bar.T, color=style.GREY, linewidth=3.0, zorder=1, alpha=0.5 if rails else 1.0)
    for rail in rails:
        ax.plot(*rail.T, color="black", linewidth=1.0, zorder=2, marker="|", markersize=5)


def _pose(ax: Any, mechanism: Mechanism, at: Placements, plane: Projection, colour: Any, thick: float) -> None:
    from matplotlib.patches import Polygon

    drawn = outline(mechanism, at, plane)
    for bar in drawn.bars:
        ax.plot(*bar.T, color=colour, linewidth=thick, zorder=3)
    for block in drawn.blocks:
        ax.add_patch(Polygon(block, facecolor="white", edgecolor=colour, linewidth=1.1, zorder=4))
    if len(drawn.rings):
        ax.plot(*drawn.rings.T, color=colour, linestyle="none", marker="o", markersize=RING,
                markerfacecolor="white", markeredgewidth=min(thick, 1.0), zorder=4)  # fmt: skip


def _frame(ax: Any, plane: Projection) -> None:
    ax.set_xlabel(with_unit(plane.names[0], "m"))
    ax.set_ylabel(with_unit(plane.names[1], "m"))
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="datalim")
