"""Parameters from simulated motions that runs are fitted to, against the values they were simulated with."""

from __future__ import annotations

import json
import re
import tomllib
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom

import ckc_pin
from ckc_pin import InputError, Mechanism, NumericalError, identify, load
from ckc_pin.control.controllers import RecordedTorques
from ckc_pin.identification.motions import identify_motion
from ckc_pin.identification.records import read_record
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.spec import DataSpec
from tests.contract.helpers.command import ckc

TRUE = {
    "joint.theta_1.friction": 0.02, "joint.theta_2.friction": 0.004, "joint.theta_3.friction": 0.015,
    "joint.theta_4.friction": 0.003, "joint.theta_1.damping": 0.01, "joint.theta_3.damping": 0.012,
}  # fmt: skip
DISSIPATION = ["joint.*.friction", "joint.theta_1.damping", "joint.theta_3.damping"]
KNOTS = np.arange(0.0, 3.01, 0.02)
TORQUES = np.array([0.6 * np.sin(9 * KNOTS) + 0.3 * np.cos(4 * KNOTS) + 0.3, 0.5 * np.cos(11 * KNOTS) - 0.2]).T
EXACT = {"rtol": 1e-12, "atol": 1e-13}


@cache
def run_five_bar(t_end=1.0, dt=0.01, start=(-1.2, -1.0, 0.5, -2.0), driven=False):
    """Return a run with friction; its torques are interpolated between the knots of TORQUES."""
    controller = RecordedTorques(KNOTS, TORQUES, interpolates=True) if driven else None
    run = ckc_pin.simulate(
        load("five_bar", TRUE), t_end=t_end, formulation="dae", controller=controller,
        initial={"q": start[:2], "q_dot": start[2:]}, solver={**EXACT, "output_dt": dt},
    )  # fmt: skip
    assert run.status == "done"
    return run


def measure(run, quantities=("theta_1", "theta_3"), noise=0.0, seed=0, driven=False):
    """Return measurements of a run of the five-bar, and its torques."""
    random = np.random.default_rng(seed)
    data = {"t": run.t} | {name: run[name] + noise * random.normal(size=len(run.t)) for name in quantities}
    for motor, tau in zip(("theta_1", "theta_3"), TORQUES.T, strict=True):
        data[f"tau.{motor}"] = np.interp(run.t, KNOTS, tau) if driven else np.zeros(len(run.t))
    return data


def require_truth(result, truth, tolerance):
    for name, value in truth.items():
        assert result.parameters[name].verdict == "identified"
        assert result.parameters[name].value == pytest.approx(value, abs=tolerance)


def test_exact_free_swing_gives_friction_and_masses():
    start = {"link.link_2.mass": 0.2, "link.link_4.mass": 0.4}
    names = [*DISSIPATION, "link.link_2.mass", "link.link_4.mass"]
    result = identify(load("five_bar", start), measure(run_five_bar()), names, method="motion")
    require_truth(result, {**TRUE, "link.link_2.mass": 0.2611, "link.link_4.mass": 0.2611}, 1e-7)
    assert result.method == "motion"
    assert not result.warnings


def test_exact_free_swing_gives_a_length_with_inertias():
    start = load("five_bar", {**TRUE, "joint.theta_2.xyz.x": 0.3, "link.link_2.mass": 0.3})
    result = identify(start, measure(run_five_bar()), ["joint.theta_2.xyz.x", "link.link_2.inertial"], method="motion")
    truth = {"joint.theta_2.xyz.x": 0.2794, "link.link_2.mass": 0.2611, "link.link_2.com.x": 0.1581,
             "link.link_2.inertia.izz": 0.003476}  # fmt: skip
    require_truth(result, truth, 1e-7)
    assert len(result.base) == 5
    for name in ("com.z", "inertia.ixx"):  # a planar motion does not tell them
        assert result.parameters[f"link.link_2.{name}"].verdict == "not identifiable"
        assert result.parameters[f"link.link_2.{name}"].value is None


def test_exact_driven_motion_gives_the_same_base_parameters_as_torques_do():
    data = measure(run_five_bar(0.8, driven=True), driven=True)
    dampings = {name: value for name, value in TRUE.items() if name.endswith("damping")}
    start = load("five_bar", {**dampings, "link.link_1.mass": 0.2, "link.link_3.mass": 0.3})
    result = identify(start, data, ["link.*.inertial", "joint.*.friction"], method="motion")
    truth = TorqueRegressor(load("five_bar", TRUE), ["link.*.inertial", "joint.*.friction"])
    values = dict(zip(truth.names, truth.start, strict=True))
    assert len(result.base) == 15  # of 19 with the dampings: tests/identification/test_torques.py
    for x in result.base:
        assert x.value == pytest.approx(sum(c * values[name] for name, c in x.coefficients.items()), abs=1e-7)
    assert result.physical


def test_free_motion_under_gravity_does_not_tell_the_scale_of_all_masses():
    names = ["link.link_1.mass", "link.link_2.mass", "link.link_3.mass", "link.link_4.mass", *DISSIPATION]
    result = identify(load("five_bar", TRUE), measure(run_five_bar()), names, method="motion")
    assert {x.verdict for x in result.parameters.values()} == {"only in a combination"}
    assert len(result.base) == len(result.parameters) - 1 == 9
    relative = identify(load("five_bar", TRUE), measure(run_five_bar()), names[1:], method="motion")
    assert {x.verdict for x in relative.parameters.values()} == {"identified"}


@pytest.mark.parametrize("driven", [False, True])
def test_truth_is_within_two_standard_deviations(driven):
    start = load("five_bar", {name: 1.5 * value for name, value in TRUE.items()})
    names, truth = [*TRUE, "link.link_2.mass"], {**TRUE, "link.link_2.mass": 0.2611}
    inside = total = 0
    for seed in range(10):
        data = measure(run_five_bar(driven=driven), noise=3e-4, seed=seed, driven=driven)
        result = identify(start, data, names, method="motion")
        for name, value in truth.items():
            estimate = result.parameters[name]
            inside, total = inside + (abs(estimate.value - value) <= 2 * estimate.std), total + 1
    assert inside >= binom.ppf(1e-3, total, 0.9545)


def test_points_rates_gaps_delays_and_unequal_times():
    run = run_five_bar()
    data = measure(run, ("theta_1", "theta_3", "tip.x", "tip.y", "v.theta_2"))
    keep = np.sort(np.random.default_rng(0).permutation(len(run.t))[:80])
    data = {name: x[keep] for name, x in data.items()}
    data["theta_1"][10:20] = np.nan
    data["tip.y"][::2] = np.nan
    start = load("five_bar", {**TRUE, "joint.theta_2.xyz.x": 0.29, "joint.theta_1.friction": 0.03})
    names = ["joint.theta_2.xyz", "joint.theta_1.friction"]
    result = identify(start, data, names, method="motion")
    assert set(result.residuals) == {"theta_1", "theta_3", "tip.x", "tip.y", "v.theta_2"}
    require_truth(result, {"joint.theta_2.xyz.x": 0.2794, "joint.theta_1.friction": 0.02}, 1e-7)
    assert result.parameters["joint.theta_2.xyz.z"].verdict == "not identifiable"

    late = measure(run_five_bar(driven=True), driven=True)
    late["tau.theta_1"] = np.interp(late["t"] - 0.02, KNOTS, TORQUES[:, 0])  # recorded 0.02 s later than it happened
    record = read_record(late, start, DataSpec(file="late", delay={"tau.theta_1": 0.02}, span=(0.02, 0.98)))
    result = identify_motion(start, [record], ["joint.theta_2.xyz.x", "joint.theta_1.friction"], robust=False, prior={})
    require_truth(result, {"joint.theta_2.xyz.x": 0.2794, "joint.theta_1.friction": 0.02}, 1e-6)
    record = read_record(late, start, DataSpec(file="late", delay={"tau.theta_1": "estimate"}))
    with pytest.raises(InputError, match=r'delay: tau\.theta_1: method = "torques" estimates delays'):
        identify_motion(start, [record], ["joint.theta_1.friction"], robust=False, prior={})


def test_two_records_and_one_that_is_not_fitted():
    runs = [run_five_bar(0.6, start=start) for start in ((-1.2, -1.0, 0.5, -2.0), (-1.0, -2.0, 1.0, 1.0))]
    last = run_five_bar(0.8, start=(-1.4, -1.9, -1.0, 1.5))
    data = [measure(run, noise=1e-3, seed=k) for k, run in enumerate(runs)]
    result = identify("five_bar", data, DISSIPATION, validation=measure(last, noise=1e-3, seed=9), method="motion")
    assert [x.validation for x in result.motions] == [False, False, True]
    assert result.instants == 2 * 61
    for fitted, other in zip(result.residuals.values(), result.validation.values(), strict=True):
        assert fitted.rms == pytest.approx(1e-3, rel=0.25)
        assert other.expected == pytest.approx(fitted.expected)
        assert other.rms <= 1.5 * other.expected
    for name, value in TRUE.items():
        assert abs(result.parameters[name].value - value) <= 4 * result.parameters[name].std


def test_robust_fit_ignores_outliers():
    data = measure(run_five_bar(), noise=1e-3)
    data["theta_3"][5::9] += 0.2
    names = ["joint.theta_1.friction", "joint.theta_3.friction"]
    start = load("five_bar", {**TRUE, "joint.theta_1.friction": 0.03})
    spoilt, robust = (identify(start, data, names, method="motion", robust=robust) for robust in (False, True))
    errors = [abs(x.parameters[names[1]].value - 0.015) for x in (spoilt, robust)]
    assert errors[1] <= 3 * robust.parameters[names[1]].std <= errors[0]


def test_motion_through_impacts_and_sticking_gives_restitution_and_friction():
    """A hinge falls on a stop, bounces, and sticks at the end."""
    urdf = """<robot name="bell"><link name="base"/><link name="rod"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
      <limit lower="-3" upper="0.5" effort="0" velocity="0"/></joint></robot>"""
    true = {"joint.hinge.friction": 0.4, "joint.hinge.restitution": 0.6}
    mechanism = Mechanism.from_urdf(
        urdf, joints=[{"name": "hinge", "stops": True, "friction": 0.4, "restitution": 0.6}]
    )
    run = ckc_pin.simulate(
        mechanism, t_end=1.5, formulation="dae", initial={"q": [-0.5], "q_dot": [0.1]},
        solver={**EXACT, "output_dt": 0.01},
    )  # fmt: skip
    assert len(run.events) >= 3
    first = Mechanism.from_urdf(urdf, joints=[{"name": "hinge", "stops": True, "friction": 0.5, "restitution": 0.5}])
    result = identify(first, {"t": run.t, "hinge": run["hinge"]}, list(true), method="motion")
    require_truth(result, true, 1e-6)


def test_slider_crank_gives_masses_friction_and_a_length():
    true = {"joint.slider.friction": 0.8, "joint.crank.damping": 0.01}
    torque = np.array([0.4 + 0.8 * np.sin(7 * KNOTS)]).T
    run = ckc_pin.simulate(
        load("slider_crank", true), t_end=1.0, formulation="dae", initial={"q": [0.4], "q_dot": [6.0]},
        controller=RecordedTorques(KNOTS, torque, interpolates=True), solver={**EXACT, "output_dt": 0.01},
    )  # fmt: skip
    data = {"t": run.t, "slider": run["slider"], "crank": run["crank"],
            "tau.crank": np.interp(run.t, KNOTS, torque[:, 0])}  # fmt: skip
    start = load("slider_crank", {"joint.rod.xyz.x": 0.11, "link.slider_link.mass": 1.2, "joint.crank.damping": 0.02})
    names = ["joint.rod.xyz.x", "link.slider_link.mass", "joint.slider.friction", "joint.crank.damping"]
    result = identify(start, data, names, method="motion")
    require_truth(result, {**true, "joint.rod.xyz.x": 0.1, "link.slider_link.mass": 1.0}, 1e-6)


BAD = [
    ({"method": "motions"}, 'method: expected "torques" or "motion", got \'motions\''),
    ({"method": "motion", "physical": False}, "simulates runs, which need inertias that some body can have"),
    ({"parameters": ["motor.*.offset"]}, "there are link.*.inertial, gravity.x, gravity.y"),
    ({"parameters": ["joint.theta_1.fricton"]}, "did you mean 'joint.theta_1.friction'"),
    ({"drop": "theta_3"}, "no column theta_3; 2 coordinates and the torques of all motors or of none"),
    ({"drop": "tau.theta_3"}, "no column tau.theta_3; 2 coordinates and the torques of all motors or of none"),
    ({"offset": 2.0}, "do not let the mechanism follow the measured coordinates; they are of another branch"),
    ({"rows": 20}, "measurements for 44 unknowns; record a longer motion"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "message"), BAD)
def test_bad_input_has_one_message(case, message):
    data = measure(run_five_bar())
    data = {name: x[: case.get("rows")] for name, x in data.items() if name != case.get("drop")}
    if "theta_3" in data:
        data["theta_3"] = data["theta_3"] + case.get("offset", 0.0)
    options = {"method": "motion"} | {key: case[key] for key in ("method", "physical") if key in case}
    default = ["link.*.inertial"] if "rows" in case else DISSIPATION
    with pytest.raises(InputError, match=re.escape(message)):
        identify("five_bar", data, case.get("parameters", default), **options)


def test_wrong_model_and_missing_torques_have_a_warning():
    data = measure(run_five_bar())
    data.pop("tau.theta_1")
    data.pop("tau.theta_3")
    start = load("five_bar", {**TRUE, "link.link_2.mass": 0.4})
    result = identify(start, data, ["joint.theta_1.friction"], method="motion")
    assert "data: no torques were recorded, so the motors count as unpowered" in result.warnings
    assert any("the model does not explain the motion" in warning for warning in result.warnings)


def test_parameter_without_derivative_has_one_message():
    run = ckc_pin.simulate("bricard", t_end=0.3, initial={"at": "assembled", "q_dot": {"hinge_1": 1.0}},
                           solver={"output_dt": 0.01})  # fmt: skip
    with pytest.raises(InputError, match=r"joint.hinge_2.xyz.x: with another value the redundant rows"):
        identify("bricard", {"t": run.t, "hinge_1": run["hinge_1"]}, ["joint.hinge_2.xyz.x"], method="motion")


def test_gravity_of_a_mechanism_that_was_built_with_it():
    start = load("five_bar", {**TRUE, "gravity": (0.0, -9.0, 0.0)})
    result = identify(start, measure(run_five_bar()), ["gravity.y"], method="motion")
    require_truth(result, {"gravity.y": -9.81}, 1e-7)


def test_run_without_derivative_at_the_start_has_one_message():
    """Joints that begin at rest with friction have one-sided derivatives only."""
    start = load("five_bar", TRUE)
    data = {"t": np.linspace(0, 1, 50), "theta_1": np.full(50, -1.2), "theta_3": np.full(50, -1.9)}
    with pytest.raises(NumericalError, match=r"no run from the start values reaches the last measurement: .*at rest"):
        identify(start, data, ["joint.theta_1.friction"], method="motion")


def test_command_writes_result_parameters_and_figures(tmp_path):
    for name, start in (("swing.csv", (-1.2, -1.0, 0.5, -2.0)), ("other.csv", (-1.0, -2.0, 1.0, 1.0))):
        columns = measure(run_five_bar(0.6, start=start), noise=1e-4)
        rows = np.array(list(columns.values())).T
        np.savetxt(tmp_path / name, rows, delimiter=",", header=",".join(columns), comments="")
    file = tmp_path / "arm.identify.toml"
    file.write_text(
        'mechanism = "five_bar"\n[[data]]\nfile = "swing.csv"\nnoise = {theta_1 = 1e-4}\n'
        '[[data]]\nfile = "other.csv"\nvalidation = true\n'
        '[estimate]\nmethod = "motion"\nparameters = ["joint.*.friction", "joint.theta_[13].damping"]\n'
    )
    done = ckc("identify", str(file), "--out", str(tmp_path / "o"), "--figures", "--json")
    assert done.code == 0
    assert json.loads((tmp_path / "o" / "identification.json").read_text()) == done.json
    assert done.json["method"] == "motion"
    assert set(done.json["residuals"]) == set(done.json["validation"]) == {"theta_1", "theta_3"}
    assert done.json["residuals"]["theta_1"]["expected"] == 1e-4
    assert done.json["parameters"]["joint.theta_1.friction"]["value"] == pytest.approx(0.02, abs=1e-3)
    assert "Measured and predicted quantities" in (tmp_path / "o" / "report.html").read_text(encoding="utf-8")
    for figure in ("motion", "residuals", "correlation"):
        assert (tmp_path / "o" / f"{figure}.png").stat().st_size > 5000
    values = tomllib.loads((tmp_path / "o" / "parameters.toml").read_text())["parameters"]
    assert set(values) == set(TRUE)
    assert load("five_bar", values).d == 2
