"""The cost of a motion on a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.optimization.mesh_motion import DEGREE

if TYPE_CHECKING:
    from ckc_pin.optimization.collocation import Collocation

__all__ = ["cost_parts"]


def cost_parts(problem: Collocation, w: Any, p: Any) -> dict[str, Any]:
    """Return the parts of the cost with weights, in SI units, as CasADi expressions.

    Parameters
    ----------
    problem : Collocation
    w : casadi.SX
        Variables.
    p : casadi.SX
        Parameters: rates of the places, and the desired motion at the Gauss points.
    """
    import casadi as cs

    minimize = problem.minimize
    shares = np.outer(problem.step, problem.weights)  # of the duration, of each Gauss point
    of_interval = w[problem.T_at[problem.phase].tolist()]

    def integral(values: Any, count: int) -> Any:
        """Integrate over time from values at the Gauss points, by interval, point, and `count` entries."""
        weights = cs.DM(np.repeat(shares.ravel(), count))
        return cs.dot(weights * w[problem.T_at[np.repeat(problem.phase, DEGREE * count)].tolist()], values)

    parts: dict[str, Any] = {}
    if minimize.time:
        parts["time"] = cs.sum1(w[problem.T_at.tolist()])
    if minimize.effort:
        effort = cs.SX(0)
        for motor, unit in enumerate(problem.unit.tolist()):
            a, b = (w[problem.tau_at[problem.begin + side, motor].tolist()] for side in (0, 1))
            effort += unit**2 * cs.dot(cs.DM(problem.step / 3) * of_interval, a**2 + a * b + b**2)
        parts["effort"] = effort
    if minimize.energy:
        power = w[problem.slack_at.ravel().tolist()]
        parts["energy"] = problem.power_unit * integral(power, problem.slacks)
    if minimize.tracking:
        missing = problem.at_points(w, 0) - p[problem.places.rates.size :]
        parts["tracking"] = integral(missing**2, problem.d)
    if minimize.jerk:
        jerk = problem.jerks(w, problem.points)
        cubes = w[problem.T_at[np.repeat(problem.phase, DEGREE * problem.d)].tolist()] ** 3
        parts["jerk"] = integral((jerk / cubes) ** 2, problem.d)
    if minimize.torque_rate:
        rates = cs.SX(0)
        for motor, unit in enumerate(problem.unit.tolist()):
            a, b = (w[problem.tau_at[problem.begin + side, motor].tolist()] for side in (0, 1))
            rates += unit**2 * cs.sum1((b - a) ** 2 / (cs.DM(problem.step) * of_interval))
        parts["torque_rate"] = rates
    if minimize.peak_torque:
        parts["peak_torque"] = w[problem.peak_at] * problem.force_unit
    return parts
