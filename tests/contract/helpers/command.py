"""A command line in this process: what it prints, where, and its exit code."""

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
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The one JSON object that standard output must be; NaN and infinity are none in JSON."""

        def refuse(name: str) -> None:
            raise AssertionError(f"{name} in JSON")

        value = json.loads(self.out, parse_constant=refuse)
        assert isinstance(value, dict)
        assert self.out.count("\n") == 1
        assert self.out.endswith("\n")
        return value


def ckc(*words: str) -> Outcome:
    """Run `ckc WORDS...`."""
    return called(lambda: sys.exit(app.main()), "ckc", *words)


def called(main: Callable[[], object], *line: str) -> Outcome:
    """Call what a program starts with, on a command line."""
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
