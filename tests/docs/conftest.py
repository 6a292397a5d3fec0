"""Compile without optimization, and terms of pages into a cache of their own, which other tests do not use."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin.formats.fmu import writer
from tests.conftest import QUICK


@pytest.fixture(autouse=True)
def cache(writable_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(writable_cache))
    monkeypatch.setattr(writer, "FLAGS", QUICK)
