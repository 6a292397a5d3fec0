"""Terms are compiled once for all tests of a process, as for users, in a cache that other tests do not see."""

from __future__ import annotations

from pathlib import Path

import pytest

from ckc_pin.codegen import compiler
from tests.conftest import OPTIMIZED, forget_process_folder


@pytest.fixture(autouse=True)
def cache(writable_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(writable_cache))
    monkeypatch.setattr(compiler, "FLAGS", OPTIMIZED)
    forget_process_folder(monkeypatch)
