"""Run through positions where J loses rank: the N-four-bar lies flat every half turn, where J loses N ranks.

Each run is compared with the closed form: all rods have one angle, theta_ddot = -k cos(theta). A run is "right" if the
first top pin is within 1e4 rtol and 1e-4 m after ten seconds, "stopped" if it ends with exit code 3, and otherwise
"wrong".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin import simulate

__all__ = ["TOLERANCES", "Crossing", "crossings", "first_top_pin", "show"]

Verdict = Literal["right", "stopped", "wrong"]

LOOPS = (1, 2, 7, 40)
TOLERANCES = tuple(float(rtol) for rtol in np.logspace(-5, -11, 20))
T_END = 10.0
G = 9.81


@dataclass(frozen=True)
class Crossing:
    """Result of one run.

    Attributes
    ----------
    t : float
        Time reached, s.
    error : float
        Distance of B0 from the closed form at that time, m.
    """

    N: int
    rtol: float
    status: str
    t: float
    error: float
    rhs: int

    @property
    def verdict(self) -> Verdict:
        """Return "right", "stopped", or "wrong" for a finished run with a large error."""
        if self.status != "done":
            return "stopped"
        return "right" if self.error <= min(1e4 * self.rtol, 1e-4) else "wrong"


def first_top_pin(N: int, t: float) -> tuple[float, float]:
    """Return B0 of the N-four-bar at t by the closed form, m. It starts upright, with the top pins at +1 m/s."""
    from scipy.integrate import solve_ivp

    k = G * 3 * (3 * N + 1) / (2 * (4 * N + 1))
    start = (np.pi / 2, -1.0)
    motion = solve_ivp(lambda _, y: (y[1], -k * np.cos(y[0])), (0, t), start, "DOP853", rtol=1e-13, atol=1e-14)
    return float(np.cos(motion.y[0, -1])), float(np.sin(motion.y[0, -1]))


def crossings(loops: Sequence[int], tolerances: Sequence[float], formulation: str = "dae") -> Iterator[Crossing]:
    """Run every number of loops at every tolerance for ten seconds."""
    for N in loops:
        for rtol in tolerances:
            overrides = {"mechanism.N": N, "solver.rtol": rtol, "formulation": formulation}
            run = simulate("n_four_bar", {**overrides, "t_end": T_END, "solver.output_dt": T_END})
            t = float(run.t[-1])
            error = float(np.hypot(*(run.points["B0"][-1][:2] - np.array(first_top_pin(N, t)))))
            yield Crossing(N, rtol, run.status, t, error, run.stats["rhs"])


def show(formulation: str, quick: bool) -> None:
    """Print a table of the runs and how many are right, stopped and wrong."""
    loops, tolerances = (LOOPS[:3], TOLERANCES[::3]) if quick else (LOOPS, TOLERANCES)
    verdicts: Counter[str] = Counter()
    print("|  N |    rtol | verdict |      t | error of B0 |   rhs |")
    print("|---:|--------:|---------|-------:|------------:|------:|")
    for one in crossings(loops, tolerances, formulation):
        verdicts[one.verdict] += 1
        row = f"| {one.N:2} | {one.rtol:.1e} | {one.verdict:7} | {one.t:6.3f} | {one.error:11.1e} | {one.rhs:5} |"
        print(row, flush=True)
    print(", ".join(f"{verdicts[verdict]} {verdict}" for verdict in ("right", "stopped", "wrong")))
