"""Parameters from simulated measurements of torques, with and without noise, against those they were simulated with."""

from __future__ import annotations

import json
from functools import cache

import msgspec
import numpy as np
import pytest
from scipy.stats import binom

import ckc_pin
from ckc_pin import InputError, Mechanism, identify, inverse_dynamics, load
from ckc_pin.identification.pseudo_inertia import MOMENTS, pseudo_inertia
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.unknowns import link_moments
from scripts.experiments.identification_trials import run_trials
from tests.contract.helpers.command import ckc

FRICTION = {
    "joint.theta_1.friction": 0.05, "joint.theta_2.friction": 0.02, "joint.theta_3.friction": 0.05,
    "joint.theta_4.friction": 0.02, "joint.theta_1.damping": 0.02, "joint.theta_2.damping": 0.01,
    "joint.theta_3.damping": 0.02, "joint.theta_4.damping": 0.01,
}  # fmt: skip
DESIRED = {
    "five_bar": {
        "theta_1": {"offset": 0.0, "harmonics": [[0.5, 2.5, 0.0], [0.2, 7.5, 1.0], [0.1, 12.5, 2.0]]},
        "theta_3": {"offset": 0.785, "harmonics": [[0.4, 5.0, 0.5], [0.3, 7.5, -1.0], [0.08, 10.0, 0.3]]},
    },
    "delta": {
        f"arm_{k}": {"offset": 0.3, "harmonics": [[0.3, 3.0 + k, 0.7 * k], [0.1, 9.0 - k, k], [0.05, 14.0, 2.0 * k]]}
        for k in (1, 2, 3)
    },
}
PARAMETERS = ("link.*.inertial", "joint.*.friction", "joint.*.damping")


@cache
def motion(name, t_end, dt):
    """Return the exact motion and torques of a mechanism with friction."""
    true = FRICTION if name == "five_bar" else {}
    scene = "five_bar/tracking" if name == "five_bar" else ckc_pin.Scene("delta", t_end=1.0, controller={
        "type": "tracking", "Lambda": 1.0, "K_D": 10.0, "desired": DESIRED["delta"]})  # fmt: skip
    overrides = {"controller.desired": DESIRED[name], "solver.output_dt": dt, "t_end": t_end, **true}
    forces = inverse_dynamics(scene, overrides)
    assert forces.status == "done"
    return load(name, true or None), forces


def record(name, q_noise=0.0, torque_noise=0.0, seed=0, t_end=4.0, dt=0.004):
    """Return measurements of the independent coordinates and all torques."""
    mechanism, forces = motion(name, t_end, dt)
    random = np.random.default_rng(seed)
    data = {"t": forces.t}
    for coordinate in mechanism.independent:
        exact = forces.q_tree[:, mechanism.coordinates.index(coordinate)]
        data[coordinate] = exact + q_noise * random.normal(size=len(exact))
    for motor, tau in zip(mechanism.motors.names, forces.tau.T, strict=True):
        data[f"tau.{motor}"] = tau + torque_noise * random.normal(size=len(tau))
    return data


def errors(result, mechanism, parameters=PARAMETERS):
    """Return the errors of all base combinations, and their standard deviations."""
    regressor = TorqueRegressor(mechanism, parameters)
    truth = dict(zip((x.name for x in regressor.unknowns), regressor.start, strict=True))
    off = [x.value - sum(c * truth[name] for name, c in x.coefficients.items()) for x in result.base]
    return np.array(off), np.array([x.std for x in result.base])


@pytest.mark.parametrize(("name", "count"), [("five_bar", 19), ("delta", 34)])
def test_exact_data_give_the_truth(name, count):
    parameters = PARAMETERS if name == "five_bar" else ("link.*.inertial",)
    start = load(name, {"link.link_1.mass": 0.2, "link.link_3.mass": 0.3}) if name == "five_bar" else load(name)
    data = record(name, t_end=1.5, dt=0.002)
    result = identify(start, data, parameters, physical=False)
    assert len(result.base) == count
    off, _ = errors(result, motion(name, 4.0, 0.004)[0] if name == "five_bar" else start, parameters)
    assert np.abs(off).max() <= 1e-8


def test_truth_is_within_two_standard_deviations():
    inside = total = 0
    for seed in range(8):
        result = identify("five_bar", record("five_bar", 1e-4, 0.01, seed), PARAMETERS, physical=False)
        off, std = errors(result, motion("five_bar", 4.0, 0.004)[0])
        inside, total = inside + int(np.sum(np.abs(off) <= 2 * std)), total + len(off)
    assert inside >= binom.ppf(1e-3, total, 0.9)


def test_torques_of_another_motion_are_predicted_to_their_noise():
    data, other = record("five_bar", 1e-5, 0.01), record("five_bar", 1e-5, 0.01, seed=1, t_end=3.0, dt=0.002)
    result = identify("five_bar", data, PARAMETERS, validation=other, noise={"tau.theta_1": 0.01, "tau.theta_3": 0.01})
    for residuals in (result.residuals, result.validation):
        assert set(residuals) == {"tau.theta_1", "tau.theta_3"}
        for residual in residuals.values():
            assert 0.01 <= residual.expected <= 1.01 * 0.01  # of the motion: little
            assert residual.rms <= 1.05 * 0.01
            assert abs(residual.autocorrelation) <= 0.1


def test_torques_of_other_phases_are_predicted_to_their_noise():
    """Noise of the platform's forces is 0.1 % of them, so errors of its accelerations count."""
    assert run_trials("stewart", "torques", 1).validation_rms <= 1.05


def test_expected_residuals_contain_the_errors_of_accelerations():
    ratios = []
    for seed in range(0, 8, 2):
        data, other = (record("five_bar", 4e-3, 0.01, seed + k) for k in (0, 1))
        residuals = identify("five_bar", data, PARAMETERS, physical=False, validation=other).validation.values()
        ratios.append([(x.rms / x.expected, x.rms / 0.01) for x in residuals])
    to_expected, to_torques = np.sqrt(np.mean(np.square(ratios), axis=(0, 1)))
    assert 0.95 <= to_expected <= 1.05 < to_torques


def test_instants_of_uncertain_friction_are_left_out_and_torques_of_the_others_predicted():
    """With the wrong sign, friction of a joint is off by 0.04 to 0.1 N m, up to ten times the noise."""
    noise, rms = {"tau.theta_1": 0.01, "tau.theta_3": 0.01}, []
    for seed in range(0, 8, 2):
        data, other = (record("five_bar", 1e-4, 0.01, seed + k) for k in (0, 1))
        result = identify("five_bar", data, PARAMETERS, physical=False, noise=noise, validation=other)
        rms += [x.rms / 0.01 for x in result.validation.values()]
        left_out = [text for text in result.warnings if "the direction of friction is uncertain" in text]
        assert [text.split(": ")[0] for text in left_out] == ["data", "data (validation)"]
        assert all(1 <= int(text.split(": ")[1].split()[0]) <= 20 for text in left_out)
    assert np.sqrt(np.mean(np.square(rms))) <= 1.05
    frictionless = ("link.*.inertial", "joint.*.damping")
    data = {**record("five_bar", 1e-4, 0.01)}
    assert not identify("five_bar", data, frictionless, physical=False).warnings


def test_noisy_inertias_are_those_of_bodies_and_load_again():
    for seed in range(4):
        data = record("five_bar", 1e-3, 0.3, seed)
        result = identify("five_bar", data, PARAMETERS)
        assert result.physical
        rebuilt = load("five_bar", dict(result.values))
        for link in ("link_1", "link_2", "link_3", "link_4"):
            moments = link_moments(TorqueRegressor(rebuilt, ["link.*.inertial"]).parameters, link)
            assert np.linalg.eigvalsh(pseudo_inertia(moments))[0] > 0
        again = identify(rebuilt, data, PARAMETERS, physical=False)
        for ours, theirs in zip(result.residuals.values(), again.residuals.values(), strict=True):
            assert ours.rms <= 1.02 * theirs.rms


def test_physical_result_equals_the_unconstrained_one_where_that_is_physical():
    data = record("five_bar", 1e-5, 1e-4)
    free, bound = (identify("five_bar", data, PARAMETERS, physical=physical) for physical in (False, True))
    for a, b in zip(free.base, bound.base, strict=True):
        assert str(a) == str(b)
        assert abs(a.value - b.value) <= 0.05 * a.std + 1e-9


ROD = """<robot name="rod"><link name="base"/>
  <link name="rod"><inertial><origin xyz="0.4 0 0"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="weight"><inertial><origin xyz="0.02 0 0.01"/><mass value="0.7"/>
    <inertia ixx="0.002" iyy="0.002" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint>
  <joint name="weld" type="fixed"><parent link="rod"/><child link="weight"/>
    <origin xyz="0.8 0 0" rpy="0.3 0 0"/></joint>
</robot>"""
MASS, MOMENT, FRICTION_OF_ROD, DAMPING = 2.2, 1.5 * 0.4 + 0.7 * 0.82, 0.3, 0.2


def rod_data(noise=0.0):
    """Return a motion of the rod, and its torques by hand."""
    t = np.linspace(0, 5, 1001)
    q = 0.8 * np.sin(2 * t) + 0.4 * np.sin(5 * t + 1)
    v = 1.6 * np.cos(2 * t) + 2 * np.cos(5 * t + 1)
    a = -3.2 * np.sin(2 * t) - 10 * np.sin(5 * t + 1)
    tilted = np.sin(0.3) * 0.0  # the weight's inertia is isotropic, its centre turns with the weld
    height = 0.01 * np.cos(0.3) + tilted
    about = 0.03 + 1.5 * 0.4**2 + 0.002 + 0.7 * (0.82**2 + height**2)
    moment_z = 0.7 * height
    gravity = -9.81 * (MOMENT * np.cos(q) + moment_z * np.sin(q))  # potential energy falls where the rod turns down
    tau = about * a + gravity + DAMPING * v + FRICTION_OF_ROD * np.sign(v)
    tau = tau + noise * np.random.default_rng(0).normal(size=len(t))
    return {"t": t, "hinge": q, "tau.hinge": tau}, about, moment_z


def test_tree_equals_least_squares_by_hand_and_welded_links_are_combined():
    start = Mechanism.from_urdf(ROD)
    data, about, moment_z = rod_data()
    result = identify(start, data, ["link.*.inertial", "joint.hinge.friction", "joint.hinge.damping"])
    assert len(result.base) == 5
    assert result.parameters["joint.hinge.friction"].value == pytest.approx(FRICTION_OF_ROD, abs=2e-3)
    assert result.parameters["joint.hinge.damping"].value == pytest.approx(DAMPING, abs=2e-3)
    for link in ("rod", "weight"):
        assert result.parameters[f"link.{link}.mass"].value is None
    verdicts = {name: x.verdict for name, x in result.parameters.items()}
    assert verdicts["link.rod.mass"] == "not identifiable"
    assert verdicts["link.weight.com.x"] == "only in a combination"
    assert verdicts["link.rod.inertia.ixx"] == "not identifiable"
    values = {name: x for name, x in result.values.items() if name.startswith("link.")}
    rebuilt = Mechanism.from_urdf(ROD, parameters=values)
    body = rebuilt.tree.model.inertias[1]
    assert body.mass * body.lever[0] == pytest.approx(MOMENT, abs=1e-3)
    assert body.mass * body.lever[2] == pytest.approx(moment_z, abs=1e-3)
    assert body.toDynamicParameters()[6] == pytest.approx(about, abs=1e-3)


def test_offsets_gaps_units_and_delays():
    data, *_ = rod_data()
    data["tau.hinge"] = data["tau.hinge"] + 0.25
    data["hinge"] = np.rad2deg(data["hinge"])
    data["hinge"][100:110] = np.nan
    data["tau.hinge"][400:500] = np.nan
    from ckc_pin.identification.records import read_record
    from ckc_pin.identification.spec import DataSpec

    mechanism = Mechanism.from_urdf(ROD)
    spec = DataSpec(file="rod", units={"hinge": "deg"}, delay={"tau.hinge": 0.0})
    read = read_record(data, mechanism, spec)
    result = identify(
        mechanism, {"t": read.t, **read.values}, ["joint.hinge.friction", "joint.hinge.damping", "motor.*.offset"]
    )
    assert result.parameters["motor.hinge.offset"].value == pytest.approx(0.25, abs=2e-3)
    assert result.instants < 905


def test_text_in_a_csv_file_is_no_gap(tmp_path):
    (tmp_path / "arm.csv").write_text("t,theta_1\n0,1\n1,\n2,n.a.\n")
    with pytest.raises(InputError, match=r"arm\.csv: could not convert string to float: 'n\.a\.'"):
        identify("five_bar", tmp_path / "arm.csv", PARAMETERS)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_recording_of_ros_gives_the_columns_of_its_joint_states(tmp_path, storage):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from ckc_pin.identification.records import read_record
    from ckc_pin.identification.spec import DataSpec

    data = {name: x[:40] for name, x in record("five_bar").items()}
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as bag:
        topic = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        tracker = bag.add_connection("/tip", "geometry_msgs/msg/Point", typestore=store)
        for k, t in enumerate(data["t"]):
            nanoseconds = round(1e9 * t) + 1_700_000_000_000_000_000
            stamp = types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 1_000_000_000))
            header = types["std_msgs/msg/Header"](stamp, "base")
            position, effort = (np.array([data[f"{prefix}theta_{i}"][k] for i in (1, 3)]) for prefix in ("", "tau."))
            state = types["sensor_msgs/msg/JointState"](header, ["theta_1", "theta_3"], position, 0 * position, effort)
            raw = store.serialize_cdr(state, "sensor_msgs/msg/JointState")
            bag.write(topic, nanoseconds + 5, bytes(raw))  # logged later than it was measured
            point = types["geometry_msgs/msg/Point"](float(k), 2.0, 3.0)
            bag.write(tracker, nanoseconds, bytes(store.serialize_cdr(point, "geometry_msgs/msg/Point")))
    path = next(tmp_path.glob("bag/*.mcap")) if storage == "mcap" else tmp_path / "bag"
    spec = DataSpec(file="bag", names={"v.theta_2": "/tip.x"})
    read = read_record(path, load("five_bar"), spec)
    np.testing.assert_allclose(read.t, data["t"] - data["t"][0], atol=1e-9)
    for name in ("theta_1", "theta_3", "tau.theta_1", "tau.theta_3"):
        np.testing.assert_array_equal(read.values[name], data[name])
    np.testing.assert_array_equal(read.values["v.theta_2"], np.arange(40.0))


def test_noisy_encoders_on_all_joints_are_combined_and_an_offset_is_refused():
    mechanism, forces = motion("five_bar", 4.0, 0.004)
    data = record("five_bar", 1e-3, 0.01)
    for seed, name in enumerate(("theta_2", "theta_4")):  # four encoders of two freedoms disagree by their noise
        exact = forces.q_tree[:, mechanism.coordinates.index(name)]
        data[name] = exact + 1e-3 * np.random.default_rng(seed + 10).normal(size=len(exact))
    result = identify("five_bar", data, PARAMETERS)
    for name in FRICTION:
        assert abs(result.parameters[name].value - FRICTION[name]) <= 3 * result.parameters[name].std
    data["theta_4"] = data["theta_4"] + 0.01
    with pytest.raises(InputError, match=r"off the constraint manifold, \d+ times its noise"):
        identify("five_bar", data, PARAMETERS)


def test_delay_of_torques_is_estimated():
    from ckc_pin.identification.records import Record
    from ckc_pin.identification.torques import identify_torques

    data = record("five_bar", 1e-5, 0.01)
    late = {name: np.interp(data["t"] - 0.0073, data["t"], x) if "tau" in name else x for name, x in data.items()}
    values = {name: x for name, x in late.items() if name != "t"}
    delay = {"tau.theta_1": "estimate"}
    mechanism = load("five_bar")
    result = identify_torques(
        mechanism, [Record("late", data["t"], values, {}, delay)], PARAMETERS, physical=False, robust=False, prior={}
    )
    assert float(result.warnings[0].split("the torques are ")[1].split(" ms")[0]) == pytest.approx(7.3, abs=0.3)


def test_number_of_base_parameters_equals_the_rank_of_an_independent_regressor():
    """Pinocchio's regressor, projected on a null space of differences of the closure."""
    import pinocchio as pin

    mechanism, forces = motion("five_bar", 4.0, 0.004)
    tree, random = mechanism.tree, np.random.default_rng(0)
    rows = []
    for q in forces.q_tree[::40]:
        q_tree = tree.from_coordinates(q)
        J = np.array([(mechanism.closure.phi(mechanism.kinematics(q_tree + h).pose)
                       - mechanism.closure.phi(mechanism.kinematics(q_tree - h).pose)) / 2e-6
                      for h in 1e-6 * np.eye(4)]).T  # fmt: skip
        null = np.linalg.svd(J)[2][2:].T
        v = null @ random.normal(size=2)
        later, before = (mechanism.kinematics(q_tree + s * 1e-5 * v) for s in (1, -1))
        a = null @ random.normal(size=2) - np.linalg.pinv(J) @ ((later.J - before.J) @ v / 2e-5)
        rows.append(null.T @ pin.computeJointTorqueRegressor(tree.model, tree.data, q_tree, v, a))
    rank = np.linalg.matrix_rank(np.vstack(rows), tol=1e-7)
    result = identify("five_bar", record("five_bar"), ["link.*.inertial"], physical=False)
    assert len(result.base) == rank


BAD = [
    ({"theta_1": [0.0]}, "no column 't'"),
    ({"t": [0.0, 1.0, 1.0], "theta_1": [0, 0, 0]}, "t does not increase: 1 is followed by 1"),
    ({"t": [0.0, 1.0], "theta_1": [0, 0], "tau.theta_1": [0, 0], "tau.theta_3": [0, 0]}, "no column theta_3"),
    ({"t": [0.0, 1.0], "theta_1": [0, 0], "theta_3": [0, 0], "tau.theta_1": [0, 0]}, "no column tau.theta_3"),
    ({"t": [0.0, 1.0], "theta_1": [0, 90.0], "theta_3": [0, 0], "tau.theta_1": [0, 0], "tau.theta_3": [0, 0]},
     "theta_1 reaches 90 rad; if these are degrees"),
    ({"t": [0.0, 1.0], "theta_1": [0, 0], "theta_3": [0, 0], "tau.theta_1": [0, 0], "tau.theta_3": [0, 0]},
     "data: theta_1: 2 values; at least 16"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "message"), BAD)
def test_bad_data_have_one_message(data, message):
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        identify("five_bar", {name: np.array(x, dtype=float) for name, x in data.items()}, ["link.*.inertial"])


def test_bad_parameters_and_short_or_saturated_data_have_one_message():
    with pytest.raises(InputError, match=r"nothing is called 'link.\*.size'.*link.\*.inertial"):
        identify("five_bar", record("five_bar"), ["link.*.size"])
    few = {name: x[:20] for name, x in record("five_bar").items()}
    with pytest.raises(InputError, match=r"unknowns; record a longer motion"):
        identify("five_bar", few, PARAMETERS)
    early = record("five_bar", 1e-4)
    early["tau.theta_1"][10:] = np.nan
    with pytest.raises(
        InputError, match=r"no torque was measured from t = .* smooth functions of theta_1, theta_3 give"
    ):
        identify("five_bar", early, PARAMETERS)
    off = record("five_bar")
    off["theta_1"] = off["theta_1"] + 3.0
    with pytest.raises(InputError, match="they are of another branch"):
        identify("five_bar", off, PARAMETERS)
    limited = Mechanism.from_urdf(ROD, motors=[{"name": "hinge", "joint": "hinge", "torque_limit": 1.0}])
    data, *_ = rod_data()
    data["tau.hinge"] = np.clip(data["tau.hinge"], -1, 1)
    with pytest.raises(InputError, match=r"tau.hinge is at its limit, -1 to 1, most of the time"):
        identify(limited, data, ["joint.hinge.friction"])


def test_command_writes_result_parameters_and_figures(tmp_path):
    data = record("five_bar", 1e-4, 0.01)
    for name, seed in (("swing.csv", 0), ("other.csv", 1)):
        columns = record("five_bar", 1e-4, 0.01, seed) if seed else data
        rows = np.array(list(columns.values())).T
        np.savetxt(tmp_path / name, rows, delimiter=",", header=",".join(columns), comments="")
    file = tmp_path / "arm.identify.toml"
    file.write_text(
        'mechanism = "five_bar"\n[[data]]\nfile = "swing.csv"\nnoise = {"tau.theta_1" = 0.01}\n'
        '[[data]]\nfile = "other.csv"\nvalidation = true\n'
        '[estimate]\nparameters = ["link.*.inertial", "joint.*.friction", "joint.*.damping"]\n'
    )
    done = ckc("identify", str(file), "--out", str(tmp_path / "o"), "--figures", "--json")
    assert done.code == 0
    assert json.loads((tmp_path / "o" / "identification.json").read_text()) == done.json
    assert set(done.json["validation"]) == {"tau.theta_1", "tau.theta_3"}
    assert done.json["parameters"]["link.link_1.mass"] == {
        "value": None, "std": None, "start": 0.2451, "verdict": "not identifiable",
        "missing": "no motion of this mechanism determines it"}  # fmt: skip
    assert done.json["parameters"]["joint.theta_1.friction"]["value"] == pytest.approx(0.05, abs=0.02)
    for figure in ("torques", "residuals", "correlation", "ellipsoids"):
        assert (tmp_path / "o" / f"{figure}.png").stat().st_size > 5000
    page = (tmp_path / "o" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 4
    assert "swing.csv, other.csv (validation)" in page
    assert "no motion of this mechanism determines it alone" in page
    assert "http" not in page.replace("http-equiv", "")
    import tomllib

    values = tomllib.loads((tmp_path / "o" / "parameters.toml").read_text())["parameters"]
    assert load("five_bar", values).d == 2
    assert len(MOMENTS) * 4 + 8 == len(values)


def test_report_escapes_names():
    from dataclasses import replace

    from ckc_pin.view.report_page import render_report

    result = identify("five_bar", record("five_bar", 1e-4, 0.01), PARAMETERS)
    name = "<script>alert(1)</script>"
    motions = tuple(msgspec.structs.replace(x, source=name) for x in result.motions)
    warned = replace(
        result, motions=motions, warnings=(name,), parameters={name: result.parameters["link.link_1.mass"]}
    )
    page = render_report(warned, {})
    assert name not in page
    assert page.count("&lt;script&gt;") == 3
    assert "Figures need matplotlib" in page


def test_ellipsoid_of_a_homogeneous_body_is_its_shape():
    """Semi-axes 3, 2 and 1 have the moments m (b^2 + c^2) / 5."""
    from ckc_pin.view.identification_figures import compute_ellipsoid

    numbers = {"link.a.mass": 2.0, **{f"link.a.com.{axis}": x for axis, x in zip("xyz", (0.1, 0.2, 0.3), strict=True)}}
    moments = {"ixx": 2 * 5 / 5, "iyy": 2 * 10 / 5, "izz": 2 * 13 / 5, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    numbers |= {f"link.a.inertia.{entry}": x for entry, x in moments.items()}
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    centre, spread = compute_ellipsoid("a", numbers, turn)
    np.testing.assert_allclose(centre, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(spread, np.diag([4.0, 9.0, 1.0]), atol=1e-12)
