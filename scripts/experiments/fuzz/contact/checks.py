"""Checks of runs with stops and friction. Each returns the fault as text, or ""."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.newton_euler import RANK_TOLERANCE, NewtonEuler
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import compute_energy, to_state

__all__ = [
    "AGREEMENT",
    "JOINT_EVENTS",
    "check_energy",
    "check_limits",
    "check_quiet_joints",
    "check_rate_event",
    "check_rest",
    "column_order",
    "compute_allowed_error",
    "compute_energies",
    "compute_start_rates",
    "list_impacts",
]

TIGHT_RTOL = 1e-11
ENERGY_TOLERANCE = 1e-9  # relative to the largest energy, for runs with TIGHT_RTOL
RTOL_FACTOR = 1e3  # allowed error over rtol of runs with a larger rtol
AGREEMENT = 1e-8  # s, and relative for coordinates and rates: allowed difference between formulations
IMPACT_TIME_TOLERANCE_S = 1e-5  # difference of an impact's time between formulations
STOP_TOLERANCE = 1e-8  # rad, or relative to the mechanism's size: allowed penetration of a stop
JOINT_EVENTS = ("stop", "friction")


def column_order(run: Run, model: Model) -> list[int]:
    """Return the columns of a run in the order of the model's labels."""
    return [run.coordinates.index(label) for label in model.labels]


def compute_allowed_error(case: Case, tolerance: float) -> float:
    """Return the allowed error of a run: `tolerance` if its rtol is tight, else at least a multiple of rtol."""
    rtol = float(case.overrides["solver.rtol"])
    return tolerance if rtol <= TIGHT_RTOL else max(tolerance, RTOL_FACTOR * rtol)


def compute_start_rates(run: Run, case: Case, model: Model) -> Array:
    """Return the rates before impacts at t = 0: independent ones of the scene, dependent ones from the constraints.

    Mechanisms with a free root return the rates of the first row, because the model's Jacobian uses another basis for
    the motion of the root.
    """
    if "F" in model.kind:
        return run.v_tree[0, column_order(run, model)]
    rates, q = case.overrides["initial"]["q_dot"], run.q_tree[:1][:, column_order(run, model)]
    v = np.array([rates.get(label, 0.0) for label in model.labels])
    free = np.array([label not in rates for label in model.labels])
    G = NewtonEuler(model).compute_equations(to_state(model, q, np.zeros_like(q)), q).G[0]
    v[free] = np.linalg.lstsq(G[:, free], -G @ v, rcond=RANK_TOLERANCE)[0]
    return v


def _start_energy(run: Run, case: Case, model: Model) -> float:
    """Return the total energy before impacts at t = 0."""
    kinetic, potential = compute_energy(
        model, run.q_tree[:1, column_order(run, model)], compute_start_rates(run, case, model)[None]
    )
    return float(kinetic[0] + potential[0])


def compute_energies(run: Run, model: Model) -> tuple[Array, float]:
    """Return the total energy of the rows, computed from the model, and the energy scale."""
    order = column_order(run, model)
    kinetic, potential = compute_energy(model, run.q_tree[:, order], run.v_tree[:, order])
    weight = float(model.mass.sum() * np.linalg.norm(model.gravity) * model.size)  # energy at rest is rounding error
    largest = max(float(kinetic.max()), float(np.ptp(potential)), 1e-6 * weight, 1e-300)
    return kinetic + potential, max(largest, 1e-3 * float(np.abs(potential).max()))


def check_energy(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Check the energy and `dissipated`; return category and text of the fault."""
    total, largest = compute_energies(run, model)
    if run.dissipated is None:
        has_contact = case.kind != "trusses" and any(
            contact.stops or contact.friction for contact in case.contacts.values()
        )
        return ("energy", "`dissipated` is missing") if has_contact else ("", "")
    allowed = compute_allowed_error(case, ENERGY_TOLERANCE)
    smallest_increment = float(np.diff(run.dissipated).min(initial=0.0))
    before = _start_energy(run, case, model)
    rises = np.r_[before, total] - np.minimum.accumulate(np.r_[before, total])
    if case.conservative and rises.max() > 10 * allowed * largest:
        return "grown", f"energy grows by {rises.max() / largest:.2g} of the largest"
    if smallest_increment < -allowed * largest:
        return "dissipated", f"`dissipated` falls by {-smallest_increment / largest:.2g} of the largest energy"
    if case.conservative:
        imbalance = total + run.dissipated - before
        k = int(np.argmax(np.abs(imbalance)))
        if abs(imbalance[k]) > allowed * largest:
            relative = imbalance[k] / largest
            return "energy", f"energy + dissipated off by {relative:.2g} of the largest at t = {run.t[k]:.6g}"
    return "", ""


def check_limits(run: Run, case: Case) -> str:
    """Check that no joint is beyond a stop, and that the loops are closed."""
    reach = run.mechanism.tree.step_scale
    for name, contact in case.contacts.items():
        k = run.column(name)
        beyond = max(contact.lower - run.q_tree[:, k].min(), run.q_tree[:, k].max() - contact.upper) / reach[k]
        if beyond > STOP_TOLERANCE:
            return f"{name} is {beyond:.2g} beyond its stop"
    if not run.max_phi <= max(10 * run.mechanism.tolerance, 1e-9 * max(1.0, run.mechanism.size)):
        return f"loops open by {run.max_phi:.2g}"
    return ""


def check_quiet_joints(run: Run, case: Case) -> str:
    """Check that joints which cannot move, or rest on their stops, have no events after they come to rest."""

    def starts_to_rest(event: dict[str, Any]) -> bool:
        rests = event["name"].split()[-1] in ("sticks", "touches")
        return bool(event["t"] <= case.quiet_after and (rests or case.quiet_after > 0))

    events = [event for event in run.events if event["of"] in JOINT_EVENTS and event["coordinate"] in case.quiet]
    unexpected = [event for event in events if not starts_to_rest(event)]
    if unexpected:
        first = unexpected[0]
        return f"{len(unexpected)} events of joints at rest, the first is {first['name']} at t = {first['t']:.6g}"
    return ""


def check_rest(run: Run, model: Model, case: Case) -> str:
    """Check that a jammed mechanism is at rest after t = 0."""
    order = column_order(run, model)
    kinetic, _ = compute_energy(model, run.q_tree[:, order], run.v_tree[:, order])
    before = compute_energy(model, run.q_tree[:1, order], compute_start_rates(run, case, model)[None])[0][0]
    if kinetic[1:].max() > 1e-18 * max(1.0, before):  # the first row may be before the impact at t = 0
        return f"jammed, but the kinetic energy is {kinetic[1:].max():.2g} J after {before:.2g} J"
    return ""


def check_rate_event(run: Run, name: str, value: float, t: float) -> str:
    """Check that an event on a rate is triggered once by the impact close to t that jumps over the event's value."""
    times = [float(event["t"]) for event in list_impacts(run) if event["coordinate"] == name]
    impact_time = min(times, key=lambda x: abs(x - t), default=np.inf)
    if abs(impact_time - t) > IMPACT_TIME_TOLERANCE_S:
        return ""
    occurrences = [float(event["t"]) for event in run.events if event["of"] == "q_dot" and event["value"] == value]
    at_impact = [x for x in occurrences if abs(x - impact_time) < AGREEMENT]
    if len(at_impact) != 1:
        return (
            f"rate {value:.4g} of {name} is triggered {len(at_impact)} times at the impact at t = {impact_time:.9g},"
            f" {len(occurrences)} times in the run"
        )
    return ""


def list_impacts(run: Run) -> Sequence[dict[str, Any]]:
    """Return the impacts of a run in the order of time."""
    return [event for event in run.events if event["of"] == "stop" and event["name"].endswith("bounces")]
