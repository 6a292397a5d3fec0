"""Figures of an identification: torques, residuals, and the correlation of the parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ckc_pin.identification.identify import Identification
from ckc_pin.view import style
from ckc_pin.view.layout import write_figure
from ckc_pin.view.style import escape_mathtext, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_identification", "save_identification"]

MAX_LAGS = 50
CONFIDENCE = 1.96  # standard deviations of the autocorrelation of independent residuals
MAX_LABELS = 30
POINTS = 4000  # of a curve


def save_identification(result: Identification, folder: Path) -> list[Path]:
    """Write torques.png, residuals.png and, for two parameters or more, correlation.png.

    Raises
    ------
    InputError
        The folder cannot be written; matplotlib is not installed.
    """
    return [
        path
        for name, figure in draw_identification(result).items()
        for path in write_figure(figure, folder, name, ("png",))
    ]


def draw_identification(result: Identification) -> dict[str, Figure]:
    """Return the figures "torques", "residuals" and, for two parameters or more, "correlation".

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    with figure_style():
        figures = {"torques": _draw_torques(result), "residuals": _draw_residuals(result)}
        if len(result.identified) > 1:
            figures["correlation"] = _draw_correlation(result)
        return figures


def _draw_torques(result: Identification) -> Figure:
    """Draw measured and predicted torques of the last record, which is one for validation if there is one."""
    from matplotlib.figure import Figure

    motion = sorted(result.motions, key=lambda x: x.validation)[-1]
    motors = result.mechanism.motors.names
    figure = Figure(figsize=(7.0, 1.2 + 1.8 * len(motors)), layout="constrained")
    panels = figure.subplots(len(motors), sharex=True, squeeze=False)[:, 0]
    kind = "not fitted" if motion.validation else "fitted"
    figure.suptitle(f"{escape_mathtext(motion.source)}, {kind}", x=0.01, ha="left", fontweight="bold")
    stride = max(1, len(motion.t) // POINTS)
    for ax, motor, measured, predicted in zip(panels, motors, motion.measured.T, motion.predicted.T, strict=True):
        ax.plot(motion.t[::stride], measured[::stride], color=style.COLOURS[0], linewidth=0.8, label="measured")
        ax.plot(motion.t[::stride], predicted[::stride], color=style.COLOURS[1], linewidth=1.2, label="predicted")
        ax.set_ylabel(f"{escape_mathtext(motor)} [N m]")
    panels[0].legend(loc="upper right", ncols=2, fontsize=8)
    panels[-1].set_xlabel("time [s]")
    return figure


def _draw_residuals(result: Identification) -> Figure:
    """Draw the torque residuals of all fitted records over time, and their autocorrelation."""
    from matplotlib.figure import Figure

    motors = result.mechanism.motors.names
    figure = Figure(figsize=(8.0, 1.2 + 1.8 * len(motors)), layout="constrained")
    panels = figure.subplots(len(motors), 2, squeeze=False, width_ratios=(2, 1), sharex="col")
    for k, (motor, (over_time, correlation)) in enumerate(zip(motors, panels, strict=True)):
        for number, motion in enumerate(x for x in result.motions if not x.validation):
            residual = (motion.measured - motion.predicted)[:, k]
            stride = max(1, len(motion.t) // POINTS)
            colour = style.COLOURS[number % len(style.COLOURS)]
            over_time.plot(motion.t[::stride], residual[::stride], ".", markersize=1.5, color=colour)
            lags = np.arange(1, min(MAX_LAGS, len(residual) - 1))
            power = max(float(residual @ residual), 1e-300)
            correlation.plot(lags, [residual[lag:] @ residual[:-lag] / power for lag in lags], color=colour)
            bound = CONFIDENCE / np.sqrt(len(residual))
            correlation.axhspan(-bound, bound, color="0.85", zorder=0)
        over_time.set_ylabel(f"{escape_mathtext(motor)} [N m]")
    panels[0, 0].set_title("measured less predicted", loc="left")
    panels[0, 1].set_title("autocorrelation", loc="left")
    panels[-1, 0].set_xlabel("time [s]")
    panels[-1, 1].set_xlabel("lag [instants]")
    return figure


def _draw_correlation(result: Identification) -> Figure:
    """Draw the correlation of the errors of all identified parameters."""
    from matplotlib.figure import Figure

    names = result.identified
    std = np.sqrt(np.maximum(np.diag(result.covariance), 1e-300))
    size = 2.0 + 0.22 * min(len(names), MAX_LABELS)
    figure = Figure(figsize=(size + 1.6, size), layout="constrained")
    ax = figure.subplots()
    image = ax.imshow(result.covariance / np.outer(std, std), cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, ax=ax, label="correlation", shrink=0.7)
    if len(names) <= MAX_LABELS:
        ax.set_yticks(range(len(names)), [escape_mathtext(name) for name in names], fontsize=7)
    else:
        ax.set_ylabel(f"{len(names)} parameters, in the order of identification.json")
    ax.set_xticks([])
    ax.set_title("Errors of the identified parameters", loc="left")
    return figure
