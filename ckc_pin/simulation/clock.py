"""The legs of a run: no step crosses an instant where a sampled controller changes what acts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ckc_pin.control.controllers import Controller
from ckc_pin.control.sampled import Sampled
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.integrate import Step, Stepper
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.systems import System

__all__ = ["Clock", "Legs"]


class Legs:
    """Steps a stepper from leg to leg, and keeps the last state that is known to be good.

    Parameters
    ----------
    stepper : Stepper
        Made for the first leg.

    Attributes
    ----------
    burst : callable or None
        Steps as far as it can by itself, before each single step.
    good : (t, y)
        After an accepted step its end; what the system made of that once it is settled.
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.guard = RankGuard(stepper)
        self.burst: Callable[[], None] | None = None
        self.good: tuple[float, Array] = (stepper.t, stepper.y)

    def aim(self, t_end: float) -> None:
        """Go on from here to another end, with a solver that remembers nothing but its step's length."""
        stepper, solver = self.stepper, self.stepper.solver
        if solver.t_bound == t_end:
            return
        length = getattr(solver, "h_abs", None) or solver.step_size
        solver.t_bound, solver.status = t_end, "running"
        stepper.settle()
        stepper.go_on(stepper.t, stepper.solver.y, length)
        self.good = (stepper.t, stepper.solver.y)

    def steps(self) -> Iterator[Step]:
        """Step to the end of the leg; each step but the last is settled once it has been looked at."""
        stepper = self.stepper
        while stepper.solver.status == "running":
            if self.burst is not None:
                self.burst()
                if stepper.solver.status != "running":
                    break
            step = self.guard.step()
            self.good = (step.t, stepper.solver.y)
            yield step
            if stepper.solver.status == "running":
                stepper.settle()
                self.good = (stepper.t, stepper.solver.y)


class Clock:
    """Ends of the legs of a run, in order; the last one is t_end.

    Parameters
    ----------
    controller : Controller or None
        Ticks at once, at t = 0, if it is a sampled one.
    system : System
    t_end : float

    Raises
    ------
    InputError
        More samples than can be meant, or a sampled u of the wrong shape.
    NumericalError
        A sampled u that is not finite.
    """

    def __init__(self, controller: Controller | None, system: System, t_end: float) -> None:
        self.system, self.t_end = system, t_end
        self.sampled = controller if isinstance(controller, Sampled) else None
        self.ends = [t_end]
        if self.sampled is not None:
            instants = self.sampled.instants(t_end)[1:]
            self.ends = [*instants[instants < t_end - self.sampled.near(t_end)].tolist(), t_end]
            self.sampled.begin(system.mechanism.d)
            self.tick(0.0, system.start())

    def __iter__(self) -> Iterator[float]:
        return iter(self.ends)

    def tick(self, t: float, y: Array) -> None:
        """Let a sampled controller see the state at an instant, and change what acts."""
        if self.sampled is not None:
            self.sampled.tick(t, self.system.terms(t, y))

    def within(self, until: float, end: float) -> float:
        """Up to when a leg's own u acts: an instant itself belongs to the next leg."""
        return until if self.sampled is None else min(until, end - self.sampled.near(end))

    def at(self, end: float) -> float:
        """Up to when an output instant counts as the end of a leg."""
        return end if self.sampled is None else end + self.sampled.near(end)
