"""`ckc_pin.excite`: condition numbers, limits between the instants, the scene that replays the motion, and messages."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas
import pytest

import ckc_pin
from ckc_pin import Excitation, InputError, Mechanism, excite
from tests.contract.helpers.command import ckc

LIMITS = {"tau.*": 1.0, "v.theta_*": 1.6, "a.theta_1": 2.0}  # of five_bar

MASS, LENGTH, INERTIA = 1.5, 0.3, 0.02  # of the pendulum: at its centre, which is LENGTH from the hinge
PENDULUM = f"""
<robot name="pendulum">
  <link name="base"/>
  <link name="rod">
    <inertial>
      <origin xyz="{LENGTH} 0 0"/><mass value="{MASS}"/>
      <inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint>
</robot>"""


@cache
def five_bar() -> Excitation:
    return excite("five_bar", harmonics=4, limits=LIMITS, random=8, iterations=12)


def pendulum(**motor: float) -> Mechanism:
    return Mechanism.from_urdf(PENDULUM, gravity=[0, -9.81, 0], motors=[{"joint": "hinge", **motor}])


@cache
def swing() -> Excitation:
    motor = pendulum(ratio=4.0, torque_limit=1.5, speed_limit=4.0)
    return excite(motor, harmonics=3, period=4.0, random=5, iterations=10, limits={"hinge": [-2.0, 0.5]})


def inverse(result: Excitation, folder: Path, refinement: int) -> ckc_pin.MotionForces:
    """Return inverse dynamics of the saved scene, on a grid that is finer than the optimized one."""
    scene, _ = result.save(folder, overwrite=True)
    count = refinement * 16 * (result.coefficients.shape[1] // 2)
    return ckc_pin.inverse_dynamics(scene, {"solver.output_dt": result.period / count})


def test_condition_number_of_a_pendulum_has_a_closed_form() -> None:
    result = swing()
    name, wave = next(iter(result.harmonics.items()))
    t = np.arange(5 * 48) / (5 * 48) * result.period
    q, a = np.full_like(t, wave["offset"]), np.zeros_like(t)
    for amplitude, frequency, phase in wave["harmonics"]:
        q += amplitude * np.sin(frequency * t + phase)
        a -= amplitude * frequency**2 * np.sin(frequency * t + phase)
    # tau = (J a + 9.81 (m_x cos q - m_y sin q)) / ratio, where J is about the hinge, and m_x, m_y are first moments.
    about_origin = np.array([INERTIA, INERTIA + MASS * LENGTH**2, INERTIA + MASS * LENGTH**2])
    radius = np.sqrt(about_origin.sum() / 2 / MASS)
    columns = (
        np.array([MASS * radius**2 * a, MASS * radius * 9.81 * np.cos(q), -MASS * radius * 9.81 * np.sin(q)]).T / 4
    )
    s = np.linalg.svd(columns, compute_uv=False)
    assert name == "hinge"
    assert result.rank == 3
    np.testing.assert_allclose(result.condition, s[0] / s[-1], rtol=1e-9)
    np.testing.assert_allclose(result.log_det, np.log(np.prod(s**2 / len(t))), rtol=1e-9)
    tau = (about_origin[2] * a + 9.81 * MASS * LENGTH * np.cos(q)) / 4
    np.testing.assert_allclose(result.largest()["tau.hinge"], np.abs(tau).max(), rtol=1e-12)
    assert result.condition < 0.8 * result.random.condition[0]  # within these limits no motion is much better


def test_limits_of_motors_and_of_ranges_hold() -> None:
    result = swing()
    table = result.quantities(np.linspace(0.0, result.run_in + result.period, 3001))
    assert np.abs(table["tau.hinge"]).max() <= 1.5
    assert np.abs(table["v.hinge"]).max() <= 4.0 / 4.0
    assert table["hinge"].min() >= -2.0
    assert table["hinge"].max() <= 0.5
    assert {"speed.hinge", "hinge"} & set(result.active)


def test_condition_number_is_at_most_half_of_that_of_random_motions() -> None:
    result = five_bar()
    assert result.random.feasible == result.random.count == 8
    assert result.condition < 0.5 * result.random.condition[0]
    assert result.random.condition[0] < result.random.condition[1]


def test_condition_number_of_the_delta_is_at_most_half_of_that_of_random_motions() -> None:
    result = excite("delta", harmonics=2, period=5.0, limits={"tau.*": 2.0}, random=4, iterations=7)
    assert result.rank == 34
    assert result.condition < 0.5 * result.random.condition[0]


def test_limits_hold_between_the_instants(tmp_path: Path) -> None:
    """Inverse dynamics, which shares no code with the search, on a grid that is five times finer, and offset."""
    result = five_bar()
    start = np.linalg.svd(result.mechanism.assembled.phi_z, compute_uv=False)[-1]
    for refinement, excess in ((5, 1e-9), (7, 1e-3)):
        forces = inverse(result, tmp_path, refinement)
        assert forces.status == "done"
        assert np.abs(forces.tau).max() <= 1.0 * (1 + excess)
        assert np.abs(forces.v_tree).max() <= 1.6 * (1 + excess)
        assert np.abs(forces["a.theta_1"]).max() <= 2.0 * (1 + excess)
        assert forces["sigma_min"].min() >= 0.3 * start * (1 - excess)
    assert {"tau.theta_1", "tau.theta_3"} & set(result.active)
    assert {"v.theta_2", "v.theta_4"} & set(result.active)
    np.testing.assert_allclose(result.margin, inverse(result, tmp_path, 5)["sigma_min"].min() / start, rtol=1e-9)


def test_scene_replays_the_torques_of_the_table(tmp_path: Path) -> None:
    result = five_bar()
    result.save(tmp_path, rate=50.0)
    forces = ckc_pin.inverse_dynamics(tmp_path / "excite.scene.toml")
    table = pandas.read_csv(tmp_path / "excite.csv")
    rows = table[table.t >= result.run_in - 1e-9]
    assert len(rows) == len(forces.t) == 501
    for name in ("theta_2", "v.theta_2", "a.theta_2", "a.theta_1", "tau.theta_1", "tau.theta_3"):
        np.testing.assert_allclose(rows[name], forces[name], rtol=0, atol=1e-9)
    run = ckc_pin.simulate(tmp_path / "excite.scene.toml")
    assert run.status == "done"
    assert np.abs(run["error.theta_1"]).max() < 1e-6
    assert np.abs(run.tau - forces.tau).max() < 1e-4


def test_run_in_starts_at_rest_and_its_rates_are_derivatives() -> None:
    result = five_bar()
    h = 1e-4
    t = np.linspace(2 * h, result.run_in + result.period - 2 * h, 200)
    before, here, after = (result.quantities(x) for x in (t - h, t, t + h))
    for name in ("theta_1", "theta_2"):
        np.testing.assert_allclose(here[f"v.{name}"], (after[name] - before[name]) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(here[f"a.{name}"], (after[f"v.{name}"] - before[f"v.{name}"]) / (2 * h), atol=1e-5)
    start = result.quantities(np.zeros(1))
    assert all(start[f"{order}.{name}"][0] == 0.0 for order in "va" for name in result.mechanism.coordinates)
    run_in = result.quantities(np.linspace(0.0, result.run_in, 1001))
    assert max(np.abs(run_in[f"tau.{name}"]).max() for name in ("theta_1", "theta_3")) <= 1.0


def test_log_det_is_larger_than_that_of_random_motions_and_grows_with_amplitude() -> None:
    result = excite("five_bar", harmonics=2, criterion="log_det", random=5, iterations=10)
    assert result.log_det > result.random.log_det[0] + 2.0
    quiet = excite("five_bar", harmonics=2, criterion="log_det", random=5, iterations=10, limits={"v.*": 0.3})
    assert quiet.log_det < result.log_det - 2.0


def test_dry_friction_and_damping_are_made_known_with_inertias() -> None:
    mechanism = Path(__file__).resolve().parents[2] / "urdf" / "five_bar" / "friction.toml"
    names = ["link.*.inertial", "joint.*.damping", "joint.*.friction"]
    result = excite(mechanism, names, harmonics=2, random=4, iterations=6)
    assert (result.unknowns, result.rank) == (48, 19)  # five_bar has 11 combinations of inertias
    assert result.condition < result.random.condition[0]


def test_seed_makes_results_reproducible() -> None:
    motions = [excite("five_bar", harmonics=2, random=3, iterations=4, seed=seed) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(motions[0].coefficients, motions[1].coefficients)
    assert motions[0].to_dict() == motions[1].to_dict()
    assert np.abs(motions[0].coefficients - motions[2].coefficients).max() > 1e-3


def test_noise_of_torques_weights_the_rows() -> None:
    plain = excite("five_bar", harmonics=2, random=2, iterations=2)
    scaled = excite("five_bar", harmonics=2, random=2, iterations=2, noise={"tau.theta_1": 0.1, "tau.theta_3": 0.1})
    np.testing.assert_allclose(scaled.log_det, plain.log_det + 2 * plain.rank * np.log(10), rtol=1e-3)


def test_command_writes_scene_table_and_figure(tmp_path: Path) -> None:
    words = ("excite", "five_bar", "--harmonics", "2", "--random", "3", "--limit", "v.theta_1=2.0", "--rate", "20")
    answer = ckc(*words, "--set", "link.link_2.mass=0.5", "--out", str(tmp_path), "--json")
    assert answer.code == 0
    result = answer.json
    assert result["condition"] < result["random"]["condition"]["best"]
    assert result["limits"]["v.theta_1"]["upper"] == 2.0
    assert {path.name for path in tmp_path.iterdir()} >= {"excite.scene.toml", "excite.csv", "excite.png"}
    run = ckc("run", str(tmp_path / "excite.scene.toml"), "--json").json
    assert run["status"] == "done"
    assert ckc_pin.load_scene(tmp_path / "excite.scene.toml").spec.parameters == {"link.link_2.mass": 0.5}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"period": 0.0}, "excite: period: expected a number of seconds above zero, got 0.0"),
        ({"harmonics": 0}, "excite: harmonics: expected an integer from 1 to 50, got 0"),
        ({"margin": 1.0}, "excite: margin: expected a number from 0 to below 1"),
        ({"criterion": "trace"}, "excite: criterion: expected condition or log_det, got 'trace'"),
        ({"parameters": []}, "excite: parameters: nothing to identify"),
        ({"parameters": ["link.link_9.inertial"]}, "excite: parameters: nothing is called 'link.link_9.inertial'"),
        ({"parameters": ["gravity"]}, "excite: parameters: nothing is called 'gravity'"),
        ({"limits": {"v.theta_9": 1.0}}, r"excite: limits: nothing is called 'v.theta_9'; there are theta_1"),
        ({"limits": {"theta_1": 1.0}}, r"excite: limits: theta_1: expected \[lower, upper\], got 1.0"),
        ({"limits": {"v.theta_1": -1.0}}, r"limits: v.theta_1: expected \[lower, upper\] or a number above zero"),
        ({"limits": {"theta_1": [1.0, -1.0]}}, "limits: theta_1: no value is between 1 and -1"),
        ({"limits": {"tau.theta_1": [5.0, 6.0]}, "random": 2}, "none of 2 random motions .* exceeds tau.theta_1 by"),
        (
            {"noise": {"tau.theta_9": 1.0}},
            "excite: noise: no motor 'theta_9'; there are theta_1, theta_3",
        ),
        ({"noise": {"tau.theta_1": 1.0, "tau.theta_3": 0.0}}, "excite: noise: expected numbers above zero"),
        ({"noise": {"tau.theta_1": 1.0}}, "excite: noise: theta_3 missing"),
    ],
)
def test_wrong_arguments_have_one_message(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        excite("five_bar", **arguments)  # type: ignore[arg-type]


def test_motors_are_needed_for_all_freedoms() -> None:
    one = Mechanism.from_urdf(PENDULUM, actuated=[])
    with pytest.raises(InputError, match="excite: pendulum has no motors"):
        excite(one)
    two = PENDULUM.replace("</robot>", '<link name="tip"/>JOINT</robot>').replace(
        "JOINT",
        '<joint name="wrist" type="continuous"><parent link="rod"/><child link="tip"/><axis xyz="0 0 1"/></joint>',
    )
    with pytest.raises(InputError, match="the motors hinge drive 1 of 2 freedoms"):
        excite(Mechanism.from_urdf(two, actuated=["hinge"]))
