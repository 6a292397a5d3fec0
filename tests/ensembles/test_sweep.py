"""Sweeps: killed and gone on with, a full disk, processes, another sweep's store, bad input."""

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


def written(folder: Path, members: int = 40, t_end: float = 0.2, more: str = "") -> Path:
    path = folder / "own.sweep.toml"
    path.write_text(FILE.format(members=members, t_end=t_end) + more)
    return path


def results(out: Path) -> xr.Dataset:
    return xr.open_zarr(out / "results.zarr", consolidated=False).load()


def test_a_sweep_prints_counts_and_leaves_results_that_xarray_opens(tmp_path: Path) -> None:
    done = ckc("sweep", str(written(tmp_path)), "--out", str(tmp_path / "o"), "--json", "--worst", "drift")
    assert done.code == 0, done.err
    assert {key: done.json[key] for key in ("status", "members", "done", "stopped", "failed")} == {
        "status": "done", "members": 40, "done": 40, "stopped": 0, "failed": 0,
    }  # fmt: skip
    assert done.json["wall_s"] > 0 < done.json["rate"]
    found = results(tmp_path / "o")
    assert dict(found.sizes) == {"member": 40, "coordinate": 4, "time": 3}
    assert found["coordinate"].to_numpy().tolist() == ["theta_1", "theta_2", "theta_3", "theta_4"]
    assert found["end"].sel(coordinate="theta_1").to_numpy().tolist() == found["path"][:, -1].to_numpy().tolist()
    assert {path.name for path in (tmp_path / "o").glob("*.png")} == {"path.png", "drift.png"}
    worst = int(np.argmax(found["drift"].to_numpy()))
    run = ckc_pin.Run.load(tmp_path / "o" / f"worst_drift_{worst}")
    assert np.allclose(run.q_tree[-1], found["end"][worst], atol=1e-9)


def test_threads_chunks_and_processes_give_the_same_bits(tmp_path: Path) -> None:
    path = written(tmp_path)
    ways = {
        "one": ["--threads", "1"],
        "chunks": ["--threads", "3", "--chunk", "7"],
        "dask": ["--workers", "2", "--chunk", "4"],
    }
    for name, how in ways.items():
        done = ckc("sweep", str(path), "--out", str(tmp_path / name), "--json", "--no-figures", *how)
        assert done.code == 0, done.err
    for name in ("chunks", "dask"):
        assert results(tmp_path / name).equals(results(tmp_path / "one"))


def test_a_killed_sweep_goes_on_where_it_was(tmp_path: Path) -> None:
    path, out = written(tmp_path, members=300, t_end=2.0), tmp_path / "o"
    command = [
        sys.executable,
        "-m",
        "ckc_pin.cli",
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
    before = results(out)
    there = before["status"].to_numpy() == 1
    assert 15 <= there.sum() < 300
    assert np.isfinite(before["end"].to_numpy()[there]).all()
    done = ckc("sweep", str(path), "--out", str(out), "--json", "--no-figures")
    assert done.json["done"] == 300
    assert done.json["rate"] * done.json["wall_s"] == pytest.approx(300 - there.sum())  # the others were not run again
    whole = ckc("sweep", str(path), "--out", str(tmp_path / "whole"), "--json", "--no-figures")
    assert whole.code == 0
    assert results(out).equals(results(tmp_path / "whole"))


def test_a_full_disk_is_said_and_what_is_there_stays(tmp_path: Path) -> None:
    path, out = written(tmp_path, members=4000, t_end=0.02), tmp_path / "o"
    command = [sys.executable, "-m", "ckc_pin.cli", "sweep", str(path), "--out", str(out), "--chunk", "2000", "--json"]

    def small() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    process = subprocess.run(command, preexec_fn=small, capture_output=True, text=True, check=False)
    assert process.returncode == 3, process.stderr
    assert "cannot be written: " in process.stderr
    assert "Traceback" not in process.stderr
    assert results(out)["status"].to_numpy().tolist() == [0] * 4000
    assert ckc("sweep", str(path), "--out", str(out), "--json", "--no-figures").json["done"] == 4000


def test_a_store_that_could_not_be_begun_is_no_obstacle(tmp_path: Path) -> None:
    path, out = written(tmp_path, 3), tmp_path / "o"

    def small() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000, 3_000))

    command = [sys.executable, "-m", "ckc_pin.cli", "sweep", str(path), "--out", str(out), "--json"]
    process = subprocess.run(command, preexec_fn=small, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert process.stderr.splitlines() == [f"error: {out / 'results.zarr'}: cannot be written: File too large"]
    assert not list(out.iterdir())
    assert ckc("sweep", str(path), "--out", str(out), "--no-figures").code == 0


def test_a_kill_while_a_store_is_begun_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: Any = ("five_bar/swing", {"initial.q.theta_1": [-1.4, -1.2]}, {"end": "q_tree"})
    rest: dict[str, Any] = {
        "overrides": {"t_end": 0.01, "solver.terms": "pinocchio"},
        "progress": False,
        "out": tmp_path,
    }

    def killed(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("zarr.Group.create_array", killed)
        with pytest.raises(KeyboardInterrupt):
            ckc_pin.ensemble(*given, **rest)
    assert np.all(np.isfinite(ckc_pin.ensemble(*given, **rest)["end"].to_numpy()))
    assert [path.name for path in tmp_path.iterdir()] == ["results.zarr"]


def test_names_may_have_slashes(tmp_path: Path) -> None:
    """As joints of a robot description in a namespace have."""
    path = written(tmp_path, 4, more='"a/b" = "energy"\n')
    options = ("--worst", "a/b", "--worst", "end", "--indices", "2")
    done = ckc("sweep", str(path), "--out", str(tmp_path / "o"), *options)
    assert done.code == 0, done.err
    assert results(tmp_path / "o")["a_b"].shape == (4,)
    assert (tmp_path / "o" / "indices_a_b.png").exists()
    assert len(list((tmp_path / "o").glob("worst_a_b_*/run.npz"))) == 3


def test_the_store_of_another_sweep_is_left_alone(tmp_path: Path) -> None:
    path, out = written(tmp_path, members=3), tmp_path / "o"
    assert ckc("sweep", str(path), "--out", str(out), "--no-figures").code == 0
    before = results(out)
    other = ckc("sweep", str(written(tmp_path, members=4)), "--out", str(out))
    assert other.code == 2
    assert "results of another sweep: members differ" in other.err
    assert results(out).equals(before)
    (out / "results.zarr" / "zarr.json").write_text("{}")
    assert "not begun as results of a sweep" in ckc("sweep", str(path), "--out", str(out)).err


@pytest.mark.parametrize(
    ("more", "options", "says"),
    [
        ("", ["--scheduler", "tcp://127.0.0.1:9"], "does not answer within"),
        ("", ["--scheduler", "nonsense://x"], "does not answer within"),
        ("", ["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], "give one of them"),
        ("", ["--worst", "none"], "no such output; there are end, path, drift"),
        ('end2 = "theta_9"\n', [], "no 'theta_9'"),
        ('path = "u"\n', [], "malformed TOML"),
        ("[extra]\n", [], "unknown key 'extra'"),
        ('status = "u"\n', [], "'status' is taken"),
        ('member = "t"\n', [], "'member' is taken"),
        ('checksums = "t"\n', [], "'checksums' is taken"),
        ('"a/b" = "t"\na_b = "t"\n', [], "'a_b' is taken"),
        ('"" = "t"\n', [], "'' can be no array's name"),
        ('"zarr.json" = "t"\n', [], "'zarr.json' can be no array's name"),
    ],
)
def test_bad_input_is_one_message(tmp_path: Path, more: str, options: list[str], says: str) -> None:
    done = ckc("sweep", str(written(tmp_path, 3, more=more)), "--out", str(tmp_path / "o"), *options)
    assert done.code == 2
    assert says in done.err
    assert "Traceback" not in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_a_scheduler_that_does_not_answer_is_asked_for_nothing_else() -> None:
    given = ("five_bar/swing", {"initial.q.theta_1": [-1.4, -1.2]}, {"end": "q_tree"})
    rest: dict[str, Any] = {"overrides": {"t_end": 0.01, "solver.terms": "pinocchio"}, "progress": False}
    for address in ("nonsense://x", "tcp://127.0.0.1:9"):
        with pytest.raises(InputError, match="does not answer within"):
            ckc_pin.ensemble(*given, **rest, scheduler=address)
    assert np.all(np.isfinite(ckc_pin.ensemble(*given, **rest)["end"].to_numpy()))


def test_workers_say_nothing_of_ports(tmp_path: Path) -> None:
    with socket.socket() as taken, contextlib.suppress(OSError):  # where it fails, another program has it
        taken.bind(("127.0.0.1", 8787))
        taken.listen()
        done = ckc("sweep", str(written(tmp_path, 4)), "--out", str(tmp_path / "o"), "--workers", "1", "--no-figures")
        assert (done.code, done.err) == (0, "")


def test_a_scheduler_that_is_lost_costs_nothing_that_is_finished(tmp_path: Path) -> None:
    python = [sys.executable, "-m"]
    place, out = tmp_path / "scheduler.json", tmp_path / "o"
    where = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)]
    processes = [subprocess.Popen([*python, "distributed.cli.dask_scheduler", *where], stderr=subprocess.DEVNULL)]
    try:
        worker = ["distributed.cli.dask_worker", "--scheduler-file", str(place), "--no-nanny", "--no-dashboard"]
        processes.append(subprocess.Popen([*python, *worker, "--nthreads", "1"], stderr=subprocess.DEVNULL))
        wait_for(place.exists)
        address = json.loads(place.read_text())["address"]
        path = written(tmp_path, members=2000, t_end=2.0)
        options = ["--out", str(out), "--chunk", "5", "--no-figures", "--json", "--scheduler", address]
        ends: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen([*python, "ckc_pin.cli", "sweep", str(path), *options], **ends))
        wait_for(lambda: len(list(out.glob("results.zarr/status/c/*"))) > 1)
        processes[0].kill()
        said, errors = processes[2].communicate(timeout=120)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    found = json.loads(said)
    assert processes[2].returncode == 3
    assert errors.splitlines() == [found["message"]]
    assert found["message"].startswith("the scheduler is lost, or was restarted (")
    assert found["message"].endswith("the same command goes on from it")
    assert 10 <= found["done"] == int((results(out)["status"] == 1).sum()) < 2000


def wait_for(there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_workers_that_die_cost_nothing_that_is_finished(tmp_path: Path) -> None:
    rest: dict[str, Any] = {"members": 4, "overrides": {"t_end": 0.1, "solver.terms": "pinocchio"}, "progress": False}
    given = ("five_bar/swing", {"initial.q.theta_1": {"uniform": [-1.5, -1.0]}})
    outputs: dict[str, Any] = {"end": "q_tree", "die": Dies(tmp_path / "dies")}
    whole = ckc_pin.ensemble(*given, outputs, **rest)
    cluster: dict[str, Any] = {"out": tmp_path / "o", "chunk": 1, "workers": 1}
    (tmp_path / "dies").write_text("x" * 100)
    patience = dask.config.set({"distributed.scheduler.allowed-failures": 0})  # Dask's own is three deaths over a chunk
    with patience, pytest.raises(InputError, match="a worker failed: KilledWorker"):
        ckc_pin.ensemble(*given, outputs, **rest, **cluster)
    (tmp_path / "dies").write_text("x")  # a single one: the rest goes on
    found = ckc_pin.ensemble(*given, outputs, **rest, **cluster)
    assert not (tmp_path / "dies").read_text()
    assert np.array_equal(found["end"].to_numpy(), whole["end"].to_numpy())


class Dies:
    """An output that kills its worker, as often as a file has letters; not the process that asked for it."""

    def __init__(self, path: Path) -> None:
        self.path, self.asked = path, os.getpid()

    def __call__(self, run: ckc_pin.Run) -> float:
        if os.getpid() != self.asked and run.q_tree[0, 0] < -1.2 and self.path.read_text():
            self.path.write_text(self.path.read_text()[1:])
            os.kill(os.getpid(), signal.SIGKILL)
        return 1.0


def test_sampling_a_million_members_is_bounded_by_the_chunks(tmp_path: Path) -> None:
    from ckc_pin.ensembles.ensemble import sweep_task

    task = sweep_task(written(tmp_path, members=10**6))
    members = task.members(1)
    assert task.variables().count == 10**6
    assert members.run(999_990, task.variables().values(999_990, 10**6)).status.tolist() == [1] * 10
