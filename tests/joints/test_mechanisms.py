"""Friction and stops in mechanisms with loops: three formulations against each other and against time stepping."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from ckc_pin import Run, Simulator, load, simulate
from ckc_pin.codegen.library import compile_terms
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import assert_close
from tests.joints.conftest import FORMULATIONS
from tests.joints.stepping_delta import SteppingDelta

WriteMechanism = Callable[..., Path]
NAMES = ("theta_1", "theta_2", "theta_3", "theta_4")
FRICTION = np.array([0.05, 0.02, 0.04, 0.03])
STOPS = {"arm_1": (-0.3, 1.2), "arm_2": (-0.4, 1.2), "arm_3": (-0.5, 1.2)}


def write_five_bar_with_friction(with_joints: WriteMechanism) -> Path:
    return with_joints("five_bar", {name: {"friction": float(f)} for name, f in zip(NAMES, FRICTION, strict=True)})


def assert_same_motion(runs: dict[str, Run], tolerance: float) -> None:
    """Assert that all formulations give the same motion with the same events."""
    one = runs["dae"]
    names = [event["name"] for event in one.events]
    for run in runs.values():
        assert run.status == "done"
        assert sorted(event["name"] for event in run.events) == sorted(names)
        assert_close([event["t"] for event in run.events], [event["t"] for event in one.events], tolerance)
        assert_close(run.q_tree, one.q_tree, tolerance)
        assert run.max_phi < 1e-12
        assert run.dissipated is not None
        assert np.all(np.diff(run.dissipated) > -1e-12)
        assert_close(run.energy + run.dissipated, np.full(len(run.t), run.energy[0]), 1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_formulations_agree_on_a_five_bar_with_friction_in_four_joints(with_joints: WriteMechanism, seed: int) -> None:
    rng = np.random.default_rng(seed)
    folder = write_five_bar_with_friction(with_joints)
    overrides = {
        "solver.rtol": 1e-12,
        "t_end": 3.0,
        "initial.q.theta_1": float(rng.uniform(-1.9, -0.9)),
        "initial.q.theta_3": float(rng.uniform(-2.2, -1.2)),
        "initial.q_dot": {"theta_1": float(rng.uniform(-2, 2)), "theta_3": float(rng.uniform(-2, 2))},
    }
    runs = {f: simulate(folder / "swing.scene.toml", {**overrides, "formulation": f}) for f in FORMULATIONS}
    assert len(runs["dae"].events) > 8
    assert_same_motion(runs, 1e-8)


def test_time_stepping_converges_to_the_motion_with_friction(with_joints: WriteMechanism) -> None:
    """Moreau's scheme with the appendix's terms, of first order; each step solves a bounded least-squares problem."""
    run = simulate(write_five_bar_with_friction(with_joints) / "swing.scene.toml", {"solver.rtol": 1e-11, "t_end": 1.0})
    assert len(run.events) > 4
    steps = np.array([250, 1000, 4000])
    errors = np.array([np.abs(time_stepping(run.q_tree[0], 1.0, n) - run.q_tree[-1]).max() for n in steps])
    assert np.all(errors * steps < 1.0)  # first order, but not smoothly: times of reversal are rounded to a step
    assert errors[-1] < errors[0] / 8


def time_stepping(q_tree: Array, duration: float, steps: int) -> Array:
    """Return the configuration of the five-bar with friction a time after its release from rest, by time stepping."""
    h, q, q_dot = duration / steps, q_tree[[0, 2]].copy(), np.zeros(2)
    for _ in range(steps):
        there = FIVE_BAR.sigma(q)
        rho, D = FIVE_BAR.rho(there), FIVE_BAR.D(there)
        free = q_dot - h * np.linalg.solve(D, FIVE_BAR.force(there, q_dot, np.zeros(2)))
        # the impulses within their bounds that minimize the kinetic energy: joints stick if they can
        root = np.linalg.cholesky(np.linalg.inv(D))
        impulses = lsq_linear(
            root.T @ rho.T, -np.linalg.solve(root, free), (-h * FRICTION, h * FRICTION), method="bvls"
        )
        q_dot = free + np.linalg.solve(D, rho.T @ impulses.x)
        q = q + h * q_dot
    return np.asarray(FIVE_BAR.sigma(q))


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_formulations_agree_on_a_delta_that_falls_on_its_stops(with_joints: WriteMechanism, restitution: float) -> None:
    joints = {name: {"stops": True, "restitution": restitution} for name in STOPS}
    folder = with_joints("delta", joints, STOPS)
    overrides = {"solver.rtol": 1e-10, "t_end": 0.6}
    runs = {f: simulate(folder / "default.scene.toml", {**overrides, "formulation": f}) for f in FORMULATIONS}
    assert any(event["of"] == "stop" for event in runs["dae"].events)
    assert_same_motion(runs, 1e-8)
    for name, (lower, upper) in STOPS.items():
        q = runs["dae"].q_tree[:, runs["dae"].column(name)]
        assert lower - 1e-10 <= q.min() <= q.max() <= upper + 1e-10


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_time_stepping_converges_to_the_impacts_of_a_delta(with_joints: WriteMechanism, restitution: float) -> None:
    """First order, but not smoothly: times of impacts are rounded to a step."""
    folder = with_joints("delta", {name: {"stops": True, "restitution": restitution} for name in STOPS}, STOPS)
    run = simulate(folder / "default.scene.toml", {"solver.rtol": 1e-11, "solver.output_dt": 0.0225, "t_end": 0.45})
    assert len(run.events) > 3
    arms = [run.column(name) for name in STOPS]
    delta, start = SteppingDelta(folder, STOPS, restitution), run.q_tree[0, arms]
    steps = np.array([400, 500, 640, 800, 1000, 1260, 1600, 2000])
    errors = [np.abs(delta.run(start, 0.45, n, 20) - run.q_tree[1:, arms]).mean() for n in steps]
    assert np.all(errors * steps < 2.5)
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] < -0.8


def test_simulator_finds_the_events_of_a_run(with_joints: WriteMechanism) -> None:
    scene = write_five_bar_with_friction(with_joints) / "swing.scene.toml"
    run = simulate(scene, {"solver.rtol": 1e-11, "t_end": 1.0})
    simulator = Simulator(scene, {"solver.rtol": 1e-11, "t_end": 1.0})
    for _ in range(40):
        state = simulator.step(None, 0.025)
    assert [event["name"] for event in simulator.events] == [event["name"] for event in run.events]
    assert_close([event["t"] for event in simulator.events], [event["t"] for event in run.events], 1e-9)
    assert_close(state.q_tree, run.q_tree[-1], 1e-9)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-7])
@pytest.mark.parametrize("method", ["auto", "RK45", "Radau"])
def test_friction_with_all_methods_and_tolerances(with_joints: WriteMechanism, rtol: float, method: str) -> None:
    scene = write_five_bar_with_friction(with_joints) / "swing.scene.toml"
    fine = simulate(scene, {"solver.rtol": 1e-12, "t_end": 0.8})
    run = simulate(scene, {"solver.rtol": rtol, "solver.method": method, "t_end": 0.8})
    assert run.status == "done"
    assert_close(run.q_tree[-1], fine.q_tree[-1], 30 * rtol)


@pytest.mark.parametrize("clock", [{}, {"sample_time": 0.005}, {"sample_time": 0.005, "delay": 0.002}])
def test_friction_under_control_with_compiled_and_pinocchios_terms(
    with_joints: WriteMechanism, clock: dict[str, float]
) -> None:
    """All four joints stick at the start. A sampled controller makes them slide at a sampling instant."""
    scene = write_five_bar_with_friction(with_joints) / "set_point.scene.toml"
    compile_terms(load(scene.parent))
    overrides = {f"controller.{key}": value for key, value in clock.items()}
    runs = [
        simulate(scene, {**overrides, "formulation": f, "solver.terms": terms, "t_end": 1.0, "solver.rtol": 1e-10})
        for f in ("dae", "reduced")
        for terms in ("pinocchio", "generated")
    ]
    for run in runs:
        assert run.status == "done", run.message
        assert [event["name"] for event in run.events] == [event["name"] for event in runs[0].events]
        assert_close(run.q_tree, runs[0].q_tree, 1e-8)


def test_formulations_agree_on_the_shipped_friction_scene() -> None:
    runs = [simulate("five_bar/friction", {"formulation": f, "solver.rtol": 1e-11}) for f in FORMULATIONS]
    one = runs[0]
    names = [event["name"] for event in one.events]
    assert {"theta_1 bounces", "theta_1 sticks", "theta_2 sticks", "theta_3 sticks"} < set(names)
    for run in runs:
        assert run.status == "done"
        assert [event["name"] for event in run.events] == names
        assert_close(run.q_tree, one.q_tree, 1e-8)
        assert run.max_phi < 1e-12
