"""The C++ loop on Pinocchio's constraintDynamics or lcaba: its results, and messages if it cannot be compiled."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scripts.experiments.benchmark.peers import compiled
from scripts.experiments.benchmark.peers.pinocchio_loop import PinocchioLoop
from scripts.experiments.benchmark.work import WORKS, Work
from scripts.experiments.right_hand_sides import measure
from tests.analytic.five_bar import FIVE_BAR

LOOP, LCABA = PinocchioLoop("constraintDynamics"), PinocchioLoop("lcaba")
compiles = pytest.mark.skipif(not compiled.compiler(), reason="no C++ compiler: that it is said is tested below")
ONE_SQUARE = Work("one_square", "N-four-bar, N = 1, 0.5 s", "n_four_bar", 0.5, {"mechanism.N": 1}, point="B0")
THREE_SECONDS = Work("swing", "five-bar, free swing, 3 s", "five_bar/swing", 3.0)
TIGHT = "K_p 0, mu 1e-08, iterations 3, tolerance 1e-12"
TIGHT_LCABA = "K_p 0, mu 0.001, iterations 5, tolerance 1e-12"
both = pytest.mark.parametrize(
    ("loop", "tight"), [(LOOP, TIGHT), (LCABA, TIGHT_LCABA)], ids=["constraintDynamics", "lcaba"]
)


def _phi(q_tree: np.ndarray) -> np.ndarray:
    """Return phi of the five-bar by NumPy, by instant."""
    return np.array([FIVE_BAR.phi(row) for row in q_tree])


@pytest.fixture
def empty_program_cache() -> Iterator[None]:
    """Clear the cache of the compiled program before and after the test."""
    kept = compiled.program
    compiled.program.cache_clear()
    yield
    kept.cache_clear()


@compiles
@pytest.mark.parametrize("loop", [LOOP, LCABA], ids=lambda loop: loop.algorithm)
@pytest.mark.parametrize("key", ["andrews", "bricard", "delta", "two_ur5"])
def test_loop_program_has_the_same_mechanism(key: str, loop: PinocchioLoop) -> None:
    """Covers springs, a hinge with redundant rows, spherical loops, and a free root."""
    work = next(work for work in WORKS if work.key == key)
    assert loop.missing(work) is None
    mass, bias, energy, acceleration = (float(x) for x in re.findall(r"(\d\S*e[-+]\d+)", loop.check(work)))
    assert mass < 1e-12
    assert bias < 1e-12
    assert energy < 1e-12
    assert acceleration < 1e-9


@compiles
@both
def test_loop_program_follows_closed_form(loop: PinocchioLoop, tight: str) -> None:
    """Half a second of a square's angle, a pendulum, by quadrature of its energy in numpy."""
    from scipy.integrate import quad
    from scipy.optimize import brentq

    k = 9.81 * 3 * 4 / (2 * 5)

    def moment(theta: float) -> float:
        return quad(lambda x: 1 / np.sqrt(1 + 2 * k * (1 - np.sin(x))), theta, np.pi / 2, epsabs=1e-13)[0]

    theta = brentq(lambda theta: moment(theta) - ONE_SQUARE.t_end, 0.0, np.pi / 2, xtol=1e-14)
    motion = loop.compute(ONE_SQUARE, tight, 60.0)
    assert motion.status == "done"
    assert motion.q_tree.shape == (11, ONE_SQUARE.mechanism.n)
    assert np.abs(ONE_SQUARE.observed(motion.q_tree)[-1] - [np.cos(theta), np.sin(theta), 0.0]).max() < 1e-11
    assert motion.steps is not None
    assert motion.rhs is not None
    assert motion.rhs >= 13 * motion.steps
    assert 0 < motion.wall_s < 60.0


@compiles
@both
def test_baumgarte_terms_keep_loops_closed(loop: PinocchioLoop, tight: str) -> None:
    """lcaba of Pinocchio 4.1 does not compute the errors of point constraints: the loop has to."""
    proximal = tight.removeprefix("K_p 0, ").rpartition(",")[0]
    free, pulled = (
        np.abs(_phi(loop.compute(THREE_SECONDS, f"K_p {gain}, {proximal}, tolerance 1e-05", 60.0).q_tree))
        for gain in (0, 100)
    )
    assert 3 * pulled.max() < free.max() < 1e-2


@compiles
@both
def test_loop_program_supports_springs_and_free_roots(loop: PinocchioLoop, tight: str) -> None:
    from ckc_pin.run.simulate import simulate

    for key, t_end in (("andrews", 0.01), ("two_ur5", 0.2)):
        work = next(work for work in WORKS if work.key == key)
        short = Work(key, work.says, work.scene, t_end)
        run = simulate(short.load(formulation="reduced", solver__method="DOP853", solver__rtol=1e-11))
        motion = loop.compute(short, tight, 60.0)
        assert np.abs(motion.q_tree - run.q_tree).max() < 1e-8
        assert np.abs(motion.v_tree - run.v_tree).max() < 1e-8 * max(1.0, np.abs(run.v_tree).max())


@compiles
def test_lcaba_does_not_depend_on_the_call_before() -> None:
    """lcaba of Pinocchio 4.1 keeps accelerations of 6D constraints: its steps shrank, and welds opened."""
    work = Work("two_ur5", "two UR5 on one bar, 1.4 s", "two_ur5", 1.4)
    theirs, lcaba = (
        loop.compute(work, f"K_p 100, mu {mu:g}, iterations {iterations}, tolerance 1e-09", 20.0)
        for loop, mu, iterations in ((LOOP, 1e-8, 3), (LCABA, 1e-3, 5))
    )
    assert lcaba.steps < 1.1 * theirs.steps
    assert np.abs(lcaba.q_tree - theirs.q_tree).max() < 1e-6


def test_settings_of_lcaba_stay_above_its_rounding_errors() -> None:
    """Accelerations err by about 1e-14 / mu, and steps of a millisecond by a thousandth of that."""
    for quick in (True, False):
        settings = list(LCABA.settings(ONE_SQUARE, quick))
        assert len(set(settings)) == len(settings)
        for setting in settings:
            _, mu, _, tolerance = (float(part.split()[1]) for part in setting.split(", "))
            assert tolerance > 1e-14 / mu * 1e-3


@compiles
def test_run_over_budget_is_terminated() -> None:
    motion = LOOP.compute(next(work for work in WORKS if work.key == "n_four_bar_40"), TIGHT, 0.01)
    assert motion.status == "refused"
    assert len(motion.q_tree) == 0


@pytest.mark.usefixtures("empty_program_cache")
def test_missing_compiler_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    assert LOOP.missing(ONE_SQUARE) == "no C++ compiler was found"


@pytest.mark.usefixtures("empty_program_cache")
def test_compiler_error_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "c++"
    compiler.write_text(
        f"#!{sys.executable}\nimport sys\nsys.exit('a note\\nloop.cpp:3: error: no such   header\\nmore')\n"
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    assert LOOP.missing(ONE_SQUARE) == "it does not compile: loop.cpp:3: error: no such header"


@compiles
def test_right_hand_sides_are_timed_with_all_terms() -> None:
    row = measure("1")
    assert (row.n, row.d) == (3, 1)
    assert row.compiled_s is not None
    assert row.lcaba_s is not None
    assert 0 < row.compiled_s < row.pinocchio_s
    assert len(row.row().split("|")) == 10
