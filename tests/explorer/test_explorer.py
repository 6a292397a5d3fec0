"""The explorer as an object of Python: start, stop, notebooks and wrong arguments."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import pytest

import ckc_pin
from ckc_pin import InputError
from ckc_pin.explorer.messages import Drag, GoTo, Move, Release
from ckc_pin.explorer.request_queue import RequestQueue
from ckc_pin.explorer.session import Session


def test_explorer_stops_at_once_however_early_it_is_stopped():
    """The thread that owns the session may not have begun to wait for requests."""
    before = threading.active_count()
    for _ in range(20):
        with ckc_pin.explore("five_bar") as explorer:
            pass
        explorer.stop()
    assert threading.active_count() <= before


def test_explorer_serves_its_page_until_it_is_stopped():
    with ckc_pin.explore("five_bar") as explorer:
        assert b"five_bar" in urllib.request.urlopen(explorer.url).read()
        assert explorer.url in repr(explorer)
        assert f'src="{explorer.url}"' in explorer._repr_html_()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(explorer.url)


def test_scene_begins_at_its_start_with_overrides():
    with ckc_pin.explore("five_bar/swing", {"initial.q.theta_1": -1.3}) as explorer:
        session = explorer._session
        assert session.mechanism.tree.named(session.mechanism.tree.to_coordinates(session.at.q_tree))["theta_1"] == -1.3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"what": 3}, "explore: what: expected a mechanism or a scene"),
        ({"what": "five_baar"}, "five_bar"),
        ({"what": "five_bar", "out": "no/such/folder"}, "no such folder; make it first"),
        ({"what": "five_bar", "port": 70000}, "choose one from 1 to 65535"),
        ({"what": "five_bar", "token": "short"}, "token: use 16 to 128"),
        ({"what": "five_bar", "overrides": 3}, "explore: overrides"),
        ({"what": "five_bar", "overrides": {"link.link_9.mass": 1.0}}, "link_9"),
        ({"what": ckc_pin.load("five_bar"), "overrides": {"link.link_2.mass": 1.0}}, "give its name or path instead"),
    ],
)
def test_wrong_arguments_give_one_message(options, message):
    with pytest.raises(InputError) as refusal:
        ckc_pin.explore(**options)
    assert message in str(refusal.value)


def test_newer_positions_of_a_gesture_replace_older_ones():
    queue = RequestQueue()
    requests = [Move("a", 1.0), Move("a", 2.0), Move("b", 1.0), Release(), Drag("x", [0.0] * 3, [1.0] * 3),
                Drag("x", [0.0] * 3, [2.0] * 3), GoTo({"a": 1.0}), GoTo({"a": 2.0})]  # fmt: skip
    for request in requests:
        queue.put(request)
    expected = [requests[k] for k in (1, 2, 3, 5, 7)]
    assert [queue.take(0.0) for _ in expected] == expected
    assert queue.take(0.0) is None


def run_command(*arguments: str) -> tuple[str, int, str]:
    """Start `ckc explore`, read the first line, visit its address and interrupt it; return line, code and errors."""
    command = [sys.executable, "-m", "ckc_pin", "explore", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        try:
            if line:
                assert urllib.request.urlopen(line.split()[0]).status == 200
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    return line, process.returncode, errors


def test_command_prints_its_address_first_and_ends_at_ctrl_c():
    line, code, errors = run_command("five_bar/tracking", "--set", "t_end=1.0")
    assert line.startswith("http://127.0.0.1:")
    assert line.endswith("(Ctrl-C ends)\n")
    assert (code, errors) == (0, "")


def test_command_refuses_wrong_input_in_one_line():
    _, code, errors = run_command("five_baar")
    assert code == 2
    assert errors.count("\n") == 1
    assert "five_bar" in errors


def test_frames_are_sent_while_requests_come_faster_than_they_are_handled(monkeypatch):
    """Each request takes longer than the next one needs to arrive."""
    frames: list[float] = []
    monkeypatch.setattr(Session, "handle", lambda self, request: time.sleep(0.01))
    send_frame = Session.send_frame

    def record(self: Session) -> None:
        frames.append(time.monotonic())
        send_frame(self)

    monkeypatch.setattr(Session, "send_frame", record)
    with ckc_pin.explore("five_bar") as explorer:
        for _ in range(150):
            explorer._queue.put(Release())
            time.sleep(0.005)
    assert len(frames) > 10
