"""Evaluation of the benchmark's tables, on small tables."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from scripts.experiments.benchmark.analysis import Analysis, analyse, compared, eq_8, families, fastest
from scripts.experiments.benchmark.figure import front

PROGRAM = "ckc_pin"


def analyse_rows(*rows: tuple[str, str, str, float, float], status: str = "done", accuracy: float = 1e-10) -> Analysis:
    """Analyse rows of work, program, setting, error and time."""
    report = pd.DataFrame(rows, columns=["work", "program", "setting", "error_max", "wall_s"]).assign(status=status)
    keys = report.work.unique()
    works = pd.DataFrame({"work": keys, "accuracy": accuracy})
    checks = pd.DataFrame({"program": ["Other", "Loop"], "packaged": [True, False]})
    return analyse(report, works, checks, pd.DataFrame(), pd.DataFrame())


def test_setting_is_split_into_columns() -> None:
    row = analyse_rows(("w", PROGRAM, "spf, z, auto, rtol 1e-06", 1e-7, 1.0)).rows.iloc[0]
    assert (row.family, row.formulation, row.method, row.rtol) == ("spf, z, auto", "spf, z", "auto", 1e-6)
    other = analyse_rows(("w", "Other", "RK4, rtol 1e-06", 1e-7, 1.0)).rows.iloc[0]
    assert other.kind == "packaged"
    assert pd.isna(other.family)


def test_fastest_run_to_an_accuracy_stays_within_it() -> None:
    rows = analyse_rows(
        ("w", PROGRAM, "dae, auto, rtol 1e-03", 1e-4, 1.0),
        ("w", PROGRAM, "dae, auto, rtol 1e-06", 1e-7, 3.0),
        ("w", PROGRAM, "reduced, auto, rtol 1e-06", 1e-6, 2.0),
    ).rows
    best = fastest(rows, ["work"]).set_index("target").wall_s
    assert best.to_dict() == {1e-3: 1.0, 1e-6: 2.0}
    assert fastest(rows.assign(status="stopped"), ["work"]).empty
    assert fastest(rows.assign(accuracy=1e-5), ["work"]).target.tolist() == [1e-3]  # of the reference


def test_programs_are_compared_at_reached_accuracies() -> None:
    rows = analyse_rows(
        ("w", PROGRAM, "dae, auto, rtol 1e-06", 1e-4, 1.0),
        ("w", "Other", "coarse", 1e-4, 3.0),
        ("w", "Other", "fine", 1e-7, 9.0),
        ("w", "Loop", "all", 1e-4, 0.5),
    ).rows
    packaged = compared(rows, "packaged").set_index("target").ratio
    assert packaged[1e-3] == 3.0
    assert np.isnan(packaged[1e-6])  # no setting of ckc_pin reaches it
    assert compared(rows, "by hand").ratio.tolist() == [0.5]


def test_eq_8_is_compared_in_time_with_the_reduced_model() -> None:
    rows = analyse_rows(
        ("a", PROGRAM, "reduced, auto, rtol 1e-06", 1e-7, 2.0),
        ("a", PROGRAM, "spf, z, auto, rtol 1e-06", 1e-7, 1.0),
        ("b", PROGRAM, "reduced, auto, rtol 1e-06", 1e-4, 2.0),
    ).rows
    ratios = eq_8(rows)
    assert ratios.loc["a", [1e-3, 1e-6]].tolist() == [0.5, 0.5]
    assert ratios.loc["a", [1e-9, 1e-12]].isna().all()
    assert "b" not in ratios.index or ratios.loc["b"].isna().all()


@pytest.mark.parametrize(("reduced", "first"), [(1.05, "reduced, auto"), (1.5, "dae, auto")])
def test_reduced_model_is_recommended_among_equally_fast_families(reduced: float, first: str) -> None:
    rows = analyse_rows(
        ("w", PROGRAM, "dae, auto, rtol 1e-06", 1e-7, 1.0), ("w", PROGRAM, "reduced, auto, rtol 1e-06", 1e-7, reduced)
    ).rows
    assert families(rows).index[0] == first


def test_unreached_accuracy_counts_as_slow() -> None:
    rows = analyse_rows(
        ("w", PROGRAM, "dae, auto, rtol 1e-03", 1e-4, 1.0),
        ("w", PROGRAM, "dae, auto, rtol 1e-09", 1e-10, 4.0),
        ("w", PROGRAM, "spf, RK45, rtol 1e-03", 1e-4, 0.8),
    ).rows
    table = families(rows)
    assert table.index[0] == "dae, auto"
    assert table.loc["spf, RK45", ["reached", "of"]].tolist() == [1, 3]
    assert table.loc["dae, auto", "worst"] == pytest.approx(1.25)
    assert table.loc["dae, auto", "mean"] == pytest.approx(1.25 ** (1 / 3))


def test_errors_over_rtol_are_those_of_the_recommended_family() -> None:
    rows = [("w", PROGRAM, f"dae, auto, rtol 1e-{k:02d}", k * 10.0**-k, float(k)) for k in range(3, 13)]
    assert analyse_rows(*rows, accuracy=1e-14).over_rtol.tolist() == pytest.approx([8, 12])


def test_front_is_pareto_optimal_in_time_and_error() -> None:
    rows = analyse_rows(
        ("w", PROGRAM, "a, b, rtol 1e-03", 1e-2, 1.0),
        ("w", PROGRAM, "a, b, rtol 1e-04", 1e-1, 2.0),
        ("w", PROGRAM, "a, b, rtol 1e-05", 1e-4, 3.0),
        ("w", PROGRAM, "a, b, rtol 1e-06", 1e-4, 4.0),
    ).rows
    assert front(rows).wall_s.tolist() == [1.0, 3.0]
