"""The panels that figures are made of. Each takes an axes and a `Group`, draws, and labels its axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.run import Run
from ckc_pin.view import style
from ckc_pin.view.desired import DesiredPath
from ckc_pin.view.labels import effort_units, plain, run_labels, symbol, units
from ckc_pin.view.skeleton import Placements, placements, sticks, viewpoint

__all__ = ["Group", "configuration_space", "coordinates", "efforts", "errors", "linkage", "loop_forces", "rates",
           "scalar", "snapshots"]  # fmt: skip

SETTLED = 0.01  # of the error at the start
DOTS = 40  # of a desired curve
SNAPSHOTS = 9
LOOPS_NAMED = 6  # more would hide their curves
INITIAL, TARGET, PATH = style.COLOURS[:3]


@dataclass(frozen=True)
class Group:
    """Runs of one mechanism under one kind of control, to be drawn on each other.

    Attributes
    ----------
    kind : "set_point", "tracking", "own" (a controller that is not the scene's) or "motion"
    runs : list of Run
        In drawing order.
    wanted : list of DesiredPath or None
    """

    kind: str
    runs: list[Run]
    wanted: list[DesiredPath | None]

    @property
    def mechanism(self) -> Mechanism:
        """The first run's; the others have the same coordinates."""
        return self.runs[0].mechanism

    @property
    def independent(self) -> tuple[str, ...]:
        """The independent coordinates."""
        return self.runs[0].independent

    @cached_property
    def lines(self) -> list[dict[str, Any]]:
        """Each run's line."""
        return style.lines(self.runs)

    @cached_property
    def labels(self) -> list[str]:
        """Each run's name."""
        ends = ["" if r.status == "done" else f" ({r.status} at {r.t[-1]:.4g} s)" for r in self.runs]
        return [plain(label) + end for label, end in zip(run_labels(self.runs), ends, strict=True)]

    @cached_property
    def colours(self) -> dict[str, Any]:
        """A colour for each coordinate, the independent ones first, and for motors that have names of their own."""
        rest = [name for name in self.runs[0].coordinates if name not in self.independent]
        named = style.colours([*self.independent, *rest])
        own = [name for name in self.runs[0].actuated if name not in named]
        return {**named, **style.colours(own)}

    @cached_property
    def shown(self) -> float:
        """How much time the panels show, s: of a motion that settles early, its first part."""
        end = max(float(run.t[-1]) for run in self.runs)
        if self.kind != "set_point":
            return end
        settled = 0.0
        for run, wanted in zip(self.runs, self.wanted, strict=True):
            if wanted is not None:
                size = np.abs(run.q_tree[:, _columns(run, run.independent)] - wanted.q).max(axis=1)
                settled = max(settled, float(run.t[np.flatnonzero(size >= SETTLED * size[0])[-1]]))
        return min(end, 2.0 * settled) or end

    @cached_property
    def desired(self) -> list[tuple[Run, DesiredPath]]:
        """What was wanted, once where several runs want the same, as long as the longest of them."""
        found: dict[str, tuple[Run, DesiredPath]] = {}
        for run, wanted in sorted(zip(self.runs, self.wanted, strict=True), key=lambda pair: -pair[0].t[-1]):
            if wanted is not None:
                controller = run.scene["controller"]
                found.setdefault(repr(controller.get("desired", controller.get("q_d"))), (run, wanted))
        return list(found.values())


# --- over time -----------------------------------------------------------------------------------


def coordinates(ax: Any, group: Group, names: Sequence[str]) -> None:
    """Draw coordinates over time, what was wanted as dots."""
    _curves(ax, group, names, lambda run: run.q_tree[:, _columns(run, names)])
    _dots(ax, group, names, lambda wanted: wanted.q)
    _time(ax, group, f"$q$, {units(group.mechanism, names, 'rad', 'm')}")


def rates(ax: Any, group: Group, names: Sequence[str]) -> None:
    """Draw rates over time, what was wanted as dots where it moves."""
    _curves(ax, group, names, lambda run: run.v_tree[:, _columns(run, names)])
    if group.kind == "tracking":
        _dots(ax, group, names, lambda wanted: wanted.q_dot)
    _time(ax, group, rf"$\dot q$, {units(group.mechanism, names, 'rad/s', 'm/s')}")


def errors(ax: Any, group: Group) -> None:
    """Draw q - q_d over time."""
    for run, wanted, line in zip(group.runs, group.wanted, group.lines, strict=True):
        if wanted is not None:
            error = run.q_tree[:, _columns(run, run.independent)] - wanted.q
            for name, values in zip(run.independent, error.T, strict=True):
                ax.plot(run.t, values, color=group.colours[name], **line)
    _time(ax, group, rf"$q - q_d$, {units(group.mechanism, group.independent, 'rad', 'm')}")


def efforts(ax: Any, group: Group) -> None:
    """Draw the actuators' efforts over time; where a short peak dwarfs the rest, the rest again, enlarged."""
    names = group.runs[0].actuated
    _curves(ax, group, names, lambda run: run.tau)
    _time(ax, group, f"${effort_symbol(group)}$, {effort_units(group.mechanism)}")
    after = _peak_ends(group.runs, group.shown)
    if after is None:
        return
    later = np.concatenate([run.tau[run.t >= after].ravel() for run in group.runs])
    low, high = ax.get_ylim()
    room_above = high - later.max() > later.min() - low
    inset = ax.inset_axes((0.17, 0.44, 0.8, 0.46) if room_above else (0.17, 0.1, 0.8, 0.46))
    _curves(inset, group, names, lambda run: np.where((run.t >= after)[:, None], run.tau, np.nan))
    inset.set_title(f"the same from t = {after:.2g} s on", fontsize=8, color=style.GREY, pad=3)
    inset.tick_params(labelsize=8)


def scalar(ax: Any, group: Group, values: Callable[[Run], Array], label: str, dots: bool = False) -> None:
    """Draw one number over all of the time, a colour for each run; as dots where it is mostly rounding."""
    for k, (run, line) in enumerate(zip(group.runs, group.lines, strict=True)):
        look = {"linestyle": "none", "marker": ".", "markersize": 2.5 * line["linewidth"]} if dots else line
        ax.plot(run.t, values(run), color=style.COLOURS[k % len(style.COLOURS)], **look)
    _time(ax, group, label, max(float(run.t[-1]) for run in group.runs))


def loop_forces(ax: Any, group: Group) -> None:
    """Draw the size of each loop's force over time, N: of its multipliers those of rows that are lengths."""
    mechanism = group.mechanism
    metres = mechanism.closure.in_metres(mechanism.tree)
    loops = [loop for loop, _ in mechanism.closure.names]
    holding = list(dict.fromkeys(loop for loop, counted in zip(loops, metres, strict=True) if counted))
    colours = style.colours(holding)
    for run, line in zip(group.runs, group.lines, strict=True):
        for loop, forces in run.loop_forces().items():
            if loop in holding:
                own = metres[[name == loop for name in loops]]
                ax.plot(run.t, np.linalg.norm(forces[:, own], axis=1), color=colours[loop], **line)
    _time(ax, group, r"$|\lambda|$, N")
    if not holding:
        ax.text(0.5, 0.5, "no loop holds points together", ha="center", va="center", transform=ax.transAxes)
    shown = holding if len(holding) <= LOOPS_NAMED else [holding[0], holding[-1]]
    for loop in shown:
        ax.plot([], [], color=colours[loop], label=plain(loop))
    if shown:
        ax.legend(loc="upper right", ncols=min(len(shown), 3), fontsize=8)


def effort_symbol(group: Group) -> str:
    """Return u where the motors turn the independent joints themselves, as in the paper, else tau."""
    return "u" if group.mechanism.driven_directly else r"\tau"


def _curves(ax: Any, group: Group, names: Sequence[str], values: Callable[[Run], Array]) -> None:
    for run, line in zip(group.runs, group.lines, strict=True):
        for name, column in zip(names, values(run).T, strict=True):
            ax.plot(run.t, column, color=group.colours[name], **line)


def _dots(ax: Any, group: Group, names: Sequence[str], values: Callable[[DesiredPath], Array]) -> None:
    for run, wanted in group.desired:
        rows = np.unique(np.linspace(0, len(run.t) - 1, DOTS).astype(int))
        for name, column in zip(run.independent, values(wanted).T, strict=True):
            if name in names:
                ax.plot(run.t[rows], column[rows], linestyle="none", marker=".", markersize=5, color="black")


def _time(ax: Any, group: Group, label: str, end: float | None = None) -> None:
    whole = max(float(run.t[-1]) for run in group.runs)
    shown = end or group.shown
    ax.set_xlabel("t, s" if shown == whole else f"t, s (settled; {whole:g} s simulated)")
    ax.set_ylabel(label)
    if shown > 0:
        ax.set_xlim(-0.02 * shown, 1.02 * shown)


def _columns(run: Run, names: Sequence[str]) -> list[int]:
    return [run.column(name) for name in names]


def _peak_ends(runs: Sequence[Run], shown: float) -> float | None:
    """Return when the efforts fall below a fifth of their peak for good, if within a tenth of what is shown."""
    ends = []
    for run in runs:
        size = np.abs(run.tau).max(axis=1, initial=0.0)
        above = np.flatnonzero(size > 0.2 * size.max())
        if size.max() == 0 or above[-1] + 1 >= len(run.t) or run.t[above[-1] + 1] > 0.1 * shown:
            return None
        ends.append(float(run.t[above[-1] + 1]))
    return max(ends)


# --- in space ------------------------------------------------------------------------------------


def configuration_space(ax: Any, group: Group) -> None:
    """Draw the first two independent coordinates against each other, or the phase plane of a single one."""
    single = len(group.independent) == 1
    for run, line in zip(group.runs, group.lines, strict=True):
        x, y = _plane(run, run.q_tree[:, _columns(run, run.independent)], run.v_tree[:, _columns(run, run.independent)])
        ax.plot(x, y, color=PATH, **line)
        ax.plot(x[:1], y[:1], linestyle="none", marker="o", markersize=6, color=PATH)
    for run, wanted in group.desired:
        x, y = _plane(run, wanted.q, wanted.q_dot)
        if len(np.unique(np.column_stack([x, y]), axis=0)) == 1:
            ax.plot(x[:1], y[:1], linestyle="none", marker="x", markersize=7, color="black")
        else:
            ax.plot(x, y, linestyle=":", linewidth=1.4, color="black")
    names = group.independent[:2]
    own = [f"{symbol(name)}, {units(group.mechanism, [name], 'rad', 'm')}" for name in names]
    ax.set_xlabel(own[0])
    ax.set_ylabel(rf"$\dot q$, {units(group.mechanism, names, 'rad/s', 'm/s')}" if single else own[1])
    ax.margins(0.08)
    if not single:
        ax.set_aspect("equal", adjustable="datalim")


def _plane(run: Run, q: Array, q_dot: Array) -> tuple[Array, Array]:
    return (q[:, 0], q_dot[:, 0]) if len(run.independent) == 1 else (q[:, 0], q[:, 1])


def linkage(ax: Any, group: Group) -> None:
    """Draw the initial configuration in blue, the desired ones in red, and the ways of the points between."""
    mechanism, run = group.mechanism, group.runs[0]
    view = viewpoint(mechanism)[:2]
    for path in run.points.values():
        x, y = view @ path.T
        ax.plot(x, y, color=style.GREY, linewidth=1.0, linestyle=":")
    start = mechanism.tree.from_coordinates(run.q_tree[0])
    poses = [(start, INITIAL)]
    for _, wanted in group.desired:
        target = sigma(mechanism, wanted.q[-1])
        if target.verdict == "converged":
            poses.append((target.at.q_tree, TARGET))
    for q_tree, colour in poses:
        _draw_linkage(ax, mechanism, placements(mechanism, q_tree[None]), view, colour)
    ax.set_xlabel(_axis_name(view[0], "across"))
    ax.set_ylabel(_axis_name(view[1], "up"))
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="datalim")


def snapshots(ax: Any, group: Group) -> Any:
    """Draw the first run's poses at equal times, from dark to light, and the ways of its points; return the colours."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mechanism, run = group.mechanism, group.runs[0]
    view = viewpoint(mechanism)[:2]
    for path in run.points.values():
        ax.plot(*(view @ path[run.t <= group.shown].T), color=style.GREY, linewidth=1.0, linestyle=":")
    shades = ScalarMappable(Normalize(0.0, group.shown or 1.0), colormaps["viridis"])
    for t in np.linspace(0.0, group.shown, SNAPSHOTS):
        row = run.at(float(t))
        q_tree = mechanism.tree.from_coordinates(run.q_tree[row])
        _draw_linkage(ax, mechanism, placements(mechanism, q_tree[None]), view, shades.to_rgba(run.t[row]))
    ax.set_xlabel(_axis_name(view[0], "across"))
    ax.set_ylabel(_axis_name(view[1], "up"))
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="datalim")
    return shades


def _draw_linkage(ax: Any, mechanism: Mechanism, at: Placements, view: Array, colour: Any) -> None:
    for stick in sticks(mechanism):
        ends = view @ np.vstack([at.of(stick.joint, stick.start), at.of(stick.end_joint, stick.end)]).T
        base = stick.joint == stick.end_joint == 0
        ax.plot(*ends, color=style.GREY if base else colour, linewidth=4.0 if base else 2.4, zorder=1 if base else 3)
        if not base:
            ax.plot(
                *ends, color=colour, linestyle="none", marker="o", markersize=5.5, markerfacecolor="white", zorder=4
            )


def _axis_name(direction: Array, otherwise: str) -> str:
    for k, name in enumerate("xyz"):
        if abs(abs(direction[k]) - 1.0) < 1e-9:
            return f"{'-' if direction[k] < 0 else ''}{name}, m"
    return f"{otherwise}, m"
