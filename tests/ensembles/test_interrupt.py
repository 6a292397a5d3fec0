"""Interrupted sweeps keep finished members and leave no temporary files or processes."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from zarr.storage import LocalStore

import ckc_pin
from ckc_pin.base.atomic_files import temporary_folder
from ckc_pin.base.interrupt import uninterrupted_thread
from ckc_pin.ensembles import cluster, members, store_layout
from ckc_pin.ensembles.ensemble import load_sweep_task, run_sweep, save_worst_members
from tests.ensembles.test_sweep import open_results, write_sweep


def test_ctrl_c_keeps_finished_members(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, members=2000, t_end=2.0), tmp_path / "o"
    command = [sys.executable, "-m", "ckc_pin", "sweep", str(path), "--out", str(out), "--chunk", "5", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while len(list(out.glob("results.zarr/status/c/*"))) < 2 and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    printed, errors = process.communicate(timeout=60)
    data = json.loads(printed)
    assert process.returncode == 130, errors
    assert data["status"] == "interrupted"
    assert "the same command resumes the sweep" in errors
    assert "Traceback" not in errors
    assert 10 <= data["done"] == int((open_results(out)["status"] == 1).sum()) < 2000


def interrupt_first(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, with a SIGINT to the main thread at the beginning of each call."""

    def interrupted(*arguments: Any) -> Any:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        time.sleep(0.1)
        return function(*arguments)

    return interrupted


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_a_temporary_folder_is_removed_when_its_creation_is_interrupted(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mkdir = Path.mkdir

    def interrupted(self: Path, mode: int = 0o777) -> None:
        mkdir(self, mode)
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt), temporary_folder():
        pass
    assert not list(temporary.iterdir())


def test_a_store_that_is_interrupted_while_created_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files are written in another thread, which must not continue after the removal."""
    monkeypatch.setattr(store_layout, "create_arrays", interrupt_first(store_layout.create_arrays))
    out = tmp_path / "o"
    with pytest.raises(KeyboardInterrupt):
        run_sweep(load_sweep_task(write_sweep(tmp_path)), out)
    assert not list(out.iterdir())


def test_members_are_counted_after_an_interrupted_write_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_value = LocalStore.set

    async def slow_set(store: LocalStore, key: str, *arguments: Any) -> None:
        if key.startswith("status/c/"):
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            await asyncio.sleep(0.3)
        await set_value(store, key, *arguments)

    monkeypatch.setattr(LocalStore, "set", slow_set)
    result = run_sweep(load_sweep_task(write_sweep(tmp_path)), tmp_path / "o", chunk=3)
    assert result.status == "interrupted"
    assert result.done == 3 == int((open_results(tmp_path / "o")["status"] == 1).sum())


def interrupted_rows(*_: Any) -> tuple[None, str, str]:
    return None, "interrupted", "interrupted at t = 0.1 s by SIGTERM"


def test_an_interrupt_of_the_run_that_measures_the_work_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(members, "record_rows", interrupted_rows)
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        run_sweep(load_sweep_task(write_sweep(tmp_path)), tmp_path / "o")


def test_an_interrupt_of_the_run_that_finds_shapes_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(members, "record_rows", interrupted_rows)
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        ckc_pin.ensemble(
            "five_bar/swing", {"initial.q.theta_1": [-1.5]}, {"end": lambda run: run.t[-1]},
            overrides={"solver.terms": "pinocchio"},
        )  # fmt: skip


def test_an_interrupted_run_of_a_worst_member_is_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = run_sweep(load_sweep_task(write_sweep(tmp_path, 4)), tmp_path / "o")
    run = ckc_pin.simulate("five_bar/swing", {"t_end": 0.1})
    object.__setattr__(run, "status", "interrupted")
    monkeypatch.setattr("ckc_pin.ensembles.ensemble.simulate", lambda *_: run)
    with pytest.raises(KeyboardInterrupt):
        save_worst_members(result.prepared, open_results(tmp_path / "o"), "drift", tmp_path / "o")
    assert not list((tmp_path / "o").glob("worst_*"))


def test_a_cluster_that_is_interrupted_while_it_starts_leaves_nothing(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(multiprocessing.active_children())  # joblib of other tests keeps its workers
    monkeypatch.setattr(cluster, "_start", interrupt_first(cluster._start))
    with pytest.raises(KeyboardInterrupt), cluster.connect(None, 1):
        pass
    assert set(multiprocessing.active_children()) <= before
    assert not list(temporary.iterdir())


def sigint_is_blocked() -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_ctrl_c_does_not_reach_workers() -> None:
    with cluster.connect(None, 1) as client:
        assert list(client.run(sigint_is_blocked).values()) == [True]
    assert not sigint_is_blocked()


def test_an_interrupt_while_a_thread_starts_comes_before_its_work(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        start(thread)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), uninterrupted_thread() as pool:
        pool.submit(done.append, 1)
    time.sleep(0.1)
    assert not done
