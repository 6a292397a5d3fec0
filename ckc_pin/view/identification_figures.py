"""Figures of an identification: predictions, residuals, and the correlation of the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.identification.result import Identification
from ckc_pin.identification.unknowns import link_inertial_axes
from ckc_pin.mechanism.parameters import AXES, INERTIA_ENTRIES
from ckc_pin.run.columns import list_quantities
from ckc_pin.view import style
from ckc_pin.view.style import escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["compute_ellipsoid", "draw_identification"]

MAX_LAGS = 50
CONFIDENCE = 1.96  # standard deviations of the autocorrelation of independent residuals
MAX_LABELS = 30
LABEL_WIDTH = 2.4  # inches, of names and the scale beside a matrix
ELLIPSOID_COLUMNS = 4
POINTS = 4000  # of a curve


def draw_identification(result: Identification) -> dict[str, Figure]:
    """Return the figures "torques" or "motion", and "residuals".

    There is "correlation" for two parameters or more, and "ellipsoids" for links of unknown inertia.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        figures = {result.method: _draw_predictions(result), "residuals": _draw_residuals(result)}
        if len(result.identified) > 1:
            figures["correlation"] = _draw_correlation(result)
        if links := _links(result):
            figures["ellipsoids"] = _draw_ellipsoids(result, links)
        return figures


def _draw_predictions(result: Identification) -> Figure:
    """Draw measured and predicted quantities of the last record, which is one for validation if there is one."""
    from matplotlib.figure import Figure

    motion = sorted(result.motions, key=lambda x: x.validation)[-1]
    names, labels = motion.quantities, _labels(result, motion.quantities)
    figure = Figure(figsize=(7.0, 1.2 + 1.8 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]
    kind = "not fitted" if motion.validation else "fitted"
    figure.suptitle(f"{escape_mathtext(motion.source)}, {kind}", x=0.01, ha="left", fontweight="bold")
    stride = max(1, len(motion.t) // POINTS)
    for ax, label, measured, predicted in zip(panels, labels, motion.measured.T, motion.predicted.T, strict=True):
        ax.plot(motion.t[::stride], predicted[::stride], color=style.COLOURS[1], linewidth=1.2, label="predicted")
        ax.plot(motion.t[::stride], measured[::stride], ".", color=style.COLOURS[0], markersize=2, label="measured")
        ax.set_ylabel(label)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, fontsize=8)
    panels[-1].set_xlabel("time (s)")
    return figure


def _draw_residuals(result: Identification) -> Figure:
    """Draw the residuals of all fitted records over time, and their autocorrelation."""
    from matplotlib.figure import Figure

    names = tuple(result.residuals)
    figure = Figure(figsize=(8.0, 1.2 + 1.8 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 2, squeeze=False, width_ratios=(2, 1), sharex="col")
    fitted = [x for x in result.motions if not x.validation]
    for name, label, (over_time, correlation) in zip(names, _labels(result, names), panels, strict=True):
        for number, motion in enumerate(fitted):
            if name not in motion.quantities:
                continue
            k = motion.quantities.index(name)
            residual = motion.measured[:, k] - motion.predicted[:, k]
            t, residual = motion.t[np.isfinite(residual)], residual[np.isfinite(residual)]
            stride = max(1, len(t) // POINTS)
            colour = style.COLOURS[number % len(style.COLOURS)]
            over_time.plot(t[::stride], residual[::stride], ".", markersize=1.5, color=colour)
            lags = np.arange(1, min(MAX_LAGS, len(residual) - 1))
            power = max(float(residual @ residual), 1e-300)
            correlation.plot(lags, [residual[lag:] @ residual[:-lag] / power for lag in lags], color=colour)
            bound = CONFIDENCE / np.sqrt(len(residual))
            correlation.axhspan(-bound, bound, color="0.85", zorder=0)
        over_time.set_ylabel(label)
    panels[0, 0].set_title("measured less predicted", loc="left")
    panels[0, 1].set_title("autocorrelation", loc="left")
    panels[-1, 0].set_xlabel("time (s)")
    panels[-1, 1].set_xlabel("lag (instants)")
    return figure


def _labels(result: Identification, names: Sequence[str]) -> list[str]:
    """Return the labels of quantities; motors are known without their prefix."""
    quantities = list_quantities(result.mechanism)
    return [f"{escape_mathtext(name.removeprefix('tau.'))} ({quantities[name].unit})" for name in names]


def _draw_correlation(result: Identification) -> Figure:
    """Draw the correlation of the errors of all identified parameters."""
    from matplotlib.figure import Figure

    names = result.identified
    std = np.sqrt(np.maximum(np.diag(result.covariance), 1e-300))
    size = 2.0 + 0.22 * min(len(names), MAX_LABELS)
    figure = Figure(figsize=(size + LABEL_WIDTH, size), layout="constrained")
    ax = figure.subplots()
    image = ax.imshow(result.covariance / np.outer(std, std), cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, ax=ax, label="correlation", shrink=0.7)
    if len(names) <= MAX_LABELS:
        ax.set_yticks(range(len(names)), [escape_mathtext(name) for name in names], fontsize=7)
    else:
        ax.set_ylabel(f"{len(names)} parameters, in the order of identification.json")
    ax.set_xticks([])
    ax.grid(visible=False)
    ax.set_title("Errors of the identified parameters", loc="left")
    return figure


def _links(result: Identification) -> list[str]:
    """Return the links with an inertia that is estimated, if there is a complete set of values."""
    ends = {name.removesuffix(".inertia.ixx") for name in result.values if name.endswith(".inertia.ixx")}
    return [
        name.removesuffix(".mass").removeprefix("link.") for name in result.values if name.removesuffix(".mass") in ends
    ]


def _draw_ellipsoids(result: Identification, links: Sequence[str]) -> Figure:
    """Draw the ellipsoid of constant density of each link, before and after, in the plane where it is longest."""
    from matplotlib.figure import Figure

    columns = min(len(links), ELLIPSOID_COLUMNS)
    rows = -(-len(links) // columns)
    figure = Figure(figsize=(1.0 + 1.9 * columns, 0.6 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.array([np.cos(angle), np.sin(angle)])
    starts = {name: x.start for name, x in result.parameters.items()}
    for ax, link in zip(panels, links, strict=False):
        axes = link_inertial_axes(result.mechanism, link)
        solids = [compute_ellipsoid(link, numbers, axes) for numbers in (starts, result.values)]
        extent = np.max([np.abs(np.diagonal(spread)) for _, spread in solids], axis=0)
        plane = np.sort(np.argsort(-extent)[:2])
        for (centre, spread), colour, style_, label in zip(solids, ("0.5", style.COLOURS[0]), ("--", "-"),
                                                           ("start", "estimate"), strict=True):  # fmt: skip
            values, vectors = np.linalg.eigh(spread[np.ix_(plane, plane)])
            outline = centre[plane, None] + (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
            ax.plot(*outline, style_, color=colour, linewidth=1.2, label=label)
            ax.plot(*centre[plane, None], ".", color=colour, markersize=4)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(escape_mathtext(link), loc="left", fontsize=8)
        ax.set_xlabel(f"{AXES[plane[0]]} (m)", fontsize=7)
        ax.set_ylabel(f"{AXES[plane[1]]} (m)", fontsize=7)
        ax.tick_params(labelsize=6)
        ax.locator_params(nbins=3)
    for ax in panels[len(links) :]:
        ax.set_axis_off()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, fontsize=8)
    return figure


def compute_ellipsoid(link: str, numbers: Mapping[str, float], axes: Array) -> tuple[Array, Array]:
    """Return centre and squared semi-axes, as a matrix in the link's axes, of the ellipsoid of constant density."""
    inertia = np.zeros((3, 3))
    for entry, (i, j) in INERTIA_ENTRIES.items():
        inertia[i, j] = inertia[j, i] = numbers[f"link.{link}.inertia.{entry}"]
    inertia = axes @ inertia @ axes.T
    moments = np.trace(inertia) / 2 * np.eye(3) - inertia
    mass = numbers[f"link.{link}.mass"]
    centre = np.array([numbers[f"link.{link}.com.{axis}"] for axis in AXES])
    return centre, 5 * moments / mass if mass > 0 else np.zeros((3, 3))
