"""Prescribed motions that begin or end in the run: the five-bar by SciPy, with two freedoms or one in each part."""

from __future__ import annotations

import math
import re
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, Run, Simulator, inverse_dynamics, linearize, simulate
from ckc_pin.mechanism.library import library
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.conftest import assert_close, remember

pytestmark = pytest.mark.usefixtures("either_terms")

FORMULATIONS = ["dae", "reduced", "spf"]
Q_START, RATES = [-1.4, -1.7], [0.5, 0.8]
AMPLITUDE, FREQUENCY, PHASE = 0.3, 5.0, 0.4
MOTION = {"joint": "theta_1", "offset": -1.4, "harmonics": [[AMPLITUDE, FREQUENCY, PHASE]]}
FREE_START = {
    "q": {"theta_1": Q_START[0], "theta_3": Q_START[1]},
    "q_dot": {"theta_1": RATES[0], "theta_3": RATES[1]},
}


def scene(formulation: str, prescribed: dict[str, Any], **overrides: Any) -> dict[str, Any]:
    return {
        "formulation": formulation,
        "t_end": 1.0,
        "prescribed": [{**MOTION, **prescribed}],
        "initial": FREE_START,
        "solver": {"rtol": 1e-11, "output_dt": 0.05},
        **overrides,
    }


def wave(t: float) -> Array:
    """Position, rate and acceleration of the motion."""
    angle = FREQUENCY * t + PHASE
    parts = [np.sin(angle), FREQUENCY * np.cos(angle), -(FREQUENCY**2) * np.sin(angle)]
    return AMPLITUDE * np.array(parts) + [-1.4, 0.0, 0.0]


def terms(q: Array, q_dot: Array) -> tuple[Array, Array]:
    q_tree = FIVE_BAR.sigma(q)
    return FIVE_BAR.D(q_tree), FIVE_BAR.force(q_tree, q_dot, np.zeros(2))


def free(_t: float, y: Array) -> Array:
    D, rest = terms(y[:2], y[2:])
    return np.concatenate([y[2:], -np.linalg.solve(D, rest)])


def driven(acceleration: Any) -> Any:
    def rate(t: float, y: Array) -> Array:
        D, rest = terms(y[:2], y[2:])
        q_1_ddot = acceleration(t)
        return np.array([*y[2:], q_1_ddot, (-rest[1] - D[1, 0] * q_1_ddot) / D[1, 1]])

    return rate


def integrate(rate: Any, span: tuple[float, float], y: Array, times: Array) -> Any:
    return solve_ivp(rate, span, y, "DOP853", times, rtol=1e-13, atol=1e-14)


@remember
def let_go(times: Array, at: float) -> Array:
    """(q, q_dot) where the left crank is driven until an instant."""
    before, after = times[times <= at], times[times > at]
    start = np.array([wave(0)[0], Q_START[1], wave(0)[1], RATES[1]])
    first = integrate(driven(lambda t: wave(t)[2]), (0, at), start, np.append(before, at))
    return np.vstack([first.y.T[: len(before)], integrate(free, (at, times[-1]), first.y[:, -1], after).y.T])


def caught_state(y: Array, rate: float) -> Array:
    """The state after an impulse of the left crank's motor has changed its rate; no impulse acts along theta_3."""
    D, _ = terms(y[:2], y[2:])
    jump = rate - y[2]
    return y + np.array([0.0, 0.0, jump, -D[1, 0] / D[1, 1] * jump])


def fall(until: float, event: Any = None) -> Any:
    return solve_ivp(
        free, (0, until), [*Q_START, *RATES], "DOP853", dense_output=True, rtol=1e-13, atol=1e-14, events=event
    )


@cache
def fall_to_contact() -> Any:
    """The free motion until theta_3 falls through -1.65."""

    def crosses(_t: float, y: Array) -> Any:
        return y[1] + 1.65

    crosses.terminal, crosses.direction = True, -1  # type: ignore[attr-defined]
    return fall(1.0, crosses)


@remember
def caught(times: Array, until: float | None = None) -> Array:
    """(q, q_dot) where the left crank is driven after a free motion, until an instant or the contact."""
    first = fall_to_contact() if until is None else fall(until)
    at = float(first.t[-1])
    y = caught_state(first.y[:, -1], wave(0)[1])
    second = integrate(driven(lambda t: wave(t - at)[2]), (at, times[-1]), y, times[times > at])
    return np.vstack([first.sol(times[times <= at]).T, second.y.T])


def assert_motion(run: Run, expected: Array, tolerance: float) -> None:
    assert run.status == "done", run.message
    assert run.independent == ("theta_3",)
    assert_close(run.q_tree[:, [0, 2]], expected[:, :2], tolerance)
    assert_close(run.v_tree[:, [0, 2]], expected[:, 2:], 20 * tolerance)
    assert run.max_phi < 1e-10
    assert run.max_phi_dot < 1e-8


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("method", ["auto", "Radau"])
def test_a_joint_that_is_let_go_falls_with_the_loop(formulation: str, method: str) -> None:
    overrides = {"solver": {"rtol": 1e-11, "output_dt": 0.05, "method": method}}
    run = simulate("five_bar/swing", scene(formulation, {"ends": 0.43}, **overrides))
    assert_motion(run, let_go(run.t, 0.43), 1e-9)
    tau = run["tau.theta_1"]
    assert np.all(tau[run.t > 0.43] == 0.0)
    assert np.all(np.abs(tau[run.t < 0.43]) > 1e-3)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_joint_is_driven_from_an_instant_on(formulation: str) -> None:
    run = simulate("five_bar/swing", scene(formulation, {"begins": 0.43}, work=True))
    assert_motion(run, caught(run.t, 0.43), 1e-9)
    assert run.works is not None
    assert_close(run.works[:, 0], run.energy - run.energy[0], 1e-8)  # the impulse is work of the motor


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_joint_is_driven_from_an_event_on(formulation: str) -> None:
    event = {"coordinate": "theta_3", "value": -1.65, "direction": -1, "name": "contact"}
    run = simulate("five_bar/swing", scene(formulation, {"begins": "contact"}, event=[event]))
    first = fall_to_contact()
    assert 0.1 < first.t[-1] < 0.9
    assert_close(run.events[0]["t"], first.t[-1], 1e-10)
    assert run.events[0]["name"] == "contact"
    assert_motion(run, caught(run.t), 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_corners_of_a_motion_that_begins_at_an_event_end_steps(formulation: str) -> None:
    """A trapezoid of its shortest duration: 0.05 s at 10 rad/s^2, 0.15 s at 0.5 rad/s, 0.05 s at -10 rad/s^2."""
    event = {"coordinate": "theta_3", "value": -1.65, "direction": -1, "name": "contact"}
    way = {"waypoints": [[0.0, 0.0], [0.25, 0.1]], "profile": "trapezoidal", "max_rate": 0.5, "max_acceleration": 10.0}
    prescribed = [{"joint": "theta_1", "begins": "contact", **way}]
    run = simulate("five_bar/swing", {**scene(formulation, {}, event=[event], t_end=0.8), "prescribed": prescribed})
    assert run.status == "done"
    first = fall_to_contact()
    at, y = float(first.t[-1]), caught_state(first.y[:, -1], 0.0)
    for begin, end, acceleration in ((0.0, 0.05, 10.0), (0.05, 0.2, 0.0), (0.2, 0.25, -10.0), (0.25, 0.8 - at, 0.0)):
        rows = (run.t > at + begin) & (run.t <= at + end)
        rate = driven(lambda _t, a=acceleration: a)
        part = solve_ivp(rate, (begin, end), y, "DOP853", dense_output=True, rtol=1e-13, atol=1e-14)
        assert_close(run.q_tree[rows][:, [0, 2]], part.sol(run.t[rows] - at)[:2].T, 1e-9)
        y = part.y[:, -1]


def test_a_brake_holds_the_joint_and_lets_it_go_again() -> None:
    run = simulate("five_bar/swing", scene("reduced", {"harmonics": [], "begins": 0.2, "ends": 0.5}))
    at = {t: float(run["theta_1"][np.argmin(np.abs(run.t - t))]) for t in (0.2, 0.35, 0.5, 0.8)}
    assert_close(at[0.35], at[0.2], 1e-12)
    assert_close(at[0.5], at[0.2], 1e-12)
    assert abs(at[0.8] - at[0.2]) > 1e-3
    y = np.array([*run.q_tree[10, [0, 2]], 0.0, run.v_tree[10, 2]])
    assert_close(run.t[10], 0.5, 1e-12)
    after = integrate(free, (0.5, 1.0), y, run.t[11:]).y.T
    assert_close(run.q_tree[11:][:, [0, 2]], after[:, :2], 1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("parameters", [{}, {"joint.theta_3.friction": 0.05}])
def test_stops_and_friction_of_other_joints_act_while_the_joint_is_free(
    formulation: str, parameters: dict[str, float]
) -> None:
    """From where it is let go, the motion is that of the mechanism without any prescribed joint."""
    parameters = {"joint.theta_4.friction": 0.02, **parameters}
    run = simulate("five_bar/swing", scene(formulation, {"ends": 0.3}, parameters=parameters))
    k = int(np.argmin(np.abs(run.t - 0.3)))
    start = {
        "q": dict(zip(run.coordinates, run.q_tree[k].tolist(), strict=True)),
        "q_dot": {name: run[f"v.{name}"][k] for name in ("theta_1", "theta_3")},
    }
    overrides = {
        "formulation": formulation, "t_end": 0.7, "initial": start, "parameters": parameters,
        "solver": {"rtol": 1e-11, "output_dt": 0.05},
    }  # fmt: skip
    other = simulate("five_bar/swing", overrides)
    assert other.status == run.status == "done"
    assert_close(run.q_tree[k:], other.q_tree, 1e-8)
    transitions = [(e["name"], e["direction"]) for e in run.events if e["t"] > 0.3 + 1e-9]
    assert transitions == [(e["name"], e["direction"]) for e in other.events if e["t"] > 1e-9]
    assert_close(run["a.theta_1"][k + 1 :], other["a.theta_1"][1:], 1e-5)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_accelerations_and_loop_forces_of_both_parts(formulation: str) -> None:
    run = simulate("five_bar/swing", scene(formulation, {"ends": 0.43}))
    for k in np.flatnonzero(run.t > 0.43):
        D, rest = terms(run.q_tree[k, [0, 2]], run.v_tree[k, [0, 2]])
        q_ddot = -np.linalg.solve(D, rest)
        assert_close([run[f"a.{name}"][k] for name in ("theta_1", "theta_3")], q_ddot, 1e-7)
    assert_close(inverse_dynamics(run).tau, run.tau, 1e-8)


def test_a_simulator_switches_as_a_run() -> None:
    overrides = scene("reduced", {"begins": 0.2, "ends": 0.43})
    run, simulator = simulate("five_bar/swing", overrides), Simulator("five_bar/swing", overrides)
    for k in range(1, len(run.t)):
        state = simulator.step(dt=run.t[k] - run.t[k - 1])
        assert_close(state.q_tree, run.q_tree[k], 1e-9)
    with pytest.raises(InputError, match="begins or ends"):
        simulator.reset(state)


def test_a_run_is_the_same_after_loading(tmp_path: Any) -> None:
    run = simulate("five_bar/swing", scene("dae", {"ends": 0.43}))
    run.save(tmp_path / "run.npz")
    loaded = Run.load(tmp_path / "run.npz")
    assert np.array_equal(loaded["a.theta_1"], run["a.theta_1"])


@pytest.mark.parametrize(
    ("prescribed", "overrides", "message"),
    [
        ({"begins": 0.5, "ends": 0.5}, {}, "ends = 0.5 has to be greater than begins = 0.5"),
        (
            {"begins": "contact"},
            {},
            "begins = 'contact': no event has this name; there are none; give one by [[event]]",
        ),
        (
            {"ends": "contact"},
            {"event": [{"coordinate": "theta_3", "value": 1.0}]},
            "ends = 'contact': no event has this name; there are 'theta_3 = 1'",
        ),
        ({"begins": 0.0}, {}, "prescribed[0].begins"),
        ({"begins": 0.5}, {"parameters": {"joint.theta_1.friction": 0.1}}, "give friction_smoothing"),
        ({"begins": 0.5}, {"initial": {"at": "equilibrium"}}, "move freely at first; give initial.q"),
    ],
)
def test_refused(prescribed: dict[str, Any], overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        simulate("five_bar/swing", scene("reduced", prescribed, **overrides))


def test_linear_models_refuse_joints_that_begin_or_end() -> None:
    overrides = scene("reduced", {"ends": 0.43})
    for t in (0.2, 0.7):
        with pytest.raises(InputError, match="begins or ends in the run"):
            linearize("five_bar/swing", t, overrides)


def test_a_full_turn_ends_after_its_time() -> None:
    """A crank that is driven for a while, then runs on by itself: its energy is conserved from there on."""
    crank = {"joint": "crank", "offset": 0.5, "rate": 6.0, "ends": 0.7}
    run = simulate("slider_crank", {"prescribed": [crank], "t_end": 1.5, "solver": {"rtol": 1e-11}})
    assert run.status == "done"
    after = run.energy[run.t > 0.7]
    assert np.ptp(after) < 1e-8 * max(1.0, math.fabs(after[0]))
    assert np.ptp(run["crank"][run.t > 0.7]) > 1.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impacts_move_a_joint_that_is_free(formulation: str, tmp_path: Path) -> None:
    """theta_3 hits its stops after the left crank is let go. Without a prescribed joint the rest is the same."""
    folder = tmp_path / "five_bar"
    shutil.copytree(library() / "five_bar", folder)
    text, urdf = (folder / "mechanism.toml").read_text(), (folder / "five_bar.urdf").read_text()
    (folder / "mechanism.toml").write_text(f'{text}\n[[joint]]\nname = "theta_3"\nstops = true\n')
    joint = re.search(r'<joint name="theta_3".*?</joint>', urdf, re.DOTALL)
    assert joint
    limited = joint[0].replace('"continuous"', '"revolute"').removesuffix("</joint>")
    limited += '<limit lower="-1.95" upper="-1.62" effort="1" velocity="1"/></joint>'
    (folder / "five_bar.urdf").write_text(urdf.replace(joint[0], limited))
    mechanism = str(folder / "mechanism.toml")
    overrides = {**scene(formulation, {"ends": 0.05}), "mechanism": mechanism}
    run = simulate("five_bar/swing", overrides)
    start = {
        "q": dict(zip(run.coordinates, run.q_tree[1].tolist(), strict=True)),
        "q_dot": {name: run[f"v.{name}"][1] for name in ("theta_1", "theta_3")},
    }
    other = simulate(
        "five_bar/swing",
        {**overrides, "prescribed": [], "initial": start, "t_end": 0.95},
    )
    impacts = [e for e in run.events if e["of"] == "stop"]
    assert impacts
    assert [e["name"] for e in impacts] == [e["name"] for e in other.events if e["of"] == "stop"]
    assert_close([e["t"] - 0.05 for e in impacts], [e["t"] for e in other.events if e["of"] == "stop"], 1e-8)
    assert_close(run.q_tree[1:], other.q_tree, 1e-7)
    assert_close(run.energy[1:], other.energy, 1e-7)
