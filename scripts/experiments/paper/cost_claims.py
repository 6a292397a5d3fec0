"""Answer the paper's statement on cost (section III-B), with the costs of both formulations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ckc_pin.scene.scene import load_scene
from scripts.experiments.chart import COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.cost import EPSILONS, METHODS, Cost, Search, cheapest, study
from scripts.experiments.paper.experiment import Problem

__all__ = ["claims", "cost_claim"]

SCENES = {"five_bar/swing": 2.0, "five_bar/tracking": 3.0}  # and t_end, s
PAPER = (1e-3, 1e-4)  # the paper's epsilons
CHEAPER = 0.9  # share of the reduced model's time below which eq. 8 counts as cheaper

Costs = Mapping[str, Sequence[Cost]]


def claims(figures: Path) -> list[Claim]:
    """Answer the paper's statement on the cost of the reduced model against the SPF."""
    return [
        cost_claim({name: study(Problem.of_scene(load_scene(name)), t_end) for name, t_end in SCENES.items()}, figures)
    ]


def cost_claim(by_scene: Costs, figures: Path) -> Claim:
    """Return the verdict on costs by scene of `SCENES`."""
    literal = all(
        (cost.count("newton") > 0) == (cost.formulation == "reduced")
        for costs in by_scene.values()
        for cost in costs
        if cost.formulation != "DAE" and not cost.reason
    )
    saved = all(
        cheapest(costs, "eq. 8", epsilon).seconds < CHEAPER * cheapest(costs, "reduced").seconds
        for costs in by_scene.values()
        for epsilon in PAPER
    )
    return Claim(
        key="cost",
        verdict=("holds" if saved else "holds with a condition") if literal else "does not hold",
        figures=(_draw(by_scene, figures),),
        table=_table(by_scene),
        **_text(by_scene),
    )


def _text(by_scene: Costs) -> dict[str, Any]:
    """Return the texts on the cost of sigma and the growth with epsilon, by explicit runs of the first scene."""
    scene = next(iter(by_scene))
    explicit = [c for c in by_scene[scene] if c.method == METHODS[0]]
    reduced, printed = (next(c for c in explicit if c.formulation == name) for name in ("reduced", "eq. 8"))
    with_sigma, without = (1e6 * c.seconds / c.count("rhs") for c in (reduced, printed))
    stiffest = min((c for c in explicit if c.epsilon and not c.reason), key=lambda c: c.epsilon or 0.0)
    asked = (("reduced", None), *(("eq. 8", epsilon) for epsilon in PAPER), ("DAE", None))
    return render_blocks(
        "claims/cost",
        method=METHODS[0],
        corrections=reduced.count("newton") / reduced.count("rhs"),
        with_sigma=with_sigma,
        without=without,
        step=SCENES[scene] / stiffest.count("steps") / (stiffest.epsilon or 1.0),
        epsilon=stiffest.epsilon,
        target=Search().target,
        cheapest={name: [cheapest(costs, *which) for which in asked] for name, costs in by_scene.items()},
        stopped=[
            (name, cost)
            for name, costs in by_scene.items()
            for cost in costs
            if cost.reason and cost.outcome and cost.epsilon is not None
        ],
    )


def _table(by_scene: Costs) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    order = ("reduced", "DAE", "eq. 8")
    heads = ("scene", "model", "ε", "method", "rtol", "error", "rhs", "σ", "iter.", "Jac.", "LU", "ms")
    rows = [
        (name.split("/")[-1], *_row(cost))
        for name, costs in by_scene.items()
        for cost in sorted(costs, key=lambda cost: (order.index(cost.formulation), -(cost.epsilon or 0)))
    ]
    return heads, tuple(rows)


def _row(cost: Cost) -> tuple[str, ...]:
    head = (cost.formulation, f"{cost.epsilon:.0e}" if cost.epsilon else "", cost.method)
    if cost.outcome is None:
        return (*head, "", "", "not tried", "", "", "", "", "")
    rhs = str(cost.count("rhs"))
    if cost.reason:
        return (*head, f"{cost.rtol:.0e}", "stopped", f"> {cost.count('rhs') - 1}", "", "", "", "", "")
    iterations = "?" if cost.outcome.iterations is None else str(cost.outcome.iterations)
    sigma, jacobians, factorizations = (str(cost.count(key)) for key in ("newton", "jacobians", "factorizations"))
    measured = (rhs, sigma, iterations, jacobians, factorizations, f"{1e3 * cost.seconds:.0f}")
    return (*head, f"{cost.rtol:.0e}", f"{cost.error:.0e}", *measured)


def _draw(by_scene: Costs, figures: Path) -> str:
    figure, axes = chart(len(by_scene))
    for ax, (name, costs) in zip(axes, by_scene.items(), strict=True):
        ax.set(xscale="log", xlim=(min(EPSILONS) / 2, max(EPSILONS) * 2), xlabel="ε (s)")
        ax.set(yscale="log", ylim=(200, 4e5), ylabel="right-hand sides")
        for method, colour in zip(METHODS, COLOURS, strict=False):
            _draw_method(ax, method, [cost for cost in costs if cost.method == method], colour)
        ax.set_title(f"{name}, {SCENES[name]:g} s, error at the end ≤ {Search().target:g}")
        ax.legend(fontsize=7, ncols=3, loc="upper center")
    return save(figure, figures, "cost.png")


def _draw_method(ax: Any, method: str, costs: Sequence[Cost], colour: str) -> None:
    printed = [cost for cost in costs if cost.formulation == "eq. 8" and cost.outcome]
    done = [cost for cost in printed if not cost.reason]
    numbers = [[cost.epsilon for cost in done], [cost.count("rhs") for cost in done]]
    ax.plot(*numbers, "o-", color=colour, label=f"eq. 8, {method}")
    for cost in costs:
        if cost.formulation == "reduced" and not cost.reason:
            ax.axhline(cost.count("rhs"), linestyle="--", linewidth=1, color=colour, label=f"reduced, {method}")
    for cost in printed:
        if cost.reason:
            ax.plot(cost.epsilon, cost.count("rhs"), "^", color=colour, markerfacecolor="none", markersize=9)
            label = f" stopped at {cost.outcome.t:.2g} s" if cost.outcome else ""
            ax.annotate(label, (cost.epsilon, cost.count("rhs")), fontsize=7, va="center", xytext=(5, 0),
                        textcoords="offset points")  # fmt: skip
