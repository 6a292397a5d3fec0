"""Watches for J losing rank inside a step, where branches of the motion meet.

At a change point (a flat four-bar) the loops stop to determine the motion: a step that passes over it can
come out on the other branch, within tolerance and wrong. The smallest singular value s(t) of J shows it
as a V that reaches zero: falling at the start of a step, rising at its end. In such a step the minimum is
searched for.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.rank import scaled
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.integrate import Step
from ckc_pin.simulation.systems import System

__all__ = ["RankGuard"]

LOST = 1e-5  # relative to the largest singular value: the rank is lost
NECK = 0.2  # of the larger end value: a minimum below that has to be resolved by shorter steps
SHORTEST = 1e-6  # s; a step below that resolves any neck that is wider than LOST
NEAR = 0.25  # of a step: no step ends so short of a crossing
GAP = 0.1  # of a step: how far stages stay away from the crossing
ATTEMPTS = 20  # to place a step across a crossing
SMOOTH = 0.1  # the largest defect of a step that kept its branch; off it the velocity jumps by its own size


class RankGuard:
    """Follows the smallest singular value of J along a run.

    A crossing is passed when the formulation does not need the branch from J (the DAE: its solution is
    smooth there), by a step none of whose stages comes near it, and whose velocity goes on smoothly.

    Parameters
    ----------
    system : System
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.rank = system.mechanism.rank
        self.crossings: list[float] = []
        self._end: tuple[float, float] | None = None  # s and its rate at the end of the last step
        self._attempts = 0

    def accept(self, step: Step) -> float | None:
        """Look at a step; return None if it stands, else the length to take it again with.

        Raises
        ------
        NumericalError
            J loses rank in the step, and it cannot be passed.
        """
        if self.rank == 0:
            return None
        (old, falling), (new, rising) = self._end or self._rate(step, step.t_old), self._rate(step, step.t)
        if falling < 0 < rising:
            t, value = self._minimum(step)
            h = step.t - step.t_old
            if value < LOST:
                retry = self._pass(step, t, value)
                if retry is not None:
                    return retry
                self.crossings.append(t)
            elif value < NECK * max(old, new) and h > SHORTEST:
                return h / 4
        early = self._too_near(step, new, rising)
        if early is not None:
            return early
        if new < LOST:
            raise self._lost(step, step.t, new)
        self._attempts = 0
        self._end = new, rising
        return None

    def _too_near(self, step: Step, new: float, rate: float) -> float | None:
        """A step that ends just before a crossing leaves no room to step across: end it earlier."""
        h = step.t - step.t_old
        if rate >= 0 or step.nodes is None or not self.system.passes_rank_loss or self._attempts >= ATTEMPTS:
            return None
        left = -new / rate  # time to the crossing, along the line
        if left > NEAR * h:
            return None
        self._attempts += 1
        return left + h * (1 - _widest_gap(step.nodes))

    def _pass(self, step: Step, t: float, value: float) -> float | None:
        """Return None if the step passes the crossing well, else a length that may."""
        self._attempts += 1
        if not self.system.passes_rank_loss or step.nodes is None or self._attempts > ATTEMPTS:
            raise self._lost(step, t, value)
        h, place = step.t - step.t_old, (t - step.t_old) / (step.t - step.t_old)
        if np.abs(step.nodes - place).min() >= GAP and step.defect < SMOOTH:
            return None
        middle = _widest_gap(step.nodes)
        if step.defect >= SMOOTH:
            h *= 0.7
        # the crossing in the widest gap between stages: now, or after a shorter step up to there
        return h * place / middle if place <= middle else h * (place - middle)

    def _minimum(self, step: Step) -> tuple[float, float]:
        from scipy.optimize import minimize_scalar

        options = {"xatol": 1e-7 * (step.t - step.t_old)}
        bounds = (step.t_old, step.t)
        least = minimize_scalar(lambda t: self._value(step, t), bounds=bounds, method="bounded", options=options)
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
        mechanism = self.system.mechanism
        return scaled(jacobian, mechanism.tree, mechanism.closure, mechanism.size)

    def _value(self, step: Step, t: float) -> float:
        """The rank-th singular value of the scaled J, relative to the largest."""
        at = self.system.mechanism.kinematics(self.system.configuration(t, step.interpolant(t)))
        values = np.linalg.svd(self._scaled(at.J), compute_uv=False)
        return float(values[self.rank - 1] / values[0])

    def _rate(self, step: Step, t: float) -> tuple[float, float]:
        """That value and its time derivative, u^T J_dot v over the largest singular value."""
        terms = self.system.terms(t, step.interpolant(t))
        u, values, v = np.linalg.svd(self._scaled(terms.at.J), full_matrices=False)
        k = self.rank - 1
        rate = u[:, k] @ self._scaled(terms.at.J_dot(self.system.velocity(t, terms))) @ v[k]
        return float(values[k] / values[0]), float(rate / values[0])


def _widest_gap(nodes: Array) -> float:
    """Middle of the widest interval without a stage."""
    places = np.unique(nodes)
    k = int(np.argmax(np.diff(places)))
    return float(places[k] + places[k + 1]) / 2
