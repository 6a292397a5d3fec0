"""What scenes leave out, and how cost grows: what is measured is what is said to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import load
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import Scene, load_scene
from ckc_pin.simulation.simulate import simulate
from scripts.experiments.benchmark import growth, left_out, make
from scripts.experiments.benchmark.growth_said import growth_said
from scripts.experiments.benchmark.left_out import LeftOut, module_costs, modules_of, terms_of
from scripts.experiments.benchmark.left_out_said import left_out_said
from scripts.experiments.benchmark.pace import motion, seconds
from scripts.experiments.benchmark.table import Table
from tests.conftest import assert_close

# --- what a scene leaves out ------------------------------------------------------------------------------------------


def test_an_acceleration_leaves_out_what_it_does_not_need() -> None:
    used = {
        (scene, formulation): {row.what for row in terms_of(scene, "k", {"formulation": formulation}) if row.used}
        for scene, formulation in (
            ("five_bar/swing", "dae"), ("five_bar/swing", "reduced"), ("five_bar/tracking", "reduced")
        )
    }  # fmt: skip
    for own in used.values():
        assert not own & {"ρ̇", "C", "λ", "energy"}
    assert "σ" not in used["five_bar/swing", "dae"]
    assert "σ" in used["five_bar/swing", "reduced"]
    assert "C'" not in used["five_bar/swing", "reduced"]
    assert "C'" in used["five_bar/tracking", "reduced"]  # eq. 16 asks for C


def test_a_term_left_out_costs_time_and_memory() -> None:
    rows = list(terms_of("andrews", "k"))
    for row in rows:
        assert row.rhs_s is not None
        if row.used:
            assert (row.seconds, row.bytes) == (None, None)
        else:
            assert row.seconds is not None
            assert row.seconds > 0
            assert row.bytes is not None
            assert row.bytes > 0
    by_name = {row.what: row for row in rows}
    n = load("andrews").n
    assert by_name["C"].bytes >= by_name["C'"].bytes >= 8 * n * n  # type: ignore[operator]
    assert len({row.key for row in rows}) == len(rows) == len(left_out.TERMS)


def test_a_scene_that_cannot_start_says_why() -> None:
    rows = list(terms_of("five_bar/swing", "k", {"initial.q.theta_1": 3.0, "initial.q.theta_3": 0.1}))
    assert [row.what for row in rows] == list(left_out.TERMS)
    assert all("out of reach" in row.reason and row.seconds is None for row in rows)
    assert "out of reach" in "\n".join(left_out_said(rows))


def test_modules_are_seen_in_a_fresh_interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(left_out, "MODULES", {name: (f"import {name}", "") for name in ("msgspec", "this", "no_such")})
    assert {row.what: row.used for row in modules_of("five_bar/swing", "k")} == {
        "msgspec": True, "this": False, "no_such": False,
    }  # fmt: skip
    assert all(row.reason for row in modules_of("no_such_scene", "k"))
    monkeypatch.setattr(left_out, "MODULES", {"big": ("import numpy; x = numpy.ones(2**22)", ""), "no": ("1 / 0", "")})
    big, no = module_costs("k", repeats=1)
    assert big.bytes is not None
    assert 2**25 <= big.bytes < 2**26
    assert big.seconds is not None
    assert big.seconds > 0
    assert no.reason == "ZeroDivisionError: division by zero"
    assert no.seconds is None


def test_every_shipped_scene_is_looked_at() -> None:
    scenes = left_out.every_scene()
    assert {"five_bar/swing", "n_four_bar/default", "talos/squat"} <= set(scenes)
    assert all(load_scene(scene) for scene in scenes)


def test_the_section_says_what_was_measured() -> None:
    rows = [
        *(LeftOut(key=name, scene="", what=name, seconds=0.5, bytes=2**20) for name in left_out.MODULES),
        *(LeftOut(key=name, scene="a/b", what=name, used=name == "scipy.integrate") for name in left_out.MODULES),
        LeftOut(key="1", scene="a/b", what="C'", used=False, seconds=1e-6, bytes=2048, rhs_s=1e-4),
        LeftOut(key="2", scene="a/b", what="σ", used=True, rhs_s=1e-4),
        LeftOut(key="3", scene="c/d", what=left_out.MISSING, reason="no such *robot*"),
    ]
    text = "\n".join(left_out_said(rows))
    count = len(left_out.MODULES) - 1
    assert "None of the 1 scenes loads meshcat" in text
    assert f"to import them would take {0.5 * count:.2g} s and {count} MB in each process." in text
    assert "- c/d: no such \\*robot\\*" in text
    assert "C' by 1 of 1 (+1 %)" in text
    assert "| a/b | 100 | +1.0 µs, 1 % |  |  |  |  | used |  | 2 |" in text
    assert "| scipy.integrate | a second opinion by SciPy's solvers | 500 | 1.0 | all |" in text


def test_a_scene_whose_robot_is_not_installed_is_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(scene: Scene) -> Mechanism:
        raise InputError("no package")

    monkeypatch.setattr(make, "scene_mechanism", none)
    monkeypatch.setattr(left_out, "MODULES", {})
    monkeypatch.setattr(left_out, "every_scene", lambda: ["talos/squat"])
    (row,) = make._left_out(tmp_path, [], False, lambda said: None)
    assert (row.scene, row.what, row.reason) == ("talos/squat", left_out.MISSING, "no package")
    assert list(Table(tmp_path / "left_out.csv", LeftOut).rows.values()) == [row]


# --- how cost grows -----------------------------------------------------------------------------------------------


@given(p=st.floats(-3, 3), factor=st.floats(1e-6, 1e3))
def test_the_exponent_of_a_power_is_found(p: float, factor: float) -> None:
    points = {float(x): factor * x**p for x in (1, 2, 4, 8, 16, 40)}
    assert growth.exponent(points, whole=True) == pytest.approx(p, abs=1e-9)
    assert growth.exponent(points) == pytest.approx(p, abs=1e-9)
    bent = {x: y if x >= 6.3 else 10 * y for x, y in points.items()}  # the lower half does not count
    assert growth.exponent(bent) == pytest.approx(p, abs=1e-9)
    assert growth.exponent({1.0: 1.0, 2.0: 2.0}) is None
    assert growth.exponent({}) is None


@pytest.mark.parametrize(("N", "loops"), [(3, 3), (3, 1), (4, 2)])
def test_a_case_has_the_loops_and_freedoms_it_says(N: int, loops: int, tmp_path: Path) -> None:
    case = growth.Case(N, loops)
    mechanism = prepare(load_scene(growth._written(case, tmp_path))).mechanism
    assert (mechanism.n, mechanism.d) == (2 * N + 1, case.d)
    assert len(mechanism.spec.loop) == loops
    assert np.abs(mechanism.assembled.phi).max() < 1e-12


def test_a_case_is_counted_and_timed() -> None:
    family = growth.FAMILIES[0]
    for formulation in growth.FORMULATIONS:
        row = growth.measure(growth.Case(2, 2), family, formulation, "k")
        assert (row.reason, row.x) == ("", 2)
        assert row.rhs_s is not None
        assert row.rhs_s > 0
        assert row.rhs is not None
        assert row.rhs > 50


def test_a_case_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "FORMULATIONS", {"dae": {"formulation": "dae", "solver.max_rhs": 20}})
    stopped = growth.measure(growth.Case(2, 2), growth.FAMILIES[0], "dae", "k")
    assert stopped.rhs is None
    assert "max_rhs = 20" in stopped.reason
    monkeypatch.setattr(growth, "FORMULATIONS", {"dae": {"formulation": "none"}})
    wrong = growth.measure(growth.Case(2, 2), growth.FAMILIES[0], "dae", "k")
    assert wrong.rhs_s is None
    assert "formulation" in wrong.reason
    text = "\n".join(growth_said([stopped, wrong], {}))
    assert "max_rhs = 20" in text
    assert "formulation" in text


def test_a_right_hand_side_is_timed_where_it_is_called() -> None:
    calls: list[tuple[np.ndarray, int]] = []

    class Loop:
        y = np.zeros(1)

        def rhs(self, t: float, y: np.ndarray) -> np.ndarray:
            return np.ones(1)

        def seconds(self, states: np.ndarray, rounds: int) -> float:
            calls.append((states, rounds))
            return 1e-3 / rounds

    states = motion(Loop())
    assert states[:5, 0] == pytest.approx([0.0, 1e-4, 2e-4, 3e-4, 4e-4])
    assert states[:5, 1] == pytest.approx([0.0, 1e-4, 2e-4, 3e-4, 4e-4])
    assert seconds(Loop()) == pytest.approx(1e-3 / 15)  # of 0.02 s a round
    assert [rounds for _, rounds in calls] == [1, 15]
    assert all(np.array_equal(timed, states) for timed, _ in calls)


def test_the_states_that_are_timed_are_those_of_the_motion() -> None:
    scene = load_scene("five_bar/swing", {"formulation": "reduced", "t_end": 0.0019, "solver.output_dt": 1e-4})
    ready = prepare(scene)
    ready.begin()
    states, run = motion(ready.loop), simulate(scene)
    q = [run.column(name) for name in run.independent]
    assert_close(states[:, 0], run.t, 1e-15)
    assert_close(states[:, 1:], np.hstack([run.q_tree[:, q], run.v_tree[:, q]]), 1e-8)
    assert 0 < seconds(ready.loop) < 1e-2


def test_exponents_are_in_the_sentences() -> None:
    rows = [
        growth.Growth(key=f"{x}", family="N", formulation="dae", x=x, rhs_s=1e-6 * x**2, rhs=100)
        for x in (1, 2, 4, 8, 16)
    ]
    text = "\n".join(growth_said(rows, {}))
    assert "N squares in a row, one freedom: a right-hand side's time grows with the power of N: DAE: 2.0" in text
    assert "the number of them with 0.00" in text
