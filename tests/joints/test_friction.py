"""Dry friction against closed forms: times of sliding and sticking, and dissipated energy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from scipy.optimize import brentq, linprog

from ckc_pin import InputError, Run, Terms, as_ivp, ensemble, load, simulate
from tests.conftest import assert_close
from tests.joints.conftest import FORMULATIONS, Make, slide

TIGHT = {"solver.rtol": 1e-12}


def event_times(run: Run, name: str) -> list[float]:
    """Return the times of the events of a name."""
    return [float(event["t"]) for event in run.events if event["name"] == name]


def oscillator(scene_of: Make, mass: float, stiffness: float, friction: float, x: float, t_end: float) -> Path:
    joint = f'[[joint]]\nname = "x"\nfriction = {friction!r}\n'
    spring = f'[[spring]]\njoint = "x"\nstiffness = {stiffness!r}\n'
    return scene_of(slide("x", "base", "block", mass), spring + joint, f"q = {{x = {x!r}}}\n", t_end)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("seed", range(4))
def test_coulomb_damped_oscillator_reverses_every_half_period(scene_of: Make, formulation: str, seed: int) -> None:
    """Each half swing is a cosine about a shifted centre, and its amplitude is 2 F / k smaller than the one before."""
    rng = np.random.default_rng(seed)
    mass, stiffness = float(rng.uniform(0.1, 10.0)), float(rng.uniform(1.0, 1e3))
    start = float(rng.uniform(0.5, 2.0) * rng.choice([-1, 1]))
    friction = float(stiffness * abs(start) / rng.uniform(2.5, 12.0))
    half = np.pi * np.sqrt(mass / stiffness)
    turns, x = [0.0], start
    while abs(stiffness * x) > friction:
        x = -np.sign(x) * (abs(x) - 2 * friction / stiffness)
        turns.append(turns[-1] + half)
    scene = oscillator(scene_of, mass, stiffness, friction, start, turns[-1] + half)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    assert run.status == "done"
    assert_close(event_times(run, "x slides"), turns[:-1], 1e-10)
    assert_close(event_times(run, "x sticks"), turns[-1:], 1e-10)
    assert_close(run.q_tree[-1], [x], 1e-10)
    assert_close(run.v_tree[-1], [0.0], 1e-15)
    assert run.dissipated is not None
    travelled = sum(abs(start) * 2 - (2 * k + 1) * 2 * friction / stiffness for k in range(len(turns) - 1))
    assert_close(run.dissipated[-1], friction * travelled, 1e-10)
    assert_close(run.energy + run.dissipated, np.full(len(run.t), run.energy[0]), 1e-9 * run.energy[0])


def test_a_block_sticks_if_the_spring_force_is_below_friction(scene_of: Make) -> None:
    scene = oscillator(scene_of, 1.0, 100.0, 10.0, 0.0999, 2.0)
    run = simulate(scene, TIGHT)
    assert [event["name"] for event in run.events] == ["x sticks"]
    assert np.all(run.q_tree == 0.0999)
    moved = simulate(scene, {**TIGHT, "initial.q.x": 0.1001})
    assert [event["name"] for event in moved.events] == ["x slides", "x sticks"]
    assert_close(moved.q_tree[-1], [0.0999], 1e-12)  # half a period of 1e-4 about 0.1


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_stick_slip_times_of_a_block_on_a_belt(scene_of: Make, formulation: str) -> None:
    """The belt has finite mass, so that both phases are cosines. The test solves for their ends itself."""
    m, M, k, F, speed = 1.3, 40.0, 55.0, 6.0, 0.7
    urdf = slide("belt", "base", "b", M) + slide("x", "b", "block", m)
    spring = '[[spring]]\nframe_a = "block"\nframe_b = {link = "base", xyz = [-50.0, 0.0, 0.0]}\nrest_length = 50.0\n'
    mechanism = f'{spring}stiffness = {k}\n[[joint]]\nname = "x"\nfriction = {F}\n'
    scene = scene_of(urdf, mechanism, f"q = {{belt = 0.0, x = 0.0}}\nq_dot = {{belt = {speed}, x = 0.0}}\n", 12.0)
    run = simulate(scene, {**TIGHT, "formulation": formulation})
    slips, sticks = belt_phases(m, M, k, F, speed, 12.0)
    assert len(slips) > 3
    assert_close(event_times(run, "x slides"), slips, 1e-10)
    assert_close(event_times(run, "x sticks"), [0.0, *sticks], 1e-10)


def belt_phases(m: float, M: float, k: float, F: float, speed: float, t_end: float) -> tuple[list[float], list[float]]:
    """Return the times at which the block begins to slip on the belt, and at which it sticks again."""
    slips, sticks = [], []
    t, x, v = 0.0, 0.0, speed  # of the block in the world
    while True:
        together = np.sqrt(k / (m + M))  # sticking: one body on the spring, until the friction force reaches F
        size, phase = np.hypot(x, v / together), np.arctan2(v / together, x)
        max_stretch = F * (m + M) / (k * M)
        if size <= max_stretch:
            return slips, sticks
        wait = (phase - np.arccos(max_stretch / size)) / together
        if x > max_stretch or wait < 0:
            raise AssertionError("the phases do not alternate as this test assumes")
        t, x, v = t + wait, max_stretch, -size * together * np.sin(together * wait - phase)
        if t > t_end:
            return slips, sticks
        slips.append(t)
        alone = np.sqrt(k / m)  # slipping: friction F accelerates the block and slows the belt down
        a, b = x - F / k, v / alone
        belt = v

        def gap(s: float, a: float = a, b: float = b, belt: float = belt, w: float = alone) -> float:
            return float(w * (b * np.cos(w * s) - a * np.sin(w * s)) - (belt - F / M * s))

        low = 0.05 / alone
        while gap(low) > 0 or gap(low + 0.05 / alone) <= 0:
            low += 0.05 / alone
        s = brentq(gap, low, low + 0.05 / alone, xtol=1e-15, rtol=1e-14)
        t, x, v = t + s, F / k + a * np.cos(alone * s) + b * np.sin(alone * s), belt - F / M * s
        if t > t_end:
            return slips, sticks
        sticks.append(t)


def test_smoothed_friction_is_integrated_as_an_ode(scene_of: Make) -> None:
    """The reference is F tanh(v / v_s), integrated by SciPy."""
    scene = oscillator(scene_of, 2.0, 200.0, 30.0, 1.0, 1.2)
    run = simulate(scene, {"solver.rtol": 1e-9, "friction_smoothing": 1e-2})
    assert run.events == []
    assert run.dissipated is None
    other = solve_ivp(
        lambda _, y: [y[1], (-200 * y[0] - 30 * np.tanh(y[1] / 1e-2)) / 2],
        (0, 1.2), [1.0, 0.0], "Radau", rtol=1e-10, atol=1e-12, t_eval=run.t,
    )  # fmt: skip
    assert_close(run.q_tree[:, 0], other.y[0], 1e-7)


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_energy_decreases_by_the_work_of_smoothed_friction(with_joints: Callable[..., Path], formulation: str) -> None:
    """The work is the integral of F tanh(v / rate) v by Simpson's rule over the output instants."""
    F, rate, step = 0.02, 0.3, 1e-3
    scene = with_joints("five_bar", {name: {"friction": F} for name in ("theta_1", "theta_4")}) / "swing.scene.toml"
    overrides = {"formulation": formulation, "friction_smoothing": rate, "t_end": 1.0}
    run = simulate(scene, {**overrides, "solver.rtol": 1e-10, "solver.output_dt": step})
    v = run.v_tree[:, [run.coordinates.index(name) for name in ("theta_1", "theta_4")]]
    work = simpson((F * np.tanh(v / rate) * v).sum(axis=1), dx=step)
    assert work > 0.01
    assert_close(run.energy[-1] + work, run.energy[0], 1e-8)


def test_dissipated_energy_is_not_reported_with_smoothed_friction(with_joints: Callable[..., Path]) -> None:
    """Nor with stops in addition: it would be the energy of the impacts alone."""
    limits = {"theta_1": (-2.0, 2.0)}
    folder = with_joints("five_bar", {"theta_1": {"friction": 0.02, "stops": True}}, limits)
    scene = folder / "swing.scene.toml"
    results = ensemble(
        scene, {"friction_smoothing": [0.1]}, {"end": "dissipated", "most": {"of": "dissipated", "reduce": "max"},
        "path": {"of": "dissipated", "reduce": "trajectory"}}, overrides={"t_end": 0.01}, progress=False,
    )  # fmt: skip
    assert simulate(scene, {"t_end": 0.01}).dissipated is not None
    assert simulate(scene, {"t_end": 0.01, "friction_smoothing": 0.1}).dissipated is None
    assert results["status"].to_numpy().tolist() == [1]
    assert all(np.isnan(results[name].to_numpy()).all() for name in ("end", "most", "path"))


def test_motion_is_unique_where_friction_forces_are_not(with_joints: Callable[..., Path]) -> None:
    """Four joints of a five-bar with two freedoms stick until no friction forces within bounds are in equilibrium.

    That is a linear program in the forces, whose value is one when the joints begin to slide.
    """
    friction = np.array([0.2, 0.5, 0.35, 0.4])
    names = ("theta_1", "theta_2", "theta_3", "theta_4")
    folder = with_joints("five_bar", {name: {"friction": float(f)} for name, f in zip(names, friction, strict=True)})
    push = np.array([1.7, -0.9])

    class Ramp:
        def u(self, t: float, terms: Terms) -> np.ndarray:
            return np.asarray(t * push)

    run = simulate(folder / "set_point.scene.toml", {**TIGHT, "t_end": 0.8}, controller=Ramp())
    assert [event["name"] for event in run.events[:4]] == [f"{name} sticks" for name in names]
    assert {event["t"] for event in run.events[:4]} == {0.0}
    mechanism = load(folder)
    terms = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(run.q_tree[0])), np.zeros(4))
    resting = run.t < run.events[4]["t"]
    assert_close(run.q_tree[resting], np.tile(run.q_tree[0], (resting.sum(), 1)), 1e-13)

    def load_factor(t: float) -> float:
        """Return the smallest fraction of all friction forces that is in equilibrium."""
        needed = t * push - terms.rho.T @ terms.h_tree
        program = linprog(
            [0, 0, 0, 0, 1],
            A_ub=np.vstack([np.c_[np.eye(4), -friction], np.c_[-np.eye(4), -friction]]), b_ub=np.zeros(8),
            A_eq=np.c_[terms.rho.T, np.zeros(2)], b_eq=-needed, bounds=[(None, None)] * 4 + [(0, None)],
        )  # fmt: skip
        return float(program.x[4])

    assert load_factor(0.0) < 1.0
    assert_close(run.events[4]["t"], brentq(lambda t: load_factor(t) - 1.0, 0.0, 0.8, xtol=1e-12), 1e-8)


def test_options_that_sticking_joints_exclude_are_refused(scene_of: Make, with_joints: Callable[..., Path]) -> None:
    scene = oscillator(scene_of, 1.0, 100.0, 10.0, 1.0, 1.0)
    with pytest.raises(InputError, match="does not close the loops exactly"):
        simulate(scene, {"formulation": "spf", "spf_coordinates": "z"})
    with pytest.raises(InputError, match="stick or have stops, whose forces are not a function"):
        as_ivp(scene)
    folder = with_joints("five_bar", {"theta_1": {"friction": 0.1}})
    with pytest.raises(InputError, match=r"initial\.w: joints of five_bar that stick or rest at stops cannot be held"):
        simulate(folder / "swing.scene.toml", {"formulation": "spf", "initial.w": [0.01, 0.0]})
