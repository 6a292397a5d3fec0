"""Figures of joint friction, stops and redundant motors for docs/images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin
from ckc_pin.view.layout import fit_legend, legend_line
from ckc_pin.view.style import WIDE_WIDTH_IN, assign_colours, axis_label, coordinate_symbol, rate_symbol

RATES = ("theta_1", "theta_3")
IMPACT = 0.02  # s: the part of the run with the impact, in its own panel
PRELOAD = {"left_elbow_joint": 10.0, "right_elbow_joint": -10.0}
SHOWN = ("left_shoulder_lift_joint", "left_elbow_joint", "right_shoulder_lift_joint", "right_elbow_joint")


def draw_friction(path: Path, dpi: float) -> None:
    """Draw an impact at a stop, and stick-slip at the reversals of a tracked swing."""
    complete = ckc_pin.simulate("five_bar/friction")
    start = ckc_pin.simulate("five_bar/friction", {"t_end": IMPACT, "solver.output_dt": IMPACT / 400})
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDE_WIDTH_IN, 3.0), width_ratios=(1, 2))
    shown: dict[str, Any] = {}
    for ax, run in ((left, start), (right, complete)):
        for name, colour in assign_colours(RATES).items():
            (shown[name],) = ax.plot(run.t, run.v_tree[:, run.column(name)], color=colour, label=rate_symbol(name))
            for begin, end in _sticking(run, name):
                stuck = ax.axvspan(
                    begin, end, color=colour, alpha=0.15, linewidth=0, label=f"{coordinate_symbol(name)} sticks"
                )
                shown[f"{name} sticks"] = stuck
        ax.set(xlabel=axis_label("$t$", "s"), xlim=(0, run.t[-1]))
    left.set(ylabel=axis_label("rate", "rad/s"), title="a)  impact at a stop")
    right.set(ylim=(-1.5, 1.5), title="b)  stick-slip")
    fit_legend(figure, list(shown.values()))
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def _sticking(run: ckc_pin.Run, name: str) -> list[tuple[float, float]]:
    """Return the intervals in which a joint sticks, (start, end) in s."""
    intervals, since = [], None
    for event in run.events:
        if event["name"] == f"{name} sticks" and since is None:
            since = float(event["t"])
        elif event["name"] == f"{name} slides" and since is not None:
            intervals.append((since, float(event["t"])))
            since = None
    return intervals if since is None else [*intervals, (since, float(run.t[-1]))]


def draw_preload(path: Path, dpi: float) -> None:
    """Draw motor torques of two_ur5's lift with and without a preload, which does not change the motion."""
    unloaded, loaded = _lift({}), _lift({"controller.allocation.preload": PRELOAD})
    if not np.abs(unloaded.q_tree - loaded.q_tree).max() < 1e-6:
        raise AssertionError("the preload changes the motion")
    figure, ax = plt.subplots(figsize=(WIDE_WIDTH_IN, 3.4))
    shown = []
    for name, colour in assign_colours(SHOWN).items():
        column = unloaded.actuated.index(name)
        shown += ax.plot(unloaded.t, unloaded.tau[:, column], color=colour, label=_words(name))
        ax.plot(loaded.t, loaded.tau[:, column], "--", color=colour)
    preload = legend_line("black", "with the preload", linestyle="--", linewidth=1.5)
    ax.set(xlabel=axis_label("$t$", "s"), ylabel=axis_label(r"$\tau$", "N m"), xlim=(0, unloaded.t[-1]),
           title="Lift by two arms: one motion, without and with a preload of the elbows")  # fmt: skip
    fit_legend(figure, [*shown, preload])
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def _words(joint: str) -> str:
    return joint.removesuffix("_joint").replace("_", " ")


def _lift(overrides: Mapping[str, object]) -> ckc_pin.Run:
    return ckc_pin.simulate("two_ur5/lift", {"solver.output_dt": 0.01, "solver.rtol": 1e-9, **overrides})
