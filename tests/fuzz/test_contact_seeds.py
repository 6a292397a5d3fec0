"""A part of the fuzz suite for contact: a few seeds of every kind, all correct."""

from __future__ import annotations

import pytest

from scripts.experiments.fuzz.contact.record import KINDS, judge_seed


@pytest.mark.parametrize("seed", range(2000, 2006))
@pytest.mark.parametrize("kind", KINDS)
def test_random_contact_is_correct(kind: str, seed: int) -> None:
    record = judge_seed(seed, kind)
    assert record.runs >= 1
    assert record.findings == [], record
