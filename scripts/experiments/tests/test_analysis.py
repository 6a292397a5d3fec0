"""What tables are said to say, of a table small enough to be read."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from scripts.experiments.benchmark.analysis import Found, analysed, compared, eq_8, families, fastest
from scripts.experiments.benchmark.figure import front

OWN = "ckc_pin"


def found(*rows: tuple[str, str, str, float, float], status: str = "done", accuracy: float = 1e-10) -> Found:
    """Rows of work, program, setting, error and time."""
    report = pd.DataFrame(rows, columns=["work", "program", "setting", "error_max", "wall_s"]).assign(status=status)
    keys = report.work.unique()
    works = pd.DataFrame({"work": keys, "accuracy": accuracy})
    checks = pd.DataFrame({"program": ["Other", "Loop"], "packaged": [True, False]})
    return analysed(report, works, checks, pd.DataFrame(), pd.DataFrame())


def test_a_setting_becomes_columns() -> None:
    row = found(("w", OWN, "spf, z, auto, rtol 1e-06", 1e-7, 1.0)).rows.iloc[0]
    assert (row.family, row.formulation, row.method, row.rtol) == ("spf, z, auto", "spf, z", "auto", 1e-6)
    other = found(("w", "Other", "RK4, rtol 1e-06", 1e-7, 1.0)).rows.iloc[0]
    assert other.kind == "packaged"
    assert pd.isna(other.family)


def test_the_fastest_run_to_an_accuracy_stays_within_it() -> None:
    rows = found(
        ("w", OWN, "dae, auto, rtol 1e-03", 1e-4, 1.0),
        ("w", OWN, "dae, auto, rtol 1e-06", 1e-7, 3.0),
        ("w", OWN, "reduced, auto, rtol 1e-06", 1e-6, 2.0),
    ).rows
    best = fastest(rows, ["work"]).set_index("target").wall_s
    assert best.to_dict() == {1e-3: 1.0, 1e-6: 2.0}
    assert fastest(rows.assign(status="stopped"), ["work"]).empty
    said = fastest(rows.assign(accuracy=1e-5), ["work"])
    assert said.target.tolist() == [1e-3]
    assert set(fastest(rows.assign(accuracy=1e-5), ["work"], untold=True).target) == {1e-3, 1e-6}


def test_programs_of_a_kind_are_compared_where_they_get_to() -> None:
    rows = found(
        ("w", OWN, "dae, auto, rtol 1e-06", 1e-4, 1.0),
        ("w", "Other", "coarse", 1e-4, 3.0),
        ("w", "Other", "fine", 1e-7, 9.0),
        ("w", "Loop", "all", 1e-4, 0.5),
    ).rows
    packaged = compared(rows, "packaged").set_index("target").ratio
    assert packaged[1e-3] == 3.0
    assert np.isnan(packaged[1e-6])  # nothing here gets there
    assert compared(rows, "by hand").ratio.tolist() == [0.5]


def test_eq_8_pays_where_it_takes_less_than_the_reduced_model() -> None:
    rows = found(
        ("a", OWN, "reduced, auto, rtol 1e-06", 1e-7, 2.0),
        ("a", OWN, "spf, z, auto, rtol 1e-06", 1e-7, 1.0),
        ("b", OWN, "reduced, auto, rtol 1e-06", 1e-4, 2.0),
    ).rows
    ratios = eq_8(rows)
    assert ratios.loc["a", [1e-3, 1e-6]].tolist() == [0.5, 0.5]
    assert ratios.loc["a", [1e-9, 1e-12]].isna().all()
    assert "b" not in ratios.index or ratios.loc["b"].isna().all()


@pytest.mark.parametrize(("reduced", "first"), [(1.05, "reduced, auto"), (1.5, "dae, auto")])
def test_of_what_is_alike_the_reduced_model_is_taken(reduced: float, first: str) -> None:
    rows = found(
        ("w", OWN, "dae, auto, rtol 1e-06", 1e-7, 1.0), ("w", OWN, "reduced, auto, rtol 1e-06", 1e-7, reduced)
    ).rows
    assert families(rows).index[0] == first


def test_what_is_not_got_to_counts_as_slow() -> None:
    rows = found(
        ("w", OWN, "dae, auto, rtol 1e-03", 1e-4, 1.0),
        ("w", OWN, "dae, auto, rtol 1e-09", 1e-10, 4.0),
        ("w", OWN, "spf, RK45, rtol 1e-03", 1e-4, 0.8),
    ).rows
    table = families(rows)
    assert table.index[0] == "dae, auto"
    assert table.loc["spf, RK45", ["reached", "of"]].tolist() == [1, 3]
    assert table.loc["dae, auto", "worst"] == pytest.approx(1.25)
    assert table.loc["dae, auto", "mean"] == pytest.approx(1.25 ** (1 / 3))


def test_errors_over_the_tolerance_are_of_the_family_to_take() -> None:
    rows = [("w", OWN, f"dae, auto, rtol 1e-{k:02d}", k * 10.0**-k, float(k)) for k in range(3, 13)]
    assert found(*rows, accuracy=1e-14).over_rtol.tolist() == pytest.approx([8, 12])


def test_a_front_has_what_nothing_beats_in_both() -> None:
    rows = found(
        ("w", OWN, "a, b, rtol 1e-03", 1e-2, 1.0),
        ("w", OWN, "a, b, rtol 1e-04", 1e-1, 2.0),
        ("w", OWN, "a, b, rtol 1e-05", 1e-4, 3.0),
        ("w", OWN, "a, b, rtol 1e-06", 1e-4, 4.0),
    ).rows
    assert front(rows).wall_s.tolist() == [1.0, 3.0]
