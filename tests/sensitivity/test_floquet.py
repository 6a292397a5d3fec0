"""Floquet multipliers against Mathieu's equation: a pendulum on a mass that swings up and down on a spring.

Perturbations of the hanging pendulum obey theta'' + (g - A w^2 cos(w t)) / L theta = 0 exactly.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import mathieu_a

from ckc_pin import InputError, load_scene
from ckc_pin.control.controllers import Tracking
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.sensitivity.floquet import floquet
from tests.sensitivity.sliders import write_sliders

M, m, L, g, w = 3.0, 0.7, 0.5, 9.81, 6.0
PERIOD = 2 * np.pi / w
TIGHT = {"solver.rtol": 1e-12, "solver.atol": 1e-14}

URDF = f"""<robot name="swing"><link name="base"/>
<link name="slide"><inertial><mass value="{M}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="bob"><inertial><origin xyz="0 0 -{L}"/><mass value="{m}"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="y" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
<joint name="theta" type="continuous"><parent link="slide"/><child link="bob"/><axis xyz="0 1 0"/></joint></robot>"""


def write_scene(folder: Path, gravity: float, amplitude: float) -> str:
    """Write a scene with y = amplitude cos(w t) about its equilibrium."""
    stiffness = (M + m) * w**2
    (folder / "swing.urdf").write_text(URDF, encoding="utf-8")
    (folder / "swing.toml").write_text(
        f'name = "swing"\nurdf = "swing.urdf"\ngravity = [0.0, 0.0, {-gravity!r}]\n'
        f'[[spring]]\njoint = "y"\nstiffness = {stiffness!r}\nrest = {(M + m) * gravity / stiffness!r}\n',
        encoding="utf-8",
    )
    scene = folder / "swing.scene.toml"
    scene.write_text(
        'mechanism = "swing.toml"\nformulation = "reduced"\nt_end = 1.0\n'
        f"[initial.q]\ny = {amplitude!r}\ntheta = 0.0\n",
        encoding="utf-8",
    )
    return str(scene)


def monodromy_of_pendulum(gravity: float, amplitude: float) -> np.ndarray:
    """Monodromy matrix of the pendulum alone, by SciPy."""

    def rate(t: float, x: np.ndarray) -> list[float]:
        pull = (gravity - amplitude * w**2 * np.cos(w * t)) / L
        return [x[1], -pull * x[0], x[3], -pull * x[2]]

    result = solve_ivp(rate, (0, PERIOD), [1.0, 0.0, 0.0, 1.0], method="DOP853", rtol=1e-13, atol=1e-14)
    return result.y[:, -1].reshape(2, 2).T


@pytest.mark.parametrize("amplitude", [0.05, 0.2, 0.25, 0.4])
def test_multipliers_are_those_of_mathieus_equation(amplitude: float, tmp_path: Path) -> None:
    result = floquet(write_scene(tmp_path, g, amplitude), PERIOD, TIGHT)
    assert result.states == ("y", "theta", "v.y", "v.theta")
    expected = monodromy_of_pendulum(g, amplitude)
    assert np.abs(result.monodromy[np.ix_([1, 3], [1, 3])] - expected).max() <= 1e-9 * np.abs(expected).max()
    pendulum_multipliers = np.linalg.eigvals(expected)
    for value in pendulum_multipliers:
        assert np.abs(result.multipliers - value).min() <= 1e-8
    assert np.prod(result.multipliers).real == pytest.approx(1.0, abs=1e-8)  # it keeps its energy
    assert result.stable is (False if abs(np.trace(expected)) > 2 else None)


def test_multipliers_on_the_boundary_of_the_first_tongue_are_minus_one(tmp_path: Path) -> None:
    """a = a_1(q) of x'' + (a - 2 q cos 2 tau) x = 0, tau = w t / 2."""
    amplitude = 0.1
    gravity = float(mathieu_a(1, 2 * amplitude / L)) * L * w**2 / 4
    result = floquet(write_scene(tmp_path, gravity, amplitude), PERIOD, TIGHT)
    assert result.monodromy[1, 1] + result.monodromy[3, 3] == pytest.approx(-2.0, abs=1e-9)


def test_the_error_says_by_how_much_a_motion_misses_its_start(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"period = 0\.9 s is not a period: after it y differs by -?0\.\d+ from its 0\.2"
    ):
        floquet(write_scene(tmp_path, g, 0.2), 0.9)
    for period in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="expected a positive number of seconds"):
            floquet(write_scene(tmp_path, g, 0.2), period)


def test_small_motions_must_return_relative_to_their_range(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"period = 1e-06 s is not a period: after it y differs by"):
        floquet(write_scene(tmp_path, g, 0.2), 1e-6)
    small = floquet(write_scene(tmp_path, g, 1e-5), PERIOD, TIGHT)  # a small motion that does return
    assert np.abs(small.run.q_tree[:, 0]).max() == pytest.approx(1e-5, rel=1e-6)


def test_a_scene_and_its_name_give_the_same_result(tmp_path: Path) -> None:
    name = write_scene(tmp_path, g, 0.05)
    expected = floquet(name, PERIOD, {"solver.rtol": 1e-9})
    result = floquet(load_scene(name, {"solver.rtol": 1e-9}), PERIOD)
    assert np.array_equal(result.monodromy, expected.monodromy)


def test_periodicity_is_checked_before_the_variational_equations_are_integrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = import_module("ckc_pin.sensitivity.floquet")  # `from` would import the function of the same name
    monkeypatch.setattr(module, "sensitivities", lambda *_: pytest.fail("integrated"))
    with pytest.raises(InputError, match="is not a period: after it y differs by"):
        floquet(write_scene(tmp_path, g, 0.2), 0.9)


# --- uncertainty ---------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [0.0, 1e-6, -1e-5])
@pytest.mark.parametrize("rtol", [1e-10, 1e-6, 1e-5])
def test_stability_of_a_conservative_motion_is_undecided(rtol: float, late: float) -> None:
    """The double multiplier at 1 moves by the square root of the error of the motion: 0.006 for 2e-5."""
    result = floquet("bricard/period", 4.99171151369 + late, {"solver.rtol": rtol})
    assert result.stable is None
    assert result.multipliers == pytest.approx([1.0, 1.0], abs=0.01)


def start_on_motion(overrides: dict[str, Any]) -> dict[str, Any]:
    """Tracking of the five-bar that starts on its desired motion."""
    scene = load_scene("five_bar/tracking", overrides)
    law = build_scene_controller(scene, load_scene_mechanism(scene))
    assert isinstance(law, Tracking)
    q, q_dot, _ = (dict(zip(("theta_1", "theta_3"), x.tolist(), strict=True)) for x in law.desired(0.0))
    return {**overrides, "initial": {"q": q, "q_dot": q_dot}, "formulation": "reduced", "solver.rtol": 1e-10}


def test_multipliers_of_tracking_follow_from_lambda() -> None:
    """If r = 0, errors decay as exp(-Lambda t), which gives two multipliers. K_D damps r, which gives the other two."""
    result = floquet("five_bar/tracking", 2 * np.pi, start_on_motion({"controller.Lambda": 0.5, "controller.K_D": 3.0}))
    assert result.stable is True
    for multiplier in result.multipliers[:2]:
        assert multiplier == pytest.approx(np.exp(-np.pi), rel=1e-4)
    assert np.abs(result.multipliers[2:]).max() < 1e-3


def test_the_desired_motion_must_have_the_period() -> None:
    """After half a period sin^3 t has its initial value and rate, but continues in the other direction."""
    overrides = {"controller.desired.theta_1": {"offset": -1.4, "harmonics": [[0.15, 1.0, 0.0], [-0.05, 3.0, 0.0]]},
               "controller.desired.theta_3": {"offset": -1.7}}  # fmt: skip
    with pytest.raises(InputError, match=r"period = 3\.14\d+ s is not a period: the desired motion differs by 0\.\d+"):
        floquet("five_bar/tracking", np.pi, start_on_motion(overrides))
    assert floquet("five_bar/tracking", 2 * np.pi, start_on_motion(overrides)).stable


def test_periods_that_are_too_short_are_rejected(tmp_path: Path) -> None:
    for period in (1e-320, 1e-12):
        with pytest.raises(InputError, match=r"s is too short; a period is at least 1e-09 s"):
            floquet(write_scene(tmp_path, g, 0.2), period)
    with pytest.raises(InputError, match="is not a period: after it y"):
        floquet(write_scene(tmp_path, g, 0.2), 3e-9)


@pytest.mark.parametrize(("samples", "stable"), [(1, True), (7, True), (30, False)])
def test_multipliers_of_a_sampled_loop_at_rest_match_the_closed_form(
    samples: int, stable: bool, tmp_path: Path
) -> None:
    """Two masses with separate loops, whose zero-order-hold discretization is known, stable and unstable."""
    (mass, other), (K_P, K_V), T = (1.3, 0.7), (11.0, 3.0), 0.05 if stable else 0.9
    controller = f'[controller]\ntype = "set_point"\nK_P = {K_P!r}\nK_V = {K_V!r}\nsample_time = {T!r}\n'
    scene = write_sliders(tmp_path, "", masses=(mass, other), scene=f"{controller}q_d = {{ x = 0.2, y = -0.1 }}\n",
                    q=(0.2, -0.1))  # fmt: skip
    result = floquet(scene, samples * T, TIGHT)
    expected = np.zeros((4, 4))
    for k, m in enumerate((mass, other)):
        step = np.array([[1.0, T], [0.0, 1.0]]) - np.outer([T**2 / 2, T], [K_P, K_V]) / m
        expected[np.ix_([k, k + 2], [k, k + 2])] = np.linalg.matrix_power(step, samples)
    assert np.abs(result.monodromy - expected).max() <= 1e-11 * np.abs(expected).max()
    assert result.stable is stable


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"sample_time": 1e-3}, r"controller\.sample_time: period = 6\.28318531 s is 6283\.18531 samples; it must be"),
        ({"sample_time": 10.0}, r"controller\.sample_time: period = 6\.28318531 s is 0\.628318531 samples"),
        ({"sample_time": np.pi / 500, "delay": 1e-3}, r"controller\.delay: floquet does not support delayed outputs"),
    ],
)
def test_delays_and_periods_of_fractional_samples_are_rejected(overrides: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        floquet("five_bar/tracking", 2 * np.pi, {f"controller.{name}": x for name, x in overrides.items()})


def test_unsupported_scenes_are_rejected_before_anything_is_run() -> None:
    with pytest.raises(InputError, match=r'^floquet: sensitivities support spf_coordinates = "w" only'):
        floquet("five_bar/swing", 1.0, {"formulation": "spf", "spf_coordinates": "z"})


def test_repr_has_states_multipliers_and_stability(tmp_path: Path) -> None:
    lines = repr(floquet(write_scene(tmp_path, g, 0.05), PERIOD)).splitlines()
    assert lines[0].startswith("Floquet of ")
    assert [line.split()[0] for line in lines[1:] if line[2] != " "] == ["states", "multipliers", "stability"]


def test_json_has_complex_numbers_as_pairs(tmp_path: Path) -> None:
    data = floquet(write_scene(tmp_path, g, 0.05), PERIOD).to_dict()
    assert set(data) == {"name", "states", "period", "monodromy", "multipliers", "stable", "uncertainty"}
    assert all(len(pair) == 2 for pair in data["multipliers"])
