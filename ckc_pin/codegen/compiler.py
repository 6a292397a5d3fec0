"""The C compiler of compiled terms: which one, with which flags, and how to run it so that an interrupt ends it."""

from __future__ import annotations

import os
import platform
import signal
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import Event
from time import monotonic
from typing import TYPE_CHECKING

import msgspec

from ckc_pin.base.interrupt import uninterrupted_thread
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    import subprocess

__all__ = ["FLAGS", "Compiler", "compile_c", "find_compiler", "hash_of", "run_program"]

# With its default of 500, GCC's register allocation takes half the time to compile long code without branches, which
# then is as fast as with 10.
FLAGS = ("-O2", "-std=c99", "-fPIC", "-shared", "-w", "--param=lra-max-considered-reload-pseudos=10")
# Products and sums are fused only in libraries that have directional derivatives, so that the processor's instruction
# cache holds both. Without fusing, a plain run has the same last digits on processors that cannot fuse.
EXACT, FUSED = "-ffp-contract=off", "-ffp-contract=fast"
COMPILER_TIMEOUT_S = 600.0
POLL_PERIOD_S = 0.05  # how soon the program is killed after an interrupt


class Compiler(msgspec.Struct, frozen=True):
    """A C compiler with flags; `key` identifies both in names of cached files."""

    path: str
    flags: tuple[str, ...]
    key: str


def find_compiler(fuses: bool) -> Compiler | None:
    """Return `cc` on PATH, or None.

    Parameters
    ----------
    fuses : bool
        Whether products and sums may be fused.
    """
    import shutil

    path = shutil.which("cc")
    if path is None:
        return None
    flags = (*FLAGS, FUSED if fuses else EXACT, *_machine_flags(fuses))
    real = os.path.realpath(path)
    stat = os.stat(real)
    return Compiler(path, flags, hash_of((real, stat.st_size, stat.st_mtime_ns, flags))[:16])


@cache
def _machine_flags(fuses: bool) -> tuple[str, ...]:
    """Return flags for wider registers and, if fusing is allowed, fused operations, as far as the machine has them."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return ()
    try:
        features = set(Path("/proc/cpuinfo").read_text(encoding="ascii").split())
    except OSError:
        return ()
    flags = [f"-m{x}" for x in ("avx2", "fma") if x in features and (fuses or x != "fma")]
    return (*flags, *(["-DHAS_AVX512F"] if "avx512f" in features else []))


def hash_of(value: object) -> str:
    """Return the SHA-256 hash of a value that JSON can represent."""
    return sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()


def compile_c(compiler: Compiler, source: Path, library: Path, name: str) -> None:
    """Compile a C file to a shared library.

    Parameters
    ----------
    compiler : Compiler
    source, library : Path
        In a folder for temporary files, which the compiler uses too.
    name : str
        Of the mechanism, for messages.

    Raises
    ------
    InputError
        The compiler cannot be started, fails, or takes more than 600 s.
    """
    command = [compiler.path, *compiler.flags, "-o", str(library), str(source), "-lm"]
    try:
        done = run_program(command, COMPILER_TIMEOUT_S, temporary=source.parent)
    except TimeoutError:
        raise InputError(f"{name}: the C compiler took more than {COMPILER_TIMEOUT_S:g} s for its terms") from None
    if done.returncode != 0 or not library.exists():
        reason = next((line for line in done.stderr.splitlines() if line.strip()), f"exit code {done.returncode}")
        raise InputError(f"{name}: the C compiler fails: {reason:.200}")


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
    import subprocess

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
