"""Unusual numbers, files, threads and functions that once gave a wrong result or a traceback."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import CkcError, Event, InputError, MechanismError, Run, Simulator, load, simulate, terms
from ckc_pin.base.atomic_files import UNFINISHED, open_atomic
from ckc_pin.kinematics.sigma import sigma

# --- numbers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("t_end", "output_dt"), [(0.02, 1e10), (0.02, 0.03), (1e-300, 1.0), (5e-324, None)])
def test_output_instants_include_zero_and_t_end_once(t_end: float, output_dt: float | None) -> None:
    """The last instant used to replace the first where output_dt exceeds t_end, or all 501 instants were 0."""
    run = simulate("five_bar/swing", {"t_end": t_end, "solver.output_dt": output_dt})
    assert run.t.tolist() == [0.0, t_end]


WORDS: list[tuple[dict[str, Any], str]] = [
    ({"initial.q_dot": {"theta_1": 1.7e308, "theta_3": 1e308}}, "initial.q_dot = "),  # v' overflows
    ({"solver.max_rhs": 10**40}, "solver.max_rhs = 1"),  # more than the loop counts
    ({"mechanism": "a" * 300}, "no mechanism 'aaa"),  # longer than a file system takes
    ({"mechanism": "a" * 300 + ".toml"}, "cannot be read: File name too long"),
]


@pytest.mark.parametrize(("overrides", "says"), WORDS, ids=lambda x: str(x)[:40])
def test_scene_values_out_of_range_are_rejected(overrides: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError) as error:
        simulate("five_bar/swing", overrides)
    assert says in str(error.value)


def test_too_large_integers_are_rejected() -> None:
    """Keys of any type used to accept them."""
    with pytest.raises(InputError, match=r"controller.desired.theta_1.offset = 10+: .*64 bits"):
        simulate("five_bar/tracking", {"controller.desired.theta_1.offset": 10**40})


def test_gains_whose_squares_overflow_are_rejected() -> None:
    with pytest.raises(InputError, match=r"controller.K_D: an entry is above 1e\+100"):
        simulate("five_bar/tracking", {"controller.K_D": 1.7e308})


def test_lengths_whose_squares_overflow_are_rejected(bar: Path) -> None:
    """The singular values of such a closure overflow."""
    text = (bar / "mechanism.toml").read_text(encoding="utf-8")
    (bar / "mechanism.toml").write_text(
        text.replace('frame_a = "tip_left"', 'frame_a = {link = "tip_left", xyz = [1e300, 0.0, 0.0]}', 1),
        encoding="utf-8",
    )
    with pytest.raises(MechanismError, match=r"joints or loop frames are 1e\+300 m apart, more than 1e\+100 m"):
        load(bar)


def test_start_many_turns_away_is_assembled_directly() -> None:
    """Newton's method used to follow the path step by step."""
    far = 2 * np.pi * 10**5 + load("four_bar").assembled.q_tree[0]
    assert sigma(load("four_bar"), np.array([far])).iterations < 6000


# --- threads -----------------------------------------------------------------------------------------


@pytest.fixture
def restless() -> Any:
    """Threads that switch as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def test_mechanism_in_threads_gives_correct_terms(restless: Any) -> None:
    """Another thread used to overwrite Pinocchio's workspace before it was read."""
    mechanism = load("five_bar")
    states = [({"theta_1": -1.2 + 1e-3 * k, "theta_3": -1.9}, {"theta_1": 0.01 * k}) for k in range(200)]

    def numbers(state: tuple[dict[str, float], dict[str, float]]) -> Any:
        at = terms(mechanism, *state)
        return np.concatenate([at.D.ravel(), at.C.ravel(), at.h, at.rho_dot.ravel(), [at.energy]])

    alone = [numbers(state) for state in states]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            assert np.array_equal(alone, list(pool.map(numbers, states)))


def test_simulator_in_threads_steps_or_rejects(restless: Any) -> None:
    """Two simultaneous steps used to change the same state."""
    simulator = Simulator("five_bar/swing", {"formulation": "reduced"})

    def step(_: int) -> str:
        try:
            simulator.step(None, 1e-3)
        except InputError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(4) as pool:
        said = list(pool.map(step, range(200)))
    assert all(text.startswith("step: this simulator is executing another call") for text in said if text)
    assert simulator.state.t == pytest.approx(1e-3 * said.count(""), abs=1e-12)
    simulator.reset()
    assert simulator.step(None, 1e-3).t == 1e-3


def test_pickled_mechanism_is_equal() -> None:
    """Its views of Pinocchio's workspace used to become separate arrays."""
    mechanism = load("five_bar")
    twin = pickle.loads(pickle.dumps(mechanism))
    q_tree = mechanism.q_tree + 0.1
    assert np.array_equal(twin.kinematics(q_tree).phi, mechanism.kinematics(q_tree).phi)
    assert np.array_equal(twin.kinematics(q_tree).J, mechanism.kinematics(q_tree).J)


# --- callers' functions ------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["step", "reset", "stats", "events"])
def test_event_function_cannot_call_its_simulator(what: str) -> None:
    acts: dict[str, Callable[[], Any]] = {
        "step": lambda: simulator.step(None, 1e-3),
        "reset": lambda: simulator.reset(),
        "stats": lambda: simulator.stats,
        "events": lambda: simulator.events,
    }
    armed = False

    def function(t: float, terms: Any) -> float:
        if armed:
            acts[what]()
        return 1.0

    simulator = Simulator("five_bar/swing", {"formulation": "reduced"}, events=[Event(function)])
    armed = True
    with pytest.raises(InputError, match=f"{what}: this simulator is executing another call"):
        simulator.step(None, 1e-3)
    armed = False
    assert simulator.step(None, 1e-3).t > 0


def test_output_callback_gets_a_copy() -> None:
    """The array used to be a view of the recorded data."""
    overrides = {"t_end": 0.02}

    def spoil(t: float, q_tree: Any) -> None:
        q_tree[:] = np.nan

    spoilt = simulate("five_bar/swing", overrides, on_output=spoil)
    assert np.array_equal(spoilt.q_tree, simulate("five_bar/swing", overrides).q_tree)


def test_state_arrays_are_read_only() -> None:
    state = Simulator("five_bar/swing", {"formulation": "reduced"}).state
    with pytest.raises(ValueError, match="read-only"):
        state.v_tree[0] = 1.0


@pytest.mark.parametrize("u", [np.array([1j, 0.0]), ["1", "2"], np.array([b"1", b"2"]), [10**400, 0]], ids=str)
def test_u_must_be_real_numbers(u: Any) -> None:
    """A complex u used to lose its imaginary part, and text was converted."""
    simulator = Simulator("five_bar/swing", {"formulation": "reduced"})
    with pytest.raises(InputError, match="u: expected a vector of numbers, got"):
        simulator.step(u, 1e-3)


def test_too_large_event_value_is_rejected() -> None:
    with pytest.raises(InputError, match=r"the event 'big' gave an integer that is too large"):
        simulate("five_bar/swing", {"t_end": 0.1}, events=[Event(lambda t, terms: 10**400, name="big")])


# --- files -------------------------------------------------------------------------------------------


def _saved(tmp_path: Path) -> Path:
    return simulate("five_bar/swing", {"t_end": 0.02}, profile=True).save(tmp_path / "run.npz")


def _with_meta(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    from ckc_pin.run.run_file import RunMeta, hashes_of

    with np.load(path) as data:
        content = {name: data[name] for name in data.files}
    meta = json.loads(content["meta"].tobytes())
    change(meta)
    hashes = hashes_of(RunMeta(**{k: v for k, v in meta.items() if k != "hashes"}))  # as an attacker can do
    content["meta"] = np.frombuffer(json.dumps(meta | {"hashes": hashes}).encode(), dtype=np.uint8)
    np.savez(path, **content)


CHANGED: list[Callable[[dict[str, Any]], Any]] = [
    lambda meta: meta["scene"].pop("formulation"),
    lambda meta: meta["scene"].update(formulation="x"),
    lambda meta: meta["scene"].update(epsilon=-1.0),
    lambda meta: meta["scene"].update(controller={"type": "x"}),
    lambda meta: meta["stats"].pop("rhs"),
    lambda meta: meta["stats"].update(steps_by_method=3),
    lambda meta: meta.update(events=[{}]),
    lambda meta: meta.update(profile={"D": 1}),
]


@pytest.mark.parametrize("change", CHANGED, ids=range(len(CHANGED)))
def test_metadata_of_run_files_is_checked(change: Callable[..., Any], tmp_path: Path) -> None:
    """With correct hashes, `ckc plot` used to end in a KeyError."""
    path = _saved(tmp_path)
    _with_meta(path, change)
    with pytest.raises(InputError, match=r"run\.npz: damaged: (scene|stats|events|profile): "):
        Run.load(path)


def test_run_with_another_mechanism_is_rejected(tmp_path: Path) -> None:
    path = _saved(tmp_path)
    other = load("slider_crank").sources.texts
    _with_meta(path, lambda meta: meta.update(texts=other))
    with pytest.raises(InputError, match=r"damaged: the run's coordinates are theta_1, .*, its mechanism's crank"):
        Run.load(path).to_dict()


def test_message_is_one_line_without_control_characters() -> None:
    assert str(CkcError("a\nb\x1b[2J é")) == r"a\nb\x1b[2J é"


@pytest.mark.parametrize("size", [0, 100, 2000])
def test_full_disk_keeps_the_old_file(size: int, tmp_path: Path) -> None:
    """A file size limit of the process simulates the full disk."""
    before = _saved(tmp_path).read_bytes()
    program = f"""
import resource, signal, ckc_pin
run = ckc_pin.Run.load({str(tmp_path)!r})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
try:
    run.save({str(tmp_path / "run.npz")!r})
except ckc_pin.InputError as error:
    print(error)
"""
    env = {**os.environ, "PYTHONPATH": str(Path(ckc_pin.__file__).parent.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=env)
    assert done.stdout == f"{tmp_path / 'run.npz'}: cannot be written: File too large\n"
    assert done.stderr == ""
    assert (tmp_path / "run.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["run.npz"]


def test_temporary_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    for content in (b"", b"half"):
        (tmp_path / f".run.npz.{len(content)}{UNFINISHED}").write_bytes(content)
    with open_atomic(path) as file:
        file.write(b"first")
        file.flush()
        with open_atomic(path) as other:
            other.write(b"second")
        assert path.read_bytes() == b"second"
    assert path.read_bytes() == b"first"
    assert os.listdir(tmp_path) == ["run.npz"]
