"""Figures of the tracking claims."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.paper.deviations import PERIOD, SETTLED, Deviation
from scripts.experiments.paper.lyapunov import Record

__all__ = ["draw_deviations", "draw_lyapunov"]

FLOOR = 1e-16  # for zeros on a logarithmic scale
SHARE = 0.85  # height of a trace over the distance between traces


def draw_lyapunov(on: Record, off: Mapping[str, Record], epsilon: float, folder: Path) -> str:
    """Draw eq. 18's function and its rate along a run, and the rate in the boundary layer against eq. 19."""
    figure, (left, right) = chart(2)
    left.semilogy(on.t, on.value, color=COLOURS[0], label="V of eq. 18 (J)")
    left.semilogy(on.t, np.maximum(-on.rate, FLOOR), color=COLOURS[1], label="$-dV/dt$, differentiated (W)")
    left.semilogy(on.t, -on.predicted, ":", color=BLACK, linewidth=2, label="$-dV/dt$, eq. 19 (W)")
    left.set(xlabel="$t$ (s)", title="from w(0) = 0")
    for (name, record), colour in zip(off.items(), COLOURS, strict=False):
        gap = np.abs(record.rate - record.predicted) / np.abs(record.predicted).max()
        right.semilogy(record.t / epsilon, np.maximum(gap, FLOOR), color=colour, linewidth=0.9, label=name)
    title = f"moving, from w(0) ≠ 0, ε = {epsilon:g}: in the boundary layer"
    right.set(xlabel="fast time τ = t/ε", ylabel="$|dV/dt$ - eq. 19| over the largest", title=title)
    for ax in (left, right):
        ax.legend()
    return save(figure, folder, "tracking_lyapunov.png")


def draw_deviations(t: Array, error: Array, shown: Mapping[str, Deviation], folder: Path) -> str:
    """Draw deviations from the exact run on a logarithmic scale, and each one scaled, over the periods of eq. 21."""
    figure, (left, right) = chart(2)
    figure.set_size_inches(12.8, 6.2)
    left.semilogy(t, error, color=BLACK, label="$|q - q_d|$ of the exact run")
    after = t >= SETTLED * PERIOD
    for row, ((name, deviation), colour) in enumerate(zip(shown.items(), COLOURS, strict=False)):
        left.semilogy(t[1:], np.maximum(deviation.size[1:], FLOOR), color=colour, linewidth=0.9, label=name)
        trace = deviation.size[after] / deviation.size[after].max()
        right.fill_between(t[after] / PERIOD, -row, SHARE * trace - row, color=colour, linewidth=0)
    left.set(xlabel="$t$ (s)", ylabel="largest of the angles (rad)", title="deviation from the exact run")
    right.set(xlabel="$t$ (2π s)", title="the same after the first period, each on its own scale", yticks=[])
    right.margins(x=0)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return save(figure, folder, "tracking_deviations.png")
