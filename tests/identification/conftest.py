"""Choose the knots of splines once for equal measurements, which several tests take."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ckc_pin.identification import smoothing
from tests.conftest import remember


@pytest.fixture(scope="package", autouse=True)
def knots_of_equal_measurements() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smoothing, "choose_knots", remember(smoothing.choose_knots))
        yield
