"""Runs that end early keep their results: budgets, NaN of a controller, signals; and decompression bombs."""

from __future__ import annotations

import io
import json
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ckc_pin import InputError, Run, Terms, load_scene, simulate
from ckc_pin.cli.signals import Interrupts
from ckc_pin.run.run_file import MAX_BYTES, MAX_META_BYTES
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc
from tests.contract.helpers.under_way import under_way

# --- in this process -----------------------------------------------------------------------------


class NanAfter:
    """A controller without force that returns NaN after a time."""

    def __init__(self, t: float) -> None:
        self.t = t

    def u(self, t: float, terms: Terms) -> Any:
        return np.array([np.nan if t > self.t else 0.0, 0.0])


@pytest.mark.parametrize("formulation", ["reduced", "dae"])
def test_nan_of_a_controller_keeps_earlier_results(formulation: str, tmp_path: Path) -> None:
    overrides = {"formulation": formulation, "t_end": 1.0, "solver.output_dt": 0.01}
    run = simulate("five_bar/swing", overrides, controller=NanAfter(0.203))
    assert run.status == "stopped"
    assert "u is not finite" in run.message
    assert 0.2 <= run.t[-1] <= 0.203
    assert len(run.t) > 20
    assert_close(run.energy, run.energy[0], 1e-6)
    assert Run.load(run.save(tmp_path / "run.npz")).message == run.message


def test_step_below_min_step_stops_the_run() -> None:
    """Where theta_1 and theta_3 do not determine the other coordinates, the step size tends to zero."""

    class Push:
        def u(self, t: float, terms: Terms) -> Any:
            return np.array([1.0, -1.0])

    overrides = {"formulation": "reduced", "solver.min_step": 1e-4}
    run = simulate("five_bar/swing", overrides, controller=Push())
    assert run.status == "stopped"
    assert "the step size fell below min_step = 0.0001 s" in run.message
    assert 0.2 < run.t[-1] < 0.25


def test_budget_messages_format_numbers() -> None:
    for text, value in ((".1", 0.1), ("1.", 1.0), ("+.5", 0.5), ("1.e-1", 0.1), ("1e-1", 0.1)):
        answer = ckc("run", "five_bar/swing", "--json", "--set", f"t_end={text}", "--set", "formulation=reduced")
        assert answer.code == 0
        assert answer.json["t"] == value
    for text in ("NaN", "Infinity", "1.5.2", "."):
        assert ckc("run", "five_bar/swing", "--set", f"t_end={text}").code == 2


def test_run_larger_than_a_file_is_rejected() -> None:
    names = {"solver.output_dt": 1e-6, "t_end": 1.0, "mechanism": {"generator": "n_four_bar", "N": 40}}
    scene = load_scene("n_four_bar", names)
    with pytest.raises(InputError, match=r"solver.output_dt: 1000001 output instants of \d+ numbers each"):
        simulate(scene)


# --- signals -------------------------------------------------------------------------------------


@pytest.fixture
def interrupts() -> Iterator[Interrupts]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    taken = Interrupts()
    taken.install()
    yield taken
    for number, handler in before.items():
        signal.signal(number, handler)


def test_third_interrupt_is_not_deferred(interrupts: Interrupts) -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        signal.raise_signal(signal.SIGTERM)


def test_deferred_interrupt_waits_for_the_work(interrupts: Interrupts) -> None:
    done = []

    def save() -> None:
        with interrupts.deferred():
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGINT):
                signal.raise_signal(number)
                done.append(number)

    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        save()
    assert len(done) == 3


def test_ignored_signals_stay_ignored(interrupts: Interrupts) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interrupts.install()
    signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


# The command, in a process of its own, which says when it is under way, when it is saving, and waits there.
CKC = """
import os, sys, time
import ckc_pin, ckc_pin.cli
simulate, fsync, said = ckc_pin.simulate, os.fsync, []

def say(what):
    if what not in said:
        said.append(what)
        print(what, file=sys.stderr, flush=True)
        return True

def signalled(scene, **options):
    return simulate(scene, **{**options, "progress": lambda t, t_end: t > 0.2 and say("under way")})

def slow(handle):
    if say("saving"):
        time.sleep(1.0)
    fsync(handle)

ckc_pin.simulate, os.fsync = signalled, slow
ckc_pin.cli.main()
"""


@pytest.mark.parametrize(
    ("t_end", "first", "meanwhile", "code", "status"),
    [
        ("9000", [signal.SIGINT, signal.SIGINT], [signal.SIGTERM, signal.SIGINT], 130, "interrupted"),
        ("0.3", [], [signal.SIGTERM, signal.SIGTERM], 143, "done"),
    ],
    ids=["interrupted before", "done before"],
)
def test_signals_while_saving_leave_a_complete_file(
    t_end: str, first: list[signal.Signals], meanwhile: list[signal.Signals], code: int, status: str, tmp_path: Path
) -> None:
    """Two immediate Ctrl-C or none, and more of them while the run is written."""
    words = ["run", "five_bar/swing", "--json", "--out", str(tmp_path), "--set", f"t_end={t_end}"]
    with under_way(CKC, *words) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "under way\n"
        for number in first:
            process.send_signal(number)
        assert process.stderr.readline() == "saving\n"
        for number in meanwhile:
            process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == code, err
    assert json.loads(out)["status"] == status
    assert "the run is saved" in err
    run = Run.load(tmp_path)
    assert run.status == status
    assert run.t[-1] == json.loads(out)["t"] > 0.2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.npz", "scene.json"], "no figures, nothing half"


# --- untrusted files -----------------------------------------------------------------------------


def _header(shape: tuple[int, ...], descr: str = "<f8", version: int = 1) -> bytes:
    stream = io.BytesIO()
    write = np.lib.format.write_array_header_1_0 if version == 1 else np.lib.format.write_array_header_2_0
    write(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


GIGABYTE = (2**27,)
BOMBS: dict[str, tuple[dict[str, bytes], str]] = {
    "one array": ({"energy": _header((2**60,))}, f"an array of {8 * 2**60} bytes; a run has at most {MAX_BYTES}"),
    "a product that overflows": ({"u": _header((2**62, 2**62))}, f"an array of {8 * 2**124} bytes"),
    "many arrays": (
        {name: _header(GIGABYTE) for name in ("u", "tau", "w", "phi")},
        "bytes when expanded; a run has at",
    ),
    "zeros that deflate well": ({"meta": bytes(MAX_META_BYTES + 1)}, "damaged"),
    "a long meta": ({"meta": _header((MAX_META_BYTES + 1,), "|u1")}, f"a run has at most {MAX_META_BYTES}"),
    "long names": ({"coordinates": _header((10**6,), "<U10000")}, "bytes; a run has at most"),
    "a later header": ({"t": _header((11,), version=2)}, "t.npy has an array header of an unsupported version"),
    "Python objects": ({"t": _header((11,), "|O")}, "t.npy contains Python objects"),
}


@pytest.fixture(scope="module")
def good_entries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The entries of a good run file."""
    path = simulate("five_bar/swing", {"t_end": 0.01}).save(tmp_path_factory.mktemp("run") / "run.npz")
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zip(path: Path, entries: list[tuple[str, bytes]]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("what", BOMBS)
def test_decompression_bombs_are_not_expanded(
    what: str, good_entries: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries, says = BOMBS[what]
    path = _zip(
        tmp_path / "run.npz", list((good_entries | {f"{name}.npy": data for name, data in entries.items()}).items())
    )
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("it was expanded"))
    with pytest.raises(InputError) as error:
        Run.load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert says in str(error.value)


def test_duplicate_entry_is_rejected(good_entries: dict[str, bytes], tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = _zip(tmp_path / "run.npz", [*good_entries.items(), ("t.npy", good_entries["t.npy"])])
    with pytest.raises(InputError, match="not a run file: it contains"):
        Run.load(path)


def test_entry_that_is_no_array_is_rejected(good_entries: dict[str, bytes], tmp_path: Path) -> None:
    rename: Callable[[str], str] = lambda name: "t" if name == "t.npy" else name  # noqa: E731
    path = _zip(tmp_path / "run.npz", [(rename(name), data) for name, data in good_entries.items()])
    with pytest.raises(InputError, match="not a run file: it contains"):
        Run.load(path)


def test_numeric_names_are_rejected(good_entries: dict[str, bytes], tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, np.zeros(4))
    path = _zip(tmp_path / "run.npz", [*(good_entries | {"coordinates.npy": stream.getvalue()}).items()])
    with pytest.raises(InputError, match=r"coordinates is \(4,\) float64, not names"):
        Run.load(path)
