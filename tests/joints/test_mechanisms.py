"""Friction and stops in mechanisms with loops: three formulations, and a time-stepping scheme of the tests' own."""

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

Made = Callable[..., Path]
NAMES = ("theta_1", "theta_2", "theta_3", "theta_4")
FRICTION = np.array([0.05, 0.02, 0.04, 0.03])
STOPS = {"arm_1": (-0.3, 1.2), "arm_2": (-0.4, 1.2), "arm_3": (-0.5, 1.2)}


def rubbing(with_joints: Made) -> Path:
    return with_joints("five_bar", {name: {"friction": float(f)} for name, f in zip(NAMES, FRICTION, strict=True)})


def alike(runs: dict[str, Run], tolerance: float) -> None:
    """All formulations give one motion, whose events are the same at the same times."""
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
def test_a_five_bar_with_friction_in_four_joints(with_joints: Made, seed: int) -> None:
    rng = np.random.default_rng(seed)
    folder = rubbing(with_joints)
    overrides = {
        "solver.rtol": 1e-12,
        "t_end": 3.0,
        "initial.q.theta_1": float(rng.uniform(-1.9, -0.9)),
        "initial.q.theta_3": float(rng.uniform(-2.2, -1.2)),
        "initial.q_dot": {"theta_1": float(rng.uniform(-2, 2)), "theta_3": float(rng.uniform(-2, 2))},
    }
    runs = {f: simulate(folder / "swing.scene.toml", {**overrides, "formulation": f}) for f in FORMULATIONS}
    assert len(runs["dae"].events) > 8
    alike(runs, 1e-8)


def test_a_time_stepping_scheme_converges_to_it(with_joints: Made) -> None:
    """Moreau's scheme, first order: velocities by a bounded least-squares problem a step, with the appendix's terms."""
    run = simulate(rubbing(with_joints) / "swing.scene.toml", {"solver.rtol": 1e-11, "t_end": 1.0})
    assert len(run.events) > 4
    steps = np.array([250, 1000, 4000])
    errors = np.array([np.abs(stepped(run.q_tree[0], 1.0, n) - run.q_tree[-1]).max() for n in steps])
    assert np.all(errors * steps < 1.0)  # of first order, if not evenly: when a joint turns is rounded to a step
    assert errors[-1] < errors[0] / 8


def stepped(q_tree: Array, duration: float, steps: int) -> Array:
    """Where the five-bar with friction is after a time, released from rest: q, q_dot and friction's impulses a step."""
    h, q, q_dot = duration / steps, q_tree[[0, 2]].copy(), np.zeros(2)
    for _ in range(steps):
        there = FIVE_BAR.sigma(q)
        rho, D = FIVE_BAR.rho(there), FIVE_BAR.D(there)
        free = q_dot - h * np.linalg.solve(D, FIVE_BAR.C(there, rho @ q_dot) @ q_dot + FIVE_BAR.h(there))
        # the impulses, within their bounds, that leave least kinetic energy: sticking where that can be
        root = np.linalg.cholesky(np.linalg.inv(D))
        found = lsq_linear(root.T @ rho.T, -np.linalg.solve(root, free), (-h * FRICTION, h * FRICTION), method="bvls")
        q_dot = free + np.linalg.solve(D, rho.T @ found.x)
        q = q + h * q_dot
    return np.asarray(FIVE_BAR.sigma(q))


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_a_delta_falls_on_its_stops(with_joints: Made, restitution: float) -> None:
    joints = {name: {"stops": True, "restitution": restitution} for name in STOPS}
    folder = with_joints("delta", joints, STOPS)
    overrides = {"solver.rtol": 1e-10, "t_end": 0.6}
    runs = {f: simulate(folder / "default.scene.toml", {**overrides, "formulation": f}) for f in FORMULATIONS}
    assert any(event["of"] == "stop" for event in runs["dae"].events)
    alike(runs, 1e-8)
    for name, (lower, upper) in STOPS.items():
        q = runs["dae"].q_tree[:, runs["dae"].column(name)]
        assert lower - 1e-10 <= q.min() <= q.max() <= upper + 1e-10


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_a_time_stepping_scheme_converges_to_the_delta_s_impacts(with_joints: Made, restitution: float) -> None:
    """First order, if not evenly: when an arm meets its stop is rounded to a step."""
    folder = with_joints("delta", {name: {"stops": True, "restitution": restitution} for name in STOPS}, STOPS)
    run = simulate(folder / "default.scene.toml", {"solver.rtol": 1e-11, "solver.output_dt": 0.0225, "t_end": 0.45})
    assert len(run.events) > 3
    arms = [run.column(name) for name in STOPS]
    delta, start = SteppingDelta(folder, STOPS, restitution), run.q_tree[0, arms]
    steps = np.array([400, 500, 640, 800, 1000, 1260, 1600, 2000])
    errors = [np.abs(delta.run(start, 0.45, n, 20) - run.q_tree[1:, arms]).mean() for n in steps]
    assert np.all(errors * steps < 2.5)
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] < -0.8


def test_a_simulator_meets_what_a_run_does(with_joints: Made) -> None:
    scene = rubbing(with_joints) / "swing.scene.toml"
    run = simulate(scene, {"solver.rtol": 1e-11, "t_end": 1.0})
    simulator = Simulator(scene, {"solver.rtol": 1e-11, "t_end": 1.0})
    for _ in range(40):
        state = simulator.step(None, 0.025)
    assert [event["name"] for event in simulator.events] == [event["name"] for event in run.events]
    assert_close([event["t"] for event in simulator.events], [event["t"] for event in run.events], 1e-9)
    assert_close(state.q_tree, run.q_tree[-1], 1e-9)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-7])
@pytest.mark.parametrize("method", ["auto", "RK45", "Radau"])
def test_at_every_tolerance_and_with_every_method(with_joints: Made, rtol: float, method: str) -> None:
    scene = rubbing(with_joints) / "swing.scene.toml"
    fine = simulate(scene, {"solver.rtol": 1e-12, "t_end": 0.8})
    run = simulate(scene, {"solver.rtol": rtol, "solver.method": method, "t_end": 0.8})
    assert run.status == "done"
    assert_close(run.q_tree[-1], fine.q_tree[-1], 30 * rtol)


@pytest.mark.parametrize("clock", [{}, {"sample_time": 0.005}, {"sample_time": 0.005, "delay": 0.002}])
def test_under_control_whoever_s_terms(with_joints: Made, clock: dict[str, float]) -> None:
    """It starts at rest, held by all four joints, and what is sampled lets it go at an instant of the clock."""
    scene = rubbing(with_joints) / "set_point.scene.toml"
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


def test_the_shipped_scene_that_rubs_and_stops() -> None:
    runs = [simulate("five_bar/friction", {"formulation": f, "solver.rtol": 1e-11}) for f in FORMULATIONS]
    one = runs[0]
    names = [event["name"] for event in one.events]
    assert {"theta_1 bounces", "theta_1 sticks", "theta_2 sticks", "theta_3 sticks"} < set(names)
    for run in runs:
        assert run.status == "done"
        assert [event["name"] for event in run.events] == names
        assert_close(run.q_tree, one.q_tree, 1e-8)
        assert run.max_phi < 1e-12
