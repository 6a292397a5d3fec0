"""A folder as a user could have it: the shipped five-bar, copied, free to be changed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ckc_pin.mechanism.library import library


@pytest.fixture
def bar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder `bar` in the working directory."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(library() / "five_bar", tmp_path / "bar")
    return tmp_path / "bar"
