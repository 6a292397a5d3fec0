"""Figures of joints that rub and stop, and of motors that share a force, for docs/images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ckc_pin

RATES = ("theta_1", "theta_3")
IMPACT = 0.02  # s, of the run: shown by itself
PRELOAD = {"left_elbow_joint": 10.0, "right_elbow_joint": -10.0}
SHOWN = ("left_shoulder_lift_joint", "left_elbow_joint", "right_shoulder_lift_joint", "right_elbow_joint")


def draw_friction(path: Path, dpi: float) -> None:
    """Impact at a stop, and stick-slip at the turns of a tracked swing."""
    whole = ckc_pin.simulate("five_bar/friction")
    start = ckc_pin.simulate("five_bar/friction", {"t_end": IMPACT, "solver.output_dt": IMPACT / 400})
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.2), width_ratios=(1, 2), layout="constrained")
    for ax, run in ((left, start), (right, whole)):
        for k, name in enumerate(RATES):
            rate = run.v_tree[:, run.column(name)]
            ax.plot(run.t, rate, color=f"C{k}", label=name)
            for begin, end in _sticking(run, name):
                ax.axvspan(begin, end, color=f"C{k}", alpha=0.15, linewidth=0)
        ax.set(xlabel="t [s]", xlim=(0, run.t[-1]))
        ax.grid(alpha=0.3)
    left.set(ylabel="rate [rad/s]", title="impact at a stop")
    right.set(ylim=(-1.5, 1.5), title="stick-slip: shaded where a joint sticks")
    right.legend(loc="upper right")
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


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


def draw_preload(path: Path, dpi: float) -> None:
    """What motors of two_ur5 do in its lift, with and without preload: one motion."""
    plain, loaded = _lift({}), _lift({"controller.allocation.preload": PRELOAD})
    if not np.abs(plain.q_tree - loaded.q_tree).max() < 1e-6:
        raise AssertionError("the preload changes the motion")
    figure, ax = plt.subplots(figsize=(9.0, 3.2), layout="constrained")
    for k, name in enumerate(SHOWN):
        column = plain.actuated.index(name)
        ax.plot(plain.t, plain.tau[:, column], color=f"C{k}", label=name)
        ax.plot(loaded.t, loaded.tau[:, column], "--", color=f"C{k}")
    ax.set(xlabel="t [s]", ylabel="tau [N m]", xlim=(0, plain.t[-1]), title="without preload, and with it (dashed)")
    ax.grid(alpha=0.3)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def _lift(changes: Mapping[str, object]) -> ckc_pin.Run:
    return ckc_pin.simulate("two_ur5/lift", {"solver.output_dt": 0.01, "solver.rtol": 1e-9, **changes})
