"""Fixtures that the tests of experiments share with all others."""

from tests.conftest import five_bar, pair, run

__all__ = ["five_bar", "pair", "run"]
