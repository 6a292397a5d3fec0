"""Terms are compiled once for all tests of a process, as for users, in a cache that other tests do not see."""

from __future__ import annotations

from functools import cache as cached
from pathlib import Path

import pytest

from ckc_pin.codegen import compiler, library
from tests.conftest import OPTIMIZED


@pytest.fixture(autouse=True)
def cache(writable_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(writable_cache))
    monkeypatch.setattr(compiler, "FLAGS", OPTIMIZED)
    # Nor what tests with an unwritable cache have compiled earlier in the process.
    monkeypatch.setattr(library, "_process_folder", cached(library._process_folder.__wrapped__))
