"""Plain steps one after the other in the native core, until something calls for Python.

Events, changes of the partition, a loss of rank that a coarse run meets or that cannot be leapt over, budgets, whatever
does not converge: the loop returns where its last step ended, and the next one is Python's.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from ckc_pin.mechanism.tree import Array
from ckc_pin.native import core
from ckc_pin.simulation.integrate import Stepper
from ckc_pin.simulation.leap import tables
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.record import Recorder
from ckc_pin.simulation.systems.base import CHART_MARGIN
from ckc_pin.simulation.systems.level_set import LevelSet

__all__ = ["Burst", "runs"]

PAUSE = 0.05  # s: how long the interpreter, and with it Ctrl-C, may be kept waiting
ROWS = 20_000  # instants recorded in one go
UNLIMITED = 2**62
STAGES = 12  # of DOP853


class Burst:
    """Runs a stepper natively as far as that goes.

    Parameters
    ----------
    stepper : Stepper
        Of a native system that knows what acts.
    guard : RankGuard
        Learns how far J is from losing rank.
    recorder : Recorder
    times : array
        All output instants.
    within : callable
        (until, end of the leg) to the last instant whose output may be recorded.
    """

    def __init__(
        self,
        stepper: Stepper,
        guard: RankGuard,
        recorder: Recorder,
        times: Array,
        within: Callable[[float, float], float],
    ) -> None:
        self.stepper, self.guard, self.recorder, self.times, self.within = stepper, guard, recorder, times, within
        self.system: Any = stepper.system
        self._made_for: tuple[Any, ...] = ()

    @property
    def able(self) -> bool:
        """Whether the native loop can go on: no more once method or coordinates are Python's."""
        return bool(self.system.crosses) and runs(self.stepper)

    def run(self, due: int) -> tuple[int, bool]:
        """Step on; return which output instant is the next, and whether there is more to be done natively."""
        loop, stepper = self._loop(), self.stepper
        solver = stepper.solver
        self.system.refresh()
        loop.begin(stepper.t, solver.y, getattr(solver, "f", solver.y), solver.h_abs, *stepper.before)
        if stepper.method == "BDF":
            loop.remember(solver.D, solver.order, solver.n_equal_steps, solver.J)
        loop.growing = stepper.growing
        loop.chart_margin = getattr(self.system, "margin", CHART_MARGIN)
        if self.guard.end is not None:
            loop.end = self.guard.end
        end = float(solver.t_bound)
        why, rows = loop.go(
            end,
            stepper.spec.min_step,
            self._allowed(),
            PAUSE,
            self.within(end, end),
            self.guard.fine,
            self.times[due:],
            min(ROWS, len(self.times) - due),
        )
        self.system.book()
        self.recorder.extend(rows)
        steps, rejected, rhs, jacobians, factorizations = loop.counts()
        stepper.rejected += rejected
        stepper.rhs_count += rhs
        solver.njev += jacobians
        solver.nlu += factorizations
        if steps:
            stepper.steps += steps
            self.guard.take_over(loop.end, loop.length)
            stepper.growing = loop.growing
            stepper.adopt(loop.t, loop.y, loop.f, loop.h_abs, loop.before)
            if stepper.method == "BDF":
                solver.D, solver.order, solver.n_equal_steps, solver.J = loop.memory()
                solver.LU = None
        self.guard.crossings += loop.crossings()
        if np.isfinite(loop.ahead):
            self.guard.expect(loop.ahead)
        stepper.require_time()
        return due + len(rows), why == "pause" and steps > 0

    def unrecorded(self) -> None:
        """Step on as far as that goes, without output."""
        more = self.able
        while more:
            _, more = self.run(len(self.times))

    def _allowed(self) -> int:
        """Right-hand sides up to the budget, or to about where the method is doubted."""
        stepper, allowed = self.stepper, UNLIMITED
        if stepper.spec.max_rhs is not None:
            allowed = stepper.spec.max_rhs - stepper.rhs_count
        if np.isfinite(stepper.doubt):
            allowed = min(allowed, max(1, int(stepper.doubt) - stepper.steps) * STAGES)
        return allowed

    def _loop(self) -> Any:
        options = self.stepper.options
        leaps = self.guard.leaps
        made_for = (self.system.native, self.stepper.method, options["rtol"], options["atol"], leaps)
        if made_for != self._made_for:
            self._made_for = made_for
            self._made = core().Loop(
                self.system.native, self.stepper.method, _coefficients(self.stepper), options["rtol"], options["atol"],
                options.get("max_step", np.inf), *self.guard.scales, _leap() if leaps else [], self.guard.gap,
            )  # fmt: skip
        return self._made


def runs(stepper: Stepper) -> bool:
    """Whether the native core has a stepper's method: the explicit one, and BDF where the Jacobian is known."""
    return stepper.method == "DOP853" or (
        stepper.method == "BDF" and isinstance(stepper.system, LevelSet) and "jac" in stepper.options
    )


def _coefficients(stepper: Stepper) -> Any:
    """SciPy's own, so that both backends take the same steps."""
    return float(stepper.solver.newton_tol) if stepper.method == "BDF" else _dop853()


@cache
def _dop853() -> Any:
    from scipy.integrate import DOP853

    names = ("A", "A_EXTRA", "D", "B", "C", "C_EXTRA", "E3", "E5")
    return core().Dop853Table(*(np.asfortranarray(getattr(DOP853, name), dtype=float) for name in names))


@cache
def _leap() -> list[Any]:
    return [core().LeapTable(**table) for table in tables()]


for kept in (_dop853, _leap):  # nanobind tells of objects that outlive it
    atexit.register(kept.cache_clear)
