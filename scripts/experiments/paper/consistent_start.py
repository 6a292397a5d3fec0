"""From a consistent start, w(0) = 0, SPF and DAE have the same solution for every epsilon.

Eq. 8 gives dphi/dt = -phi/epsilon exactly, so that phi stays zero, and on phi = 0 its first line is eq. 6. Measured
differences are integration errors only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin.base.arrays import Array
from scripts.experiments.chart import BLACK, COLOURS, chart, save
from scripts.experiments.pages import render_blocks
from scripts.experiments.paper.claim import Claim
from scripts.experiments.paper.experiment import Problem, difference, end_of, five_bar_problem

__all__ = ["Irrelevance", "claims", "measure"]

PRINTED = tuple(10.0**-k for k in range(1, 9))
EQ_17 = tuple(10.0**-k for k in range(1, 13))
RTOLS = (1e-4, 1e-6, 1e-8)
T_END = 1.0


@dataclass(frozen=True)
class Irrelevance:
    """Largest difference in (q, q_dot) from the DAE at t_end, at one tolerance.

    Attributes
    ----------
    rtol : float
    printed : (m,) array
        Eq. 8 as printed by Radau, for each epsilon.
    eq_17 : (k,) array
        Eq. 17 by DOP853, for each epsilon.
    radau, dop853 : float
        The same for the reduced model, which has no epsilon, by the same two methods.
    """

    rtol: float
    printed: Array
    eq_17: Array
    radau: float
    dop853: float


def measure(
    problem: Problem,
    rtol: float,
    printed: Sequence[float] = PRINTED,
    eq_17: Sequence[float] = EQ_17,
    t_end: float = T_END,
) -> Irrelevance:
    """Integrate the SPF from phi = 0 for each epsilon and compare with the DAE at rtol 1e-12.

    Raises
    ------
    NumericalError
        A run stops.
    """
    dae = end_of(problem.dae(), "DOP853", 1e-12, t_end)
    none = np.zeros(problem.mechanism.closure.rows)
    return Irrelevance(
        rtol,
        np.array([difference(dae, end_of(problem.printed_spf(e), "Radau", rtol, t_end))[0] for e in printed]),
        np.array([difference(dae, end_of(problem.spf(e, none), "DOP853", rtol, t_end))[0] for e in eq_17]),
        difference(dae, end_of(problem.reduced(), "Radau", rtol, t_end))[0],
        difference(dae, end_of(problem.reduced(), "DOP853", rtol, t_end))[0],
    )


def claims(figures: Path) -> list[Claim]:
    """Answer whether epsilon matters from a consistent start."""
    studies = [measure(five_bar_problem(True), rtol) for rtol in RTOLS]
    name = _draw(studies, figures)
    worst = max(float((each.printed / each.radau).max()) for each in studies)
    same = all(bool(np.all(each.eq_17 == each.dop853)) for each in studies)
    return [
        Claim(
            key="epsilon-irrelevant",
            verdict="does not hold" if same and worst < 10 else "holds",
            figures=(name,),
            table=_table(studies),
            **render_blocks(
                "claims/epsilon-irrelevant",
                t_end=T_END,
                largest=[each.printed.max() for each in studies],
                printed=(PRINTED[0], PRINTED[-1]),
                rtols=[each.rtol for each in studies],
                worst=worst,
                same=same,
                smallest=EQ_17[-1],
            ),
        )
    ]


def _table(studies: Sequence[Irrelevance]) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    heads = ["ε"]
    for each in studies:
        heads += [f"eq. 8: rtol {each.rtol:.0e}", f"eq. 17: rtol {each.rtol:.0e}"]
    rows = []
    for k, epsilon in enumerate(EQ_17):
        cells = [f"{epsilon:.0e}"]
        for each in studies:
            cells += [f"{each.printed[k]:.1e}" if k < len(PRINTED) else "", f"{each.eq_17[k]:.1e}"]
        rows.append(tuple(cells))
    rows.append(("reduced", *(f"{x:.1e}" for each in studies for x in (each.radau, each.dop853))))
    return tuple(heads), tuple(rows)


def _draw(studies: Sequence[Irrelevance], figures: Path) -> str:
    figure, (ax,) = chart()
    for each, colour in zip(studies, COLOURS, strict=False):
        ax.loglog(PRINTED, each.printed, "o-", color=colour, label=f"eq. 8, Radau, rtol {each.rtol:.0e}")
        ax.loglog(EQ_17, each.eq_17, "s--", color=colour, label=f"eq. 17, DOP853, rtol {each.rtol:.0e}", markersize=4)
    ax.loglog(EQ_17, EQ_17, ":", color=BLACK, label="ε, the bound off the manifold")
    ax.set(xlabel="ε (s)", ylabel=f"largest difference in (q, q̇) from the DAE at t = {T_END:g} s")
    ax.set_ylim(1e-12, 1.0)
    ax.set_title("From w(0) = 0: the tolerance counts, ε does not")
    ax.legend(fontsize=7, ncols=2)
    return save(figure, figures, "consistent_start.png")
