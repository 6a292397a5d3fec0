"""Forces from inverse dynamics reproduce the motion, at each instant and in a forward run."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, Mechanism, MotionForces, Terms, inverse_dynamics
from ckc_pin.control.desired import Table
from ckc_pin.control.spec import SetPointSpec, TrackingSpec
from ckc_pin.mechanism.library import shipped
from ckc_pin.scene.names import list_scene_names
from ckc_pin.scene.parts import load_scene_mechanism
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.analytic.five_bar import Array
from tests.conftest import assert_close

CONTROLLED = [
    f"{mechanism}/{scene}"
    for mechanism in shipped()
    for scene in list_scene_names(mechanism)
    if isinstance(ckc_pin.load_scene(f"{mechanism}/{scene}").spec.controller, SetPointSpec | TrackingSpec)
]
T_END = {"andrews": 0.01}  # s; open-loop errors grow by e in 2 ms there, and rounding differs between machines
AT_REST = 1e-12  # relative to the fastest coordinate; rounding of a rate that is zero, as at a reversal
ROUNDED = 1e-9  # relative to the largest row of J; smaller rows count as zero


def waves(mechanism: Mechanism, t_end: float, size: float = 0.05) -> dict[str, Any]:
    """Overrides with which each independent coordinate oscillates about the assembled configuration."""
    numbers = mechanism.tree.named(mechanism.tree.to_coordinates(mechanism.q_tree))
    reach = mechanism.tree.named(mechanism.tree.step_scale)
    desired, rates = {}, {}
    for k, name in enumerate(mechanism.independent):
        amplitude = size * reach[name] * (1.0 + 0.1 * k)
        desired[name] = {"offset": numbers[name], "harmonics": [[amplitude, 4.0, 0.0]]}
        rates[name] = 4.0 * amplitude
    return {
        "controller": {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": desired},
        "initial": {"at": "assembled", "q_dot": rates},
        "formulation": "reduced",
        "t_end": t_end,
        "solver": {"output_dt": t_end / 50, "rtol": 1e-12, "atol": 1e-14},
    }


def forward(mechanism: Mechanism, terms: Terms, tau: Array) -> Array:
    """Solve eq. 1 and the twice differentiated closure as one scaled linear system for the acceleration and lambda."""
    J, n = terms.at.J, mechanism.n
    u_tree = mechanism.motors.force(tau)
    resting = np.abs(terms.v_tree) <= AT_REST * np.abs(terms.v_tree).max(initial=0.0)
    u_tree -= mechanism.joints.friction * np.where(resting, 0.0, np.sign(terms.v_tree))
    force = u_tree + terms.damping_force - terms.bias_tree
    unit = np.sqrt(np.abs(terms.D_tree).max() or 1.0)
    size = np.linalg.norm(J, axis=1, keepdims=True)
    size = np.where(size > ROUNDED * size.max(initial=0.0), size, 1.0)
    rows = J / size
    left_side = np.block([[terms.D_tree / unit**2, -rows.T], [rows, np.zeros((len(J), len(J)))]])
    closing = -(terms.J_dot @ terms.v_tree)[:, None] / size
    return np.linalg.lstsq(left_side, np.concatenate([force / unit**2, closing[:, 0]]), rcond=1e-13)[0][:n]


def assert_gives_back(forces: MotionForces) -> None:
    """Check that eq. 1 with the computed forces has the given acceleration at each instant."""
    mechanism = forces.mechanism
    for q, v, a, tau in zip(forces.q_tree, forces.v_tree, forces.a_tree, forces.tau, strict=True):
        terms = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(q)), v)
        assert_close(terms.at.J @ v, 0, 1e-10 * max(1.0, np.abs(v).max() * np.abs(terms.at.J).max(initial=0.0)))
        assert_close(forward(mechanism, terms, tau), a, 1e-9 * max(1.0, np.abs(a).max()))


class Prescribed:
    """u of eq. 6 as a function of time only."""

    def __init__(self, forces: MotionForces) -> None:
        mechanism, u = forces.mechanism, []
        for q, tau in zip(forces.q_tree, forces.tau, strict=True):
            rho = mechanism.kinematics(mechanism.tree.from_coordinates(q)).rho
            u.append(rho.T @ mechanism.motors.force(tau))
        self.table = Table(forces.t, np.array(u))

    def u(self, t: float, terms: Terms) -> Array:
        return self.table(t)[0]


def assert_integrates_back(scene: str | Path, overrides: dict[str, Any], forces: MotionForces) -> None:
    """Check that an open-loop run with the computed torques has the prescribed motion."""
    run = ckc_pin.simulate(scene, overrides, controller=Prescribed(forces))
    assert run.status == "done", run.message
    assert_close(run.t, forces.t, 0)
    for ours, theirs in ((run.q_tree, forces.q_tree), (run.v_tree, forces.v_tree)):
        assert_close(ours, theirs, 1e-9 * max(1.0, np.abs(theirs).max()))


@pytest.mark.parametrize("scene", CONTROLLED)
def test_inverse_dynamics_of_shipped_scenes_satisfies_eq_1(scene: str) -> None:
    assert len(CONTROLLED) >= 10
    forces = inverse_dynamics(scene, {"t_end": 1.0, "solver.output_dt": 0.05})
    assert forces.status == "done"
    assert len(forces.t) == 21
    assert_gives_back(forces)


@pytest.mark.parametrize("name", shipped())
def test_inverse_dynamics_reproduces_motion_of_shipped_mechanisms(name: str) -> None:
    overrides = waves(load_scene_mechanism(ckc_pin.load_scene(name)), T_END.get(name, 0.1))
    forces = inverse_dynamics(name, overrides)
    assert forces.status == "done"
    assert_gives_back(forces)
    assert_integrates_back(name, overrides, forces)


@pytest.mark.parametrize("seed", range(40))
def test_inverse_dynamics_reproduces_motion_of_random_mechanisms(seed: int, tmp_path: Path) -> None:
    """A free root that the loops leave free is moved by no motor and rejected by name."""
    scene = random_mechanism(seed).write(tmp_path / "random") / "default.scene.toml"
    mechanism = load_scene_mechanism(ckc_pin.load_scene(scene))
    overrides = waves(mechanism, 0.1)
    if mechanism.splits_root or mechanism.independent_root_coordinates:
        says = (
            "constrain a free root in part"
            if mechanism.splits_root
            else r"the motion along root\.\w+.* is driven by none"
        )
        with pytest.raises(InputError, match=says):
            inverse_dynamics(scene, overrides)
        return
    # Open-loop motions amplify rounding. They do so least along coordinates that determine the others well.
    file = scene.parent / "mechanism.toml"
    file.write_text(f"independent = {json.dumps(best_independent(mechanism))}\n{file.read_text()}")
    overrides = waves(load_scene_mechanism(ckc_pin.load_scene(scene)), 0.1)
    forces = inverse_dynamics(scene, overrides)
    assert forces.status == "done"
    assert_gives_back(forces)
    assert_integrates_back(scene, overrides, forces)


def best_independent(mechanism: Mechanism) -> list[str]:
    """Of all choices, the one whose phi_z has the largest smallest singular value. A free root depends on the loops."""
    J, everything = mechanism.assembled.J, range(mechanism.n)
    joints = [k for k in everything if "." not in mechanism.coordinates[k]]
    choices = [list(q) for q in combinations(joints, mechanism.d)]

    def conditioning(q: list[int]) -> float:
        z = [k for k in everything if k not in q]
        return float(np.linalg.svd(J[:, z], compute_uv=False)[len(z) - 1]) if z else 1.0

    return [mechanism.coordinates[k] for k in max(choices, key=conditioning)]
