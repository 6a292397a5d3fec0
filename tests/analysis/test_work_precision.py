"""Work against precision: references and errors against solutions that the package has no part in."""

from __future__ import annotations

from collections import Counter
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
from ckc_pin.analysis.precision import PrecisionRow, WorkPrecision, precision_plain, work_precision
from ckc_pin.analysis.precision.compute import advise
from ckc_pin.analysis.precision.motion import INSTANTS, Motion, settings
from ckc_pin.analysis.precision.mujoco import model_of
from ckc_pin.analysis.precision.reference import Reference, confirm, find_reference
from ckc_pin.cli.arguments import read_overrides
from ckc_pin.formats.exporting import export
from ckc_pin.scene.parts import scene_mechanism
from tests.analysis.swing_table import START, pendulum, write_table
from tests.analytic.five_bar import FIVE_BAR
from tests.conftest import assert_close

BUDGET, ENOUGH = 4.0, 60.0  # s; with enough all settings are tried
ALL = 4 * (11 + 11 + 6 + 6)  # formulations times tolerances of each method


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_table(tmp_path_factory.mktemp("own") / "table")


@pytest.fixture(scope="module")
def found(table: Path) -> WorkPrecision:
    mjcf = export(load(table / "mechanism.toml"), "mjcf").text
    return work_precision(table, budget=ENOUGH, mjcf=mjcf)


def reference_of(found: WorkPrecision) -> Reference:
    assert found.reference is not None
    return found.reference


def of_scene(scene: str | Path, overrides: dict[str, Any] | None = None, seconds: float = 3.0) -> Reference:
    loaded = load_scene(scene, overrides)
    reference = find_reference(loaded, scene_mechanism(loaded), seconds)
    assert isinstance(reference, Reference), reference
    return reference


def again(scene: str | Path, row: PrecisionRow, t_end: float) -> Any:
    return simulate(scene, {**row.overrides, "t_end": t_end, "solver.output_dt": t_end / INSTANTS})


# --- references ------------------------------------------------------------------------------------


def test_the_reference_of_ones_own_mechanism_is_the_pendulum(found: WorkPrecision) -> None:
    reference = reference_of(found)
    q_tree, v_tree = pendulum(reference.t)
    assert reference.t_end == 1.5
    assert reference.accuracy < 1e-11
    assert_close(reference.motion.q_tree, q_tree, 1e-11)
    assert_close(reference.motion.v_tree, v_tree, 1e-11)


def test_the_reference_of_the_five_bar_is_the_one_in_numpy() -> None:
    """The independent five-bar integrated by SciPy, its dependent angles by its own sigma."""
    reference = of_scene("five_bar/swing", {"t_end": 0.5})
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


def test_off_the_manifold_the_reference_is_the_spfs_own() -> None:
    """Eq. 8 as printed, in NumPy and by SciPy; the reduced model is another motion, and told as one."""
    overrides = {"formulation": "spf", "initial.w": [0.01, -0.005], "epsilon": 0.05, "t_end": 0.3}
    found = work_precision("five_bar/swing", overrides, budget=BUDGET)
    reference = reference_of(found)
    problem = as_ivp("five_bar/swing", {**overrides, "spf_coordinates": "z"})
    solved = solve_ivp(problem.f, (0.0, 0.3), problem.y0, "DOP853", t_eval=reference.t, rtol=1e-11, atol=1e-13)
    q_tree = np.array([problem.terms(t, y).q_tree for t, y in zip(reference.t, solved.y.T, strict=True)])
    assert_close(reference.motion.q_tree, q_tree, 1e-9)
    assert {row.formulation for row in found.rows} == {"spf, w", "spf, z"}
    reduced = simulate("five_bar/swing", {"formulation": "reduced", "t_end": 0.3, "solver.output_dt": 0.3 / INSTANTS})
    assert found.model_difference is not None
    assert found.model_difference >= np.abs(reduced.q_tree - q_tree).max() / np.abs(q_tree).max() > 1e-3
    assert any("difference of models" in note for note in found.notes)


def test_a_motion_with_an_end_is_compared_up_to_there(table: Path) -> None:
    """The table stops at the bottom, a quarter of a period after it is let go."""
    event = {"coordinate": "alpha", "value": 0.0, "stop": True}
    reference = of_scene(table, {"event": [event]})
    t = np.linspace(0, 1.5, 30001)
    quarter = float(t[np.argmax(pendulum(t)[0][:, 0] < 0)])
    assert reference.t_end == pytest.approx(quarter, abs=1e-4)
    assert abs(reference.motion.q_tree[-1, 0]) < 1e-9
    assert "compared up to the event" in reference.notes[0]


def test_what_stops_is_compared_up_to_there() -> None:
    """The misprinted five-bar leaves its workspace at 4.393 s (docs/errata.md); no run gets past."""
    found = work_precision("five_bar_as_printed/tracking", budget=BUDGET)
    reference = reference_of(found)
    assert 3.5 < reference.t_end < 4.393
    assert len(reference.t) < INSTANTS + 1
    assert "as far as the reference is confirmed" in reference.notes[-1]
    done = [row for row in found.rows if row.status == "done"]
    assert done
    assert all(row.error is not None for row in done)


def test_where_two_motions_part() -> None:
    """Apart by 1e-14 exp(8 t), as a chaotic motion and its rounding errors are."""
    mechanism = load("five_bar")
    t = np.linspace(0, 4, INSTANTS + 1)
    one = Motion("done", "", np.zeros((len(t), 4)), np.zeros((len(t), 4)))
    other = replace(one, q_tree=one.q_tree + 1e-14 * np.exp(8 * t)[:, None])
    last, accuracy = confirm(mechanism, one, other)
    expected = int(np.flatnonzero(1e-14 * np.exp(8 * t) <= 1e-6)[-1])
    assert last == expected < INSTANTS
    assert accuracy == pytest.approx(1e-14 * np.exp(8 * t[expected]), rel=1e-6)
    blown_up = replace(one, v_tree=np.where(t[:, None] > 1.0, np.nan, one.v_tree))
    assert t[confirm(mechanism, one, blown_up)[0]] == 1.0


def test_a_run_is_not_confirmed_by_itself() -> None:
    """The squares' chain loses rank, which only the DAE gets over: its "auto" steps are DOP853's."""
    reference = of_scene("n_four_bar", {"mechanism.N": 1, "t_end": 1.0})
    methods = {name.split(", ")[1] for name in (reference.of, reference.by)}
    assert methods in ({"auto", "Radau"}, {"DOP853", "Radau"})


def test_nothing_is_compared_without_a_reference() -> None:
    found = work_precision("five_bar/swing", budget=1e-6)
    assert (found.status, found.rows, found.reference, found.advice) == ("stopped", [], None, [])
    assert found.message.startswith("no reference could be confirmed")


# --- rows ------------------------------------------------------------------------------------------


def test_errors_are_those_against_the_pendulum(found: WorkPrecision, table: Path) -> None:
    reference = reference_of(found)
    q_tree, v_tree = pendulum(reference.t)
    wanted = [("reduced", "auto", 1e-4), ("dae", "RK45", 1e-6), ("spf, z", "Radau", 1e-4), ("spf, w", "DOP853", 1e-3)]
    rows = {(row.formulation, row.method, row.rtol): row for row in found.rows}
    for formulation, method, rtol in wanted:
        row = next(x for key, x in rows.items() if key[:2] == (formulation, method) and np.isclose(key[2] or 0, rtol))
        run = again(table, row, 1.5)
        off_q, off_v = np.abs(run.q_tree - q_tree).max(), np.abs(run.v_tree - v_tree).max()
        assert row.error_q == pytest.approx(off_q, abs=1e-11)
        assert row.error_v == pytest.approx(off_v, abs=1e-11)
        scaled = max(off_q / max(1.0, START), off_v / max(1.0, np.abs(v_tree).max()))
        assert row.error == pytest.approx(scaled, abs=1e-11)
        assert row.rhs == run.stats["rhs"]


def test_every_setting_has_a_row(found: WorkPrecision) -> None:
    own = [row for row in found.rows if row.program == "ckc_pin"]
    assert len(own) == ALL == len({(row.formulation, row.method, row.rtol) for row in own})
    assert {row.formulation for row in own} == {"dae", "reduced", "spf, w", "spf, z"}
    assert {row.method for row in own} == {"auto", "DOP853", "RK45", "Radau"}


def test_tighter_tolerances_err_less(found: WorkPrecision) -> None:
    for formulation in ("dae", "reduced", "spf, w"):
        rows = [row for row in found.rows if row.formulation == formulation and row.method == "auto"]
        by_rtol = {round(-np.log10(row.rtol or 1)): row for row in rows}
        errors = [by_rtol[k].error for k in (3, 6, 9)]
        assert all(error is not None for error in errors)
        assert all((later or 0.0) < (earlier or 0.0) / 10 for earlier, later in pairwise(errors))


def test_what_the_reference_cannot_tell_is_said(found: WorkPrecision) -> None:
    accuracy = reference_of(found).accuracy
    for row in found.rows:
        assert row.resolved == (None if row.error is None else row.error > 10 * accuracy)


def test_eq_17s_spf_is_the_reduced_model_on_the_manifold(found: WorkPrecision) -> None:
    errors: dict[str, dict[Any, Any]] = {"reduced": {}, "spf, w": {}}
    for row in found.rows:
        if row.formulation in errors and row.status == "done":
            errors[row.formulation][row.method, row.rtol] = (row.error, row.rhs)
    both = errors["reduced"].keys() & errors["spf, w"].keys()
    assert len(both) > 10
    assert all(errors["reduced"][key] == errors["spf, w"][key] for key in both)


def test_failures_stay_in_the_data() -> None:
    """Eq. 8 cannot have a free root's rotation in it, and the rows say so."""
    found = work_precision("two_ur5", {"t_end": 0.05}, budget=BUDGET)
    refused = [row for row in found.rows if row.formulation == "spf, z"]
    assert len(refused) == ALL // 4
    assert {row.status for row in refused} == {"refused"}
    assert all("free root" in row.reason and row.error is None and row.wall_s is None for row in refused)
    assert any(row.status == "done" for row in found.rows)


def test_a_small_budget_leaves_out_rows_and_says_so() -> None:
    found = work_precision("five_bar/swing", budget=0.8)
    status = Counter(row.status for row in found.rows)
    assert sum(status.values()) == ALL
    assert status["not tried"] > 0
    late = sum("the budget was used up" in row.reason for row in found.rows)
    assert f"{late} settings were not tried: the budget was used up before" in found.notes


def test_a_scenes_own_atol_goes_with_its_rtol() -> None:
    scene = load_scene("five_bar/swing", {"solver.atol": 1e-3})
    for setting in settings(scene):
        assert setting.overrides(scene)["solver.atol"] == pytest.approx(setting.rtol / 100)


def test_what_only_a_dae_has_is_to_be_taken_out(found: WorkPrecision) -> None:
    """A scene with Baumgarte's stabilization: no other formulation takes that key."""
    scene = load_scene(
        "five_bar/swing", {"formulation": "dae", "solver.projection": False, "solver.baumgarte": [5.0, 5.0]}
    )
    for setting in settings(scene):
        taken_out = [key for key, x in setting.overrides(scene).items() if x is None]
        assert taken_out == ([] if setting.formulation == "dae" else ["solver.baumgarte"])
    row = replace(
        found.rows[0], overrides={"formulation": "reduced", "solver.baumgarte": None}, error=1e-5, wall_s=1e-9
    )
    advice = advise([row], 1e-12)[0]
    assert (advice.options, advice.removed) == (["formulation=reduced"], ["solver.baumgarte"])


def test_a_sampled_controller_is_compared_too() -> None:
    found = work_precision("five_bar/set_point", {"t_end": 0.2, "controller.sample_time": 0.02}, budget=BUDGET)
    assert reference_of(found).t_end == 0.2
    assert any(row.status == "done" and row.error is not None and row.error < 1e-6 for row in found.rows)


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_that_is_none_is_refused(budget: float) -> None:
    with pytest.raises(InputError, match="above zero"):
        work_precision("five_bar/swing", budget=budget)


# --- advice ----------------------------------------------------------------------------------------


def test_the_advised_options_meet_the_error(found: WorkPrecision, table: Path) -> None:
    q_tree, v_tree = pendulum(reference_of(found).t)
    assert [advice.target for advice in found.advice] == [1e-3, 1e-6, 1e-9]
    for advice in found.advice:
        assert advice.row is not None, advice.reason
        run = simulate(table, {**read_overrides("--set", advice.options), "solver.output_dt": 1.5 / INSTANTS})
        assert np.abs(run.q_tree - q_tree).max() <= advice.target
        assert np.abs(run.v_tree - v_tree).max() <= advice.target * max(1.0, np.abs(v_tree).max())
        assert run.scene["formulation"] == str(advice.row.formulation).partition(",")[0]


def test_the_advised_setting_is_the_fastest_that_met_it(found: WorkPrecision) -> None:
    accuracy = reference_of(found).accuracy
    for advice in found.advice:
        assert advice.row is not None
        assert advice.row.wall_s is not None
        met = [
            row.wall_s
            for row in found.rows
            if row.program == "ckc_pin" and row.error is not None and row.error + accuracy <= advice.target
        ]
        assert advice.row.wall_s <= 1.1 * min(x for x in met if x is not None)


def test_no_advice_below_what_the_reference_knows(found: WorkPrecision) -> None:
    advice = {each.target: each for each in advise(found.rows, 1e-7)}
    assert advice[1e-6].row is not None
    assert advice[1e-9].row is None
    assert "only known to 1.0e-07" in advice[1e-9].reason


# --- MuJoCo ----------------------------------------------------------------------------------------


def test_mujocos_error_falls_with_its_step(found: WorkPrecision, table: Path) -> None:
    """The stiffer its loops and the finer its steps, the nearer to the pendulum."""
    rows = [row for row in found.rows if row.program == "MuJoCo" and row.method == "RK4, solref 2 dt"]
    done = [(row.dt, row.error) for row in rows if row.error is not None and row.error > 1e-9]
    assert len(done) >= 4
    steps, errors = zip(*done, strict=True)
    assert list(steps) == sorted(steps, reverse=True)
    assert all(later < earlier for earlier, later in pairwise(errors))
    assert errors[-1] < errors[0] / 8
    assert all(row.formulation is None and row.rtol is None and not row.overrides for row in rows)


def test_mujoco_is_left_out_where_it_cannot() -> None:
    mjcf = export(load("five_bar"), "mjcf").text
    found = work_precision("five_bar/set_point", {"t_end": 0.05}, budget=1.0, mjcf=mjcf)
    assert {row.program for row in found.rows} == {"ckc_pin"}
    assert any(note.startswith("MuJoCo is not beside it: the scene's controller") for note in found.notes)


def test_mujoco_has_the_friction_and_the_stops(table: Path) -> None:
    """A row of its constraints each: what is compared is the same mechanism."""
    mechanism = load(table / "mechanism.toml")
    joint = mechanism.coordinates[0]
    model = model_of(export(mechanism, "mjcf").text)
    root = ElementTree.fromstring(export(mechanism, "mjcf").text)
    root.find(f".//joint[@name='{joint}']").attrib.update(frictionloss="0.1", range="-9 -8", limited="true")
    rubbing = model_of(ElementTree.tostring(root, encoding="unicode"))
    for there, count in ((model, 0), (rubbing, 1)):
        data = mujoco.MjData(there)
        mujoco.mj_forward(there, data)
        assert (data.nf, data.nl) == (count, count)


def test_another_mechanism_in_mujoco_is_named(table: Path) -> None:
    heavier = export(load(table / "mechanism.toml"), "mjcf").text.replace('mass="2.5"', 'mass="2.6"')
    found = work_precision(table, {"t_end": 0.05}, budget=1.0, mjcf=heavier)
    assert {row.program for row in found.rows} == {"ckc_pin"}
    assert any("its mass matrix or its forces at the start differ" in note for note in found.notes)


def test_plain_data_is_json_ready(found: WorkPrecision) -> None:
    from ckc_pin.base.summary import to_json

    plain = precision_plain(found)
    assert len(plain["rows"]) == len(found.rows)
    assert to_json(plain)
