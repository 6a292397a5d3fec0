"""Sweeps: results, resumption after kills and full disks, clusters, stores of other sweeps, and wrong input."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr

import ckc_pin
from ckc_pin.ensembles import cluster
from ckc_pin.errors import InputError
from tests.contract.helpers.command import ckc

FILE = """
scene = "five_bar/swing"
members = {members}
seed = 1
[overrides]
t_end = {t_end}
solver.rtol = 1e-6
solver.output_dt = 0.1
solver.terms = "pinocchio"
[variables]
"initial.q.theta_1" = {{uniform = [-1.9, -0.9]}}
"link.link_2.mass" = {{normal = [0.2611, 0.01]}}
[outputs]
end = "q_tree"
path = {{of = "theta_1", reduce = "trajectory"}}
drift = "energy_drift"
"""


def write_sweep(folder: Path, members: int = 40, t_end: float = 0.2, more: str = "") -> Path:
    path = folder / "test.sweep.toml"
    path.write_text(FILE.format(members=members, t_end=t_end) + more)
    return path


@pytest.fixture
def quick_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for one second instead of ten for a scheduler that does not answer."""
    monkeypatch.setattr(cluster, "SCHEDULER_TIMEOUT_S", 1.0)


def open_results(out: Path) -> xr.Dataset:
    return xr.open_zarr(out / "results.zarr", consolidated=False).load()


def test_a_sweep_prints_counts_and_writes_results_for_xarray(tmp_path: Path) -> None:
    done = ckc("sweep", str(write_sweep(tmp_path)), "--out", str(tmp_path / "o"), "--json", "--worst", "drift")
    assert done.code == 0, done.err
    assert {key: done.json[key] for key in ("status", "members", "done", "stopped", "failed")} == {
        "status": "done", "members": 40, "done": 40, "stopped": 0, "failed": 0,
    }  # fmt: skip
    assert done.json["wall_s"] > 0 < done.json["rate"]
    result = open_results(tmp_path / "o")
    assert dict(result.sizes) == {"member": 40, "coordinate": 4, "time": 3}
    assert result["coordinate"].to_numpy().tolist() == ["theta_1", "theta_2", "theta_3", "theta_4"]
    assert result["end"].sel(coordinate="theta_1").to_numpy().tolist() == result["path"][:, -1].to_numpy().tolist()
    assert {path.name for path in (tmp_path / "o").glob("*.png")} == {"path.png", "drift.png", "end.png"}
    worst = int(np.argmax(result["drift"].to_numpy()))
    run = ckc_pin.Run.load(tmp_path / "o" / f"worst_drift_{worst}")
    assert np.allclose(run.q_tree[-1], result["end"][worst], atol=1e-9)


def test_results_are_bitwise_equal_for_threads_chunks_and_processes(tmp_path: Path) -> None:
    path = write_sweep(tmp_path)
    options = {
        "one": ["--threads", "1"],
        "chunks": ["--threads", "3", "--chunk", "7"],
        "dask": ["--workers", "2", "--chunk", "4"],
    }
    for name, arguments in options.items():
        done = ckc("sweep", str(path), "--out", str(tmp_path / name), "--json", "--no-figures", *arguments)
        assert done.code == 0, done.err
    for name in ("chunks", "dask"):
        assert open_results(tmp_path / name).equals(open_results(tmp_path / "one"))


def test_a_killed_sweep_is_resumed(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, members=150, t_end=2.0), tmp_path / "o"
    command = [
        sys.executable,
        "-m",
        "ckc_pin",
        "sweep",
        str(path),
        "--out",
        str(out),
        "--chunk",
        "5",
        "--no-figures",
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while len(list(out.glob("results.zarr/status/c/*"))) < 3 and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = open_results(out)
    is_finished = before["status"].to_numpy() == 1
    assert 15 <= is_finished.sum() < 150
    assert np.isfinite(before["end"].to_numpy()[is_finished]).all()
    done = ckc("sweep", str(path), "--out", str(out), "--json", "--no-figures")
    assert done.json["done"] == 150
    assert done.json["rate"] * done.json["wall_s"] == pytest.approx(
        150 - is_finished.sum()
    )  # finished members are not run again
    uninterrupted = ckc("sweep", str(path), "--out", str(tmp_path / "uninterrupted"), "--json", "--no-figures")
    assert uninterrupted.code == 0
    assert open_results(out).equals(open_results(tmp_path / "uninterrupted"))


def test_a_full_disk_is_reported_and_the_store_remains_valid(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, members=4000, t_end=0.02), tmp_path / "o"
    command = [sys.executable, "-m", "ckc_pin", "sweep", str(path), "--out", str(out), "--chunk", "2000", "--json"]

    def limit_file_size() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    process = subprocess.run(command, preexec_fn=limit_file_size, capture_output=True, text=True, check=False)
    assert process.returncode == 3, process.stderr
    assert "cannot be written: " in process.stderr
    assert "Traceback" not in process.stderr
    assert open_results(out)["status"].to_numpy().tolist() == [0] * 4000
    assert ckc("sweep", str(path), "--out", str(out), "--json", "--no-figures").json["done"] == 4000


def test_a_store_that_could_not_be_created_leaves_no_files(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, 3), tmp_path / "o"

    def limit_file_size() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000, 3_000))

    command = [sys.executable, "-m", "ckc_pin", "sweep", str(path), "--out", str(out), "--json"]
    process = subprocess.run(command, preexec_fn=limit_file_size, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert process.stderr.splitlines() == [f"error: {out / 'results.zarr'}: cannot be written: File too large"]
    assert not list(out.iterdir())
    assert ckc("sweep", str(path), "--out", str(out), "--no-figures").code == 0


def test_an_interrupt_while_a_store_is_created_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments: Any = ("five_bar/swing", {"initial.q.theta_1": [-1.4, -1.2]}, {"end": "q_tree"})
    keywords: dict[str, Any] = {
        "overrides": {"t_end": 0.01, "solver.terms": "pinocchio"},
        "progress": False,
        "out": tmp_path,
    }

    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("zarr.Group.create_array", interrupt)
        with pytest.raises(KeyboardInterrupt):
            ckc_pin.ensemble(*arguments, **keywords)
    assert np.all(np.isfinite(ckc_pin.ensemble(*arguments, **keywords)["end"].to_numpy()))
    assert [path.name for path in tmp_path.iterdir()] == ["results.zarr"]


def test_names_may_have_slashes(tmp_path: Path) -> None:
    """Joints of a robot description in a namespace have them."""
    path = write_sweep(tmp_path, 4, more='"a/b" = "energy"\n')
    options = ("--worst", "a/b", "--worst", "end", "--indices", "2")
    done = ckc("sweep", str(path), "--out", str(tmp_path / "o"), *options)
    assert done.code == 0, done.err
    assert open_results(tmp_path / "o")["a_b"].shape == (4,)
    assert (tmp_path / "o" / "indices_a_b.png").exists()
    assert len(list((tmp_path / "o").glob("worst_a_b_*/run.npz"))) == 3


def test_the_store_of_another_sweep_is_not_changed(tmp_path: Path) -> None:
    path, out = write_sweep(tmp_path, members=3), tmp_path / "o"
    assert ckc("sweep", str(path), "--out", str(out), "--no-figures").code == 0
    before = open_results(out)
    other = ckc("sweep", str(write_sweep(tmp_path, members=4)), "--out", str(out))
    assert other.code == 2
    assert "results of another sweep: members differ" in other.err
    assert open_results(out).equals(before)
    (out / "results.zarr" / "zarr.json").write_text("{}")
    assert "not a store of a sweep" in ckc("sweep", str(path), "--out", str(out)).err


@pytest.mark.parametrize(
    ("more", "options", "message"),
    [
        ("", ["--scheduler", "tcp://127.0.0.1:9"], "does not answer within"),
        ("", ["--scheduler", "nonsense://x"], "does not answer within"),
        ("", ["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], "give one of them"),
        ("", ["--worst", "none"], "no such output; there are end, path, drift"),
        ('end2 = "theta_9"\n', [], "'theta_9': no such quantity"),
        ('path = "u"\n', [], "malformed TOML"),
        ("[extra]\n", [], "unknown key 'extra'"),
        ('status = "u"\n', [], "'status' is taken"),
        ('member = "t"\n', [], "'member' is taken"),
        ('checksums = "t"\n', [], "'checksums' is taken"),
        ('"a/b" = "t"\na_b = "t"\n', [], "'a_b' is taken"),
        ('"" = "t"\n', [], "'' cannot be the name of an array"),
        ('"zarr.json" = "t"\n', [], "'zarr.json' cannot be the name of an array"),
    ],
)
def test_wrong_input_gives_one_message(
    tmp_path: Path, quick_timeout: None, more: str, options: list[str], message: str
) -> None:
    done = ckc("sweep", str(write_sweep(tmp_path, 3, more=more)), "--out", str(tmp_path / "o"), *options)
    assert done.code == 2
    assert message in done.err
    assert "Traceback" not in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_a_scheduler_that_does_not_answer_is_not_used_later(quick_timeout: None) -> None:
    arguments = ("five_bar/swing", {"initial.q.theta_1": [-1.4, -1.2]}, {"end": "q_tree"})
    keywords: dict[str, Any] = {"overrides": {"t_end": 0.01, "solver.terms": "pinocchio"}, "progress": False}
    for address in ("nonsense://x", "tcp://127.0.0.1:9"):
        with pytest.raises(InputError, match="does not answer within"):
            ckc_pin.ensemble(*arguments, **keywords, scheduler=address)
    assert np.all(np.isfinite(ckc_pin.ensemble(*arguments, **keywords)["end"].to_numpy()))


def test_workers_do_not_warn_about_ports(tmp_path: Path) -> None:
    with socket.socket() as taken, contextlib.suppress(OSError):  # another program may use the port
        taken.bind(("127.0.0.1", 8787))
        taken.listen()
        done = ckc(
            "sweep", str(write_sweep(tmp_path, 4)), "--out", str(tmp_path / "o"), "--workers", "1", "--no-figures"
        )
        assert (done.code, done.err) == (0, "")


def test_finished_chunks_are_kept_if_the_scheduler_is_lost(tmp_path: Path) -> None:
    python = [sys.executable, "-m"]
    scheduler_file, out = tmp_path / "scheduler.json", tmp_path / "o"
    where = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(scheduler_file)]
    processes = [subprocess.Popen([*python, "distributed.cli.dask_scheduler", *where], stderr=subprocess.DEVNULL)]
    try:
        worker = [
            "distributed.cli.dask_worker",
            "--scheduler-file",
            str(scheduler_file),
            "--no-nanny",
            "--no-dashboard",
        ]
        processes.append(subprocess.Popen([*python, *worker, "--nthreads", "1"], stderr=subprocess.DEVNULL))
        wait_for(scheduler_file.exists)
        address = json.loads(scheduler_file.read_text())["address"]
        path = write_sweep(tmp_path, members=2000, t_end=2.0)
        options = ["--out", str(out), "--chunk", "5", "--no-figures", "--json", "--scheduler", address]
        ends: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen([*python, "ckc_pin", "sweep", str(path), *options], **ends))
        wait_for(lambda: len(list(out.glob("results.zarr/status/c/*"))) > 1)
        processes[0].kill()
        printed, errors = processes[2].communicate(timeout=120)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    result = json.loads(printed)
    assert processes[2].returncode == 3
    assert errors.splitlines() == [result["message"]]
    assert result["message"].startswith("the scheduler is lost, or was restarted (")
    assert result["message"].endswith("the same command resumes the sweep")
    assert 10 <= result["done"] == int((open_results(out)["status"] == 1).sum()) < 2000


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_finished_chunks_are_kept_if_workers_die(tmp_path: Path) -> None:
    keywords: dict[str, Any] = {
        "members": 4,
        "overrides": {"t_end": 0.1, "solver.terms": "pinocchio"},
        "progress": False,
    }
    arguments = ("five_bar/swing", {"initial.q.theta_1": {"uniform": [-1.5, -1.0]}})
    outputs: dict[str, Any] = {"end": "q_tree", "die": Dies(tmp_path / "dies")}
    expected = ckc_pin.ensemble(*arguments, outputs, **keywords)
    cluster: dict[str, Any] = {"out": tmp_path / "o", "chunk": 1, "workers": 1}
    (tmp_path / "dies").write_text("x" * 100)
    no_retries = dask.config.set({"distributed.scheduler.allowed-failures": 0})  # Dask allows three deaths by default
    with no_retries, pytest.raises(InputError, match="a worker failed: KilledWorker"):
        ckc_pin.ensemble(*arguments, outputs, **keywords, **cluster)
    (tmp_path / "dies").write_text("x")  # after a single death Dask restarts the worker
    result = ckc_pin.ensemble(*arguments, outputs, **keywords, **cluster)
    assert not (tmp_path / "dies").read_text()
    assert np.array_equal(result["end"].to_numpy(), expected["end"].to_numpy())


class Dies:
    """An output that kills its worker process as often as a file has letters."""

    def __init__(self, path: Path) -> None:
        self.path, self.main_process = path, os.getpid()

    def __call__(self, run: ckc_pin.Run) -> float:
        if os.getpid() != self.main_process and run.q_tree[0, 0] < -1.2 and self.path.read_text():
            self.path.write_text(self.path.read_text()[1:])
            os.kill(os.getpid(), signal.SIGKILL)
        return 1.0


def test_the_last_members_of_a_million_can_be_run_alone(tmp_path: Path) -> None:
    from ckc_pin.ensembles.ensemble import load_sweep_task

    task = load_sweep_task(write_sweep(tmp_path, members=10**6))
    members = task.prepare(1)
    assert task.variables.count == 10**6
    assert members.run(999_990, task.variables.values(999_990, 10**6)).status.tolist() == [1] * 10
