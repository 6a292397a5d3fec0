"""Live runs: pushes against equations of the tests' own, exported runs against what was shown, rewinding, threads."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import Force, InputError, Mechanism, Run, Scene, load, load_scene, simulate
from ckc_pin.explorer import live_run
from ckc_pin.explorer.live_run import MAX_FRAME_S, PUSH_DAMPING_RATIO, PUSH_FREQUENCY, LiveFrame, LiveRun, list_modes
from ckc_pin.explorer.messages import RunReport
from ckc_pin.scene.parts import load_scene_mechanism
from tests.analytic.five_bar import FIVE_BAR, Array
from tests.analytic.test_forces import generalized, integrate, turned
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc
from tests.explorer.test_saving import moved

SIX = ["five_bar", "delta", "stewart", "bricard", "two_ur5", "slider_crank"]
BLOCK = """<robot name="block"><link name="base"/>
<link name="block"><inertial><mass value="2.0"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="-10" upper="10" effort="100" velocity="10"/></joint></robot>"""


def frames(run: LiveRun, count: int) -> list[LiveFrame]:
    """Compute frames without a thread, and return them."""
    result = []
    for _ in range(count):
        run.advance()
        result.append(run.frame())
    return result


def of_scene(name: str, mode: Any = "scene", overrides: Any = None, **options: Any) -> LiveRun:
    scene = load_scene(name, overrides)
    mechanism = load_scene_mechanism(scene)
    return LiveRun(mechanism, mechanism.assembled, scene, mode, **options)


def grab(run: LiveRun, by: tuple[float, float, float] = (0.06, 0.04, 0.05)) -> None:
    """Push the last body, at a point of it, from where it is."""
    joint = list(run.mechanism.tree.model.names)[-1]
    pose = run.mechanism.kinematics(run.frame().q_tree).pose
    point = np.array([0.1, 0.02, 0.01])
    run.push(joint, point, pose.rotation[-1] @ point + pose.translation[-1] + by)


def assert_exported(run: LiveRun, shown: list[LiveFrame], folder: Path, tolerance: float) -> Run:
    """Export a run, and compare its rows with frames at the same times, and with `simulate` and the command."""
    path, message = run.export(folder, "shown")
    assert str(path) in message
    saved = Run.load(folder / "shown" / "run.npz")
    again = simulate(load_scene(path))
    assert saved.status == "done"
    assert np.array_equal(saved.q_tree, again.q_tree)
    assert np.array_equal(saved.v_tree, again.v_tree)
    tree, compared = run.mechanism.tree, 0
    for frame in shown:
        k = int(np.argmin(np.abs(saved.t - frame.t)))
        if abs(saved.t[k] - frame.t) < 1e-9:
            compared += 1
            assert_close(saved.q_tree[k], tree.to_coordinates(frame.q_tree), tolerance)
    assert compared > len(shown) / 2
    return saved


# --- pushes --------------------------------------------------------------------------------------


def test_a_push_is_the_damped_spring_of_a_block_with_zero_order_hold() -> None:
    """Exact motion of 2 kg under the force of the last frame, in NumPy."""
    block = Mechanism.from_urdf(BLOCK, gravity=[0.0, 0.0, 0.0])
    run = LiveRun(block, block.assembled, rtol=1e-11, formulation="dae")
    run.push("slide", [0.3, 0.1, 0.0], [0.4, 7.0, 0.0], normal=[0.0, 2.0, 0.0])
    x = v = 0.0
    for frame in frames(run, 60):
        a = PUSH_FREQUENCY**2 * (0.1 - x) - 2 * PUSH_DAMPING_RATIO * PUSH_FREQUENCY * v
        assert frame.push is not None
        assert_close(frame.push[0], [x + 0.3, 0.1, 0.0], 1e-8)
        assert_close(frame.push[1], [2.0 * a, 0.0, 0.0], 1e-6)
        x, v = x + v * MAX_FRAME_S + 0.5 * a * MAX_FRAME_S**2, v + a * MAX_FRAME_S
        assert_close([frame.q_tree[0], frame.v_tree[0]], [x, v], 1e-8)
    assert abs(x - 0.1) < 1e-3
    run.release()
    assert frames(run, 1)[0].push is None


def test_a_push_accelerates_the_grabbed_point_of_the_five_bar_by_the_spring() -> None:
    """The force of the first frame in the appendix's equations: the point accelerates by omega^2 (target - point)."""
    mechanism = load("five_bar")
    at = moved(mechanism, 0.5)
    run = LiveRun(mechanism, at, rtol=1e-11)
    pose = at.pose
    joint = mechanism.tree.model.names.tolist().index("theta_2")
    point = np.array([0.12, 0.03, 0.0])
    place = pose.rotation[joint] @ point + pose.translation[joint]
    run.push("theta_2", point, place + np.array([0.05, -0.02, 0.3]))
    run.advance()
    push = run.frame().push
    assert push is not None
    assert_close(push[0], place, 1e-12)
    q_tree = FIVE_BAR.sigma(mechanism.independent_part(at.q_tree))
    force = generalized(1, (0.12, 0.03), lambda t, q: (push[1][:2], 0.0), 0.0, q_tree)
    rho = FIVE_BAR.rho(q_tree)
    still = np.zeros(2)
    q_ddot = FIVE_BAR.acceleration(q_tree, still, rho.T @ force) - FIVE_BAR.acceleration(q_tree, still, still)
    units = [generalized(1, (0.12, 0.03), lambda t, q, e=e: (e, 0.0), 0.0, q_tree) for e in np.eye(2)]
    assert_close(np.array(units) @ rho @ q_ddot, PUSH_FREQUENCY**2 * np.array([0.05, -0.02]), 1e-6)
    # The frame's motion: the force at the joint of link 2, and its moment about the joint at the frame's start.
    arm = turned(q_tree[0] + q_tree[1], np.array([0.12, 0.03]))
    moment = arm[0] * push[1][1] - arm[1] * push[1][0]
    wrench = (1, (0.0, 0.0), lambda t, q: (push[1][:2], moment))
    q_end, v_end = integrate(np.array([0.0, MAX_FRAME_S]), [wrench], np.concatenate([q_tree, np.zeros(4)]))
    assert_close(run.frame().q_tree, q_end[-1], 1e-9)
    assert_close(run.frame().v_tree, v_end[-1], 1e-8)


@pytest.mark.parametrize("name", SIX)
@pytest.mark.parametrize("mode", ["free", "hold"])
def test_pushed_runs_are_exported_as_they_were_shown(name: str, mode: Any, tmp_path: Path) -> None:
    mechanism = load(name)
    if mode not in list_modes(mechanism, None):
        pytest.fail(f"{name} has no mode {mode}")
    run = LiveRun(mechanism, moved(mechanism, 0.02), None, mode, rtol=1e-10)
    shown = frames(run, 3)
    grab(run)
    shown += frames(run, 12)
    run.release()
    shown += frames(run, 5)
    grab(run, (-0.02, 0.03, 0.0))
    shown += frames(run, 4)
    assert run.report().state == "running"
    saved = assert_exported(run, shown, tmp_path, 2e-6)
    assert saved.force_values is not None
    assert np.abs(saved.force_values).max() > 0.1
    free = simulate(load_scene(tmp_path / "shown" / "shown.scene.toml", {"force": []}))
    assert np.abs(free.q_tree[-1] - saved.q_tree[-1]).max() > 1e-3  # the push matters


def test_pushes_in_a_scene_with_friction_and_a_controller_are_exported(tmp_path: Path) -> None:
    run = of_scene("five_bar/friction", rtol=1e-9)
    shown = frames(run, 10)
    grab(run)
    shown += frames(run, 20)
    saved = assert_exported(run, shown, tmp_path, 1e-6)
    assert saved.scene["controller"]["type"] == "tracking"


@pytest.mark.parametrize("name", ["five_bar/swing", "five_bar/tracking", "four_bar/servo", "slider_crank/driven"])
def test_an_unpushed_run_is_the_command_run_of_its_scene_to_the_bit(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)
    mode = "scene" if "scene" in list_modes(load_scene_mechanism(scene), scene) else "free"
    run = of_scene(name, mode)
    shown = frames(run, 20)
    saved = assert_exported(run, shown, tmp_path, 1e-4)
    assert ckc("run", str(tmp_path / "shown" / "shown.scene.toml"), "--out", str(tmp_path / "command")).code == 0
    again = Run.load(tmp_path / "command" / "run.npz")
    for key in ("t", "q_tree", "v_tree", "tau", "energy"):
        assert np.array_equal(getattr(again, key), getattr(saved, key))


# --- motors --------------------------------------------------------------------------------------


def test_torques_of_sliders_are_limited_and_exported(tmp_path: Path) -> None:
    run = of_scene("five_bar/tracking", "free", {"controller.torque_limit": 0.5}, rtol=1e-10)
    shown = frames(run, 5)
    run.set_motor("theta_1", 0.3)
    shown += frames(run, 10)
    assert_close(shown[-1].tau, [0.3, 0.0], 0.0)
    run.set_motor("theta_3", -2.0)
    shown += frames(run, 5)
    assert_close(shown[-1].tau, [0.3, -0.5], 0.0)
    saved = assert_exported(run, shown, tmp_path, 1e-7)
    assert_close(saved.tau[8], [0.3, 0.0], 0.0)
    assert_close(saved.tau[18], [0.3, -0.5], 0.0)


@pytest.mark.parametrize("name", ["five_bar", "delta", "stewart"])
def test_hold_rests_at_the_pose_and_moves_to_targets(name: str, tmp_path: Path) -> None:
    mechanism = load(name)
    at = moved(mechanism, 0.02)
    run = LiveRun(mechanism, at, None, "hold", rtol=1e-9)
    shown = frames(run, 10)
    assert_close(shown[-1].q_tree, at.q_tree, 1e-8)
    joint, start = mechanism.independent[0], run.targets[mechanism.independent[0]]
    run.set_motor(joint, start + 0.03)
    shown += frames(run, 40)
    run.set_motor(joint, start - 0.01)
    shown += frames(run, 70)
    q = mechanism.independent_part(shown[-1].q_tree)
    expected = mechanism.independent_part(at.q_tree) - 0.01 * (np.arange(mechanism.d) == 0)
    assert_close(q, expected, 1e-4)
    peak = max(mechanism.independent_part(frame.q_tree)[0] for frame in shown)
    assert peak == pytest.approx(start + 0.03, abs=2e-3)  # the targets' speed is fed forward, not their deceleration
    assert_exported(run, shown, tmp_path, 1e-7)


def test_hold_is_critically_damped_with_2_hz() -> None:
    """At fixed D, a deviation of q decays as (1 + w t) exp(-w t); pushed off, released, a block returns so."""
    block = Mechanism.from_urdf(BLOCK, gravity=[0.0, 0.0, 0.0])
    run = LiveRun(block, block.assembled, None, "hold", rtol=1e-11, q_dot=np.array([0.5]))
    w = 2 * np.pi * 2.0
    for frame in frames(run, 60):
        assert_close(frame.q_tree[0], 0.5 * frame.t * np.exp(-w * frame.t), 1e-8)


# --- time ----------------------------------------------------------------------------------------

MOTOR = {"K_P": 8.0, "K_I": 60.0, "K_D": 0.6, "desired": {"offset": -1.2}}
PID = {"type": "joint_servo", "motor": {"theta_1": MOTOR, "theta_3": {**MOTOR, "desired": {"offset": -1.9}}}}
REWOUND = [
    ("five_bar/swing", "free", None),
    ("five_bar/tracking", "scene", None),
    ("five_bar/tracking", "hold", None),
    ("five_bar/set_point", "scene", {"controller": PID}),
    ("five_bar/set_point", "scene", {"controller": {**PID, "sample_time": 0.007}}),
    ("five_bar/friction", "scene", None),
]


@pytest.mark.parametrize(("name", "mode", "overrides"), REWOUND)
def test_a_rewound_run_continues_as_it_did(name: str, mode: Any, overrides: Any, tmp_path: Path) -> None:
    """Also with the state of the controller: integrals, samples and moved targets at that time."""
    run = of_scene(name, mode, overrides, rtol=1e-10)
    if mode == "hold":
        run.set_motor("theta_1", run.targets["theta_1"] + 0.2)
    grab(run)
    shown = frames(run, 12)
    run.release()
    shown += frames(run, 30)
    run.rewind(shown[19].t + 0.3 * MAX_FRAME_S)
    assert run.report() == RunReport(state="paused", t=shown[19].t, t_last=shown[-1].t)
    assert np.array_equal(run.frame().q_tree, shown[19].q_tree)
    run.advance()
    assert np.array_equal(run.frame().q_tree, shown[19].q_tree)  # paused
    run.pause(False)
    assert run.report().t_last == shown[19].t
    again = frames(run, 22)
    for ours, theirs in zip(again, shown[20:], strict=True):
        assert ours.t == pytest.approx(theirs.t, abs=1e-12)
        assert_close(ours.q_tree, theirs.q_tree, 1e-6)
        assert_close(ours.tau, theirs.tau, 1e-4)
    assert_exported(run, [*shown[:20], *again], tmp_path, 1e-6)


def test_a_run_that_was_rewound_without_continuing_is_exported_up_to_there(tmp_path: Path) -> None:
    run = of_scene("five_bar/swing", "free")
    shown = frames(run, 20)
    run.rewind(shown[9].t)
    path, _ = run.export(tmp_path, "part")
    assert load_scene(path).spec.t_end == shown[9].t
    run.rewind(-5.0)
    assert run.report().t == 0.0
    with pytest.raises(InputError, match="export: the run has no frame after its start"):
        run.export(tmp_path, "none")


def test_a_run_that_stops_keeps_its_frames_and_says_why(tmp_path: Path) -> None:
    run = of_scene("five_bar/swing", "hold")
    run.set_motor("theta_1", -3.0)  # out of reach
    run.set_motor("theta_3", 0.0)
    frames(run, 600)
    report = run.report()
    assert report.state == "stopped"
    assert report.message.startswith(f"stopped at t = {report.t_last:.6g} s: ")
    assert "singular" in report.message
    assert run.frame().t == report.t_last > 0.05
    run.rewind(report.t_last / 2)
    assert run.report().state == "paused"
    run.pause(False)
    assert run.report() == RunReport(state="running", t=run.frame().t, t_last=run.frame().t)
    assert frames(run, 1)[0].t > report.t_last / 2
    assert run.export(tmp_path, "stopped")[0].exists()


def test_an_event_that_stops_the_scene_stops_the_run() -> None:
    event = {"of": "q", "coordinate": "theta_1", "value": -1.3, "stop": True}
    run = of_scene("five_bar/swing", "free", {"event": [event]})
    run.set_motor("theta_1", 1.0)
    frames(run, 100)
    report = run.report()
    assert report.state == "stopped"
    assert "event" in report.message
    assert run.frame().q_tree[0] == pytest.approx(-1.3, abs=1e-6)


def test_stored_frames_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_run, "MAX_FRAMES", 64)
    run = of_scene("five_bar/swing", "free")
    shown = frames(run, 500)
    assert len(run._frames) == len(run._times) <= 65
    assert run.report().t == shown[-1].t
    for frame in shown[::37]:
        run.rewind(frame.t)
        assert frame.t - 16 * MAX_FRAME_S < run.report().t <= frame.t
    run.pause(False)
    assert frames(run, 1)[0].t == pytest.approx(run._times[-1])


@pytest.mark.parametrize("speed", [0.25, 1.0, 20.0])
def test_a_thread_computes_frames_not_faster_than_real_time(speed: float) -> None:
    calls: list[float] = []
    mechanism = load("five_bar")
    run = LiveRun(mechanism, mechanism.assembled, speed=speed, on_frame=lambda: calls.append(time.monotonic()))
    began = time.monotonic()
    run.start()
    while run.report().t_last < 0.3 * speed and time.monotonic() < began + 20.0:
        time.sleep(0.01)
        assert run.report().t_last <= speed * (time.monotonic() - began) + MAX_FRAME_S * max(speed, 1.0)
    report = run.report()
    assert report.state == "running"
    assert report.t_last >= 0.3 * speed
    assert 0.0 < report.real_time < 1.3 * speed
    run.pause()
    time.sleep(0.1)
    paused = run.report()
    assert paused.state == "paused"
    time.sleep(0.1)
    assert run.report().t_last == paused.t_last
    run.pause(False)
    while run.report().t_last == paused.t_last and time.monotonic() < began + 30.0:
        time.sleep(0.01)
    assert run.report().t_last > paused.t_last
    run.stop()
    time.sleep(0.1)
    last = run.report()
    assert last.state == "stopped"
    count = len(calls)
    time.sleep(0.1)
    assert run.report() == last
    assert len(calls) == count
    assert np.diff(calls)[:-1].min() > 0.9 / 60.0


def test_requests_at_any_time_do_not_disturb_the_thread() -> None:
    random = np.random.default_rng(8)
    for mode in ("free", "hold", "scene"):
        run = of_scene("five_bar/tracking", mode, speed=3.0)
        run.start()
        for _ in range(150):
            match random.integers(7):
                case 0:
                    grab(run, tuple(random.uniform(-0.1, 0.1, 3)))
                case 1:
                    run.release()
                case 2:
                    run.rewind(random.uniform(0.0, run.report().t_last))
                case 3 | 4:
                    run.pause(False)
                case 5 if mode != "scene":
                    run.set_motor(
                        "theta_3", random.uniform(-1.9, -1.6) if mode == "hold" else random.uniform(-0.3, 0.3)
                    )
                case _:
                    frame = run.frame()
                    assert_close(run.mechanism.kinematics(frame.q_tree).phi, 0.0, 1e-9)
            time.sleep(random.uniform(0.0, 0.01))
        assert "Error" not in run.report().message
        times = np.array(run._times)
        assert np.all(np.diff(times) > 0)
        run.stop()


# --- wrong requests ------------------------------------------------------------------------------


def test_modes_are_those_that_the_mechanism_has() -> None:
    scene = load_scene("five_bar/tracking")
    assert list_modes(load("five_bar"), None) == ["free", "hold"]
    assert list_modes(load_scene_mechanism(scene), scene) == ["free", "scene", "hold"]
    andrews = load("andrews")
    expected = ["free", "hold"] if andrews.actuated else ["free"]
    assert list_modes(andrews, None) == expected
    unmoved = Mechanism.from_urdf(BLOCK, actuated=[])
    assert list_modes(unmoved, None) == ["free"]
    with pytest.raises(InputError, match="run: mode 'hold': block has no motors; choose 'free'"):
        LiveRun(unmoved, unmoved.assembled, None, "hold")
    run = LiveRun(unmoved, unmoved.assembled)
    assert frames(run, 3)[-1].tau.shape == (0,)
    with pytest.raises(InputError, match="run: mode 'scene': there is no controller"):
        LiveRun(unmoved, unmoved.assembled, None, "scene")


def test_wrong_requests_are_rejected_and_change_nothing() -> None:
    run = of_scene("five_bar/tracking", "free")
    refused: list[tuple[Any, str]] = [
        (lambda: run.push("theta_9", [0, 0, 0], [0, 0, 0]), "push: no joint 'theta_9' moves a body; there are theta_1"),
        (lambda: run.push("theta_1", [0, 0], [0, 0, 0]), "push: point: expected 3 finite numbers"),
        (lambda: run.push("theta_1", [0, 0, 0], [0, np.nan, 0]), "push: target: expected 3 finite numbers"),
        (lambda: run.push("theta_1", [0, 0, 0], [0, 0, 0], "up"), "push: normal: expected 3 finite numbers"),
        (lambda: run.set_motor("theta_2", 1.0), "set_motor: no motor 'theta_2'; there are theta_1, theta_3"),
        (lambda: run.set_motor("theta_1", np.inf), "set_motor: theta_1: expected a finite number"),
        (lambda: run.set_motor("theta_1", "1"), "set_motor: theta_1: expected a finite number"),
        (lambda: run.rewind(np.nan), "rewind: t = nan"),
        (lambda: run.set_speed(0.0), "run: speed = 0.0|speed = the number 0"),
        (lambda: run.set_speed(1000.0), "run: speed"),
    ]
    for request, says in refused:
        with pytest.raises(InputError, match=says):
            request()
    other = of_scene("five_bar/tracking", "free")
    assert np.array_equal(frames(run, 5)[-1].q_tree, frames(other, 5)[-1].q_tree)
    with pytest.raises(InputError, match="set_motor: theta_1: the scene's controller sets the motors"):
        of_scene("five_bar/tracking").set_motor("theta_1", 1.0)
    with pytest.raises(InputError, match="set_motor: no independent coordinate 'theta_2'"):
        of_scene("five_bar/tracking", "hold").set_motor("theta_2", 1.0)


def test_a_run_with_objects_of_python_says_that_it_cannot_be_exported(tmp_path: Path) -> None:
    scene = Scene("five_bar", t_end=1.0, controller=lambda t, terms: [0.1, 0.0])
    mechanism = load_scene_mechanism(scene)
    run = LiveRun(mechanism, mechanism.assembled, scene, "scene")
    frames(run, 3)
    with pytest.raises(InputError, match="files cannot describe the scene's controller"):
        run.export(tmp_path, "function")


def test_an_error_of_a_function_stops_the_run() -> None:
    def fail(t: float, terms: Any) -> Array:
        if t > 0.05:
            raise ValueError("no more")
        return np.zeros(2)

    scene = Scene("five_bar", t_end=1.0, controller=fail)
    mechanism = load_scene_mechanism(scene)
    run = LiveRun(mechanism, mechanism.assembled, scene, "scene")
    frames(run, 10)
    assert run.report().state == "stopped"
    assert "ValueError: no more" in run.report().message


def test_stop_ends_a_long_step_of_the_thread() -> None:
    """A force with 20 kHz makes a frame last for minutes."""
    shake = Force("link_2", lambda t, terms: [1e-3 * np.sin(1e6 * t), 0.0, 0.0])
    scene = load_scene("five_bar/swing").with_control(None, [], [shake])
    mechanism = load_scene_mechanism(scene)
    run = LiveRun(mechanism, mechanism.assembled, scene, rtol=1e-12)
    run.start()
    time.sleep(0.3)
    began = time.monotonic()
    run.stop()
    while any(thread.name == "ckc_pin live run" for thread in threading.enumerate()):
        assert time.monotonic() < began + 5.0
        time.sleep(0.01)
    assert run.report().t == 0.0


def test_a_mechanism_with_a_partly_constrained_root_has_no_modes() -> None:
    body = BLOCK.partition('<link name="block">')[2].partition("</link>")[0]
    urdf = f'<robot name="b"><link name="body">{body}</link></robot>'
    ball = {"name": "ball", "type": "point", "frame_a": "body", "frame_b": "world"}
    mechanism = Mechanism.from_urdf(trees=[{"file": urdf, "root": "free"}], loops=[ball])
    assert list_modes(mechanism, None) == []
    with pytest.raises(InputError, match="run: b: the loops constrain a free root in part"):
        LiveRun(mechanism, mechanism.assembled)
