"""The benchmark: references against published values, cached rows, and sentences that follow from the tables."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from joblib import Memory
from scipy.integrate import solve_ivp

from ckc_pin.analysis.precision.motion import Motion, Setting, motion_without_data, override_scene
from ckc_pin.errors import InputError
from ckc_pin.run.simulate import simulate
from scripts.experiments.benchmark import make, ours
from scripts.experiments.benchmark.compiled_terms import compiled_terms_cost
from scripts.experiments.benchmark.peers import peers
from scripts.experiments.benchmark.reference import Reference, reference
from scripts.experiments.benchmark.row import compare_with_reference
from scripts.experiments.benchmark.stamp import work_stamp
from scripts.experiments.benchmark.work import WORKS, Budget, Work
from tests.analytic.five_bar import FIVE_BAR, Q

SHORT_WORK = Work("short", "five-bar, free swing, 0.1 s", "five_bar/swing", 0.1, quick=True)
BY_KEY = {work.key: work for work in WORKS}
DOCS = Path(__file__).parents[3] / "docs" / "report"
LOOPS = {f"Pinocchio {algorithm}, RKF78 in C++" for algorithm in ("constraintDynamics", "lcaba")}


@pytest.fixture(scope="module")
def exact() -> Reference:
    return reference(SHORT_WORK)


# --- references ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("work", "B0"),
    [
        ("n_four_bar_1", [0.478385057760970559, 0.878150178791209301, 0.0]),
        ("n_four_bar_40", [0.180512226686728390, 0.983572740582311575, 0.0]),
    ],
)
def test_row_of_squares_matches_forty_digit_reference(work: str, B0: list[float]) -> None:
    """The values are elliptic functions by mpmath at forty digits; an independent integration agrees to 1e-11."""
    closed_form = reference(BY_KEY[work])
    assert np.abs(closed_form.values[-1] - B0).max() < 1e-13
    assert np.abs(closed_form.values[0] - [0, 1, 0]).max() < 1e-15


def test_pendulum_reference_matches_known_values() -> None:
    """The period is 4 K(1/2) / sqrt(g); the other instants are integrated by SciPy."""
    values, work = reference(BY_KEY["pendulum"]).values, BY_KEY["pendulum"]

    def rate(t: float, y: Any) -> Any:
        return [y[1], -9.81 * np.cos(y[0])]

    run = solve_ivp(rate, (0.0, 10.0), [np.pi, 0.0], "DOP853", work.instants, rtol=1e-13, atol=1e-14)
    assert np.abs(values[:, :2] - np.column_stack([np.cos(run.y[0]), np.sin(run.y[0])])).max() < 1e-10
    one_period = replace(work, t_end=2.36784194757624)
    assert np.abs(reference(one_period).values[-1] - [-1, 0, 0]).max() < 1e-13


def test_reference_without_loops_has_an_accuracy() -> None:
    flyball = reference(BY_KEY["flyball"])
    assert 1e-14 < flyball.accuracy < 1e-10
    assert "at 10 s 3e-09 from equations written by hand" in flyball.how


def test_chains_match_newton_euler_equations() -> None:
    """Two chains of 5 links in absolute coordinates: positions of rods, pins as constraints with multipliers."""
    work = BY_KEY["chains_5_5"]
    names = work.mechanism.coordinates
    bodies = [f"joint_{chain}_{k}" for chain in (1, 2) for k in range(1, 6)] + ["connecting_rod_joint"]
    parent = {f"joint_{c}_{k}": f"joint_{c}_{k - 1}" if k > 1 else None for c in (1, 2) for k in range(1, 6)}
    parent["connecting_rod_joint"] = "joint_1_2"
    root = {"joint_1_1": np.zeros(2), "joint_2_1": np.array([1.0, 0.0])}
    at = {name: 3 * k for k, name in enumerate(bodies)}
    pins = [(name, np.array([0.0, -0.5]), parent[name], np.array([0.0, 0.5])) for name in bodies]
    pins.append(("connecting_rod_joint", np.array([1.0, -0.5]), "joint_2_2", np.array([0.0, 0.5])))

    def turned(angle: float, r: Any) -> Any:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ r

    def rate(t: float, y: Any) -> Any:
        n = 3 * len(bodies)
        x, v = y[:n], y[n:]
        M = np.diag(np.tile([0.25, 0.25, 0.01], len(bodies)))
        f = np.tile([0.25 * 9.81, 0.0, 0.0], len(bodies))
        J, drift = np.zeros((2 * len(pins), n)), np.zeros(2 * len(pins))
        for row, (one, r, other, s) in enumerate(pins):
            for sign, name, local in ((1, one, r), (-1, other, s)):
                if name is not None:
                    k, arm = at[name], turned(x[at[name] + 2], local)
                    J[2 * row : 2 * row + 2, k : k + 3] += sign * np.array([[1, 0, -arm[1]], [0, 1, arm[0]]])
                    drift[2 * row : 2 * row + 2] += sign * arm * v[k + 2] ** 2
        zeros = np.zeros((len(J), len(J)))
        a = np.linalg.solve(np.block([[M, J.T], [J, zeros]]), np.concatenate([f, drift]))[:n]
        return np.concatenate([v, a])

    start, up = np.zeros(6 * len(bodies)), np.array([0.0, 0.5])
    for name in bodies:
        base, above = root.get(name), parent[name]
        low = base if base is not None else start[at[above] : at[above] + 2] + up
        start[at[name] : at[name] + 2] = low + up
    run = solve_ivp(rate, (0.0, 0.5), start, "DOP853", rtol=1e-10, atol=1e-12)
    angles = {name: run.y[at[name] + 2, -1] for name in bodies}
    theirs = [angles[name] - (angles[parent[name]] if parent[name] else 0.0) for name in names]
    ours_run = simulate(replace(work, t_end=0.5).load(formulation="dae", solver__rtol=1e-10))
    assert np.abs(ours_run.q_tree[-1] - theirs).max() < 1e-8


def test_reference_accuracy_bounds_its_error(exact: Reference) -> None:
    assert exact.values.shape == (11, 4)
    assert 0 < exact.accuracy < 1e-11

    def rate(t: float, y: Any) -> Any:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    start = np.concatenate(
        [exact.values[0][Q], [SHORT_WORK.load().spec.initial.q_dot.get(x, 0.0) for x in ("theta_1", "theta_3")]]
    )
    numpy_run = solve_ivp(rate, (0.0, SHORT_WORK.t_end), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:2, -1]
    assert np.abs(numpy_run - exact.values[-1][Q]).max() < 1e-10


# --- rows ---------------------------------------------------------------------------------------------------------


def motion(q_tree: Any, v_tree: Any = None, status: str = "done") -> Motion:
    return Motion(status, "", q_tree, np.zeros_like(q_tree) if v_tree is None else v_tree, 0.5, 0.1, steps=3)


def test_errors_are_maximum_and_end_of_run(exact: Reference) -> None:
    off = exact.values.copy()
    off[4, 1] += 3e-3
    off[-1, 2] -= 2e-4
    row = compare_with_reference(SHORT_WORK, "other", "s", motion(off), exact)
    assert row.error_max == pytest.approx(3e-3, rel=1e-6)
    assert row.error_end == pytest.approx(2e-4, rel=1e-6)
    phi = [np.abs(FIVE_BAR.phi(q_tree)).max() for q_tree in off]
    assert row.closure == pytest.approx(max(phi), rel=1e-6)


@pytest.mark.parametrize("broken", ["stopped", "nan", "short"])
def test_incomplete_motion_has_no_error(broken: str, exact: Reference) -> None:
    values = exact.values[:5] if broken == "short" else exact.values.copy()
    if broken == "nan":
        values[-1, 0] = np.nan
    row = compare_with_reference(
        SHORT_WORK, "other", "s", motion(values, status="stopped" if broken == "stopped" else "done"), exact
    )
    assert row.error_max is None
    assert row.status != "done" or broken == "short"


def test_repeated_run_gives_equal_results() -> None:
    """A measured run, from a loop that has run before, gives the result of a user's run."""
    setting = Setting("reduced", "DOP853", 1e-6)
    motion = ours.compute(SHORT_WORK, setting, 60.0)
    overrides = {"solver__method": "DOP853", "solver__rtol": 1e-6, "solver__terms": SHORT_WORK.terms}
    run = simulate(SHORT_WORK.load(formulation="reduced", **overrides))
    assert np.array_equal(motion.q_tree, run.q_tree)
    assert np.array_equal(motion.v_tree, run.v_tree)
    assert (motion.steps, motion.rhs) == (run.stats["steps"], run.stats["rhs"])
    assert motion.wall_s > 0


def test_other_programs_compute_the_same_motion(exact: Reference) -> None:
    setting = Setting("dae", "auto", 1e-8)
    row = compare_with_reference(
        SHORT_WORK, ours.PROGRAM, ours.name_of(setting), ours.compute(SHORT_WORK, setting, 60.0), exact
    )
    assert row.error_max is not None
    assert row.error_max < 1e-7
    assert row.energy_drift is not None
    assert row.energy_drift < 1e-6
    settings = {
        "MuJoCo": "RK4, solref 2 dt, dt 0.0005",
        "Exudyn": "GeneralizedAlpha, spectral radius 0.9, dt 0.0005",
        "Pinocchio constraintDynamics": "K_p 10, dt 6.25e-05",
        "SUNDIALS IDA": "rtol 1e-05",
    }
    for peer in (peer for peer in peers() if peer.name in settings):  # loops and programs have separate tests
        assert peer.missing(SHORT_WORK) is None
        assert settings[peer.name] in set(peer.settings(SHORT_WORK, quick=False))
        theirs = compare_with_reference(
            SHORT_WORK, peer.name, "s", peer.compute(SHORT_WORK, settings[peer.name], 60.0), exact
        )
        assert theirs.error_max is not None
        assert theirs.error_max < 1e-3
        assert theirs.error_max > row.error_max


@pytest.mark.parametrize("work", ["swing", "andrews", "bricard", "slider_crank"])
def test_other_programs_have_equal_mass_matrix_and_bias(work: str) -> None:
    """Equal mass matrices and biases at the start are the precondition of a comparison."""
    peer = next(peer for peer in peers() if peer.name == "MuJoCo")
    assert peer.missing(BY_KEY[work]) is None
    mass, bias = (float(x) for x in re.findall(r"to (\d\S*e[-+]\d+)", peer.check(BY_KEY[work])))
    assert mass < 1e-9
    assert bias < 1e-9


def test_settings_combine_all_formulations_and_methods() -> None:
    scene = SHORT_WORK.load()
    quick, full = (list(ours.settings(quick=how)) for how in (True, False))
    for settings in (quick, full):
        assert len({ours.name_of(setting) for setting in settings}) == len(settings)
    assert len(quick) == 4 * len(ours.QUICK_TOLERANCES)
    assert len(full) == 4 * 2 * (len(ours.TOLERANCES) + len(ours.COARSE_TOLERANCES))
    assert {setting.method for setting in full} == {"auto", "DOP853", "RK45", "Radau"}
    assert {setting.overrides(scene).get("spf_coordinates") for setting in full} == {None, "w", "z"}
    for setting in full:
        assert override_scene(scene, setting.overrides(scene))


def test_setting_round_trips_through_its_name() -> None:
    for setting in ours.settings(quick=False):
        assert ours.setting_of(ours.name_of(setting)) == setting


def test_reason_of_stop_is_short() -> None:
    """The reduced model of a row of squares stops where they lie flat; its message lists coordinates."""
    flat = replace(BY_KEY["n_four_bar_4"], t_end=2.0)
    stopped = ours.compute(flat, Setting("reduced", "DOP853", 1e-6), 60.0)
    assert stopped.status == "stopped"
    assert not any(name in stopped.reason for name in flat.mechanism.coordinates)


def test_smaller_steps_of_a_setting_are_not_tried_after_a_refusal() -> None:
    class Slow(Breaks):
        def settings(self, work: Work, quick: bool) -> list[str]:
            return ["a, dt 1", "a, dt 0.5", "b, dt 1"]

        def compute(self, work: Work, setting: str, budget: float) -> Motion:
            self.runs += 1
            return motion_without_data("refused", "would take 9 s")

    slow = Slow()
    rows = [row for row in make.rows_of(SHORT_WORK, True, Memory(None), [slow]) if row.program == slow.name]
    assert [row.reason for row in rows] == ["would take 9 s", "not tried: a, dt 1 would take 9 s", "would take 9 s"]
    assert slow.runs == 2


def test_tighter_tolerances_are_skipped_after_budget_is_exhausted() -> None:
    rows = list(make.rows_of(SHORT_WORK, True, Memory(None), [], Budget(ours=1e-6, peer=1e-6)))
    statuses = [row.status for row in rows]
    families = len({ours.setting_of(row.setting).family for row in rows})
    assert statuses.count("stopped") == families
    assert statuses.count("refused") == len(rows) - families
    assert all(row.error_max is None for row in rows)


def test_run_over_budget_is_refused_in_advance(exact: Reference) -> None:
    mujoco = peers()[0]
    refused = compare_with_reference(
        SHORT_WORK, "MuJoCo", "s", mujoco.compute(SHORT_WORK, "RK4, solref 2 dt, dt 1e-06", 1e-3), exact
    )
    assert refused.status == "refused"
    assert refused.error_max is None


def test_missing_programs_give_reason() -> None:
    render_blocks = {peer.name: peer.missing(BY_KEY["tracking_1e-04"]) for peer in peers()}
    for name in set(render_blocks) - {"SUNDIALS IDA"}:
        assert render_blocks[name]
    assert render_blocks["SUNDIALS IDA"] is None
    andrews = {peer.name: peer.missing(BY_KEY["andrews"]) for peer in peers() if peer.name not in LOOPS}
    assert andrews["Pinocchio constraintDynamics"]


# --- the tables ---------------------------------------------------------------------------------------------------


def test_cache_key_depends_on_scene_and_version() -> None:
    longer = Work("short", SHORT_WORK.says, SHORT_WORK.scene, 0.2)
    assert work_stamp(SHORT_WORK, "1") == work_stamp(replace(SHORT_WORK), "1")
    assert len({work_stamp(SHORT_WORK, "1"), work_stamp(SHORT_WORK, "2"), work_stamp(longer, "1")}) == 3


class Nobody:
    """A program that is not installed."""

    name = "Nobody"
    packaged = False

    def missing(self, work: Work) -> str:
        return "not installed"

    def settings(self, work: Work, quick: bool) -> list[str]:
        return ["never"]


class Breaks:
    """A program whose runs all fail; it counts them."""

    name = "Breaks"
    packaged = True
    runs = 0

    def __init__(self, version: str = "1") -> None:
        self.version_ = version

    def missing(self, work: Work) -> None:
        return None

    def version(self) -> str:
        return self.version_

    def settings(self, work: Work, quick: bool) -> list[str]:
        return ["always"]

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        self.runs += 1
        return motion_without_data("failed", "it fell, over a comma")


def test_cached_measurements_are_reused(tmp_path: Path) -> None:
    memory, others = Memory(tmp_path, verbose=0), [Nobody(), Breaks()]
    first = list(make.rows_of(SHORT_WORK, True, memory, others))
    assert {row.program for row in first} == {ours.PROGRAM, "Breaks"}
    assert (first[-1].status, first[-1].reason) == ("failed", "it fell, over a comma")
    assert (
        list(make.rows_of(SHORT_WORK, True, memory, others)) == first
    )  # equal times show that the rows come from the cache
    assert others[1].runs == 1
    newer = Breaks("2")
    list(make.rows_of(SHORT_WORK, True, memory, [newer]))
    assert newer.runs == 1


def test_page_is_reproduced_from_tables(tmp_path: Path) -> None:
    """The committed tables reproduce the committed page."""
    for name in [*(f"{name}.csv.gz" for name in make.TABLES), "about.json"]:
        shutil.copy(DOCS / name, tmp_path)
    files = make.write(tmp_path)
    assert all(path.stat().st_size > 100 for path in files)
    assert (tmp_path / "report.md").read_text(encoding="utf-8") == (DOCS / "report.md").read_text(encoding="utf-8")
    figures = {path.name for path in files if path.suffix == ".png"}
    assert figures == {path.name for path in DOCS.glob("*.png")}


def test_report_without_tables_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        make.report(tmp_path, from_tables=True)


def test_compiled_terms_pay_after_stated_length_of_motion() -> None:
    """The time saved per second of motion repays compiling after `pays_s`; a too large tree gives a reason."""
    cost = compiled_terms_cost(SHORT_WORK, 1.5)
    assert None not in (cost.compile_s, cost.compiled_run_s, cost.pinocchio_run_s, cost.pays_s)
    assert cost.compiled_run_s < cost.pinocchio_run_s
    assert cost.pays_s * (cost.pinocchio_run_s - cost.compiled_run_s) == pytest.approx(
        cost.compile_s * SHORT_WORK.t_end
    )
    large = compiled_terms_cost(replace(BY_KEY["n_four_bar_40"], overrides={"mechanism.N": 80}), 1.5)
    assert "terms are compiled for trees of up to 130" in large.refused
    assert large.compile_s is None


def test_page_has_table_of_compile_costs(tmp_path: Path) -> None:
    for name in [*(f"{name}.csv.gz" for name in make.TABLES), "about.json"]:
        shutil.copy(DOCS / name, tmp_path)
    works = pd.read_csv(tmp_path / "works.csv.gz")
    costs = pd.DataFrame(
        [{"compile_s": 0.8, "compiled_run_s": 1e-3, "pinocchio_run_s": 5e-3, "pays_s": 400.0}] * len(works)
    )
    costs.loc[1] = None
    works = works.drop(columns=costs.columns, errors="ignore").join(costs).assign(refused="")
    works.loc[1, "refused"] = "81 coordinates"
    works.to_csv(tmp_path / "works.csv.gz", index=False)
    make.write(tmp_path)
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert f"| {works.says[0]} | 0.8 | 1 | 5 | 5 | 400 |" in page
    assert f"| {works.says[1]} | 81 coordinates |" in page
