"""Programs that follow the benchmark's protocol: both examples against references, and wrong answers."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from ckc_pin.errors import InputError
from scripts.experiments.benchmark.peer_table import print_table
from scripts.experiments.benchmark.peers import compiled, environments, protocol
from scripts.experiments.benchmark.peers.environments import Program, find_python, make_environment
from scripts.experiments.benchmark.peers.protocol import ProgramPeer, add_programs, make_problem
from scripts.experiments.benchmark.work import WORKS, Work
from tests.analytic.five_bar import FIVE_BAR, Q

BY_KEY = {work.key: work for work in WORKS}
SWING = Work("short", "five-bar, free swing, 0.1 s", "five_bar/swing", 0.1, quick=True)
EXAMPLES = Path(protocol.__file__).parents[1] / "peer_examples"
TIGHT = "rtol 1e-12"


@pytest.fixture(scope="module", params=["scipy_peer.py", "eigen_peer.cpp"])
def example(request: pytest.FixtureRequest) -> ProgramPeer:
    path = EXAMPLES / request.param
    if path.suffix == ".py":
        return ProgramPeer(f"{sys.executable} {path}")
    if not compiled.compiler():
        pytest.skip("no C++ compiler")
    program, reason = compiled.compile_program([path, EXAMPLES / "problem.hpp"], ["-std=c++17", "-O3"])
    assert reason is None
    return ProgramPeer(str(program))


# --- the examples against references ---------------------------------------------------------------------------------


def test_example_matches_five_bar_in_numpy(example: ProgramPeer) -> None:
    def rate(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    motion = example.compute(SWING, TIGHT, 20.0)
    assert motion.status == "done", motion.reason
    start = np.concatenate([motion.q_tree[0][Q], motion.v_tree[0][Q]])
    reference = solve_ivp(rate, (0.0, 0.1), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert np.abs(motion.q_tree[-1][Q] - reference[:2]).max() < 1e-10
    assert np.abs(motion.v_tree[-1][Q] - reference[2:]).max() < 1e-9


def test_example_matches_closed_form_of_one_square(example: ProgramPeer) -> None:
    """A square's angle is a pendulum, by quadrature of its energy."""
    work, k = Work("square", "one square, 0.5 s", "n_four_bar", 0.5, {"mechanism.N": 1}, point="B0"), 9.81 * 12 / 10

    def moment(theta: float) -> float:
        return quad(lambda x: 1 / np.sqrt(1 + 2 * k * (1 - np.sin(x))), theta, np.pi / 2, epsabs=1e-13)[0]

    theta = brentq(lambda theta: moment(theta) - 0.5, 0.0, np.pi / 2, xtol=1e-14)
    motion = example.compute(work, TIGHT, 20.0)
    assert np.abs(work.observed(motion.q_tree)[-1] - [np.cos(theta), np.sin(theta), 0.0]).max() < 1e-10


def test_example_matches_published_bricard(example: ProgramPeer) -> None:
    """A hinge loop with redundant rows; the published position at 1 s has eight digits."""
    work = replace(BY_KEY["bricard"], t_end=1.0, point="P3")
    motion = example.compute(work, "rtol 1e-11", 20.0)
    assert np.abs(work.observed(motion.q_tree)[-1] - [0.27448132, -0.88670794, -0.46233000]).max() < 1e-8


@pytest.mark.parametrize("key", ["swing", "slider_crank", "bricard", "delta", "two_ur5", "n_four_bar_16"])
def test_example_has_the_same_mechanism(key: str, example: ProgramPeer) -> None:
    """Covers slides, springs on joints, hinges, spherical loops, welds and free bodies."""
    reason = example.missing(BY_KEY[key])
    if reason:
        assert reason == "it has no free bodies"
        assert key in ("delta", "two_ur5")
    else:
        assert float(example.check(BY_KEY[key]).rpartition(" ")[2]) < 1e-11


def test_example_follows_free_bodies() -> None:
    """Two arms on one free bar against MuJoCo, which closes the loops by soft constraints."""
    from scripts.experiments.benchmark.peers.mujoco import Mujoco

    work = replace(BY_KEY["two_ur5"], t_end=0.2)
    motion = ProgramPeer(f"{sys.executable} {EXAMPLES / 'scipy_peer.py'}").compute(work, "rtol 1e-08", 20.0)
    theirs = Mujoco().compute(work, "RK4, solref 2 dt, dt 0.0002", 20.0)
    assert np.abs(motion.q_tree - theirs.q_tree).max() < 1e-4
    assert np.abs(motion.q_tree[-1] - motion.q_tree[0]).max() > 1e-2


def test_examples_are_short() -> None:
    for name in ("scipy_peer.py", "eigen_peer.cpp"):
        assert len((EXAMPLES / name).read_text(encoding="utf-8").splitlines()) < 100


def test_controlled_and_unsupported_works_give_a_reason(example: ProgramPeer) -> None:
    assert "reduced model" in str(example.missing(BY_KEY["tracking_1e-04"]))
    assert example.missing(BY_KEY["andrews"]) == "it has no springs between bodies"


def test_table_shows_errors_and_times(capsys: pytest.CaptureFixture[str]) -> None:
    assert print_table(f"{sys.executable} {EXAMPLES / 'scipy_peer.py'}", ["swing"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("  rtol")]
    for rtol, error, _, own_error, _ in (line[1:] for line in lines):
        assert float(error) < 1e3 * float(rtol) + 1e-11
        assert float(own_error) < 1e3 * float(rtol) + 1e-11
    assert len(lines) == len(protocol.QUICK_TOLERANCES)


# --- wrong answers -------------------------------------------------------------------------------------------------

INTRODUCTION = '{"name": "mine", "version": "2"}'


@pytest.fixture
def program(tmp_path: Path) -> Callable[[str], str]:
    """Return a function that writes a program of Python code and returns its command."""

    def write(code: str, introduction: str = INTRODUCTION) -> str:
        path = tmp_path / "peer.py"
        path.write_text(f"import json, sys\nproblem = json.load(sys.stdin)\nprint({introduction!r})\n{code}\n")
        return f"{sys.executable} {path}"

    return write


STATES = "for t in problem['instants']:\n  print(json.dumps({'t': t, 'q': problem['q'], 'v': problem['v']}))\n"
END = "print(json.dumps({'wall_s': 1e-6}))"


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("print('step 1')", "line 2 is 'step 1'; expected a JSON object with one of the keys name"),
        ("print('[1]')", "line 2 is '[1]'; expected a JSON object"),
        ("if problem['instants']: raise SystemExit('diverged')", "exit code 1: diverged"),
        (STATES, "wall_s is None; expected seconds"),
        (STATES + "print(json.dumps({'wall_s': 100.0}))", "wall_s is 100.0; expected seconds, at most those of"),
        (END, "it printed states at t = []; expected [0.0, "),
        (STATES.replace("'t': t", "'t': 2 * t") + END, "it printed states at t = [0.0, 0.02"),
        (STATES.replace("problem['q']", "[1.0]") + END, "q at t = 0 is [1.0]; expected 4"),
    ],
)
def test_wrong_answer_is_reported(code: str, reason: str, program: Callable[[str], str]) -> None:
    if "step 1" in code or "[1]" in code:
        with pytest.raises(InputError) as error:
            ProgramPeer(program(code))
        assert reason in str(error.value)
        return
    motion = ProgramPeer(program(code)).compute(SWING, TIGHT, 1.0)
    assert motion.status == "failed"
    assert reason in motion.reason


def test_right_answer_is_a_motion(program: Callable[[str], str]) -> None:
    motion = ProgramPeer(program(STATES + "print(json.dumps({'wall_s': 1e-6, 'rhs': 7}))")).compute(SWING, TIGHT, 1.0)
    assert (motion.status, motion.wall_s, motion.rhs, motion.steps) == ("done", 1e-6, 7, None)
    assert motion.q_tree.shape == motion.v_tree.shape == (11, 4)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "the command is empty"),
        ("'", "No closing quotation"),
        ("/nowhere/peer", "/nowhere/peer: it does not start: No such file"),
        ("true", "its first line is not"),
    ],
)
def test_program_that_does_not_introduce_itself_is_rejected(command: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        add_programs([command])


def test_two_programs_of_one_name_are_rejected(program: Callable[[str], str]) -> None:
    with pytest.raises(InputError, match="two programs have the name 'mine'"):
        add_programs([program(""), program("")])


def test_settings_combine_own_settings_and_tolerances(program: Callable[[str], str]) -> None:
    peer = ProgramPeer(program("", '{"name": "mine", "version": "2", "settings": ["a, b", "c"], "packaged": true}'))
    settings = list(peer.settings(SWING, quick=False))
    assert settings[0] == "a, b, rtol 1e-02"
    assert len(set(settings)) == 2 * len(protocol.TOLERANCES)
    assert peer.packaged
    echo = program("print(json.dumps({'unsupported': problem['setting'] + str(problem['rtol'])}))")
    assert ProgramPeer(echo).compute(SWING, "a, b, rtol 1e-04", 1.0).reason == "a, b0.0001"


def test_version_changes_with_the_program(program: Callable[[str], str]) -> None:
    first, second = ProgramPeer(program("")).version(), ProgramPeer(program("pass")).version()
    assert first.startswith("2 (")
    assert first != second


def test_loops_that_points_cannot_express_have_no_pairs() -> None:
    from ckc_pin.scene.names import list_catalogue

    checked = 0
    for name, _, scenes in list_catalogue():
        if not scenes:
            continue
        work = Work(name, name, f"{name}/{next(iter(scenes))}", 0.1)
        try:
            problem = make_problem(work, 1e-6, 1.0)
        except InputError:  # robots that are not installed
            continue
        pairs = {"point": 1, "point_2d": 1, "hinge": 2, "weld": 3}
        types = [loop["type"] for loop in problem["loops"]]
        expected = sum(pairs[kind] for kind in types) if set(types) <= set(pairs) else None
        assert expected == (None if problem["pairs"] is None else len(problem["pairs"]))
        json.dumps(problem, allow_nan=False)
        checked += 1
    assert checked > 5


# --- environments --------------------------------------------------------------------------------------------------


def test_this_python_is_found_by_its_version() -> None:
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    assert find_python(version) == sys.executable
    assert find_python("2.9") is None


def test_missing_python_and_package_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environments, "ENVIRONMENTS", tmp_path)
    absent = Program("Drake", "drake_peer.py", "2.9", ("drake==9.9",))
    assert make_environment(absent) == (
        "Drake: drake==9.9 needs Python 2.9, which was not found on PATH, by pyenv or by uv; it is left out"
    )
    assert absent.command is None


def test_environment_runs_a_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The requirement is there already, so that nothing is downloaded."""
    (tmp_path / "echo.py").write_text(f"print({INTRODUCTION!r})\n", encoding="utf-8")
    monkeypatch.setattr(environments, "ENVIRONMENTS", tmp_path / "some folder")
    monkeypatch.setattr(environments, "SOURCES", tmp_path)
    mine = Program("mine", "echo.py", f"{sys.version_info[0]}.{sys.version_info[1]}", ("pip",))
    assert "installed in" in make_environment(mine)
    assert make_environment(mine) == "mine: installed"
    assert ProgramPeer(str(mine.command), mine.name).version() == "2"


def test_programs_without_environment_are_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environments, "ENVIRONMENTS", tmp_path)
    environments.program_peers.cache_clear()
    peers = environments.program_peers()
    environments.program_peers.cache_clear()
    assert [peer.name for peer in peers] == [program.name for program in environments.PROGRAMS]
    assert {peer.missing(SWING) for peer in peers} == {
        "not installed: ./scripts/experiment benchmark --peers installs it"
    }
