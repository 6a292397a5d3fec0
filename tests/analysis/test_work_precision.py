"""Work-precision comparison: references and errors against independent solutions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin import InputError, as_ivp, load, load_scene, simulate
from ckc_pin.analysis.precision import PrecisionRow, WorkPrecision, work_precision
from ckc_pin.analysis.precision.compute import advise_settings
from ckc_pin.analysis.precision.motion import INSTANTS, Motion, list_settings
from ckc_pin.analysis.precision.mujoco import load_model
from ckc_pin.analysis.precision.reference import Reference, find_confirmed_span, find_reference
from ckc_pin.cli.options import read_overrides
from ckc_pin.formats.exporting import export
from ckc_pin.scene.parts import load_scene_mechanism
from tests.analysis.one_run import time_by_one_run
from tests.analysis.swing_table import START, pendulum, write_table
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

BUDGET_S, FULL_BUDGET_S = 4.0, 60.0  # within the full budget all settings are run


ALL_SETTINGS = 4 * (11 + 11 + 6 + 6)  # formulations times tolerances of each method


@pytest.fixture(scope="module", autouse=True)
def one_run() -> Iterator[None]:
    """Time each setting by one run; tests/contract/test_scene_from_python.py repeats runs as users' reports do."""
    with time_by_one_run():
        yield


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_table(tmp_path_factory.mktemp("own") / "table")


@pytest.fixture(scope="module")
def result(table: Path) -> WorkPrecision:
    mjcf = export(load(table / "mechanism.toml"), "mjcf").text
    return work_precision(table, budget=FULL_BUDGET_S, mjcf=mjcf)


def reference_of(result: WorkPrecision) -> Reference:
    assert result.reference is not None
    return result.reference


def find_scene_reference(scene: str | Path, overrides: dict[str, Any] | None = None, seconds: float = 3.0) -> Reference:
    loaded = load_scene(scene, overrides)
    reference = find_reference(loaded, load_scene_mechanism(loaded), seconds)
    assert isinstance(reference, Reference), reference
    return reference


def run_setting(scene: str | Path, row: PrecisionRow, t_end: float) -> Any:
    return simulate(scene, {**row.overrides, "t_end": t_end, "solver.output_dt": t_end / INSTANTS})


# --- references ------------------------------------------------------------------------------------


def test_reference_of_a_users_pendulum_is_the_analytic_solution(result: WorkPrecision) -> None:
    reference = reference_of(result)
    q_tree, v_tree = pendulum(reference.t)
    assert reference.t_end == 1.5
    assert reference.accuracy < 1e-11
    assert_close(reference.motion.q_tree, q_tree, 1e-11)
    assert_close(reference.motion.v_tree, v_tree, 1e-11)


def test_reference_of_the_five_bar_equals_numpy_and_scipy() -> None:
    """SciPy integrates the independent angles of the NumPy five-bar; its own sigma gives the dependent ones."""
    reference = find_scene_reference("five_bar/swing", {"t_end": 0.5})
    start = simulate("five_bar/swing", {"t_end": 1e-9})
    y0 = np.concatenate([start.q_tree[0, [0, 2]], start.v_tree[0, [0, 2]]])

    def f(_: float, y: Any) -> Any:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    solved = solve_ivp(f, (0.0, 0.5), y0, "DOP853", t_eval=reference.t, rtol=1e-12, atol=1e-14)
    for y, q_tree, v_tree in zip(solved.y.T, reference.motion.q_tree, reference.motion.v_tree, strict=True):
        theirs = FIVE_BAR.sigma(y[:2])
        assert_close(np.cos(q_tree), np.cos(theirs), 1e-10)
        assert_close(np.sin(q_tree), np.sin(theirs), 1e-10)
        assert_close(v_tree, FIVE_BAR.rho(theirs) @ y[2:], 1e-9)


def test_reference_off_the_manifold_is_the_spf() -> None:
    """Eq. 8 as printed, integrated by SciPy. The reduced model has another motion, which a note says."""
    overrides = {"formulation": "spf", "initial.w": [0.01, -0.005], "epsilon": 0.05, "t_end": 0.3}
    result = work_precision("five_bar/swing", overrides, budget=BUDGET_S)
    reference = reference_of(result)
    problem = as_ivp("five_bar/swing", {**overrides, "spf_coordinates": "z"})
    solved = solve_ivp(problem.f, (0.0, 0.3), problem.y0, "DOP853", t_eval=reference.t, rtol=1e-11, atol=1e-13)
    q_tree = np.array([problem.terms(t, y).q_tree for t, y in zip(reference.t, solved.y.T, strict=True)])
    assert_close(reference.motion.q_tree, q_tree, 1e-9)
    assert {row.formulation for row in result.rows} == {"spf, w", "spf, z"}
    reduced = simulate("five_bar/swing", {"formulation": "reduced", "t_end": 0.3, "solver.output_dt": 0.3 / INSTANTS})
    assert result.model_difference is not None
    assert result.model_difference >= np.abs(reduced.q_tree - q_tree).max() / np.abs(q_tree).max() > 1e-3
    assert any("difference of models" in note for note in result.notes)


def test_motion_is_compared_up_to_a_stopping_event(table: Path) -> None:
    """The table stops at the bottom, a quarter of a period after its release."""
    event = {"coordinate": "alpha", "value": 0.0, "stop": True}
    reference = find_scene_reference(table, {"event": [event]})
    t = np.linspace(0, 1.5, 30001)
    quarter = float(t[np.argmax(pendulum(t)[0][:, 0] < 0)])
    assert reference.t_end == pytest.approx(quarter, abs=1e-4)
    assert abs(reference.motion.q_tree[-1, 0]) < 1e-9
    assert "compared up to the event" in reference.notes[0]


def test_motion_is_compared_up_to_a_singularity() -> None:
    """The misprinted five-bar leaves its workspace at 4.393 s (docs/errata.md), where every run stops."""
    result = work_precision("five_bar_as_printed/tracking", budget=BUDGET_S)
    reference = reference_of(result)
    assert 3.5 < reference.t_end < 4.393
    assert len(reference.t) < INSTANTS + 1
    assert "as far as the reference is confirmed" in reference.notes[-1]
    done = [row for row in result.rows if row.status == "done"]
    assert done
    assert all(row.error is not None for row in done)


def test_confirmed_span_ends_where_motions_diverge() -> None:
    """They differ by 1e-14 exp(8 t), as a chaotic motion with rounding errors does."""
    mechanism = load("five_bar")
    t = np.linspace(0, 4, INSTANTS + 1)
    one = Motion("done", "", np.zeros((len(t), 4)), np.zeros((len(t), 4)))
    other = replace(one, q_tree=one.q_tree + 1e-14 * np.exp(8 * t)[:, None])
    last, accuracy = find_confirmed_span(mechanism, one, other)
    expected = int(np.flatnonzero(1e-14 * np.exp(8 * t) <= 1e-6)[-1])
    assert last == expected < INSTANTS
    assert accuracy == pytest.approx(1e-14 * np.exp(8 * t[expected]), rel=1e-6)
    blown_up = replace(one, v_tree=np.where(t[:, None] > 1.0, np.nan, one.v_tree))
    assert t[find_confirmed_span(mechanism, one, blown_up)[0]] == 1.0


def test_equal_steps_of_two_methods_do_not_confirm_each_other() -> None:
    """The chain of squares loses rank, which only the DAE passes; its "auto" takes the steps of DOP853."""
    reference = find_scene_reference("n_four_bar", {"mechanism.N": 1, "t_end": 1.0})
    methods = {name.split(", ")[1] for name in (reference.source, reference.confirmed_by)}
    assert methods in ({"auto", "Radau"}, {"DOP853", "Radau"})


def test_comparison_stops_without_a_reference() -> None:
    result = work_precision("five_bar/swing", budget=1e-6)
    assert (result.status, result.rows, result.reference, result.advice) == ("stopped", [], None, [])
    assert result.message.startswith("no reference could be confirmed")


# --- rows ------------------------------------------------------------------------------------------


def test_errors_equal_those_against_the_analytic_solution(result: WorkPrecision, table: Path) -> None:
    reference = reference_of(result)
    q_tree, v_tree = pendulum(reference.t)
    settings = [("reduced", "auto", 1e-4), ("dae", "RK45", 1e-6), ("spf, z", "Radau", 1e-4), ("spf, w", "DOP853", 1e-3)]
    rows = {(row.formulation, row.method, row.rtol): row for row in result.rows}
    for formulation, method, rtol in settings:
        row = next(x for key, x in rows.items() if key[:2] == (formulation, method) and np.isclose(key[2] or 0, rtol))
        run = run_setting(table, row, 1.5)
        off_q, off_v = np.abs(run.q_tree - q_tree).max(), np.abs(run.v_tree - v_tree).max()
        assert row.error_q == pytest.approx(off_q, abs=1e-11)
        assert row.error_v == pytest.approx(off_v, abs=1e-11)
        scaled = max(off_q / max(1.0, START), off_v / max(1.0, np.abs(v_tree).max()))
        assert row.error == pytest.approx(scaled, abs=1e-11)
        assert row.rhs == run.stats["rhs"]


def test_every_setting_has_a_row(result: WorkPrecision) -> None:
    ours = [row for row in result.rows if row.program == "ckc_pin"]
    assert len(ours) == ALL_SETTINGS == len({(row.formulation, row.method, row.rtol) for row in ours})
    assert {row.formulation for row in ours} == {"dae", "reduced", "spf, w", "spf, z"}
    assert {row.method for row in ours} == {"auto", "DOP853", "RK45", "Radau"}


def test_errors_fall_with_the_tolerance(result: WorkPrecision) -> None:
    for formulation in ("dae", "reduced", "spf, w"):
        rows = [row for row in result.rows if row.formulation == formulation and row.method == "auto"]
        by_rtol = {round(-np.log10(row.rtol or 1)): row for row in rows}
        errors = [by_rtol[k].error for k in (3, 6, 9)]
        assert all(error is not None for error in errors)
        assert all((later or 0.0) < (earlier or 0.0) / 10 for earlier, later in pairwise(errors))


def test_errors_near_the_accuracy_of_the_reference_are_unresolved(result: WorkPrecision) -> None:
    accuracy = reference_of(result).accuracy
    for row in result.rows:
        assert row.resolved == (None if row.error is None else row.error > 10 * accuracy)


def test_spf_of_eq_17_equals_the_reduced_model_on_the_manifold(result: WorkPrecision) -> None:
    errors: dict[str, dict[Any, Any]] = {"reduced": {}, "spf, w": {}}
    for row in result.rows:
        if row.formulation in errors and row.status == "done":
            errors[row.formulation][row.method, row.rtol] = (row.error, row.rhs)
    both = errors["reduced"].keys() & errors["spf, w"].keys()
    assert len(both) > 10
    assert all(errors["reduced"][key] == errors["spf, w"][key] for key in both)


def test_refused_settings_stay_in_the_rows() -> None:
    """Eq. 8 does not support the rotation of a free root, and the rows have this reason."""
    result = work_precision("two_ur5", {"t_end": 0.05}, budget=BUDGET_S)
    refused = [row for row in result.rows if row.formulation == "spf, z"]
    assert len(refused) == ALL_SETTINGS // 4
    assert {row.status for row in refused} == {"refused"}
    assert all("free root" in row.reason and row.error is None and row.wall_s is None for row in refused)
    assert any(row.status == "done" for row in result.rows)


def test_small_budget_leaves_out_settings_with_a_note() -> None:
    result = work_precision("five_bar/swing", budget=0.2)
    status = Counter(row.status for row in result.rows)
    assert sum(status.values()) == ALL_SETTINGS
    assert status["not tried"] > 0
    late = sum("the budget is used up" in row.reason for row in result.rows)
    assert f"{late} settings were not tried, because the budget was used up" in result.notes


def test_atol_of_the_scene_is_replaced_with_rtol() -> None:
    scene = load_scene("five_bar/swing", {"solver.atol": 1e-3})
    for setting in list_settings(scene):
        assert setting.overrides(scene)["solver.atol"] == pytest.approx(setting.rtol / 100)


def test_keys_of_the_dae_only_are_removed(result: WorkPrecision) -> None:
    """Only the DAE accepts the key of Baumgarte's stabilization."""
    scene = load_scene(
        "five_bar/swing", {"formulation": "dae", "solver.projection": False, "solver.baumgarte": [5.0, 5.0]}
    )
    for setting in list_settings(scene):
        taken_out = [key for key, x in setting.overrides(scene).items() if x is None]
        assert taken_out == ([] if setting.formulation == "dae" else ["solver.baumgarte"])
    row = replace(
        result.rows[0], overrides={"formulation": "reduced", "solver.baumgarte": None}, error=1e-5, wall_s=1e-9
    )
    advice = advise_settings([row], 1e-12)[0]
    assert (advice.options, advice.removed) == (["formulation=reduced"], ["solver.baumgarte"])


def test_sampled_controller_is_compared() -> None:
    result = work_precision("five_bar/set_point", {"t_end": 0.2, "controller.sample_time": 0.02}, budget=BUDGET_S)
    assert reference_of(result).t_end == 0.2
    assert any(row.status == "done" and row.error is not None and row.error < 1e-6 for row in result.rows)


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_budget_is_refused(budget: float) -> None:
    with pytest.raises(InputError, match="above zero"):
        work_precision("five_bar/swing", budget=budget)


# --- advice ----------------------------------------------------------------------------------------


def test_advised_options_meet_the_error(result: WorkPrecision, table: Path) -> None:
    q_tree, v_tree = pendulum(reference_of(result).t)
    assert [advice.target for advice in result.advice] == [1e-3, 1e-6, 1e-9]
    for advice in result.advice:
        assert advice.row is not None, advice.reason
        run = simulate(table, {**read_overrides("--set", advice.options), "solver.output_dt": 1.5 / INSTANTS})
        assert np.abs(run.q_tree - q_tree).max() <= advice.target
        assert np.abs(run.v_tree - v_tree).max() <= advice.target * max(1.0, np.abs(v_tree).max())
        assert run.scene["formulation"] == str(advice.row.formulation).partition(",")[0]


def test_advised_setting_is_the_fastest_within_the_error(result: WorkPrecision) -> None:
    accuracy = reference_of(result).accuracy
    for advice in result.advice:
        assert advice.row is not None
        assert advice.row.wall_s is not None
        wall_times = [
            row.wall_s
            for row in result.rows
            if row.program == "ckc_pin" and row.error is not None and row.error + accuracy <= advice.target
        ]
        assert advice.row.wall_s <= 1.1 * min(x for x in wall_times if x is not None)


def test_no_advice_below_the_accuracy_of_the_reference(result: WorkPrecision) -> None:
    advice = {each.target: each for each in advise_settings(result.rows, 1e-7)}
    assert advice[1e-6].row is not None
    assert advice[1e-9].row is None
    assert "accurate to 1.0e-07 only" in advice[1e-9].reason


# --- MuJoCo ----------------------------------------------------------------------------------------


def test_error_of_mujoco_falls_with_its_step(result: WorkPrecision, table: Path) -> None:
    """With stiffness coupled to the step, the motion converges to the pendulum's."""
    rows = [row for row in result.rows if row.program == "MuJoCo" and row.method == "RK4, solref 2 dt"]
    done = [(row.dt, row.error) for row in rows if row.error is not None and row.error > 1e-9]
    assert len(done) >= 4
    steps, errors = zip(*done, strict=True)
    assert list(steps) == sorted(steps, reverse=True)
    assert all(later < earlier for earlier, later in pairwise(errors))
    assert errors[-1] < errors[0] / 8
    assert all(row.formulation is None and row.rtol is None and not row.overrides for row in rows)


def test_unsupported_scene_is_not_run_in_mujoco() -> None:
    mjcf = export(load("five_bar"), "mjcf").text
    result = work_precision("five_bar/set_point", {"t_end": 0.05}, budget=1.0, mjcf=mjcf)
    assert {row.program for row in result.rows} == {"ckc_pin"}
    assert any(note.startswith("MuJoCo is not compared: the scene's controller") for note in result.notes)


def test_loaded_mujoco_model_keeps_friction_and_stops(table: Path) -> None:
    """Each adds a row to MuJoCo's constraints, so the compared mechanism is the same."""
    mechanism = load(table / "mechanism.toml")
    joint = mechanism.coordinates[0]
    model = load_model(export(mechanism, "mjcf").text)
    root = ElementTree.fromstring(export(mechanism, "mjcf").text)
    root.find(f".//joint[@name='{joint}']").attrib.update(frictionloss="0.1", range="-9 -8", limited="true")
    with_friction = load_model(ElementTree.tostring(root, encoding="unicode"))
    for variant, count in ((model, 0), (with_friction, 1)):
        data = mujoco.MjData(variant)
        mujoco.mj_forward(variant, data)
        assert (data.nf, data.nl) == (count, count)


def test_different_mechanism_in_mujoco_is_noted(table: Path) -> None:
    heavier = export(load(table / "mechanism.toml"), "mjcf").text.replace('mass="2.5"', 'mass="2.6"')
    result = work_precision(table, {"t_end": 0.05}, budget=1.0, mjcf=heavier)
    assert {row.program for row in result.rows} == {"ckc_pin"}
    assert any("its mass matrix or its forces at the start differ" in note for note in result.notes)


def test_result_serializes_to_json(result: WorkPrecision) -> None:
    from ckc_pin.base.summary import to_json

    data = result.to_dict()
    assert len(data["rows"]) == len(result.rows)
    assert to_json(data)
