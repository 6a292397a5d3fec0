"""What the report says follows from its rows: made-up rows, and who is ahead turns the sentences around."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scripts.experiments.benchmark.advice import advice
from scripts.experiments.benchmark.figure import _front
from scripts.experiments.benchmark.goals import BY_HAND, PACKAGED, cells, goals_table
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import eq_8_ratio, fastest, sentences, times
from scripts.experiments.benchmark.work import Work
from scripts.experiments.tests.report_rows import peer, row

SHORT = Work("short", "five-bar, free swing, 0.1 s", "five_bar/swing", 0.1)
SPATIAL = Work("spatial", "somewhere in space", "bricard", 0.1, planar=False)
GOOD = Reference(np.zeros((11, 4)), 1e-13, "known")
LOOP = "a loop in C++"
SECONDS = st.floats(1e-4, 1e2)


def advised(rows: Mapping[str, list[Row]], works: tuple[Work, ...] = (SHORT,)) -> str:
    return "\n".join(advice(works, rows, {work.key: GOOD for work in works}, {LOOP}))


# --- one work ----------------------------------------------------------------------------------------------------


def test_the_fastest_is_the_one_that_is_right_all_along() -> None:
    slow, fast = row(wall_s=0.2), row(wall_s=0.1, error_max=2e-3)
    failed = row(wall_s=0.01, status="stopped", error_max=None)
    assert fastest([slow, fast, failed], 1e-6) is slow
    assert fastest([slow, fast, failed], 1e-2) is fast
    assert fastest([failed], 1e-2) is None


def test_sentences_name_who_is_ahead_and_by_how_much() -> None:
    rough = Reference(np.zeros((11, 4)), 1e-10, "known")
    here = [row(wall_s=0.2, error_max=1e-10)]
    said = list(sentences(SHORT, [*here, peer(wall_s=0.05, error_max=1e-4)], rough))
    assert said[0] == "To 1e-03: dae, auto, rtol 1e-06, 200 ms; MuJoCo (RK4) takes 50 ms, 4 times faster than here."
    assert said[1] == "To 1e-06: dae, auto, rtol 1e-06, 200 ms; no packaged program gets there."
    assert said[3] == "To 1e-12: not told, the reference is good to 1e-10."
    assert len(said) == 4
    slower = peer(wall_s=0.6, error_max=1e-4)
    assert next(sentences(SHORT, [*here, slower], rough)).endswith("MuJoCo (RK4) takes 600 ms, 3 times as long.")
    alone = next(sentences(SHORT, [slower], rough))
    assert alone == "To 1e-03: nothing here gets there; MuJoCo (RK4) does in 600 ms."
    assert next(sentences(SHORT, [row(error_max=1.0)], rough)) == "To 1e-03: no setting tried gets there."


@pytest.mark.parametrize(
    ("other", "verdict"),
    [(0.05, "4 times faster than here"), (0.16, "25 % faster than here"), (0.2, "0 % longer"), (0.21, "5 % longer"),
     (0.4, "2 times as long")],
)  # fmt: skip
def test_small_differences_are_told_in_percent(other: float, verdict: str) -> None:
    said = next(sentences(SHORT, [row(wall_s=0.2), peer(wall_s=other)], GOOD))
    assert said.endswith(f", {verdict}.")


@given(own=SECONDS, other=SECONDS, by_hand=st.booleans())
def test_whoever_takes_less_time_is_said_to_be_ahead(own: float, other: float, by_hand: bool) -> None:
    program = LOOP if by_hand else "MuJoCo"
    rows = [row(wall_s=own), peer(program=program, wall_s=other)]
    said = next(sentences(SHORT, rows, GOOD, {LOOP}))
    assert ("faster than here" in said) == (other < own)
    assert (f"Written by hand, {LOOP}" in said) == by_hand
    assert (f"{program} is ahead" in advised({"short": rows})) == (other < own)
    for goal in (PACKAGED, BY_HAND):
        found = list(cells(goal, rows, GOOD, {LOOP}))
        assert bool(found) == (goal.by_hand == by_hand)
        assert all(cell.reached == (other >= goal.factor * own) for cell in found)
        assert all(cell.ratio == pytest.approx(other / own) for cell in found)
        assert [cell.target for cell in found] == [target for target in goal.targets if found and target >= 1e-7]


def test_a_loop_written_by_hand_is_no_package() -> None:
    rows = [row(wall_s=0.1), peer(program=LOOP, wall_s=0.05), peer(wall_s=0.4)]
    said = next(sentences(SHORT, rows, GOOD, {LOOP}))
    assert "MuJoCo (RK4) takes 400 ms, 4 times as long." in said
    assert said.endswith(f"Written by hand, {LOOP} (RK4) takes 50 ms, 2 times faster than here.")
    none = list(sentences(SHORT, [*rows[::2], peer(program=LOOP, status="failed", error_max=None)], GOOD, {LOOP}))
    assert none[0].endswith("The loop written by hand does not get there.")


@given(printed=SECONDS, reduced=SECONDS)
def test_eq_8_pays_where_it_takes_less(printed: float, reduced: float) -> None:
    times_of = {"spf, eq. 8": printed, "reduced": reduced}
    rows = [row(setting=f"{name}, auto, rtol 1e-06", wall_s=wall_s) for name, wall_s in times_of.items()]
    assert eq_8_ratio(rows, 1e-6) == pytest.approx(printed / reduced)
    assert eq_8_ratio(rows, 1e-9) is None
    last = list(sentences(SHORT, rows, GOOD))[-1]
    assert ("it pays to 1e-03, 1e-06" in last) == (printed < reduced)
    assert ("it pays on short (ε = 1e-03) to 1e-03" in advised({"short": rows})) == (printed < reduced)


def test_eq_8_that_gets_nowhere_is_said_to() -> None:
    rows = [row(setting="spf, eq. 8, auto, rtol 1e-06", status="stopped", error_max=None), row()]
    assert list(sentences(SHORT, rows, GOOD))[-1] == "Eq. 8 as printed at ε = 1e-03 gets to none of these accuracies."
    assert "gets to none of these accuracies" in advised({"short": rows})


@pytest.mark.parametrize(
    ("x", "said"), [(0.123, "0.12"), (1.0, "1"), (9.96, "10"), (56.7, "57"), (1234.5, "1,230"), (4.4e5, "440,000")]
)
def test_numbers_are_for_people(x: float, said: str) -> None:
    assert times(x) == said


# --- what to take -------------------------------------------------------------------------------------------------


def test_the_setting_that_gets_furthest_is_advised_and_what_to_take_elsewhere() -> None:
    reduced, dae = (
        row(setting="reduced, auto, rtol 1e-08", wall_s=0.1),
        row(setting="dae, auto, rtol 1e-08", wall_s=0.2),
    )
    far = row(setting="dae, auto, rtol 1e-08", error_max=1e-4, wall_s=0.2)
    rows = {"short": [reduced, dae], "spatial": [far]}
    said = advised(rows, (SHORT, SPATIAL))
    assert 'Take `formulation = "dae"`, `method = "auto"`: it gets to 3 of the 3 accuracies' in said
    assert "1.6 times the time of the fastest one in the mean, 2 times at worst (short to 1e-03)." in said
    rows["short"].append(row(setting="reduced, auto, rtol 1e-10", wall_s=0.3, error_max=1e-10))
    rows["short"].append(row(setting="reduced, auto, rtol 1e-12", wall_s=0.3, error_max=1e-12))
    said = advised(rows, (SHORT, SPATIAL))
    assert 'Take `formulation = "reduced"`, `method = "auto"`: it gets to 4 of the 5 accuracies' in said
    assert 'Elsewhere (spatial to 1e-03) take `formulation = "dae"`, `method = "auto"`.' in said


@given(over=st.floats(1e-2, 1e4))
def test_the_advised_tolerance_reaches_the_error_asked_for(over: float) -> None:
    rows = [row(setting=f"reduced, auto, rtol 1e-{k:02d}", error_max=over * 10.0**-k) for k in range(4, 10)]
    said = advised({"short": rows})
    rtol = float(said.split("give rtol = ")[1].split(".\n")[0])
    assert over * rtol <= 1e-6 * (1 + 1e-6)
    assert rtol == 1.0 or over * 10 * rtol > 1e-6


def test_where_another_is_ahead_is_said_work_by_work() -> None:
    rows = {
        "short": [row(wall_s=0.1), peer(wall_s=0.05, error_max=1e-4), peer(wall_s=0.02), peer(error_max=1e-10)],
        "spatial": [row(wall_s=0.1), peer(wall_s=0.2)],
    }
    said = advised(rows, (SHORT, SPATIAL))
    assert "(MuJoCo) it is faster at 2 of the 5 works and accuracies that one of them gets to, 2 to 2 times" in said
    assert "MuJoCo is ahead on short to 1e-03, 1e-06, 1e-09 (up to 10 times faster): take it there." in said


def test_nothing_that_got_anywhere_is_said_to() -> None:
    assert advised({"short": [row(status="stopped", error_max=None)]}) == (
        "No setting of this program got to any of the accuracies."
    )


# --- the figures to reach -----------------------------------------------------------------------------------------


def test_the_table_of_figures_says_what_was_missed_and_what_was_not_asked_for() -> None:
    rows = {
        "short": [row(wall_s=0.1), peer(wall_s=0.4, error_max=1e-4), peer(wall_s=0.8)],
        "spatial": [row(wall_s=0.1), peer(wall_s=0.1)],
    }
    known = {"short": GOOD, "spatial": GOOD}
    lines = goals_table(PACKAGED, (SHORT, SPATIAL), rows, known, {LOOP})
    assert lines[0] == (
        "At least 5 times faster than the best packaged program: reached at 3 of 5 accuracies that one gets to "
        "(planar works); missed on short at 1e-03, 1e-04."
    )
    assert "| 4, missed | 4, missed | 8 | 8 | 8 |  |  |" in lines[-1]
    assert not any("space" in line for line in lines)
    assert goals_table(BY_HAND, (SHORT, SPATIAL), rows, known, {LOOP}) == []
    rows["short"] = [peer(), peer(program="Drake", wall_s=0.001, error_max=1e-3)]
    lines = goals_table(PACKAGED, (SHORT,), rows, known, {LOOP})
    assert lines[0].endswith("reached at 0 of 5 accuracies that one gets to (planar works); missed on short at all 5.")
    assert "| missed, nothing here, Drake | missed, nothing here, MuJoCo |" in lines[-1]


# --- figures ------------------------------------------------------------------------------------------------------


def test_the_front_is_what_no_other_row_beats() -> None:
    rows = [row(wall_s=x, error_max=y) for x, y in ((3.0, 1.0), (1.0, 5.0), (2.0, 6.0), (4.0, 2.0))]
    failed = row(wall_s=0.1, status="stopped", error_max=None)
    assert _front([*rows, failed]) == (rows[1], rows[0])
