"""Why the loop stopped, in words."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.events import EventFunction
from ckc_pin.scene.spec import SolverSpec

__all__ = ["PAUSE", "Stop", "explain", "why_not_q"]

PAUSE = 0.05  # s: how long the interpreter, and with it Ctrl-C, may be kept waiting
INSTANT = 1e-8  # of the time, or s: changes of modes so close to each other are at one instant
SMOOTHER = "a scene with friction_smoothing has no sticking, and a smaller solver.rtol may tell the joints apart"
NEARLY = 1e-3  # of |J|: phi_z's least singular value below which a step that cannot be made is put down to it

TROUBLES = {
    "none": "the step became so short that t does not change any more",
    "open": "sigma(q) does not converge: the loops cannot be kept closed on the way",
    "rank": "the loop closure's Jacobian J has lost rank: the mechanism has more freedoms here than elsewhere",
    "vague": "phi_z is so nearly singular that the other coordinates are not known as exactly as solver.rtol asks",
    "pole": "what is wanted of the motors passes through infinity, and they jump from limit to limit: how the "
    "parameters move that instant is not known",
    "shares": "motors at their limits do not reach what is wanted of them together, and how they share what they do "
    "has no known derivative",
    "infinite": "its state or its right-hand side is not finite",
}


class Stop(NamedTuple):
    """How the loop came back: why, when, a number that goes with it, which event, and how many rows are recorded."""

    why: str
    t: float
    value: float
    event: int
    filled: int


def explain(
    stop: Stop, loop: Any, mechanism: Mechanism, solver: SolverSpec, events: list[EventFunction]
) -> NumericalError:
    """Return the error that a stop is, with the configuration where that matters."""
    why, says, u, sigma_min, margin, q_tree, q, z = loop.trouble()
    where = mechanism.tree.named(mechanism.tree.to_coordinates(q_tree))
    match stop.why:
        case "rhs_budget":
            return NumericalError(f"the budget of max_rhs = {solver.max_rhs} right-hand sides is used up", t=loop.t)
        case "wall_budget":
            return NumericalError(f"the budget of max_wall_s = {solver.max_wall_s:g} s is used up", t=loop.t)
        case "pace":
            return NumericalError(f"{_fastest(loop, mechanism)}; {_rest(stop.value)}", t=loop.t)
        case "rank":
            return NumericalError(
                f"J loses rank at t = {stop.t:.6g} s (least singular value {stop.value:.1g}): branches of the motion "
                "meet there, and the loops do not say which one it takes",
                t=loop.t,
                q_tree=where,
            )
        case "chart" if not math.isfinite(sigma_min):
            return NumericalError(f"the motion runs away: {TROUBLES['infinite']}", t=loop.t)
        case "chart":
            return NumericalError(why_not_q(mechanism, sigma_min, q, z), t=loop.t, q_tree=where)
        case "energy":
            return NumericalError(
                f"nothing acts, but a step changes the energy by {stop.value:.2g} J however short it is",
                t=loop.t,
                q_tree=where,
            )
        case "control":
            return NumericalError(says or f"the controller's u is not finite: {u.tolist()}", t=loop.t)
        case "chatter":
            return NumericalError(
                f"{_changing(loop, mechanism)} change between sticking, sliding and touching again and again at this "
                f"instant{_holding_forces(loop, mechanism)}; {SMOOTHER}",
                t=loop.t,
                q_tree=where,
            )
        case "contact":
            return NumericalError(
                "no forces are found that hold the joints at their stops or at rest here"
                f"{_holding_forces(loop, mechanism)}; {SMOOTHER}",
                t=loop.t,
                q_tree=where,
            )
        case "beyond_stop":
            name = mechanism.coordinates[stop.event]
            return NumericalError(
                f"{name} has passed its stop within a step; a solver.max_step shorter than the time that {name} spends "
                "beyond the stop finds the impact",
                t=loop.t,
                q_tree=where,
            )
        case "function":
            return NumericalError(f"the event {events[stop.event].label['name']!r} is {stop.value}", t=loop.t)
    small = f"the step fell below min_step = {solver.min_step:g} s"
    reason = small if stop.why == "min_step" else TROUBLES[why]
    if not margin <= NEARLY:
        return NumericalError(reason, t=loop.t)
    return NumericalError(f"{why_not_q(mechanism, sigma_min, q, z)}; {reason}", t=loop.t, q_tree=where)


def _changing(loop: Any, mechanism: Mechanism) -> str:
    """Name the joints whose mode changed last, at one instant."""
    changes = loop.joint_changes()
    names = [mechanism.coordinates[k] for t, k, *_ in changes if loop.t - t <= INSTANT * max(1.0, abs(loop.t))]
    return ", ".join(dict.fromkeys(names)) or "joints"


def _holding_forces(loop: Any, mechanism: Mechanism) -> str:
    """Say which joints are held, with which force, and between which bounds that has to be."""
    forces = [
        f"{mechanism.coordinates[k]} {force:.6g} {'N' if mechanism.tree.in_metres[k] else 'N m'}, "
        f"{low:.6g} to {high:.6g} being possible"
        for k, force, low, high in loop.locked_joints()
    ]
    return f" (forces on the joints at rest: {'; '.join(forces)})" if forces else ""


def _rest(rhs: float) -> str:
    much = f"{rhs:.0e}" if math.isfinite(rhs) else "far more than 1e9"
    return f"the rest would take {much} right-hand sides: the motion runs away or is stiff (solver.max_rhs = N goes on)"


def _fastest(loop: Any, mechanism: Mechanism) -> str:
    """Say which coordinate moves fastest, radians and the mechanism's size being alike."""
    tree = mechanism.tree
    at = loop.state()
    if at is None:
        return "steps are very short"
    v = at[1][tree.nq : tree.nq + tree.n]
    k = int(np.argmax(np.abs(v) / tree.step_scale))
    return f"steps are very short ({mechanism.coordinates[k]} moves at {v[k]:.2g} {tree.units('/s')[k]})"


def why_not_q(mechanism: Mechanism, sigma_min: float, q: list[int], z: list[int]) -> str:
    """Say that phi_z is singular, so that q has stopped to be coordinates."""
    names = mechanism.coordinates
    return (
        f"phi_z is singular (its least singular value is {sigma_min:.2g}): "
        f"{', '.join(names[k] for k in q)} do not determine {', '.join(names[k] for k in z)} here"
    )
