"""The stability suite: references, verdicts, and some of its cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ckc_pin import Run
from ckc_pin.kinematics import load
from scripts.experiments.stability import equations
from scripts.experiments.stability.cases import GROUPS, MODELS, PAPER, SWING
from scripts.experiments.stability.cell import Case, Cell, Variant, run_case
from scripts.experiments.stability.equations import Reduced, free_motion, to_absolute
from scripts.experiments.stability.long_runs import LONG_RUN_SETTINGS, long_run
from scripts.experiments.stability.page import TITLES, as_frame, page, satisfied, save
from scripts.experiments.stability.planar import JointSpring, LineSpring, Planar
from scripts.experiments.stability.reference import FiveBarEquations, gap
from tests.analytic.five_bar import Array, Controller, FiveBar, Q, no_control, set_point, tracking
from tests.conftest import assert_close

DOCS = Path(__file__).parents[3] / "docs"
UNEVEN = replace(PAPER.heavier((3.0, 0.2, 1.0, 5.0)), l=(0.3, 0.35, 0.25, 0.32), base=0.4)


def in_numpy(p: Planar) -> FiveBar:
    return FiveBar(p.l, p.c, p.m, p.I, p.base, p.g)


def states(model: FiveBar, count: int = 10) -> list[tuple[Array, Array]]:
    """Return closed configurations near the equilibrium with admissible rates."""
    random = np.random.default_rng(0)
    pairs = []
    for _ in range(count):
        q_tree = model.sigma(np.array([-1.4, -1.7]) + random.uniform(-0.4, 0.4, 2))
        pairs.append((q_tree, model.rho(q_tree) @ random.normal(size=2)))
    return pairs


# --- references -------------------------------------------------------------------------


@pytest.mark.parametrize("p", [PAPER, UNEVEN], ids=["paper", "uneven"])
def test_free_motion_satisfies_eq_1(p: Planar) -> None:
    """Compare the links' accelerations with the numpy five-bar and its multipliers."""
    model = in_numpy(p)
    for q_tree, v_tree in states(model):
        theirs, _ = model.acceleration_and_multipliers(q_tree, v_tree, np.zeros(2))
        y = [*to_absolute(q_tree.tolist()), *to_absolute(v_tree.tolist())]
        ours = free_motion(p)(0.0, y)
        assert_close(ours, [*y[4:], *to_absolute(theirs.tolist())], 1e-12, relative=True)


CONTROLS = {
    "none": (equations.uncontrolled, lambda model: no_control),
    "set point": (
        equations.set_point(UNEVEN, (-1.2, -1.5), 7.0, 3.0),
        lambda m: set_point(m, np.array([-1.2, -1.5]), 7.0, 3.0),
    ),
    "tracking": (equations.tracking(2.0, 5.0), lambda model: tracking(model, 2.0, 5.0)),
}


@pytest.mark.parametrize("control", CONTROLS)
def test_controlled_motion_satisfies_eq_6(control: str) -> None:
    by_hand, numpy_control = CONTROLS[control]
    model = in_numpy(UNEVEN)
    u: Controller = numpy_control(model)
    for q_tree, v_tree in states(model):
        q, q_dot = q_tree[Q].tolist(), v_tree[Q].tolist()
        now = Reduced(UNEVEN, q, q_dot)
        assert_close(np.sin(now.a), np.sin(to_absolute(q_tree.tolist())), 1e-13)
        theirs = model.acceleration(q_tree, v_tree[Q], u(0.7, q_tree, v_tree[Q]))
        assert_close(by_hand(0.7, now, q, q_dot), theirs, 1e-11, relative=True)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_spring_power_equals_damping_loss(damping: float) -> None:
    """dE/dt, including the springs' energy, equals the power of the dampers."""
    line, joint = LineSpring(50.0, damping, 0.2, 0.1, 0.15), JointSpring(2.0, damping, 0.5)
    p, model = replace(PAPER, line=line, joint=joint), in_numpy(PAPER)

    def pose(a: Array) -> tuple[Array, Array]:
        tip = model.l[0] * np.array([np.cos(a[0]), np.sin(a[0])]) + model.l[1] * np.array([np.cos(a[1]), np.sin(a[1])])
        angles = np.array([a[0], a[1] - a[0], a[2], a[3] - a[2]])
        return angles, np.linalg.norm(tip - [line.x, line.y])

    def energy(y: Array) -> float:
        (angles, length), (rates, _) = pose(y[:4]), pose(y[4:])
        stretched = line.stiffness * (length - line.rest) ** 2 + joint.stiffness * (angles[0] - joint.rest) ** 2
        return float(model.energy(angles, rates) + stretched / 2)

    for q_tree, v_tree in states(model):
        y = np.array([*to_absolute(q_tree.tolist()), *to_absolute(v_tree.tolist())])
        f, h = np.array(free_motion(p)(0.0, y)), 1e-6
        power = (energy(y + h * f) - energy(y - h * f)) / (2 * h)
        length_rate = (pose((y + h * f)[:4])[1] - pose((y - h * f)[:4])[1]) / (2 * h)
        assert power == pytest.approx(-damping * (length_rate**2 + v_tree[0] ** 2), abs=1e-7)


def test_errors_are_relative_to_the_scale_of_the_solution() -> None:
    assert gap(np.array([100.0, 0.1]), np.array([100.0, 0.0])) == pytest.approx(1e-3)
    assert gap(np.array([0.01]), np.array([0.0])) == pytest.approx(0.01)
    assert gap(np.array([np.nan]), np.array([0.0])) == np.inf


def test_written_files_equal_shipped_five_bar(tmp_path: Path) -> None:
    PAPER.write(tmp_path)
    ours, shipped = load(tmp_path / "mechanism.toml"), load("five_bar")
    assert_close(ours.q_tree, shipped.q_tree, 1e-13)
    assert ours.coordinates == shipped.coordinates


# --- verdicts ---------------------------------------------------------------------------------

SHORT_SWING = {"initial.q": {"theta_1": SWING[0], "theta_3": SWING[1]}, "t_end": 0.2, "solver.output_dt": 0.1}


def run_cell(reference: FiveBarEquations, variant: Variant = MODELS[2], **overrides: object) -> Cell:
    case = Case(
        "method",
        "short",
        "five_bar",
        {**SHORT_SWING, **{k.replace("__", "."): v for k, v in overrides.items()}},
        reference,
        (variant,),
    )
    return run_case(case)[0]


def test_accurate_run_is_within() -> None:
    cell = run_cell(FiveBarEquations(PAPER))
    assert (cell.verdict, cell.t) == ("within", 0.2)
    assert cell.error <= 1e-7 < cell.allowed
    assert cell.uncertainty <= 1e-10


def test_inaccurate_run_has_failed() -> None:
    """A link of the reference is 1 % heavier than in the run."""
    cell = run_cell(FiveBarEquations(PAPER.heavier((1.0, 1.01, 1.0, 1.0))))
    assert cell.verdict == "FAILED"
    assert cell.allowed < cell.error < 1e-2


class Open(FiveBarEquations):
    """A reference that reports |phi| = 1 mm."""

    def phi(self, run: Run) -> float:
        return 1e-3


def test_open_loops_have_failed() -> None:
    assert run_cell(Open(PAPER)).verdict == "FAILED"


def test_exhausted_budget_gives_reason() -> None:
    cell = run_cell(FiveBarEquations(PAPER), solver__max_rhs=50)
    assert cell.verdict == "stopped"
    assert "max_rhs = 50" in cell.message


def test_case_that_raises_has_failed() -> None:
    cell = run_cell(FiveBarEquations(PAPER), solver__no_such_key=1)
    assert cell.verdict == "FAILED"
    assert "no_such_key" in cell.message


def some_cells() -> list[Cell]:
    def cell(verdict: str, **more: object) -> Cell:
        return Cell("mass", "a|b", "spf", "auto: Radau", 1e-8, "by hand", verdict, **more)  # type: ignore[arg-type]

    within = [cell("within", error=1e-9, allowed=1e-5, uncertainty=1e-12, rhs=12)] * 9
    return [*within, cell("stopped", t=0.5, message="why it stopped")]


def test_satisfied_requires_nine_in_ten_and_no_failure() -> None:
    cells = some_cells()
    assert satisfied(as_frame(cells))
    assert not satisfied(as_frame(cells[1:]))
    assert not satisfied(as_frame([*cells, *cells, replace(cells[0], verdict="FAILED")]))


def test_table_round_trips_through_file(tmp_path: Path) -> None:
    cells = as_frame(some_cells())
    save(cells, tmp_path / "t.csv.gz")
    back = pd.read_csv(tmp_path / "t.csv.gz", keep_default_na=True)
    assert back.columns.tolist() == [name for name in cells.columns if name != "cpu_s"]
    assert back.verdict.tolist() == ["within"] * 9 + ["stopped"]
    assert back.error[0] == 1e-9
    assert back.message.dropna().tolist() == ["why it stopped"]


def test_page_lists_stopped_cells() -> None:
    cells = some_cells()
    renamed = [replace(cell, case=f"case {k}|") for k, cell in enumerate(cells)]
    rows = [line for line in page(as_frame(renamed), []).splitlines() if line.startswith("| case ")]
    assert len(rows) == len(renamed) + 1 + 1  # a table with a header, and why one stopped
    assert all(row.replace("\\|", "").count("|") in (3, 4) for row in rows)


# --- cells -------------------------------------------------------------------------------------


def test_case_names_are_unique_and_groups_have_titles() -> None:
    names = [(case.group, case.name) for cases in GROUPS.values() for case in cases()]
    assert len(set(names)) == len(names)
    assert {group for group, _ in names} == set(GROUPS) == set(TITLES)


def test_committed_table_has_all_cases_and_is_satisfied() -> None:
    table = pd.read_csv(DOCS / "stability.csv.gz")
    committed = list(zip(table.group, table.case, table.formulation, table.method.str.partition(":")[0], strict=True))
    cells = [
        (c.group, c.name, variant.label, variant.method)
        for cases in GROUPS.values()
        for c in cases()
        for variant in c.variants
    ]
    assert committed == cells
    assert satisfied(table)


# extreme cases by group, and the formulations to run
THINNED = {
    "epsilon": ({"1e-01, w(0) = (0.01, -0.006)", "1e-06, w(0) large", "1e-12, w(0) large"}, "spf"),
    "mass": ({"link 2 x 1e+06", "link 2 x 1e-08"}, "reduced"),
    "length": ({"base 0.001 m", "base 1000 m"}, "dae"),
    "gain": ({"set point, K_P = 1e+06, K_V = 1e+06", "tracking, K_D = 10000"}, "spf"),
    "singular": (
        {"type 1 above, 1e-01 away", "type 1 above, 1e-08 away", "type 1 below, 1e-04 away", "type 2, 1e-12 away"},
        "reduced",
    ),
    "speed": ({"1000 rad/s, apart", "crossing type 2, 12 rad/s"}, "reduced"),
    "spring": ({"line 1e+09 N/m", "line 1e+09 N/m, damped"}, "reduced"),
    "published": ({"Andrews", "Bricard at 1 s", "N-four-bar, N = 2, through rank losses"}, "dae"),
}


@pytest.mark.parametrize("group", THINNED)
def test_cells_are_within_tolerance(group: str) -> None:
    names, formulation = THINNED[group]
    cases = [case for case in GROUPS[group]() if case.name in names]
    assert len(cases) == len(names)
    for case in cases:
        variant = next(variant for variant in case.variants if variant.formulation == formulation)
        cell = run_case(replace(case, variants=(variant,)))[0]
        assert cell.verdict == "within", f"{case.name}: {cell.verdict}, error {cell.error:.1e}, {cell.message}"
        assert cell.uncertainty <= 0.1 * cell.allowed


def test_singular_start_is_rejected() -> None:
    case = next(case for case in GROUPS["singular"]() if case.name == "type 1 above, 1e-12 away")
    cells = run_case(case)
    assert {cell.verdict for cell in cells} == {"stopped"}
    assert all("start elsewhere" in cell.message for cell in cells)


def test_chart_is_changed_before_first_step() -> None:
    case = next(case for case in GROUPS["singular"]() if case.name == "type 1 above, 1e-04 away")
    assert (
        run_case(replace(case, overrides={**case.overrides, "solver.max_rhs": 1}, variants=MODELS[:1]))[0].switches == 1
    )


# --- long runs -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "formulation", "overrides"), LONG_RUN_SETTINGS[2:], ids=["swing", "across type 2"])
def test_tenth_of_long_run_has_tenth_of_drift(name: str, formulation: str, overrides: dict[str, object]) -> None:
    """A tenth of the time, a tenth of the drift."""
    run = long_run(name, formulation, overrides, 100.0)
    assert run.outcome == "done"
    assert run.drift <= 1e-9
    assert run.max_phi <= 1e-12
    assert (run.crossings > 5) == bool(overrides)
