"""Joints whose motion is prescribed: the five-bar with its left crank eliminated by hand, and a driven slider-crank."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from scipy.optimize import brentq

from ckc_pin import (
    CkcError,
    InputError,
    Run,
    Simulator,
    check,
    inverse_dynamics,
    linearize,
    load,
    plot,
    sensitivities,
    simulate,
)
from ckc_pin.control.desired import Harmonics
from ckc_pin.control.spec import MotionSpec
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import assert_close, remember

pytestmark = pytest.mark.usefixtures("either_terms")

FORMULATIONS = ["dae", "reduced", "spf"]
WAVES = {"offset": -1.4, "harmonics": [[0.3, 5.0, 0.4], [0.05, 13.0, -0.3]]}
START = {"theta_1": -1.4 + 0.3 * math.sin(0.4) + 0.05 * math.sin(-0.3), "theta_3": -1.7}
RATE = 0.8  # rad/s, of theta_3 at the start


def scene(formulation: str, **overrides: Any) -> dict[str, Any]:
    return {
        "formulation": formulation,
        "t_end": 1.5,
        "prescribed": [{"joint": "theta_1", **WAVES}],
        "initial": {"q": START, "q_dot": {"theta_3": RATE}},
        "solver": {"rtol": 1e-11, "output_dt": 0.05},
        **overrides,
    }


def left_crank(t: float) -> tuple[float, float, float]:
    waves = np.array(WAVES["harmonics"])
    angle = waves[:, 1] * t + waves[:, 2]
    return (
        float(WAVES["offset"] + waves[:, 0] @ np.sin(angle)),  # type: ignore[operator]
        float((waves[:, 0] * waves[:, 1]) @ np.cos(angle)),
        float(-(waves[:, 0] * waves[:, 1] ** 2) @ np.sin(angle)),
    )


@remember
def eliminated(times: Array) -> tuple[Array, Array, Array]:
    """q', v' and the left crank's torque of the reduced model with the left crank's motion inserted by hand."""

    def state(t: float, y: Array) -> tuple[Array, Array, float, float]:
        q_1, q_1_dot, q_1_ddot = left_crank(t)
        q_tree, q_dot = FIVE_BAR.sigma(np.array([q_1, y[0]])), np.array([q_1_dot, y[1]])
        v_tree = FIVE_BAR.rho(q_tree) @ q_dot
        D, rest = FIVE_BAR.D(q_tree), FIVE_BAR.force(q_tree, q_dot, np.zeros(2))
        q_3_ddot = (-rest[1] - D[1, 0] * q_1_ddot) / D[1, 1]
        return q_tree, v_tree, q_3_ddot, D[0] @ [q_1_ddot, q_3_ddot] + rest[0]

    motion = solve_ivp(
        lambda t, y: [y[1], state(t, y)[2]],
        (0, times[-1]),
        [START["theta_3"], RATE],
        "DOP853",
        times,
        rtol=1e-13,
        atol=1e-14,
    )
    states = [state(t, y) for t, y in zip(times, motion.y.T, strict=True)]
    return tuple(np.array([x[k] for x in states]) for k in (0, 1, 3))  # type: ignore[return-value]


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["auto", "Radau"])
def test_motion_and_torque_are_those_of_the_problem_with_the_joint_eliminated(formulation: str, method: str) -> None:
    run = simulate("five_bar/swing", scene(formulation, solver={"rtol": 1e-11, "output_dt": 0.05, "method": method}))
    q_tree, v_tree, tau = eliminated(run.t)
    assert run.status == "done"
    assert run.independent == ("theta_3",)
    turns = 2 * np.pi * np.round((run.q_tree - q_tree) / (2 * np.pi))
    assert_close(run.q_tree - turns, q_tree, 1e-9)
    assert_close(run.v_tree, v_tree, 2e-8)
    assert_close(run.tau[:, run.actuated.index("theta_1")], tau, 1e-7)
    assert_close(run["theta_1"], [left_crank(t)[0] for t in run.t], 1e-12)
    assert run.max_phi < 1e-12
    assert run.max_phi_dot < 1e-9


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_accelerations_and_loop_forces_contain_the_prescribed_motion(formulation: str, friction: float) -> None:
    """Eq. 1 of the appendix at the recorded states, with the left crank's motion inserted by hand."""
    parameters = {"joint.theta_1.friction": friction}
    run = simulate("five_bar/swing", scene(formulation, parameters=parameters))
    accelerations = np.column_stack([run[f"a.{name}"] for name in run.coordinates])
    loop_forces, forces = run.loop_forces()["elbow"], inverse_dynamics(run)
    assert_close(forces.a_tree, accelerations, 1e-9)
    assert_close(forces.tau, run.tau, 1e-7)
    for t, q_tree, v_tree, acceleration, multipliers in zip(
        run.t, run.q_tree, run.v_tree, accelerations, loop_forces, strict=True
    ):
        q_dot = v_tree[[0, 2]]
        D, rest = FIVE_BAR.D(q_tree), FIVE_BAR.force(q_tree, q_dot, np.zeros(2))
        q_1_ddot = left_crank(float(t))[2]
        q_ddot = np.array([q_1_ddot, (-rest[1] - D[1, 0] * q_1_ddot) / D[1, 1]])
        a_tree = FIVE_BAR.rho(q_tree) @ q_ddot + FIVE_BAR.rho_dot(q_tree, v_tree) @ q_dot
        assert_close(acceleration, a_tree, 1e-7)
        force = FIVE_BAR.D_tree(q_tree) @ a_tree + FIVE_BAR.C_tree(q_tree, v_tree) @ v_tree + FIVE_BAR.h_tree(q_tree)
        assert_close(multipliers, np.linalg.solve(FIVE_BAR.J(q_tree)[:, [1, 3]].T, force[[1, 3]]), 1e-7)


def test_linear_model_is_that_of_the_problem_with_the_joint_eliminated() -> None:
    t = 0.65
    model = linearize("five_bar/swing", t, scene("reduced"))
    assert len(model.A) == 2
    q_1, q_1_dot, q_1_ddot = left_crank(t)

    def acceleration(q_3: float, q_3_dot: float, tau: float = 0.0) -> float:
        q_tree, q_dot = FIVE_BAR.sigma(np.array([q_1, q_3])), np.array([q_1_dot, q_3_dot])
        D = FIVE_BAR.D(q_tree)
        rest = FIVE_BAR.C(q_tree, FIVE_BAR.rho(q_tree) @ q_dot) @ q_dot + FIVE_BAR.h(q_tree)
        return float((tau - rest[1] - D[1, 0] * q_1_ddot) / D[1, 1])

    q_3, rate, e = model.q_tree[2], model.v_tree[2], 1e-5
    by_q = (acceleration(q_3 + e, rate) - acceleration(q_3 - e, rate)) / (2 * e)
    by_rate = (acceleration(q_3, rate + e) - acceleration(q_3, rate - e)) / (2 * e)
    by_tau = acceleration(q_3, rate, 1.0) - acceleration(q_3, rate)
    assert_close(model.A, [[0.0, 1.0], [by_q, by_rate]], 1e-5)
    crank, other = (model.inputs.index(name) for name in model.inputs)
    assert_close(model.B[1, [crank, other]], [0.0, by_tau], 1e-8)


def test_linear_model_at_rest_keeps_the_prescribed_joint_at_its_start() -> None:
    model = linearize("five_bar/swing", "equilibrium", scene("reduced"))
    assert_close(model.q_tree[0], START["theta_1"], 1e-12)
    assert len(model.A) == 2
    assert "at rest at the position where the prescribed motion begins: theta_1" in model.notes


def test_inverse_dynamics_of_a_scene_with_prescribed_joints_asks_for_its_run() -> None:
    with pytest.raises(InputError, match="give a run of the scene instead"):
        inverse_dynamics("five_bar/swing", scene("reduced"))


def test_a_prescribed_joint_costs_no_more_steps_than_the_eliminated_problem() -> None:
    free = simulate("five_bar/swing", {**scene("reduced"), "prescribed": []})
    driven = simulate("five_bar/swing", scene("reduced"))
    assert driven.stats["python_calls"] == 0
    assert driven.stats["rhs"] <= 1.2 * free.stats["rhs"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_steps_agree_with_the_run(formulation: str) -> None:
    run, simulator = simulate("five_bar/swing", scene(formulation)), Simulator("five_bar/swing", scene(formulation))
    for k in range(1, len(run.t)):
        state = simulator.step(None, 0.05)
        assert_close(state.q_tree, run.q_tree[k], 1e-8)
    simulator.reset(state)
    assert_close(simulator.state.v_tree, state.v_tree, 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_events_of_a_prescribed_joint_are_at_their_exact_times(formulation: str) -> None:
    events = [{"coordinate": "theta_1", "value": -1.2}, {"coordinate": "theta_1", "of": "q_dot", "value": 0.0}]
    run = simulate("five_bar/swing", scene(formulation, t_end=0.3, event=events))
    expected = [brentq(lambda t: left_crank(t)[0] + 1.2, 0.0, 0.1), brentq(lambda t: left_crank(t)[1], 0.1, 0.3)]
    assert_close(np.array([event["t"] for event in run.events]), np.array(expected), 1e-9)


def test_dry_friction_beside_a_prescribed_joint_agrees_between_formulations() -> None:
    friction = {"joint.theta_3.friction": 0.05, "joint.theta_1.friction": 0.1}
    runs = [simulate("five_bar/swing", scene(formulation, parameters=friction)) for formulation in FORMULATIONS]
    without = simulate("five_bar/swing", scene("dae", parameters={"joint.theta_3.friction": 0.05}))
    for run in runs:
        assert [event["name"] for event in run.events] == ["theta_3 slides"] * 4
        assert_close(np.array([x["t"] for x in run.events]), np.array([x["t"] for x in runs[0].events]), 1e-8)
        assert_close(run.q_tree, runs[0].q_tree, 1e-8)
    crank = runs[0].actuated.index("theta_1")
    rate = runs[0].v_tree[:, 0]
    assert_close(runs[0].tau[:, crank] - without.tau[:, crank], 0.1 * np.sign(rate), 1e-7)


# --- slider-crank, without any freedom -----------------------------------------------------------

CRANK, ROD = 0.1, 0.3  # m, of the shipped slider-crank


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("motion", ["waves", "rate", "waypoints"])
def test_driven_slider_crank_follows_its_closed_form(formulation: str, motion: str) -> None:
    keys: dict[str, dict[str, Any]] = {
        "waves": {"offset": 0.5, "harmonics": [[2.0, 3.0, 0.0]]},
        "rate": {"offset": 0.5, "rate": 5.0},
        "waypoints": {"waypoints": [[0.2, 0.5], [1.7, 4.0]]},
    }
    overrides = {
        "formulation": formulation,
        "prescribed": [{"joint": "crank", **keys[motion]}],
        "t_end": 2.0,
        "initial": {"at": "assembled"},
        "solver": {"rtol": 1e-10, "output_dt": 1e-3, "max_rhs": 20000},
    }
    run = simulate("slider_crank", overrides)
    assert (run.status, run.independent) == ("done", ())
    s = np.clip((run.t - 0.2) / 1.5, 0, 1)
    angle = {
        "waves": 0.5 + 2.0 * np.sin(3.0 * run.t),
        "rate": 0.5 + 5.0 * run.t,
        "waypoints": 0.5 + 3.5 * (10 * s**3 - 15 * s**4 + 6 * s**5),
    }[motion]
    assert_close(run["crank"], angle, 1e-12)
    place = CRANK * np.cos(angle) + np.sqrt(ROD**2 - (CRANK * np.sin(angle)) ** 2)
    assert_close(run.points["slider"][:, 0], place, 1e-11)
    power = run.tau[:, run.actuated.index("crank")] * run.v_tree[:, run.coordinates.index("crank")]
    assert np.abs(power).max() > 0.5
    assert_close(simpson(power, x=run.t), run.energy[-1] - run.energy[0], 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_motion_that_the_loops_cannot_follow_stops(formulation: str) -> None:
    """The slider is pushed past the stretched linkage, 0.4 m from the crank's pivot."""
    slider = {"joint": "slider", "offset": 0.3, "rate": 0.1}
    overrides = {"formulation": formulation, "prescribed": [slider], "t_end": 2.0, "initial": {"at": "assembled"}}
    run = simulate("slider_crank", overrides)
    assert run.status == "stopped"
    assert re.search("singular|loses rank|cannot be kept closed", run.message)
    assert run.t[-1] == pytest.approx(1.0, abs=0.02)
    assert "the loops may not allow the prescribed motion of slider from here on" in run.message
    (warning,) = [text for text in check("slider_crank/default", overrides).warnings if "prescribed" in text]
    assert "cannot be followed beyond t = 1 s" in warning


@pytest.mark.parametrize(
    "name", ["four_bar", "delta", "stewart", "three_rrr", "andrews", "slider_crank_spatial", "bricard"]
)
def test_motor_of_a_prescribed_joint_does_the_work_that_the_energy_takes(name: str) -> None:
    mechanism = load(name)
    joint = mechanism.actuated[0]
    start = float(mechanism.tree.to_coordinates(mechanism.q_tree)[mechanism.coordinates.index(joint)])
    waves = {"offset": start, "harmonics": [[0.05, 4.0, 0.0], [0.02, 9.0, 0.0]]}
    overrides = {
        "prescribed": [{"joint": joint, **waves}],
        "t_end": 0.5,
        "initial": {"at": "assembled"},
        "solver": {"rtol": 1e-10, "output_dt": 2.5e-4},
    }
    dae, reduced = (simulate(name, {**overrides, "formulation": formulation}) for formulation in ("dae", "reduced"))
    for run in (dae, reduced):
        power = (run.tau * run.motor_rates).sum(axis=1)
        assert_close(simpson(power, x=run.t), run.energy[-1] - run.energy[0], 2e-9)
        assert_close(run[joint], start + 0.05 * np.sin(4 * run.t) + 0.02 * np.sin(9 * run.t), 1e-12)
    assert_close(dae.q_tree, reduced.q_tree, 1e-9)


def test_scene_with_a_start_of_the_prescribed_joint_runs() -> None:
    run = simulate("slider_crank", {"prescribed": [{"joint": "crank", "rate": 5.0}], "t_end": 1.0})
    assert_close(run["crank"], 5.0 * run.t, 1e-12)
    assert_close(run["v.crank"], 5.0, 1e-12)
    assert_close(
        run["slider"], CRANK * np.cos(5.0 * run.t) + np.sqrt(ROD**2 - (CRANK * np.sin(5.0 * run.t)) ** 2), 1e-11
    )
    assert run.warnings == ()


def test_saved_run_keeps_the_prescribed_joint(tmp_path: Path) -> None:
    run = simulate("five_bar/swing", scene("reduced", t_end=0.2))
    loaded = Run.load(run.save(tmp_path / "run.npz"))
    assert loaded.mechanism.prescribed == ("theta_1",)
    assert loaded.mechanism.independent == ("theta_3",)
    assert_close(loaded.tau, run.tau, 0.0)


def test_sensitivities_with_a_prescribed_joint_equal_differences() -> None:
    name, step = "link.link_4.mass", 1e-6
    overrides = scene("reduced", t_end=0.6)
    result = sensitivities("five_bar/swing", [name], overrides)
    ends = [
        simulate("five_bar/swing", {**overrides, "parameters": {name: 0.2611 + side * step}}).q_tree[-1]
        for side in (1, -1)
    ]
    assert_close(result.q_tree[-1][:, 0], (ends[0] - ends[1]) / (2 * step), 1e-5)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"prescribed": [{"joint": "theta_9"}]}, "theta_9"),
        ({"prescribed": [{"joint": "theta_1"}, {"joint": "theta_1"}]}, "prescribed twice"),
        ({"spf_coordinates": "z", "formulation": "spf"}, 'spf_coordinates = "w"'),
        ({"prescribed": [{"joint": "theta_1", "waypoints": [[0, 0], [1, 1]], "profile": "linear"}]}, "rate jumps at t"),
    ],
)
def test_unusable_prescribed_joints_are_rejected(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(CkcError, match=message):
        simulate("five_bar/swing", {**scene("reduced"), **overrides})


def test_paper_controllers_are_refused_with_prescribed_joints() -> None:
    controller = {"type": "set_point", "K_P": 1.0, "K_V": 1.0, "q_d": {"theta_3": -1.7}}
    with pytest.raises(InputError, match=r"eqs\. 14 and 16"):
        simulate("five_bar/swing", scene("reduced", controller=controller))


def test_harmonics_of_the_test_are_those_of_the_scene() -> None:
    ours = Harmonics([MotionSpec(offset=-1.4, harmonics=[(0.3, 5.0, 0.4), (0.05, 13.0, -0.3)])])(0.7)
    assert_close(np.ravel(ours), np.array(left_crank(0.7)), 1e-12)


@pytest.mark.parametrize("either_terms", ["pinocchio"], indirect=True)  # Drawings do not depend on the terms.
@pytest.mark.parametrize("has_freedom", [False, True])
def test_prescribed_motions_are_drawn_and_played(tmp_path: Path, has_freedom: bool) -> None:
    """Also without any freedom, where all coordinates are drawn."""
    crank = {"prescribed": [{"joint": "crank", "rate": 5.0}], "t_end": 0.2}
    run = simulate("five_bar/swing", scene("reduced", t_end=0.2)) if has_freedom else simulate("slider_crank", crank)
    figures = plot(run)
    names = [path.name for path in figures.save(tmp_path)]
    assert names == ["prescribed.png", "prescribed_checks.png", "prescribed_snapshots.png"]
    page = run.play(inline=True).save(tmp_path / "motion.html")  # type: ignore[union-attr]
    assert page.stat().st_size > 10_000
