"""Losses of rank of J are crossed on the same branch, or the run stops there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ellipkinc

from ckc_pin import Run, simulate
from ckc_pin.errors import NumericalError
from tests.regression import one_freedom
from tests.regression.test_reference_cases import first_top_pin, pendulum_constant

# --- flat every half turn ------------------------------------------------------------------------


def n_four_bar(N: int, rtol: float, **overrides: Any) -> Run:
    scene = {"mechanism.N": N, "solver.rtol": rtol, "solver.output_dt": 10.0, "t_end": 10.0}
    return simulate("n_four_bar", {**scene, **{key.replace("__", "."): value for key, value in overrides.items()}})


@pytest.mark.parametrize(("N", "rtol"), [(1, 1e-5), (2, 1e-11), (7, 1e-8)])
def test_crossings_of_rank_loss_stay_on_the_branch(N: int, rtol: float) -> None:
    run = n_four_bar(N, rtol)
    assert run.status == "done", run.message
    assert run.points["B0"][-1][:2] == pytest.approx(first_top_pin(N, 10.0), abs=min(1e4 * rtol, 1e-4))


@pytest.mark.parametrize("N", [2, 7])
def test_step_size_growth_is_limited(N: int) -> None:
    """With SciPy's step size growth of up to ten, one in ten of these runs has an error of 1,000 to 12,000 rtol."""
    expected = [first_top_pin(N, float(t)) for t in range(11)]
    for rtol in np.geomspace(3e-9, 6e-8, 14).tolist():
        run = n_four_bar(N, rtol, solver__output_dt=1.0)
        assert run.status == "done", run.message
        assert np.abs(run.points["B0"][:, :2] - expected).max() < 500 * rtol


@pytest.mark.parametrize("t_end", [0.7, 0.7084500152, 0.75])
def test_run_may_end_before_at_or_after_a_crossing(t_end: float) -> None:
    run = n_four_bar(1, 1e-10, t_end=t_end)
    assert run.status == "done", run.message
    assert run.t[-1] == t_end
    assert run.points["B0"][-1][:2] == pytest.approx(first_top_pin(1, t_end), abs=1e-9)


@pytest.mark.parametrize(("rtol", "rhs"), [(1e-5, 48), (1e-7, 75)])
def test_run_far_from_a_crossing_costs_no_extra_evaluations(rtol: float, rhs: int) -> None:
    """The first crossing is at 0.7085 s, of four squares at 0.7179 s. Counts are those without the rank monitor."""
    for N in (1, 4):
        assert n_four_bar(N, rtol, t_end=0.6).stats["rhs"] <= rhs + 3  # for the interpolant


def test_collocation_steps_stop_their_iteration_at_the_tolerance() -> None:
    """A run has 11 crossings. Most of their steps take two sweeps of 10 stages for the guess, and two of all 14."""
    counts = [n_four_bar(N, rtol).stats for N in (1, 2, 4) for rtol in (8e-8, 9e-8, 1e-7, 1.1e-7)]
    rhs_of_crossings = [stats["rhs"] - 12 * (stats["steps"] + stats["rejected"]) for stats in counts]
    assert np.mean(rhs_of_crossings) <= 11 * 54


def test_coarse_run_is_repeated_when_crossings_were_missed() -> None:
    """At rtol = 1e-3, steps pass three losses of rank before the first is detected."""
    run = n_four_bar(4, 1e-3)
    assert run.status == "done", run.message
    assert run.points["B0"][-1][:2] == pytest.approx(first_top_pin(4, 10.0), abs=1e-4)


@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
def test_step_over_peak_and_zero_of_the_monitor_is_detected(rtol: float) -> None:
    """The monitor rises at both ends of the step. With forty squares the miss led to an error of 0.08 m."""
    run = n_four_bar(40, rtol)
    assert run.status == "done", run.message
    assert run.points["B0"][-1][:2] == pytest.approx(first_top_pin(40, 10.0), abs=1e-4)


def test_outputs_across_a_crossing_are_accurate() -> None:
    run = n_four_bar(2, 1e-10, t_end=0.8, solver__output_dt=0.01)
    exact = [first_top_pin(2, float(t)) for t in run.t[1:]]
    np.testing.assert_allclose(run.points["B0"][1:, :2], exact, rtol=0, atol=1e-8)
    assert run.max_phi <= 1e-12
    assert np.ptp(run.energy) <= 1e-8


def first_flat(N: int) -> float:
    """Time at which the rods lie flat, s: chi = (pi/2 - theta) / 2 has the rate sqrt(1 + 4 k sin(chi)^2) / 2."""
    return float(2 * ellipkinc(np.pi / 4, -4 * pendulum_constant(N)))


@pytest.mark.parametrize("rtol", [1e-5, 1e-8, 1e-11])
@pytest.mark.parametrize("formulation", ["reduced", "spf"])
@pytest.mark.parametrize("N", [1, 2, 7])
def test_formulations_that_cannot_cross_rank_loss_stop(N: int, formulation: str, rtol: float) -> None:
    run = n_four_bar(N, rtol, formulation=formulation)
    assert run.status == "stopped"
    flat_at = first_flat(N)
    lost_at = re.search(r"J loses rank at t = (\S+) s", run.message)
    assert float(lost_at[1]) == pytest.approx(flat_at, abs=1e-4) if lost_at else "phi_z is so nearly" in run.message
    assert flat_at - 0.02 < run.t[-1] < flat_at
    end = first_top_pin(N, float(run.t[-1])) if run.t[-1] else (0.0, 1.0)
    assert run.points["B0"][-1][:2] == pytest.approx(end, abs=min(1e4 * rtol, 1e-4))


@pytest.mark.parametrize("formulation", ["dae", "reduced", "spf"])
def test_start_where_J_loses_rank_is_rejected(formulation: str) -> None:
    """No other coordinates help there, so the message proposes none."""
    with pytest.raises(NumericalError, match=r"the start theta_0 = 0 is singular: J loses rank.*; start elsewhere$"):
        simulate("n_four_bar", {"formulation": formulation, "initial.q": {"theta_0": 0.0}})


# --- a change-point four-bar: ground + crank = coupler + rocker ------------------------------------

GROUND, CRANK, COUPLER, ROCKER = 2.0, 1.0, 1.7, 1.3  # m; rods are thin, 1 kg/m
SPEED = 9.0  # rad/s, enough to keep turning

ROD = """<link name="{name}"><inertial><origin xyz="{half} 0 0"/><mass value="{length}"/>
    <inertia ixx="1e-3" iyy="{izz}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
PIN = """<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{x} 0 0"/><axis xyz="0 0 1"/></joint>"""


def four_bar(theta: float, rocker: float = ROCKER) -> one_freedom.State:
    """Of the crank's angle; the pin of coupler and rocker is beside the line from the crank's pin to the rocker's.

    16 times the squared area of its triangle is ((b + c)^2 - r^2)(r^2 - (b - c)^2); with a change point the first
    factor is 4 g a cos^2(theta / 2), so that its signed root passes through zero where the rods are in line.
    """
    g, a, b, c = GROUND, CRANK, COUPLER, rocker

    def place(th: complex) -> NDArray[np.complex128]:
        pin = a * np.array([np.cos(th), np.sin(th)])
        to_rocker = np.array([g, 0.0]) - pin
        r = np.sqrt(to_rocker @ to_rocker)
        in_line = b + c == g + a
        root = 2 * np.sqrt(g * a) * np.cos(th / 2) if in_line else np.sqrt((b + c) ** 2 - r**2)
        height = root * np.sqrt(r**2 - (b - c) ** 2) / (2 * r)
        along = (b**2 - c**2 + r**2) / (2 * r)
        u = to_rocker / r
        top = pin + along * u + height * np.array([-u[1], u[0]])
        ends = [(np.zeros(2), pin), (pin, top), (np.array([g, 0.0]), top)]
        return np.array([[*(p + q) / 2, *(q - p)] for p, q in ends])

    values, rates = one_freedom._with_rate(place, theta)
    masses = np.array([a, b, c])
    M = masses @ (np.sum(rates[:, :2] ** 2, axis=1) + np.sum(rates[:, 2:] ** 2, axis=1) / 12)
    return one_freedom.State(float(M), float(one_freedom.G * masses @ values[:, 1]), 0.0)


def write_four_bar(folder: Path, rocker: float, formulation: str, rtol: float) -> Path:
    lengths = {"crank_rod": CRANK, "coupler_rod": COUPLER, "rocker_rod": rocker}
    rods = [ROD.format(name=name, half=x / 2, length=x, izz=x**3 / 12) for name, x in lengths.items()]
    pins = [
        PIN.format(name="crank", parent="ground", child="crank_rod", x=0),
        PIN.format(name="coupler", parent="crank_rod", child="coupler_rod", x=CRANK),
        PIN.format(name="rocker", parent="ground", child="rocker_rod", x=GROUND),
    ]
    (folder / "m.urdf").write_text(f'<robot name="m"><link name="ground"/>{"".join(rods + pins)}</robot>')
    (folder / "mechanism.toml").write_text(
        f"""name = "m"
urdf = "m.urdf"
gravity = [0.0, -9.81, 0.0]
independent = ["crank"]
[q_guess]
crank = 0.5
coupler = 0.6
rocker = 1.8
[[loop]]
name = "top"
type = "point_2d"
frame_a = {{link = "coupler_rod", xyz = [{COUPLER}, 0.0, 0.0]}}
frame_b = {{link = "rocker_rod", xyz = [{rocker}, 0.0, 0.0]}}
"""
    )
    scene = folder / "default.scene.toml"
    scene.write_text(
        f"""mechanism = "mechanism.toml"
formulation = "{formulation}"
t_end = 2.0
[initial]
q = {{crank = 0.5}}
q_dot = {{crank = {SPEED}}}
[solver]
rtol = {rtol}
output_dt = 0.1
"""
    )
    return scene


@pytest.mark.parametrize("rtol", [1e-6, 1e-9, 1e-11, 3e-13])
def test_change_point_four_bar_stays_on_its_branch(tmp_path: Path, rtol: float) -> None:
    run = simulate(write_four_bar(tmp_path, ROCKER, "dae", rtol))
    theta, theta_dot = one_freedom.turning(four_bar, 0.5, SPEED, run.t)
    assert theta[-1] > 3 * np.pi  # in line at pi and at 3 pi
    assert run.status == "done", run.message
    assert np.abs(run.q_tree[:, run.column("crank")] - theta).max() <= min(1e4 * rtol, 1e-4)
    assert np.abs(run.v_tree[:, run.column("crank")] - theta_dot).max() <= min(1e5 * rtol, 1e-3)


@pytest.mark.parametrize("excess", [1e-2, 1e-4])
@pytest.mark.parametrize("rtol", [1e-6, 1e-10])
def test_near_miss_of_branches_is_not_a_crossing(tmp_path: Path, excess: float, rtol: float) -> None:
    """With a longer rocker the rods are never in line, and the pin stays on its side."""

    def near_miss(theta: float) -> one_freedom.State:
        return four_bar(theta, ROCKER + excess)

    run = simulate(write_four_bar(tmp_path, ROCKER + excess, "dae", rtol))
    theta, _ = one_freedom.turning(near_miss, 0.5, SPEED, run.t)
    assert run.status == "done", run.message
    assert np.abs(run.q_tree[:, run.column("crank")] - theta).max() <= min(1e4 * rtol, 1e-4)


def test_near_miss_of_branches_costs_no_crossing_steps(tmp_path: Path) -> None:
    """A crossing step needs at least fifty evaluations. The monitor does not expect one where J keeps its rank."""
    stats = simulate(write_four_bar(tmp_path, ROCKER + 1e-2, "dae", 1e-3)).stats
    assert stats["rhs"] <= 12 * (stats["steps"] + stats["rejected"]) + 3 * stats["steps"] + 6


# --- cost of the rank monitor -----------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["four_bar/turning", "five_bar/swing", "slider_crank"])
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_run_without_crossing_costs_no_extra_evaluations(scene: str, rtol: float) -> None:
    """Three evaluations at the start, twelve per step, one after projection, three for the last output."""
    overrides = {"formulation": "dae", "solver.rtol": rtol, "solver.method": "DOP853", "t_end": 1.0}
    stats = simulate(scene, {**overrides, "solver.output_dt": 1.0}).stats
    tries = stats["steps"] + stats["rejected"]
    assert 12 * tries <= stats["rhs"] <= 12 * tries + stats["steps"] + 6
