"""Time-optimal motions along paths: closed forms, torques within limits, replays in the step loop, and messages."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import ckc_pin
from ckc_pin import InputError, NumericalError, Plan, optimize
from tests.contract.helpers.command import ckc
from tests.optimization.small_models import (
    MASS,
    REPLAY,
    pendulum,
    pendulum_duration,
    require_replay,
    slider,
)

FIVE_BAR = {"q": {"theta_1": [-1.434, -1.2, -1.0], "theta_3": [-1.707, -1.6, -1.9]}}
PICK = {"point": {"plate": [[0.0, 0.0, -0.29], [0.0, 0.0, -0.27], [0.1, 0.0, -0.27], [0.1, 0.0, -0.29]]},
        "shape": "lines", "rounding": 0.01}  # fmt: skip


@cache
def five_bar(intervals: int | None = None) -> Plan:
    return optimize("five_bar", path=FIVE_BAR, limits={"torque": 2.0}, intervals=intervals)


def test_double_integrator_is_bang_bang() -> None:
    distance, force = 0.7, 3.0
    plan = optimize(slider(), path={"q": {"rail": [0.0, distance]}}, limits={"torque": force})
    assert plan.t_end == pytest.approx(2 * np.sqrt(distance * MASS / force), rel=2e-5)
    require_replay(plan, force)


def test_pendulum_is_bang_bang() -> None:
    """One switch of the torque. The duration is an integral over the angle."""
    angle, torque = 1.0, 9.0
    plan = optimize(pendulum(torque_limit=torque), path={"q": {"hinge": [0.0, angle]}})
    assert plan.t_end == pytest.approx(pendulum_duration(angle, torque), rel=3e-5)
    require_replay(plan, torque)


def test_rate_and_acceleration_limits_give_a_trapezoid() -> None:
    limits = {"rate": 0.4, "acceleration": 1.6}
    plan = optimize(slider(), path={"q": {"rail": [0.0, 0.7]}}, limits=limits)
    assert plan.t_end == pytest.approx(0.7 / 0.4 + 0.4 / 1.6, rel=3e-5)
    reached = {x.quantity for x in plan.active}
    assert reached == {"v.rail", "a.rail"}


def test_friction_and_damping_slow_the_motion_down() -> None:
    """Forth with F - friction - c v, back with -F - friction - c v: exponentials with one switch."""
    distance, force, friction, damping = 0.7, 3.0, 0.5, 2.0
    rate = damping / MASS

    def travel(v: float, drive: float, t: float) -> tuple[float, float]:
        final = (drive - friction) / damping
        return final * t + (v - final) * (1 - np.exp(-rate * t)) / rate, final + (v - final) * np.exp(-rate * t)

    def stopping(first: float) -> tuple[float, float]:
        way, speed = travel(0.0, force, first)
        final = (-force - friction) / damping
        second = np.log((speed - final) / -final) / rate
        return way + travel(speed, -force, second)[0] - distance, second

    first = brentq(lambda t: stopping(t)[0], 0.1, 2.0)
    mechanism = slider(damping=damping, friction=friction)
    plan = optimize(mechanism, path={"q": {"rail": [0.0, distance]}}, limits={"torque": force}, intervals=800)
    assert plan.t_end == pytest.approx(first + stopping(first)[1], rel=3e-5)
    require_replay(plan, force)


def test_plan_of_the_five_bar_is_replayed() -> None:
    require_replay(five_bar(), 2.0)


def test_torques_of_the_plan_are_those_of_inverse_dynamics() -> None:
    plan = five_bar()
    for k in (10, len(plan.t) // 2, len(plan.t) - 20):
        q, rate, acceleration = (x[0] for x in plan.motion(plan.t[k : k + 1]))
        names = plan.mechanism.independent
        terms = ckc_pin.terms(plan.mechanism, dict(zip(names, q, strict=True)), dict(zip(names, rate, strict=True)))
        u = terms.D @ acceleration + terms.C @ rate + terms.h
        tau = [plan.columns()[f"tau.{name}"][k] for name in names]
        assert np.abs(u - tau).max() < 1e-9


def test_some_limit_is_active_at_all_times() -> None:
    plan = five_bar()
    shares = np.abs([plan.columns()["tau.theta_1"], plan.columns()["tau.theta_3"]]).max(axis=0) / 2.0
    assert np.mean(shares > 0.99) > 0.95


@pytest.mark.parametrize(("intervals", "tolerance"), [(50, 1e-3), (200, 5e-5)])
def test_duration_converges_with_the_grid(intervals: int, tolerance: float) -> None:
    assert five_bar(intervals).t_end == pytest.approx(five_bar(400).t_end, rel=tolerance)


def test_plate_of_the_delta_follows_lines_with_rounded_corners() -> None:
    plan = optimize("delta", path=PICK, limits={"torque": 5.0}, intervals=100)
    require_replay(plan, 5.0)
    assert "2 corners are rounded" in plan.warnings[0]
    at = plan.motion(np.array([plan.t_end]))[0][0]
    place = ckc_pin.Point(plan.mechanism, "plate").forward(at)
    assert np.abs(place - [0.1, 0.0, -0.29]).max() < 1e-9


def redundant_five_bar() -> ckc_pin.Mechanism:
    """Return the five-bar with a motor on each of its four joints."""
    folder = Path(__file__).parents[2] / "urdf" / "five_bar"
    data = tomllib.loads((folder / "mechanism.toml").read_text(encoding="utf-8"))
    return ckc_pin.Mechanism.from_urdf(
        folder / "five_bar.urdf", loops=data["loop"], gravity=data["gravity"], q_guess=data["q_guess"],
        motors=[{"joint": name} for name in ("theta_1", "theta_3", "theta_2", "theta_4")],
    )  # fmt: skip


def test_redundant_motors_share_the_load_within_their_limits() -> None:
    plan = optimize(redundant_five_bar(), path=FIVE_BAR, limits={"torque": 1.0}, intervals=100)
    require_replay(plan, 1.0)
    assert plan.t_end < 0.9 * optimize("five_bar", path=FIVE_BAR, limits={"torque": 1.0}, intervals=100).t_end


def test_scenes_and_files_replay_the_plan(tmp_path: Path) -> None:
    plan = five_bar()
    files = plan.save(tmp_path)
    assert [path.name for path in files] == ["open.scene.toml", "closed.scene.toml", "plan.csv", "plan.json"]
    q, rates, _ = plan.motion(np.array([plan.t_end]))
    for name in ("open", "closed"):
        run = ckc_pin.simulate(tmp_path / f"{name}.scene.toml")
        at = plan.mechanism.partition.q
        assert np.abs(run.q_tree[-1, at] - q[0]).max() < REPLAY
        assert np.abs(run.v_tree[-1, at] - rates[0]).max() < REPLAY


def test_command_writes_files_and_prints_json(tmp_path: Path) -> None:
    file = tmp_path / "slide.optimize.toml"
    q = "{theta_1 = [-1.434, -1.2], theta_3 = [-1.707, -1.6]}"
    file.write_text(f'mechanism = "five_bar"\npath = {{q = {q}}}\nlimits = {{torque = 2.0}}\nintervals = 30\n')
    answer = ckc("optimize", str(file), "--out", str(tmp_path / "plan"), "--json")
    assert answer.code == 0
    result = json.loads(answer.out)
    assert set(result) == {"name", "status", "message", "t_end", "cost", "parts", "iterations", "replay", "margin",
                           "via_t", "periods", "active", "crossings", "warnings", "files"}  # fmt: skip
    assert set(result["replay"]) == {"error", "max_tau", "closure"}
    assert {x.name for x in (tmp_path / "plan").iterdir()} >= set(result["files"])
    assert "plan.png" in result["files"]


def test_set_and_unset_override_keys_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "slide.optimize.toml"
    path = "[path]\nq = {theta_1 = [-1.434, -1.2], theta_3 = [-1.707, -1.6]}\n"
    file.write_text(f'mechanism = "five_bar"\nintervals = 30\n{path}[limits]\ntorque = 2.0\nrate = 0.5\n')
    options = ["--set", "limits.torque=4.0", "--unset", "limits.rate", "--set", "link.link_2.mass=0.5"]
    answer = ckc("optimize", str(file), *options, "--json")
    heavier = ckc_pin.load("five_bar", {"link.link_2.mass": 0.5})
    places = {"q": {"theta_1": [-1.434, -1.2], "theta_3": [-1.707, -1.6]}}
    assert answer.json["t_end"] == optimize(heavier, path=places, limits={"torque": 4.0}, intervals=30).t_end
    wrong = ckc("optimize", str(file), "--set", "limits.toque=4.0")
    assert (wrong.code, "unknown key 'toque'" in wrong.err) == (2, True)


PATH = {"q": {"theta_1": [-1.4, -1.2], "theta_3": [-1.7, -1.6]}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": {}}, "path: expected one of q and point, got neither"),
        ({"path": {"q": {"theta_1": [-1.4, -1.2]}}}, "path.q: needs places of each of theta_1, theta_3; 'theta_3'"),
        ({"path": {"q": {"theta_1": [-1.4], "theta_3": [-1.7]}}}, "at least two places are needed"),
        ({"path": {"q": {"theta_1": [-1.4, -1.2], "theta_3": [-1.7]}}}, "expected equally many places"),
        ({"path": {"q": {"theta_1": [-1.4, -1.4], "theta_3": [-1.7, -1.7]}}}, "the same place twice in a row"),
        ({"path": {**PATH, "rounding": 0.1}}, 'path.rounding belongs to shape = "lines"'),
        ({"path": {"point": {"tip": [[0.15, -0.55, 0.0], [3.0, 0.0, 0.0]]}}}, "cannot follow the path beyond"),
        (
            {"path": {"q": {"theta_1": [-1.434, 2.0], "theta_3": [-1.707, -5.5]}}},
            "cannot be kept closed on this branch",
        ),
        ({"limits": {}}, "limits: nothing limits the speed; give torque, rate or acceleration"),
        ({"limits": {"torque": {"theta_2": 1.0}}}, "limits.torque: no motor 'theta_2'"),
        ({"limits": {"q": {"theta_1": [-1.3, 0.0]}, "torque": 2.0}}, "theta_1 = -1.4 at s = 0.0000 is outside"),
        ({"limits": {"torque": 2.0, "time": 0.01}}, "infeasible: limits.time = 0.01 s: the fastest motion takes"),
        ({"limits": {"torque": 2.0, "singularity": 0.99}}, "below limits.singularity = 0.99"),
        ({"minimize": {"time": 0.0}}, "minimize: every weight is zero"),
        ({"minimize": {"tme": 1.0}}, "tme"),
    ],
)
def test_wrong_input_is_explained(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"path": PATH, "limits": {"torque": 2.0}, **change}
    with pytest.raises(InputError) as error:
        optimize("five_bar", **arguments)
    assert message in str(error.value)


def test_motors_that_cannot_hold_the_mechanism_are_named() -> None:
    with pytest.raises(NumericalError, match=r"infeasible: at s = .* no speed is within the limits of tau\.hinge"):
        optimize(pendulum(torque_limit=1.0), path={"q": {"hinge": [0.0, 1.0]}})


def test_a_fine_grid_is_replayed() -> None:
    """Divided intervals of a fine grid are shorter than the gap between rows of the torques' table."""
    path = {"a_1": [-0.675, -0.5, -0.4], "a_2": [1.419, 1.5, 1.3], "a_3": [3.514, 3.4, 3.5]}
    plan = optimize("three_rrr", path={"q": path}, limits={"torque": 1.0}, intervals=1000)
    require_replay(plan, 1.0)
