"""Torques by motor of the geared five-bar from controllers, steps and files, compared with SciPy on the appendix."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, Run, Sampled, Simulator, Terms, load, simulate
from tests.analytic.five_bar import FIVE_BAR, Array, Q
from tests.conftest import assert_close
from tests.contract.helpers.bad import Bad, expect

FORMULATIONS = ["reduced", "spf", "dae"]


# --- the five-bar, motors behind gears -------------------------------------------------------------

MOTORS = """
[[motor]]
name = "left"
joint = "theta_1"
ratio = -20.0
speed_limit = 5.0
[[motor]]
name = "belt"
joints = {theta_3 = 1.0, theta_4 = -0.5}
ratio = 4.0
torque_limit = 0.2
"""
TURNS = np.array([[-20.0, 0.0, 0.0, 0.0], [0.0, 0.0, 4.0, -2.0]])


@pytest.fixture
def geared(bar: Path) -> Path:
    """A folder of the five-bar with geared motors."""
    text = (bar / "mechanism.toml").read_text("utf-8")
    old = 'actuated = ["theta_1", "theta_3"]\n'
    assert old in text
    head, _, tail = text.replace(old, "").partition("[q_guess]")
    (bar / "mechanism.toml").write_text(f"{head}{MOTORS}\n[q_guess]{tail}", "utf-8")
    return bar


def u_of(tau: Array, q_tree: Array) -> Array:
    """Eq. 6's force of limited torques, with rho of the appendix."""
    return (TURNS @ FIVE_BAR.rho(q_tree)).T @ np.clip(tau, [-np.inf, -0.2], [np.inf, 0.2])


def motion(start: Array, t: Array, tau: Any) -> Array:
    """(q, q_dot) at instants between which tau(t, q_tree, q_dot) is smooth."""
    states = [start]

    def rate(time: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        u = u_of(tau(time, q_tree, y[2:]), q_tree)
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], u)])

    for a, b in pairwise(t):
        states.append(solve_ivp(rate, (a, b), states[-1], "DOP853", rtol=1e-12, atol=1e-14).y[:, -1])
    return np.array(states)


def start_of(run: Run) -> Array:
    return np.concatenate([run.q_tree[0, Q], run.v_tree[0, Q]])


class Spring:
    """Torques that depend on the state, as an array or by name."""

    def __init__(self, named: bool) -> None:
        self.named = named

    def tau(self, t: float, terms: Terms) -> Array | Mapping[str, float]:
        values = self.of(t, terms.q_tree, terms.q_dot)
        return {"belt": values[1], "left": values[0]} if self.named else values

    @staticmethod
    def of(t: float, q_tree: Array, q_dot: Array) -> Array:
        return np.array([0.01 * np.sin(3 * t) - 0.02 * (q_tree[1] - 0.3), 0.05 * np.cos(q_tree[3]) - 0.03 * q_dot[1]])


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_torque_controller_agrees_with_scipy(geared: Path, formulation: str, named: bool) -> None:
    overrides = {"formulation": formulation, "t_end": 0.3, "solver.rtol": 1e-11, "solver.output_dt": 0.1}
    run = simulate(geared / "swing.scene.toml", overrides, controller=Spring(named))
    assert run.actuated == ("left", "belt")
    states = motion(start_of(run), run.t, Spring.of)
    assert_close(run.q_tree[:, Q], states[:, :2], 1e-9)
    assert_close(run.v_tree[:, Q], states[:, 2:], 1e-8)
    for k, q_tree in enumerate(run.q_tree):
        assert_close(run.tau[k], Spring.of(run.t[k], q_tree, run.v_tree[k, Q]), 1e-12)
        assert_close(run.u[k], u_of(run.tau[k], q_tree), 1e-10)
    assert run.stats["python_calls"] > 0


def test_sampled_torques_are_constant_while_u_varies(geared: Path) -> None:
    overrides = {"formulation": "dae", "t_end": 0.1, "solver.rtol": 1e-11, "solver.output_dt": 0.01}
    run = simulate(geared / "swing.scene.toml", overrides, controller=Sampled(Spring(True), 0.02, 0.01))
    y, acts = start_of(run), np.zeros(2)
    for k in range(10):
        if k % 2 == 0:
            asked = Spring.of(run.t[k], FIVE_BAR.sigma(y[:2]), y[2:])
        else:
            acts = asked
        y = motion(y, run.t[k : k + 2], lambda t, q_tree, q_dot, tau=acts: tau)[-1]
        assert_close(run.q_tree[k + 1, Q], y[:2], 1e-9)
        assert_close(run.tau[k], acts, 1e-8)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_steps_with_tau_agree_with_scipy(geared: Path, formulation: str) -> None:
    simulator = Simulator(geared / "swing.scene.toml", {"formulation": formulation, "solver.rtol": 1e-11})
    state, rng = simulator.state, np.random.default_rng(4)
    y = np.concatenate([state.q, state.q_dot])
    for k in range(12):
        tau = rng.uniform(-1, 1, 2) * [0.02, 0.3]  # the belt's torque is limited
        arguments: Any = dict(zip(("left", "belt"), tau, strict=True)) if k % 3 else tau
        if k == 5:
            arguments, tau[0] = {"belt": tau[1]}, 0.0
        state = simulator.step(tau=arguments, dt=0.01)
        y = motion(y, np.array([0.0, 0.01]), lambda t, q_tree, q_dot, tau=tau: tau)[-1]
        assert_close(np.concatenate([state.q, state.q_dot]), y, 1e-9)
    u = np.array([0.1, -0.2])  # then a force on q
    assert_close(simulator.step(u, 0.01).t, 0.13, 1e-12)
    assert simulator.stats["python_calls"] == 0


def test_torques_need_no_chart(geared: Path) -> None:
    """Where phi_z becomes singular, the reduced model continues in other coordinates and agrees with the DAE."""
    runs = []
    for formulation in ("reduced", "dae"):
        overrides = {
            "formulation": formulation,
            "solver.rtol": 1e-10,
            "initial.q_dot": {"theta_1": 9.0, "theta_3": -9.0},
        }
        simulator = Simulator(geared / "swing.scene.toml", overrides)
        for _ in range(25):
            state = simulator.step(tau={"left": 1e-3}, dt=0.02)
        runs.append((state, simulator.stats))
    assert runs[0][1]["switches"] > 0
    assert_close(runs[0][0].q_tree, runs[1][0].q_tree, 1e-6)


def test_motor_above_its_speed_limit_is_named(geared: Path) -> None:
    run = simulate(geared / "swing.scene.toml", {"t_end": 1.0})
    assert_close(run.motor_rates, run.v_tree @ TURNS.T, 1e-12)
    fastest = np.abs(run.motor_rates).max(axis=0)
    assert fastest[0] > 5.0
    assert run.too_fast() == run.to_dict()["too_fast"] == {"left": fastest[0]}


# --- torques of a file -----------------------------------------------------------------------------

TIMES = np.array([-0.5, 0.0, 0.05, 0.11, 0.2])
VALUES = np.array([[9.0, 9.0], [0.02, 0.1], [-0.03, 0.1], [0.0, -0.5], [0.05, 0.0]])


def csv(folder: Path, values: Array) -> None:
    rows = np.column_stack([values[:, ::-1], TIMES])
    lines = ["belt,left,t", *(",".join(map(repr, row.tolist())) for row in rows), ""]
    (folder / "drive.csv").write_text("\n".join(lines), "utf-8")


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_torques_from_a_file_agree_with_scipy(geared: Path, formulation: str, interpolation: str) -> None:
    values = VALUES if interpolation == "hold" else 0.3 * VALUES  # between rows a line could exceed a limit
    csv(geared, values)
    overrides = {
        "formulation": formulation,
        "t_end": 0.2,
        "solver.rtol": 1e-11,
        "solver.output_dt": 0.01,
        "controller": {"type": "torques", "file": "drive.csv", "interpolation": interpolation},
    }
    run = simulate(geared / "swing.scene.toml", overrides)

    def tau(t: float, q_tree: Array, q_dot: Array) -> Array:
        if interpolation == "linear":
            return np.array([np.interp(t, TIMES, column) for column in values.T])
        k = 1 if t < 0.05 - 1e-12 else 2 if t < 0.11 - 1e-12 else 3
        return np.asarray(values[k])

    before = 1e-10 if interpolation == "hold" else 0.0  # the reference's steps end where the torque changes
    states = motion(start_of(run), run.t, lambda t, *state: tau(t - before, *state))
    assert_close(run.q_tree[:, Q], states[:, :2], 1e-9)
    assert_close(run.v_tree[:, Q], states[:, 2:], 1e-8)
    limits = [np.inf, 0.2]
    expected = np.array([np.clip(tau(t, Q, Q), np.negative(limits), limits) for t in run.t])
    rows = slice(0, -1) if interpolation == "hold" else slice(None)  # the last row starts at the end
    assert_close(run.tau[rows], expected[rows], 1e-12)
    assert run.stats["python_calls"] == 0
    kept = Run.load(run.save(geared / "run.npz"))
    assert kept.actuated == ("left", "belt")
    assert "drive.csv" in kept.texts


def test_csv_names_with_commas_are_quoted(geared: Path) -> None:
    overrides = {"t_end": 0.15, "controller": {"type": "torques", "file": "drive.csv"}, "solver.terms": "pinocchio"}
    csv(geared, VALUES)
    expected = simulate(geared / "swing.scene.toml", overrides)
    mechanism, drive = geared / "mechanism.toml", geared / "drive.csv"
    mechanism.write_text(mechanism.read_text("utf-8").replace('"left"', '"left, upper"'), "utf-8")
    drive.write_text(drive.read_text("utf-8").replace("left", '"left, upper"').replace("belt", '"belt"'), "utf-8")
    result = simulate(geared / "swing.scene.toml", overrides)
    assert result.actuated == ("left, upper", "belt")
    assert np.array_equal(result.q_tree, expected.q_tree)


CONTROLLER = '[controller]\ntype = "torques"\nfile = "drive.csv"\n'
HEADER = "t,theta_1,theta_3\n"


def _file(what: str, rows: str, *says: str, entry: str = "") -> Bad:
    scene = (
        f'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\ninitial.at = "assembled"\n{CONTROLLER}{entry}'
    )
    files = {"bar/a.scene.toml": scene, "bar/drive.csv": rows}
    return Bad(what, ("run", "bar/a.scene.toml"), says, files=files)


def _tracking(change: str, *says: str) -> Bad:
    return Bad(change, ("run", "bar/tracking.scene.toml", "--set", f"controller.{change}"), says)


BAD = [
    _file("another motor", "t,theta_1,theta_2\n0,1,1\n1,1,1\n", "drive.csv: its header is", "t, theta_1, theta_3"),
    _file("a missing cell", f"{HEADER}0,1,1\n0.5,1\n1,1,1\n", "drive.csv, line 3: '0.5,1' is not 3 finite numbers"),
    _file("a gap", f"{HEADER}0,1,1\n0.5,,1\n1,1,1\n", "drive.csv, line 3: '0.5,,1' is not 3 finite numbers"),
    _file("nan", f"{HEADER}0,1,1\n0.5,nan,1\n1,1,1\n", "drive.csv, line 3"),
    _file("time that stands still", f"{HEADER}0,1,1\n0.5,1,1\n0.5,1,1\n", "line 4: t = 0.5 after t = 0.5; t must"),
    _file("a late start", f"{HEADER}0.1,1,1\n1,1,1\n", "starts at t = 0.1 s; a run starts at 0"),
    _file(
        "an early end",
        f"{HEADER}0,1,1\n0.4,1,1\n",
        "drive.csv: the torques end at t = 0.8 s, before the scene's t_end = 1 s",
    ),
    _file("one row", f"{HEADER}0,1,1\n", "drive.csv: 1 rows; torques over time need at least 2"),
    _file("between rows", f"{HEADER}0,1,1\n1,1,1\n", "valid: 'hold', 'linear'", entry='interpolation = "spline"\n'),
    _file("a clock", f"{HEADER}0,1,1\n1,1,1\n", "unknown key 'sample_time'", entry="sample_time = 0.1\n"),
    _tracking(
        "allocation.preload={theta_1=1.0}",
        "allocation.preload: five_bar has no redundant motors: u determines the torques of its 2",
    ),
    _tracking("allocation.weights={theta_1=1.0}", "controller.allocation.weights: five_bar has no redundant motors"),
    _tracking(
        "allocation.preloads={theta_1=1.0}", "controller.allocation: unknown key 'preloads'; valid: weights, preload"
    ),
]


@pytest.mark.parametrize("case", BAD, ids=lambda case: case.what)
def test_invalid_torque_file_is_rejected(case: Bad, bar: Path) -> None:
    expect(case, bar)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"tau": {"x": 1.0}}, "tau: no motor 'x'; there are left, belt"),
        ({"tau": {"left": "strong"}}, "tau: expected a table of numbers by motor, got"),
        ({"tau": [1.0]}, r"tau: expected shape \(2,\) \(left, belt\), got \(1,\)"),
        ({"tau": [1.0, np.nan]}, r"tau is not finite: \[1.0, nan\]"),
        ({"tau": [0.0, 0.0], "u": [0.0, 0.0]}, "give either u or tau, not both"),
    ],
)
def test_invalid_tau_is_rejected(geared: Path, arguments: dict[str, Any], says: str) -> None:
    simulator = Simulator(geared / "swing.scene.toml")
    before = simulator.step(tau={"belt": 0.1}, dt=0.01)
    with pytest.raises(InputError, match=says):
        simulator.step(dt=0.01, **arguments)
    assert simulator.state is before


@pytest.mark.parametrize(
    ("allocation", "says"),
    [
        (
            {"preload": {"x": 1.0}},
            "controller.allocation.preload: no motor 'x'; there are left_shoulder_pan_joint",
        ),
        ({"weights": {"left_elbow_joint": 0}}, "weights.left_elbow_joint = 0: expected a number greater than 0"),
    ],
)
def test_invalid_allocation_is_rejected(allocation: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        simulate("two_ur5/lift", {"controller.allocation": allocation})


class Both(Spring):
    """A controller with both methods, u and tau."""

    def u(self, t: float, terms: Terms) -> Array:
        return np.zeros(2)


@pytest.mark.parametrize(
    ("controller", "says"),
    [
        (Both(True), "Both has both u and tau; a controller has one of the methods"),
        (object(), "expected an object with one of the methods.*, got an object"),
    ],
)
def test_controller_must_have_one_of_u_and_tau(controller: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        simulate("five_bar/swing", controller=controller)


def test_empty_actuated_does_not_change_the_partition(bar: Path) -> None:
    text = (bar / "mechanism.toml").read_text("utf-8")
    chosen = []
    for motors in ("", "actuated = []\n"):
        keys = 'independent = ["theta_1", "theta_3"]\nactuated = ["theta_1", "theta_3"]\n'
        (bar / "mechanism.toml").write_text(text.replace(keys, motors), "utf-8")
        chosen.append(load(bar))
    assert chosen[1].independent == chosen[0].independent == chosen[0].actuated
    assert chosen[1].actuated == ()


def test_undriven_freedom_is_named_and_torques_still_act(bar: Path) -> None:
    text = (bar / "mechanism.toml").read_text("utf-8")
    (bar / "mechanism.toml").write_text(text.replace('actuated = ["theta_1", "theta_3"]', "actuated = []"), "utf-8")
    with pytest.raises(
        InputError, match="no joint cannot drive every freedom; the motion along theta_1, theta_3 is driven by none"
    ):
        simulate(bar / "tracking.scene.toml")
    (bar / "mechanism.toml").write_text(
        text.replace('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_4"]'), "utf-8"
    )
    simulator = Simulator(bar / "swing.scene.toml", {"formulation": "reduced", "solver.rtol": 1e-11})
    with pytest.raises(InputError, match=r"u: actuated: theta_4 cannot drive every freedom.*give tau by motor instead"):
        simulator.step([0.1, 0.0], 0.01)
    y = np.concatenate([simulator.state.q, simulator.state.q_dot])
    state = simulator.step(tau={"theta_4": 0.05}, dt=0.2)

    def rate(t: float, y: Array) -> Array:
        q_tree = FIVE_BAR.sigma(y[:2])
        u = FIVE_BAR.rho(q_tree)[3] * 0.05
        return np.concatenate([y[2:], FIVE_BAR.acceleration(q_tree, y[2:], u)])

    there = solve_ivp(rate, (0.0, 0.2), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    assert_close(np.concatenate([state.q, state.q_dot]), there, 1e-9)
