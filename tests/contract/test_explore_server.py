"""Server of the explorer: access, and handling of valid and invalid requests."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from threading import current_thread
from typing import Any

import msgspec
import numpy as np
import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from ckc_pin.errors import InputError
from ckc_pin.explorer import messages
from ckc_pin.explorer.server import ExploreServer
from ckc_pin.view import commands
from ckc_pin.view.server import MAX_MESSAGE_BYTES
from tests.contract.helpers.playback import leave, messages_to
from tests.contract.helpers.viewer import listening, status

VECTOR = [0.1, -2.0, 3]
REQUESTS: list[tuple[dict[str, Any], messages.Request]] = [
    ({"type": "move", "coordinate": "a", "value": 1}, messages.Move(coordinate="a", value=1.0)),
    ({"type": "drag", "body": "b", "point": VECTOR, "target": VECTOR, "normal": [0, 0, 1]},
     messages.Drag(body="b", point=VECTOR, target=VECTOR, normal=[0.0, 0.0, 1.0])),
    ({"type": "release"}, messages.Release()),
    ({"type": "undo"}, messages.Undo()),
    ({"type": "redo"}, messages.Redo()),
    ({"type": "home"}, messages.Home()),
    ({"type": "go_to", "values": {"a": 1.5}}, messages.GoTo(values={"a": 1.5})),
    ({"type": "list_branches"}, messages.ListBranches(on=True)),
    ({"type": "select_branch", "index": 3}, messages.SelectBranch(index=3)),
    ({"type": "show_map", "on": False}, messages.ShowMap(on=False)),
    ({"type": "show", "quantity": "forces", "on": True}, messages.Show(quantity="forces", on=True)),
    ({"type": "set_parameter", "name": "m", "value": 2.5}, messages.SetParameter(name="m", value=2.5)),
    ({"type": "reset_parameters"}, messages.ResetParameters()),
    ({"type": "start_run", "mode": "hold", "rtol": 1e-8}, messages.StartRun(mode="hold", rtol=1e-8)),
    ({"type": "pause"}, messages.Pause(on=True)),
    ({"type": "rewind", "t": 0.5}, messages.Rewind(t=0.5)),
    ({"type": "stop_run"}, messages.StopRun()),
    ({"type": "set_motor", "name": "a", "value": -1.0}, messages.SetMotor(name="a", value=-1.0)),
    ({"type": "save", "what": "run", "name": "x-1"}, messages.Save(what="run", name="x-1")),
    ({"type": "copy_text", "what": "svg"}, messages.CopyText(what="svg")),
]  # fmt: skip
WRONG: list[str | bytes] = [
    "shown",
    "",
    "[]",
    "7",
    "{}",
    '{"type": "fly"}',
    '{"type": ["undo"]}',
    '{"type": "undo", "extra": 1}',
    '{"type": "move", "coordinate": "a"}',
    '{"type": "move", "coordinate": "a", "value": "1"}',
    '{"type": "move", "coordinate": "a", "value": true}',
    '{"type": "move", "coordinate": "a", "value": NaN}',
    '{"type": "move", "coordinate": "a", "value": 1e400}',
    '{"type": "move", "coordinate": "a", "value": 1e10}',
    '{"type": "move", "coordinate": "' + 501 * "a" + '", "value": 1}',
    r'{"type": "move", "coordinate": "\ud800", "value": 1}',
    '{"type": "drag", "body": "a", "point": [0, 0], "target": [0, 0, 0]}',
    '{"type": "drag", "body": "a", "point": [0, 0, null], "target": [0, 0, 0]}',
    '{"type": "select_branch", "index": -1}',
    '{"type": "start_run", "speed": 0}',
    '{"type": "start_run", "rtol": 1}',
    '{"type": "save", "what": "run", "name": "../x"}',
    '{"type": "save", "what": "run", "name": "x\n"}',
    '{"type": "copy_text", "what": "passwords"}',
    '{"a": ' + 60_000 * "[",
    60_000 * "[",
    b"\xff\xfe",
    b"\x81\xa4type\xa4undo",
]


class Recorder:
    """A server, the requests that it passed on, and the names of the threads in which it did."""

    def __init__(self, **options: Any) -> None:
        self.requests: list[messages.Request] = []
        self.threads: set[str] = set()
        self.server = ExploreServer("test", self.on_request, **options)

    def on_request(self, request: messages.Request) -> None:
        self.requests.append(request)
        self.threads.add(current_thread().name)


@pytest.fixture
def serve_explorer() -> Iterator[Callable[..., Recorder]]:
    started: list[Recorder] = []

    def start(**options: Any) -> Recorder:
        started.append(Recorder(**options))
        return started[-1]

    yield start
    for one in started:
        one.server.stop()


async def connect(server: ExploreServer, path: str | None = None, **headers: str) -> WebSocketClientConnection:
    url = f"ws://127.0.0.1:{server.port}/{server.token if path is None else path}/"
    return await websocket_connect(HTTPRequest(url, headers=headers), max_message_size=2**26)


async def receive(connection: WebSocketClientConnection) -> Any:
    message = await asyncio.wait_for(connection.read_message(), 20)
    return None if message is None else msgspec.msgpack.decode(message)


# --- access --------------------------------------------------------------------------------------


def test_everything_is_below_the_token(serve_explorer):
    server = serve_explorer().server
    assert server.url == f"http://127.0.0.1:{server.port}/{server.token}/"
    assert [status(server, f"/{server.token}/{name}") for name in ("", "main.min.js", "start.js")] == [200] * 3
    other = "A" * len(server.token)
    outside = ("/", "/main.min.js", "/start.js", f"/{server.token}", f"/{other}/", f"/{other}/start.js",
               f"/{server.token[:-1]}/", f"/{server.token}x/", f"/{server.token}/x", f"//{server.token}/",
               f"/{server.token}/../start.js")  # fmt: skip
    assert [status(server, path) for path in outside] == [404] * len(outside)


def test_tokens_are_random(serve_explorer):
    tokens = {serve_explorer().server.token for _ in range(3)}
    assert len(tokens) == 3
    assert {len(token) for token in tokens} == {32}  # 24 random bytes


def test_websocket_needs_the_token(serve_explorer):
    server = serve_explorer().server
    for path in ("", "A" * 32):
        with pytest.raises(HTTPClientError) as refused:
            asyncio.run(connect(server, path))
        assert refused.value.code == 404


def test_requests_of_other_hosts_and_origins_are_rejected(serve_explorer):
    server = serve_explorer().server
    for path in ("/", f"/{server.token}/", f"/{server.token}/start.js"):
        expected = 404 if path == "/" else 200
        for name in ("127.0.0.1", "localhost"):
            assert status(server, path, Host=f"{name}:{server.port}") == expected
            assert status(server, path, Origin=f"http://{name}:{server.port}") == expected
        for host in ("evil.example", "127.0.0.1", f"127.0.0.1:{server.port + 1}", f"evil.example:{server.port}", ""):
            assert status(server, path, Host=host) == 403
        for origin in ("http://evil.example", "null", f"https://127.0.0.1:{server.port}", "http://localhost:8888"):
            assert status(server, path, Origin=origin) == 403
    for headers in ({"Origin": "http://localhost:8888"}, {"Origin": "null"}, {"Host": "evil.example"}):
        with pytest.raises(HTTPClientError) as refused:
            asyncio.run(connect(server, **headers))
        assert refused.value.code == 403


def test_server_listens_on_loopback_only(serve_explorer):
    before = listening()
    server = serve_explorer().server
    assert listening() - before == {f"0100007F:{server.port:04X}"}


def test_policy_allows_frames_of_this_machine_and_nothing_else(serve_explorer):
    server = serve_explorer().server
    connection = HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.request("GET", f"/{server.token}/")
    answer = connection.getresponse()
    page = answer.read().decode()
    connection.close()
    policy = dict(part.split(" ", 1) for part in answer.headers["Content-Security-Policy"].split("; "))
    assert policy == {
        "default-src": "'none'",
        "script-src": "'self'",
        "style-src": "'unsafe-inline'",
        "img-src": "'self' data: blob:",
        "connect-src": f"'self' ws://127.0.0.1:{server.port}",
        "frame-ancestors": "http://localhost:* http://127.0.0.1:*",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    assert "http:" not in page
    assert "https:" not in page


def test_port_and_token_can_be_used_again(serve_explorer):
    first = serve_explorer().server
    first.stop()
    again = serve_explorer(port=first.port, token=first.token).server
    assert again.url == first.url
    with pytest.raises(InputError, match=rf"port {again.port} on 127.0.0.1: address already in use"):
        serve_explorer(port=again.port)
    for token in ("short", "a" * 15, "a" * 129, "a" * 15 + "/", "a" * 15 + ".", "a" * 16 + "\n", "é" * 16):
        with pytest.raises(InputError, match="token: use 16 to 128 letters"):
            serve_explorer(token=token)


# --- requests ------------------------------------------------------------------------------------


def test_requests_are_passed_on_in_the_servers_thread(serve_explorer):
    assert {type(request) for _, request in REQUESTS} | {messages.FrameShown} == set(messages.Request.__args__)
    recorder = serve_explorer()

    async def talk() -> None:
        connection = await connect(recorder.server)
        for message, _ in REQUESTS:
            await connection.write_message(json.dumps(message))
        await leave(connection)

    asyncio.run(talk())
    assert recorder.requests == [request for _, request in REQUESTS]
    assert recorder.threads == {"ckc_pin view"}


def test_wrong_messages_are_answered_with_a_notice_and_dropped(serve_explorer, caplog, capsys):
    recorder = serve_explorer()

    async def talk() -> list[dict]:
        connection = await connect(recorder.server)
        notices = []
        for message in WRONG:
            await connection.write_message(message, binary=isinstance(message, bytes))
            notices.append(await receive(connection))
        await connection.write_message(json.dumps({"type": "home"}))
        await leave(connection)
        return notices

    notices = asyncio.run(talk())
    assert {(notice["type"], notice["path"]) for notice in notices} == {("report", "notice")}
    for k, notice in enumerate(notices):
        content = notice["content"]
        assert (content["is_error"], content["serial"]) == (True, k + 1)
        assert content["text"].startswith("request refused: ")
        assert len(content["text"]) <= 300
    assert recorder.requests == [messages.Home()]
    assert recorder.server.scene_state.messages() == []  # other pages do not see them
    assert not caplog.records
    assert capsys.readouterr() == ("", "")


def test_oversized_message_closes_the_connection(serve_explorer, caplog):
    recorder = serve_explorer()

    async def talk() -> tuple[Any, int | None]:
        connection = await connect(recorder.server)
        await connection.write_message("x" * MAX_MESSAGE_BYTES)
        notice = await receive(connection)
        assert notice["path"] == "notice"
        await connection.write_message("x" * (MAX_MESSAGE_BYTES + 1))
        end = await receive(connection), connection.close_code
        connection.close()
        return end

    assert asyncio.run(talk()) == (None, 1009)
    assert recorder.requests == []
    assert not caplog.records
    assert messages_to(recorder.server, 0) == []  # the server still answers


def test_frames_wait_until_the_last_one_has_been_shown(serve_explorer):
    recorder = serve_explorer()
    server = recorder.server

    async def talk() -> list[str]:
        connection = await connect(server)
        while not server.viewers:
            await asyncio.sleep(0.01)
        shown = []
        for k in range(5):
            server.send(commands.group_commands([commands.set_status(f"{k}")]))
        server.send(messages.Notice(text="not a frame").to_command())
        for _ in range(2):
            shown.append(await receive(connection))
        await connection.write_message('{"type": "home"}')  # says nothing about the frame
        await connection.write_message('{"type": "frame_shown"}')
        shown.append(await receive(connection))
        await leave(connection)
        return [one["commands"][0]["text"] if one["type"] == "several" else one["content"]["text"] for one in shown]

    assert asyncio.run(talk()) == ["0", "not a frame", "4"]
    assert recorder.requests == [messages.Home()]


def test_later_pages_get_the_newest_report_of_each_kind(serve_explorer):
    server = serve_explorer().server
    for k in range(3):
        server.send(messages.RunReport(state="running", t=float(k)).to_command())
        server.send(messages.BranchList(branches=[f"{k}"], current=0).to_command())
    server.send(commands.delete("/world"))
    reports = messages_to(server, 2)
    assert [(one["path"], one["content"].get("t"), one["content"].get("branches")) for one in reports] == [
        ("run", 2.0, None),
        ("branch_list", None, ["2"]),
    ]


def test_reports_take_scalars_of_numpy():
    command = messages.PoseReport(values={"a": np.float64(0.1)}, closure=np.float32(0.5)).to_command()
    assert command["path"] == "pose"
    assert command["content"]["values"] == {"a": 0.1}
    assert command["content"]["closure"] == 0.5
    branches = messages.BranchList(branches=[], current=np.int64(2)).to_command()
    assert isinstance(branches["content"]["current"], int)
