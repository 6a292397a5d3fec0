"""The report: references against published values, rows that are kept as long as they hold, sentences that follow."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ckc_pin.errors import InputError
from ckc_pin.simulation.simulate import simulate
from scripts.experiments.benchmark import growth, left_out, make, ours
from scripts.experiments.benchmark import table as tables
from scripts.experiments.benchmark.page import web
from scripts.experiments.benchmark.peers import peers
from scripts.experiments.benchmark.reference import Reference, reference
from scripts.experiments.benchmark.row import Motion, Row, judged
from scripts.experiments.benchmark.table import Table, key
from scripts.experiments.benchmark.work import WORKS, Budget, Work
from scripts.experiments.tests.report_rows import row
from tests.analytic.five_bar import FIVE_BAR, Q

SHORT = Work("short", "five-bar, free swing, 0.1 s", "five_bar/swing", 0.1, quick=True)
EVERY = {work.key: work for work in WORKS}
LOOP = "Pinocchio constraintDynamics, RKF78 in C++"


@pytest.fixture(scope="module")
def exact() -> Reference:
    return reference(SHORT)


# --- references ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("work", "B0"),
    [
        ("n_four_bar_1", [0.478385057760970559, 0.878150178791209301, 0.0]),
        ("n_four_bar_40", [0.180512226686728390, 0.983572740582311575, 0.0]),
    ],
)
def test_a_row_of_squares_ends_where_forty_digits_say(work: str, B0: list[float]) -> None:
    """The elliptic functions with mpmath at forty digits; an integration by others agrees with them to 1e-11."""
    found = reference(EVERY[work])
    assert np.abs(found.values[-1] - B0).max() < 1e-13
    assert np.abs(found.values[0] - [0, 1, 0]).max() < 1e-15


def test_a_reference_knows_how_good_it_is(exact: Reference) -> None:
    assert exact.values.shape == (11, 4)
    assert 0 < exact.accuracy < 1e-11

    def rate(t: float, y: Any) -> Any:
        return np.concatenate([y[2:], FIVE_BAR.acceleration(FIVE_BAR.sigma(y[:2]), y[2:], np.zeros(2))])

    start = np.concatenate(
        [exact.values[0][Q], [SHORT.load().spec.initial.q_dot.get(x, 0.0) for x in ("theta_1", "theta_3")]]
    )
    numpy_run = solve_ivp(rate, (0.0, SHORT.t_end), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:2, -1]
    assert np.abs(numpy_run - exact.values[-1][Q]).max() < 1e-10
    assert "the reduced model at 1e-13 agrees" in exact.how


# --- rows ---------------------------------------------------------------------------------------------------------


def motion(q_tree: Any, v_tree: Any = None, status: str = "done") -> Motion:
    return Motion(status, "", q_tree, np.zeros_like(q_tree) if v_tree is None else v_tree, 0.5, 0.1, steps=3)


def test_errors_are_along_the_run_and_at_its_end(exact: Reference) -> None:
    off = exact.values.copy()
    off[4, 1] += 3e-3
    off[-1, 2] -= 2e-4
    row = judged("k", SHORT, "other", "s", motion(off), exact)
    assert row.error_max == pytest.approx(3e-3, rel=1e-6)
    assert row.error_end == pytest.approx(2e-4, rel=1e-6)
    phi = [np.abs(FIVE_BAR.phi(q_tree)).max() for q_tree in off]
    assert row.closure == pytest.approx(max(phi), rel=1e-6)


@pytest.mark.parametrize("broken", ["stopped", "nan", "short"])
def test_what_did_not_get_there_has_no_error(broken: str, exact: Reference) -> None:
    values = exact.values[:5] if broken == "short" else exact.values.copy()
    if broken == "nan":
        values[-1, 0] = np.nan
    row = judged("k", SHORT, "other", "s", motion(values, status="stopped" if broken == "stopped" else "done"), exact)
    assert row.error_max is None
    assert row.status != "done" or broken == "short"


def test_a_repeated_run_is_the_same_run() -> None:
    """What is measured, warm and from a loop that has run before, is what a user's run computes."""
    setting = ours.Setting("reduced", "DOP853", 1e-6)
    motion = ours.compute(SHORT, setting.changes, 60.0)
    run = simulate(SHORT.load(formulation="reduced", solver__method="DOP853", solver__rtol=1e-6))
    assert np.array_equal(motion.q_tree, run.q_tree)
    assert np.array_equal(motion.v_tree, run.v_tree)
    assert (motion.steps, motion.rhs) == (run.stats["steps"], run.stats["rhs"])
    assert motion.wall_s > 0


def test_ours_and_the_others_do_the_same_work(exact: Reference) -> None:
    setting = ours.Setting("dae", "auto", 1e-8)
    row = judged("k", SHORT, ours.PROGRAM, setting.name, ours.compute(SHORT, setting.changes, 60.0), exact)
    assert row.error_max is not None
    assert row.error_max < 1e-7
    assert row.energy_drift is not None
    assert row.energy_drift < 1e-6
    settings = {
        "MuJoCo": "RK4, solref 2 dt, dt 0.0005",
        "Drake": "SAP, dt 6.25e-05",
        "Exudyn": "GeneralizedAlpha, spectral radius 0.9, dt 0.0005",
        "Pinocchio constraintDynamics": "K_p 10, dt 6.25e-05",
        "SUNDIALS IDA": "rtol 1e-05",
    }
    for peer in (peer for peer in peers() if peer.name != LOOP):  # which has tests of its own
        assert peer.missing(SHORT) is None
        assert settings[peer.name] in set(peer.settings(SHORT, quick=False))
        theirs = judged("k", SHORT, peer.name, "s", peer.compute(SHORT, settings[peer.name], 60.0), exact)
        assert theirs.error_max is not None
        assert theirs.error_max < 1e-3
        assert theirs.error_max > row.error_max


@pytest.mark.parametrize("work", ["swing", "andrews", "bricard", "slider_crank"])
def test_others_are_set_up_as_the_same_tree(work: str) -> None:
    """Mass matrix and bias at the start: the least that makes a comparison one."""
    for peer in (peer for peer in peers() if peer.name in ("MuJoCo", "Drake")):
        assert peer.missing(EVERY[work]) is None
        mass, bias = (float(x) for x in re.findall(r"to (\d\S*e[-+]\d+)", peer.check(EVERY[work])))
        assert mass < 1e-9
        assert bias < 1e-9


def test_every_formulation_is_measured_by_every_method() -> None:
    quick, full = (list(ours.settings(quick=how)) for how in (True, False))
    for every in (quick, full):
        assert len({setting.name for setting in every}) == len(every)
    assert len(quick) == 4 * len(ours.QUICK_TOLERANCES)
    assert len(full) == 4 * 2 * (len(ours.TOLERANCES) + len(ours.FEW))
    assert {setting.changes["solver.method"] for setting in full} == {"auto", "DOP853", "RK45", "Radau"}
    assert {setting.changes.get("spf_coordinates") for setting in full} == {None, "w", "z"}
    for setting in full:
        assert SHORT.load(**{name.replace(".", "__"): x for name, x in setting.changes.items()})


def test_a_row_tells_its_setting() -> None:
    for setting in ours.settings(quick=False):
        assert ours.of_row(row(setting=setting.name)) == setting


def test_a_reason_is_no_list_of_coordinates() -> None:
    """The reduced model of squares in a row stops where they lie flat, and says near which coordinates."""
    flat = replace(EVERY["n_four_bar_4"], t_end=2.0)
    stopped = ours.compute(flat, ours.Setting("reduced", "DOP853", 1e-6).changes, 60.0)
    assert stopped.status == "stopped"
    assert re.match(r"stopped at t = 0\.\d+ s: J loses rank at t = 0\.7179\d+ s", stopped.reason)
    assert "theta" not in stopped.reason


def test_what_used_up_its_budget_is_not_tried_with_a_tighter_tolerance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ours, "QUICK_METHODS", {"auto": (1e-3, 1e-6)})
    monkeypatch.setattr(make, "BUDGET", Budget(own=1e-6, peer=1e-6))
    rows = list(make._Measured(SHORT, Table(tmp_path / "t.csv", Row), lambda said: None).ours(quick=True))
    first, second = rows[:2]
    assert first.status == "stopped"
    assert "max_wall_s" in first.reason
    assert second.status == "refused"
    assert second.reason.startswith("not tried: at rtol 1e-03 the stopped at t = ")
    assert second.error_max is None


def test_a_run_that_would_take_too_long_is_refused_beforehand(exact: Reference) -> None:
    mujoco = peers()[0]
    refused = judged("k", SHORT, "MuJoCo", "s", mujoco.compute(SHORT, "RK4, solref 2 dt, dt 1e-06", 1e-3), exact)
    assert refused.status == "refused"
    assert "the budget is" in refused.reason
    assert refused.error_max is None


def test_others_say_why_they_are_missing() -> None:
    said = {peer.name: peer.missing(EVERY["tracking_1e-04"]) for peer in peers()}
    for name in set(said) - {"SUNDIALS IDA"}:
        assert said[name] is not None
        assert said[name].startswith("the law of a controlled motion needs D, C and h of the reduced model")
    assert said["SUNDIALS IDA"] is None
    andrews = {peer.name: peer.missing(EVERY["andrews"]) for peer in peers() if peer.name != LOOP}
    assert andrews["Pinocchio constraintDynamics"] == "springs are no part of its models"


# --- the table ----------------------------------------------------------------------------------------------------


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    written = [row(), row(key="l", status="stopped", reason='a "reason", with a comma', error_end=None, rhs=None)]
    table = Table(tmp_path / "t.csv", Row)
    for line in written:
        table.add(line)
    assert list(Table(tmp_path / "t.csv", Row).rows.values()) == written


@pytest.mark.parametrize("text", ["no table", "key,work\n1,2\n", "\0", ",".join(Row.__struct_fields__) + "\nx"])
def test_a_table_of_somebody_else_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="not a report's table"):
        Table(tmp_path / "t.csv", Row)


def test_a_row_depends_on_scene_setting_program_code_and_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    base = key(SHORT, "p", "1", "s")
    assert key(SHORT, "p", "1", "s") == base
    longer = Work("short", SHORT.says, SHORT.scene, 0.2)
    others = [
        key(longer, "p", "1", "s"),
        key(SHORT, "q", "1", "s"),
        key(SHORT, "p", "2", "s"),
        key(SHORT, "p", "1", "t"),
    ]
    monkeypatch.setattr(tables, "machine", lambda: "another")
    others.append(key(SHORT, "p", "1", "s"))
    monkeypatch.setattr(tables, "_code", lambda: "another")
    others.append(key(SHORT, "p", "1", "s"))
    assert len({base, *others}) == 7


# --- the report ---------------------------------------------------------------------------------------------------


def test_an_interrupt_ends_the_report_and_what_was_measured_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> Any:
        if len(Table(tmp_path / "report.csv", Row).rows) == 1:
            return replace(whole, status="interrupted", message="interrupted at t = 0.01 s by SIGTERM")
        return whole

    whole = simulate(SHORT.load())
    monkeypatch.setattr(make, "WORKS", (SHORT,))
    monkeypatch.setattr(ours, "run_prepared", interrupted)
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        make.report(tmp_path, quick=True)
    assert len(Table(tmp_path / "report.csv", Row).rows) == 1


class Nobody:
    """A program that is not there."""

    name = "Nobody"
    packaged = False

    def missing(self, work: Work) -> str:
        return "not installed: pip install nobody"

    def settings(self, work: Work, quick: bool) -> list[str]:
        return ["never"]


class Breaks:
    """A program whose every run fails."""

    name = "Breaks"
    packaged = True

    def missing(self, work: Work) -> None:
        return None

    def version(self) -> str:
        return "0.1"

    def settings(self, work: Work, quick: bool) -> list[str]:
        return ["always"]

    def check(self, work: Work) -> str:
        return "it agrees"

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        return Motion("failed", "it fell, over a comma", np.empty((0, 4)), np.empty((0, 4)), 0.0, 0.0)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of few settings, and of a motion that cannot be made here."""
    away = Work("away", "robots that are away", "no_such", 1.0, quick=True)
    monkeypatch.setattr(make, "WORKS", (SHORT, away))
    monkeypatch.setattr(make, "peers", lambda: [*peers()[:1], Nobody(), Breaks()])
    monkeypatch.setattr(ours, "QUICK_METHODS", {"auto": (1e-3, 1e-6)})
    monkeypatch.setattr("scripts.experiments.benchmark.peers.mujoco.QUICK_STEPS", 1)
    monkeypatch.setattr("scripts.experiments.benchmark.peers.mujoco.SOFT_STEPS", 1)
    monkeypatch.setattr(left_out, "MODULES", {"json": ("import json", "an example"), "no_such": ("import no_such", "")})
    row_of_squares = replace(growth.FAMILIES[0], quick=growth.FAMILIES[0].cases[:3])
    monkeypatch.setattr(growth, "FAMILIES", (row_of_squares,))
    monkeypatch.setattr(growth, "FORMULATIONS", {"reduced": {"formulation": "reduced"}})


def test_a_report_is_gone_on_with(tmp_path: Path, tiny: None) -> None:
    measured: list[str] = []
    found = make.report(tmp_path / "r", quick=True, progress=measured.append)
    assert len(found.rows["short"]) == 4 * 2 + 5 + 1
    assert len(measured) == 1 + 14 + 3 + 3
    tables = ["report.csv", "growth.csv", "left_out.csv"]
    figures = [f"{name}.{kind}" for name in ("report", "growth", "short") for kind in ("png", "svg")]
    assert [path.name for path in found.files] == ["report.html", "report.md", *tables, *figures]
    assert all(path.stat().st_size > 100 for path in found.files)

    text = (tmp_path / "r" / "report.md").read_text(encoding="utf-8")
    assert "Nobody : not compared, not installed: pip install nobody." in text
    assert "Breaks 0.1: it agrees." in text
    assert "A run may take 1.5 s here and 2 s in another program" in text
    assert "- Not measured: robots that are away, no mechanism 'no_such'; shipped: " in text
    html = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert html.count('src="data:image/png;base64,') == 3
    assert "http" not in html.replace("http-equiv", "")
    failed = next(row for row in found.rows["short"] if row.program == "Breaks")
    assert (failed.status, failed.reason) == ("failed", "it fell, over a comma")
    assert failed in Table(tmp_path / "r" / "report.csv", Row).rows.values()
    left = list(Table(tmp_path / "r" / "left_out.csv", left_out.LeftOut).rows.values())
    assert [row.what for row in left if row.scene == ""] == ["json", "no_such"]
    assert "No module named 'no_such'" in left[1].reason

    measured.clear()
    again = make.report(tmp_path / "r", quick=True, progress=measured.append)
    assert again.rows == found.rows
    assert measured == ["short: reference"]


def test_a_stale_row_is_measured_again(tmp_path: Path, tiny: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of a report made by other code, however right it looks, is in this one."""
    monkeypatch.setattr(make, "peers", lambda: [Breaks()])
    monkeypatch.setattr(ours, "QUICK_METHODS", {"auto": (1e-3,)})
    monkeypatch.setattr(make, "_figures", lambda *everything: [])
    monkeypatch.setattr(make, "web", lambda *everything: "")
    with monkeypatch.context() as then:
        then.setattr(tables, "_code", lambda: "as it was")
        old = make.report(tmp_path, quick=True)
    new = make.report(tmp_path, quick=True)
    for name, kind in (("report", Row), ("growth", growth.Growth), ("left_out", left_out.LeftOut)):
        rows = Table(tmp_path / f"{name}.csv", kind).rows
        assert rows
        assert not {row.key for row in old.rows["short"]} & set(rows)
    assert [row.setting for row in old.rows["short"]] == [row.setting for row in new.rows["short"]]


def test_a_page_is_escaped(tmp_path: Path) -> None:
    assert "<script>" not in web("# \\<script>alert(1)\\</script>", tmp_path)
