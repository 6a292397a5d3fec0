"""Modes of a linear model as motions to look at: a mechanism that sways about its state, its loops closed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import newton
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.linear_model import LinearModel, Mode
from ckc_pin.simulation.run import Run
from ckc_pin.simulation.scene import make_scene

__all__ = ["sway", "sways"]

MOST = 12  # modes, the slowest ones
PERIODS, FRAMES = 2, 48  # shown, and frames in each
LARGEST, LEAST = 0.2, 1e-3  # rad, or of the mechanism's size: how far the coordinate that moves most does


def sways(model: LinearModel) -> dict[int, Run]:
    """Return the modes that swing, by their number among `LinearModel.modes`, counted from 1; at most a dozen."""
    swinging = [k for k, mode in enumerate(model.modes, 1) if mode.frequency > 0]
    return {k: run for k in swinging[:MOST] if (run := sway(model, k)) is not None}


def sway(model: LinearModel, number: int) -> Run | None:
    """Return a mode as a run of a few periods without its damping, as large as the loops allow; None where they do not.

    Rates and energies are those of the motion; no force acts.

    Parameters
    ----------
    number : int
        Of the mode, counted from 1.
    """
    mode, size = model.modes[number - 1], LARGEST
    while size > LEAST:
        found = _swing(model, mode, size)
        if found is not None:
            return _run(model, number, mode, *found)
        size /= 2
    return None


def _swing(model: LinearModel, mode: Mode, size: float) -> tuple[Array, list[Terms]] | None:
    """States of the motion: what the shape says of the model's own coordinates, the others as the loops have it."""
    mechanism, tree = model.mechanism, model.mechanism.tree
    q = np.array([tree.index[name] for name in model.states[: len(model.states) // 2]], dtype=np.intp)
    z = np.setdiff1d(np.arange(mechanism.n), q)
    start = tree.from_coordinates(model.q_tree)
    angles = np.linspace(0.0, 2 * np.pi, FRAMES, endpoint=False)
    one: list[Terms] = []
    for angle in angles:
        part = size * mode.shape * np.exp(1j * angle)
        at = _closed(model, Partition(q, z), tree.integrate(start, part.real), part.real)
        if at is None:
            return None
        rate = (2j * np.pi * mode.frequency * part).real
        one.append(Terms(mechanism, at, rate - np.linalg.pinv(at.J, rcond=1e-9) @ (at.J @ rate)))
    return np.append(
        np.tile(angles, PERIODS) + 2 * np.pi * np.repeat(np.arange(PERIODS), FRAMES), 2 * np.pi * PERIODS
    ), [
        *(PERIODS * one),
        one[0],
    ]


def _closed(model: LinearModel, partition: Partition, q_tree: Array, step: Array) -> Kinematics | None:
    at = Kinematics(model.mechanism.tree, model.mechanism.closure, partition, q_tree)
    found = newton(at, 0.0, model.mechanism.tolerance)
    moved = model.mechanism.tree.difference(q_tree, found.at.q_tree) / model.mechanism.tree.reach
    return found.at if found.converged and np.abs(moved).max(initial=0.0) < np.abs(step).max() else None


def _run(model: LinearModel, number: int, mode: Mode, angles: Array, states: list[Terms]) -> Run:
    mechanism, m = model.mechanism, len(angles)
    rows = mechanism.closure.rows
    name = f"{model.name}: mode {number}, {mode.says}"
    stats: dict[str, Any] = dict.fromkeys(
        ("rhs", "steps", "rejected", "newton", "factorizations", "jacobians", "switches"), 0
    )
    stats |= {"python_calls": 0, "wall_s": 0.0, "method": "none", "steps_by_method": {}, "terms": "pinocchio"}
    seconds = angles / (2 * np.pi * mode.frequency)
    scene = {"mechanism": MECHANISM_FILE, "formulation": "reduced", "t_end": float(seconds[-1])}
    scene |= {"initial": {"at": "assembled"}}
    run = Run(
        status="done",
        message=f"a mode of the linear model {model.at}, no simulation",
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        t=seconds,
        q_tree=np.array([mechanism.tree.to_coordinates(x.q_tree) for x in states]),
        v_tree=np.array([x.v_tree for x in states]),
        u=np.zeros((m, mechanism.d)),
        tau=np.zeros((m, len(mechanism.actuated))),
        phi=np.array([x.phi for x in states]).reshape(m, rows),
        w=np.zeros((m, rows)),
        energy=np.array([x.energy for x in states]),
        lyapunov=None,
        dissipated=None,
        max_phi=float(max(np.abs(x.phi).max(initial=0.0) for x in states)),
        max_phi_dot=float(max(np.abs(x.at.J @ x.v_tree).max(initial=0.0) for x in states)),
        events=[],
        stats=stats,
        scene_name=name,
        scene=make_scene(scene, name, mechanism.sources).plain(),
        texts=dict(mechanism.sources.texts),
    )
    run.__dict__["mechanism"] = mechanism
    return run
