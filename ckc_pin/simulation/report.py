"""Findings as plain data (the JSON of docs/reference.md) and as tables for a terminal."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.dynamics.terms import Terms
from ckc_pin.generated.library import MOST_COORDINATES
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.check import Check
from ckc_pin.simulation.linear_report import stability_plain, stability_text
from ckc_pin.simulation.run import Run

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from ckc_pin.simulation.motion_forces import MotionForces

__all__ = ["check_plain", "check_table", "inverse_plain", "inverse_table", "profile_table", "run_table", "terms_plain",
           "terms_table", "to_json"]  # fmt: skip

MOST_EVENTS = 10  # in a table for people
SPATIAL = (slice(0, 3), slice(3, 6))  # force and moment of a wrench
NO_MOMENT = 1e-9  # of the force on the arm of the mechanism's size
LONG = 10.0  # s: what compiling a mechanism's terms takes at most, as a rule
AXES = tuple(combinations_with_replacement(enumerate("xyz"), 2))
TERMS = ("D_tree", "C_tree", "h_tree", "phi", "rho", "rho_dot", "D", "C", "h", "energy")


def to_json(data: dict[str, Any]) -> str:
    """Return plain data as one line of JSON, which knows no NaN and no infinity: null."""
    return json.dumps(_finite(data), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_plain(found: Check) -> dict[str, Any]:
    """Return a check as JSON-ready data."""
    branches = None if found.branches is None else found.branches.tolist()
    arrays = {"q_tree": found.q_tree.tolist(), "inertia": found.inertia.tolist(), "branches": branches,
              "stability": stability_plain(found.stability)}  # fmt: skip
    return asdict(found) | arrays


def check_table(found: Check) -> Group:
    """Return a check for people."""
    from rich.console import Group
    from rich.text import Text

    table = _plain_table("", "")
    table.add_row("coordinates n", str(found.n))
    table.add_row("freedoms d", str(found.d))
    redundant = f", redundant: {', '.join(found.redundant)}" if found.redundant else ""
    table.add_row("closure rows, rank", f"{found.rows}, {found.rank}{redundant}")
    table.add_row("singular values", f"{found.gap[0]:.2e} | {found.gap[1]:.2e} around the cut (relative, scaled J)")
    table.add_row("independent q", ", ".join(found.independent) or "none")
    table.add_row("dependent z", ", ".join(found.dependent) or "none")
    assembled = "  ".join(f"{k} = {x:.6f}" for k, x in zip(found.coordinates, found.q_tree, strict=True))
    table.add_row("assembled at", assembled)
    if found.det_phi_z is not None:
        table.add_row("det phi_z", f"{found.det_phi_z:.6g}")
    table.add_row("sigma_min(phi_z), cond", f"{found.sigma_min_phi_z:.6g}, {found.cond_phi_z:.4g}")
    table.add_row("moving mass", f"{found.mass:.6g} kg")
    about = "  ".join(f"i{a}{b} = {found.inertia[i, j]:.6g}" for (i, a), (j, b) in AXES)
    table.add_row("its inertia", f"{about} kg m^2, as assembled, about its centre of mass")
    table.add_row("terms", found.terms)
    for k, numbers in enumerate(found.branches if found.branches is not None else ()):
        shown = "  ".join(f"{c} = {x:.6f}" for c, x in zip(found.coordinates, numbers, strict=True))
        table.add_row(f"branch {k + 1}", shown)
    if found.desired is not None and found.desired.leaves_at is None:
        closest = f"stays inside; closest to singular at t = {found.desired.closest_t:.4f} s"
        table.add_row("desired", f"{closest}, sigma_min(phi_z) = {found.desired.sigma_min:.4g}")
    elif found.desired is not None:
        table.add_row("desired", f"leaves the workspace at t = {found.desired.leaves_at:.5f} s")
    if found.stability is not None:
        table.add_row("closed loop", stability_text(found.stability))
    joints = [_joints_table(found)] if found.joints else []
    return Group(table, *joints, *(Text(f"warning: {warning}") for warning in found.warnings))


def _joints_table(found: Check) -> Table:
    """Return what the joints themselves do, one a line."""
    table = _plain_table("joint", "armature", "damping", "friction", "stops", "restitution")
    for name, joint in found.joints.items():
        stopped = math.isfinite(joint["lower"]) or math.isfinite(joint["upper"])
        stops = (f"{joint['lower']:.6g} to {joint['upper']:.6g}", f"{joint['restitution']:g}") if stopped else ("", "")
        table.add_row(name, *(f"{joint[key]:g}" for key in ("armature", "damping", "friction")), *stops)
    return table


def terms_plain(found: Terms) -> dict[str, Any]:
    """Return all terms at a state as JSON-ready data."""
    mechanism = found.mechanism
    plain: dict[str, Any] = {
        "coordinates": mechanism.coordinates,
        "independent": mechanism.independent,
        "dependent": mechanism.dependent,
        "q_tree": mechanism.tree.to_coordinates(found.q_tree).tolist(),
        "v_tree": found.v_tree.tolist(),
        "phi_q": found.at.phi_q.tolist(),
        "phi_z": found.at.phi_z.tolist(),
    }
    return plain | {name: np.asarray(getattr(found, name)).tolist() for name in TERMS}


def terms_table(found: Terms) -> Group:
    """Return all terms at a state for people."""
    from rich.console import Group
    from rich.text import Text

    mechanism = found.mechanism
    state = _plain_table("coordinate", "q_tree", "v_tree", "h_tree")
    numbers = mechanism.tree.to_coordinates(found.q_tree)
    for k, name in enumerate(mechanism.coordinates):
        state.add_row(name, *(f"{x:.8g}" for x in (numbers[k], found.v_tree[k], found.h_tree[k])))
    parts: list[Any] = [state, Text(f"energy {found.energy:.8g} J")]
    for name in ("phi", "h"):
        parts.append(Text(f"{name}  {_row(np.asarray(getattr(found, name)))}"))
    for name in ("D_tree", "C_tree", "rho", "rho_dot", "D", "C"):
        parts += [Text(name), *(Text("  " + _row(row)) for row in getattr(found, name))]
    parts += [Text("phi_q | phi_z"), *(Text(f"  {_row(a)} | {_row(b)}") for a, b in _rows_of_jacobian(found))]
    return Group(*parts)


def run_table(run: Run) -> Table:
    """Return the outcome of a run for people."""
    table = _plain_table("", "")
    table.add_row("status", run.message if run.message.startswith(run.status) else f"{run.status}: {run.message}")
    table.add_row("formulation", _formulation(run))
    last = "  ".join(f"{k} = {x:.8f}" for k, x in zip(run.coordinates, run.q_tree[-1], strict=True))
    table.add_row(f"q_tree at {run.t[-1]:g} s", last)
    if "controller" in run.scene:
        table.add_row("largest |u|, |tau|", f"{np.abs(run.u).max():.4g}, {np.abs(run.tau).max():.4g}")
    for name, rate in run.too_fast().items():
        limit = run.mechanism.motors.speed_limit[run.actuated.index(name)]
        table.add_row("warning", f"{name} turns at {rate:.4g}, its speed_limit is {limit:.4g}")
    table.add_row("energy start, end", f"{run.energy[0]:.9g}, {run.energy[-1]:.9g} J")
    if run.dissipated is not None:
        table.add_row("friction, impacts took", f"{run.dissipated[-1]:.9g} J")
    table.add_row("largest |phi - w|", f"{run.max_phi:.2g} (its rate {run.max_phi_dot:.2g})")
    for event in run.events[:MOST_EVENTS]:
        table.add_row("event", f"t = {event['t']:.9g} s: {event['name']}")
    if len(run.events) > MOST_EVENTS:
        table.add_row("", f"and {len(run.events) - MOST_EVENTS} more")
    stats = run.stats
    steps = ", ".join(f"{name} {count} steps" for name, count in stats["steps_by_method"].items())
    table.add_row("method", f"{steps or stats['method']}, {stats['rejected']} rejected")
    terms = stats.get("terms", "pinocchio")  # a file may be from before there were others
    before = stats.get("rhs_by_terms", {}).get("pinocchio", 0)
    late = f", compiled after {before} right-hand sides" if terms == "generated" and before else ""
    table.add_row("terms", terms + late + (_would_pay(run) if terms == "pinocchio" else ""))
    work = f"{stats['rhs']} right-hand sides, {stats['newton']} Newton iterations"
    called = f", {stats['python_calls']} calls of your functions" if stats["python_calls"] else ""
    table.add_row("work", f"{work}, {stats['factorizations']} factorizations{called}, {stats['wall_s']:.2g} s")
    return table


def inverse_plain(found: MotionForces) -> dict[str, Any]:
    """Return what a motion needs as JSON-ready data."""
    loops = {}
    for loop, multipliers in found.loop_forces.items():
        wrench = found.loop_wrenches.get(loop)
        loops[loop] = {
            "rows": found.rows(loop),
            "multipliers": multipliers.tolist(),
            "force": None if wrench is None else wrench[:, :3].tolist(),
            "moment": None if wrench is None else wrench[:, 3:].tolist(),
        }
    return {
        **{name: getattr(found, name).tolist() for name in ("t", "q_tree", "v_tree", "a_tree", "tau")},
        "coordinates": found.coordinates,
        "actuated": found.actuated,
        "loop_forces": loops,
        "joint_forces": {joint: wrench.tolist() for joint, wrench in found.joint_forces.items()},
        "exceeded": found.exceeded,
        "redundant": found.mechanism.redundant,
        "status": found.status,
        "message": found.message,
    }


def inverse_table(found: MotionForces) -> Group:
    """Return what a motion needs for people: the largest of each, and when."""
    from rich.console import Group
    from rich.text import Text

    table = _plain_table("of the motion")
    for title in ("largest", "at t, s"):
        table.add_column(title, justify="right")
    beyond = {entry["motor"]: entry for entry in found.exceeded}
    table.add_column("limit")
    lengths, turns = found.mechanism.tree.in_metres, found.mechanism.motors.turns != 0
    for k, motor in enumerate(found.actuated):
        unit = "N" if np.all(lengths[turns[k]]) else "N m"
        limit = found.limit[k]
        says = f"{limit:.4g} {unit}" if np.isfinite(limit) else ""
        if motor in beyond:
            says += f", exceeded from t = {beyond[motor]['t']:.4g} s on"
        table.add_row(f"motor {motor}", *_largest(found.t, np.abs(found.tau[:, k]), unit), says)
    for loop, multipliers in found.loop_forces.items():
        if loop not in found.loop_wrenches:
            table.add_row(f"coupling {loop}", *_largest(found.t, np.abs(multipliers[:, 0]), ""))
            continue
        force, moment = (np.linalg.norm(found.loop_wrenches[loop][:, part], axis=1) for part in SPATIAL)
        if force.any() or not moment.any():
            table.add_row(f"loop {loop}", *_largest(found.t, force, "N"))
        if moment.max() > NO_MOMENT * found.mechanism.size * force.max():
            table.add_row(f"loop {loop}, moment", *_largest(found.t, moment, "N m"))
    return Group(table, Text(found.message))


def _largest(t: Array, sizes: Array, unit: str) -> tuple[str, str]:
    at = int(np.argmax(sizes))
    return f"{sizes[at]:.4g} {unit}", f"{t[at]:.4g}"


def _would_pay(run: Run) -> str:
    """Say of a long run that compiled terms would have made it a short one."""
    if len(run.coordinates) > MOST_COORDINATES or run.stats["wall_s"] < LONG:
        return ""
    return "; compiled ones are several times faster: ckc compile"


def _formulation(run: Run) -> str:
    formulation = run.scene["formulation"]
    if formulation != "spf":
        return str(formulation)
    coordinates = run.scene["spf_coordinates"]
    exact = coordinates == "w" and not run.w[0].any()  # epsilon stands only in w = w(0) exp(-t / epsilon)
    same = ": from w(0) = 0 bit for bit the reduced model, whatever epsilon" if exact else ""
    return f"spf in (q, q_dot, {coordinates}), epsilon = {run.scene['epsilon']:g}{same}"


def profile_table(run: Run) -> Table:
    """Return which terms were evaluated, how often, and what that cost."""
    table = _plain_table("term")
    for title in ("evaluated", "ms"):
        table.add_column(title, justify="right")
    for name, cost in run.profile.items():
        table.add_row(name, str(cost["calls"]), f"{1e3 * cost['seconds']:.2f}")
    return table


def _rows_of_jacobian(found: Terms) -> zip[tuple[Array, Array]]:
    return zip(found.at.phi_q, found.at.phi_z, strict=True)


def _row(values: Array) -> str:
    return " ".join(f"{x:>14.8g}" for x in values)


def _plain_table(*titles: str) -> Table:
    from rich.table import Table

    table = Table(*titles, box=None, show_header=any(titles), pad_edge=False)
    return table
