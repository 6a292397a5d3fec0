"""Find the equilibria of the set-point controller, the solutions of eq. 15, from many starts.

Eq. 14 at rest is u = h(q), that is h(q) - h(q_d) = K_P (q_d - q); eq. 15 prints its left side with the other sign.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import SetPoint
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.certificate.branch_walk import follow, same_configuration
from scripts.experiments.certificate.certificate import rest_height

__all__ = ["Equilibrium", "equilibria"]

LONGEST = 0.2  # rad or m: limit of a Newton step
ITERATIONS = 60
SOLVED = 1e-10  # residual in N m or N, relative to K_P

Kind = Literal["minimum", "saddle", "maximum"]


@dataclass(frozen=True)
class Equilibrium:
    """A solution of eq. 15.

    Attributes
    ----------
    q : (d,) array
    at : Kinematics
    kind : "minimum", "saddle" or "maximum"
        Type of the critical point of V_L(q, 0). The closed loop is stable at minima only.
    height : float
        V_L there, J; zero at q_d.
    starts : int
        Number of starts from which Newton converged to it.
    """

    q: Array
    at: Kinematics
    kind: Kind
    height: float
    starts: int


def equilibria(mechanism: Mechanism, controller: SetPoint, starts: Iterable[Kinematics]) -> list[Equilibrium]:
    """Solve eq. 15 by Newton from many closed configurations; return the distinct solutions, lowest V_L first.

    Angles that differ by a whole turn are different solutions, since K_P (q_d - q) differs.
    """
    distinct: list[tuple[Kinematics, int]] = []
    for start in starts:
        at = _solve(mechanism, controller, start)
        if at is None:
            continue
        for k, (solution, times) in enumerate(distinct):
            apart = mechanism.independent_part(at.q_tree) - mechanism.independent_part(solution.q_tree)
            if np.abs(apart).max(initial=0.0) < 1e-6 and same_configuration(mechanism, solution, at):
                distinct[k] = (solution, times + 1)
                break
        else:
            distinct.append((at, 1))
    solutions = [
        Equilibrium(
            q=mechanism.independent_part(at.q_tree),
            at=at,
            kind=_kind(controller.K_P + h_gradient(mechanism, at)),
            height=rest_height(mechanism, controller, at),
            starts=times,
        )
        for at, times in distinct
    ]
    return sorted(solutions, key=lambda solution: solution.height)


def _solve(mechanism: Mechanism, controller: SetPoint, at: Kinematics) -> Kinematics | None:
    """Solve grad U = h(q) - h(q_d) + K_P (q - q_d) = 0 by Newton along the branch, with limited steps."""
    for _ in range(ITERATIONS):
        terms = Terms(mechanism, at, np.zeros(mechanism.n))
        slope = terms.h - controller.target.h + controller.K_P @ (terms.q - controller.q_d)
        if np.abs(slope).max() <= SOLVED * np.linalg.norm(controller.K_P, 2):
            return at
        step = -np.linalg.lstsq(controller.K_P + h_gradient(mechanism, at), slope, rcond=None)[0]
        at, reached = follow(mechanism, at, step * min(1.0, LONGEST / np.abs(step).max()))
        if reached < 1.0:
            return None
    return None


def _kind(hessian: Array) -> Kind:
    values = np.linalg.eigvalsh((hessian + hessian.T) / 2)
    if values[0] > 0:
        return "minimum"
    return "maximum" if values[-1] < 0 else "saddle"
