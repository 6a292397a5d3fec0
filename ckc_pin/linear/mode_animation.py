"""Animation of a linear model's modes: runs that oscillate about the state with the loops closed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import is_number
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import minimum_norm_step, project_onto_closure
from ckc_pin.linear.linear_model import LinearModel
from ckc_pin.linear.modes import ComplexArray, Mode, select_modes
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.run.run import Run
from ckc_pin.scene.scene import make_scene

__all__ = ["animate_mode", "animate_modes"]

MAX_MODES = 12
PERIODS, FRAMES_PER_PERIOD = 2, 48
TIME_CONSTANTS = 3  # duration of a decay or growth
MAX_AMPLITUDE = 0.2  # of the largest coordinate, rad or relative to the mechanism's size
MIN_AMPLITUDE = 1e-3  # the same; smaller animations are not visible


def animate_modes(model: LinearModel) -> dict[int, Run]:
    """Return runs of the modes, by their number in `LinearModel.modes`, counted from 1.

    There are at most 12 modes, oscillations before decays and growths. Rigid modes and modes that the loops forbid at
    a visible amplitude are omitted.
    """
    numbers = [k + 1 for k in select_modes(model.modes, MAX_MODES) if model.modes[k].eigenvalue]
    return {k: run for k in numbers if (run := animate_mode(model, k)) is not None}


def animate_mode(model: LinearModel, number: int) -> Run | None:
    """Return a mode as a run to play, with the largest amplitude that the loops allow.

    An oscillation lasts two periods and is shown without damping. A decay or growth lasts three time constants. The
    run has the rates and energies of the motion. It has no forces.

    Parameters
    ----------
    model : LinearModel
    number : int
        Number of the mode, counted from 1.

    Returns
    -------
    Run or None
        None if the loops cannot follow the mode at a visible amplitude.

    Raises
    ------
    InputError
        There is no mode of this number, or it is a rigid mode, which has no time scale.
    """
    if not (is_number(number) and number in range(1, len(model.modes) + 1)):
        raise InputError(f"mode {number!r:.80}: {model.name} has modes 1 to {len(model.modes)}")
    number = int(number)
    mode, amplitude = model.modes[number - 1], MAX_AMPLITUDE
    if not mode.eigenvalue:
        raise InputError(f"mode {number} is rigid (eigenvalue 0), so it has no time scale; choose another mode")
    rate = 2j * np.pi * mode.frequency if mode.frequency else complex(mode.eigenvalue.real)
    duration = PERIODS * 2 * np.pi if mode.frequency else TIME_CONSTANTS
    instants = np.linspace(0.0, duration, PERIODS * FRAMES_PER_PERIOD + 1) / abs(rate)
    factors = np.exp(rate * instants) / max(1.0, float(np.exp(rate.real * instants[-1])))
    while amplitude > MIN_AMPLITUDE:
        states = _compute_states(model, amplitude * mode.shape, factors, rate)
        if states is not None:
            return _create_run(model, number, mode, instants, states)
        amplitude /= 2
    return None


def _compute_states(
    model: LinearModel, shape: ComplexArray, factors: ComplexArray, rate: complex
) -> list[Terms] | None:
    """Return the states of Re(shape factor), each projected onto the constraint manifold.

    Returns None if a projection does not converge or is larger than the displacement of the mode.
    """
    mechanism, tree = model.mechanism, model.mechanism.tree
    start, locked = tree.from_coordinates(model.q_tree), [tree.index[name] for name in model.locked]
    rank, tolerance = mechanism.n - len(model.states) // 2, mechanism.tolerance * tree.tolerance_factor(start)
    locked_rows = np.eye(mechanism.n)[locked]
    states: list[Terms] = []
    for factor in factors:
        displacement = (shape * factor).real
        moved = mechanism.kinematics(tree.integrate(start, displacement))
        at = project_onto_closure(moved, rank, locked)
        correction = np.abs(tree.difference(moved.q_tree, at.q_tree) / tree.step_scale).max()
        limit = max(float(np.abs(displacement / tree.step_scale).max()), MIN_AMPLITUDE)
        if np.abs(at.phi).max(initial=0.0) > tolerance or correction > limit:
            return None
        rows, v = np.vstack([at.J, locked_rows]), (rate * shape * factor).real
        states.append(Terms(mechanism, at, v + minimum_norm_step(rows, rank, rows @ v, tree.step_scale)))
    return states


def _create_run(model: LinearModel, number: int, mode: Mode, instants: Array, states: list[Terms]) -> Run:
    mechanism, m = model.mechanism, len(instants)
    rows = mechanism.closure.rows
    frequency = f"{mode.frequency:.4g} Hz" if mode.frequency else mode.description  # the run has no damping
    name = f"{model.name}: mode {number}, {frequency}"
    stats: dict[str, Any] = dict.fromkeys(
        ("rhs", "steps", "rejected", "newton", "factorizations", "jacobians", "switches"), 0
    )
    stats |= {"python_calls": 0, "wall_s": 0.0, "method": "none", "steps_by_method": {}, "terms": "pinocchio"}
    scene = {"mechanism": MECHANISM_FILE, "formulation": "reduced", "t_end": float(instants[-1])}
    scene |= {"initial": {"at": "assembled"}}
    run = Run(
        status="done",
        message=f"a mode of the linear model {model.at}, no simulation",
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        t=instants,
        q_tree=np.array([mechanism.tree.to_coordinates(x.q_tree) for x in states]),
        v_tree=np.array([x.v_tree for x in states]),
        u=np.zeros((m, mechanism.d)),
        tau=np.zeros((m, len(mechanism.actuated))),
        phi=np.array([x.phi for x in states]).reshape(m, rows),
        w=np.zeros((m, rows)),
        energy=np.array([x.energy for x in states]),
        lyapunov=None,
        dissipated=None,
        works=None,
        force_values=None,
        prescribed_states=None,
        max_phi=float(max(np.abs(x.phi).max(initial=0.0) for x in states)),
        max_phi_dot=float(max(np.abs(x.at.J @ x.v_tree).max(initial=0.0) for x in states)),
        events=[],
        stats=stats,
        scene_name=name,
        scene=make_scene(scene, name, mechanism.sources).to_dict(),
        texts=dict(mechanism.sources.texts),
        built_mechanism=mechanism,
    )
    return run
