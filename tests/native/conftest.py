"""Where the native core was not built there is nothing here to test; that the rest works is what the rest tests."""

from ckc_pin.native import unavailable


def pytest_ignore_collect() -> bool | None:
    return True if unavailable() else None
