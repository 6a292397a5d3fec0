"""An instant of a run as a state, and its instants from one time to another as a run."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ckc_pin.base.validation import is_number
from ckc_pin.errors import InputError
from ckc_pin.run.run_file import ARRAYS, OPTIONAL
from ckc_pin.run.state import State

if TYPE_CHECKING:
    from ckc_pin.run.run import Run

__all__ = ["part_of", "state_of"]


def part_of(run: Run, start: Any, stop: Any, step: Any) -> Run:
    """Return a run's instants from start to stop, s, with the events between.

    Raises
    ------
    InputError
        No two times, a step, or no instant between them.
    """
    if step is not None or not (is_number(start) and is_number(stop)):
        raise InputError(
            f"Run.sel: t: expected a slice of two times, s, without a step, got slice({start!r:.40}, {stop!r:.40})"
        )
    rows = (start <= run.t) & (run.t <= stop)
    if not rows.any():
        between, whole = f"from {start:g} to {stop:g} s", f"from {run.t[0]:g} to {run.t[-1]:g} s"
        raise InputError(f"Run.sel: no output instant {between}; the run is {whole}")
    arrays = {name: getattr(run, name) for name in (*ARRAYS, *OPTIONAL)}
    kept: dict[str, Any] = {name: values if values is None else values[rows] for name, values in arrays.items()}
    met = [event for event in run.events if start <= event["t"] <= stop]
    return replace(run, events=met, **kept)


def state_of(run: Run, k: int) -> State:
    """Return the state at an output instant of a run, as a simulator would be in."""
    mechanism = run.mechanism
    split = mechanism.partition
    q_tree = mechanism.tree.from_coordinates(run.q_tree[k])
    v_terms = v_tree = run.v_tree[k]
    if np.any(run.w[k]) and run.scene["coriolis_velocity"] == "rho":  # off its manifold the SPF's C has this one
        v_terms = mechanism.kinematics(q_tree).rho @ v_tree[split.q]
    numbers = np.concatenate([q_tree, v_tree, v_terms, run.w[k]])
    return State(mechanism, float(run.t[k]), numbers, split.q.tolist(), split.z.tolist())
