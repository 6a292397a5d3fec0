"""Geometric calibration: exact data, unbiasedness, Cramer-Rao bound, what cannot be known, outliers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import ckc_pin
from ckc_pin import Calibration, calibrate
from ckc_pin.kinematics.sigma import follow_sigma
from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.parameters import values_of
from scripts.experiments.fuzz.mechanisms import random_mechanism
from tests.identification.closed_form_five_bar import LENGTHS, Array, bound, columns, draw_motors, read

POSES, NOISE = 20, 1e-3
ENCODERS = ("theta_1", "theta_2", "theta_3", "theta_4")
MOTORS_AND_TIP = ("theta_1", "theta_3", "tip.x", "tip.y")
NAMES = [*list(LENGTHS)[:4], "encoder.theta_1.offset", "encoder.theta_3.offset"]
TRUTH = np.array([0.2801, 0.3040, 0.2790, 0.3055, 0.01, -0.02])
BASE = LENGTHS["joint.theta_3.xyz.x"]
MOTORS = draw_motors(np.random.default_rng(3), POSES)


def predict(unknowns: Array) -> Array:
    """Return the readings of all encoders and of the tip at parameters and motor angles."""
    readings = read(np.array([*unknowns[:4], BASE]), unknowns[6:].reshape(-1, 2))
    readings[:, 0] += unknowns[4]
    readings[:, 2] += unknowns[5]
    return readings


EXACT = predict(np.concatenate([TRUTH, MOTORS.ravel()]))


def errors(result: Calibration, truth: dict[str, float]) -> Array:
    """Return the errors of parameters, all of which must have values."""
    return np.array([float(result.parameters[name].value or np.nan) - x for name, x in truth.items()])


def measure(seed: int, outliers: float = 0.0) -> dict[str, Array]:
    """Return readings of the encoders with noise, and some of them far off."""
    random = np.random.default_rng(seed)
    noisy = EXACT[:, :4] + NOISE * random.standard_normal((POSES, 4))
    return columns(
        noisy + np.where(random.random(noisy.shape) < outliers, random.uniform(-0.1, 0.1, noisy.shape), 0.0), ENCODERS
    )


@pytest.fixture(scope="module")
def crb() -> Array:
    unknowns = np.concatenate([TRUTH, MOTORS.ravel()])
    return bound(lambda x: predict(x)[:, :4], unknowns, np.array(NOISE), len(TRUTH))


@pytest.fixture(scope="module")
def five_bar() -> Mechanism:
    return ckc_pin.load("five_bar")


# --- estimates -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("readings", [ENCODERS, MOTORS_AND_TIP])
@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_exact_readings_give_the_truth(five_bar: Mechanism, readings: tuple[str, ...], loss: str) -> None:
    result = calibrate(five_bar, columns(EXACT, readings), NAMES, loss=loss)
    assert result.converged
    assert not result.outliers
    assert np.abs(errors(result, dict(zip(NAMES, TRUTH, strict=True)))).max() < 1e-9


def test_errors_of_200_trials_are_as_predicted(five_bar: Mechanism, crb: Array) -> None:
    results = [calibrate(five_bar, measure(seed), NAMES, noise=NOISE) for seed in range(200)]
    estimates = np.array([[x.parameters[name].value for name in NAMES] for x in results], dtype=float)
    stds = np.array([[x.parameters[name].std for name in NAMES] for x in results], dtype=float)
    covered = np.mean(np.abs(estimates - TRUTH) < 2 * stds, axis=0)
    # 0.9545 of 200 trials: below 0.895 or above 0.995 with probability 5e-4 each
    assert np.all((covered > 0.895) & (covered < 0.995)), covered
    rms = np.sqrt(np.mean((estimates - TRUTH) ** 2, axis=0))
    assert np.all(rms < 1.2 * crb), rms / crb  # the standard error of rms is 0.05
    assert np.allclose(stds.mean(axis=0), crb, rtol=0.02)
    # The tip by the closed form, from the motors' encoders and the estimates, is as accurate as predicted.
    tips = [read(np.array([*x[:4], BASE]), EXACT[:, [0, 2]] - x[4:])[:, 4:] for x in estimates]
    error = np.sqrt(np.mean(np.sum((np.array(tips) - EXACT[:, 4:]) ** 2, axis=2)))
    after = np.sqrt(np.mean([float(x.points["tip"]["after"] or np.nan) ** 2 for x in results]))
    assert after == pytest.approx(error, rel=0.1)


def test_error_of_the_tip_before_is_that_of_the_start(five_bar: Mechanism) -> None:
    start = np.array([*list(LENGTHS.values())[:4], 0.0, 0.0])
    unknowns = start + 0.05 * (TRUTH - start)
    exact = predict(np.concatenate([unknowns, MOTORS.ravel()]))
    result = calibrate(five_bar, columns(exact, ENCODERS), NAMES)
    nominal = read(np.array(list(LENGTHS.values())), exact[:, [0, 2]])[:, 4:]
    before = np.sqrt(np.mean(np.sum((nominal - exact[:, 4:]) ** 2, axis=1)))
    assert result.points["tip"]["before"] == pytest.approx(before, rel=0.01)  # to first order in the parameters


def test_noise_is_estimated_from_residuals(five_bar: Mechanism) -> None:
    results = [calibrate(five_bar, measure(seed), NAMES) for seed in range(20)]
    variance = np.mean([x.noise["theta_2"] ** 2 for x in results])
    assert np.sqrt(variance) == pytest.approx(NOISE, rel=0.1)  # 20 x 34 redundant readings: 2.7 %
    for name in ENCODERS:
        rms, expected = (
            np.sqrt(np.mean([x.residuals[name][key] ** 2 for x in results])) for key in ("rms", "expected")
        )
        assert rms == pytest.approx(expected, rel=0.15)


def test_noise_of_angles_and_lengths_is_estimated_separately(five_bar: Mechanism) -> None:
    random = np.random.default_rng(1)
    sigma = np.array([2e-3, 2e-3, 1e-4, 1e-4])
    unknowns = np.concatenate([TRUTH, draw_motors(random, 100).ravel()])
    exact = predict(unknowns)[:, [0, 2, 4, 5]]
    noisy = exact + sigma * random.standard_normal(exact.shape)
    result = calibrate(five_bar, dict(zip(MOTORS_AND_TIP, noisy.T, strict=True)), NAMES)
    assert result.noise["theta_1"] == pytest.approx(2e-3, rel=0.15)
    assert result.noise["tip.x"] == pytest.approx(1e-4, rel=0.15)


def test_huber_loss_withstands_five_percent_of_outliers(five_bar: Mechanism, crb: Array) -> None:
    truth = dict(zip(NAMES, TRUTH, strict=True))
    rms, count = {}, {"squares": 12, "huber": 40}
    for loss in ("squares", "huber"):
        results = [calibrate(five_bar, measure(k, 0.05), NAMES, loss=loss, noise=NOISE) for k in range(count[loss])]
        off = np.array([errors(x, truth) for x in results])
        rms[loss] = np.sqrt(np.mean(off**2, axis=0)) / crb
    stds = np.array([[x.parameters[name].std for name in NAMES] for x in results], dtype=float)  # with Huber's loss
    assert np.mean(np.abs(off) < 2 * stds) > 0.9  # 0.9545; 40 trials have a standard error of 0.02
    assert np.all(np.sqrt(np.mean((off / stds) ** 2, axis=0)) < 1.35)  # 1; standard error 0.11
    assert np.all(rms["huber"] < 1.5), rms["huber"]
    assert np.all(rms["squares"] > 5.0), rms["squares"]


def test_huber_loss_leaves_nothing_out_without_outliers(five_bar: Mechanism) -> None:
    for seed in range(8):
        squares, huber = (calibrate(five_bar, measure(seed), NAMES, loss=x, noise=NOISE) for x in ("squares", "huber"))
        assert not huber.outliers
        for name in NAMES:
            assert huber.parameters[name].value == pytest.approx(squares.parameters[name].value, abs=1e-7)


def test_outliers_are_named(five_bar: Mechanism) -> None:
    poses = measure(0)
    poses["theta_3"][7] += 0.05
    for loss in ("squares", "huber"):
        result = calibrate(five_bar, poses, NAMES, noise=NOISE, loss=loss)
        assert result.outliers[0][:2] == (7, "theta_3")
        assert "pose 7: theta_3" in repr(result)


def test_missing_readings_are_left_out(five_bar: Mechanism) -> None:
    poses = columns(EXACT, ENCODERS)
    poses["theta_2"][[0, 5]] = np.nan
    poses["theta_1"][3] = np.nan
    result = calibrate(five_bar, poses, NAMES)
    assert np.abs(errors(result, dict(zip(NAMES, TRUTH, strict=True)))).max() < 1e-9


# --- other mechanisms ----------------------------------------------------------------------------------


def draw_poses(mechanism: Mechanism, count: int, reach: float, seed: int = 0) -> list[Array]:
    """Return closed configurations at random independent coordinates."""
    random, poses = np.random.default_rng(seed), list[Array]()
    scale = reach * mechanism.tree.step_scale[mechanism.partition.q]
    while len(poses) < count:
        step = scale * random.uniform(-1, 1, mechanism.d)
        reached = follow_sigma(mechanism.assembled, step, 0.0, mechanism.tolerance)
        if reached.verdict == "converged":
            poses.append(reached.at.q_tree)
    return poses


def measure_mechanism(mechanism: Mechanism, poses: list[Array], names: list[str]) -> dict[str, Array]:
    """Return exact readings of coordinates and points."""
    tree = mechanism.tree
    values = [tree.named(tree.to_coordinates(q)) for q in poses]
    for row, q in zip(values, poses, strict=True):
        row |= {f"{p}.{a}": x for p, at in mechanism.point_positions(q).items() for a, x in zip("xyz", at, strict=True)}
    return {name: np.array([row[name] for row in values]) for name in names}


def check_trials(
    nominal: str | Path, poses: dict[str, Array], truth: dict[str, float], sigma: float, trials: int
) -> None:
    """Calibrate exact readings, then noisy ones: 2 standard deviations cover the truth in about 95 % of the cases."""
    exact = calibrate(nominal, poses, list(truth))
    assert np.abs(errors(exact, truth)).max() < 1e-9
    covered = []
    for seed in range(trials):
        random = np.random.default_rng(seed)
        noisy = {name: x + sigma * random.standard_normal(x.shape) for name, x in poses.items()}
        result = calibrate(nominal, noisy, list(truth), noise=sigma)
        stds = np.array([result.parameters[name].std for name in truth], dtype=float)
        covered.append(np.abs(errors(result, truth)) < 2 * stds)
    assert np.mean(covered) > 0.85, np.mean(covered)  # errors of one trial are correlated


def test_delta_is_calibrated_with_its_plate_measured() -> None:
    rods = {f"loop.ball_{k}{side}.frame_a.xyz.z": -0.45 + 1e-3 * k for k in (1, 2, 3) for side in "ab"}
    delta = ckc_pin.load("delta", rods)
    readings = ["arm_1", "arm_2", "arm_3", "plate.x", "plate.y", "plate.z"]
    poses = measure_mechanism(delta, draw_poses(delta, 20, 0.4), readings)
    poses["arm_2"] += 0.01
    check_trials("delta", poses, {**rods, "encoder.arm_2.offset": 0.01}, 1e-4, 8)


@pytest.mark.parametrize("seed", [4, 1])
def test_random_mechanism_is_calibrated(seed: int, tmp_path: Path) -> None:
    random_mechanism(seed).write(tmp_path)
    path = tmp_path / "mechanism.toml"
    nominal = ckc_pin.load(path)
    loop = next(loop.name for loop in nominal.spec.loop if loop.type == "point")
    start = read_vector(nominal, f"loop.{loop}.frame_a.xyz")
    truth = {
        f"loop.{loop}.frame_a.xyz.{axis}": x + 0.01 * (k - 1.5)
        for k, (axis, x) in enumerate(zip("xyz", start, strict=True))
    }
    mechanism = ckc_pin.load(path, truth)
    poses = measure_mechanism(mechanism, draw_poses(mechanism, 15, 0.3), list(mechanism.coordinates))
    check_trials(path, poses, truth, 1e-4, 8)


def test_poses_are_found_far_from_the_assembled_configuration() -> None:
    """Two arms that hold a load: their encoders alone, without its free root, tell how they hold it."""
    truth = {f"loop.left_grip.frame_b.xyz.{axis}": x for axis, x in zip("xyz", (-0.152, 0.001, 0.003), strict=True)}
    arms = ckc_pin.load("two_ur5", truth)
    joints = [name for name in arms.coordinates if name not in arms.tree.free_coordinates]
    poses = measure_mechanism(arms, draw_poses(arms, 12, 0.2), joints)
    result = calibrate("two_ur5", poses, "loop.left_grip.frame_b.xyz")
    assert np.abs(errors(result, truth)).max() < 1e-9


def read_vector(mechanism: Mechanism, name: str) -> tuple[float, float, float]:
    """Return the value of a vector of the mechanism's file."""
    value = values_of(mechanism.spec, mechanism.urdf)[name]
    assert isinstance(value, tuple)
    return value


def test_placement_of_the_tracker_is_estimated() -> None:
    delta = ckc_pin.load("delta")
    readings = ["arm_1", "arm_2", "arm_3", "plate.x", "plate.y", "plate.z"]
    poses = measure_mechanism(delta, draw_poses(delta, 15, 0.4), readings)
    position, rotation = np.array([0.1, 0.5, 1.0]), np.array([0.3, -0.2, 1.0])
    seen = (np.array([poses[f"plate.{axis}"] for axis in "xyz"]).T - position) @ pin.exp3(rotation)
    poses |= dict(zip(("plate.x", "plate.y", "plate.z"), seen.T, strict=True))
    poses["arm_3"] -= 0.02
    result = calibrate(delta, poses, "encoder.*.offset", tracker="unknown")
    axes = ("x", "y", "z", "rx", "ry", "rz")
    truth = {f"tracker.{axis}": x for axis, x in zip(axes, [*position, *rotation], strict=True)}
    assert np.abs(errors(result, {**truth, "encoder.arm_3.offset": -0.02, "encoder.arm_1.offset": 0.0})).max() < 1e-9


# --- what can be known ---------------------------------------------------------------------------------


def test_size_of_a_five_bar_cannot_be_known_from_encoders(five_bar: Mechanism) -> None:
    result = calibrate(five_bar, measure(0), [*LENGTHS, "joint.theta_2.xyz.z", *NAMES[4:]])
    for name in LENGTHS:
        estimate = result.parameters[name]
        assert (estimate.value, estimate.std, estimate.verdict) == (None, None, "only in a combination")
    assert result.parameters["joint.theta_2.xyz.z"].verdict == "not identifiable"
    assert result.parameters["encoder.theta_1.offset"].verdict == "identified"
    assert result.points["tip"]["after"] is None
    assert not result.overrides
    # The ratios of the lengths are known: L_k - r_k L = 0, of which r_k is the ratio of the estimates.
    assert len(result.combinations) == 4
    for combination in result.combinations:
        (first, one), (last, ratio) = combination.coefficients.items()
        lengths = dict(zip(LENGTHS, [*TRUTH[:4], BASE], strict=True))
        assert one == 1.0
        assert -ratio == pytest.approx(lengths[first] / lengths[last], rel=0.02)
        assert 0 < combination.std < 1e-3


def test_measured_point_or_prior_makes_the_size_known(five_bar: Mechanism) -> None:
    truth = dict(zip(LENGTHS, [*TRUTH[:4], BASE], strict=True))
    with_tip = calibrate(five_bar, columns(EXACT, MOTORS_AND_TIP), [*LENGTHS, *NAMES[4:]])
    assert np.abs(errors(with_tip, truth)).max() < 1e-9
    with_prior = calibrate(
        five_bar, measure(0), [*LENGTHS, *NAMES[4:]], noise=NOISE, prior={"joint.theta_3.xyz.x": 1e-4}
    )
    for name in LENGTHS:  # the readings tell the ratios of lengths, so the prior of one gives all others
        verdict = "prior only" if name == "joint.theta_3.xyz.x" else "identified with a prior"
        assert with_prior.parameters[name].verdict == verdict
    assert with_prior.parameters["joint.theta_3.xyz.x"].std == pytest.approx(1e-4, rel=1e-3)
    assert with_prior.parameters["encoder.theta_1.offset"].verdict == "identified"
    assert np.abs(errors(with_prior, truth)).max() < 3e-3


def test_mean_of_prior_and_readings_is_weighted() -> None:
    """One encoder on a pendulum whose tip is measured: the offset's estimate is a weighted mean."""
    urdf = """<robot name="p"><link name="base"/><link name="rod"/>
      <joint name="hinge" type="continuous">
        <parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint></robot>"""
    frame = {"link": "rod", "xyz": [1.0, 0.0, 0.0]}
    pendulum = ckc_pin.Mechanism.from_urdf(urdf, points=[{"name": "tip", "frame": frame}])
    angles, offset, sigma, prior = np.linspace(-1, 1, 9), 0.03, 1e-2, 4e-3
    poses = {"hinge": angles + offset, "tip.x": np.cos(angles), "tip.y": np.sin(angles)}
    result = calibrate(
        pendulum, poses, ["encoder.hinge.offset"], noise={"hinge": sigma, "tip.*": 1e-6}, prior={"encoder.*": prior}
    )
    weight = prior**2 / (prior**2 + sigma**2 / 9)
    assert result.parameters["encoder.hinge.offset"].value == pytest.approx(weight * offset, rel=1e-6)
    assert result.parameters["encoder.hinge.offset"].std == pytest.approx(prior * np.sqrt(1 - weight), rel=1e-6)


# --- result --------------------------------------------------------------------------------------------


def test_result_can_be_printed_saved_and_used(five_bar: Mechanism, tmp_path: Path) -> None:
    poses = measure(0)
    text = "\n".join(
        [",".join(poses), *(",".join(map(repr, row)) for row in np.array(list(poses.values())).T.tolist())]
    )
    (tmp_path / "poses.csv").write_text(text.replace("np.float64", ""), encoding="utf-8")
    result = calibrate(five_bar, tmp_path / "poses.csv", NAMES)
    assert result.parameters == calibrate(five_bar, poses, NAMES).parameters
    data = json.loads(json.dumps(result.to_dict()))
    assert data["status"] == "converged"
    assert data["parameters"][NAMES[0]]["verdict"] == "identified"
    assert result.to_pandas().loc[NAMES[4], "value"] == result.parameters[NAMES[4]].value
    calibrated = ckc_pin.load("five_bar", result.overrides)
    assert calibrated.overrides == {name: result.parameters[name].value for name in NAMES[:4]}
    saved = result.save(tmp_path / "calibrated.toml").read_text(encoding="utf-8")
    assert saved.startswith("[parameters]")
    assert all(name in saved for name in NAMES[:4])
    assert "identified; start 0.2794" in repr(result)


def test_values_of_the_loaded_mechanism_are_the_start(five_bar: Mechanism) -> None:
    overrides = {NAMES[0]: 0.28}
    result = calibrate(ckc_pin.load("five_bar", overrides), columns(EXACT, ENCODERS), NAMES)
    assert result.parameters[NAMES[0]].start == 0.28
    assert np.abs(errors(result, dict(zip(NAMES, TRUTH, strict=True)))).max() < 1e-9
