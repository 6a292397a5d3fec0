"""Figures of ensembles: quantiles over time, maps over two variables, basins of attraction, Sobol indices."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.ensembles.store_layout import array_name, unit_coordinate_name
from ckc_pin.view import style
from ckc_pin.view.layout import fit_legend, legend_line, set_panel_title, write_figure
from ckc_pin.view.style import axis_label, coordinate_symbol, escape_mathtext, figure_style

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["draw_basins", "draw_ensemble", "draw_ensemble_map", "draw_quantiles", "draw_sobol_indices"]

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MAX_COMPONENTS = 12  # of one output that are drawn
BASIN_TOLERANCE = 0.05  # rad, m: final positions that differ by more belong to different basins


def draw_ensemble(results: xr.Dataset, out: Path) -> list[Path]:
    """Draw an ensemble's outputs, one file each: quantiles of outputs over time, maps over two variables.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    paths = []
    # The sweep file's order; the arrays of a store are not ordered.
    variables = [array_name(name) for name in json.loads(results.attrs["sweep"])["variables"]]
    for name, x in results.data_vars.items():
        if x.attrs.get("is") != "output":
            continue
        if "time" in x.dims:
            paths.append(draw_quantiles(x, out / f"{name}.png"))
        elif len(x.dims) == 1 and len(variables) == 2:
            paths.append(draw_ensemble_map(results, (variables[0], variables[1]), str(name), out / f"{name}.png"))
    return paths


def draw_quantiles(x: xr.DataArray, path: Path) -> Path:
    """Draw quantiles of an output over time, an axes for each component with its unit."""
    name = str(x.name)
    values = x.to_numpy().reshape(x.sizes["member"], -1, x.sizes["time"])[:, :MAX_COMPONENTS]
    has_components = len(x.dims) > 2
    components = x[x.dims[1]].to_numpy() if has_components else ()
    labels = [coordinate_symbol(str(label)) for label in components] or [escape_mathtext(name)]
    component_units = x.coords.get(unit_coordinate_name(name))
    if component_units is None:
        units = [x.attrs.get("units", "")] * values.shape[1]
    else:
        units = component_units.to_numpy().tolist()
    with figure_style():
        figure, axes = _create_figure((style.WIDTH_IN, 0.9 + 1.3 * values.shape[1]), values.shape[1])
        t, blue = x["time"].to_numpy(), style.COLOURS[0]
        for k, ax in enumerate(axes):
            with np.errstate(all="ignore"):
                bands = np.nanquantile(values[:, k], QUANTILES, axis=0)
            ax.fill_between(t, bands[0], bands[4], alpha=0.2, color=blue, lw=0, label="5 to 95 %")
            ax.fill_between(t, bands[1], bands[3], alpha=0.4, color=blue, lw=0, label="25 to 75 %")
            ax.plot(t, bands[2], color=blue, lw=1.2, label="median")
            ax.set_ylabel(axis_label(labels[k], units[k]))
        set_panel_title(axes[0], f"{escape_mathtext(name)} of {x.sizes['member']} members")
        axes[-1].set_xlabel(axis_label("$t$", "s"))
        fit_legend(figure, axes[0].get_legend_handles_labels()[0])
    return _save(figure, path)


def draw_ensemble_map(results: xr.Dataset, variables: tuple[str, str], name: str, path: Path) -> Path:
    """Draw an output over two variables: cells of a grid, else points. Crosses are members without a value."""
    x, y, z = (results[key].to_numpy() for key in (*variables, name))
    with figure_style():
        figure, (ax,) = _create_figure((style.WIDTH_IN, 4.2))
        columns, rows = np.unique(x), np.unique(y)
        if len(columns) * len(rows) == len(z) and len(rows) > 1 < len(columns):
            order = np.lexsort((y, x))
            grid = z[order].reshape(len(columns), len(rows)).T
            mappable: Any = ax.pcolormesh(columns, rows, grid, shading="nearest")
        else:
            mappable = ax.scatter(x, y, c=z, s=8)
        missing = np.isnan(z)
        if missing.any():
            crosses = ax.plot(x[missing], y[missing], "x", color=style.GREY, ms=3, label=f"{missing.sum()} without")
            fit_legend(figure, crosses)
        figure.colorbar(mappable, label=_variable_label(results, name))
        ax.set(xlabel=_variable_label(results, variables[0]), ylabel=_variable_label(results, variables[1]))
    return _save(figure, path)


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
