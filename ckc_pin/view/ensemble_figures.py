"""Pictures of an ensemble: fans of quantiles over time, maps over two variables, basins, which variable matters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.tree import Array

if TYPE_CHECKING:
    import xarray as xr

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
    plt = _pyplot()
    values = x.to_numpy().reshape(x.sizes["member"], -1, x.sizes["time"])[:, :MOST_FANS]
    labels = [str(label) for label in x[x.dims[1]].to_numpy()] if len(x.dims) > 2 else [str(x.name)]
    figure, axes = plt.subplots(values.shape[1], 1, sharex=True, squeeze=False, figsize=(7, 1 + 2 * values.shape[1]))
    for k, at in enumerate(axes[:, 0]):
        with np.errstate(all="ignore"):
            bands = np.nanquantile(values[:, k], QUANTILES, axis=0)
        t = x["time"].to_numpy()
        at.fill_between(t, bands[0], bands[4], alpha=0.2, color="C0", lw=0, label="5 to 95 %")
        at.fill_between(t, bands[1], bands[3], alpha=0.3, color="C0", lw=0, label="25 to 75 %")
        at.plot(t, bands[2], color="C0", label="median")
        at.set_ylabel(labels[k])
    axes[0, 0].legend(loc="upper right", fontsize="small")
    axes[-1, 0].set_xlabel("t / s")
    return _save(figure, path)


def draw_map(results: xr.Dataset, variables: tuple[str, str], name: str, path: Path) -> Path:
    """Draw an output over two variables: a raster of a grid, else points; crosses are members without it."""
    plt = _pyplot()
    x, y, z = (results[key].to_numpy() for key in (*variables, name))
    figure, at = plt.subplots(figsize=(6, 5))
    columns, rows = np.unique(x), np.unique(y)
    if len(columns) * len(rows) == len(z) and len(rows) > 1 < len(columns):
        order = np.lexsort((y, x))
        shown: Any = at.pcolormesh(columns, rows, z[order].reshape(len(columns), len(rows)).T, shading="nearest")
    else:
        shown = at.scatter(x, y, c=z, s=8)
    missing = np.isnan(z)
    if missing.any():
        at.plot(x[missing], y[missing], "x", color="0.6", ms=3, label=f"{missing.sum()} without")
        at.legend(fontsize="small")
    figure.colorbar(shown, label=name)
    at.set_xlabel(variables[0])
    at.set_ylabel(variables[1])
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
    plt = _pyplot()
    x, y = (results[name].to_numpy() for name in variables)
    ends = results[end].to_numpy().reshape(len(x), -1)
    rests = np.ones(len(x), bool) if settled is None else results[settled].to_numpy() == 1.0
    group, centres = basins(np.where(rests[:, None], ends, np.nan))
    figure, at = plt.subplots(figsize=(6.5, 6))
    ended = results["status"].to_numpy()
    for k in range(min(len(centres), MOST_BASINS)):
        at.plot(
            x[group == k], y[group == k], "s", ms=3, color=f"C{k}", label=f"settles: {np.count_nonzero(group == k)}"
        )
    moving, without = (group < 0) & (ended == 1), ended > 1
    at.plot(x[moving], y[moving], "s", ms=3, color="0.7", label=f"does not settle: {moving.sum()}")
    at.plot(x[without], y[without], "x", ms=3, color="0.3", label=f"stopped or cannot begin: {without.sum()}")
    for curve in curves:
        at.plot(curve[:, 0], curve[:, 1], color="k", lw=1)
    for label, u, v in marks:
        at.plot(u, v, "*", ms=12, color="k")
        at.annotate(label, (u, v), xytext=(6, 6), textcoords="offset points")
    at.set_xlabel(variables[0])
    at.set_ylabel(variables[1])
    at.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
    return _save(figure, path)


def draw_importance(indices: xr.Dataset, path: Path) -> Path:
    """Draw Sobol indices, first order and total, of each variable."""
    plt = _pyplot()
    names = [str(name) for name in indices["variable"].to_numpy()]
    figure, at = plt.subplots(figsize=(7, 1.5 + 0.4 * len(names)))
    place = np.arange(len(names))
    at.barh(place - 0.2, indices["first_order"].to_numpy(), height=0.4, label="alone (first order)")
    at.barh(place + 0.2, indices["total_order"].to_numpy(), height=0.4, label="with all others (total)")
    at.set_yticks(place, names)
    at.invert_yaxis()
    at.set_xlabel("share of the variance")
    at.legend(fontsize="small")
    return _save(figure, path)


def _pyplot() -> Any:
    try:
        import matplotlib

        matplotlib.use("agg")
        import matplotlib.pyplot as plt
    except ModuleNotFoundError:
        raise InputError("figures are drawn by matplotlib, which is not installed: pip install ckc_pin[view]") from None
    return plt


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path, bbox_inches="tight", dpi=110)
    _pyplot().close(figure)
    return path
