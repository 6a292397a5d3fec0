"""Whether a set point's closed loop is stable where it rests, at its target or off it; and which K_P would do."""

from __future__ import annotations

import numpy as np

from ckc_pin.control.controllers import SetPoint
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.kinematics.continuation import follow
from ckc_pin.kinematics.sigma import follow_sigma, sigma
from ckc_pin.linear.limited_closed_loop import LoopWithinLimits
from ckc_pin.linear.linear_model import eigenvalues_of
from ckc_pin.linear.sampled_loop import sampled_loop
from ckc_pin.linear.stability_result import Stability, time_constant
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core

__all__ = ["set_point_stability"]

SURE = 1e-12  # of the fastest eigenvalue: what is no further left of the axis may be on it
NEWTON = 8  # iterations of a piece of the way to where a controller with another model's h comes to rest
SMALLEST_PIECE = 1e-4  # of that way
OFF = 1e-9  # rad, or of the mechanism's size: at its target
BALANCED = 1e-11  # of the forces: rounding


def set_point_stability(
    law: SetPoint, closed_loop: LoopWithinLimits, near: Kinematics, sampling: tuple[float, float] | None
) -> Stability:
    """Linearize a set point's closed loop where it rests.

    Parameters
    ----------
    near : Kinematics
        The target is meant on its assembly branch.
    sampling : (sample_time, delay) or None
        s.

    Raises
    ------
    NumericalError
        The target is out of reach or singular, the loop has no rest near it, or cannot be linearized there.
    """
    mechanism = closed_loop.mechanism
    target = sigma(mechanism, law.q_d, near)
    if target.verdict != "converged":
        raise NumericalError(f"the target is not reached from where the run starts: {target.reason}")
    if target.at.margin() <= _core.chart_margin:
        names = (", ".join(x) for x in (mechanism.independent, mechanism.dependent))
        raise NumericalError("the target is singular: {} do not determine {} there".format(*names))
    rest = Terms(mechanism, _rest(mechanism, law, target.at), np.zeros(mechanism.n))
    loop = closed_loop.at(0.0, rest, "where it would come to rest")
    values = eigenvalues_of(loop.closed)
    stable, slowest = bool(values[0].real < -SURE * np.abs(values).max()), time_constant(float(values[0].real))
    multiplier = None
    if sampling is not None:
        multiplier = float(np.abs(np.linalg.eigvals(sampled_loop(loop, *sampling))).max())
        stable, slowest = multiplier < 1.0 - SURE, time_constant(float(np.log(max(multiplier, 1e-300))) / sampling[0])
    reach = mechanism.tree.step_scale[mechanism.partition.q]
    K_P, hessian = (x / 2 + x.T / 2 for x in (law.K_P, h_gradient(mechanism, rest.at)))
    half, offset = np.linalg.inv(np.linalg.cholesky(K_P)), rest.q - law.q_d
    factor = max(0.0, -float(np.linalg.eigvalsh(half @ hessian @ half.T)[0]))
    return Stability(
        stable=stable,
        eigenvalues=values,
        least_K_P=factor * law.K_P if np.all(np.abs(offset) <= OFF * reach) else None,
        least_eigenvalue=float(np.linalg.eigvalsh(K_P + hessian)[0]),
        offset=offset,
        slowest=slowest,
        sampled=sampling is not None,
        multiplier=multiplier,
    )


def _rest(mechanism: Mechanism, law: SetPoint, target: Kinematics) -> Kinematics:
    """Where the closed loop rests: its target, or where that goes as h(q_d) becomes what the controller takes it for.

    The way from one to the other is followed, as long as K_P + dh/dq keeps its rank on it.
    """
    own = Terms(mechanism, target, np.zeros(mechanism.n)).h
    excess, scale = law.target.h - own, np.abs(own).max() + np.abs(law.K_P).max()
    if np.abs(excess).max() <= BALANCED * scale:
        return target

    def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
        sign = np.linalg.slogdet(law.K_P + h_gradient(mechanism, at))[0]
        for _ in range(NEWTON):
            state = Terms(mechanism, at, np.zeros(mechanism.n))
            missing = own + (done + part) * excess - law.K_P @ (state.q - law.q_d) - state.h
            stiffness = law.K_P + h_gradient(mechanism, at)
            if np.linalg.slogdet(stiffness)[0] != sign:
                return None
            if np.abs(missing).max() <= BALANCED * scale:
                return at
            step = np.asarray(np.linalg.solve(stiffness, missing), dtype=float)
            found = follow_sigma(at, step, 0.0, mechanism.tolerance, anywhere=False)
            if found.verdict != "converged":
                return None
            at = found.at
        return None

    at, done = follow(target, advance, SMALLEST_PIECE)
    if done < 1.0:
        raise NumericalError(
            "what the controller takes for h(q_d) is so far from the plant's that the loop has no rest near its target"
        )
    return at
