"""Time reversal: from the end of a conservative motion, with velocities turned around, back along its own past."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ckc_pin
from ckc_pin import Run
from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.judge import Judge
from scripts.experiments.fuzz.motions import Motion

__all__ = ["reversal"]

INSTANTS = 12  # of output, that it is run back over


def reversal(run: Run, motion: Motion, judge: Judge, order: Sequence[int], doubtful: float) -> float:
    """How far the run's own past is missed, over rtol; NaN where nothing is said.

    A way that magnifies errors much itself is left out, as pieces are: where it is off by more than `doubtful` rtol
    the judge goes it too. So is one that stops.
    """
    rtol = motion.overrides["solver.rtol"]
    then = max(0, len(run.t) - 1 - INSTANTS)
    span = float(run.t[-1] - run.t[then])
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
        back = ckc_pin.simulate(motion.scene, overrides)
    except CkcError:
        return np.nan
    if back.status != "done":
        return np.nan
    off = float(judge.error(back.q_tree[-1:, order], back.v_tree[-1:, order], q[then][None], -v[then][None])[0])
    if off > doubtful * rtol:
        start, dt = (q[-1:], -v[-1:]), np.array([span])
        end = judge.pieces(*start, dt, 1e-3 * rtol)
        if not end.resolved[0] or judge.sensitive(*start, dt, end, np.array([True]))[0]:
            return np.nan
    return off / rtol
