"""Freedoms are counted near a singular start, whichever directions the search takes."""

from __future__ import annotations

import re
from random import Random

import pytest

from ckc_pin.kinematics import closing
from ckc_pin.kinematics.loading import build
from ckc_pin.mechanism.library import GeneratorSpec, generate


@pytest.mark.parametrize("N", [2, 4, 6])
@pytest.mark.parametrize("seed", range(8))
def test_flat_squares_have_one_freedom(N: int, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """All links lie in one line, where each square may fold in two ways and most directions lead nowhere."""
    monkeypatch.setattr(closing, "Random", lambda _: Random(seed))
    text, sources = generate(GeneratorSpec(generator="n_four_bar", N=N))
    mechanism = build(re.sub(r"(?m)^(\w+) = -?1\.5707963267948966$", r"\1 = 0.0", text), sources)
    assert abs(mechanism.q_tree).max() <= 1e-12
    assert mechanism.d == 1
    assert any("singular" in warning for warning in mechanism.warnings)
