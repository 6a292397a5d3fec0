"""Figures of runs: the paper's Fig. 3 and Fig. 4, uncontrolled motion, and what a careful reader checks.

Runs of one mechanism under one kind of control are drawn on each other: colour by coordinate, line by formulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import require_path
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined, motor_units, row_units
from ckc_pin.run.run import Run
from ckc_pin.view import panels, poses, style
from ckc_pin.view.canvas import Slot, fit_legend, line, look, page, write
from ckc_pin.view.desired import desired_along
from ckc_pin.view.given_runs import given_runs
from ckc_pin.view.group import Group
from ckc_pin.view.labels import plain, symbol, with_unit
from ckc_pin.view.skeleton import planes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FORMATS", "draw", "plot", "require_formats", "write_figures"]

FORMATS = ("png", "svg", "pdf")
TITLES = {
    "set_point": "set-point control",
    "tracking": "tracking control",
    "own": "own controller",
    "motion": "motion without control",
}
PAPER = {"five_bar/set_point": "Fig. 3, eq. 14", "five_bar/tracking": "Fig. 4, eq. 16"}  # its own scenes
STEADY = 4.0  # s, from when on the paper speaks of steady state
ALL_MAX = 12  # coordinates of a motion; of more only the independent ones are shown
PANEL = (style.WIDTH / 2, 1.95)  # in
TALLER = 0.6  # in, of a panel of two units
SMALL = 1.15  # in, the height of one of many panels
LEAST = 0.01  # of the largest of them, how much any one shows


def plot(runs: Run | Sequence[Run], out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Draw runs and write the figures.

    Parameters
    ----------
    runs : Run or sequence of Run
        Those of one mechanism under one kind of control share a figure.
    out_dir : path
        A folder; made when missing.
    formats : sequence of "png", "svg", "pdf"

    Returns
    -------
    list of Path
        The files: ``set_point``, ``tracking``, ``own`` or ``motion``; each with ``_snapshots``; for controlled runs
        with ``_checks``, what tells whether to trust them; with ``_coordinates`` and ``_efforts``, a small panel for
        each, where they are more than have a colour of their own.

    Raises
    ------
    InputError
        No run, an unknown format, a folder that cannot be written, matplotlib missing.
    """
    require_formats(formats)
    return write_figures(draw(runs), out_dir, formats)


def write_figures(figures: Mapping[str, Figure], out_dir: str | Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write figures that were drawn, a file for each and each format.

    Raises
    ------
    InputError
        An unknown format, a folder that cannot be written.
    """
    require_formats(formats)
    require_path(out_dir, "plot: out_dir", "a folder")
    return [path for name, figure in figures.items() for path in write(figure, Path(out_dir), name, formats)]


def require_formats(formats: Sequence[str]) -> None:
    """Refuse formats that figures are not written in (InputError)."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise InputError(f"plot: format {unknown[0] if unknown else 'missing'!r}; valid: {', '.join(FORMATS)}")


def draw(runs: Run | Sequence[Run]) -> dict[str, Figure]:
    """Return the figures that `plot` writes, by name, for those who want to change or to show them.

    Raises
    ------
    InputError
        No run; matplotlib missing.
    """
    runs = given_runs(runs, "plot")
    figures: dict[str, Figure] = {}
    groups = _groups(runs)
    with look():
        for stem, group in zip(_stems(groups), groups, strict=True):
            figures[stem] = _LAYOUTS[group.kind](group)
            if group.kind != "motion":
                figures[f"{stem}_checks"] = _checks(group)
            figures[f"{stem}_snapshots"] = _snapshots(group)
            figures |= {f"{stem}_{more}": figure for more, figure in _each(group).items()}
    return figures


def _groups(runs: Iterable[Run]) -> list[Group]:
    found: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        controller = run.scene.get("controller")
        law = controller["type"] if controller else "torques"
        kind = str(law) if law != "torques" else "own" if np.any(run.tau) else "motion"
        found.setdefault((kind, run.mechanism.name, run.coordinates, run.independent, run.actuated), []).append(run)
    ordered = [(kind, style.drawing_order(members)) for (kind, *_), members in found.items()]
    return [Group(kind, members, [desired_along(run) for run in members]) for kind, members in ordered]


def _stems(groups: Sequence[Group]) -> list[str]:
    """File names: the kind of control, with the mechanism's name and a number where that is not enough."""
    stems = [group.kind for group in groups]
    if len(set(stems)) < len(stems):
        names = ["".join(c if c.isalnum() or c in "-_" else "_" for c in group.mechanism.name) for group in groups]
        stems = [f"{name}_{stem}" for name, stem in zip(names, stems, strict=True)]
    if len(set(stems)) < len(stems):
        stems = [f"{stem}_{k}" for k, stem in enumerate(stems, 1)]
    return stems


# --- layouts -------------------------------------------------------------------------------------


def _set_point(group: Group) -> Figure:
    """Fig. 3: a the configurations, b torques, c errors, d velocities."""
    slots = _page(group, ["configurations", _efforts_title(group), "errors", "velocities"])
    poses.linkage(slots[0], group, planes(group.mechanism)[0])
    panels.efforts(slots[1], group, group.runs[0].actuated, _peaks(group))
    panels.errors(slots[2], group, group.independent)
    panels.rates(slots[3], group, group.independent)
    ends = [line(poses.INITIAL, "initial"), line(poses.TARGET, "desired")]
    fit_legend(slots[0].figure.axes[0], ends)
    _legend(slots[0].figure, group)
    return slots[0].figure


def _tracking(group: Group) -> Figure:
    """Fig. 4: a configuration space, b torques, c angles, d velocities; of more than two freedoms a has the errors."""
    d = len(group.independent)
    first = ("phase plane" if d == 1 else "configuration space" if d == 2
             else "errors" if group.desired else "energy")  # fmt: skip
    slots = _page(group, [first, _efforts_title(group), "coordinates", "velocities"])
    if d <= 2:
        poses.configuration_space(slots[0], group)
    elif group.desired:
        panels.errors(slots[0], group, group.independent)
    else:
        panels.scalar(slots[0], group, lambda run: run.energy, with_unit("$E$", "J"))
    panels.efforts(slots[1], group, group.runs[0].actuated, _peaks(group))
    panels.coordinates(slots[2], group, group.independent)
    panels.rates(slots[3], group, group.independent)
    desired = [line("black", "desired", linestyle="none", marker=".", markersize=4)] if group.desired else []
    _legend(slots[0].figure, group, more=desired)
    return slots[0].figure


def _motion(group: Group) -> Figure:
    """Without control: coordinates, rates, change of energy, closure residual."""
    every = group.runs[0].coordinates
    names = every if len(every) <= ALL_MAX else group.independent
    smooth = group.mechanism.joints.has_smooth_friction(group.runs[0].scene.get("friction_smoothing"))
    damped = group.mechanism.springs.any_damping or group.runs[0].dissipated is not None or smooth
    slots = _page(group, ["coordinates", "velocities", f"energy {'change' if damped else 'drift'}", "closure residual"])
    panels.coordinates(slots[0], group, names)
    panels.rates(slots[1], group, names)
    drift = max(float(np.abs(run.energy - run.energy[0]).max()) for run in group.runs)
    power = math.floor(math.log10(drift)) if drift > 0 else 0
    unit = rf"$10^{{{power}}}$ J" if power else "J"
    panels.scalar(slots[2], group, lambda run: (run.energy - run.energy[0]) / 10.0**power,
                  with_unit("$E - E(0)$", unit), cut=False)  # fmt: skip
    _residual(slots[3], group)
    _legend(slots[0].figure, group, names, by_run=True)
    return slots[0].figure


def _checks(group: Group) -> Figure:
    """What tells whether to trust a run: residual, loop forces, energy, Lyapunov function."""
    monitored = any(run.lyapunov is not None for run in group.runs)
    titles = ["closure residual", "loop forces", "energy"] + ["Lyapunov function"] * monitored
    slots = _page(group, titles)
    _residual(slots[0], group)
    panels.loop_forces(slots[1], group)
    panels.scalar(slots[2], group, lambda run: run.energy, with_unit("$E$", "J"))
    if monitored:
        _logarithmic(panels.scalar(slots[3], group, _lyapunov, with_unit("$V$", "J"), cut=False))
    _legend(slots[0].figure, group, [], by_run=True)
    return slots[0].figure


def _snapshots(group: Group) -> Figure:
    """Poses at equal times; of a motion without control, which has no checks, the loop forces too."""
    where = planes(group.mechanism)
    titles = [plane.title or "snapshots" for plane in where] + ["loop forces"] * (group.kind == "motion")
    single = len(titles) == 1
    which = f"snapshots of {group.labels[0]}" if len(group.runs) > 1 else ""
    slots = _page(group, titles, (3.6, 3.3) if single else (PANEL[0], 2.3), which)
    figure = slots[0].figure
    shades = poses.snapshots(slots[: len(where)], group, where)
    beside = figure.axes[: len(where)] if len(where) == 1 else [figure.axes[-1]]
    if group.kind == "motion":
        panels.loop_forces(slots[-1], group)
        beside = figure.axes[:1]
    figure.colorbar(shades, ax=beside, label=with_unit("$t$", "s"), shrink=0.85, aspect=30)
    if group.kind == "motion":
        _legend(figure, group, [])
    return figure


def _each(group: Group) -> dict[str, Figure]:
    """A small panel for each coordinate and each motor, where they are too many for colours."""
    from matplotlib import rc_context

    every = group.runs[0].coordinates if group.kind == "motion" else group.independent
    kinds: dict[str, tuple[Sequence[str], Callable[[Slot, Group, Sequence[str]], None]]] = {
        "coordinates": (every, panels.coordinates),
        "efforts": (group.runs[0].actuated if group.kind != "motion" else (), panels.efforts),
    }
    found = {}
    for what, (names, draw_one) in kinds.items():
        if len(names) <= style.MOST:
            continue
        beside = 3 if len(names) <= 2 * ALL_MAX else 4
        letters = int(13 * style.WIDTH / beside)
        shown = [name if len(name) <= letters else f"{name[: letters - 8]}…{name[-7:]}" for name in names]
        one = group.in_one_colour()
        with rc_context({"axes.titlesize": style.NOTE, "axes.titlelocation": "right"}):
            slots = _page(group, [symbol(name) for name in shown], (style.WIDTH / beside, SMALL), what)
            for slot, name in zip(slots, names, strict=True):
                draw_one(slot, one, [name])
                unit = slot.figure.axes[-1].get_ylabel().rpartition("(")[2]
                slot.figure.axes[-1].set_ylabel(f"({unit}")  # the title has the name
        _thin(slots[0].figure, beside)
        _legend(slots[0].figure, group, [])
        found[what] = slots[0].figure
    return found


_LAYOUTS = {"set_point": _set_point, "tracking": _tracking, "own": _tracking, "motion": _motion}


# --- parts ---------------------------------------------------------------------------------------


def _page(group: Group, titles: Sequence[str], panel: tuple[float, float] = PANEL, what: str = "") -> list[Slot]:
    scene = group.runs[0].scene_name
    words = [what, plain(scene) if "/" in scene else "", PAPER.get(scene, ""),
            group.labels[0] if len(group.runs) == 1 else ""]  # fmt: skip
    columns = round(style.WIDTH / panel[0]) if len(titles) > 1 else 1
    title = f"{plain(group.mechanism.name)}: {TITLES[group.kind]}"
    if (
        panel == PANEL
        and len({panels.unit_of(group, name) for name in group.shown_names if name in group.runs[0].coordinates}) > 1
    ):
        panel = (PANEL[0], PANEL[1] + TALLER)  # an axes for each unit
    return page(title, ", ".join(filter(None, words)), titles, columns, panel)


def _thin(figure: Figure, columns: int) -> None:
    """Of many small panels label the time only below, let numbers be few, and magnify no rounding."""
    spans: dict[str, float] = {}
    for ax in figure.axes:
        low, high = ax.get_ylim()
        spans[ax.get_ylabel()] = max(spans.get(ax.get_ylabel(), 0.0), high - low)
    for k, ax in enumerate(figure.axes):
        ax.locator_params(axis="x", nbins=3)
        (low, high), least = ax.get_ylim(), LEAST * spans[ax.get_ylabel()]
        if high - low < least and ax.get_autoscaley_on():  # else it was cut
            ax.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
        if k + columns < len(figure.axes):
            ax.set_xlabel("")


def _efforts_title(group: Group) -> str:
    units = set(motor_units(group.mechanism))
    return "torques and forces" if len(units) > 1 else "forces" if units == {"N"} else "torques"


def _peaks(group: Group) -> str:
    """Name the largest efforts, beside the paper's where it gives some."""
    sizes: dict[str, float] = {}
    for k, unit in enumerate(motor_units(group.mechanism)):
        sizes[unit] = max(sizes.get(unit, 0.0), *(float(np.abs(run.tau[:, k]).max()) for run in group.runs))
    name = panels.effort_symbol(group)
    said = f"max $|{name}|$ = {', '.join(f'{size:.3g} {unit}' for unit, size in sizes.items())}"
    late = [run.tau[run.t >= STEADY] for run in group.runs if run.t[-1] > STEADY]
    if late and all(run.scene_name == "five_bar/tracking" for run in group.runs):
        steady = max(float(np.abs(tau).max(initial=0.0)) for tau in late)
        return f"{said} (paper: ≤ 30)\nafter {STEADY:.0f} s {steady:.3g} N m (paper: ≤ 5)"
    return said


def _residual(slot: Slot, group: Group) -> None:
    def residual(run: Run) -> Array:
        size = np.abs(run.phi - run.w).max(axis=1, initial=0.0)
        return np.where(size > 0, size, np.nan)  # zero has no logarithm

    name = with_unit(r"max $|\varphi - w|$", joined(row_units(group.mechanism)) or "m")
    _logarithmic(panels.scalar(slot, group, residual, name, dots=True, cut=False))


def _logarithmic(ax: Any) -> None:
    if any(np.any(np.isfinite(line.get_ydata())) for line in ax.get_lines()):
        ax.set_yscale("log")
    else:  # nothing above zero
        ax.set_ylim(-1.0, 1.0)
        ax.text(0.5, 0.5, "zero throughout", ha="center", va="center", transform=ax.transAxes, color=style.GREY)


def _lyapunov(run: Run) -> Array:
    if run.lyapunov is None:
        return np.full(len(run.t), np.nan)
    floor = 1e-15 * float(np.abs(run.lyapunov).max(initial=0.0))  # below is rounding
    return np.where(run.lyapunov > floor, run.lyapunov, np.nan)


def _legend(
    figure: Figure, group: Group, names: Sequence[str] | None = None, more: Sequence[Any] = (), by_run: bool = False
) -> None:
    """One legend below all panels: colours, then lines. `by_run`: some panels have a colour for each run.

    One name stands on its axes, and one run below the title.
    """
    names = group.shown_names if names is None else names
    own = [name for name in names if group.colours[name] != style.REST]
    handles = [line(group.colours[name], symbol(name)) for name in own] if len(names) > 1 else []
    if len(own) < len(names):
        handles.append(line(style.REST, f"{len(names) - len(own)} more"))
    handles += more
    if len(group.runs) > 1:
        for k, (label, shape) in enumerate(zip(group.labels, group.lines, strict=True)):
            handles.append(line(style.COLOURS[k % len(style.COLOURS)] if by_run else "black", label, **shape))
    fit_legend(figure, handles)
