"""Watches for J losing rank, where branches of the motion meet.

At a change point (a flat four-bar) the loops stop to determine the motion: a step that passes over it can
come out on the other branch, within tolerance and wrong. The smallest singular value s(t) of J shows it
as a V that reaches zero: falling at the start of a step, rising at its end. In such a step the minimum is
searched for. Where the motion itself is smooth there, it is crossed by a leap (`simulation.leap`).
The native loop does the same by itself (`native/src/crossing.hpp`); what it does not pass comes here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.rank import scales
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.integrate import Step, Stepper
from ckc_pin.simulation.leap import Leap, leap
from ckc_pin.simulation.systems import Dae, Native

__all__ = ["RankGuard"]

FINE = 1e-7  # at least, in a run with crossings: with less they come out up to 1e-2 off after ten seconds
LOST = 1e-5  # relative to the largest singular value: the rank is lost
DEEP = 0.7  # of the larger end value: a V whose tangents meet below that is looked at through the interpolant
NECK = 0.2  # of the larger end value: a minimum below that has to be resolved by shorter steps
SHORTEST = 1e-6  # s; a step below that resolves any neck that is wider than LOST
JUMP = 0.7  # of the time to s = 0 along its tangent: the longest step that begins and ends with s falling
NEAR = 4.0  # steps: a crossing that is as near as that is leapt over
BEYOND = 0.3  # of the time to a crossing: one that is as much behind the end of the run is left alone
AHEAD = 0.1  # of s: what is left of it at a crossing, the motion extrapolated
ATTEMPTS = 6  # leaps, each from half as far away as the one before
CENTRED = 0.04  # of half a leap: how well the crossing has to be in its middle
NEWTON = 10  # steps of Newton's method on s, with its sign; it takes two or three
CLOSED = 1e-9  # of the mechanism's size: the loops stay closed along a leap, or the branches do not meet


class RankGuard:
    """Steps a run, and takes it across positions where J loses rank, or stops it there.

    A crossing is passed when the formulation does not need the branch from J (the DAE: its solution is
    smooth there). A run that meets none evaluates no right-hand side more.

    Parameters
    ----------
    stepper : Stepper

    Attributes
    ----------
    crossings : list of float
        When J lost rank, s.
    end : (s, rate) or None
        The least singular value at the end of the last step.
    length : float
        Of that step, s.
    scales : (array, array)
        What makes J free of units: of its rows and its columns.
    burst : callable or None
        Steps as far as it can by itself, without output.
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.system = stepper.system
        mechanism = self.system.mechanism
        self.rank = mechanism.rank
        self.core = self.system.core if isinstance(self.system, Native) else None
        self.dae = self.system if isinstance(self.system, Dae) and self.system.closed else None
        self.scales = scales(mechanism.tree, mechanism.closure, mechanism.size)
        self.crossings: list[float] = []
        self.end: tuple[float, float] | None = None
        self.length = 0.0
        self.burst: Callable[[], None] | None = None
        self._inside: float | None = None  # when rank is lost within a step that was taken back
        self._reach = np.inf  # s; from farther away no leap is expected to be accurate
        self._attempts = 0
        self._first_leg = stepper.solver.t_bound

    def step(self) -> Step:
        """Advance by one accepted step, or a leap; to be followed by `Stepper.settle`.

        Raises
        ------
        NumericalError
            J loses rank and the system cannot pass it, or the solver cannot go on.
        BudgetError
            A budget is used up.
        """
        while True:
            left = self._time_to_crossing()
            across = None if left is None else self._across(left)
            if across is not None:
                return across
            step = self.stepper.step()
            if self.rank == 0 or self._stands(step):
                return step

    def _stands(self, step: Step) -> bool:
        """Whether a step can be kept; if not it is taken back."""
        (old, falling), (new, rising) = self.end or self._rate(step, step.t_old), self._rate(step, step.t)
        h = step.t - step.t_old
        if falling < 0 < rising and _tangents_meet(h, old, falling, new, rising) < DEEP * max(old, new):
            t, value = self._minimum(step.interpolant, step.t_old, step.t)
            if value < LOST:
                if not self._passes:
                    raise self._lost(step, t, value)
                self._inside = t
                self.stepper.take_back((t - step.t_old) / 2)
                return False
            if value < NECK * max(old, new) and h > SHORTEST:
                self.stepper.take_back(h / 4)
                return False
        if falling < 0 and rising <= 0 and h > JUMP * -old / falling and h > SHORTEST:
            self.stepper.take_back(h / 2)  # it may have passed zero, a peak, and be falling again
            return False
        if falling >= 0 and rising > 0 and h > new / rising and h > SHORTEST:
            self.stepper.take_back(h / 2)  # a peak, zero, and rising again: its tangent has zero within the step
            return False
        if new < LOST:
            raise self._lost(step, step.t, new)
        self.take_over((new, rising), h)
        return True

    # --- what the native loop sees to ------------------------------------------------------------

    @property
    def leaps(self) -> bool:
        """Whether the native loop knows how to leap: no row of J is idle."""
        return self.dae is not None and self.rank == self.system.mechanism.closure.rows

    @property
    def fine(self) -> bool:
        """Whether crossings come out well as the run is; else it is made again up to the first one."""
        return bool(self.stepper.options["rtol"] <= FINE)

    @property
    def gap(self) -> float:
        """How far loops may be open along a leap, rad or m."""
        mechanism = self.system.mechanism
        return max(CLOSED * mechanism.size, 10 * mechanism.tolerance)

    def take_over(self, end: tuple[float, float], length: float) -> None:
        """Learn of a step that was kept: the value and rate at its end, and its length."""
        if end[1] > 0:
            self._attempts = 0
        self.end, self.length, self._inside = end, length, None

    def expect(self, crossing: float) -> None:
        """Learn when J is about to lose rank."""
        if self._passes:
            self._inside = crossing

    # --- crossing --------------------------------------------------------------------------------

    @property
    def _passes(self) -> bool:
        return self.dae is not None and self._attempts < ATTEMPTS

    def _time_to_crossing(self) -> float | None:
        """Time until J loses rank; None when that is not near. Costs no right-hand side."""
        t, inside = self.stepper.t, self._inside
        self._inside = None
        if inside is not None:
            return inside - t
        s, falling = self.end or (0.0, 0.0)
        if falling >= 0 or not self._passes or s > -NEAR * self.length * falling:
            return None
        y, rate, n = self.stepper.solver.y, self.stepper.solver.f, self.system.positions

        def extrapolated(t_ahead: float) -> Array:
            ahead = y + (t_ahead - t) * rate
            ahead[:n] += 0.5 * (t_ahead - t) ** 2 * rate[n : 2 * n]
            return ahead

        left = -s / falling
        crossing, least = self._minimum(extrapolated, t + 0.3 * left, t + 1.3 * left, accuracy=1e-2)
        if least >= AHEAD * s or crossing - self.stepper.solver.t_bound > BEYOND * (crossing - t):
            return None
        return crossing - t

    def _across(self, left: float) -> Step | None:
        """Leap over a crossing; None where it has to be approached first, or is none."""
        stepper = self.stepper
        t, y = stepper.t, stepper.solver.y.copy()
        if left > max(self._reach, self.length):  # a step as long as the last one does not pass it either
            self._approach(left)
            return None
        starts = [(t, y)]
        if left < 0.5 * self.length:  # so near J is ill-conditioned: rather from where the last step began
            starts.insert(0, stepper.before)
        self._attempts += 1
        again = not self.fine and t > 0 and stepper.solver.t_bound == self._first_leg
        for start in starts:
            found, crossing = self._leap(*start, t + left, centred=not again)
            if crossing is not None:
                break
        else:
            self._approach(left)
            return None
        stepper.refine(FINE)
        if again:
            self._again(t)
            self._inside = crossing
            return None
        self.crossings.append(crossing)
        self._attempts = 0
        end = min(found.t, float(stepper.solver.t_bound))
        step = Step(t, end, found)
        stepper.go_on(end, found(end), self.length or left)
        stepper.steps += 1
        self.end = self._rate(step, end)
        return step

    def _approach(self, left: float) -> None:
        """Let the next step end where a leap may succeed, unless it is to be shorter anyway."""
        length = max(left - 0.9 * self._reach, 0.1 * left)
        solver = self.stepper.solver
        if solver.h_abs > length:
            self.stepper.go_on(self.stepper.t, solver.y.copy(), length)

    def _again(self, t: float) -> None:
        """Come to t once more from the start, with the finer tolerance, and see what the coarser one passed over."""
        stepper = self.stepper
        t_end = stepper.solver.t_bound
        stepper.go_on(0.0, stepper.y, t / 10)
        stepper.solver.t_bound = t
        self.end, self.length, self._attempts = None, 0.0, 0
        while stepper.solver.status == "running":
            if self.burst is not None:
                self.burst()
                if stepper.solver.status != "running":
                    break
            self.step()
            stepper.settle()
        stepper.solver.t_bound, stepper.solver.status = t_end, "running"
        stepper.go_on(t, stepper.solver.y.copy(), self.length)

    def _leap(self, t: float, y: Array, crossing: float, centred: bool) -> tuple[Leap, float | None]:
        """Leap from (t, y) with a crossing in the middle; also when exactly it was met, None if it was not.

        The first leap that meets it is as good as any where it need not be in the middle.
        """
        known = None
        for _ in range(2):
            left = crossing - t
            known = found = leap(self._rates, t, y, 2 * left, known)
            self._reach = left * float(np.clip(found.scale, 0.25, 2.0))
            if not found.good:
                break
            met = self._zero(found, crossing)
            if met is None or not 0.5 < (met - t) / left < 1.5 or not self._closed(found):
                break
            if not centred or abs(met - crossing) < CENTRED * left:
                return found, met
            crossing = met
        return found, None

    def _rates(self, times: Array, states: Array) -> Array:
        """Return y' where the states are put on the closure, counted."""
        assert self.dae is not None
        self.stepper.count(*times.tolist())
        with np.errstate(all="ignore"):
            return self.dae.rates_on_closure(times, states)

    def _closed(self, found: Leap) -> bool:
        """Whether the branches meet: off the closure the leap would have jumped a narrow gap between them."""
        mechanism = self.system.mechanism
        for t in np.linspace(found.t_old, found.t, 9):
            q_tree = self.system.configuration(t, found(t))
            phi = self.core.phi(q_tree) if self.core else mechanism.kinematics(q_tree).phi
            if np.abs(phi).max() > self.gap:
                return False
        return True

    # --- the least singular value ----------------------------------------------------------------

    def _zero(self, motion: Callable[[float], Array], t: float) -> float | None:
        """When J has lost rank on a motion of the DAE, by Newton's method from t; None where it does not converge.

        With its sign s is smooth there: on both sides s over its rate is what is left.
        """
        mechanism, value = self.system.mechanism, np.inf
        for _ in range(NEWTON):
            y = motion(t)
            at = mechanism.kinematics(self.system.configuration(t, y))
            before, (value, rate) = value, self._value_and_rate(at, y[mechanism.tree.nq :])
            if value <= 1e-3 * LOST:
                return t
            if not value < 0.5 * before or rate == 0:
                break
            t -= value / rate
        return t if value <= LOST else None

    def _minimum(
        self, motion: Callable[[float], Array], start: float, end: float, accuracy: float = 1e-7
    ) -> tuple[float, float]:
        """When s is least on a motion, relative to the interval as accurately as said, and that s."""
        from scipy.optimize import minimize_scalar

        def value(t: float) -> float:
            return self._value(self.system.configuration(t, motion(t)))

        options = {"xatol": accuracy * (end - start)}
        least = minimize_scalar(value, bounds=(start, end), method="bounded", options=options)
        return float(least.x), float(least.fun)

    def _lost(self, step: Step, t: float, value: float) -> NumericalError:
        tree = self.system.mechanism.tree
        q_tree = self.system.configuration(t, step.interpolant(t))
        return NumericalError(
            f"J loses rank at t = {t:.6g} s (least singular value {value:.1g}): branches of the motion meet there, "
            "and the loops do not say which one it takes",
            t=t,
            q_tree=tree.named(tree.to_coordinates(q_tree)),
        )

    def _scaled(self, jacobian: Array) -> Array:
        rows, columns = self.scales
        return rows[:, None] * jacobian * columns

    def _value(self, q_tree: Array) -> float:
        """The rank-th singular value of the scaled J, relative to the largest."""
        J = self.core.jacobian(q_tree) if self.core else self.system.mechanism.kinematics(q_tree).J
        values = np.linalg.svd(self._scaled(J), compute_uv=False)
        return float(values[self.rank - 1] / values[0])

    def _rate(self, step: Step, t: float) -> tuple[float, float]:
        """That value and its time derivative, u^T J_dot v over the largest singular value."""
        terms = self.system.terms(t, step.interpolant(t))
        return self._value_and_rate(terms.at, self.system.velocity(t, terms))

    def _value_and_rate(self, at: Kinematics, velocity: Array) -> tuple[float, float]:
        J, J_dot = self.core.jacobians(at.q_tree, velocity) if self.core else (at.J, at.J_dot(velocity))
        u, values, v = np.linalg.svd(self._scaled(J), full_matrices=False)
        k = self.rank - 1
        rate = u[:, k] @ self._scaled(J_dot) @ v[k]
        return float(values[k] / values[0]), float(rate / values[0])


def _tangents_meet(h: float, old: float, falling: float, new: float, rising: float) -> float:
    """Height at which the tangents at both ends of a V meet: an estimate of its depth without right-hand sides."""
    place = (new - old - rising * h) / (falling - rising)
    return old + falling * place
