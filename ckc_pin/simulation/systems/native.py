"""The same first-order systems with their right-hand sides in the native core; everything else is inherited."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller, SetPoint, Tracking
from ckc_pin.control.sampled import Held
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.chart import Chart
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.tree import Array
from ckc_pin.native import core
from ckc_pin.native.drive import hand_over
from ckc_pin.native.tables import make_core
from ckc_pin.simulation.systems.base import Counts
from ckc_pin.simulation.systems.dae import Dae
from ckc_pin.simulation.systems.level_set import LevelSet
from ckc_pin.simulation.systems.printed_spf import PrintedSpf
from ckc_pin.simulation.systems.trail import Trail

__all__ = ["Native", "NativeDae", "NativeLevelSet", "NativePrintedSpf"]


class NativeTrail(Trail):
    """The trail of a native level set, which the right-hand sides of both backends lengthen."""

    def __init__(self, native: Any, start: Kinematics) -> None:
        self._native, self._start = native, start

    @property
    def last(self) -> Kinematics:
        return self._placed(self._native.last())

    def add(self, t: float, at: Kinematics, v_tree: Array, w: Array) -> None:
        self._native.add(t, at.q_tree, v_tree, w)

    def predict(self, t: float, numbers: Array, chart: Chart, w: Array) -> Kinematics:
        return self._placed(self._native.predict(t, numbers, w))

    def _placed(self, q_tree: Array) -> Kinematics:
        return Kinematics(self._start.tree, self._start.closure, self._start.partition, q_tree)


class Native:
    """What the native systems have in common.

    Attributes
    ----------
    native : ckc_pin.native System
    crosses : bool
        Whether the native side knows what acts; else the controller is called for each right-hand side.
    """

    controller: Controller | None
    actuation: Actuation | None
    counts: Counts
    native: Any = None
    crosses = False
    core: Any = None

    @property
    def controls(self) -> bool:
        """Whether one of the paper's controllers acts natively, with its Lyapunov function."""
        return self.crosses and isinstance(self.controller, SetPoint | Tracking)

    def drive(self, native: Any) -> None:
        """Let a native system act as the controller does, if it knows how."""
        self.native = native
        self.crosses = self.actuation is not None and hand_over(self.controller, self.actuation, native)

    def refresh(self) -> None:
        """Hand over a u that is held."""
        if isinstance(self.controller, Held):
            self.native.hold(self.controller.held)

    def book(self) -> None:
        """Add the native side's counts."""
        newton, factorizations = self.native.counts()
        self.counts.newton += newton
        self.counts.factorizations += factorizations

    def row(self, t: float, y: Array) -> Array | None:
        """What a run keeps of an instant, as the native step loop records it; None where Python has to tell."""
        if not self.crosses:
            return None
        self.refresh()
        found: Array | None = self.native.row(t, y)
        self.book()
        return found

    def evaluate(self, t: float, y: Array) -> Array | None:
        """y' with what acts natively; None where it does not exist."""
        self.refresh()
        derivative: Array | None = self.native.rhs(t, y)
        self.book()
        return derivative


@dataclass
class NativeLevelSet(LevelSet, Native):
    """A level set whose right-hand sides are native as long as no free root is among q.

    Where Newton's method does not close the loops from the prediction the inherited one looks further.
    """

    controller: Controller | None = None
    actuation: Actuation | None = None
    backend: ClassVar[str] = "native"

    def _new_trail(self, start: Kinematics) -> Trail:
        if not self._chart.plain:
            self.native, self.crosses = None, False
            return super()._new_trail(start)
        if self.core is None:
            self.core = make_core(self.mechanism)
        self.core.split(start.partition.q.tolist(), start.partition.z.tolist())
        w0 = np.zeros(self.mechanism.closure.rows) if self.w0 is None else self.w0
        with_actual = self.convention == "actual"
        native = core().LevelSet(
            self.core, start.q_tree, self.epsilon, with_actual, w0, self.mechanism.tolerance, self.slack
        )
        self.drive(native)
        return NativeTrail(native, start)

    def rhs(self, t: float, y: Array) -> Array:
        if self.native is None:
            return super().rhs(t, y)
        derivative = self.evaluate(t, y) if self.crosses else self._with_force(t, y)
        return super().rhs(t, y) if derivative is None else derivative

    def _with_force(self, t: float, y: Array) -> Array | None:
        closed = self.native.open(t, y)
        if closed is None:
            return None
        at = self._trail.last
        at = Kinematics(at.tree, at.closure, at.partition, closed[0])
        u_tree = self.force(t, Terms(self.mechanism, at, closed[1]))
        derivative = self.native.finish(u_tree) if np.isfinite(u_tree).all() else None
        self.book()
        return derivative


@dataclass
class NativePrintedSpf(PrintedSpf, Native):
    """Eq. 8 as printed with native right-hand sides where the native side knows what acts."""

    controller: Controller | None = None
    actuation: Actuation | None = None
    backend: ClassVar[str] = "native"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.core = make_core(self.mechanism)
        self.drive(core().PrintedSpf(self.core, self.epsilon, self.convention == "actual", self.w0))

    def rhs(self, t: float, y: Array) -> Array:
        derivative = self.evaluate(t, y) if self.crosses else None
        return super().rhs(t, y) if derivative is None else derivative


@dataclass
class NativeDae(Dae, Native):
    """Eq. 1 with native accelerations."""

    controller: Controller | None = None
    actuation: Actuation | None = None
    backend: ClassVar[str] = "native"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.core = make_core(self.mechanism)
        alpha, beta = self.baumgarte or (0.0, 0.0)
        self.drive(core().Dae(self.core, self.mechanism.tolerance, self.projects, alpha, beta))

    def rhs(self, t: float, y: Array) -> Array:
        if self.closes_within:
            return super().rhs(t, y)
        derivative = self.evaluate(t, y) if self.crosses else self._with_force(t, y)
        return super().rhs(t, y) if derivative is None else derivative

    def _projected(self, at: Kinematics, v_tree: Array) -> Terms:
        y = np.concatenate([at.q_tree, v_tree])
        if not np.isfinite(y).all():
            return super()._projected(at, v_tree)
        found = self.native.projected(y)
        if found is None:  # near a rank loss, with what that has cost forgotten
            self.native.counts()
            return super()._projected(at, v_tree)
        self.book()
        return Terms(self.mechanism, self.mechanism.kinematics(found[0]), found[1])

    def rates_on_closure(self, times: Array, states: Array) -> Array:
        if self.closes_within or not self.crosses:
            return super().rates_on_closure(times, states)
        self.refresh()
        rates: Array = self.native.rates_on_closure(times, states)
        self.book()
        return rates

    def _with_force(self, t: float, y: Array) -> Array | None:
        q_tree, v_tree = self._split(y)
        terms = Terms(self.mechanism, self.mechanism.kinematics(q_tree), v_tree)
        u_tree, correction = self.force(t, terms), self.w(t) + self._correction(terms)
        if not (np.isfinite(u_tree).all() and np.isfinite(correction).all()):
            return None
        acceleration = self.core.dae_acceleration(q_tree, v_tree, u_tree, correction)
        if not np.isfinite(acceleration).all():  # the reason is told in Python
            return None
        self.counts.factorizations += 2
        return np.concatenate([self.mechanism.tree.configuration_rate(q_tree, v_tree), acceleration])
