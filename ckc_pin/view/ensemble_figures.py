"""Pictures of an ensemble: fans of quantiles over time, maps over two variables, basins, which variable matters."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.ensembles.store_layout import array_name, units_beside
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, line, look, say, write
from ckc_pin.view.labels import plain, symbol, with_unit

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["draw", "draw_basins", "draw_fan", "draw_importance", "draw_map"]

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MOST_FANS = 12  # components of one output
APART = 0.05  # rad, m: ends further apart than that are others


def draw(results: xr.Dataset, out: Path) -> list[Path]:
    """Draw what an ensemble's results show, a file each: fans of what was kept over time, maps over two variables.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    paths = []
    named = json.loads(results.attrs["sweep"])["variables"]  # in the order that they are given in; a store has none
    variables = [array_name(name) for name in named]
    for name, x in results.data_vars.items():
        if x.attrs.get("is") != "output":
            continue
        if "time" in x.dims:
            paths.append(draw_fan(x, out / f"{name}.png"))
        elif len(x.dims) == 1 and len(variables) == 2:
            paths.append(draw_map(results, (variables[0], variables[1]), str(name), out / f"{name}.png"))
    return paths


def draw_fan(x: xr.DataArray, path: Path) -> Path:
    """Draw quantiles over time, of each component one below the other, each in its unit."""
    values = x.to_numpy().reshape(x.sizes["member"], -1, x.sizes["time"])[:, :MOST_FANS]
    labels = [symbol(str(label)) for label in x[x.dims[1]].to_numpy()] if len(x.dims) > 2 else [plain(str(x.name))]
    beside = x.coords.get(units_beside(str(x.name)))
    units = [x.attrs.get("units", "")] * values.shape[1] if beside is None else beside.to_numpy().tolist()
    with look():
        figure, axes = _page((style.WIDTH, 0.9 + 1.3 * values.shape[1]), values.shape[1])
        t, blue = x["time"].to_numpy(), style.COLOURS[0]
        for k, at in enumerate(axes):
            with np.errstate(all="ignore"):
                bands = np.nanquantile(values[:, k], QUANTILES, axis=0)
            at.fill_between(t, bands[0], bands[4], alpha=0.2, color=blue, lw=0, label="5 to 95 %")
            at.fill_between(t, bands[1], bands[3], alpha=0.4, color=blue, lw=0, label="25 to 75 %")
            at.plot(t, bands[2], color=blue, lw=1.2, label="median")
            at.set_ylabel(with_unit(labels[k], units[k]))
        say(axes[0], f"{plain(str(x.name))} of {x.sizes['member']} members")
        axes[-1].set_xlabel(with_unit("$t$", "s"))
        fit_legend(figure, axes[0].get_legend_handles_labels()[0])
    return _save(figure, path)


def draw_map(results: xr.Dataset, variables: tuple[str, str], name: str, path: Path) -> Path:
    """Draw an output over two variables: a raster of a grid, else points; crosses are members without it."""
    x, y, z = (results[key].to_numpy() for key in (*variables, name))
    with look():
        figure, (at,) = _page((style.WIDTH, 4.2))
        columns, rows = np.unique(x), np.unique(y)
        if len(columns) * len(rows) == len(z) and len(rows) > 1 < len(columns):
            order = np.lexsort((y, x))
            shown: Any = at.pcolormesh(columns, rows, z[order].reshape(len(columns), len(rows)).T, shading="nearest")
        else:
            shown = at.scatter(x, y, c=z, s=8)
        missing = np.isnan(z)
        if missing.any():
            crosses = at.plot(x[missing], y[missing], "x", color=style.GREY, ms=3, label=f"{missing.sum()} without")
            fit_legend(figure, crosses)
        figure.colorbar(shown, label=_axis(results, name))
        at.set(xlabel=_axis(results, variables[0]), ylabel=_axis(results, variables[1]))
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
    group, _ = basins(np.where(rests[:, None], ends, np.nan))
    ended = results["status"].to_numpy()
    kinds: list[tuple[BoolArray, str, dict[str, Any]]] = [
        (group == k, "settles", {"marker": "s", "color": colour}) for k, colour in enumerate(style.COLOURS)
    ]
    kinds += [
        (group >= style.MOST, "settles elsewhere", {"marker": "s", "color": style.REST}),
        ((group < 0) & (ended == 1), "does not settle", {"marker": "X", "ms": 5, "color": "black"}),
        (ended > 1, "stopped or cannot begin", {"marker": ".", "ms": 2, "color": style.GREY}),
    ]
    with look():
        figure, (at,) = _page((style.WIDTH, style.WIDTH))
        for curve in curves:
            at.plot(*curve.T, color="black", lw=0.8)
        shown = []
        for members, said, how in kinds:
            if members.any():
                named = {"label": f"{said}: {members.sum()}", "linestyle": "none"}
                shown += at.plot(x[members], y[members], **({"ms": 3} | named | how))
        for label, u, v in marks:
            shown += at.plot(u, v, "*", ms=12, color="black", mec="white", label=label, linestyle="none")
        if curves:
            shown.append(line("black", "singular configurations", linewidth=0.8))
        at.set(xlabel=_axis(results, variables[0]), ylabel=_axis(results, variables[1]))
        fit_legend(figure, shown)
    return _save(figure, path)


def draw_importance(indices: xr.Dataset, path: Path) -> Path:
    """Draw Sobol indices, first order and total, of each variable."""
    names = [plain(str(name)) for name in indices["variable"].to_numpy()]
    place = np.arange(len(names))
    with look():
        figure, (at,) = _page((style.WIDTH, 1.2 + 0.35 * len(names)))
        bars = [
            at.barh(place + side, indices[key].to_numpy(), height=0.4, label=label)
            for side, key, label in ((-0.2, "first_order", "alone (first order)"),
                                     (0.2, "total_order", "with all others (total)"))
        ]  # fmt: skip
        at.set_yticks(place, names)
        at.invert_yaxis()
        at.grid(visible=False, axis="y")
        at.set_xlabel("share of the variance")
        fit_legend(figure, bars)
    return _save(figure, path)


def _page(size: tuple[float, float], rows: int = 1) -> tuple[Figure, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    return figure, list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def _axis(results: xr.Dataset, name: str) -> str:
    """What an axis over a variable or an output shows: its key, a start's by its symbol."""
    coordinate = name.removeprefix("initial.q.")
    shown = plain(name) if coordinate == name else f"{symbol(coordinate)} at the start"
    return with_unit(shown, results[name].attrs.get("units", ""))


def _save(figure: Figure, path: Path) -> Path:
    return write(figure, path.parent, path.stem, ("png",))[0]
