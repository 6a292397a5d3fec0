"""A long run is interrupted: its exit code says by what, and everything up to there is printed and saved."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import ckc_pin
from tests.contract.helpers.under_way import under_way

# The command, in a process of its own, which says on standard error when it is under way.
CKC = """
import sys
import ckc_pin, ckc_pin.cli
simulate = ckc_pin.simulate

def watched(scene, **options):
    def progress(t, t_end):
        if t > 0.5 and not said:
            said.append(t)
            print("under way", file=sys.stderr, flush=True)
    said = []
    return simulate(scene, **{**options, "progress": progress})

ckc_pin.simulate = watched
ckc_pin.cli.main()
"""


@pytest.mark.parametrize(
    ("number", "code", "says"),
    [(signal.SIGINT, 130, "interrupted at t = "), (signal.SIGTERM, 143, "by SIGTERM")],
    ids=["SIGINT", "SIGTERM"],
)
def test_an_interrupted_run_is_printed_and_saved(number: signal.Signals, code: int, says: str, tmp_path: Path) -> None:
    words = ["run", "five_bar/swing", "--json", "--out", str(tmp_path), "--set", "t_end=9000.0"]
    with under_way(CKC, *words) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "under way\n"
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == code
    found = json.loads(out)
    assert found["status"] == "interrupted"
    assert says in found["message"]
    assert err == f"{found['message']}\n"
    assert found["t"] >= 0.5, "the output instants before the step that was told"
    run = ckc_pin.Run.load(tmp_path)
    assert run.status == "interrupted"
    assert run.t[-1] == found["t"]
    assert run.q_tree[-1].tolist() == found["q_tree"]
    assert json.loads((tmp_path / "scene.json").read_text(encoding="utf-8"))["t_end"] == 9000.0


def test_a_reader_that_goes_away_is_no_error() -> None:
    """`ckc list | true`, with a pipe that is closed before anything is written."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-c", "import sys, ckc_pin.cli; ckc_pin.cli.main()", "list"],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": str(Path(ckc_pin.__file__).parent.parent)},
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")
