"""Some seeds of the fuzz suite for contact: motions of each kind of mechanism are correct."""

from __future__ import annotations

import pytest

from scripts.experiments.fuzz.contact.record import KINDS, check_seed


@pytest.mark.parametrize("seed", range(2000, 2006))
@pytest.mark.parametrize("kind", KINDS)
def test_random_contact_is_correct(kind: str, seed: int) -> None:
    record = check_seed(seed, kind)
    assert record.runs >= 1
    assert record.faults == [], record
