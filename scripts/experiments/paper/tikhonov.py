"""Tikhonov's theorem for the SPF (eqs. 9 to 13): difference from the DAE at t = 1 s against epsilon.

From a consistent start both have the same solution (see `consistent_start`). So the study starts off the manifold, with
the same q and q_dot in both systems, z on phi = 0 in the DAE, and z on phi = w(0) in the SPF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.formulations import CoriolisVelocity
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper import boundary_layer
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.experiment import W0, Problem, difference, end_of, five_bar_problem, vector

__all__ = ["EPSILONS", "Convergence", "claims", "converge", "order_claim", "velocity_claim"]

EPSILONS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
T_END = 1.0
FIRST, SECOND = ("DOP853", 1e-12), ("LSODA", 1e-12)  # two integrations with different methods and codes
ORDER_MARGIN = 0.05


@dataclass(frozen=True)
class Convergence:
    """Differences of the SPF from the DAE for a sequence of epsilons.

    Attributes
    ----------
    epsilons : (m,) array
    x, z : (m,) arrays
        Largest difference in (q, q_dot) and in z at t_end.
    x_uncertainty, z_uncertainty : (m,) arrays
        Change of the difference by the second pair of integrations.
    """

    epsilons: Array
    x: Array
    z: Array
    x_uncertainty: Array
    z_uncertainty: Array

    @property
    def orders(self) -> Array:
        """Observed order of x between neighbouring epsilons, shape (m - 1,)."""
        return _orders(self.epsilons, self.x)

    @property
    def z_orders(self) -> Array:
        """Observed order of z between neighbouring epsilons, shape (m - 1,)."""
        return _orders(self.epsilons, self.z)

    @property
    def resolved(self) -> bool:
        """Whether the integration errors are below a tenth of each difference."""
        return bool(np.all(10 * self.x_uncertainty < self.x) and np.all(10 * self.z_uncertainty < self.z))


def _orders(epsilons: Array, errors: Array) -> Array:
    return np.diff(np.log(errors)) / np.diff(np.log(epsilons))


def converge(
    problem: Problem,
    w: Array,
    epsilons: Sequence[float] = EPSILONS,
    convention: CoriolisVelocity = "rho",
    t_end: float = T_END,
    reference: Problem | None = None,
) -> Convergence:
    """Measure the difference of the SPF (eq. 8 in the coordinates of eq. 17) from the DAE of eq. 1.

    Each difference is measured twice: with DOP853 for both systems, and with LSODA for the SPF and for the reduced
    model in place of the DAE.

    Parameters
    ----------
    problem : Problem
        The start on phi = 0 and the force.
    w : (rows,) array
        w(0) of the SPF.
    epsilons : sequence of float
    convention : "rho" or "actual"
        Velocity at which C is evaluated: that of eq. 8 or that of eq. 16.
    t_end : float
        Time of the comparison, s.
    reference : Problem, optional
        Start of the DAE, by default that of `problem`.

    Raises
    ------
    NumericalError
        A start cannot be closed, or a run stops.
    """
    reference = reference or problem
    dae = end_of(reference.dae(), *FIRST, t_end)
    reduced = end_of(reference.reduced(), *SECOND, t_end)
    first, second = np.empty((len(epsilons), 2)), np.empty((len(epsilons), 2))
    for k, epsilon in enumerate(epsilons):
        first[k] = difference(dae, end_of(problem.spf(epsilon, w, convention), *FIRST, t_end))
        second[k] = difference(reduced, end_of(problem.spf(epsilon, w, convention), *SECOND, t_end))
    unsure = np.abs(first - second)
    return Convergence(np.array(epsilons), first[:, 0], first[:, 1], unsure[:, 0], unsure[:, 1])


def claims(figures: Path) -> list[Claim]:
    """Answer the paper's claim on the order of the error, for both definitions of C."""
    rest, moving = five_bar_problem(False), five_bar_problem(True)
    start = f"w(0) = {vector(W0)} m, q̇(0) = 0 or {vector(moving.q_dot)} rad/s"
    rho = converge(rest, W0), converge(moving, W0)
    actual = converge(rest, W0, convention="actual"), converge(moving, W0, convention="actual")
    behind = boundary_layer.problem_after_layer(moving, W0)
    corrected = converge(moving, W0, convention="actual", reference=behind)
    figure = _draw(rho, [*actual, corrected], figures)
    return [order_claim(*rho, start, figure), velocity_claim(*actual, corrected, moving, behind, figure)]


def order_claim(rest: Convergence, moving: Convergence, start: str, figure: str) -> Claim:
    last = np.concatenate([orders[-2:] for c in (rest, moving) for orders in (c.orders, c.z_orders)])
    resolved = rest.resolved and moving.resolved
    good = bool(np.all(np.abs(last - 1) <= ORDER_MARGIN)) and resolved
    rows = [
        (f"{epsilon:.0e}", *(cell for c in (rest, moving) for cell in _cells(c, k)))
        for k, epsilon in enumerate(rest.epsilons)
    ]
    return Claim(
        key="tikhonov-order",
        verdict="holds" if good else "does not hold",
        figures=(figure,),
        table=(
            ("ε", *(f"{s}: {c}" for s in ("rest", "moving") for c in ("(q, q̇)", "order", "z", "order"))),
            tuple(rows),
        ),
        **render_blocks(
            "claims/tikhonov-order",
            start=start,
            t_end=T_END,
            orders=(last.min(), last.max()),
            certainty=_certainty(rest, moving),
        ),
    )


def velocity_claim(
    rest: Convergence, moving: Convergence, corrected: Convergence, before: Problem, behind: Problem, figure: str
) -> Claim:
    rows = [
        (f"{epsilon:.0e}", *_cells(rest, k)[:2], *_cells(moving, k)[:2], *_cells(corrected, k)[:2])
        for k, epsilon in enumerate(rest.epsilons)
    ]
    heads = ("rest: (q, q̇)", "order", "moving: (q, q̇)", "order", "moving: to the DAE from: behind the layer", "order")
    converges = bool(np.all(np.abs(moving.orders[-2:] - 1) <= ORDER_MARGIN))
    return Claim(
        key="tikhonov-velocity",
        verdict="holds" if converges else "does not hold",
        figures=(figure,),
        table=(("ε", *heads), tuple(rows)),
        **render_blocks(
            "claims/tikhonov-velocity",
            floor=moving.x[-1],
            epsilon=moving.epsilons[-1],
            before=before.q_dot,
            behind=behind.q_dot,
            corrected=corrected.orders[-1],
            rest=rest.orders[-1],
            certainty=_certainty(rest, moving, corrected),
        ),
    )


def _certainty(*studies: Convergence) -> str:
    unsure = max(float(np.max(np.append(s.x_uncertainty / s.x, s.z_uncertainty / s.z))) for s in studies)
    resolved = all(s.resolved for s in studies)
    (first, rtol), (second, _) = FIRST, SECOND
    text = render_blocks(
        "claims/measured_twice", first=first, second=second, rtol=rtol, unsure=unsure, resolved=resolved
    )
    return str(text["certainty"])


def _cells(c: Convergence, k: int) -> tuple[str, str, str, str]:
    order, z_order = ("", "") if k == 0 else (f"{o[k - 1]:z.3f}" for o in (c.orders, c.z_orders))
    return f"{c.x[k]:.2e}", order, f"{c.z[k]:.2e}", z_order


def _draw(rho: Sequence[Convergence], actual: Sequence[Convergence], figures: Path) -> str:
    figure, axes = chart(2)
    for ax, title in zip(axes, ("C at ρ q̇ (eq. 8)", "C at the actual ż (eq. 16)"), strict=True):
        ax.set(xscale="log", yscale="log", xlabel="ε (s)", ylabel=f"largest difference from the DAE at t = {T_END:g} s")
        ax.set_title(title)
    for c, name, colour in zip(rho, ("from rest", "moving"), COLOURS, strict=False):
        axes[0].plot(c.epsilons, c.x, "o-", color=colour, label=f"{name}: q, q̇ (rad, rad/s)")
        axes[0].plot(c.epsilons, c.z, "s--", color=colour, label=f"{name}: z (rad)", markerfacecolor="none")
    axes[0].plot(rho[0].epsilons, rho[0].epsilons, ":", color=BLACK, label="slope 1")
    names = ("from rest", "moving", "moving, against the DAE with\nq̇ from behind the layer")
    for c, name, colour in zip(actual, names, COLOURS, strict=False):
        axes[1].plot(c.epsilons, c.x, "o-", color=colour, label=f"{name}: q, q̇")
    axes[1].plot(actual[0].epsilons, actual[0].epsilons, ":", color=BLACK, label="slope 1")
    axes[1].sharey(axes[0])
    for ax in axes:
        ax.legend(fontsize=8)
    return save(figure, figures, "tikhonov.png")
