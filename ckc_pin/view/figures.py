"""Figures of runs: the paper's Fig. 3 and Fig. 4, uncontrolled motion, and what a careful reader checks.

Runs of one mechanism under one kind of control are drawn on each other: colour by coordinate, line by formulation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.kinds import require_path
from ckc_pin.mechanism.tree import Array
from ckc_pin.mechanism.whole_file import written_whole
from ckc_pin.simulation.run import Run, given_runs
from ckc_pin.view import panels, style
from ckc_pin.view.desired import desired_along
from ckc_pin.view.labels import effort_units, plain, symbol
from ckc_pin.view.panels import Group

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FORMATS", "draw", "plot", "require_formats", "write_figures"]

FORMATS = ("png", "svg", "pdf")
TITLES = {
    "set_point": "set-point control (eq. 14)",
    "tracking": "tracking control (eq. 16)",
    "own": "own controller",
    "motion": "motion without control",
}
LEGEND_MAX = 12  # coordinates; more would need a page of their own
STEADY = 4.0  # s, from when on the paper speaks of steady state


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
        with ``_checks``, what tells whether to trust them.

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
    with _look():
        return [_write(figure, Path(out_dir) / f"{name}.{suffix}")
                for name, figure in figures.items() for suffix in formats]  # fmt: skip


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
    with _look():
        for stem, group in zip(_stems(groups), groups, strict=True):
            figures[stem] = _LAYOUTS[group.kind](group)
            if group.kind != "motion":
                figures[f"{stem}_checks"] = _checks(group)
            figures[f"{stem}_snapshots"] = _snapshots(group)
    return figures


def _look() -> AbstractContextManager[None]:
    """Our style on matplotlib's defaults, whatever the user has set, and that as it was afterwards."""
    try:
        from matplotlib import style as styles
    except ModuleNotFoundError:
        raise InputError("figures need matplotlib: pip install 'ckc_pin[view]'") from None
    context: AbstractContextManager[None] = styles.context(["default", style.RC])
    return context


def _groups(runs: Iterable[Run]) -> list[Group]:
    found: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        controller = run.scene.get("controller")
        law = controller["type"] if controller else "torques"
        kind = str(law) if law != "torques" else "own" if np.any(run.tau) else "motion"
        found.setdefault((kind, run.mechanism.name, run.coordinates, run.independent, run.actuated), []).append(run)
    groups = []
    for (kind, *_), members in found.items():
        ordered = style.drawing_order(members)
        groups.append(Group(kind, ordered, [desired_along(run) for run in ordered]))
    return groups


def _stems(groups: Sequence[Group]) -> list[str]:
    """File names: the kind of control, with the mechanism's name and a number where that is not enough."""
    stems = [group.kind for group in groups]
    if len(set(stems)) < len(stems):
        names = ["".join(c if c.isalnum() or c in "-_" else "_" for c in group.mechanism.name) for group in groups]
        stems = [f"{name}_{stem}" for name, stem in zip(names, stems, strict=True)]
    if len(set(stems)) < len(stems):
        stems = [f"{stem}_{k}" for k, stem in enumerate(stems, 1)]
    return stems


def _write(figure: Figure, path: Path) -> Path:
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # the same run gives the same file
    kind = path.suffix[1:]
    with written_whole(path) as file:
        figure.savefig(file, dpi=style.DPI, format=kind, metadata=dates.get(kind))
    return path


# --- layouts -------------------------------------------------------------------------------------


def _set_point(group: Group) -> Figure:
    """Fig. 3: a the configurations, b torques, c errors, d velocities."""
    figure, axes = _panels(group, ["configurations", _efforts_title(group), "errors", "velocities"])
    panels.linkage(axes[0], group)
    panels.efforts(axes[1], group)
    panels.errors(axes[2], group)
    panels.rates(axes[3], group, group.independent)
    poses = [_line(panels.INITIAL, "initial"), _line(panels.TARGET, "desired")]
    axes[0].legend(handles=poses, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)
    _legend(figure, group, [*group.independent, *group.runs[0].actuated])
    return figure


def _tracking(group: Group) -> Figure:
    """Fig. 4: a configuration space, b torques, c angles, d velocities."""
    space = "configuration space" if len(group.independent) > 1 else "phase plane"
    if len(group.independent) > 2:
        space += f", 2 of its {len(group.independent)} dimensions"
    figure, axes = _panels(group, [space, _efforts_title(group), "coordinates", "velocities"])
    panels.configuration_space(axes[0], group)
    panels.efforts(axes[1], group)
    panels.coordinates(axes[2], group, group.independent)
    panels.rates(axes[3], group, group.independent)
    desired = [_line("black", "desired", linestyle="none", marker=".", markersize=6)] if group.desired else []
    _legend(figure, group, [*group.independent, *group.runs[0].actuated], desired)
    return figure


def _motion(group: Group) -> Figure:
    """Without control: coordinates, rates, energy drift, closure residual."""
    names = group.runs[0].coordinates if len(group.runs[0].coordinates) <= LEGEND_MAX else group.independent
    figure, axes = _panels(group, ["coordinates", "velocities", "energy drift", "closure residual"])
    panels.coordinates(axes[0], group, names)
    panels.rates(axes[1], group, names)
    drift = max(float(np.abs(run.energy - run.energy[0]).max()) for run in group.runs)
    power = math.floor(math.log10(drift)) if drift > 0 else 0
    label = rf"$E - E(0)$, $10^{{{power}}}$ J" if power else "$E - E(0)$, J"
    panels.scalar(axes[2], group, lambda run: (run.energy - run.energy[0]) / 10.0**power, label)
    _residual(axes[3], group)
    _legend(figure, group, names, by_run=True)
    return figure


def _checks(group: Group) -> Figure:
    """What tells whether to trust a run: residual, loop forces, energy, Lyapunov function."""
    monitored = any(run.lyapunov is not None for run in group.runs)
    titles = ["closure residual", "loop forces", "energy"] + ["Lyapunov function"] * monitored
    figure, axes = _panels(group, titles)
    _residual(axes[0], group)
    panels.loop_forces(axes[1], group)
    panels.scalar(axes[2], group, lambda run: run.energy, "$E$, J")
    if monitored:
        panels.scalar(axes[3], group, _lyapunov, "$V$, J")
        _logarithmic(axes[3])
    _legend(figure, group, [], by_run=True)
    return figure


def _snapshots(group: Group) -> Figure:
    """Poses at equal times; of a motion without control, which has no checks, the loop forces too."""
    which = f", {group.labels[0]}" if len(group.runs) > 1 else ""
    forces = ["loop forces"] * (group.kind == "motion")
    figure, axes = _panels(group, [f"snapshots{which}", *forces], (7.2 + 5.0 * len(forces), 5.4))
    figure.colorbar(panels.snapshots(axes[0], group), ax=axes[0], label="t, s", shrink=0.85)
    if forces:
        panels.loop_forces(axes[1], group)
        _legend(figure, group, [])
    return figure


_LAYOUTS = {"set_point": _set_point, "tracking": _tracking, "own": _tracking, "motion": _motion}


# --- parts ---------------------------------------------------------------------------------------


def _panels(group: Group, titles: Sequence[str], size: tuple[float, float] | None = None) -> tuple[Figure, list[Any]]:
    from matplotlib.figure import Figure

    rows, columns = (2, 2) if len(titles) == 4 else (1, len(titles))
    figure = Figure(figsize=size or (5.2 * columns, 3.7 * rows + 0.7), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.09, h_pad=0.07)  # type: ignore[union-attr, call-arg]
    name = plain(group.mechanism.name)
    figure.suptitle(f"{name}: {TITLES[group.kind]}", x=0.01, ha="left", fontsize=12, fontweight="bold")
    axes = [figure.add_subplot(rows, columns, k) for k in range(1, len(titles) + 1)]
    for letter, ax, title in zip("abcd", axes, titles, strict=False):
        ax.set_title(f"{letter})  {title}" if len(titles) > 1 else title)
    return figure, axes


def _efforts_title(group: Group) -> str:
    """Name the efforts and their maxima, beside the paper's where it gives some."""
    unit = effort_units(group.mechanism)
    kind = {"N m": "torques", "N": "forces"}.get(unit, "torques and forces")
    peak = max(float(np.abs(run.tau).max(initial=0.0)) for run in group.runs)
    title = f"{kind}: max $|{panels.effort_symbol(group)}|$ = {peak:.3g} {unit}"
    late = [run.tau[run.t >= STEADY] for run in group.runs if run.t[-1] > STEADY]
    if group.kind == "tracking" and group.mechanism.name.startswith("five_bar") and late:
        steady = max(float(np.abs(tau).max(initial=0.0)) for tau in late)
        return f"{title} (paper: at most 30),\n      after {STEADY:.0f} s {steady:.3g} {unit} (paper: at most 5)"
    return title


def _residual(ax: Any, group: Group) -> None:
    def residual(run: Run) -> Array:
        size = np.abs(run.phi - run.w).max(axis=1, initial=0.0)
        return np.where(size > 0, size, np.nan)  # zero has no logarithm

    panels.scalar(ax, group, residual, r"max $|\varphi - w|$, m or rad", dots=True)
    _logarithmic(ax)


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


def _line(colour: Any, label: str, **look: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, label=label, **({"linewidth": 2.4} | look))


def _legend(figure: Figure, group: Group, names: Sequence[str], more: Sequence[Any] = (), by_run: bool = False) -> None:
    """One legend below all panels: colours, then lines. `by_run`: some panels have a colour for each run."""
    names = list(dict.fromkeys(names))
    shown = names if len(names) <= LEGEND_MAX else [names[0], names[-1]]
    handles = [_line(group.colours[name], symbol(name)) for name in shown] + list(more)
    for k, (label, line) in enumerate(zip(group.labels, group.lines, strict=True)):
        handles.append(_line(style.COLOURS[k % len(style.COLOURS)] if by_run else "black", label, **line))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), handlelength=3.2)
