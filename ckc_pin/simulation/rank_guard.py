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


class RankGuard:
    """Follows the smallest singular value of J along a run.

    Parameters
    ----------
    system : System
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.rank = system.mechanism.rank
        self._end: tuple[float, float] | None = None  # s and its rate at the end of the last step

    def resolves(self, step: Step) -> bool:
        """Whether a step is short enough for what s does in it; it should be taken again if not.

        Raises
        ------
        NumericalError
            J loses rank in the step.
        """
        if self.rank == 0:
            return True
        (old, falling), (new, rising) = self._end or self._rate(step, step.t_old), self._rate(step, step.t)
        if falling < 0 < rising and not self._neck_is_resolved(step, old, new):
            return False
        if new < LOST:
            raise self._lost(step, step.t, new)
        self._end = new, rising
        return True

    def _neck_is_resolved(self, step: Step, old: float, new: float) -> bool:
        from scipy.optimize import minimize_scalar

        options = {"xatol": 1e-7 * (step.t - step.t_old)}
        bounds = (step.t_old, step.t)
        least = minimize_scalar(lambda t: self._value(step, t), bounds=bounds, method="bounded", options=options)
        if least.fun < LOST:
            raise self._lost(step, float(least.x), float(least.fun))
        return least.fun >= NECK * max(old, new) or step.t - step.t_old < SHORTEST

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
