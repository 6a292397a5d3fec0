"""Messages for the reasons at which the native loop stops, their causes, and warnings of a run."""

from __future__ import annotations

import math

import numpy as np

from ckc_pin.control.controllers import Tracking
from ckc_pin.control.point_path import Circle, Line, PointPath
from ckc_pin.control.sampled import unwrap_sampled
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import Loop, RhsFailure, Stop, StopReason
from ckc_pin.run.checks import desired_warnings
from ckc_pin.run.events import EventFunction
from ckc_pin.run.prepare import Prepared
from ckc_pin.scene.spec import SolverSpec

__all__ = ["PAUSE_S", "add_cause", "describe_stop", "find_exit"]

PAUSE_S = 0.05  # longest time that the native loop keeps the interpreter, and with it Ctrl-C, waiting, s
SAME_INSTANT_TOLERANCE = 1e-8  # mode transitions closer in time are at one instant; relative to t, or s
# Below this smallest singular value of phi_z, relative to |J|, a step that fails is blamed on phi_z.
NEARLY_SINGULAR = 1e-3
LEAD = 1e-3  # of the time of a stop: a motion may stop so long before the exit of its desired motion
EXIT_PHRASE = "leaves the workspace"  # in the error of a path of a point, which names the time itself
FRICTION_REMEDY = "a scene with friction_smoothing has no sticking, and a smaller solver.rtol may tell the joints apart"

STEP_TOO_SMALL = "the step size became so small that t does not change any more"
STEP_FAILURES = {
    RhsFailure.NONE: STEP_TOO_SMALL,
    RhsFailure.LOOPS_OPEN: "sigma(q) does not converge: the loops cannot be kept closed on the way",
    RhsFailure.RANK_LOST: (
        "the loop closure's Jacobian J has lost rank: the mechanism has more freedoms here than elsewhere"
    ),
    RhsFailure.Z_INACCURATE: (
        "phi_z is so nearly singular that the dependent coordinates are less accurate than solver.rtol asks"
    ),
    RhsFailure.TORQUE_POLE: (
        "the required motor torque passes through infinity and jumps from one limit to the other: the parameter "
        "derivative of that instant is unknown"
    ),
    RhsFailure.ALLOCATION_NOT_DIFFERENTIABLE: (
        "motors at their torque limits cannot produce u together, and the parameter derivative of the torque "
        "allocation is unknown"
    ),
    RhsFailure.NOT_FINITE: "its state or its right-hand side is not finite",
}


def describe_stop(
    stop: Stop, loop: Loop, mechanism: Mechanism, solver: SolverSpec, events: list[EventFunction]
) -> NumericalError:
    """Return the error for a stop, with the configuration where it matters."""
    failure = loop.failure()
    sigma_min = failure.sigma_min
    where = mechanism.tree.named(mechanism.tree.to_coordinates(failure.q_tree))
    match stop.reason:
        case StopReason.RHS_BUDGET:
            return NumericalError(f"the budget of max_rhs = {solver.max_rhs} right-hand sides is used up", t=loop.t)
        case StopReason.WALL_BUDGET:
            return NumericalError(f"the budget of max_wall_s = {solver.max_wall_s:g} s is used up", t=loop.t)
        case StopReason.PACE:
            return NumericalError(
                f"{_describe_fastest(loop, mechanism)}; {_describe_remaining_work(stop.value)}", t=loop.t
            )
        case StopReason.RANK:
            reason = (
                _describe_impossible_motion(mechanism)
                if mechanism.prescribed
                else "branches of the motion meet there, and the loops do not determine one"
            )
            return NumericalError(
                f"J loses rank at t = {stop.t:.6g} s (smallest singular value {stop.value:.1g}): {reason}",
                t=loop.t,
                q_tree=where,
            )
        case StopReason.COORDINATES_SINGULAR if not math.isfinite(sigma_min):
            return NumericalError(f"the motion runs away: {STEP_FAILURES[RhsFailure.NOT_FINITE]}", t=loop.t)
        case StopReason.COORDINATES_SINGULAR:
            return NumericalError(
                describe_singular_phi_z(mechanism, sigma_min, failure.q, failure.z), t=loop.t, q_tree=where
            )
        case StopReason.ENERGY:
            return NumericalError(
                f"no force acts, but a step changes the energy by {stop.value:.2g} J at every step size",
                t=loop.t,
                q_tree=where,
            )
        case StopReason.CONTROL:
            return NumericalError(
                failure.message or f"the controller's u is not finite: {failure.u.tolist()}", t=loop.t
            )
        case StopReason.CHATTER:
            return NumericalError(
                f"{_list_last_transitions(loop, mechanism)} change between sticking, sliding and touching again and "
                f"again at this instant{_describe_holding_forces(loop, mechanism)}; {FRICTION_REMEDY}",
                t=loop.t,
                q_tree=where,
            )
        case StopReason.CONTACT_UNSOLVED:
            return NumericalError(
                "no forces are found that hold the joints at their stops or at rest here"
                f"{_describe_holding_forces(loop, mechanism)}; {FRICTION_REMEDY}",
                t=loop.t,
                q_tree=where,
            )
        case StopReason.BEYOND_STOP:
            name = mechanism.coordinates[stop.which]
            return NumericalError(
                f"{name} has passed its stop within a step; a solver.max_step shorter than the time that {name} spends "
                "beyond the stop finds the impact",
                t=loop.t,
                q_tree=where,
            )
        case StopReason.EVENT_FUNCTION:
            return NumericalError(f"the event {events[stop.which].label['name']!r} is {stop.value}", t=loop.t)
    below_minimum = f"the step size fell below min_step = {solver.min_step:g} s"
    reason = below_minimum if stop.reason == StopReason.MIN_STEP else STEP_FAILURES[failure.reason]
    if not failure.margin <= NEARLY_SINGULAR:
        return NumericalError(reason, t=loop.t)
    return NumericalError(
        f"{describe_singular_phi_z(mechanism, sigma_min, failure.q, failure.z)}; {reason}", t=loop.t, q_tree=where
    )


def _list_last_transitions(loop: Loop, mechanism: Mechanism) -> str:
    """Name the joints whose mode changed at the present instant."""
    tolerance = SAME_INSTANT_TOLERANCE * max(1.0, abs(loop.t))
    names = [mechanism.coordinates[x.coordinate] for x in loop.joint_transitions() if loop.t - x.t <= tolerance]
    return ", ".join(dict.fromkeys(names)) or "joints"


def _describe_holding_forces(loop: Loop, mechanism: Mechanism) -> str:
    """List the joints at rest with the forces that hold them and the bounds of these forces."""
    forces = [
        f"{mechanism.coordinates[x.coordinate]} {x.force:.6g} "
        f"{'N' if mechanism.tree.in_metres[x.coordinate] else 'N m'}, {x.lower:.6g} to {x.upper:.6g} being possible"
        for x in loop.locked_joints()
    ]
    return f" (forces on the joints at rest: {'; '.join(forces)})" if forces else ""


def _describe_remaining_work(rhs: float) -> str:
    count = f"{rhs:.0e}" if math.isfinite(rhs) else "far more than 1e9"
    return (
        f"the rest would take {count} right-hand sides: the motion runs away or is stiff (solver.max_rhs = N goes on)"
    )


def _describe_fastest(loop: Loop, mechanism: Mechanism) -> str:
    """Name the fastest coordinate, where lengths are compared relative to the mechanism's size."""
    tree = mechanism.tree
    state = loop.state()
    if state is None:
        return "steps are very short"
    v_tree = state[1][tree.nq : tree.nq + tree.n]
    k = int(np.argmax(np.abs(v_tree) / tree.step_scale))
    return f"steps are very short ({mechanism.coordinates[k]} moves at {v_tree[k]:.2g} {tree.units('/s')[k]})"


def describe_singular_phi_z(mechanism: Mechanism, sigma_min: float, q: list[int], z: list[int]) -> str:
    """Say that phi_z is singular, so that the independent coordinates do not determine the dependent ones."""
    names, prescribed = mechanism.coordinates, mechanism.prescribed
    determining = [*(names[k] for k in q), *(f"the prescribed motion of {name}" for name in prescribed)]
    dependent = [names[k] for k in z if names[k] not in prescribed]
    verb = "does" if len(determining) == 1 else "do"
    text = (
        f"phi_z is singular (its smallest singular value is {sigma_min:.2g}): "
        f"{', '.join(determining)} {verb} not determine {', '.join(dependent)} here"
    )
    return f"{text}; {_describe_impossible_motion(mechanism)}" if prescribed else text


def _describe_impossible_motion(mechanism: Mechanism) -> str:
    return f"the loops may not allow the prescribed motion of {', '.join(mechanism.prescribed)} from here on"


# --- causes and warnings ---------------------------------------------------------------------------


def find_exit(prepared: Prepared, t: float) -> DesiredCheck | None:
    """Return when the desired motion of a tracking controller left the workspace until a stop at t (s); None if not."""
    law = unwrap_sampled(prepared.controller)
    if not isinstance(law, Tracking):
        return None
    t_end = prepared.scene.spec.t_end
    horizon = min(t + LEAD * max(t, t_end), t_end)
    try:
        desired = follow_desired(prepared.mechanism, law.desired, horizon, prepared.start.at)
    except NumericalError:  # The path of a point cannot be followed up to there, and its own message says so.
        return None
    return None if desired.leaves_at is None else desired


def add_cause(error: NumericalError, prepared: Prepared, exit_: DesiredCheck | None) -> tuple[str, list[str]]:
    """Return the message of a stop that begins with its cause, and the warnings about the cause.

    Parameters
    ----------
    error : NumericalError
        Why the loop stopped.
    prepared : Prepared
    exit_ : DesiredCheck or None
        As from `find_exit`.
    """
    text = str(error)
    if exit_ is None:
        return text, []
    warnings = desired_warnings(prepared.mechanism, exit_, prepared.scene.spec.t_end)
    if EXIT_PHRASE in text:
        return text, warnings
    cause = f"{_name_desired(prepared)} left the workspace at t = {exit_.leaves_at:.4f} s"
    detail = text.removesuffix(STEP_TOO_SMALL).removesuffix("; ")
    return (f"{cause}; {detail}" if detail else cause), warnings


def _name_desired(prepared: Prepared) -> str:
    law = unwrap_sampled(prepared.controller)
    desired = getattr(law, "desired", None)
    if not isinstance(desired, PointPath):
        return "the desired motion"
    shapes = {Circle: "circle", Line: "line"}
    return f"the desired {shapes.get(type(desired.path), 'path')} of the point {desired.point.name!r}"
