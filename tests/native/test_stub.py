"""The types that the checked-in stub of the core gives."""

from __future__ import annotations

from scripts.stubs import STUB, generate


def test_stub_is_that_of_the_core() -> None:
    """Otherwise `python -m scripts.stubs` has to be run again."""
    assert STUB.read_text(encoding="utf-8") == generate()
