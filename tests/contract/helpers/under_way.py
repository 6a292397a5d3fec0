"""Run a command in a separate process, which can be sent signals."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import ckc_pin

__all__ = ["under_way"]


@contextmanager
def under_way(program: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program with a command line; it is killed when the context is left."""
    with subprocess.Popen(
        [sys.executable, "-c", program, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(ckc_pin.__file__).parent.parent)},
    ) as process:
        try:
            yield process
        finally:
            process.kill()
