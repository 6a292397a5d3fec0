"""Where the native core was not built there is nothing here to test; that the rest works is what the rest tests."""

from ckc_pin.native import unavailable

collect_ignore_glob = ["test_*.py"] if unavailable() else []
