"""Invalid paths raise one InputError, in Python and on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ckc_pin
from ckc_pin.errors import CkcError, InputError
from ckc_pin.view.player import render_html, save_html
from tests.contract.helpers.command import ckc

SWING = "five_bar/swing"
BAD_PATHS = ["a" * 5000, f"{'a' * 300}/b", "a\0b", "a\ud800b"]
SHORT_RUN: dict[str, Any] = {"t_end": 0.01, "solver.terms": "pinocchio"}
SWEEP: dict[str, Any] = {"outputs": {"e": "energy"}, "overrides": SHORT_RUN, "progress": False}


@pytest.fixture(scope="module")
def run() -> ckc_pin.Run:
    return ckc_pin.simulate(SWING, SHORT_RUN)


CALLS: dict[str, Callable[[ckc_pin.Run, str], Any]] = {
    "Run.load": lambda run, path: ckc_pin.Run.load(path),
    "Run.save": lambda run, path: run.save(path),
    "Run.to_csv": lambda run, path: run.to_csv(path),
    "load": lambda run, path: ckc_pin.load(path),
    "load_scene": lambda run, path: ckc_pin.load_scene(path),
    "simulate": lambda run, path: ckc_pin.simulate(path),
    "inverse_dynamics": lambda run, path: ckc_pin.inverse_dynamics(path),
    "ensemble: scene": lambda run, path: ckc_pin.ensemble(path, {"t_end": [0.01]}, **SWEEP),
    "ensemble: out": lambda run, path: ckc_pin.ensemble(SWING, {"t_end": [0.01]}, **SWEEP, out=path),
    "ensemble: file": lambda run, path: ckc_pin.ensemble(SWING, {"t_end": {"file": path}}, **SWEEP),
    "torques": lambda run, path: ckc_pin.simulate(SWING, {"controller.type": "torques", "controller.file": path}),
    "save_html": save_html,
    "html: meshes": lambda run, path: render_html(run, meshes=path),
    "plot": lambda run, path: ckc_pin.plot([run], path),
}


@pytest.mark.parametrize("name", CALLS)
def test_bad_paths_are_input_errors(
    name: str, run: ckc_pin.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for path in BAD_PATHS:
        with pytest.raises(CkcError) as error:
            CALLS[name](run, path)
        assert isinstance(error.value, InputError) or "unknown mechanism" in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [
        ("run", SWING, "--set", "t_end=0.01", "--out"),
        ("play", "--html", "page.html"),
        ("plot", "--out", "figures"),
        ("import", "--out", "imported"),
        ("sweep", "--out", "swept"),
        ("new",),
    ],
)
def test_bad_paths_are_rejected_on_the_command_line(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for path in BAD_PATHS:
        done = ckc(*words, path)
        assert (done.code, len(done.err.splitlines())) == (2, 1), done.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("urdf", [r"package://example-robot-data/a\u0000b", f"package://{'a' * 5000}/x.urdf"])
def test_bad_package_paths_are_input_errors(urdf: str, tmp_path: Path) -> None:
    (tmp_path / "mechanism.toml").write_text(f'name = "bad"\nurdf = "{urdf}"\n')
    with pytest.raises(InputError, match=r"is not a valid path|no package"):
        ckc_pin.load(tmp_path / "mechanism.toml")
