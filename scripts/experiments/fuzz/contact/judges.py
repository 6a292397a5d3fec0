"""Judges of runs with stops and friction. Each returns what is wrong, or "" where nothing is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ckc_pin import Run
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.motion import REDUNDANT, Motion
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import energy, state

__all__ = [
    "AGREE",
    "JOINT_EVENTS",
    "allowed_error",
    "columns_of",
    "energies",
    "energy_fault",
    "jumps",
    "limits_fault",
    "quiet_fault",
    "rate_event_fault",
    "rest_fault",
    "start_rates",
]

TIGHT = 1e-11  # rtol
ENERGY = 1e-9  # of the largest, at a tight tolerance
OF_RTOL = 1e3  # times rtol: what else runs may be off
AGREE = 1e-8  # s, and of the largest coordinate and rate: how far formulations may be apart
SAME_IMPACT = 1e-5  # s: how far one impact may be from itself in another formulation
STOP = 1e-8  # rad, or of the mechanism's size: how far beyond a stop a joint may be
JOINT_EVENTS = ("stop", "friction")


def columns_of(run: Run, model: Model) -> list[int]:
    """Columns of a run by the model's labels."""
    return [run.coordinates.index(label) for label in model.labels]


def allowed_error(case: Case, tight: float) -> float:
    """What runs may be off: `tight` at a tight tolerance, else a multiple of rtol."""
    rtol = float(case.overrides["solver.rtol"])
    return tight if rtol <= TIGHT else max(tight, OF_RTOL * rtol)


def start_rates(run: Run, case: Case, model: Model) -> Array:
    """Rates before the impacts of the first instant: as the scene says, dependent ones as loops and couplings do.

    With a free root those of the first row: the suite's loop rows take another basis of its motions.
    """
    if "F" in model.kind:
        return run.v_tree[0, columns_of(run, model)]
    rates, q = case.overrides["initial"]["q_dot"], run.q_tree[:1][:, columns_of(run, model)]
    v = np.array([rates.get(label, 0.0) for label in model.labels])
    free = np.array([label not in rates for label in model.labels])
    G = Motion(model).equations(state(model, q, np.zeros_like(q)), q).G[0]
    v[free] = np.linalg.lstsq(G[:, free], -G @ v, rcond=REDUNDANT)[0]
    return v


def _start_energy(run: Run, case: Case, model: Model) -> float:
    """Kinetic and potential energy before the impacts of the first instant."""
    kinetic, potential = energy(model, run.q_tree[:1, columns_of(run, model)], start_rates(run, case, model)[None])
    return float(kinetic[0] + potential[0])


def energies(run: Run, model: Model) -> tuple[Array, float]:
    """Kinetic and potential energy of the rows by the suite's own equations, and the largest of it."""
    order = columns_of(run, model)
    kinetic, potential = energy(model, run.q_tree[:, order], run.v_tree[:, order])
    weight = float(model.mass.sum() * np.linalg.norm(model.gravity) * model.size)  # at rest energy is all rounding
    largest = max(float(kinetic.max()), float(np.ptp(potential)), 1e-6 * weight, 1e-300)
    return kinetic + potential, max(largest, 1e-3 * float(np.abs(potential).max()))


def energy_fault(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Category and text of what is wrong with energy and what is dissipated."""
    total, largest = energies(run, model)
    if run.dissipated is None:
        acts = case.kind != "trusses" and any(contact.stops or contact.friction for contact in case.contacts.values())
        return ("energy", "`dissipated` is missing") if acts else ("", "")
    allowed = allowed_error(case, ENERGY)
    least = float(np.diff(run.dissipated).min(initial=0.0))
    before = _start_energy(run, case, model)
    rises = np.r_[before, total] - np.minimum.accumulate(np.r_[before, total])
    if case.conservative and rises.max() > 10 * allowed * largest:
        return "grown", f"energy grows by {rises.max() / largest:.2g} of the largest"
    if least < -allowed * largest:
        return "dissipated", f"`dissipated` falls by {-least / largest:.2g} of the largest energy"
    if case.conservative:
        off = total + run.dissipated - before
        k = int(np.argmax(np.abs(off)))
        if abs(off[k]) > allowed * largest:
            return "energy", f"energy + dissipated off by {off[k] / largest:.2g} of the largest at t = {run.t[k]:.6g}"
    return "", ""


def limits_fault(run: Run, case: Case) -> str:
    """Whether a joint is beyond a stop, or the loops are open."""
    reach = run.mechanism.tree.step_scale
    for name, contact in case.contacts.items():
        k = run.column(name)
        beyond = max(contact.lower - run.q_tree[:, k].min(), run.q_tree[:, k].max() - contact.upper) / reach[k]
        if beyond > STOP:
            return f"{name} is {beyond:.2g} beyond its stop"
    if not run.max_phi <= max(10 * run.mechanism.tolerance, 1e-9 * max(1.0, run.mechanism.size)):
        return f"open by {run.max_phi:.2g}"
    return ""


def quiet_fault(run: Run, case: Case) -> str:
    """Whether joints that cannot move, or rest on their stops, have events but those by which they begin to be held."""

    def begins(event: dict[str, Any]) -> bool:
        rests = event["name"].split()[-1] in ("sticks", "touches")
        return bool(event["t"] <= case.quiet_after and (rests or case.quiet_after > 0))

    events = [event for event in run.events if event["of"] in JOINT_EVENTS and event["coordinate"] in case.quiet]
    loud = [event for event in events if not begins(event)]
    if loud:
        return f"{len(loud)} events of joints that do not move, first {loud[0]['name']} at t = {loud[0]['t']:.6g}"
    return ""


def rest_fault(run: Run, model: Model, case: Case) -> str:
    """Whether a jammed mechanism is at rest after the first instant."""
    order = columns_of(run, model)
    kinetic, _ = energy(model, run.q_tree[:, order], run.v_tree[:, order])
    before = energy(model, run.q_tree[:1, order], start_rates(run, case, model)[None])[0][0]
    if kinetic[1:].max() > 1e-18 * max(1.0, before):  # the first row may be before the impact of its instant
        return f"jammed, but kinetic energy {kinetic[1:].max():.2g} J is left of {before:.2g} J"
    return ""


def rate_event_fault(run: Run, name: str, value: float, t: float) -> str:
    """Whether an event on a rate is met once at the impact near a time that jumps over its value."""
    hits = [float(event["t"]) for event in jumps(run) if event["coordinate"] == name]
    hit = min(hits, key=lambda x: abs(x - t), default=np.inf)
    if abs(hit - t) > SAME_IMPACT:
        return ""
    met = [float(event["t"]) for event in run.events if event["of"] == "q_dot" and event["value"] == value]
    at = [x for x in met if abs(x - hit) < AGREE]
    if len(at) != 1:
        return (
            f"rate {value:.4g} of {name} is met {len(at)} times at its impact at t = {hit:.9g}, {len(met)} times in all"
        )
    return ""


def jumps(run: Run) -> Sequence[dict[str, Any]]:
    """Impacts of a run, in order."""
    return [event for event in run.events if event["of"] == "stop" and event["name"].endswith("bounces")]
