"""One-screen summaries of runs, states, simulators and inverse dynamics."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import Row, Summary, format_quantities
from ckc_pin.codegen.library import explain_too_large
from ckc_pin.errors import CkcError, InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import joined
from ckc_pin.run.units import quantity_units
from ckc_pin.scene.summary import formulation_of

if TYPE_CHECKING:
    from ckc_pin.run.motion_forces import MotionForces
    from ckc_pin.run.run import Run
    from ckc_pin.run.simulator import Simulator
    from ckc_pin.run.state import State

__all__ = ["forces_summary", "run_summary", "simulator_summary", "state_summary"]

MOST_EVENTS = 10
LONG = 10.0  # s: what compiling a mechanism's terms takes at most, as a rule


def run_summary(run: Run) -> Summary:
    """Return the outcome of a run."""
    mechanism = _mechanism(run)
    units = ([], []) if mechanism is None else (mechanism.tree.units(), mechanism.tree.units("/s"))
    rows: list[Row] = [
        ("formulation", formulation_of(run.scene, exact=not run.w[0].any())),
        ("instants", f"{len(run.t)}, from t = {run.t[0]:g} to {run.t[-1]:g} s"),
        ("q_tree at the end", format_quantities(run.coordinates, run.q_tree[-1], units[0], 9)),
        ("v_tree at the end", format_quantities(run.coordinates, run.v_tree[-1], units[1])),
    ]
    if np.any(run.u) or np.any(run.tau) or "controller" in run.scene:
        u_unit, tau_unit = ("", "") if mechanism is None else _efforts(mechanism)
        rows.append(("largest |u|, |tau|", f"{_largest(run.u):.4g}{u_unit}, {_largest(run.tau):.4g}{tau_unit}"))
    for name, rate in ({} if mechanism is None else run.too_fast()).items():
        limit = run.mechanism.motors.speed_limit[run.actuated.index(name)]
        rows.append(("warning", f"{name} turns at {rate:.4g}, its speed_limit is {limit:.4g}"))
    rows.append(("energy start, end", f"{run.energy[0]:.9g}, {run.energy[-1]:.9g} J"))
    if run.dissipated is not None:
        rows.append(("friction, impacts took", f"{run.dissipated[-1]:.9g} J"))
    rows.append(("largest |phi - w|", f"{run.max_phi:.2g} (its rate {run.max_phi_dot:.2g})"))
    rows += _work(run.stats, _would_pay(run))
    rows += [("event", f"t = {event['t']:.9g} s: {event['name']}") for event in run.events[:MOST_EVENTS]]
    if len(run.events) > MOST_EVENTS:
        rows.append(("", f"and {len(run.events) - MOST_EVENTS} more events"))
    said = run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}"
    return Summary(f"Run of {run.scene_name}, {said}", rows)


def _work(stats: dict[str, Any], would_pay: str = "") -> list[Row]:
    steps = ", ".join(f"{name} {count} steps" for name, count in stats["steps_by_method"].items())
    work = f"{stats['rhs']} right-hand sides, {stats['newton']} Newton iterations"
    called = f", {stats['python_calls']} calls of your functions" if stats["python_calls"] else ""
    spent = f", {stats['wall_s']:.2g} s" if "wall_s" in stats else ""
    terms = stats.get("terms", "pinocchio")  # a file may be from before there were others
    before = stats.get("rhs_by_terms", {}).get("pinocchio", 0)
    late = f", compiled after {before} right-hand sides" if terms == "generated" and before else ""
    return [
        ("method", f"{steps or stats['method']}, {stats['rejected']} rejected"),
        ("terms", terms + late + would_pay),
        ("work", f"{work}, {stats['factorizations']} factorizations{called}{spent}"),
    ]


def _would_pay(run: Run) -> str:
    """Say of a long run that compiled terms would have made it a short one."""
    if run.stats.get("terms", "pinocchio") != "pinocchio" or run.stats["wall_s"] < LONG:
        return ""
    mechanism = _mechanism(run)
    if mechanism is None or explain_too_large(mechanism):
        return ""
    return "; compiled ones are several times faster: ckc compile"


def _mechanism(run: Run) -> Mechanism | None:
    """Return a run's mechanism; None where its texts are damaged, which no look at it is to stop at."""
    try:
        return run.mechanism
    except CkcError:
        return None


def forces_summary(found: MotionForces) -> Summary:
    """Return what a motion asks of motors, loops and joints."""
    rows: list[Row] = [
        ("instants", f"{len(found.t)}, from t = {found.t[0]:g} to {found.t[-1]:g} s"),
        ("largest |tau|", format_quantities(found.actuated, np.abs(found.tau).max(axis=0))),
        ("loop_forces", list(found.loop_forces)),
        ("joint_forces", list(found.joint_forces)),
    ]
    rows += [("exceeded", f"{x['motor']}: {x['most']:.4g} at t = {x['t_most']:.4g} s, its limit is {x['limit']:.4g}")
             for x in found.exceeded]  # fmt: skip
    return Summary(f"MotionForces of {found.name}, {found.status}: {found.message}", rows)


def state_summary(state: State) -> Summary:
    """Return where a simulator is, or a run was."""
    mechanism = state.mechanism
    tree = mechanism.tree
    rows: list[Row] = [
        ("q_tree", format_quantities(mechanism.coordinates, state.q_tree, tree.units())),
        ("v_tree", format_quantities(mechanism.coordinates, state.v_tree, tree.units("/s"))),
        ("independent q", _list(mechanism.independent)),
    ]
    rows += [("w", f"up to {_largest(state.w):.3g}")] if np.any(state.w) else []
    return Summary(f"State of {mechanism.name} at t = {state.t:g} s", rows)


def simulator_summary(simulator: Simulator) -> Summary:
    """Return what a simulator steps, and where it is."""
    scene = simulator.scene
    motors = simulator.mechanism.actuated
    rows: list[Row] = [
        ("formulation", formulation_of(scene.to_dict(), exact=not np.any(simulator.state.w))),
        *state_summary(simulator.state).rows,
        ("motors", _list(motors)),
    ]
    with suppress(InputError):  # within a step, as from an event's function, it counts on
        stats = simulator.stats
        rows += _work(stats) if stats["rhs"] else []
    return Summary(f"Simulator of {scene.name} at t = {simulator.state.t:g} s", rows)


def _list(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"


def _efforts(mechanism: Mechanism) -> tuple[str, str]:
    """Return the units of u and of tau."""
    units = quantity_units(mechanism)
    return f" {joined(units['u'])}", f" {joined(units['tau'])}"


def _largest(values: Array) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
