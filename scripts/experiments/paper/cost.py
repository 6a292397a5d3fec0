"""Cost of the formulations at equal error (section III-B): eq. 8 as printed, the reduced model, the DAE.

All are integrated in NumPy by SciPy's methods, so that only the equations differ. For each method, the loosest
tolerance of a list is chosen whose run ends within `Search.target` of the DAE integrated at 1e-12. The counts and the
processor time of that run are the cost. All runs start on phi = 0, where epsilon affects only the cost of eq. 8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ckc_pin.dynamics.terms import Terms
from ckc_pin.run.ivp import Ivp
from scripts.experiments.paper.experiment import Outcome, Problem, difference, end_of, march

__all__ = ["EPSILONS", "METHODS", "Cost", "Search", "cheapest", "cost_at_equal_error", "study"]

METHODS = ("DOP853", "Radau", "BDF", "LSODA")
EPSILONS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
REPEATS = 2  # repetitions of short runs, of which the minimum time counts
MAX_REPEATED_RUN_S = 0.3  # runs that take longer are not repeated


@dataclass(frozen=True)
class Search:
    """Definition of equal error, and the budget of a run.

    Attributes
    ----------
    rtols : tuple of float
        Decreasing tolerances.
    target : float
        Largest error in (q, q_dot) and z at the end.
    max_rhs : int
        Budget of right-hand sides of a run.
    """

    rtols: tuple[float, ...] = tuple(10.0 ** (-k / 2) for k in range(6, 21))
    target: float = 1e-6
    max_rhs: int = 50_000


@dataclass(frozen=True)
class Cost:
    """Cost of a formulation and method at the loosest tolerance that reaches the target, or why there is none.

    Attributes
    ----------
    formulation : "eq. 8", "reduced" or "DAE"
    epsilon : float or None
    method : str
    rtol, error : float
        Tolerance and error of that run; NaN without one.
    outcome : Outcome or None
    reason : str
        Why no run reaches the target; empty if one does.
    """

    formulation: str
    epsilon: float | None
    method: str
    rtol: float = float("nan")
    error: float = float("nan")
    outcome: Outcome | None = None
    reason: str = ""

    @property
    def seconds(self) -> float:
        """Processor time; NaN without a run."""
        return self.outcome.seconds if self.outcome else float("nan")

    def count(self, name: str) -> int:
        """Return one of the outcome's counts, 0 without a run."""
        return self.outcome.stats[name] if self.outcome else 0


def cost_at_equal_error(
    name: Cost, make: Callable[[], Ivp], reference: Terms, t_end: float, search: Search, first: float
) -> Cost:
    """Find the loosest tolerance that reaches the target, and the cost of its run.

    Parameters
    ----------
    name : Cost
        Its formulation, epsilon and method are used.
    make : callable
        Returns a new initial value problem for each run.
    reference : Terms
        The exact state at t_end.
    t_end : float
    search : Search
    first : float
        First tolerance to try. If it reaches the target, looser ones follow while they do. Otherwise tighter ones
        follow until one reaches it or the budget is exhausted.
    """

    def attempt(k: int) -> Cost:
        outcome = march(make(), name.method, search.rtols[k], t_end, max_rhs=search.max_rhs)
        tried = replace(name, rtol=search.rtols[k], outcome=outcome)
        if outcome.stopped:
            return replace(tried, reason=outcome.stopped)
        error = max(difference(reference, outcome.terms))
        return replace(tried, error=error, reason="" if error <= search.target else f"error {error:.1e}")

    k = int(np.argmin(np.abs(np.log(np.array(search.rtols) / first))))
    best = attempt(k)
    if best.reason:
        while best.reason and k + 1 < len(search.rtols) and not _out_of_budget(best):
            k += 1
            best = attempt(k)
    else:
        while k > 0 and not (looser := attempt(k - 1)).reason:
            k, best = k - 1, looser
    return best if best.reason else _timed(best, make, t_end)


def _out_of_budget(cost: Cost) -> bool:
    return "max_rhs" in cost.reason


def _timed(cost: Cost, make: Callable[[], Ivp], t_end: float) -> Cost:
    if cost.outcome is None or cost.outcome.seconds > MAX_REPEATED_RUN_S:
        return cost
    runs = [cost.outcome, *(march(make(), cost.method, cost.rtol, t_end) for _ in range(REPEATS - 1))]
    return replace(cost, outcome=min(runs, key=lambda run: run.seconds))


def study(
    problem: Problem,
    t_end: float,
    epsilons: Sequence[float] = EPSILONS,
    methods: Sequence[str] = METHODS,
    search: Search | None = None,
) -> list[Cost]:
    """Measure the cost of the reduced model, the DAE, and eq. 8 for each epsilon, with each method.

    After a method has exhausted its budget at one epsilon, it is not tried with smaller ones.

    Parameters
    ----------
    problem : Problem
    t_end : float
    epsilons : sequence of float
        Decreasing tolerances.
    methods : sequence of str
    search : Search, optional

    Raises
    ------
    NumericalError
        The reference cannot be computed.
    """
    search = search or Search()
    reference = end_of(problem.dae(), "DOP853", 1e-12, t_end)
    for ivp in (problem.printed_spf(1e-2), problem.reduced()):  # imports and caches are filled before the timing
        march(ivp, "DOP853", 1e-3, min(t_end, 0.1))
    return [
        cost for method in methods for cost in _costs_of_method(problem, method, epsilons, reference, t_end, search)
    ]


def _costs_of_method(
    problem: Problem, method: str, epsilons: Sequence[float], reference: Terms, t_end: float, search: Search
) -> list[Cost]:
    cases: list[tuple[Cost, Callable[[], Ivp]]] = [
        (Cost("reduced", None, method), problem.reduced),
        (Cost("DAE", None, method), problem.dae),
        *((Cost("eq. 8", epsilon, method), partial(problem.printed_spf, epsilon)) for epsilon in epsilons),
    ]
    costs: list[Cost] = []
    rtol, spent = 1e-6, ""
    for name, make in cases:
        if spent:
            costs.append(replace(name, reason=spent))
            continue
        cost = cost_at_equal_error(name, make, reference, t_end, search, rtol)
        rtol = rtol if cost.reason else cost.rtol  # the next epsilon needs about the same tolerance
        if name.epsilon is not None and _out_of_budget(cost):
            spent = f"not tried: too much at epsilon = {name.epsilon:.0e} already"
        costs.append(cost)
    return costs


def cheapest(costs: Sequence[Cost], formulation: str, epsilon: float | None = None) -> Cost:
    """Return the smallest cost in time of a formulation over the methods that reach the target."""
    those = [c for c in costs if c.formulation == formulation and c.epsilon == epsilon and not c.reason]
    return min(those, key=lambda cost: cost.seconds)
