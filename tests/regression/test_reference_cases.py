"""Cases with independent results: published values, closed forms and simple integrals."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import Run, simulate
from tests.regression import flyball, one_freedom

FORMULATIONS = ("dae", "reduced", "spf")


def command(*words: str) -> dict[str, Any]:
    """The JSON of `ckc run`, called as a separate program."""
    done = subprocess.run(
        [sys.executable, "-m", "ckc_pin", "run", *words, "--json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


# --- Andrews' squeezing mechanism ----------------------------------------------------------------

ANDREWS = {
    "beta": 15.81077119515370,
    "theta": -15.75637105841184,
    "gamma": 0.04082224011964587,
    "phi": -0.5347301163420793,
    "delta": 0.5244099658799541,
    "omega": 0.5347301163420791,
    "eps": 1.048080741041938,
}


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_andrews_squeezer(formulation: str) -> None:
    run_json = command("andrews", "--set", f"formulation={formulation}")
    q = dict(zip(run_json["coordinates"], run_json["q_tree"], strict=True))
    assert set(q) == set(ANDREWS)
    for name, expected in ANDREWS.items():
        assert abs(q[name] - expected) <= 1e-8, name  # the test set asks for 1e-7


# --- Bricard's mechanism -------------------------------------------------------------------------

P3_AT_1 = (0.27448132, -0.88670794, -0.46233000)  # published to eight digits
BRICARD_PERIOD = 4.99171151369


def test_bricard_from_the_command_line() -> None:
    run_json = command("bricard")
    assert run_json["t"] == 1.0
    np.testing.assert_allclose(run_json["points"]["P3"], P3_AT_1, rtol=0, atol=1e-8)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_bricard_swings_with_its_period(formulation: str) -> None:
    overrides: dict[str, Any] = {"formulation": formulation, "t_end": 1.1 * BRICARD_PERIOD}
    overrides["event"] = [
        {"coordinate": "hinge_1", "of": "q_dot", "value": 0.0, "direction": 1},
        {"coordinate": "hinge_1", "of": "q_dot", "value": 0.0, "direction": -1},
    ]
    run = simulate("bricard", overrides)
    assert run.status == "done", run.message
    half, whole = sorted(event["t"] for event in run.events)
    assert half == pytest.approx(BRICARD_PERIOD / 2, abs=1e-8)
    assert whole == pytest.approx(BRICARD_PERIOD, abs=1e-8)


# --- slider-cranks -------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("scene", "rate", "mechanism"),
    [
        ("slider_crank", 20.0, one_freedom.slider_crank),
        ("slider_crank_spatial", 6.0, one_freedom.slider_crank_spatial),
    ],
)
def test_slider_cranks_match_the_one_line_integral(
    scene: str, rate: float, mechanism: one_freedom.Mechanism, formulation: str
) -> None:
    run = simulate(scene, {"formulation": formulation, "t_end": 1.5, "solver.rtol": 1e-11, "solver.output_dt": 0.5})
    theta, theta_dot = one_freedom.turning(mechanism, 0.0, rate, run.t)
    assert np.abs(run.q_tree[:, run.column("crank")] - theta).max() <= 1e-9
    assert np.abs(run.v_tree[:, run.column("crank")] - theta_dot).max() <= 1e-8
    slider = [mechanism(x).slider for x in theta]
    assert np.abs(run.q_tree[:, run.column("slider")] - slider).max() <= 1e-9


# --- flyball governor ----------------------------------------------------------------------------

A05 = {"slider": 0.61962292, "rod_1": 0.39007370, "rod_2": 0.39007370, "shaft": 55.93540991}  # at 10 s, to 1e-8


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_stiff_flyball_governor(formulation: str) -> None:
    run = simulate("flyball", {"formulation": formulation, "solver.rtol": 1e-9})
    assert run.stats["method"] == "Radau"
    assert run.stats["rhs"] <= 6000
    by_hand = flyball.governor(run.t[-1], 1e-12)
    for name, expected in A05.items():
        run_json = run.q_tree[-1, run.column(name)]
        assert abs(run_json - expected) <= 2e-8, name
        assert abs(run_json - by_hand[name]) <= 1e-8, name


# --- N-four-bar ----------------------------------------------------------------------------------


def pendulum_constant(N: int) -> float:
    """Constant k of N squares in a row, 1/s^2. All rods keep the same angle: theta_ddot = -k cos(theta)."""
    return 9.81 * 3 * (3 * N + 1) / (2 * (4 * N + 1))


def first_top_pin(N: int, t: float) -> tuple[float, float]:
    """Position of the first top pin at t, m."""
    k = pendulum_constant(N)
    motion = solve_ivp(
        lambda _, y: (y[1], -k * np.cos(y[0])), (0, t), (np.pi / 2, -1.0), "DOP853", rtol=1e-13, atol=1e-14
    )
    return float(np.cos(motion.y[0, -1])), float(np.sin(motion.y[0, -1]))


@pytest.mark.parametrize("N", [1, 7, 40])
def test_n_four_bar(N: int) -> None:
    run_json = command("n_four_bar", "--set", f"mechanism.N={N}", "--set", "t_end=0.6")
    assert len(run_json["coordinates"]) == 2 * N + 1
    assert run_json["points"]["B0"] == pytest.approx([*first_top_pin(N, 0.6), 0.0], abs=1e-8)


@pytest.mark.parametrize("formulation", ["reduced", "spf"])
@pytest.mark.parametrize("N", [1, 7, 40])
def test_n_four_bar_in_reduced_coordinates_matches_the_pendulum(N: int, formulation: str) -> None:
    run = simulate("n_four_bar", {"mechanism.N": N, "formulation": formulation, "solver.output_dt": 0.3})
    assert run.points["B0"][-1] == pytest.approx([*first_top_pin(N, 0.6), 0.0], abs=1e-8)


# --- the tree alone ------------------------------------------------------------------------------

PENDULUM_PERIOD = 2.36784194757624  # 1 m massless rod, 1 kg point mass, g = 9.81, released horizontal

PENDULUM = """<robot name="pendulum">
  <link name="world_pin"/>
  <link name="rod"><inertial><origin xyz="1 0 0"/><mass value="1"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="swing" type="continuous"><parent link="world_pin"/><child link="rod"/><axis xyz="0 0 1"/></joint>
  {wheel}
</robot>
"""
WHEEL = """<link name="wheel"><inertial><mass value="1"/>
    <inertia ixx="0.5" iyy="0.5" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="wheel_turn" type="continuous"><parent link="world_pin"/><child link="wheel"/><axis xyz="0 0 1"/></joint>
"""
# A point mass on two slides in the plane, with a distance loop of 1 m to the origin.
CARRIAGE = """<robot name="carriage">
  <link name="world_pin"/>
  <link name="bridge"/>
  <link name="mass"><inertial><mass value="1"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="world_pin"/><child link="bridge"/><axis xyz="1 0 0"/></joint>
  <joint name="y" type="prismatic"><parent link="bridge"/><child link="mass"/><axis xyz="0 1 0"/></joint>
</robot>
"""


def period(folder: Path, urdf: str, extra: str, start: str, coordinate: str, direction: int, formulation: str) -> Run:
    """Return the period: the run starts at rest and ends where a rate vanishes for the second time."""
    (folder / "m.urdf").write_text(urdf)
    (folder / "mechanism.toml").write_text(f'name = "m"\nurdf = "m.urdf"\ngravity = [0.0, -9.81, 0.0]\n{extra}')
    (folder / "default.scene.toml").write_text(
        f"""mechanism = "mechanism.toml"
formulation = "{formulation}"
t_end = 10.0
[initial.q]
{start}
[solver]
rtol = 1e-12
[[event]]
coordinate = "{coordinate}"
of = "q_dot"
direction = {direction}
stop = true
"""
    )
    return simulate(folder / "default.scene.toml")


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_pendulum_period(tmp_path: Path, formulation: str) -> None:
    run = period(tmp_path, PENDULUM.format(wheel=""), "", "swing = 0.0", "swing", -1, formulation)
    assert run.t[-1] == pytest.approx(PENDULUM_PERIOD, abs=1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_geared_wheel_adds_its_reflected_inertia(tmp_path: Path, formulation: str) -> None:
    """A wheel geared by -3 adds 9 times its moment of inertia to m l^2."""
    izz = 0.05
    coupling = '[[coupling]]\njoint = "wheel_turn"\nother = "swing"\nratio = -3.0\noffset = 0.4\n'
    urdf = PENDULUM.format(wheel=WHEEL.format(izz=izz))
    run = period(tmp_path, urdf, f'independent = ["swing"]\n{coupling}', "swing = 0.0", "swing", -1, formulation)
    assert run.t[-1] == pytest.approx(PENDULUM_PERIOD * np.sqrt(1 + 9 * izz), abs=1e-9)
    assert run.q_tree[:, run.column("wheel_turn")] == pytest.approx(0.4 - 3 * run.q_tree[:, run.column("swing")])


def test_distance_loop_gives_the_pendulum_period(tmp_path: Path) -> None:
    loop = """independent = ["x"]
[q_guess]
x = 0.95
y = -0.3
[[loop]]
name = "rod"
type = "distance"
frame_a = "world"
frame_b = "mass"
length = 1.0
"""
    # x is no chart where the mass is level with the pin, so it starts slightly below.
    start = -0.3
    run = period(tmp_path, CARRIAGE, loop, f"x = {np.cos(start)}\ny = {np.sin(start)}", "x", -1, "dae")
    assert run.t[-1] == pytest.approx(one_freedom.pendulum_period(start), abs=1e-9)


def test_far_trial_stages_are_rejected_without_evaluating_sigma() -> None:
    """At rtol = 1e-3 a trial step has stages 1e5 turns away. Following sigma there used to take a minute."""
    overrides = {"formulation": "reduced", "t_end": 5.0, "solver.method": "DOP853", "solver.rtol": 1e-3}
    run = simulate("slider_crank", overrides)
    assert run.status == "done"
    assert run.stats["newton"] < 4 * run.stats["rhs"]
