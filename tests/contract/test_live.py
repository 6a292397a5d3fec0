"""Live view: frames are correct, skipped for slow viewers, and cost the simulation nothing."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, websocket_connect

import ckc_pin
from ckc_pin.view import live
from ckc_pin.view.live import LiveView, live_view
from tests.contract.helpers.command import ckc
from tests.contract.helpers.viewer import listening, raw_viewer, vanish
from tests.contract.sketches import FOUR_BAR, FOUR_BAR_LOOP, START_OF_FOUR_BAR, write_scene

SWING = "five_bar/swing"
L_PROXIMAL, BASE = 0.2794, 0.3048  # of five_bar
NO_SHAPE = '<link name="crank"><visual><geometry><box size="1 2"/></geometry></visual>'

Viewer = Callable[[WebSocketClientConnection], Coroutine[Any, Any, list[dict]]]


def start_viewer(url: str, viewer: Viewer) -> tuple[Thread, list[dict]]:
    """Start a viewer in a thread of its own; it is connected, and has been drawn for, when this returns."""
    seen: list[dict] = []
    here = socket.socketpair()

    async def receive() -> None:
        connection = await websocket_connect(url.replace("http", "ws"), max_message_size=2**26)
        await connection.read_message()  # the scene has been sent
        here[1].send(b"!")
        seen.extend(await viewer(connection))
        connection.close()

    thread = Thread(target=lambda: asyncio.run(receive()))
    thread.start()
    assert here[0].recv(1) == b"!"
    for end in here:
        end.close()
    return thread, seen


async def until_the_end(connection: WebSocketClientConnection, answer: bool) -> list[dict]:
    """Read everything, answering frames as our page does, or not."""
    frames = []
    while (message := await connection.read_message()) is not None:
        command = msgspec.msgpack.decode(message)
        if command["type"] == "several":
            frames.append(command)
            if answer:
                with suppress(WebSocketClosedError):  # the run may be over by now
                    await connection.write_message("shown")
    return frames


async def answering(connection: WebSocketClientConnection) -> list[dict]:
    return await until_the_end(connection, answer=True)


async def silent(connection: WebSocketClientConnection) -> list[dict]:
    return await until_the_end(connection, answer=False)


def time_of(frame: dict) -> float:
    (said,) = [c["text"] for c in frame["commands"] if c["type"] == "say"]
    assert said.endswith(" of 2 s")
    return float(said.split()[2])


def elbow_of(frame: dict) -> np.ndarray:
    (placed,) = [c for c in frame["commands"] if c["path"] == "/world/live/joint:theta_2"]
    return np.array(placed["matrix"][12:15])


def seen_live(viewer: Viewer, overrides: dict[str, Any]) -> tuple[ckc_pin.Run, list[dict]]:
    scene = ckc_pin.load_scene(SWING, overrides)
    with live_view(scene, None) as view:
        assert view is not None
        thread, seen = start_viewer(view.server.url, viewer)
        run = ckc_pin.simulate(scene, on_output=view.on_output)
    thread.join(20)
    assert not thread.is_alive()
    return run, seen


@pytest.mark.parametrize("viewer", [answering, silent])
def test_run_is_identical_with_and_without_viewers(viewer, run):
    assert_same(seen_live(viewer, {})[0], run(SWING))


def test_lost_connection_does_not_stop_a_run(run, caplog):
    scene = ckc_pin.load_scene(SWING)
    with live_view(scene, None) as view:
        viewers = [raw_viewer(view.server) for _ in range(3)]

        def on_output(t: float, q_tree: np.ndarray) -> None:
            view.on_output(t, q_tree)
            if t > 1.0 and viewers:
                vanish(viewers.pop())

        seen = ckc_pin.simulate(scene, on_output=on_output)
    assert not viewers
    assert not caplog.records
    assert_same(seen, run(SWING))


def assert_same(seen: ckc_pin.Run, alone: ckc_pin.Run) -> None:
    for name in ("t", "q_tree", "v_tree", "phi", "energy"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(alone, name))
    assert (seen.status, seen.stats["rhs"]) == ("done", alone.stats["rhs"])


def test_live_frames_are_in_order_and_reach_the_end():
    run, frames = seen_live(answering, {})
    times = [time_of(frame) for frame in frames]
    assert times == sorted(set(times))
    assert times[-1] == 2.0
    for frame in frames:
        row = run.at(time_of(frame))  # the caption has two digits; output instants are 0.004 s apart
        neighbours = slice(max(row - 2, 0), row + 3)
        angle = run.q_tree[neighbours, run.column("theta_1")]
        expected = L_PROXIMAL * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        assert np.abs(expected - elbow_of(frame)).max(axis=1).min() < 1e-12


def test_unresponsive_viewer_gets_the_first_and_the_last_frame():
    _, frames = seen_live(silent, {})
    assert len(frames) <= 2
    assert time_of(frames[-1]) == 2.0


def test_live_view_keeps_only_the_newest_output_time():
    view = LiveView(ckc_pin.load_scene(SWING), None)
    try:
        for k in range(10_000):
            view.on_output(1e-4 * k, view.mechanism.q_tree)
        assert len(view._frames) <= 1
        assert view._pending is None or len(view._pending) == 2
    finally:
        view.stop()
        view.server.stop()


def test_live_view_at_a_speed_shows_due_output_times(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(live, "perf_counter", lambda: clock[0])
    view = LiveView(ckc_pin.load_scene(SWING), 0.5)
    try:
        view.stop()  # its thread; what follows is done by hand
        for k in range(5):
            view.on_output(0.1 * k, view.mechanism.q_tree)
        assert view._take_due_frame()[0] == 0.0
        assert view._take_due_frame() is None
        clock[0] = 100.5  # half a second is a quarter of a second of the motion: 0.1 is dropped
        assert view._take_due_frame()[0] == pytest.approx(0.2)
        clock[0] = 200.0
        assert view._take_due_frame()[0] == pytest.approx(0.4)
    finally:
        view.server.stop()


def test_finish_waits_for_a_slower_view_only(monkeypatch, run):
    waited = []
    clock = [100.0]
    monkeypatch.setattr(live, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(live, "pause", waited.append)
    for speed, expected in ((0.5, [3.0]), (None, [])):
        with live_view(ckc_pin.load_scene(SWING), speed) as view:
            clock[0] = 100.0
            view.on_output(0.0, view.mechanism.q_tree)
            clock[0] = 101.0
            view.finish(run(SWING), stay=False)
        assert waited == expected
        waited.clear()


# --- the command ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("setting", "status", "code"), [("t_end=0.1", "done", 0), ("solver.max_rhs=40", "stopped", 3)])
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_live_command_stays_until_a_signal_and_saves_the_same_run(setting, status, code, sent):
    """In a pipe too: what it says is there when the run has ended, the page as long as nobody ends it."""
    with command(["run", SWING, "--set", setting, "--meshcat", "--json"], stderr=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            url = process.stderr.readline().split()[-1]
            assert json.loads(process.stdout.readline())["status"] == status
            lines = [process.stderr.readline()] if code == 0 else [process.stderr.readline() for _ in range(2)]
            assert lines[-1] == f"played back at {url}  (Ctrl-C ends)\n"
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(1.0)
            assert urlopen(url).status == 200
            process.send_signal(sent)
            assert process.wait(20) == code
        finally:
            process.kill()


def test_port_in_use_does_not_prevent_a_run():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        answer = ckc("run", SWING, "--set", "t_end=0.1", "--meshcat", "--port", str(port), "--json")
    assert answer.code == 0
    assert answer.json["status"] == "done"
    assert answer.err == (
        f"no live view: port {port} on 127.0.0.1: address already in use; choose another, or 0 for any free one; "
        "the run goes on without\n"
    )


def test_invalid_visuals_do_not_prevent_a_run(tmp_path):
    urdf = FOUR_BAR.replace('<link name="crank">', NO_SHAPE)
    path = write_scene(tmp_path / "m", urdf, FOUR_BAR_LOOP, START_OF_FOUR_BAR, 0.01)
    answer = ckc("run", str(path), "--meshcat", "--json")
    assert (answer.code, answer.json["status"]) == (0, "done")
    assert "no live view: m.urdf: link 'crank', <visual>: a box needs size above zero" in answer.err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--speed", "1"], "--speed goes with --meshcat"),
        (["--port", "80"], "--port goes with --meshcat"),
        (["--open"], "--open goes with --meshcat"),
        (["--meshcat", "--speed", "0"], "--speed 0: it must be above zero"),
        (["--meshcat", "--speed", "-1"], "--speed -1: it must be above zero"),
        (["--meshcat", "--speed", "nan"], "--speed nan: it must be above zero"),
        (["--meshcat", "--speed", "fast"], "Invalid value for '--speed'"),
    ],
)
def test_invalid_view_options_are_rejected(words, says):
    answer = ckc("run", SWING, *words)
    assert (answer.code, answer.out) == (2, "")
    assert says in answer.err


@pytest.mark.parametrize("words", [["run", SWING, "--meshcat", "--speed", "0.01"], ["play", "RUN"]])
def test_live_view_listens_on_loopback_and_starts_no_process(words, run, tmp_path):
    """As a command of its own, read from outside."""
    words = [str(run(SWING).save(tmp_path / "run.npz")) if word == "RUN" else word for word in words]
    with command(words) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline().split("127.0.0.1:")[1].split("/")[0])
            assert listening(process.pid) == {f"0100007F:{port:04X}"}
            assert Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text() == ""
        finally:
            process.terminate()


def test_map_command_opens_no_port():
    seen, looks = set(), 0
    with command(["map", "four_bar", "--cells", "16"]) as process:
        while process.poll() is None:
            with suppress(FileNotFoundError, ProcessLookupError, PermissionError):  # it has just ended
                seen |= listening(process.pid)
                looks += 1
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.01)
    assert process.returncode == 0
    assert looks > 10
    assert seen == set()


def command(words: list[str], stderr: int = subprocess.STDOUT) -> subprocess.Popen[str]:
    whole = [sys.executable, "-W", "error", "-m", "ckc_pin", *words]
    return subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=stderr, text=True)
