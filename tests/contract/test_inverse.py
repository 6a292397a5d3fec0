"""`ckc inverse`: keys and shapes, table, files, end of a motion, and rejected input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, NumericalError, inverse_dynamics
from tests.conftest import assert_close
from tests.contract.helpers.bad import Bad, expect
from tests.contract.helpers.command import ckc
from tests.contract.test_mechanism_keys import write

KEYS = """t coordinates q_tree v_tree a_tree actuated tau loop_forces joint_forces exceeded redundant status
          message"""
SHORT_RUN = ("--set", "t_end=0.2")


class Swing:
    def tau(self, t: float, terms: ckc_pin.Terms) -> list[float]:
        return [0.2 * np.sin(5 * t + 1)]


def test_json() -> None:
    answer = ckc("inverse", "five_bar/tracking", *SHORT_RUN, "--json")
    assert (answer.code, answer.err) == (0, "")
    forces = answer.json
    assert sorted(KEYS.split()) == sorted(forces)
    m = len(forces["t"])
    assert m > 5
    assert (forces["t"][0], forces["t"][-1]) == (0.0, 0.2)
    assert forces["coordinates"] == ["theta_1", "theta_2", "theta_3", "theta_4"]
    assert forces["actuated"] == ["theta_1", "theta_3"]
    for key, width in (("q_tree", 4), ("v_tree", 4), ("a_tree", 4), ("tau", 2)):
        assert np.shape(forces[key]) == (m, width)
    assert set(forces["loop_forces"]) == {"elbow"}
    elbow = forces["loop_forces"]["elbow"]
    assert elbow["rows"] == ["x", "y"]
    assert np.shape(elbow["multipliers"]) == (m, 2)
    assert np.shape(elbow["force"]) == np.shape(elbow["moment"]) == (m, 3)
    assert {name: np.shape(x) for name, x in forces["joint_forces"].items()} == dict.fromkeys(
        forces["coordinates"], (m, 6)
    )
    assert (forces["status"], forces["exceeded"], forces["redundant"]) == ("done", [], [])
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith("| `inverse`"))
    section = page.partition("\n## inverse\n")[2].partition("\n## ")[0]
    keys = (*forces, *elbow, "motor", "t_most")
    assert [key for key in keys if not re.search(rf"\b{key}\b", row + section)] == []


def test_summary_names_largest_forces_and_exceeded_limits() -> None:
    answer = ckc("inverse", "five_bar/tracking", "--set", "controller.torque_limit={theta_1 = 1.2, theta_3 = 2.0}")
    assert (answer.code, answer.err) == (0, "")
    forces = inverse_dynamics("five_bar/tracking", {"controller.torque_limit": {"theta_1": 1.2, "theta_3": 2.0}})
    rows = {line[:15].strip(): line for line in answer.out.splitlines()}
    for motor, tau in zip(forces.actuated, np.abs(forces.tau).T, strict=True):
        assert f"{tau.max():.4g} N m" in rows[f"motor {motor}"]
        assert f"{forces.t[np.argmax(tau)]:.4g}" in rows[f"motor {motor}"]
    (entry,) = forces.exceeded
    assert entry["motor"] == "theta_1"
    assert f"1.2 N m, exceeded from t = {entry['t']:.4g} s on" in answer.out
    assert rows["motor theta_3"].rstrip().endswith("2 N m")
    elbow = np.linalg.norm(forces.loop_forces["elbow"], axis=1)
    assert f"{elbow.max():.4g} N" in rows["loop elbow"]
    assert "moment" not in answer.out


def test_files(tmp_path: Path) -> None:
    answer = ckc("inverse", "delta/circle", *SHORT_RUN, "--out", str(tmp_path / "forces"), "--figures")
    assert answer.code == 0
    assert (tmp_path / "forces" / "inverse.png").read_bytes().startswith(b"\x89PNG")
    forces = inverse_dynamics("delta/circle", {"t_end": 0.2})
    with np.load(tmp_path / "forces" / "inverse.npz", allow_pickle=False) as data:
        saved = {name: data[name] for name in data.files}
    assert_close(saved["tau"], forces.tau, 0)
    assert saved["actuated"].tolist() == list(forces.actuated)
    assert saved["rows"].tolist() == [".".join(name) for name in forces.mechanism.closure.names]
    for k, loop in enumerate(saved["loops"]):
        of_loop = [name.startswith(f"{loop}.") for name in saved["rows"].tolist()]
        assert_close(saved["multipliers"][:, of_loop], forces.loop_forces[loop], 0)
        assert_close(saved["loop_wrenches"][:, k], forces.loop_wrenches[loop], 0)
    for k, joint in enumerate(saved["joints"]):
        assert_close(saved["joint_forces"][:, k], forces.joint_forces[joint], 0)
    assert json.loads(saved["meta"].tobytes())["status"] == "done"
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "run_file.md").read_text(encoding="utf-8")
    section = page.partition("\n## inverse.npz\n")[2].partition("\n## ")[0]
    assert [name for name in saved if not re.search(rf"\b{name}\b", section)] == []


def test_inverse_dynamics_of_a_recorded_run_returns_its_torques(
    run: Callable[..., ckc_pin.Run], tmp_path: Path
) -> None:
    recorded = run("five_bar/tracking", formulation="reduced")
    recorded.save(tmp_path / "run.npz")
    for what in (str(tmp_path), str(tmp_path / "run.npz")):
        forces = ckc("inverse", what, "--set", "controller.torque_limit=10", "--json").json
        assert_close(forces["t"], recorded.t, 0)
        assert_close(forces["tau"], recorded.tau, 1e-9)
        assert {entry["motor"] for entry in forces["exceeded"]} == {"theta_1", "theta_3"}


# --- along a point's path --------------------------------------------------------------------------


CIRCLE = "controller.desired={point = 'tip', circle = {centre = [0.15, -0.42, 0.0], radius = 0.06, frequency = 2.0}}"
LINE = (
    "controller.desired={point = 'tip', line = {start = [0.15, -0.42, 0.0], end = [0.15, -0.9, 0.0], frequency = 1.0}}"
)


def test_work_along_a_point_path_equals_the_energy() -> None:
    """The work of the motors equals the change of energy."""
    forces = inverse_dynamics("five_bar/tracking", {"controller.desired": {
        "point": "tip", "circle": {"centre": [0.15, -0.42, 0.0], "radius": 0.06, "frequency": 2.0}
    }, "t_end": 1.0, "solver.output_dt": 0.001})  # fmt: skip
    assert forces.status == "done"
    mechanism = forces.mechanism
    places = np.array([mechanism.point_positions(q)["tip"] for q in forces.q_tree])
    assert_close(np.linalg.norm(places - [0.15, -0.42, 0.0], axis=1), 0.06, 1e-9)
    terms = [
        ckc_pin.Terms(mechanism, mechanism.kinematics(q), v) for q, v in zip(forces.q_tree, forces.v_tree, strict=True)
    ]
    power = np.sum(forces.tau * (forces.v_tree @ mechanism.motors.transmission.T), axis=1)
    work = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(forces.t))])
    energy = np.array([at.energy for at in terms])
    assert_close(energy - energy[0], work, 1e-6)


def test_path_is_followed_up_to_the_workspace_boundary() -> None:
    answer = ckc("inverse", "five_bar/tracking", "--set", LINE, "--json")
    assert answer.code == 3
    forces = answer.json
    assert forces["status"] == "stopped"
    assert forces["message"] == answer.err.rstrip("\n")
    assert "leaves the workspace of its branch at t = " in forces["message"]
    leaves_at = float(re.search(r"branch at t = ([\d.]+)", forces["message"])[1])
    assert forces["t"][-1] <= leaves_at < forces["t"][-1] + 0.021
    assert len(forces["tau"]) == len(forces["t"]) > 10


def test_trajectory_is_followed_up_to_the_workspace_boundary(tmp_path: Path) -> None:
    answer = ckc("inverse", "five_bar_as_printed/tracking", "--out", str(tmp_path))
    assert answer.code == 3
    assert "the motion cannot be followed beyond t = 4.393" in answer.err
    with np.load(tmp_path / "inverse.npz") as data:
        assert 4.37 < data["t"][-1] < 4.394


def test_redundant_rows_are_named() -> None:
    forces = inverse_dynamics("stewart/wave", {"t_end": 0.02})
    assert forces.mechanism.redundant == ()
    assert "open" not in forces.message


def test_message_names_redundant_rows(bar: Path) -> None:
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    (bar / "mechanism.toml").write_text(text.replace('"point_2d"', '"point"'), encoding="utf-8")
    answer = ckc("inverse", "bar/tracking.scene.toml", *SHORT_RUN, "--json")
    assert answer.json["redundant"] == ["elbow.z"]
    assert "rows elbow.z are redundant" in answer.json["message"]
    assert_close(np.array(answer.json["loop_forces"]["elbow"]["multipliers"])[:, 2], 0, 1e-12)
    flat = inverse_dynamics("five_bar/tracking", {"t_end": 0.2})
    assert_close(answer.json["tau"], flat.tau, 1e-9)


def test_interrupted_inverse_dynamics_keeps_its_results() -> None:
    def stop(t: float, t_end: float) -> None:
        if t > 0.1:
            raise KeyboardInterrupt("SIGTERM")

    forces = inverse_dynamics("five_bar/tracking", progress=stop)
    assert forces.status == "interrupted"
    assert "by SIGTERM" in forces.message
    assert 0.1 < forces.t[-1] < 0.15


# --- what is refused -------------------------------------------------------------------------------

BAD = [
    Bad("no controller", ["inverse", "five_bar/swing"], ["five_bar/swing", "no [controller]", "controller.desired"]),
    Bad("no desired", ["inverse", "bar/tracking.scene.toml", "--set", "controller.desired={}"],
        ["controller.desired", "theta_1", "missing"]),
    Bad("no such thing", ["inverse", "six_bar"], ["no mechanism 'six_bar'", "five_bar"]),
    Bad("no run", ["inverse", "bar/run.npz"], ["bar/run.npz", "no such run file"]),
    Bad("not a run", ["inverse", "other.npz"], ["other.npz", "not a run file"], files={"other.npz": "no zip"}),
    Bad("a start out of reach", ["inverse", "bar/tracking.scene.toml", "--set", "controller.desired.theta_1.offset=3"],
        ["the motion cannot be started", "q_d(0) is out of reach"]),
    Bad("a path out of reach", ["inverse", "five_bar/tracking", "--set", CIRCLE.replace("-0.42", "-4.2")],
        ["the start of the path cannot be reached", "'tip'"]),
    Bad("an unknown motor", ["inverse", "five_bar/tracking", "--set", "controller.torque_limit={theta_2 = 1.0}"],
        ["torque_limit", "theta_2", "theta_1, theta_3"]),
    Bad("too few motors", ["inverse", "bar/tracking.scene.toml"],
        ["actuated: theta_1 cannot drive every freedom", "theta_3 is driven by none"],
        edits={"mechanism.toml": ('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]')}),
]  # fmt: skip


@pytest.mark.parametrize("case", BAD, ids=lambda case: case.what)
def test_bad_input(case: Bad, bar: Path) -> None:
    expect(case, bar)


def test_run_of_another_mechanism_is_rejected(run: Callable[..., ckc_pin.Run]) -> None:
    recorded, other = run("five_bar/tracking", formulation="reduced"), ckc_pin.load("four_bar")
    with pytest.raises(InputError, match=r"the run's coordinates are theta_1, .*its mechanism's crank"):
        inverse_dynamics(replace(recorded, texts=other.sources.texts))
    with pytest.raises(InputError, match="a run belongs to its mechanism"):
        inverse_dynamics(recorded, {"mechanism": "four_bar"})


def test_run_with_open_loops_is_rejected() -> None:
    recorded = ckc_pin.simulate("five_bar/swing", {
        "formulation": "spf", "initial.at": None, "initial.q": {"theta_1": -1.2, "theta_3": -1.9},
        "initial.w": [1e-3, 0.0], "t_end": 0.05})  # fmt: skip
    with pytest.raises(InputError, match="starts off phi = 0, with open loops"):
        inverse_dynamics(recorded)


def test_passive_run_needs_no_motors(bar: Path) -> None:
    """No torque is needed; only loop and joint forces are computed."""
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    (bar / "mechanism.toml").write_text(text.replace('actuated = ["theta_1", "theta_3"]', 'actuated = ["theta_1"]'))
    recorded = ckc_pin.simulate(bar / "swing.scene.toml", {"t_end": 0.3})
    forces = inverse_dynamics(recorded)
    assert forces.status == "done"
    assert_close(forces.tau, 0, 1e-12)
    assert_close(forces.loop_forces["elbow"], recorded.loop_forces()["elbow"], 1e-10)
    broken = replace(recorded, v_tree=np.full_like(recorded.v_tree, np.nan))
    with pytest.raises(NumericalError):
        inverse_dynamics(broken)


def test_free_root_needs_no_motor(tmp_path: Path) -> None:
    """An arm turns on a floating body. Generalized forces along the body's freedoms are zero up to rounding."""
    write(tmp_path, "free", "root.z = 0.5")
    text = (tmp_path / "mechanism.toml").read_text(encoding="utf-8")
    motor = text.replace("[[tree]]", 'actuated = ["turn"]\n[[tree]]')
    (tmp_path / "mechanism.toml").write_text(motor, encoding="utf-8")
    scene = tmp_path / "default.scene.toml"
    scene.write_text(
        'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n'
        '[initial]\nat = "assembled"\n[initial.q_dot]\nroot.rx = 0.4\nroot.y = -0.2\nturn = 0.3\n'
    )
    recorded = ckc_pin.simulate(scene, controller=Swing())
    forces = inverse_dynamics(recorded)
    assert forces.status == "done"
    assert np.ptp(recorded.tau) > 0.3
    assert_close(forces.tau, recorded.tau, 1e-12)


def test_overrides_of_a_scene_are_those_of_its_name() -> None:
    overrides = {"t_end": 0.5}
    forces = inverse_dynamics(ckc_pin.load_scene("five_bar/tracking"), overrides)
    assert forces.t[-1] == 0.5
    np.testing.assert_array_equal(forces.tau, inverse_dynamics("five_bar/tracking", overrides).tau)
