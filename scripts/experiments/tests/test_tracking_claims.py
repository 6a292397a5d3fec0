"""Verdicts on claims of tracking control, from synthetic numbers or short runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scripts.experiments.paper import tracking
from scripts.experiments.paper.deviations import (
    PERIOD,
    Deviation,
    Setting,
    Track,
    deviation,
    instants,
)
from scripts.experiments.paper.lyapunov import Record
from scripts.experiments.paper.tracking_experiments import (
    EXACT,
    SETTINGS,
    deviations,
    lyapunov_along,
    off_manifold,
)
from scripts.experiments.paper.tracking_identities import (
    Skewness,
)
from tests.analytic.five_bar import Array, desired
from tests.conftest import assert_close

SHORT_RUN = {"t_end": 0.02, "solver.output_dt": 5e-5, "solver.method": "DOP853", "solver.rtol": 1e-10}


def synthetic_deviations(settings: Mapping[str, Setting], periodic: str) -> tuple[Array, Array, dict[str, Deviation]]:
    """Return synthetic deviations: 1e-3 rad with the period of eq. 21 in `periodic`, none in tight runs, or noise."""
    t, random = instants(3), np.random.default_rng(4)
    still = Track(np.zeros((len(t), 2)), 0.0)
    by_setting = {}
    for name in settings:
        tight = name in SETTINGS["nothing"] or name in SETTINGS["sigma of both"]
        off = np.zeros_like(t) if tight else 1e-4 * random.uniform(0, 1, len(t))
        off = 1e-3 * (2 + np.sin(t)) if name == periodic else off
        by_setting[name] = deviation(
            Track(off[:, None] + still.q + 1e-13 * random.uniform(0, 1, still.q.shape), 1e-2), still
        )
    return t, np.exp(-t), by_setting


@pytest.fixture(scope="module")
def good() -> Record:
    return lyapunov_along({"formulation": "reduced", **SHORT_RUN})


def judged_rate(rho: Record, actual: Record, on: Record, figures: Path) -> str:
    off = {(1e-3, name, moving): x for name, x in (("rho", rho), ("actual", actual)) for moving in (False, True)}
    claim = tracking.lyapunov_claim({"reduced": on}, {"reduced": on}, off, figures)
    assert all((figures / name).stat().st_size > 10_000 for name in claim.figures)
    assert claim.table is not None
    assert [len(row) for row in claim.table[1]] == [len(claim.table[0])] * 6
    return claim.verdict


def test_rate_verdict_requires_correct_convention(good: Record, tmp_path: Path) -> None:
    """Only C at rho q_dot violates eq. 19; with the conventions exchanged the statement would not hold."""
    bad = replace(good, rate=1.01 * good.rate)
    assert judged_rate(good, good, good, tmp_path) == "holds"
    assert judged_rate(bad, good, good, tmp_path) == "holds with a condition"
    assert judged_rate(good, bad, good, tmp_path) == "does not hold"
    assert judged_rate(good, good, bad, tmp_path) == "does not hold"


def test_rate_verdict_of_short_runs(good: Record, tmp_path: Path) -> None:
    rho, actual = (off_manifold(1e-3, name, True) for name in ("rho", "actual"))
    assert judged_rate(rho, actual, good, tmp_path) == "holds with a condition"


def test_gains_verdict_follows_quadratic_forms() -> None:
    claim = tracking.gains_claim()
    assert claim.verdict == "holds with a condition"
    assert claim.table is not None
    assert all(len(row) == len(claim.table[0]) for row in claim.table[1])


@pytest.mark.parametrize(("deviates", "verdict"), [(False, "does not hold"), (True, "holds")])
def test_deviations_verdict_follows_numbers(tmp_path: Path, deviates: bool, verdict: str) -> None:
    (tight,) = SETTINGS["nothing"]
    settings = {name: x for group in SETTINGS.values() for name, x in group.items()}
    claim = tracking.deviations_claim(*synthetic_deviations(settings, tight if deviates else "none"), tmp_path)
    assert claim.verdict == verdict
    assert all((tmp_path / name).stat().st_size > 10_000 for name in claim.figures)


def test_deviations_are_relative_to_exact_run() -> None:
    tracks: list[tuple[object, object]] = []

    def fake(scene: str, setting: Setting, times: Array) -> Track:
        tracks.append((setting.tolerance, setting.controller_tolerance))
        q_d = np.array([desired(float(t))[0] for t in times])
        return Track(q_d + (0.25 if setting is EXACT else 0.375 + 0.125 * np.sin(times)[:, None]), 0.0)

    settings = SETTINGS["controller's sigma"]
    t, error, by_setting = deviations(settings, 2, fake)
    assert_close(t[[0, -1]], [0.0, 2 * PERIOD], 1e-12)
    assert_close(error, 0.25, 1e-12)
    assert tracks == [(None, None), (None, 1e-2), (None, 1e-3)]
    for x in by_setting.values():
        assert_close(x.size, np.abs(0.125 + 0.125 * np.sin(t)), 1e-12)


@pytest.mark.parametrize(
    ("on", "mixed", "verdict"),
    [(1e-11, 2.0, "holds with a condition"), (1e-11, 1e-11, "holds"), (1e-3, 2.0, "does not hold")],
)
def test_skewness_verdict_follows_numbers(on: float, mixed: float, verdict: str) -> None:
    by_epsilon = {epsilon: Skewness(on, 1e-11, mixed, 1e-11, 4) for epsilon in (1e-2, 1e-3)}
    assert tracking.skew_claim(by_epsilon).verdict == verdict
