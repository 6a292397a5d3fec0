"""Figures of joints that rub and stop, and of motors that share a force, for docs/images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import ckc_pin
from ckc_pin.view import style
from ckc_pin.view.canvas import fit_legend, line, say, write
from ckc_pin.view.labels import rate_symbol

RATES = ("theta_1", "theta_3")
IMPACT = 0.02  # s, of the run: shown by itself
PRELOAD = {"left_elbow_joint": 10.0, "right_elbow_joint": -10.0}
SHOWN = ("left_shoulder_lift_joint", "left_elbow_joint", "right_shoulder_lift_joint", "right_elbow_joint")


def draw_friction(path: Path) -> None:
    """Impact at a stop, and stick-slip at the turns of a tracked swing."""
    from matplotlib.figure import Figure

    whole = ckc_pin.simulate("five_bar/friction")
    start = ckc_pin.simulate("five_bar/friction", {"t_end": IMPACT, "solver.output_dt": IMPACT / 400})
    figure = Figure(figsize=(style.WIDTH_BESIDE, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2))
    for ax, run in ((left, start), (right, whole)):
        for colour, name in zip(style.COLOURS, RATES, strict=False):
            rate = run.v_tree[:, run.column(name)]
            ax.plot(run.t, rate, color=colour)
            for begin, end in _sticking(run, name):
                ax.axvspan(begin, end, color=colour, alpha=0.15, linewidth=0)
        ax.set(xlabel="$t$ (s)", xlim=(0, run.t[-1]))
    left.set(ylabel="rate (rad/s)")
    right.set(ylim=(-1.5, 1.5))
    say(left, "a)  impact at a stop")
    say(right, "b)  stick-slip: shaded where a joint sticks")
    fit_legend(figure, [line(c, rate_symbol(name)) for c, name in zip(style.COLOURS, RATES, strict=False)])
    write(figure, path.parent, path.stem, ("png",))


def _sticking(run: ckc_pin.Run, name: str) -> list[tuple[float, float]]:
    """When a joint stuck."""
    found, since = [], None
    for event in run.events:
        if event["name"] == f"{name} sticks" and since is None:
            since = float(event["t"])
        elif event["name"] == f"{name} slides" and since is not None:
            found.append((since, float(event["t"])))
            since = None
    return found if since is None else [*found, (since, float(run.t[-1]))]


def draw_preload(path: Path) -> None:
    """What motors of two_ur5 do in its lift, with and without preload: one motion."""
    from matplotlib.figure import Figure

    plain, loaded = _lift({}), _lift({"controller.allocation.preload": PRELOAD})
    if not np.abs(plain.q_tree - loaded.q_tree).max() < 1e-6:
        raise AssertionError("the preload changes the motion")
    figure = Figure(figsize=(style.WIDTH_BESIDE, 3.4), layout="constrained")
    ax = figure.subplots()
    handles = []
    for colour, name in zip(style.COLOURS, SHOWN, strict=False):
        column = plain.actuated.index(name)
        ax.plot(plain.t, plain.tau[:, column], color=colour)
        ax.plot(loaded.t, loaded.tau[:, column], "--", color=colour)
        handles.append(line(colour, name.removesuffix("_joint").replace("_", " ")))
    ax.set(xlabel="$t$ (s)", ylabel=r"$\tau$ (N m)", xlim=(0, plain.t[-1]))
    say(ax, "without preload, and with it (dashed)")
    fit_legend(figure, handles)
    write(figure, path.parent, path.stem, ("png",))


def _lift(changes: Mapping[str, object]) -> ckc_pin.Run:
    return ckc_pin.simulate("two_ur5/lift", {"solver.output_dt": 0.01, "solver.rtol": 1e-9, **changes})
