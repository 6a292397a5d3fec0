"""Judges of runs with stops and friction. Each returns what is wrong, or "" where nothing is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np

from ckc_pin.simulation import Run
from scripts.experiments.fuzz.contact.cases import Case
from scripts.experiments.fuzz.contact.slides import Slides
from scripts.experiments.fuzz.contact.time_stepping import TimeStepping
from scripts.experiments.fuzz.motion import REDUNDANT, Motion
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import difference, energy, state

__all__ = [
    "Agreement",
    "agreement_allowed",
    "compare",
    "compare_with_slides",
    "compare_with_steps",
    "energy_fault",
    "jumps",
    "limits_fault",
    "quiet_fault",
    "rate_event_fault",
    "rest_fault",
]

TIGHT = 1e-11  # rtol
ENERGY = 1e-9  # of the largest, at a tight tolerance
OF_RTOL = 1e3  # times rtol: what else runs may be off
AGREE = 1e-8  # s, and of the largest coordinate and rate
OF_LAST_BOUNCE = 100.0  # times: bounces end where the last one's rise, 1e-10 of a joint's reach, takes 1e-5 s
BESIDE_EVENT = 1e-7  # s: rows nearer to an event may be before or after it
STOP = 1e-8  # rad, or of the mechanism's size: how far beyond a stop a joint may be
MAGNIFIED = 30.0  # times what a perturbed reference is off
PERTURBATION = 1e-11  # relative, of the reference's start
SEEN = 25  # instants at which the time-stepping scheme is compared
STEPS = (250, 500, 2000)
STEPS_OFF = 5.0  # times the difference of two step sizes: how far the scheme may be off
JOINT_EVENTS = ("stop", "friction")


def _columns(run: Run, model: Model) -> list[int]:
    return [run.coordinates.index(label) for label in model.labels]


def agreement_allowed(case: Case) -> float:
    """How far formulations may be apart, in s, and of the largest coordinate and rate."""
    return _allowed(case, AGREE)


def _allowed(case: Case, tight: float) -> float:
    rtol = float(case.overrides["solver.rtol"])
    return tight if rtol <= TIGHT else max(tight, OF_RTOL * rtol)


def energies(run: Run, model: Model) -> tuple[Array, float]:
    """Kinetic and potential energy of the rows by the suite's own equations, and the largest of it."""
    order = _columns(run, model)
    kinetic, potential = energy(model, run.q_tree[:, order], run.v_tree[:, order])
    weight = float(model.mass.sum() * np.linalg.norm(model.gravity) * model.size)  # at rest energy is all rounding
    largest = max(float(kinetic.max()), float(np.ptp(potential)), 1e-6 * weight, 1e-300)
    return kinetic + potential, max(largest, 1e-3 * float(np.abs(potential).max()))


def energy_fault(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Category and text of what is wrong with energy and what is dissipated."""
    total, largest = energies(run, model)
    if run.dissipated is None:  # nothing rubs or stops, or only joints that cannot move
        moves = any(contact.stops or contact.friction for contact in case.contacts.values()) and case.kind != "truss"
        return ("energy", "`dissipated` is missing") if moves else ("", "")
    allowed = _allowed(case, ENERGY)
    least = float(np.diff(run.dissipated).min(initial=0.0))
    if case.conservative and total.max() - total[0] > 10 * allowed * largest:
        return "grown", f"energy grows by {(total.max() - total[0]) / largest:.2g} of the largest"
    if least < -allowed * largest:
        return "dissipated", f"`dissipated` falls by {-least / largest:.2g} of the largest energy"
    if case.conservative:
        off = total + run.dissipated - _start_energy(run, case, model)
        k = int(np.argmax(np.abs(off)))
        if abs(off[k]) > allowed * largest:
            return "energy", f"energy + dissipated off by {off[k] / largest:.2g} of the largest at t = {run.t[k]:.6g}"
    return "", ""


def limits_fault(run: Run, case: Case) -> str:
    """Whether a joint is beyond a stop, or the loops are open."""
    reach = run.mechanism.tree.reach
    for name, contact in case.contacts.items():
        k = run.column(name)
        beyond = max(contact.lower - run.q_tree[:, k].min(), run.q_tree[:, k].max() - contact.upper) / reach[k]
        if beyond > STOP:
            return f"{name} is {beyond:.2g} beyond its stop"
    if not run.max_phi <= max(10 * run.mechanism.tolerance, 1e-9 * max(1.0, run.mechanism.size)):
        return f"open by {run.max_phi:.2g}"
    return ""


def quiet_fault(run: Run, case: Case) -> str:
    """Whether joints that cannot move, or rest on their stops, have events."""
    loud = [
        event for event in run.events
        if event["of"] in JOINT_EVENTS and event["coordinate"] in case.quiet and event["t"] > case.quiet_after
    ]  # fmt: skip
    if case.quiet_after == 0.0:  # what sticks or touches from the start may say so
        loud = [event for event in loud if event["t"] > 0.0 or event["name"].split()[-1] not in ("sticks", "touches")]
    if loud:
        return f"{len(loud)} events of joints that do not move, first {loud[0]['name']} at t = {loud[0]['t']:.6g}"
    return ""


def rest_fault(run: Run, model: Model, case: Case) -> str:
    """Whether a jammed mechanism is at rest after the first instant."""
    order = _columns(run, model)
    kinetic, _ = energy(model, run.q_tree[:, order], run.v_tree[:, order])
    before = energy(model, run.q_tree[:1, order], _start_rates(run, case, model)[None])[0][0]
    if kinetic[1:].max() > 1e-18 * max(1.0, before):  # the first row may be before the impact of its instant
        return f"jammed, but kinetic energy {kinetic[1:].max():.2g} J is left of {before:.2g} J"
    return ""


@dataclass(frozen=True)
class Agreement:
    """How far two runs agree: the number of equal events, until when, and by how much they are off until then."""

    fault: str
    until: float
    off: float


def _times(run: Run) -> dict[str, list[float]]:
    """When each event of stops and friction happened, by name."""
    times: dict[str, list[float]] = {}
    for event in run.events:
        if event["of"] in JOINT_EVENTS:
            times.setdefault(str(event["name"]), []).append(float(event["t"]))
    return times


def compare(one: Run, other: Run, model: Model, allowed: float, until: float = np.inf) -> Agreement:
    """Compare the events of two runs, each name's in order of time, and their rows, up to a time.

    Events change places only where their times agree within what is allowed.
    """
    mine, theirs = _times(one), _times(other)
    end = min(float(one.t[-1]), float(other.t[-1]), until)
    off, fault, until = 0.0, "", end
    for name in sorted({*mine, *theirs}):
        for a, b in zip_longest(mine.get(name, []), theirs.get(name, []), fillvalue=np.inf):
            first = min(a, b)
            if first >= end - BESIDE_EVENT:
                break
            late = abs(a - b) if max(a, b) < np.inf else np.inf
            factor = OF_LAST_BOUNCE if name.endswith("touches") else 1.0
            if late <= allowed * factor:
                off = max(off, late / factor)
                continue
            if first < until:
                fault, until = f"{name} at {a:.9g} and {b:.9g}", first
            break
    times = np.array([t for found in (*mine.values(), *theirs.values()) for t in found])
    rows_a, rows_b = _common(one.t, other.t)
    keep = one.t[rows_a] < until - BESIDE_EVENT if fault else one.t[rows_a] <= until
    if len(times):
        keep &= np.abs(one.t[rows_a][:, None] - times).min(axis=1) > BESIDE_EVENT
    rows_a, rows_b = rows_a[keep], rows_b[keep]
    if len(rows_a):
        apart = _apart(one, other, rows_a, rows_b, model)
        k = int(np.argmax(apart > allowed)) if (apart > allowed).any() else -1
        off = max(off, float(apart.max()))
        if k >= 0:
            fault, until = f"states {apart[k]:.2g} apart at t = {one.t[rows_a[k]]:.6g}", float(one.t[rows_a[k]])
    return Agreement(fault, until, off)


def _common(a: Array, b: Array) -> tuple[np.ndarray, np.ndarray]:
    k = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    same = np.abs(b[k] - a) < 1e-12
    return np.flatnonzero(same), k[same]


def _apart(one: Run, other: Run, rows_a: np.ndarray, rows_b: np.ndarray, model: Model) -> Array:
    order, order_b = _columns(one, model), _columns(other, model)
    q, q_b, v, v_b = one.q_tree[rows_a][:, order], other.q_tree[rows_b][:, order_b], one.v_tree, other.v_tree
    of_q = np.abs(difference(model, q, q_b)).max(axis=1) / max(1.0, float(np.abs(q).max()))
    of_v = np.abs(v[rows_a][:, order] - v_b[rows_b][:, order_b]).max(axis=1) / max(1.0, float(np.abs(v).max()))
    return np.maximum(of_q, of_v)


def compare_with_slides(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare impact times and velocities with the event-driven reference; category and what is off."""
    faults = []
    for rechoose in (False, True):
        fault, certain = _against_slides(run, model, case, rechoose)
        if not fault:
            return ("", "") if certain else ("unjudged", "the reference is not certain from the start")
        faults.append(fault)
    return "reference", faults[0]


def _against_slides(run: Run, model: Model, case: Case, rechoose: bool) -> tuple[str, bool]:
    slides = Slides(model, case.contacts, rechoose=rechoose)
    order = _columns(run, model)
    q, v, end = run.q_tree[0][order], _start_rates(run, case, model), float(run.t[-1])
    exact = slides.run(q, v, end)
    beside = slides.run(q, v * (1 + PERTURBATION), end)
    certain = min(exact.certain_until, beside.certain_until, end)
    rows = np.flatnonzero((run.t > 0) & (run.t < certain))
    own = [float(event["t"]) for event in run.events if event["of"] == "stop" and event["name"].endswith("bounces")]
    hits = [t for t, _ in exact.impacts]
    for at, (a, b) in enumerate(zip(hits, [t for t, _ in beside.impacts], strict=False)):
        if a >= certain:
            break
        allowed = 1e-9 + MAGNIFIED * abs(a - b)
        if a > 0 and _nearest(run, a) > allowed:
            return f"impact {at} at t = {a:.9g} is missing; nearest event {_nearest(run, a):.2g} s off", True
    for t in own:
        if t < certain - BESIDE_EVENT and (not hits or np.abs(np.array(hits) - t).min() > 1e-7):
            return f"a bounce at t = {t:.9g} that the reference has not", True
    times = np.array([*exact.t, *beside.t, *(float(event["t"]) for event in run.events)])
    rows = rows[np.abs(run.t[rows][:, None] - times).min(axis=1, initial=np.inf) > BESIDE_EVENT] if len(times) else rows
    if not len(rows):
        return "", False
    (q_a, v_a), (q_b, v_b) = exact.at(run.t[rows]), beside.at(run.t[rows])
    for name, right, near, ours in (("q", q_a, q_b, run.q_tree), ("rates", v_a, v_b, run.v_tree)):
        scale = max(1.0, float(np.abs(right).max()))
        bound = 1e-9 * scale + MAGNIFIED * np.maximum.accumulate(np.abs(right - near).max(axis=1))
        off = np.abs(ours[rows][:, order] - right).max(axis=1)
        if np.any(off > bound):
            k = int(np.argmax(off > bound))
            return f"{name} off by {off[k]:.2g} at t = {run.t[rows[k]]:.6g}, allowed {bound[k]:.2g}", True
    return "", True


def _nearest(run: Run, t: float) -> float:
    return min((abs(float(event["t"]) - t) for event in run.events if event["of"] == "stop"), default=np.inf)


def _start_rates(run: Run, case: Case, model: Model) -> Array:
    """Rates before the impacts of the first instant: as the scene says, dependent ones as loops and couplings do.

    With a free root those of the first row: the suite's loop rows take another basis of its motions.
    """
    if "F" in model.kind:
        return run.v_tree[0, _columns(run, model)]
    rates, q = case.overrides["initial"]["q_dot"], run.q_tree[:1][:, _columns(run, model)]
    v = np.array([rates.get(label, 0.0) for label in model.labels])
    free = np.array([label not in rates for label in model.labels])
    G = Motion(model).equations(state(model, q, np.zeros_like(q)), q).G[0]
    v[free] = np.linalg.lstsq(G[:, free], -G @ v, rcond=REDUNDANT)[0]
    return v


def _start_energy(run: Run, case: Case, model: Model) -> float:
    """Kinetic and potential energy before the impacts of the first instant."""
    kinetic, potential = energy(model, run.q_tree[:1, _columns(run, model)], _start_rates(run, case, model)[None])
    return float(kinetic[0] + potential[0])


def compare_with_steps(run: Run, model: Model, case: Case) -> tuple[str, str]:
    """Compare with the time-stepping scheme at two step sizes, whose difference says how far off it is itself.

    Where that is not enough, since an impact is rounded to a step by chance alike in both, at a third one that has to
    be nearer to the run by half at least.
    """
    scheme = TimeStepping(model, case.contacts)
    order = _columns(run, model)
    start, rates, end = run.q_tree[0][order], _start_rates(run, case, model), float(run.t[-1])
    times = end * np.arange(1, SEEN + 1) / SEEN  # instants of the run too
    right = run.q_tree[[run.at(t) for t in times]][:, order]
    coarse, fine = (scheme.run(start, rates, end, n, SEEN) for n in STEPS[:2])
    own, off = np.abs(coarse - fine).max(axis=1), np.abs(fine - right).max(axis=1)
    allowed = STEPS_OFF * np.maximum.accumulate(own) + 1e-3 * float(np.ptp(right, axis=0).max()) + 1e-9
    if not np.any(off > allowed):
        return "", ""
    k = int(np.argmax(off > allowed))
    finest = np.abs(scheme.run(start, rates, end, STEPS[2], SEEN) - right).max(axis=1)
    if finest[: k + 1].max() < 0.5 * off[: k + 1].max():
        return "", ""
    return "stepping", f"{finest[k]:.2g} off the time-stepping scheme at t = {times[k]:.4g}, before {off[k]:.2g}"


def rate_event_fault(run: Run, name: str, value: float, t: float) -> str:
    """Whether an event on a rate is met once at the impact that jumps over its value."""
    met = [float(event["t"]) for event in run.events if event["of"] == "q_dot" and event["value"] == value]
    at = [x for x in met if abs(x - t) < 1e-8]
    if len(at) != 1:
        return f"rate {value:.4g} of {name} is met {len(at)} times at the impact at t = {t:.9g}, of {len(met)} in all"
    return ""


def jumps(run: Run) -> Sequence[dict[str, Any]]:
    """Impacts of a run, in order."""
    return [event for event in run.events if event["of"] == "stop" and event["name"].endswith("bounces")]
