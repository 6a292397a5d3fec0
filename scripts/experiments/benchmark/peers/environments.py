"""Make environments for programs that cannot be installed beside ckc_pin, and run them there as peers."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ckc_pin.analysis.precision.motion import Motion
from ckc_pin.errors import InputError
from scripts.experiments.benchmark.peers import Peer
from scripts.experiments.benchmark.peers.protocol import ProgramPeer
from scripts.experiments.benchmark.work import Work

__all__ = ["PROGRAMS", "Program", "find_python", "make_environment", "program_peers"]

SOURCES = Path(__file__).resolve().parents[1] / "peer_programs"
ENVIRONMENTS = Path(__file__).resolve().parents[4] / ".cache" / "peers"
INSTALLED = "requirements.txt"  # written when everything is installed
HINT = "./scripts/experiment benchmark --peers installs it"
INSTALL_S = 1200.0  # patience with the installation of an environment


@dataclass(frozen=True)
class Program:
    """A program of `peer_programs` with its environment.

    Attributes
    ----------
    name : str
        Name that the program introduces itself by.
    file : str
    python : str
        Version of Python, such as "3.12".
    requirements : tuple of str
        Exact versions of its packages.
    """

    name: str
    file: str
    python: str
    requirements: tuple[str, ...]

    @property
    def folder(self) -> Path:
        """The environment's folder."""
        key = hashlib.sha256(" ".join([self.python, *self.requirements]).encode()).hexdigest()[:8]
        return ENVIRONMENTS / f"{Path(self.file).stem}_{key}"

    @property
    def command(self) -> str | None:
        """The command line that starts the program; None without its environment."""
        if not (self.folder / INSTALLED).is_file():
            return None
        return f"'{self.folder / 'bin' / 'python'}' '{SOURCES / self.file}'"


# The versions of programs with an environment of their own.
PROGRAMS = (
    Program("Drake", "drake_peer.py", "3.12", ("drake==1.58.0", "numpy==2.5.5")),
    Program("MuJoCo 3", "mujoco_peer.py", "3.12", ("mujoco==3.17.0", "numpy==2.5.5")),
)


class Absent:
    """A program that cannot be run, with the reason."""

    packaged = True

    def __init__(self, name: str, reason: str) -> None:
        self.name, self._reason = name, reason

    def missing(self, work: Work) -> str:
        return self._reason

    def version(self) -> str:
        return ""

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        yield from ()

    def check(self, work: Work) -> str:
        return self._reason

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        raise InputError(f"{self.name}: {self._reason}")


@cache
def program_peers() -> tuple[Peer, ...]:
    """Return the programs of `PROGRAMS` as peers, made or not."""
    return tuple(map(_start, PROGRAMS))


def _start(program: Program) -> Peer:
    if program.command is None:
        return Absent(program.name, f"not installed: {HINT}")
    try:
        return ProgramPeer(program.command, program.name)
    except InputError as error:
        return Absent(program.name, str(error))


def make_environment(program: Program) -> str:
    """Make a program's environment if there is none; return a sentence on what was done or is missing."""
    if program.command:
        return f"{program.name}: installed"
    python = find_python(program.python)
    if python is None:
        return (
            f"{program.name}: {' '.join(program.requirements)} needs Python {program.python}, which was not found on "
            f"PATH, by pyenv or by uv; it is left out"
        )
    shutil.rmtree(program.folder, ignore_errors=True)
    pip = [str(program.folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    for command in ([python, "-m", "venv", str(program.folder)], [*pip, *program.requirements]):
        try:
            subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=INSTALL_S, check=True)
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or [f"exit code {error.returncode}"]
            return f"{program.name}: it could not be installed: {lines[-1]}; it is left out"
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{program.name}: it could not be installed: {error}; it is left out"
    (program.folder / INSTALLED).write_text("\n".join([*program.requirements, ""]), encoding="utf-8")
    program_peers.cache_clear()
    return f"{program.name}: installed in {program.folder}"


def find_python(version: str) -> str | None:
    """Return a Python of a version, such as "3.12": this one, from PATH, from pyenv or from uv."""
    return next((path for path in _pythons(version) if _run(path, "-c", CHECK) == version), None)


CHECK = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"


def _pythons(version: str) -> Iterator[str]:
    yield sys.executable
    yield f"python{version}"
    root = _run("pyenv", "root")
    if root:
        yield from map(str, sorted(Path(root, "versions").glob(f"{version}.*/bin/python"), reverse=True))
    path = _run("uv", "python", "find", "--no-project", version)
    if path:
        yield path


def _run(*command: str) -> str:
    """Return what a command prints; empty if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=60, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
