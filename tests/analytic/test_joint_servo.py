"""Servos of single joints: a wheel in closed form, the five-bar with the equations of its appendix, sampled servos."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import ckc_pin
from ckc_pin import CkcError, InputError, JointServo, Sampled, Simulator, load, simulate
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.analytic.small_models import WHEEL_INERTIA, wheel_urdf
from tests.conftest import assert_close

FORMULATIONS = ["dae", "reduced", "spf"]
START = np.array([-1.2, -1.9])
MOTION = {"offset": -1.1, "harmonics": [[0.2, 3.0, 0.5]]}
SERVOS = {
    "theta_1": {"K_P": 8.0, "K_I": 30.0, "K_D": 0.6, "desired": MOTION},
    "theta_3": {"mode": "velocity", "K_P": 0.5, "K_I": 2.0, "desired": {"rate": 0.3}},
}
LIMIT = {"theta_1": 2.5, "theta_3": 0.2}


def servo_scene(**overrides: Any) -> dict[str, Any]:
    return {
        "formulation": "dae",
        "t_end": 2.0,
        "initial": {"q": {"theta_1": -1.2, "theta_3": -1.9}},
        "controller": {"type": "joint_servo", "motor": SERVOS},
        "solver": {"rtol": 1e-11, "output_dt": 0.1},
        **overrides,
    }


def motion(t: float) -> tuple[float, float]:
    return -1.1 + 0.2 * np.sin(3.0 * t + 0.5), 0.6 * np.cos(3.0 * t + 0.5)


def torques_and_rates(t: float, q: Array, q_dot: Array, x: Array, limit: Array) -> tuple[Array, Array]:
    """Torques within their limits, and the rates of the two integrals."""
    value, rate = motion(t)
    e, e_dot, e_rate = q[0] - value, q_dot[0] - rate, q_dot[1] - 0.3
    requested = np.array([-8.0 * e - 0.6 * e_dot, -0.5 * e_rate]) + x
    tau = np.clip(requested, -limit, limit)
    unwinding = np.array([30.0 / 8.0, 2.0 / 0.5])
    return tau, np.array([-30.0 * e, -2.0 * e_rate]) + unwinding * (tau - requested)


@cache
def appendix_motion(*, limited: bool) -> tuple[Array, Array]:
    limit = np.array(list(LIMIT.values())) if limited else np.full(2, np.inf)

    def rate(t: float, y: Array) -> Array:
        q, q_dot, x = y[:2], y[2:4], y[4:]
        tau, x_dot = torques_and_rates(t, q, q_dot, x, limit)
        return np.concatenate([q_dot, FIVE_BAR.acceleration(FIVE_BAR.sigma(q), q_dot, tau), x_dot])

    times = np.linspace(0.0, 2.0, 21)
    solution = solve_ivp(rate, (0.0, 2.0), [*START, 0, 0, 0, 0], "DOP853", times, rtol=1e-12, atol=1e-13, max_step=0.01)
    return solution.y[:2].T, solution.y[2:4].T


# --- closed form ---------------------------------------------------------------------------------

INERTIA = WHEEL_INERTIA


def write_wheel(folder: Path) -> Path:
    (folder / "wheel.urdf").write_text(wheel_urdf())
    (folder / "mechanism.toml").write_text(
        'name = "wheel"\nurdf = "wheel.urdf"\n[[motor]]\nname = "drive"\njoint = "axle"\nratio = 4.0\n'
    )
    path = folder / "turn.scene.toml"
    path.write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 3.0\n[initial]\nq = {axle = 0.2}\n'
        '[solver]\nrtol = 1e-11\n[controller]\ntype = "joint_servo"\n[controller.motor.drive]\nK_P = 1.0\n'
    )
    return path


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("servo", "matrix", "forcing"),
    [
        # y = (angle, rate, integral); the desired angle is 1
        ({"K_P": 5.0}, [[0, 1, 0], [-5 / INERTIA, 0, 0], [0, 0, 0]], [0, 5 / INERTIA, 0]),
        ({"K_P": 5.0, "K_D": 0.4}, [[0, 1, 0], [-5 / INERTIA, -0.4 / INERTIA, 0], [0, 0, 0]], [0, 5 / INERTIA, 0]),
        (
            {"K_P": 5.0, "K_I": 6.0, "K_D": 0.9},
            [[0, 1, 0], [-5 / INERTIA, -0.9 / INERTIA, 1 / INERTIA], [-6, 0, 0]],
            [0, 5 / INERTIA, 6],
        ),
        # velocity mode: the desired rate is 2
        (
            {"mode": "velocity", "K_P": 0.7, "K_I": 1.5},
            [[0, 1, 0], [0, -0.7 / INERTIA, 1 / INERTIA], [0, -1.5, 0]],
            [0, 1.4 / INERTIA, 3.0],
        ),
    ],
    ids=["P", "PD", "PID", "velocity PI"],
)
def test_a_wheel_moves_as_the_linear_equations_say(
    tmp_path: Path, formulation: str, servo: dict[str, Any], matrix: Any, forcing: Any
) -> None:
    desired = {"rate": 2.0} if "mode" in servo else {"offset": 1.0}
    overrides = {"formulation": formulation, "controller.motor.drive": {**servo, "desired": desired}}
    run = simulate(write_wheel(tmp_path), overrides)
    extended = np.block([[np.array(matrix, float), np.array(forcing, float)[:, None]], [np.zeros((1, 4))]])
    for k in range(0, len(run.t), 50):
        expected = expm(extended * run.t[k]) @ [0.2, 0.0, 0.0, 1.0]
        assert_close([run["axle"][k], run["v.axle"][k]], expected[:2], 1e-8)
    assert_close(run.tau[0, 0] * 4.0, 1.4 if "mode" in servo else 4.0, 1e-12)  # before the gear


# --- against the appendix ------------------------------------------------------------------------


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_servos_move_the_five_bar_as_the_appendix_says(formulation: str, method: str) -> None:
    solver = {"rtol": 1e-11, "output_dt": 0.1, "method": method}
    run = simulate("five_bar/swing", servo_scene(formulation=formulation, solver=solver))
    q, q_dot = appendix_motion(limited=False)
    assert run.status == "done"
    assert_close(run.q, q, 1e-9)
    assert_close(run.q_dot, q_dot, 1e-8)
    assert run.stats["python_calls"] == 0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_at_torque_limits_the_integral_follows_back_calculation(formulation: str) -> None:
    overrides = servo_scene(formulation=formulation)
    overrides["controller"] = {**overrides["controller"], "torque_limit": LIMIT}
    run = simulate("five_bar/swing", overrides)
    q, _ = appendix_motion(limited=True)
    assert_close(np.abs(run.tau).max(axis=0)[1], 0.2, 1e-12)
    assert_close(run.q, q, 1e-6)
    assert np.abs(q - appendix_motion(limited=False)[0]).max() > 0.01


def test_motors_need_not_be_independent_coordinates(tmp_path: Path) -> None:
    text = (Path(ckc_pin.__file__).parent.parent / "urdf/five_bar/mechanism.toml").read_text()
    (tmp_path / "five_bar.urdf").write_text(
        (Path(ckc_pin.__file__).parent.parent / "urdf/five_bar/five_bar.urdf").read_text()
    )
    (tmp_path / "mechanism.toml").write_text(
        text.replace('independent = ["theta_1", "theta_3"]', 'independent = ["theta_2", "theta_4"]')
    )
    q_tree = FIVE_BAR.sigma(START)
    path = tmp_path / "servo.scene.toml"
    path.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 2.0\n[initial]\nat = "assembled"\n')
    initial = {"q": dict(zip(("theta_1", "theta_2", "theta_3", "theta_4"), q_tree.tolist(), strict=True))}
    overrides = {key: servo_scene()[key] for key in ("controller", "solver")}
    run = simulate(path, {**overrides, "initial": initial})
    assert run.independent == ("theta_2", "theta_4")
    assert_close(run.q_tree[:, [0, 2]], appendix_motion(limited=False)[0], 1e-8)


def test_gravity_is_balanced_at_the_start() -> None:
    servo = {"K_P": 5.0, "K_D": 0.5}
    motors = {"theta_1": {**servo, "desired": {"offset": -1.2}}, "theta_3": {**servo, "desired": {"offset": -1.9}}}
    controller = {"type": "joint_servo", "gravity": True, "motor": motors}
    run = simulate("five_bar/swing", servo_scene(controller=controller))
    assert_close(run.q, START, 1e-9)
    assert_close(run.tau[-1], FIVE_BAR.h(FIVE_BAR.sigma(START)), 1e-8)


@pytest.mark.parametrize("limit", [None, 0.5])
def test_gravity_is_shared_by_redundant_motors_as_the_reference_says(limit: float | None) -> None:
    """Torques along a run against those of the class in Python, which does not share code with the core."""
    joint = "left_shoulder_lift_joint"
    motor = {joint: {"K_P": 20.0, "K_D": 2.0, "desired": {"offset": -1.0}}}
    controller = {"type": "joint_servo", "gravity": True, "motor": motor, "torque_limit": limit}
    overrides = {"controller": {k: x for k, x in controller.items() if x is not None}, "t_end": 0.05}
    run = simulate("two_ur5/lift", {**overrides, "solver.rtol": 1e-9})
    servo = JointServo(run.mechanism, motor, gravity=True)
    for k in range(0, len(run.t), 100):
        tau = servo.tau(float(run.t[k]), run.sel(t=float(run.t[k])).terms)
        tau = tau if limit is None else np.clip(tau, -limit, limit)
        assert_close(run.tau[k], tau, 1e-7, relative=True)


def test_gravity_that_the_motors_cannot_balance_is_refused(tmp_path: Path) -> None:
    mechanism = load("five_bar")
    text = mechanism.sources.texts["mechanism.toml"].replace(
        'actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]'
    )
    (tmp_path / "mechanism.toml").write_text(text)
    (tmp_path / "five_bar.urdf").write_text(mechanism.sources.texts["five_bar.urdf"])
    controller = {"type": "joint_servo", "gravity": True, "motor": {"theta_1": {"K_P": 1.0}}}
    with pytest.raises(
        InputError, match=r"controller\.gravity: the motors cannot balance it: actuated: theta_1 cannot"
    ):
        simulate(load(tmp_path / "mechanism.toml"), t_end=0.1, controller=controller)


def test_the_desired_motion_of_position_servos_is_a_quantity(tmp_path: Path) -> None:
    """`desired` exists where every independent coordinate has one, in the order of `independent`."""
    servo = {"K_P": 8.0, "K_D": 0.6}
    motors = {"theta_3": {**servo, "desired": {"offset": -1.9}}, "theta_1": {**servo, "desired": MOTION}}
    run = simulate("five_bar/swing", servo_scene(controller={"type": "joint_servo", "motor": motors}))
    expected = np.array([motion(t)[0] for t in run.t])
    for one in (run, ckc_pin.Run.load(run.save(tmp_path / "run.npz"))):
        assert_close(one["desired.theta_1"], expected, 1e-12)
        assert_close(one["error.theta_3"], one["theta_3"] + 1.9, 1e-12)
    assert simulate("five_bar/swing", servo_scene()).desired is None
    ckc_pin.plot(run).save(tmp_path)


def test_a_motor_without_a_servo_has_no_torque() -> None:
    controller = {"type": "joint_servo", "motor": {"theta_3": SERVOS["theta_3"]}}
    run = simulate("five_bar/swing", servo_scene(controller=controller))
    assert not run.tau[:, 0].any()
    assert run.tau[:, 1].any()


# --- sampled, stepped, events, ensembles ---------------------------------------------------------


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_a_sampled_servo_is_the_controller_evaluated_once_a_sample(formulation: str) -> None:
    """The reference in Python gives the torques, and its integrals advance by Euler's rule."""
    overrides = servo_scene(formulation=formulation, t_end=0.5)
    overrides["controller"] = {**overrides["controller"], "sample_time": 0.01, "torque_limit": LIMIT}
    run = simulate("five_bar/swing", {**overrides, "solver": {"rtol": 1e-11, "output_dt": 0.01}})
    mechanism = load("five_bar")
    servo = JointServo(mechanism, SERVOS, sample_time=0.01)
    limit = np.array(list(LIMIT.values()))
    servo.limit_torques(np.array([-limit, limit]))
    simulator, x = Simulator("five_bar/swing", {**overrides, "controller": None}), servo.initial_state
    for k in range(50):
        terms = simulator.state.terms
        tau = np.clip(servo.tau(0.01 * k, terms, x), -limit, limit)
        x = x + 0.01 * servo.state_dot(0.01 * k, terms, x)
        simulator.step(tau=tau, dt=0.01)
    assert_close(simulator.state.q_tree, run.q_tree[-1], 1e-8)


def test_events_of_a_servo_are_at_their_times() -> None:
    event = [{"coordinate": "theta_1", "value": -1.0}]
    run = simulate("five_bar/swing", servo_scene(event=event))
    q, _ = appendix_motion(limited=False)
    crossings = np.flatnonzero(np.diff(np.sign(q[:, 0] + 1.0)))
    assert len(run.events) == len(crossings) > 0
    for event, k in zip(run.events, crossings, strict=True):
        assert run.t[k] <= event["t"] <= run.t[k + 1]


def test_ensembles_vary_the_gains_of_a_servo() -> None:
    gains = [4.0, 8.0]
    results = ckc_pin.ensemble(
        "five_bar/swing", {"controller.motor.theta_1.K_P": gains}, {"end": "theta_1"}, overrides=servo_scene(),
        progress=False,
    )  # fmt: skip
    for gain, end in zip(gains, results["end"].to_numpy(), strict=True):
        single = simulate("five_bar/swing", {**servo_scene(), "controller.motor.theta_1.K_P": gain})
        assert end == single["theta_1"][-1]


# --- controllers of the user's own with a state --------------------------------------------------


class Servo:
    """The servo of theta_1 above as a controller with a state."""

    initial_state = np.zeros(1)

    def tau(self, t: float, terms: ckc_pin.Terms, x: Array) -> dict[str, float]:
        value, rate = motion(t)
        return {"theta_1": -8.0 * (terms.q[0] - value) - 0.6 * (terms.q_dot[0] - rate) + float(x[0])}

    def state_dot(self, t: float, terms: ckc_pin.Terms, x: Array) -> list[float]:
        return [-30.0 * (terms.q[0] - motion(t)[0])]


class ServoOfU(Servo):
    """The same with eq. 6's force."""

    tau = None  # type: ignore[assignment]

    def u(self, t: float, terms: ckc_pin.Terms, x: Array) -> list[float]:
        return [Servo.tau(self, t, terms, x)["theta_1"], 0.0]


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
@pytest.mark.parametrize("controller", [Servo(), ServoOfU()])
def test_a_controller_with_a_state_is_integrated_with_the_motion(
    formulation: str, method: str, controller: Any
) -> None:
    servo = {"type": "joint_servo", "motor": {"theta_1": SERVOS["theta_1"]}}
    overrides = servo_scene(formulation=formulation, controller=servo, t_end=1.0)
    solver = {"rtol": 1e-10, "output_dt": 0.1, "method": method}
    ours = simulate("five_bar/swing", {**overrides, "controller": None, "solver": solver}, controller=controller)
    assert_close(ours.q_tree, simulate("five_bar/swing", overrides).q_tree, 1e-8)


def test_a_sampled_controller_with_a_state_is_the_sampled_servo() -> None:
    servo = {"type": "joint_servo", "motor": {"theta_1": SERVOS["theta_1"]}, "sample_time": 0.02, "delay": 0.005}
    overrides = servo_scene(controller=servo, t_end=1.0)
    sampled = Sampled(Servo(), 0.02, 0.005)
    ours = simulate("five_bar/swing", {**overrides, "controller": None}, controller=sampled)
    assert_close(ours.q_tree, simulate("five_bar/swing", overrides).q_tree, 1e-10)


def test_a_controller_with_a_state_starts_anew_in_every_run() -> None:
    controller = Servo()
    overrides = servo_scene(controller=None, t_end=0.5)
    first, again = (simulate("five_bar/swing", overrides, controller=controller) for _ in range(2))
    assert np.array_equal(first.q_tree, again.q_tree)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"initial_state": None}, "its attribute initial_state must be a vector of finite numbers, got None"),
        ({"initial_state": np.array([np.nan])}, "must be a vector of finite numbers"),
        ({"state_dot": lambda self, t, terms, x: [0.0, 0.0]}, "state_dot: expected 1 finite numbers"),
        ({"state_dot": lambda self, t, terms: [0.0]}, "expected a function of (t, terms, state)"),
        ({"tau": lambda self, t, terms: [0.0, 0.0]}, "expected a function of (t, terms, state)"),
    ],
)
def test_unusable_controllers_with_a_state_are_refused(attributes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        simulate("five_bar/swing", servo_scene(controller=None), controller=type("Mine", (Servo,), attributes)())


@pytest.mark.parametrize(
    ("servo", "message"),
    [
        ({"theta_9": {"K_P": 1.0}}, "controller.motor: no motor 'theta_9'; there are theta_1, theta_3"),
        ({}, "got an empty one"),
        ({"theta_1": {}}, "controller.motor.theta_1: all gains are zero"),
        ({"theta_1": {"mode": "velocity", "K_P": 1.0, "K_D": 1.0}}, 'K_D belongs to mode = "position"'),
        ({"theta_1": {"K_P": 1.0, "anti_windup": 0.1}}, "anti_windup belongs to K_I"),
        ({"theta_1": {"K_P": 1.0, "kd": 1.0}}, "did you mean 'K_D'"),
        (
            {"theta_1": {"K_P": 1.0, "K_D": 1.0, "desired": {"waypoints": [[0, 0], [1, 1]], "profile": "linear"}}},
            "a desired rate jumps at t = 1 s",
        ),
    ],
)
def test_unusable_servos_are_refused(servo: dict[str, Any], message: str) -> None:
    controller = {"type": "joint_servo", "motor": servo}
    with pytest.raises(CkcError, match=re.escape(message)):
        simulate("five_bar/swing", servo_scene(controller=controller))


def test_a_servo_beside_a_prescribed_joint() -> None:
    """The servo of theta_3 acts while theta_1 moves as prescribed; a servo of theta_1 itself is refused."""
    prescribed = [{"joint": "theta_1", **MOTION}]
    motor = {"theta_3": SERVOS["theta_3"]}
    controller = {"type": "joint_servo", "motor": motor}
    run = simulate("five_bar/swing", servo_scene(prescribed=prescribed, controller=controller))
    assert_close(run["theta_1"], [motion(t)[0] for t in run.t], 1e-10)

    def rate(t: float, y: Array) -> Array:
        value, v_1 = motion(t)
        q, q_dot = np.array([value, y[0]]), np.array([v_1, y[1]])
        q_tree = FIVE_BAR.sigma(q)
        e = y[1] - 0.3
        D, rest = FIVE_BAR.D(q_tree), FIVE_BAR.force(q_tree, q_dot, np.zeros(2))
        a_1 = -1.8 * np.sin(3.0 * t + 0.5)
        return np.array([y[1], (-0.5 * e + y[2] - rest[1] - D[1, 0] * a_1) / D[1, 1], -2.0 * e])

    solution = solve_ivp(rate, (0.0, 2.0), [-1.9, 0.0, 0.0], "DOP853", run.t, rtol=1e-12, atol=1e-13)
    assert_close(run["theta_3"], solution.y[0], 1e-8)
    with pytest.raises(InputError, match="the motion of 'theta_1' is prescribed; remove one of them"):
        simulate("five_bar/swing", servo_scene(prescribed=prescribed))


def test_linear_models_say_that_they_leave_servos_out() -> None:
    model = ckc_pin.linearize("five_bar/swing", overrides=servo_scene(), at=0.5)
    assert any("without the scene's controller" in note for note in model.notes)


def test_sensitivities_of_servos_are_refused() -> None:
    with pytest.raises(InputError, match="JointServo gives tau, whose derivatives are unknown"):
        ckc_pin.sensitivities("five_bar/swing", ["link.link_2.mass"], servo_scene())
