"""Ctrl-C keeps what is there, and says so."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.ensembles.test_sweep import results, written


def test_ctrl_c_keeps_what_is_there(tmp_path: Path) -> None:
    path, out = written(tmp_path, members=2000, t_end=2.0), tmp_path / "o"
    command = [sys.executable, "-m", "ckc_pin.cli", "sweep", str(path), "--out", str(out), "--chunk", "5", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while len(list(out.glob("results.zarr/status/c/*"))) < 2 and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=60)
    found = json.loads(said)
    assert process.returncode == 130, errors
    assert found["status"] == "interrupted"
    assert "the same command goes on from it" in errors
    assert "Traceback" not in errors
    assert 10 <= found["done"] == int((results(out)["status"] == 1).sum()) < 2000
