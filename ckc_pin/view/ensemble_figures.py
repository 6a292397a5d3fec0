"""Figures of ensembles: quantiles over time, lines and maps over variables, basins of attraction, Sobol indices."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.ensembles.members import DONE
from ckc_pin.ensembles.store_layout import STATUS_NAME, array_name, unit_coordinate_name
from ckc_pin.errors import InputError
from ckc_pin.view import style
from ckc_pin.view.layout import fit_legend, legend_line, set_panel_title, write_figure
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["draw_basins", "draw_ensemble", "draw_ensemble_line", "draw_ensemble_map", "draw_quantiles",
           "draw_sobol_indices", "save_ensemble"]  # fmt: skip

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MAX_COMPONENTS = 12  # of one output that are drawn
BASIN_TOLERANCE = 0.05  # rad, m: final positions that differ by more belong to different basins


def save_ensemble(results: xr.Dataset, out: Path) -> list[Path]:
    """Draw an ensemble's outputs and write them to a folder, one PNG for each output.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return [_save(figure, out / f"{name}.png") for name, figure in draw_ensemble(results).items()]


def draw_ensemble(results: xr.Dataset) -> dict[str, Figure]:
    """Return the figures of an ensemble's outputs by name.

    Outputs over time are drawn as quantiles. Others are a line over the variable of a sweep, or a map over two; there
    is no figure over more of them.

    Raises
    ------
    InputError
        The dataset is not that of an ensemble; matplotlib is not installed.
    """
    if "sweep" not in results.attrs or STATUS_NAME not in results:
        raise InputError("plot: the xarray.Dataset is not that of an ensemble; give what ckc_pin.ensemble returns")
    figures = {}
    # The sweep file's order; the arrays of a store are not ordered.
    variables = [array_name(name) for name in json.loads(results.attrs["sweep"])["variables"]]
    for key, x in results.data_vars.items():
        name = str(key)
        if x.attrs.get("is") != "output":
            continue
        if "time" in x.dims:
            figures[name] = draw_quantiles(x)
        elif len(variables) == 1:
            figures[name] = draw_ensemble_line(results, variables[0], name)
        elif len(variables) == 2:
            figures[name] = draw_ensemble_map(results, (variables[0], variables[1]), name)
    return figures


def draw_quantiles(x: xr.DataArray) -> Figure:
    """Return the figure of an output's quantiles over time, an axes for each component with its unit."""
    values = x.to_numpy().reshape(x.sizes["member"], -1, x.sizes["time"])
    labels = _component_labels(x)
    with figure_style():
        figure, axes = _create_figure((style.WIDTH_IN, 0.9 + 1.3 * len(labels)), len(labels))
        t, blue = x["time"].to_numpy(), style.COLOURS[0]
        for k, ax in enumerate(axes):
            with np.errstate(all="ignore"):
                bands = np.nanquantile(values[:, k], QUANTILES, axis=0)
            ax.fill_between(t, bands[0], bands[4], alpha=0.2, color=blue, lw=0, label="5 to 95 %")
            ax.fill_between(t, bands[1], bands[3], alpha=0.4, color=blue, lw=0, label="25 to 75 %")
            ax.plot(t, bands[2], color=blue, lw=1.2, label="median")
            ax.set_ylabel(labels[k])
        set_panel_title(axes[0], f"{escape_mathtext(str(x.name))} of {x.sizes['member']} members")
        axes[-1].set_xlabel(axis_label("$t$", "s"))
        fit_legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def draw_ensemble_line(results: xr.Dataset, variable: str, name: str) -> Figure:
    """Return the figure of an output over one variable, an axes for each component.

    The line connects the members that are done. The others are grey, at their last value if they have one. They do not
    set the scale.
    """
    order = np.argsort(results[variable].to_numpy(), kind="stable")
    x, y, is_done = (
        results[variable].to_numpy()[order],
        _split_components(results[name])[order],
        _is_done(results)[order],
    )
    labels = _component_labels(results[name])
    with figure_style():
        figure, axes = _create_figure((style.WIDTH_IN, 1.2 + max(1.3 * len(labels), 2.0)), len(labels))
        for k, ax in enumerate(axes):
            ax.plot(x, np.where(is_done, y[:, k], np.nan), marker=".", markersize=4, linewidth=1.2)
            limits = ax.get_ylim()
            ax.plot(x[~is_done], y[~is_done, k], ".", color=style.GREY, markersize=4)
            if not is_done.all() and np.isfinite(y[is_done, k]).any():
                ax.set_ylim(limits)
            for position in x[~is_done]:
                ax.axvline(position, color=style.GREY, linewidth=0.8, linestyle=":", zorder=0)
            ax.set_ylabel(labels[k])
        axes[-1].set_xlabel(_variable_label(results, variable))
        if not is_done.all():
            fit_legend(figure, [legend_line(style.GREY, _count_unfinished(is_done), linewidth=0.8, linestyle=":")])
    return figure


def draw_ensemble_map(results: xr.Dataset, variables: tuple[str, str], name: str) -> Figure:
    """Return the figure of an output over two variables: cells of a grid, else points, an axes for each component.

    Members that stopped or cannot begin are grey and do not set the scale of the colours. Crosses are other members
    without a value.
    """
    from matplotlib.patches import Patch

    x, y = (results[key].to_numpy() for key in variables)
    values, is_done = _split_components(results[name]), _is_done(results)
    labels = _component_labels(results[name])
    with figure_style():
        figure, axes = _create_figure((style.WIDTH_IN, 4.2 if len(labels) == 1 else 3.0 * len(labels)), len(labels))
        for k, ax in enumerate(axes):
            missing = is_done & np.isnan(values[:, k])
            _draw_cells(figure, ax, x, y, np.where(is_done, values[:, k], np.nan), labels[k])
            if missing.any():
                ax.plot(x[missing], y[missing], "x", color=style.GREY, ms=3)
            ax.set_ylabel(_variable_label(results, variables[1]))
        axes[-1].set_xlabel(_variable_label(results, variables[0]))
        handles = [] if is_done.all() else [Patch(color=style.REST_COLOUR, label=_count_unfinished(is_done))]
        without = int((is_done & np.isnan(values).any(axis=1)).sum())
        if without:
            handles.append(legend_line(style.GREY, f"{without} without a value", marker="x", linestyle="none"))
        fit_legend(figure, handles)
    return figure


def _draw_cells(figure: Figure, ax: Any, x: Array, y: Array, z: Array, label: str) -> None:
    """Draw values over two variables as colours, NaN grey, with a colour bar if there are values."""
    columns, rows = np.unique(x), np.unique(y)
    if len(columns) * len(rows) == len(z) and len(rows) > 1 < len(columns):
        from matplotlib import colormaps

        grid = np.ma.masked_invalid(z[np.lexsort((y, x))].reshape(len(columns), len(rows)).T)
        colours = colormaps["viridis"].with_extremes(bad=style.REST_COLOUR)
        mappable: Any = ax.pcolormesh(columns, rows, grid, shading="nearest", cmap=colours)
    else:
        has_value = np.isfinite(z)
        ax.scatter(x[~has_value], y[~has_value], s=8, color=style.REST_COLOUR)
        mappable = ax.scatter(x[has_value], y[has_value], c=z[has_value], s=8)
    if np.isfinite(z).any():
        figure.colorbar(mappable, ax=ax, label=label)


def _is_done(results: xr.Dataset) -> BoolArray:
    return np.asarray(results[STATUS_NAME].to_numpy() == DONE)


def _count_unfinished(is_done: BoolArray) -> str:
    """Return the legend entry of the members that are not done, as in the figure of basins."""
    return f"stopped or cannot begin: {int((~is_done).sum())}"


def _split_components(x: xr.DataArray) -> Array:
    """Return an output that has no time, shape (members, components)."""
    return np.asarray(x.to_numpy().reshape(x.sizes["member"], -1)[:, :MAX_COMPONENTS])


def _component_labels(x: xr.DataArray) -> list[str]:
    """Return the axis label of each component that is drawn, with its unit."""
    name, dims = str(x.name), [dim for dim in x.dims if dim not in ("member", "time")]
    if not dims:
        return [axis_label(escape_mathtext(name), x.attrs.get("units", ""))]
    count = int(np.prod([x.sizes[dim] for dim in dims]))
    names = x[dims[0]].to_numpy() if len(dims) == 1 else [f"{name} {k + 1}" for k in range(count)]
    units = x.coords.get(unit_coordinate_name(name))
    by_component = [x.attrs.get("units", "")] * count if units is None else units.to_numpy().tolist()
    labels = [axis_label(coordinate_symbol(str(label)), unit) for label, unit in zip(names, by_component, strict=True)]
    return labels[:MAX_COMPONENTS]


def find_basins(ends: Array) -> tuple[Array, Array]:
    """Group members by their final positions.

    Parameters
    ----------
    ends : (members, coordinates) array
        Final positions; rows with NaN belong to no basin.

    Returns
    -------
    group : (members,) array of int
        The basin of each member, the largest basin first, and -1 for none.
    centres : (basins, coordinates) array
        A final position for each basin.
    """
    group = np.full(len(ends), -1)
    centres: list[Array] = []
    for k in np.flatnonzero(np.isfinite(ends).all(axis=1)):
        distances = [np.abs(ends[k] - centre).max() for centre in centres]
        if not distances or min(distances) > BASIN_TOLERANCE:
            centres.append(ends[k])
            group[k] = len(centres) - 1
        else:
            group[k] = int(np.argmin(distances))
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
    """Draw the equilibrium at which each initial position settles, with the singular configurations as curves.

    Parameters
    ----------
    results : xarray.Dataset
    variables : two names
        The coordinates of the initial position.
    end : str
        An output: a member's final position, by coordinate.
    path : Path
    settled : str, optional
        An output: whether a member is at rest at the end.
    curves : sequence of (k, 2) arrays
        Singular configurations in the plane of the variables.
    marks : sequence of (label, x, y)
        Labelled points.
    """
    x, y = (results[name].to_numpy() for name in variables)
    ends = results[end].to_numpy().reshape(len(x), -1)
    is_settled = np.ones(len(x), bool) if settled is None else results[settled].to_numpy() == 1.0
    group, _ = find_basins(np.where(is_settled[:, None], ends, np.nan))
    status = results["status"].to_numpy()
    kinds: list[tuple[BoolArray, str, dict[str, Any]]] = [
        (group == k, "settles", {"marker": "s", "color": colour}) for k, colour in enumerate(style.COLOURS)
    ]
    kinds += [
        (group >= style.MAX_COLOURS, "settles elsewhere", {"marker": "s", "color": style.REST_COLOUR}),
        ((group < 0) & (status == 1), "does not settle", {"marker": "X", "ms": 5, "color": "black"}),
        (status > 1, "stopped or cannot begin", {"marker": ".", "ms": 2, "color": style.GREY}),
    ]
    with figure_style():
        figure, (ax,) = _create_figure((style.WIDTH_IN, style.WIDTH_IN))
        for curve in curves:
            ax.plot(*curve.T, color="black", lw=0.8)
        handles = []
        for members, outcome, properties in kinds:
            if members.any():
                defaults = {"ms": 3, "label": f"{outcome}: {members.sum()}", "linestyle": "none"}
                handles += ax.plot(x[members], y[members], **(defaults | properties))
        for label, u, v in marks:
            handles += ax.plot(u, v, "*", ms=12, color="black", mec="white", label=label, linestyle="none")
        if curves:
            handles.append(legend_line("black", "singular configurations", linewidth=0.8))
        ax.set(xlabel=_variable_label(results, variables[0]), ylabel=_variable_label(results, variables[1]))
        fit_legend(figure, handles)
    return _save(figure, path)


def draw_sobol_indices(indices: xr.Dataset, path: Path) -> Path:
    """Draw first-order and total Sobol indices of each variable as bars."""
    names = [escape_mathtext(str(name)) for name in indices["variable"].to_numpy()]
    positions = np.arange(len(names))
    with figure_style():
        figure, (ax,) = _create_figure((style.WIDTH_IN, 1.2 + 0.35 * len(names)))
        bars = [
            ax.barh(positions + side, indices[key].to_numpy(), height=0.4, label=label)
            for side, key, label in ((-0.2, "first_order", "alone (first order)"),
                                     (0.2, "total_order", "with all others (total)"))
        ]  # fmt: skip
        ax.set_yticks(positions, names)
        ax.invert_yaxis()
        ax.grid(visible=False, axis="y")
        ax.set_xlabel("share of the variance")
        fit_legend(figure, bars)
    return _save(figure, path)


def _create_figure(size: tuple[float, float], rows: int = 1) -> tuple[Figure, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    return figure, list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def _variable_label(results: xr.Dataset, name: str) -> str:
    """Return the axis label of a variable or an output: its key, or the symbol of an initial coordinate."""
    coordinate = name.removeprefix("initial.q.")
    label = escape_mathtext(name) if coordinate == name else f"{coordinate_symbol(coordinate)} at the start"
    return axis_label(label, results[name].attrs.get("units", ""))


def _save(figure: Figure, path: Path) -> Path:
    return write_figure(figure, path.parent, path.stem, ("png",))[0]
