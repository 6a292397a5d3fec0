"""Random sensitivities through impacts, stops and friction, compared with one-sided differences on both sides."""

from __future__ import annotations

import pytest

from scripts.experiments.fuzz.derivatives import check_sensitivities, is_wrong

# 48, 108: an impact moves other joints off their stops; 50: an impact at t = 0; 65, 73: assembled at a stop;
# 410: joints that are coupled by loops hit two stops
SEEDS = [2, 3, 7, 11, 48, 50, 65, 73, 108, 410]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_sensitivities_agree_with_one_sided_differences(seed: int) -> None:
    columns = check_sensitivities(seed)
    assert not [column for column in columns if is_wrong(column)]
    assert any(column.result == "right" for column in columns)
