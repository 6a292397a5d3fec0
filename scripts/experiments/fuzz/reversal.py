"""Time reversal: run a conservative motion back from its end with reversed velocities, and compare with its past."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.motions import Motion
from scripts.experiments.fuzz.reference import ReferenceIntegrator

__all__ = ["measure_reversal_error"]

INSTANTS = 12  # output instants of the reversed run


def measure_reversal_error(
    run: Run, motion: Motion, reference: ReferenceIntegrator, order: Sequence[int], suspect_factor: float
) -> float:
    """Return the error of a reversed run against the run's own past, over rtol.

    It is NaN if the reversed run stops or is ill-conditioned. The latter is tested with the reference integrator if
    the error exceeds `suspect_factor` rtol.
    """
    rtol = motion.overrides["solver.rtol"]
    row = max(0, len(run.t) - 1 - INSTANTS)
    span = float(run.t[-1] - run.t[row])
    if span <= 0:
        return np.nan
    q, v = run.q_tree[:, order], run.v_tree[:, order]
    at = {name: k for k, name in enumerate(run.coordinates)}
    initial = {
        "q": {name: float(run.q_tree[-1, k]) for name, k in at.items()},
        "q_dot": {name: -float(run.v_tree[-1, at[name]]) for name in run.independent},
    }
    overrides = {**motion.overrides, "initial": initial, "t_end": span, "event": [], "solver.output_dt": span}
    try:
        returned = ckc_pin.simulate(motion.scene, overrides)
    except CkcError:
        return np.nan
    if returned.status != "done":
        return np.nan
    q_end, v_end = returned.q_tree[-1:, order], returned.v_tree[-1:, order]
    error = float(reference.compute_error(q_end, v_end, q[row][None], -v[row][None])[0])
    if error > suspect_factor * rtol:
        start, dt = (q[-1:], -v[-1:]), np.array([span])
        end = reference.integrate_segments(*start, dt, 1e-3 * rtol)
        if not end.resolved[0] or reference.find_ill_conditioned(*start, dt, end, np.array([True]))[0]:
            return np.nan
    return error / rtol
