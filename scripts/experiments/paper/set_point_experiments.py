"""Experiments on set-point control (eqs. 14 and 15), which `scripts.experiments.paper.set_point` evaluates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.control.controllers import SetPoint
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import assembly_branches
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.certificate.branch_walk import follow, margin
from scripts.experiments.certificate.certificate import Certificate, certify, level_of, sublevel_set
from scripts.experiments.certificate.gradient_bounds import Bound, chart_step, explore_branch, gradient_bounds
from scripts.experiments.paper.lyapunov import Record, record
from scripts.experiments.paper.solutions import Equilibrium, equilibria

__all__ = [
    "DENSE",
    "FORMULATIONS",
    "NEAR_START",
    "SCENE",
    "Case",
    "along_run",
    "bounds",
    "equilibria_of",
    "gradient_error",
    "load_case",
]

SCENE = "five_bar/set_point"
MARGINS = (0.8, 0.5, 0.3, 0.1, 0.05)
DENSE = {"solver.rtol": 1e-12, "solver.method": "DOP853", "solver.output_dt": 5e-4, "t_end": 2.0}
NEAR_START = {
    "initial.at": None,
    "initial.q": {"theta_1": 0.3, "theta_3": 0.5},
}  # half a radian from q_d
FORMULATIONS: dict[str, dict[str, Any]] = {
    "reduced, eq. 6": {"formulation": "reduced"},
    "SPF, eq. 17": {"formulation": "spf"},
    # Eq. 8 as printed limits explicit methods to steps of the size of epsilon.
    "SPF, eq. 8": {"formulation": "spf", "spf_coordinates": "z", "solver.method": "Radau", "solver.rtol": 1e-10},
    "DAE, eq. 1": {"formulation": "dae"},
}


@dataclass(frozen=True)
class Case:
    """A set-point scene with its mechanism, controller and start."""

    mechanism: Mechanism
    controller: SetPoint
    start: Start

    @property
    def level(self) -> float:
        """V_L at the start, J."""
        return level_of(self.mechanism, self.controller, self.start)

    def certificate(self, divisions: int = 50) -> Certificate:
        """Return the certificate of the gain condition for this start."""
        return certify(self.mechanism, self.controller, self.start, divisions)


def load_case(overrides: Mapping[str, Any] | None = None, scene: str | Path = SCENE) -> Case:
    """Load a set-point scene, with overrides by dotted key.

    Raises
    ------
    InputError
        The scene has no set-point controller.
    """
    loaded = load_scene(scene, overrides)
    mechanism = load_scene_mechanism(loaded)
    controller = build_scene_controller(loaded, mechanism)
    if not isinstance(controller, SetPoint):
        raise InputError(f"{loaded.name}: not a scene with set-point control (eq. 14)")
    return Case(mechanism, controller, find_start(mechanism, loaded))


def along_run(overrides: Mapping[str, Any], scene: str | Path = SCENE) -> tuple[Run, Record]:
    """Run a scene and compare the rate of V_L with -q_dot^T K_V q_dot."""
    case = load_case(overrides, scene)
    run = simulate(scene, overrides)
    q_dot = run.v_tree[:, [run.column(name) for name in run.independent]]
    return run, record(run, lambda k: -float(q_dot[k] @ case.controller.K_V @ q_dot[k]))


def gradient_error(mechanism: Mechanism, count: int, seed: int = 0, step: float = 1e-4) -> tuple[float, float, int]:
    """Compare dh/dq by the chain rule with central differences of h at random closed configurations.

    Returns
    -------
    error, asymmetry : float
        Largest difference from fourth-order central differences, and of dh/dq from its transpose, relative to |dh/dq|.
    used : int
        Number of configurations with |s| >= 0.05 that were reached.
    """
    random = np.random.default_rng(seed)
    error = asymmetry = 0.0
    used = 0
    for _ in range(count):
        at, _ = follow(mechanism, mechanism.assembled, random.uniform(-np.pi, np.pi, mechanism.d))
        if margin(at) < 0.05:
            continue
        used += 1

        def h(k: int, distance: float, at: Any = at) -> Any:
            dq = np.zeros(mechanism.d)
            dq[k] = distance
            return Terms(mechanism, follow(mechanism, at, dq)[0], np.zeros(mechanism.n)).h

        reach = step * margin(at) ** 2  # the curvature of h grows towards singular configurations
        columns = [
            (8 * (h(k, reach) - h(k, -reach)) - (h(k, 2 * reach) - h(k, -2 * reach))) / (12 * reach)
            for k in range(mechanism.d)
        ]
        gradient = h_gradient(mechanism, at)
        size = float(np.linalg.norm(gradient, 2))
        error = max(error, float(np.abs(np.column_stack(columns) - gradient).max()) / size)
        asymmetry = max(asymmetry, float(np.abs(gradient - gradient.T).max()) / size)
    return error, asymmetry, used


def bounds(mechanism: Mechanism, margins: Sequence[float] = MARGINS, divisions: int = 36) -> list[list[Bound]]:
    """Bound dh/dq on |s| >= s_min over each assembly branch, the assembled one first."""
    step = chart_step(mechanism, divisions)
    return [
        gradient_bounds(mechanism, explore_branch(mechanism, branch, divisions), margins, step)
        for branch in assembly_branches(mechanism)
    ]


def equilibria_of(case: Case, divisions: int = 16, starts: int = 80) -> list[Equilibrium]:
    """Return the solutions of eq. 15 in the sublevel set of a case's start, by Newton from points spread over it."""
    region = sublevel_set(case.mechanism, case.controller, case.level, divisions)
    nodes = region.explored.nodes[:: max(1, len(region.explored.nodes) // starts)]
    solutions = equilibria(case.mechanism, case.controller, nodes)
    return [solution for solution in solutions if solution.height <= case.level]
