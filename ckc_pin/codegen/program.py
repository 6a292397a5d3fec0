"""Run another program so that an interrupt ends it, with every process that it has started."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from time import monotonic

from ckc_pin.base.interrupt import uninterrupted_thread

__all__ = ["run_program"]

POLL_PERIOD_S = 0.05  # how soon the program is killed after an interrupt


def run_program(command: Sequence[str], timeout_s: float, temporary: Path) -> subprocess.CompletedProcess[str]:
    """Run a program to its end and return its exit code and output.

    A compiler's driver starts other programs, which do not end when it is killed. So the program gets a process group,
    which is killed as a whole: on a timeout, and on an exception raised here meanwhile, such as KeyboardInterrupt.

    Parameters
    ----------
    command : sequence of str
    timeout_s : float
    temporary : Path
        Folder for the program's temporary files, as TMPDIR: a killed program does not remove them.

    Raises
    ------
    TimeoutError
    OSError
        The program cannot be started.
    """
    stop = Event()
    with uninterrupted_thread() as pool:  # an interrupt could lose a process while it starts
        try:
            return pool.submit(_run, command, timeout_s, temporary, stop).result()
        finally:
            stop.set()


def _run(command: Sequence[str], timeout_s: float, temporary: Path, stop: Event) -> subprocess.CompletedProcess[str]:
    deadline = monotonic() + timeout_s
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
        env={**os.environ, "TMPDIR": str(temporary)}, process_group=0,
    ) as process:  # fmt: skip
        while True:
            try:
                out, err = process.communicate(timeout=POLL_PERIOD_S)
                return subprocess.CompletedProcess(command, process.returncode, out, err)
            except subprocess.TimeoutExpired:
                if not stop.is_set() and monotonic() < deadline:
                    continue
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()  # returns when no process of the group holds the pipes any more
            raise TimeoutError
