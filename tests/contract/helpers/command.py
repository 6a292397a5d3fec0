"""Run a command line in this process and capture its output and exit code."""

from __future__ import annotations

import contextlib
import io
import json
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest import mock

from ckc_pin.cli import app


@dataclass(frozen=True)
class Outcome:
    """Exit code and captured output of a command."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """Standard output as one JSON object without NaN and infinity."""

        def refuse(name: str) -> None:
            raise AssertionError(f"{name} in JSON")

        value = json.loads(self.out, parse_constant=refuse)
        assert isinstance(value, dict)
        assert self.out.count("\n") == 1
        assert self.out.endswith("\n")
        return value


def ckc(*words: str) -> Outcome:
    """Run `ckc WORDS...`."""
    return run_main(lambda: sys.exit(app.main()), "ckc", *words)


def run_main(main: Callable[[], object], *line: str) -> Outcome:
    """Call the entry point of a program with a command line."""
    out, err = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    code: Any = None
    try:
        with (
            mock.patch.object(sys, "argv", list(line)),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main()
    except SystemExit as stop:
        code = stop.code
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert isinstance(code, int)
    return Outcome(code, out.getvalue(), err.getvalue())
