"""Measurements of unused modules and terms, and of the growth of cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ckc_pin.kinematics.loading import load
from ckc_pin.run.prepare import prepare
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.scene import load_scene
from scripts.experiments.benchmark import growth, left_out
from scripts.experiments.benchmark.left_out import module_costs, modules_of, terms_of
from tests.conftest import assert_close

# --- unused modules and terms ----------------------------------------------------------------------------------------


def test_right_hand_sides_evaluate_only_needed_terms() -> None:
    used = {
        (scene, formulation): {row.what for row in terms_of(scene, {"formulation": formulation}) if row.used}
        for scene, formulation in (
            ("five_bar/swing", "dae"), ("five_bar/swing", "reduced"), ("five_bar/tracking", "reduced")
        )
    }  # fmt: skip
    for names in used.values():
        assert not names & {"ρ̇", "C", "λ", "energy"}
    assert "σ" not in used["five_bar/swing", "dae"]
    assert "σ" in used["five_bar/swing", "reduced"]
    assert "C'" not in used["five_bar/swing", "reduced"]
    assert "C'" in used["five_bar/tracking", "reduced"]  # eq. 16 needs C


def test_unused_term_would_cost_time_and_memory() -> None:
    rows = list(terms_of("andrews"))
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
    assert list(by_name) == list(left_out.TERMS)


def test_scene_that_cannot_start_gives_reason() -> None:
    rows = list(terms_of("five_bar/swing", {"initial.q.theta_1": 3.0, "initial.q.theta_3": 0.1}))
    assert [row.what for row in rows] == list(left_out.TERMS)
    assert all(row.reason and row.seconds is None for row in rows)


def test_imported_modules_are_detected_in_fresh_interpreter() -> None:
    assert {row.what: row.used for row in modules_of("five_bar/swing", ["msgspec", "this", "no_such"])} == {
        "msgspec": True, "this": False, "no_such": False,
    }  # fmt: skip
    assert all(row.reason for row in modules_of("no_such_scene"))
    big, no = module_costs(1, {"big": ("import numpy; x = numpy.ones(2**22)", ""), "no": ("1 / 0", "")})
    assert big.bytes is not None
    assert 2**25 - 2**16 <= big.bytes < 2**26  # memory is counted in pages, some of which the interpreter releases
    assert big.seconds is not None
    assert big.seconds > 0
    assert "ZeroDivisionError" in no.reason
    assert no.seconds is None


def test_all_shipped_scenes_are_measured() -> None:
    scenes = left_out.every_scene()
    assert {"five_bar/swing", "n_four_bar/default", "talos/squat"} <= set(scenes)
    assert all(load_scene(scene) for scene in scenes)


# --- growth of cost -----------------------------------------------------------------------------------------------


@given(p=st.floats(-3, 3), factor=st.floats(1e-6, 1e3))
def test_exponent_of_power_law_is_fitted(p: float, factor: float) -> None:
    points = {float(x): factor * x**p for x in (1, 2, 4, 8, 16, 40)}
    assert growth.exponent(points, whole=True) == pytest.approx(p, abs=1e-9)
    assert growth.exponent(points) == pytest.approx(p, abs=1e-9)
    bent = {x: y if x >= 6.3 else 10 * y for x, y in points.items()}  # the lower half does not count
    assert growth.exponent(bent) == pytest.approx(p, abs=1e-9)
    assert growth.exponent({1.0: 1.0, 2.0: 2.0}) is None
    assert growth.exponent({}) is None


@pytest.mark.parametrize(("N", "loops"), [(3, 3), (3, 1), (4, 2)])
def test_case_has_stated_loops_and_freedoms(N: int, loops: int, tmp_path: Path) -> None:
    case = growth.Case(N, loops)
    mechanism = prepare(load_scene(growth.write_case(case, tmp_path))).mechanism
    assert (mechanism.n, mechanism.d) == (2 * N + 1, case.d)
    assert len(mechanism.spec.loop) == loops
    assert np.abs(mechanism.assembled.phi).max() < 1e-12


def test_case_has_time_and_number_of_right_hand_sides() -> None:
    family = growth.FAMILIES[0]
    for formulation in growth.FORMULATIONS:
        row = growth.measure(growth.Case(2, 2), family, formulation)
        assert (row.reason, row.x) == ("", 2)
        assert row.rhs_s is not None
        assert row.rhs_s > 0
        assert row.rhs is not None
        assert row.rhs > 50


@pytest.mark.parametrize(("overrides", "timed"), [({"solver.max_rhs": 20}, True), ({"formulation": "none"}, False)])
def test_failing_case_gives_reason(overrides: dict[str, object], timed: bool) -> None:
    row = growth.measure(growth.Case(2, 2), growth.FAMILIES[0], "dae", overrides)
    assert row.rhs is None
    assert (row.rhs_s is not None) == timed
    assert row.reason


def test_timed_states_are_on_the_motion() -> None:
    scene = load_scene("five_bar/swing", {"formulation": "reduced", "t_end": 0.0019, "solver.output_dt": 1e-4})
    ready = prepare(scene)
    ready.begin()
    states, run = growth.motion(ready.loop), simulate(scene)
    q = [run.column(name) for name in run.independent]
    assert_close(states[:, 0], run.t, 1e-15)
    assert_close(states[:, 1:], np.hstack([run.q_tree[:, q], run.v_tree[:, q]]), 1e-8)
