"""Pictures of an ensemble: fans of quantiles over time, maps over two variables, basins, which variable matters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.mechanism.tree import Array
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, line, look, write
from ckc_pin.view.labels import plain, symbol

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["draw", "draw_basins", "draw_fan", "draw_importance", "draw_map"]

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MOST_FANS = 12  # components of one output
APART = 0.05  # rad, m: ends further apart than that are others
MOST_BASINS = 9


def draw(results: xr.Dataset, out: Path) -> list[Path]:
    """Draw what an ensemble's results show, a file each: fans of what was kept over time, maps over two variables.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    paths = []
    variables = [str(name) for name, x in results.data_vars.items() if x.attrs.get("is") == "variable"]
    for name, x in results.data_vars.items():
        if x.attrs.get("is") != "output":
            continue
        if "time" in x.dims:
            paths.append(draw_fan(x, out / f"{name}.png"))
        elif len(x.dims) == 1 and len(variables) == 2:
            paths.append(draw_map(results, (variables[0], variables[1]), str(name), out / f"{name}.png"))
    return paths


def draw_fan(x: xr.DataArray, path: Path) -> Path:
    """Draw quantiles over time, of each component one below the other."""
    values = x.to_numpy().reshape(x.sizes["member"], -1, x.sizes["time"])[:, :MOST_FANS]
    labels = [str(label) for label in x[x.dims[1]].to_numpy()] if len(x.dims) > 2 else [str(x.name)]
    with look():
        figure = _figure(style.WIDTH, 0.9 + 1.5 * values.shape[1])
        axes = figure.subplots(values.shape[1], 1, sharex=True, squeeze=False)[:, 0]
        colour = style.COLOURS[0]
        for k, ax in enumerate(axes):
            with np.errstate(all="ignore"):
                bands = np.nanquantile(values[:, k], QUANTILES, axis=0)
            t = x["time"].to_numpy()
            ax.fill_between(t, bands[0], bands[4], alpha=0.2, color=colour, lw=0)
            ax.fill_between(t, bands[1], bands[3], alpha=0.3, color=colour, lw=0)
            ax.plot(t, bands[2], color=colour)
            ax.set_ylabel(symbol(labels[k]))
        axes[-1].set_xlabel("$t$ (s)")
        figure.suptitle(plain(str(x.name)), x=0.012, ha="left", fontweight="bold")
        fit_legend(figure, [line(colour, "median"), line(colour, "25 to 75 %", alpha=0.45, linewidth=6),
                            line(colour, "5 to 95 %", alpha=0.2, linewidth=6)])  # fmt: skip
        return _save(figure, path)


def draw_map(results: xr.Dataset, variables: tuple[str, str], name: str, path: Path) -> Path:
    """Draw an output over two variables: a raster of a grid, else points; crosses are members without it."""
    x, y, z = (results[key].to_numpy() for key in (*variables, name))
    with look():
        figure = _figure(style.WIDTH, 4.4)
        ax = figure.subplots()
        ax.grid(visible=False)
        columns, rows = np.unique(x), np.unique(y)
        if len(columns) * len(rows) == len(z) and len(rows) > 1 < len(columns):
            order = np.lexsort((y, x))
            shown: Any = ax.pcolormesh(columns, rows, z[order].reshape(len(columns), len(rows)).T, shading="nearest")
        else:
            shown = ax.scatter(x, y, c=z, s=8)
        missing = np.isnan(z)
        if missing.any():
            ax.plot(x[missing], y[missing], "x", color=style.GREY, ms=3)
            fit_legend(figure, [line(style.GREY, f"{missing.sum()} without", marker="x", linestyle="none")])
        figure.colorbar(shown, label=plain(name))
        ax.set(xlabel=plain(variables[0]), ylabel=plain(variables[1]))
        return _save(figure, path)


def basins(ends: Array) -> tuple[Array, Array]:
    """Group members by where they end: each one's group, -1 for none, and the groups' ends, the largest first."""
    group = np.full(len(ends), -1)
    centres: list[Array] = []
    for k in np.flatnonzero(np.isfinite(ends).all(axis=1)):
        turned = [np.abs(ends[k] - centre).max() for centre in centres]
        if not turned or min(turned) > APART:
            centres.append(ends[k])
            group[k] = len(centres) - 1
        else:
            group[k] = int(np.argmin(turned))
    order = np.argsort([-np.count_nonzero(group == k) for k in range(len(centres))], kind="stable")
    rank = np.empty(len(centres), dtype=int)
    rank[order] = np.arange(len(centres))
    return np.where(group >= 0, rank[group], -1) if centres else group, np.array([centres[k] for k in order])


def draw_basins(
    results: xr.Dataset,
    variables: tuple[str, str],
    end: str,
    path: Path,
    *,
    settled: str | None = None,
    curves: Sequence[Array] = (),
    marks: Sequence[tuple[str, float, float]] = (),
) -> Path:
    """Draw where each start settles, on the curves where the mechanism is singular.

    Parameters
    ----------
    results : xarray.Dataset
    variables : two names
        The starts' coordinates.
    end : str
        An output: where a member is at its end, by coordinate.
    path : Path
    settled : str, optional
        An output: whether it rests there.
    curves : sequence of (k, 2) arrays
        Singular configurations in the plane of the variables.
    marks : sequence of (label, x, y)
        Points to name.
    """
    x, y = (results[name].to_numpy() for name in variables)
    ends = results[end].to_numpy().reshape(len(x), -1)
    rests = np.ones(len(x), bool) if settled is None else results[settled].to_numpy() == 1.0
    group, centres = basins(np.where(rests[:, None], ends, np.nan))
    ended = results["status"].to_numpy()
    moving, without = (group < 0) & (ended == 1), ended > 1
    shown = [(group == k, "s", style.COLOURS[k % style.MOST], "settles") for k in range(min(len(centres), MOST_BASINS))]
    shown += [(moving, "D", "black", "does not settle"), (without, "x", style.GREY, "stopped or cannot begin")]
    with look():
        figure = _figure(style.WIDTH, 5.4)
        ax = figure.subplots()
        handles = []
        for which, marker, colour, says in shown:
            ax.plot(x[which], y[which], marker, ms=2.6, color=colour, linestyle="none")
            handles.append(line(colour, f"{says}: {np.count_nonzero(which)}", marker=marker, linestyle="none"))
        for curve in curves:
            ax.plot(curve[:, 0], curve[:, 1], color="black", lw=0.9)
        for label, u, v in marks:
            ax.plot(u, v, "*", ms=12, color="white", markeredgecolor="black")
            ax.annotate(label, (u, v), xytext=(7, 7), textcoords="offset points", fontweight="bold",
                        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0})  # fmt: skip
        ax.set(xlabel=plain(variables[0]), ylabel=plain(variables[1]))
        fit_legend(figure, [*handles, *([line("black", "singular")] if len(curves) else [])])
        return _save(figure, path)


def draw_importance(indices: xr.Dataset, path: Path) -> Path:
    """Draw Sobol indices, first order and total, of each variable."""
    names = [str(name) for name in indices["variable"].to_numpy()]
    place = np.arange(len(names))
    with look():
        figure = _figure(style.WIDTH, 1.1 + 0.36 * len(names))
        ax = figure.subplots()
        kinds = (("first_order", "alone (first order)"), ("total_order", "with all others (total)"))
        handles = []
        for (kind, says), colour, aside in zip(kinds, style.COLOURS, (-0.2, 0.2), strict=False):
            ax.barh(place + aside, indices[kind].to_numpy(), height=0.4, color=colour)
            handles.append(line(colour, says, linewidth=6))
        ax.set_yticks(place, [plain(name) for name in names])
        ax.invert_yaxis()
        ax.set_xlabel("share of the variance")
        fit_legend(figure, handles)
        return _save(figure, path)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _save(figure: Figure, path: Path) -> Path:
    return write(figure, path.parent, path.stem, (path.suffix[1:],))[0]
