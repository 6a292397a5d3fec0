"""Steps of a simulator with set forces, acting controllers and moved targets, compared with SciPy and with runs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Force, InputError, Mechanism, Scene, Simulator, State, simulate
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.analytic.test_forces import FORMULATIONS, START, initial_state, integrate, scene
from tests.conftest import assert_close

PUSH = Force("link_2", [0.0, 0.0, 0.0], name="push")
TIMES = [0.0, 0.13, 0.2, 0.5, 0.9]
WRENCHES = np.array([[0.0, 0.4, 0.3], [0.7, -0.2, 0.0], [0.0, 0.0, 0.0], [-0.4, 0.5, -0.2]])  # fx, fy, mz

# A free body: mass 2 kg, inertia 0.3 kg m^2 about z.
BODY = (
    '<robot name="body"><link name="body"><inertial><mass value="2.0"/>'
    '<inertia ixx="0.1" iyy="0.2" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
)
BLOCK = """<robot name="block"><link name="base"/>
<link name="block"><inertial><mass value="1.0"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="-10" upper="10" effort="100" velocity="10"/><dynamics friction="1.0"/></joint></robot>"""


def wrench_of(values: Array) -> list[float]:
    return [values[0], values[1], 0.0, 0.0, 0.0, values[2]]


# --- forces --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("either_terms")
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("dt", [0.01, 0.0025])
def test_set_forces_agree_with_the_appendix(formulation: str, dt: float) -> None:
    """A force that changes at some steps, also while the method's steps are longer than the caller's."""
    simulator = Simulator("five_bar/swing", scene(formulation=formulation), forces=[PUSH])
    expected = initial_state()
    for (begin, end), values in zip(pairwise(TIMES), WRENCHES, strict=True):
        for k in range(round((end - begin) / dt)):
            state = simulator.step(None, dt, wrenches={"push": wrench_of(values)} if k == 0 else None)
        wrench = (1, (0.0, 0.0), lambda t, q_tree, values=values: (values[:2], values[2]))
        q_tree, v_tree = integrate(np.array([begin, end]), [wrench], expected)
        expected = np.concatenate([q_tree[-1], v_tree[-1]])
        assert state.t == pytest.approx(end, abs=1e-12)
        assert_close(state.q_tree, q_tree[-1], 1e-8)
        assert_close(state.v_tree, v_tree[-1], 1e-8)
    assert simulator.stats["python_calls"] == 0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_set_forces_agree_with_the_run_of_their_table(formulation: str) -> None:
    columns = {"t": TIMES[:-1], "fx": WRENCHES[:, 0], "fy": WRENCHES[:, 1], "mz": WRENCHES[:, 2]}
    overrides = scene(formulation=formulation, t_end=0.9, solver={"rtol": 1e-12, "output_dt": 0.01})
    table = {"frame": "link_2", "file": columns, "interpolation": "hold"}
    run = simulate(Scene("five_bar", forces=[table], **overrides))
    simulator = Simulator(Scene("five_bar", **overrides), forces=[PUSH])
    for k in range(90):
        piece = next((n for n, t in enumerate(TIMES) if abs(t - 0.01 * k) < 1e-9), None)
        wrenches = None if piece is None else {"push": wrench_of(WRENCHES[piece])}
        state = simulator.step(None, 0.01, wrenches=wrenches)
        assert_close(state.q_tree, run.q_tree[k + 1], 1e-9)
        assert_close(state.v_tree, run.v_tree[k + 1], 1e-9)


def test_impulses_of_set_forces_are_the_momentum_of_a_free_body() -> None:
    body = Mechanism.from_urdf(trees=[{"file": BODY, "root": "free"}], gravity=[0.0, 0.0, 0.0])
    start = Scene(body, t_end=1.0, formulation="dae", initial={"at": "assembled"}, solver={"rtol": 1e-11})
    simulator, random = Simulator(start, forces=[Force("body", [0.0] * 3, name="push")]), np.random.default_rng(4)
    impulse, turn = np.zeros(3), 0.0
    for _ in range(30):
        force, moment, dt = random.normal(size=3), random.normal(), random.uniform(1e-3, 0.1)
        state = simulator.step(None, dt, wrenches={"push": [*force, 0.0, 0.0, moment]})
        impulse, turn = impulse + dt * force, turn + dt * moment
        pose = state.terms.at.pose
        velocity = pose.linear_part @ state.v_tree  # of the point of the body at the origin
        rate = pose.angular_part @ state.v_tree
        assert_close(2.0 * (velocity + np.cross(rate, pose.translation[1])), impulse, 1e-9)
        assert_close(0.3 * rate, [0.0, 0.0, turn], 1e-9)


def test_axes_of_a_set_force_are_those_of_its_table() -> None:
    follower = Force("link_4", [0.0, 0.0, 0.0], axes="frame", name="follower")
    simulator = Simulator("five_bar/swing", scene(), forces=[follower])
    constant = Force("link_4", [0.3, -0.6, 0.0], [0.0, 0.0, 0.1], axes="frame")
    run = simulate("five_bar/swing", scene(t_end=0.3), forces=[constant])
    for k in range(1, 7):
        state = simulator.step(None, 0.05, wrenches={"follower": [0.3, -0.6, 0.0, 0.0, 0.0, 0.1]})
        assert_close(state.q_tree, run.q_tree[k], 1e-9)


def test_a_stuck_joint_slides_once_the_set_force_exceeds_friction() -> None:
    """Friction of 1 N on 1 kg: nothing moves at 0.9 N; 3 N accelerate by 2 m/s^2; without force it slows by 1 m/s^2."""
    block = Mechanism.from_urdf(BLOCK, gravity=[0.0, 0.0, 0.0])
    simulator = Simulator(
        Scene(block, t_end=1.0, formulation="dae", solver={"rtol": 1e-10}),
        forces=[Force("block", [0.0] * 3, name="push")],
    )
    for _ in range(10):
        assert simulator.step(None, 0.01, wrenches={"push": [0.9, 0.0, 0.0]}).q_tree[0] == 0.0
    state = simulator.step(None, 0.5, wrenches={"push": [3.0, 0.0, 0.0]})
    assert_close([state.q_tree[0], state.v_tree[0]], [0.25, 1.0], 1e-9)
    state = simulator.step(None, 0.5, wrenches={"push": [0.0, 0.0, 0.0]})
    assert_close([state.q_tree[0], state.v_tree[0]], [0.25 + 0.5 - 0.125, 0.5], 1e-9)
    state = simulator.step(None, 1.0)
    assert_close([state.q_tree[0], state.v_tree[0]], [0.25 + 0.375 + 0.125, 0.0], 1e-9)


def test_reset_restores_the_forces_of_the_scene() -> None:
    simulator = Simulator("five_bar/swing", scene(force=[{"frame": "link_2", "force": [0.5, 0.0, 0.0]}]))
    first = [simulator.step(None, 0.02) for _ in range(5)]
    simulator.step(None, 0.1, wrenches={"link_2": [9.0, 0.0, 0.0]})
    simulator.reset()
    for state in first:
        assert np.array_equal(simulator.step(None, 0.02).q_tree, state.q_tree)
    simulator.reset()
    for state in first:  # an equal value changes nothing
        assert np.array_equal(simulator.step(None, 0.02, wrenches={"link_2": [0.5, 0.0, 0.0]}).q_tree, state.q_tree)


@pytest.mark.parametrize(
    ("wrenches", "says"),
    [
        ({"pull": [0, 0, 0]}, "there is no force 'pull'; constant forces are: push"),
        ({"wind": [0, 0, 0]}, "'wind' is a function of time or of the state and cannot be set; constant are: push"),
        ({"gust": [0, 0, 0]}, "'gust' is a function of time or of the state and cannot be set; constant are: push"),
        ({3: [0, 0, 0]}, "step: wrenches"),
        ({"push": [0, 0]}, r"push: expected 3 finite numbers \(fx, fy, fz\) or 6 \(and mx, my, mz\), got a list"),
        ({"push": [0, 0, np.nan]}, "push: expected 3 finite numbers"),
        ({"push": [0, 0, np.inf, 0, 0, 0]}, "push: expected 3 finite numbers"),
        ({"push": "up"}, "push: expected 3 finite numbers"),
        ({"push": None}, "push: expected 3 finite numbers"),
        ({"push": {"fx": 1.0}}, "push: expected 3 finite numbers"),
        ([1.0, 0.0, 0.0], "step: wrenches: expected a table"),
    ],
)
def test_invalid_wrenches_are_rejected_and_change_nothing(wrenches: Any, says: str) -> None:
    table = {"frame": "link_4", "name": "wind", "file": {"t": [0.0], "fx": [1.0]}, "interpolation": "hold"}
    gust = Force("link_4", lambda t, terms: [0.0, 0.0, 0.0], name="gust")
    simulator, other = (Simulator("five_bar/swing", forces=[PUSH, table, gust]) for _ in range(2))
    before = simulator.step(None, 0.01)
    other.step(None, 0.01)
    with pytest.raises(InputError, match=says):
        simulator.step(None, 0.01, wrenches=wrenches)
    with pytest.raises(InputError, match="u is not finite"):
        simulator.step([np.nan, 0.0], 0.01, wrenches={"push": [5.0, 0.0, 0.0]})
    assert simulator.state is before
    assert np.array_equal(simulator.step(None, 0.01).q_tree, other.step(None, 0.01).q_tree)


def test_a_scene_without_constant_forces_says_how_to_add_one() -> None:
    with pytest.raises(InputError, match=r"constant forces are: none; add Force\(frame"):
        Simulator("five_bar/swing").step(None, 0.01, wrenches={"push": [0.0, 0.0, 0.0]})


# --- acting controllers --------------------------------------------------------------------------

SERVO = {
    "type": "joint_servo",
    "motor": {
        "theta_1": {"K_P": 8.0, "K_I": 30.0, "K_D": 0.6, "desired": {"offset": -1.0, "harmonics": [[0.2, 5.0, 0.0]]}},
        "theta_3": {"mode": "velocity", "K_P": 0.5, "K_I": 2.0, "desired": {"rate": 0.3}},
    },
}
SAMPLED = {"controller.sample_time": 0.004, "controller.delay": 0.006, "controller.drive": {"torque_resolution": 0.05}}
NOISY = {
    "controller.sample_time": 0.004,
    "controller.sensor": {"resolution": 1e-4, "q_noise": 1e-5, "rate": "difference"},
}
TORQUES = {"controller": {"type": "torques", "file": {"t": [0.0, 0.1, 0.25], "theta_1": [0.0, 0.4, -0.3],
                                                     "theta_3": [0.1, 0.0, 0.2]}}}  # fmt: skip
TIGHT = {"solver.rtol": 1e-10, "solver.output_dt": 0.02}
ACTING = [
    ("five_bar/tracking", {"formulation": "reduced"}),
    ("five_bar/tracking", {"formulation": "dae"}),
    ("five_bar/set_point", SAMPLED),
    ("five_bar/tracking", NOISY),
    ("five_bar/set_point", {"formulation": "spf"}),
    ("five_bar/set_point", {"controller": SERVO}),
    ("five_bar/set_point", {"controller": {**SERVO, "sample_time": 0.005}}),
    ("five_bar/friction", {"t_end": 0.6}),
    ("four_bar/servo", {}),
    ("slider_crank/driven", {}),
    ("delta/circle", {}),
    ("stewart/wave", {}),
    ("three_rrr/circle", {}),
    ("five_bar/swing", {}),
]


def assert_follows(simulator: Simulator, run: Any, tolerance: float) -> None:
    for k in range(1, len(run.t)):
        state = simulator.step(dt=run.t[k] - run.t[k - 1])
        assert state.t == pytest.approx(run.t[k], abs=1e-12)
        assert_close(state.q_tree, run.q_tree[k], tolerance)
        assert_close(state.v_tree, run.v_tree[k], 100 * tolerance)


@pytest.mark.parametrize(("name", "overrides"), ACTING)
def test_steps_under_the_controller_agree_with_the_run(name: str, overrides: dict[str, Any]) -> None:
    config = {**TIGHT, "t_end": 0.4, **overrides}
    run = simulate(name, config)
    assert run.status == "done"
    simulator = Simulator(name, config, controlled=True)
    is_sampled = "sample_time" in str(overrides)  # It samples when the first step begins.
    assert_close(simulator.tau, 0.0 if is_sampled else run.tau[0], 1e-9, relative=True)
    assert_follows(simulator, run, 1e-7)
    assert_close(simulator.tau, run.tau[-1], 1e-5, relative=True)
    assert simulator.stats["python_calls"] == 0


def test_steps_under_torques_over_time_and_python_laws_agree_with_the_run() -> None:
    for law in (TORQUES["controller"], lambda t, terms: [-0.3 * terms.q_dot[0], 0.2 * np.sin(9 * t)]):
        made = Scene("five_bar", t_end=0.4, initial={"q": START}, controller=law, solver={"rtol": 1e-10})
        simulator = Simulator(made, controlled=True)
        assert_follows(simulator, simulate(made, {"solver.output_dt": 0.02}), 1e-8)


@pytest.mark.parametrize("overrides", [{"controller": SERVO}, {"controller": {**SERVO, "sample_time": 0.005}}, NOISY])
def test_reset_begins_the_controller_anew(overrides: dict[str, Any]) -> None:
    """To the bit, with the integral of a PID, samples, and the noise of sensors."""
    simulator = Simulator("five_bar/tracking", overrides, controlled=True)
    first = [simulator.step(dt=0.0123) for _ in range(20)]
    simulator.reset()
    for state in first:
        assert np.array_equal(simulator.step(dt=0.0123).q_tree, state.q_tree)


@pytest.mark.parametrize("sample_time", [None, 0.005])
def test_a_controller_after_reset_to_a_later_state_has_no_history(sample_time: float | None) -> None:
    """With constant targets the motion from a state at t = 1.001 s is that from the same state at t = 0.

    A sampled controller samples at once; its clock is then 1 ms ahead, so its second sample comes 4 ms later.
    """
    motor = {name: {"K_P": 8.0, "K_I": 60.0, "K_D": 0.6, "desired": {"offset": x}}
             for name, x in (("theta_1", -1.0), ("theta_3", -1.9))}  # fmt: skip
    keys: dict[str, Any] = {} if sample_time is None else {"sample_time": sample_time}
    made = Scene("five_bar", t_end=2.0, initial={"q": START}, solver={"rtol": 1e-11},
                 controller={"type": "joint_servo", "motor": motor, **keys})  # fmt: skip
    early, late = Simulator(made, controlled=True), Simulator(made, controlled=True)
    start = early.state
    late.reset(State(late.mechanism, 1.0, start._packed.copy(), start._q_indices, start._z_indices))
    for _ in range(10):
        ours, theirs = late.step(dt=0.02), early.step(dt=0.02)
        assert_close(ours.q_tree, theirs.q_tree, 1e-9)
    assert np.abs(ours.v_tree).max() > 0.1
    if sample_time is not None:
        late.reset(State(late.mechanism, 1.001, start._packed.copy(), start._q_indices, start._z_indices))
        early.reset()
        assert_close(late.step(dt=0.003).q_tree, early.step(dt=0.003).q_tree, 1e-10)
        first_tau = early.tau
        assert_close(late.tau, first_tau, 1e-12)
        late.step(dt=0.0015)
        assert np.abs(late.tau - first_tau).max() > 1e-4


def test_forces_push_a_controlled_mechanism() -> None:
    """Tracking with a push, compared with eq. 16 and the force in the appendix's equations."""
    config = {"solver.rtol": 1e-11, "formulation": "reduced"}
    simulator = Simulator("five_bar/tracking", config, forces=[PUSH], controlled=True)
    state = simulator.state
    for k in range(10):
        state = simulator.step(dt=0.02, wrenches={"push": [3.0, -1.0, 0.0]} if k == 5 else None)
    columns = {"t": [0.0, 0.1], "fx": [0.0, 3.0], "fy": [0.0, -1.0]}
    table = {"frame": "link_2", "file": columns, "interpolation": "hold"}
    run = simulate("five_bar/tracking", {**config, "t_end": 0.2}, forces=[table])
    assert_close(state.q_tree, run.q_tree[-1], 1e-9)
    assert np.abs(run.q_tree[-1] - simulate("five_bar/tracking", {**config, "t_end": 0.2}).q_tree[-1]).max() > 1e-3


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"u": [0.0, 0.0], "dt": 0.1}, "step: u: the scene's controller acts; remove u, or controlled=True"),
        ({"tau": [0.0, 0.0], "dt": 0.1}, "step: tau: the scene's controller acts"),
        ({"dt": None}, "dt = None"),
        ({"dt": 0.1, "desired": [0.0]}, r"step: desired: expected shape \(2,\)"),
        ({"dt": 0.1, "desired": {"theta_9": 0.0}}, "theta_9"),
        ({"dt": 0.1, "desired": [0.0, np.nan]}, "step: desired is not finite"),
    ],
)
def test_invalid_steps_of_a_controlled_simulator_are_rejected(arguments: dict[str, Any], says: str) -> None:
    simulator = Simulator("five_bar/tracking", controlled=True)
    before = simulator.step(dt=0.01)
    with pytest.raises(InputError, match=says):
        simulator.step(**arguments)
    assert simulator.state is before
    with pytest.raises(InputError, match="Simulator: controlled: expected"):
        Simulator("five_bar/tracking", controlled="yes")  # type: ignore[arg-type]


# --- moved targets -------------------------------------------------------------------------------


def follow_line(begin: float, end: float, state: Array, start: Array, target: Array) -> Array:
    """Integrate eq. 6 of the appendix under eq. 16, with q_d on a line from `start` to `target`."""
    rate = (target - start) / (end - begin)

    def derivative(t: float, y: Array) -> Array:
        q_tree, q_dot = FIVE_BAR.sigma(y[:2]), y[2:]
        error, error_dot = y[:2] - start - rate * (t - begin), q_dot - rate
        v, a, r = rate - 4.0 * error, -4.0 * error_dot, error_dot + 4.0 * error
        C = FIVE_BAR.C(q_tree, FIVE_BAR.rho(q_tree) @ q_dot)
        u = FIVE_BAR.D(q_tree) @ a + C @ v + FIVE_BAR.h(q_tree) - 0.5 * r
        return np.concatenate([q_dot, FIVE_BAR.acceleration(q_tree, q_dot, u)])

    result: Array = solve_ivp(derivative, (begin, end), state, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return result


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_moved_targets_agree_with_eq_16_of_the_appendix(formulation: str) -> None:
    law = {"type": "tracking", "Lambda": 4.0, "K_D": 0.5, "desired": {name: {"offset": x} for name, x in START.items()}}
    made = Scene("five_bar", t_end=1.0, initial={"q": START}, controller=law, formulation=formulation,
                 solver={"rtol": 1e-11})  # fmt: skip
    simulator, target = Simulator(made, controlled=True), np.array(list(START.values()))
    expected, t = np.concatenate([target, [0.0, 0.0]]), 0.0
    moves = [None, {"theta_1": -1.1}, [-1.0, -1.8], None, None, {"theta_1": -1.0}, {"theta_3": -2.0}, None]
    for move in moves:
        present = target.copy()
        if isinstance(move, dict):
            target = np.array([move.get(name, x) for name, x in zip(START, target, strict=True)])
        elif move is not None:
            target = np.array(move)
        state = simulator.step(dt=0.05, desired=move)
        expected, t = follow_line(t, t + 0.05, expected, present, target), t + 0.05
        assert_close(state.q, expected[:2], 1e-8)
        assert_close(state.q_dot, expected[2:], 1e-7)
    assert simulator.stats["python_calls"] == 0
    simulator.reset()
    assert_close(simulator.step(dt=0.05).q, list(START.values()), 1e-8)  # the scene's targets again


@pytest.mark.parametrize("name", ["five_bar/set_point", "five_bar/swing", "four_bar/servo"])
def test_only_tracking_controllers_take_targets(name: str) -> None:
    with pytest.raises(
        InputError, match='step: desired: it replaces the desired motion of an acting controller of type "tracking"'
    ):
        Simulator(name, controlled=True).step(dt=0.01, desired={})
    with pytest.raises(InputError, match="step: desired: it replaces"):
        Simulator("five_bar/tracking").step(dt=0.01, desired={})


def test_files_of_forces_are_read(tmp_path: Path) -> None:
    (tmp_path / "push.csv").write_text("t,fx\n0.0,0.0\n0.1,2.0\n")
    table = {"frame": "link_2", "file": str(tmp_path / "push.csv"), "interpolation": "hold"}
    made = Scene("five_bar", t_end=0.2, initial={"q": START})
    simulator = Simulator(made, forces=[{**table, "file": {"t": [0.0, 0.1], "fx": [0.0, 2.0]}}])
    run = simulate(made, forces=[table])
    assert_close(simulator.step(None, 0.2).q_tree, run.q_tree[-1], 1e-7)


def test_cancel_ends_a_step_at_the_state_it_has_reached() -> None:
    simulator = Simulator("five_bar/swing", {"formulation": "reduced", "solver.rtol": 1e-12})
    Timer(0.2, simulator.cancel).start()
    state = simulator.step(None, 1e6)
    assert 0.0 < state.t < 1e6
    assert_close(state.terms.phi, 0.0, 1e-12)
    assert simulator.step(None, 0.01).t == pytest.approx(state.t + 0.01)
