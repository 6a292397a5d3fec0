"""Fixtures: a user's folder, runs to play, and a playback server that is stopped after the test."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import ckc_pin
from ckc_pin.mechanism.library import library

if TYPE_CHECKING:
    from ckc_pin.view.server import ViewServer


@pytest.fixture
def bar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder `bar` in the working directory."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(library() / "five_bar", tmp_path / "bar")
    return tmp_path / "bar"


@pytest.fixture(scope="session")
def tracking(run: Callable[..., ckc_pin.Run]) -> ckc_pin.Run:
    return run("five_bar/tracking", formulation="reduced")


@pytest.fixture(scope="session")
def swing(run: Callable[..., ckc_pin.Run]) -> ckc_pin.Run:
    return run("five_bar/swing")


@pytest.fixture
def serve() -> Iterator[Callable[..., ViewServer]]:
    """Return `play_runs` with block=False; its servers are stopped at the end of the test."""
    from ckc_pin.view.player import play_runs

    started: list[ViewServer] = []

    def start(*runs: ckc_pin.Run, **options: float) -> ViewServer:
        server = play_runs(runs, block=False, **options)
        assert server is not None
        started.append(server)
        return server

    yield start
    for server in started:
        server.stop()
