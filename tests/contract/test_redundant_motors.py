"""Two arms on one bar: allocation of six forces to twelve motors by minimum norm, weights, preload and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from ckc_pin import Mechanism, Run, simulate
from ckc_pin.mechanism.library import library
from ckc_pin.native.control import allocate
from tests.analytic.five_bar import Array
from tests.conftest import assert_close

FORMULATIONS = ["reduced", "spf", "dae"]
LIFT = {"t_end": 0.5, "solver.rtol": 1e-10, "solver.output_dt": 0.05}
PRELOAD = {"left_elbow_joint": 10.0, "right_shoulder_pan_joint": -5.0}


def lift(**overrides: Any) -> Run:
    return simulate("two_ur5/lift", {**LIFT, **{name.replace("__", "."): x for name, x in overrides.items()}})


def transmission(mechanism: Mechanism, q_tree: Array) -> Array:
    """Return T of u = T tau from J of the mechanism's rows."""
    at = mechanism.kinematics(mechanism.tree.from_coordinates(q_tree))
    rates = np.zeros((mechanism.n, mechanism.d))
    rates[mechanism.partition.q] = np.eye(mechanism.d)
    rates[mechanism.partition.z] = -np.linalg.lstsq(at.phi_z, at.phi_q, rcond=None)[0]
    return rates[[mechanism.tree.index[name] for name in mechanism.actuated]].T


@pytest.fixture(scope="module")
def unlimited() -> Run:
    return lift()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_torques_have_minimum_norm(unlimited: Run, formulation: str) -> None:
    run = unlimited if formulation == "spf" else lift(formulation=formulation)
    for k, q_tree in enumerate(run.q_tree):
        T = transmission(run.mechanism, q_tree)
        assert T.shape == (6, 12)
        assert_close(run.tau[k], np.linalg.pinv(T) @ run.u[k], 1e-9)
    assert_close(run.q_tree, unlimited.q_tree, 1e-8)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_preload_does_not_change_the_motion(unlimited: Run, formulation: str) -> None:
    """tau differs by the projection of the preload on the null space; the motion is the same."""
    without = unlimited if formulation == "spf" else lift(formulation=formulation)
    run = lift(controller__allocation__preload=PRELOAD, formulation=formulation)
    assert_close(run.q_tree, without.q_tree, 1e-9)
    assert_close(run.u, without.u, 1e-8)
    preload = np.array([PRELOAD.get(name, 0.0) for name in run.actuated])
    for k, q_tree in enumerate(run.q_tree):
        T = transmission(run.mechanism, q_tree)
        null_space_part = preload - np.linalg.pinv(T) @ (T @ preload)
        assert np.abs(null_space_part).max() > 3.0
        assert_close(run.tau[k] - without.tau[k], null_space_part, 1e-8)


def test_large_weights_reduce_torques(unlimited: Run) -> None:
    """Torques with a weight of 1000 are hardly used, and the motion is the same."""
    tired = [name for name in unlimited.actuated if name.startswith("right")]
    run = lift(controller__allocation__weights=dict.fromkeys(tired, 1e3))
    assert_close(run.q_tree, unlimited.q_tree, 1e-9)
    scale = np.array([1e3 if name in tired else 1.0 for name in run.actuated]) ** -0.5
    for k, q_tree in enumerate(run.q_tree):
        T = transmission(run.mechanism, q_tree)
        assert_close(run.tau[k], scale * (np.linalg.pinv(T * scale) @ run.u[k]), 1e-8)
    assert np.abs(run.tau[:, 6:]).max() < 0.05 * np.abs(unlimited.tau[:, 6:]).max()


@pytest.mark.parametrize("limit", [21.0, 18.0])
def test_limited_torques_agree_with_the_reference(unlimited: Run, limit: float) -> None:
    """Compared with the NumPy reference; the motion is unchanged while other motors can compensate."""
    run = lift(controller__torque_limit=limit, controller__allocation__preload=PRELOAD)
    assert run.status == "done"
    assert np.abs(run.tau).max() == limit
    preload = np.array([PRELOAD.get(name, 0.0) for name in run.actuated])
    for k, q_tree in enumerate(run.q_tree):
        T = transmission(run.mechanism, q_tree)
        assert_close(T @ run.tau[k], run.u[k], 1e-9)
        if limit == 21.0:
            tau = allocate(T, unlimited.u[k], np.outer([-limit, limit], np.ones(12)), np.ones(12), preload)
            assert_close(run.tau[k], tau, 1e-7)
    off = np.abs(run.q_tree - unlimited.q_tree).max()
    assert off < 1e-9 if limit == 21.0 else off > 1e-5


def test_unreachable_u_has_minimum_error() -> None:
    """Where no tau within limits gives u, the scaled error is close to the minimum."""
    limit = 12.0
    overrides = {"t_end": 1e-3, "controller.torque_limit": limit}
    run, free = simulate("two_ur5/lift", overrides), simulate("two_ur5/lift", {"t_end": 1e-3})
    assert np.abs(free.tau[0]).max() > 20
    T = transmission(run.mechanism, run.q_tree[0])
    rows = 1 / np.linalg.norm(T, axis=1)
    result = lsq_linear(T * rows[:, None], free.u[0] * rows, (-limit, limit), method="bvls", tol=1e-15)
    assert result.cost > 1e-3
    missed = 0.5 * np.sum((rows * (T @ run.tau[0] - free.u[0])) ** 2)
    assert result.cost <= missed < result.cost * (1 + 1e-4)
    assert np.all(np.abs(run.tau) <= limit)
    assert_close(
        run.tau[0], allocate(T, free.u[0], np.outer([-limit, limit], np.ones(12)), np.ones(12), np.zeros(12)), 1e-7
    )


def test_motor_table_limits_apply(tmp_path: Path) -> None:
    """[[motor]] instead of actuated: names, and limits below the controller's."""
    text = (library() / "two_ur5" / "mechanism.toml").read_text("utf-8")
    before, _, rest = text.partition("actuated = [")
    names = [line.strip(' ",') for part in rest.partition("]")[0].split(",") for line in [part] if line.strip()]
    names = [name.strip().strip('"') for name in names]
    assert len(names) == 12
    motors = "".join(
        f'[[motor]]\nname = "{name}_motor"\njoint = "{name}"\nratio = -100.0\ntorque_limit = 0.25\n' for name in names
    )
    (tmp_path / "mechanism.toml").write_text(before + motors + rest.partition("]\n")[2], "utf-8")
    (tmp_path / "load.urdf").write_text((library() / "two_ur5" / "load.urdf").read_text("utf-8"), "utf-8")
    scene = (library() / "two_ur5" / "lift.scene.toml").read_text("utf-8")
    (tmp_path / "lift.scene.toml").write_text(scene, "utf-8")
    run = simulate(tmp_path / "lift.scene.toml", {**LIFT, "controller.torque_limit": 1.0})
    joints = lift(controller__torque_limit=25.0)
    assert run.actuated == tuple(f"{name}_motor" for name in names)
    assert_close(run.q_tree, joints.q_tree, 1e-9)
    assert_close(run.tau, -0.01 * joints.tau, 1e-9)
