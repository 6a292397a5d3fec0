"""Work-precision comparisons that time each setting by one run, not by the shortest of several."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ckc_pin.analysis.precision import motion

__all__ = ["time_by_one_run"]


@contextmanager
def time_by_one_run() -> Iterator[None]:
    """Do not repeat runs to measure their times exactly, which takes most of the time of a comparison of short runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motion, "MIN_TIMED_S", 0.0)
        patch.setattr(motion, "MAX_REPEATS", 1)
        yield
