"""SIGINT and SIGTERM at any moment of a command: its exit code is right and no file is half-written."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
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
    result = json.loads(out)
    assert result["status"] == "interrupted"
    assert says in result["message"]
    assert err == f"{result['message']}\n"
    assert result["t"] >= 0.5, "the output instants before the step that was told"
    run = ckc_pin.Run.load(tmp_path)
    assert run.status == "interrupted"
    assert run.t[-1] == result["t"]
    assert run.q_tree[-1].tolist() == result["q_tree"]
    assert json.loads((tmp_path / "scene.json").read_text(encoding="utf-8"))["t_end"] == 9000.0


# The command in a process of its own that counts the calls of its Python functions from the moment on at which it
# handles signals, and gets a signal at the call of a given number: the same moment on every machine, however loaded.
AT_A_CALL = """
import os, sys
from ckc_pin.cli import main, signals
number, moment = int(sys.argv.pop(1)), int(sys.argv.pop(1))
install, calls = signals.interrupts.install, 0

def count(frame, event, argument):
    global calls
    if event == "call":
        calls += 1
        if calls == moment:
            os.write(2, b"signalled\\n")
            os.kill(os.getpid(), number)

def install_and_count(**options):
    install(**options)
    sys.setprofile(count)

def report_calls(code, leave=os._exit):
    sys.setprofile(None)
    os.write(2, f"calls: {calls}\\n".encode())
    leave(code)

signals.interrupts.install, os._exit = install_and_count, report_calls
main()
"""
MODEL = """
<mujoco model="pair"><worldbody><body name="a"><joint name="hip"/><geom size="0.1"/>
<body name="b" pos="0 0 1"><joint name="knee"/><geom size="0.1"/></body></body></worldbody></mujoco>
"""
COMMANDS = {
    "list": "list",
    "run": "run five_bar/swing --out out --set t_end=0.1",
    "compile": "compile five_bar",
    "import": "import pair.xml --out out",
    "sweep": "sweep own.sweep.toml --out out --no-figures",
}
SWEEP = """
scene = "five_bar/swing"
members = 20
[overrides]
t_end = 0.1
[variables]
"initial.q.theta_1" = {uniform = [-1.9, -0.9]}
[outputs]
end = "q_tree"
"""


def _signalled(folder: Path, command: str, number: int, moment: int) -> tuple[int, str]:
    """Run a command in a new folder with a signal at a call; return its exit code and what it says."""
    for name in ("temporary", "cache"):
        (folder / name).mkdir(parents=True)
    (folder / "pair.xml").write_text(MODEL)
    (folder / "own.sweep.toml").write_text(SWEEP)
    places = {"TMPDIR": str(folder / "temporary"), "XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", AT_A_CALL, str(int(number)), str(moment), *command.split()],
        capture_output=True,
        text=True,
        cwd=folder,
        check=False,
        timeout=300,
        env={**os.environ, **places, "PYTHONPATH": str(Path(ckc_pin.__file__).parent.parent)},
    )
    return done.returncode, done.stderr


def _require_nothing_half_written(folder: Path) -> None:
    assert not list((folder / "temporary").iterdir())
    half = (".unfinished", ".begun", ".partial")
    assert not [path for path in folder.rglob("*") if path.name.endswith(half)]
    out = folder / "out"
    files = {path.name for path in out.iterdir()} if out.exists() else set()
    assert files in (
        set(),
        {"results.zarr"},
        {"run.npz", "scene.json"},
        {"mechanism.toml", "pair.urdf", "default.scene.toml"},
    )
    if "run.npz" in files:
        ckc_pin.Run.load(out)


@pytest.mark.parametrize("name", COMMANDS)
def test_command_can_be_interrupted_at_any_call(name: str, tmp_path: Path) -> None:
    code, says = _signalled(tmp_path / "whole", COMMANDS[name], signal.SIGINT, 0)
    assert code == 0, says
    count = int(says.split()[-1])
    assert count > 1000
    draw = random.Random(41)
    for k in range(4):
        number, ends_with = ((signal.SIGINT, 130), (signal.SIGTERM, 143))[k % 2]
        moment = draw.randrange(1, int(0.98 * count))
        folder = tmp_path / str(k)
        code, says = _signalled(folder, COMMANDS[name], number, moment)
        assert "signalled" in says, "fewer calls than before"
        assert code == ends_with, (moment, count, says)
        assert "interrupted" in says
        assert "Traceback" not in says
        _require_nothing_half_written(folder)


def test_the_compiler_is_killed_with_its_processes(tmp_path: Path) -> None:
    """A compiler that starts another process, which would go on without it."""
    compiler, temporary, late = tmp_path / "bin" / "cc", tmp_path / "temporary", tmp_path / "late"
    compiler.parent.mkdir()
    temporary.mkdir()
    compiler.write_text(f"#!/bin/sh\n(sleep 2; touch {late}) &\ntouch $TMPDIR/begun\nwait\n")
    compiler.chmod(0o755)
    places = {"PATH": f"{compiler.parent}:{os.environ['PATH']}", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    with subprocess.Popen(
        [sys.executable, "-m", "ckc_pin", "compile", "five_bar"],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **places, "TMPDIR": str(temporary)},
    ) as process:
        while not list(temporary.glob("*/begun")):
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "interrupted: by Ctrl-C\n")
    assert not list(temporary.iterdir())
    time.sleep(2.5)
    assert not late.exists()


@pytest.mark.parametrize("call", [1, 40], ids=["first call", "later call"])
def test_an_interrupt_in_a_python_controller_propagates_or_ends_the_run(call: int) -> None:
    calls = 0

    def controller(t: float, terms: ckc_pin.Terms) -> list[float]:
        nonlocal calls
        calls += 1
        if calls == call:
            signal.raise_signal(signal.SIGINT)
        return [0.0, 0.0]

    if call == 1:
        with pytest.raises(KeyboardInterrupt):
            ckc_pin.simulate("five_bar/swing", {"t_end": 0.1}, controller=controller)
    else:
        run = ckc_pin.simulate("five_bar/swing", {"t_end": 0.1}, controller=controller)
        assert run.status == "interrupted"
        assert run.t[0] == 0.0


# What libraries do to a KeyboardInterrupt: in the place of `ckc list`'s function.
SWALLOWED = {
    "swallowed": "except BaseException: pass",
    "another error": "except BaseException as error: raise ImportError('no such module') from error",
    "a message": "except BaseException: raise ckc_pin.InputError('no MuJoCo') from None",
}
SWALLOWS = """
import os, signal, sys, time
import ckc_pin, ckc_pin.cli, ckc_pin.scene.names

def list_catalogue():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    {clause}
    time.sleep(60)

ckc_pin.scene.names.list_catalogue = list_catalogue
ckc_pin.cli.main()
"""


@pytest.mark.parametrize("name", SWALLOWED)
def test_interrupt_that_a_library_swallows_is_raised_again(name: str) -> None:
    with under_way(SWALLOWS.format(clause=SWALLOWED[name]), "list", "--json") as process:
        out, err = process.communicate(timeout=50)
    assert (process.returncode, err) == (143, "interrupted: by SIGTERM\n")
    assert json.loads(out) == {"status": "interrupted", "message": "by SIGTERM"}


IMPORTS = """
import os, signal, sys, time
import ckc_pin, ckc_pin.cli, ckc_pin.scene.names

def list_catalogue():
    import slow
    print("imported as a whole:", slow.done, flush=True)
    time.sleep(60)

ckc_pin.scene.names.list_catalogue = list_catalogue
ckc_pin.cli.main()
"""
SLOW = """
import os, signal, time
os.kill(os.getpid(), signal.SIGINT)
time.sleep(0.2)
done = True
"""


def test_imports_are_not_interrupted(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    with under_way(f"import sys; sys.path.append({str(tmp_path)!r})" + IMPORTS, "list") as process:
        out, err = process.communicate(timeout=50)
    assert (process.returncode, err) == (130, "interrupted: by Ctrl-C\n")
    assert out in ("", "imported as a whole: True\n")


AT_EXIT = """
import atexit, os, signal, sys
import ckc_pin.cli
atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))
ckc_pin.cli.main()
"""


def test_signal_during_exit_is_not_lost() -> None:
    with under_way(AT_EXIT, "list", "--json") as process:
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "interrupted: by Ctrl-C\n")
    assert "five_bar" in {entry["name"] for entry in json.loads(out)["mechanisms"]}


def test_importing_the_package_installs_no_handlers() -> None:
    code = """
import signal
before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
import ckc_pin, ckc_pin.cli, ckc_pin.cli.app, ckc_pin.run.simulate
assert before == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
"""
    with under_way(code) as process:
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


def test_closed_standard_output_is_no_error() -> None:
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


NO_PROCESSES = """
import sys
import ckc_pin.cli

def refuse(event, arguments):
    if event == "subprocess.Popen":
        raise SystemExit(f"starts {arguments[1]}")

sys.addaudithook(refuse)
ckc_pin.cli.main()
"""


def test_mujoco_import_starts_no_process(tmp_path: Path) -> None:
    (tmp_path / "pair.xml").write_text(MODEL)
    with under_way(NO_PROCESSES, "import", str(tmp_path / "pair.xml"), "--out", str(tmp_path / "out")) as process:
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
