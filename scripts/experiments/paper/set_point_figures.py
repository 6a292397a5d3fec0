"""Figures of the set-point claims."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.run.run import Run
from ckc_pin.view.style import axis_label, coordinate_symbol
from scripts.experiments.certificate.certificate import Certificate, rest_height, sublevel_set
from scripts.experiments.certificate.gradient_bounds import Bound
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.paper.lyapunov import Record
from scripts.experiments.paper.set_point_experiments import Case

__all__ = ["draw_bounds", "draw_lyapunov", "draw_set"]

STYLES = ("-", "--", ":", "-.")


def draw_lyapunov(records: Mapping[str, Record], folder: Path) -> str:
    """Draw V_L and its rate along runs of several formulations."""
    figure, (left, right) = chart(2)
    for (name, record), colour, style in zip(records.items(), COLOURS, STYLES, strict=False):
        left.semilogy(record.t, np.maximum(record.value, 1e-18), style, color=colour, label=name)
        right.semilogy(record.t, np.maximum(-record.rate, 1e-18), style, color=colour, label=f"$-dV_L/dt$, {name}")
    last = list(records.values())[-1]
    right.semilogy(last.t, -last.predicted, color=BLACK, linewidth=0.8, label=r"$\dot{q}^T K_V \dot{q}$")
    left.axhline(last.round_off, color=BLACK, linewidth=0.8, linestyle=":", label="rounding and closure")
    left.set(xlabel="$t$ (s)", ylabel="$V_L$ (J)", title="Lyapunov function of eq. 14", ylim=(1e-17, None))
    right.set(xlabel="$t$ (s)", ylabel="power (W)", title="its rate, and what the paper says it is", ylim=(1e-12, None))
    for ax in (left, right):
        ax.legend()
    return save(figure, folder, "set_point_lyapunov.png")


def draw_bounds(branches: list[list[Bound]], K_P: Array, folder: Path) -> str:
    """Draw M_1 and the smallest eigenvalue over |s| >= s_min."""
    figure, (ax,) = chart()
    margins = np.array([bound.margin for bound in branches[0]])
    for k, bounds in enumerate(branches):
        of = "assembled branch" if k == 0 else f"branch {k + 1}"
        norms, lows = (np.array([getattr(bound, name) for bound in bounds]) for name in ("norm", "low"))
        ax.loglog(
            margins,
            norms,
            "o-" if k == 0 else "^:",
            color=COLOURS[k],
            label=rf"largest $|\partial h/\partial q|$, {of}",
        )
        ax.loglog(margins, -lows, "s--", color=COLOURS[k + 2], label=f"minus the smallest eigenvalue, {of}")
    tail = branches[0][-1]
    fit = tail.norm * (margins / tail.margin) ** -3.0
    ax.loglog(margins, fit, color=BLACK, linewidth=0.8, label=rf"{tail.norm * tail.margin**3:.3f} / $s_{{\min}}^3$")
    ax.axhline(float(np.linalg.eigvalsh(K_P)[0]), color=BLACK, linestyle=":", label="$K_P$ of eq. 20")
    ax.set_xticks(margins, [f"{s:g}" for s in margins])
    ax.set_xticks([], minor=True)
    ax.set(
        xlabel=r"$s_{\min}$, $|s| = |\det\varphi_z| / (l_2 l_4)$",
        ylabel=r"$\partial h/\partial q$ (N m/rad)",
        title=r"$\partial h/\partial q$ where $|s| \geq s_{\min}$",
    )
    ax.legend(fontsize=8)
    return save(figure, folder, "set_point_gradient.png")


def draw_set(case: Case, certificate: Certificate, run: Run, divisions: int, folder: Path) -> str:
    """Draw the sublevel set of a start, the region where the gain condition fails, and the run (d = 2)."""
    figure, (ax,) = chart()
    region = sublevel_set(case.mechanism, case.controller, case.level, divisions)
    q, ends = (_plane(case, ats) for ats in (region.explored.nodes, [end.at for end in region.explored.ends]))
    height = np.array([rest_height(case.mechanism, case.controller, at) for at in region.explored.nodes])
    fails, safe = region.eigenvalues <= 0, height <= certificate.safe_level
    dots: dict[str, Any] = {"s": 14 * (50 / divisions) ** 2, "marker": "s", "linewidths": 0}
    ax.scatter(
        *q[~fails & ~safe].T, color="#dddddd", label=f"connected to $q_d$, $V_L$ ≤ {certificate.level:.1f} J", **dots
    )
    ax.scatter(
        *q[fails].T, color=COLOURS[1], label=r"there $K_P + \partial h/\partial q$ is not positive definite", **dots
    )
    ax.scatter(*q[safe].T, color=COLOURS[2], label=f"certified: $V_L$ ≤ {certificate.safe_level:.2f} J", **dots)
    if len(ends):
        ax.scatter(*ends.T, color=BLACK, s=6, label="there the set reaches a singular configuration")
    path = run.q_tree[:, [run.column(name) for name in run.independent]]
    ax.plot(*path.T, color=COLOURS[0], label="the run")
    ax.plot(*path[0], "o", color=COLOURS[0])
    ax.plot(*case.controller.q_d, "*", color=BLACK, markersize=12, label="$q_d$")
    names = case.mechanism.independent
    ax.set(
        xlabel=axis_label(coordinate_symbol(names[0]), "rad"),
        ylabel=axis_label(coordinate_symbol(names[1]), "rad"),
        aspect="equal",
    )
    figure.set_size_inches(7.5, 8.8)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return save(figure, folder, "set_point_set.png")


def _plane(case: Case, ats: list[Any]) -> Array:
    return np.array([case.mechanism.independent_part(at.q_tree) for at in ats]).reshape(-1, case.mechanism.d)
