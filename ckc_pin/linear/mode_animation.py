"""Modes of a linear model as motions to look at: a mechanism that sways about its state, its loops closed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import is_number
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import minimum_norm_step, project_onto_closure
from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.modes import ComplexArray, Mode, telling
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.run.run import Run
from ckc_pin.scene.scene import make_scene

__all__ = ["sway", "sways"]

MOST = 12  # modes
PERIODS, FRAMES = 2, 48  # shown, and frames in each
CONSTANTS = 3  # time constants of a decay
LARGEST, LEAST = 0.2, 1e-3  # rad, or of the mechanism's size: how far the coordinate that moves most does


def sways(model: LinearModel) -> dict[int, Run]:
    """Return modes as runs, by their number among `LinearModel.modes`, counted from 1.

    At most a dozen, those that swing before those that decay or grow; none that is rigid, or that the loops forbid.
    """
    moving = [k + 1 for k in telling(model.modes, MOST) if model.modes[k].eigenvalue]
    return {k: run for k in moving if (run := sway(model, k)) is not None}


def sway(model: LinearModel, number: int) -> Run | None:
    """Return a mode as a run, as large as the loops allow; None where they do not.

    A few periods without damping, or of a real eigenvalue the decay or growth in three time constants. Rates and
    energies are those of the motion; no force acts.

    Parameters
    ----------
    number : int
        Of the mode, counted from 1.

    Raises
    ------
    InputError
        No mode of that number, or a rigid one: nothing says how it goes on.
    """
    if not (is_number(number) and number in range(1, len(model.modes) + 1)):
        raise InputError(f"mode {number!r:.80}: {model.name} has modes 1 to {len(model.modes)}")
    number = int(number)
    mode, size = model.modes[number - 1], LARGEST
    if not mode.eigenvalue:
        raise InputError(f"mode {number} is rigid (eigenvalue 0): nothing drives it, and no time belongs to it")
    rate = 2j * np.pi * mode.frequency if mode.frequency else complex(mode.eigenvalue.real)
    seconds = np.linspace(0.0, PERIODS * 2 * np.pi if mode.frequency else CONSTANTS, PERIODS * FRAMES + 1) / abs(rate)
    swing = np.exp(rate * seconds) / max(1.0, float(np.exp(rate.real * seconds[-1])))
    while size > LEAST:
        states = _swing(model, size * mode.shape, swing, rate)
        if states is not None:
            return _run(model, number, mode, seconds, states)
        size /= 2
    return None


def _swing(model: LinearModel, shape: ComplexArray, swing: ComplexArray, rate: complex) -> list[Terms] | None:
    """States of the motion, the shortest way off the shape that the loops ask for."""
    mechanism, tree = model.mechanism, model.mechanism.tree
    start, still = tree.from_coordinates(model.q_tree), [tree.index[name] for name in model.locked]
    rank, tolerance = mechanism.n - len(model.states) // 2, mechanism.tolerance * tree.tolerance_factor(start)
    rest = np.eye(mechanism.n)[still]
    states: list[Terms] = []
    for factor in swing:
        part = (shape * factor).real
        moved = mechanism.kinematics(tree.integrate(start, part))
        at = project_onto_closure(moved, rank, still)
        off = np.abs(tree.difference(moved.q_tree, at.q_tree) / tree.step_scale).max()
        if np.abs(at.phi).max(initial=0.0) > tolerance or off > max(float(np.abs(part / tree.step_scale).max()), LEAST):
            return None
        rows, v = np.vstack([at.J, rest]), (rate * shape * factor).real
        states.append(Terms(mechanism, at, v + minimum_norm_step(rows, rank, rows @ v, tree.step_scale)))
    return states


def _run(model: LinearModel, number: int, mode: Mode, seconds: Array, states: list[Terms]) -> Run:
    mechanism, m = model.mechanism, len(seconds)
    rows = mechanism.closure.rows
    says = f"{mode.frequency:.4g} Hz" if mode.frequency else mode.says
    name = f"{model.name}: mode {number}, {says}"  # without its damping
    stats: dict[str, Any] = dict.fromkeys(
        ("rhs", "steps", "rejected", "newton", "factorizations", "jacobians", "switches"), 0
    )
    stats |= {"python_calls": 0, "wall_s": 0.0, "method": "none", "steps_by_method": {}, "terms": "pinocchio"}
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
        scene=make_scene(scene, name, mechanism.sources).to_dict(),
        texts=dict(mechanism.sources.texts),
    )
    run.__dict__["mechanism"] = mechanism
    return run
