"""Playback server: access control, and that it leaves nothing behind."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest
from tornado.httpclient import HTTPClientError
from tornado.websocket import websocket_connect

from ckc_pin.errors import InputError
from ckc_pin.view import commands
from ckc_pin.view.player import play_runs
from tests.contract.helpers.playback import leave, messages_to, objects, placed
from tests.contract.helpers.viewer import listening, raw_viewer, status, vanish


def test_later_viewer_gets_the_current_scene(serve, swing):
    server = serve(swing)
    count = len(server.scene_state.messages())
    first = messages_to(server, count)
    server.send(commands.set_transform("/world", 2 * np.eye(4)))
    second = messages_to(server, count)
    assert [c["path"] for c in second] == [c["path"] for c in first]
    np.testing.assert_array_equal(placed(second), 2 * np.eye(4))
    assert second[-1]["type"] == "set_animation"
    assert objects(second) == objects(first)


def test_connected_viewer_gets_commands_immediately(serve, swing):
    server = serve(swing)

    async def listen() -> dict:
        connection = await websocket_connect(server.url.replace("http", "ws"), max_message_size=2**26)
        for _ in server.scene_state.messages():
            await connection.read_message()
        server.send(commands.set_property("/Axes", "visible", True))
        message = await asyncio.wait_for(connection.read_message(), 20)
        await leave(connection)
        return msgspec.msgpack.decode(message)

    assert asyncio.run(listen()) == {"type": "set_property", "path": "/Axes", "property": "visible", "value": True}


@pytest.mark.parametrize("path", ["/", "/main.min.js", "/start.js", "/nothing"])
def test_requests_of_other_hosts_and_origins_are_rejected(serve, swing, path):
    server = serve(swing)
    expected = 404 if path == "/nothing" else 200
    for name in ("127.0.0.1", "localhost"):
        assert status(server, path, Host=f"{name}:{server.port}") == expected
        assert status(server, path, Origin=f"http://{name}:{server.port}") == expected
    for host in ("evil.example", "127.0.0.1", f"127.0.0.1:{server.port + 1}", f"evil.example:{server.port}", ""):
        assert status(server, path, Host=host) == 403
    for origin in ("http://evil.example", "null", f"https://127.0.0.1:{server.port}", "http://localhost"):
        assert status(server, path, Origin=origin) == 403


def test_websockets_of_other_pages_are_rejected(serve, swing):
    server = serve(swing)
    count = len(server.scene_state.messages())
    assert len(messages_to(server, count, Origin=f"http://localhost:{server.port}")) == count
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
        with pytest.raises(HTTPClientError) as refused:
            messages_to(server, 1, **headers)
        assert refused.value.code == 403


def test_server_listens_on_loopback_only(serve, swing):
    before = listening()
    server = serve(swing)
    assert listening() - before == {f"0100007F:{server.port:04X}"}


def test_port_in_use_is_reported(serve, swing):
    taken = serve(swing).port
    with pytest.raises(InputError, match=rf"port {taken} on 127.0.0.1: address already in use; choose another"):
        serve(swing, port=taken)
    for port in (-1, 65536):
        with pytest.raises(InputError, match="choose one from 1 to 65535"):
            serve(swing, port=port)


def test_invalid_runs_and_speeds_are_rejected(swing):
    with pytest.raises(InputError, match="no run given"):
        play_runs([], block=False)
    for speed in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="speed"):
            play_runs(swing, speed=speed, block=False)


def test_stop_closes_threads_files_and_port(swing):
    threads, files = threading.enumerate(), len(os.listdir("/dev/fd"))
    server = play_runs(swing, block=False)
    messages_to(server, 3)
    server.stop()
    server.stop()  # again is no harm
    assert threading.enumerate() == threads
    assert len(os.listdir("/dev/fd")) == files
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", server.port)) != 0
    with play_runs(swing, port=server.port, block=False) as again:  # the port is free at once
        assert again.port == server.port


def test_lost_connection_is_no_error(serve, swing, caplog):
    server = serve(swing)
    vanish(raw_viewer(server))
    for _ in range(50):
        server.send(commands.draw_polyline("/world/line", np.zeros((5000, 3)), (0, 0, 0)))
    deadline = time.monotonic() + 20
    while server.viewers and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not server.viewers
    assert len(messages_to(server, 3)) == 3
    server.stop()
    gc.collect()  # asyncio complains about forgotten errors only now
    assert not caplog.records


def test_stop_does_not_wait_for_an_unresponsive_viewer(swing):
    server = play_runs(swing, block=False)
    with raw_viewer(server) as stalled:
        server.stop()
        assert not server._thread.is_alive()
        while stalled.recv(2**16):  # what was under way, then the end
            pass


def test_play_prints_the_address_and_waits_for_ctrl_c(swing, tmp_path):
    saved = swing.save(tmp_path / "run.npz")
    code = f"import ckc_pin; ckc_pin.play(ckc_pin.Run.load({str(saved)!r}))"
    command = [sys.executable, "-W", "error", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[0]
        with urlopen(url) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        try:
            _, errors = process.communicate(timeout=20)
        finally:
            process.kill()
    assert (process.returncode, errors) == (0, "")


def test_playback_loads_no_zmq_and_drawing_no_tornado(swing, tmp_path):
    saved = swing.save(tmp_path / "run.npz")
    code = (
        "import sys, ckc_pin\n"
        "from ckc_pin.view.drawing import draw_runs_3d\n"
        "from ckc_pin.view.player import play_runs\n"
        f"run = ckc_pin.Run.load({str(saved)!r})\n"
        "draw_runs_3d([run])\n"
        "assert not {'tornado', 'meshcat', 'matplotlib', 'yourdfpy'} & set(sys.modules)\n"
        "play_runs(run, block=False).stop()\n"
        "assert not {'zmq', 'meshcat', 'IPython', 'matplotlib'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_missing_browser_is_reported(swing, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr("webbrowser.open", lambda url: bool(asked.append(url)))
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with play_runs(swing, open_browser=True, block=False) as server:
        assert not asked  # one for terminals would take ours
    assert f"no display here; open {server.url}" in capsys.readouterr().err
    monkeypatch.setenv("DISPLAY", ":7")
    with play_runs(swing, open_browser=True, block=False) as server:
        assert asked == [server.url]
    assert f"open {server.url} in yours" in capsys.readouterr().err
