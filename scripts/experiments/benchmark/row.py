"""Compare one run of one program with the reference: a line of the report's table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.analysis.precision.motion import Motion
from ckc_pin.dynamics.terms import Terms
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.work import Work

__all__ = ["Row", "compare_with_reference"]


@dataclass(frozen=True)
class Row:
    """A line of the table. Errors in rad or m; energy drift in units of the largest kinetic energy."""

    work: str
    program: str
    setting: str
    status: str
    reason: str
    error_end: float | None
    error_max: float | None
    closure: float | None
    energy_drift: float | None
    wall_s: float | None
    setup_s: float | None
    steps: int | None
    rhs: int | None


def compare_with_reference(work: Work, program: str, setting: str, motion: Motion, reference: Reference) -> Row:
    """Compare a motion with the reference: error, closure and energy drift."""
    complete = motion.status == "done" and len(motion.q_tree) == len(work.instants)
    finite = complete and bool(np.all(np.isfinite(motion.q_tree)))
    errors = np.abs(work.observed(motion.q_tree) - reference.values).max(axis=1) if finite else np.empty(0)
    closure, drift = _closure_and_drift(work, motion) if finite else (None, None)
    return Row(
        work=work.key,
        program=program,
        setting=setting,
        status=motion.status if finite or motion.status != "done" else "not finite",
        reason=motion.reason,
        error_end=float(errors[-1]) if finite else None,
        error_max=float(errors.max()) if finite else None,
        closure=closure,
        energy_drift=drift,
        wall_s=motion.wall_s,
        setup_s=motion.setup_s,
        steps=motion.steps,
        rhs=motion.rhs,
    )


def _closure_and_drift(work: Work, motion: Motion) -> tuple[float, float | None]:
    """Return the largest |phi| and the relative drift of the energy, None if a controller or damper acts."""
    mechanism = work.mechanism
    states = [
        Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(q_tree)), v_tree)
        for q_tree, v_tree in zip(motion.q_tree, motion.v_tree, strict=True)
    ]
    closure = max(float(np.abs(terms.phi).max(initial=0.0)) for terms in states)
    if work.controlled or mechanism.springs.any_damping:
        return closure, None
    kinetic = max(0.5 * float(terms.v_tree @ terms.D_tree @ terms.v_tree) for terms in states)
    energies = np.array([terms.energy for terms in states])
    return closure, float(np.abs(energies - energies[0]).max() / max(kinetic, 1e-300))
