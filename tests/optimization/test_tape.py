"""The cache of derived functions: found by the next process, for all values of parameters, and derived if damaged."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Mechanism
from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.optimization import motion_functions, tape
from ckc_pin.optimization.motion_functions import MotionFunctions
from ckc_pin.optimization.reduced import ReducedDynamics

NAME, FUNCTIONS = "five_bar", ("closure", "rates", "forces", "first", "second")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ckc_pin" / "terms"


def evaluate(mechanism: Mechanism) -> list[Array]:
    """Return the results of all functions at random arguments."""
    random, functions, n, rows = np.random.default_rng(0), MotionFunctions(mechanism), mechanism.n, mechanism.n - 2
    q, v, a, multipliers = (random.normal(size=(3, k)) for k in (n, n, n, rows))
    weights = [random.normal(size=(3, k)) for k in (rows, rows, rows, n)]
    arguments = {"closure": [q], "rates": [q, v], "forces": [q, v, a], "first": [q, v, a, multipliers],
                 "second": [q, v, a, multipliers, *weights]}  # fmt: skip
    return [x for name in FUNCTIONS for x in getattr(functions, name)(*arguments[name])]


def forbid_deriving(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the derivation of expressions fail."""

    def fail(mechanism: Mechanism) -> None:
        raise AssertionError("expressions are derived")

    monkeypatch.setattr(motion_functions, "MotionExpressions", fail)


def test_functions_are_found_again_with_the_same_values(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    derived = evaluate(ckc_pin.load(NAME))
    assert len(list(folder.glob("*.tape"))) == len(FUNCTIONS)
    forbid_deriving(monkeypatch)
    for ours, exact in zip(evaluate(ckc_pin.load(NAME)), derived, strict=True):
        np.testing.assert_array_equal(ours, exact)


def test_without_a_cache_functions_are_derived_once_in_a_process(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached = evaluate(ckc_pin.load(NAME))
    of_process = tmp_path / "of_process"
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    monkeypatch.setattr(tape, "process_folder", lambda: of_process)
    for ours, exact in zip(evaluate(ckc_pin.load(NAME)), cached, strict=True):
        np.testing.assert_array_equal(ours, exact)
    assert len(list(of_process.glob("*.tape"))) == len(FUNCTIONS)
    forbid_deriving(monkeypatch)
    for ours, exact in zip(evaluate(ckc_pin.load(NAME)), cached, strict=True):
        np.testing.assert_array_equal(ours, exact)


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "of another function"])
def test_a_damaged_file_is_derived_again(folder: Path, damage: str) -> None:
    derived = evaluate(ckc_pin.load(NAME))
    files = {path: path.read_bytes() for path in folder.glob("*.tape")}
    for path, content in files.items():
        middle = len(content) // 2
        path.write_bytes({
            "cut": content[:middle],
            "changed": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "empty": b"",
            "of another function": content[::-1],
        }[damage])  # fmt: skip
    for ours, exact in zip(evaluate(ckc_pin.load(NAME)), derived, strict=True):
        np.testing.assert_array_equal(ours, exact)
    assert {path: path.read_bytes() for path in folder.glob("*.tape")} == files


def missing_force(mechanism: Mechanism) -> tuple[Array, Array]:
    """Return the force of eq. 6 without motors at a motion, and that of Pinocchio's terms."""
    d = mechanism.d
    rate, acceleration = np.linspace(0.3, 1.0, d), np.linspace(-2.0, 1.0, d)
    at = ReducedDynamics(mechanism).instants(
        mechanism.q_tree[None], rate[None], acceleration[None], np.zeros((1, len(mechanism.motors.names)))
    )
    terms = Terms(mechanism, mechanism.assembled, at.v_tree[0])
    return at.force[0], terms.D @ acceleration + terms.C @ rate + terms.h


def test_other_values_of_parameters_take_the_same_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changed = {"link.link_1.mass": 2.5, "gravity": [0.0, -3.0, 0.0]}
    first, _ = missing_force(ckc_pin.load(NAME))
    forbid_deriving(monkeypatch)
    ours, expected = missing_force(ckc_pin.load(NAME, changed))
    assert np.abs(ours - first).max() > 0.1 * np.abs(first).max()
    assert np.abs(ours - expected).max() < 1e-12 * np.abs(expected).max()


def test_another_structure_takes_other_files(folder: Path) -> None:
    for name in ("five_bar", "four_bar", "slider_crank"):
        ours, expected = missing_force(ckc_pin.load(name))
        assert np.abs(ours - expected).max() < 1e-11 * np.abs(expected).max()
    assert len(list(folder.glob("*.tape"))) == 6


def test_a_folder_that_others_may_write_to_is_not_used(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    missing_force(ckc_pin.load(NAME))
    assert not list(folder.iterdir())


def evaluate_first(name: str) -> float:
    """Return a sum of the results in a process."""
    return float(sum(np.abs(x).sum() for x in evaluate(ckc_pin.load(name))))


def test_several_processes_may_write_at_the_same_time(folder: Path) -> None:
    with ProcessPoolExecutor(3) as pool:
        sums = list(pool.map(evaluate_first, [NAME] * 3))
    assert len(set(sums)) == 1
    assert sorted(path.suffix for path in folder.iterdir()) == [".tape"] * len(FUNCTIONS)
    assert evaluate_first(NAME) == sums[0]
