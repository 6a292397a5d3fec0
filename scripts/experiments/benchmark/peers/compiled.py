"""Compile C++ programs at their first use, and keep them in the benchmark's cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

__all__ = ["compile_program", "compiler", "program", "version"]

SOURCE = Path(__file__).with_name("pinocchio_loop.cpp")
PROGRAMS = Path(__file__).resolve().parents[4] / ".cache" / "benchmark" / "programs"
# Definitions that Pinocchio's headers need. The other flags are those of the native core.
FLAGS = [
    *("-std=c++17", "-O3", "-DNDEBUG", "-w"),
    *("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"),
    *("-DBOOST_FUSION_INVOKE_MAX_ARITY=12", "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION"),
]
PATIENCE = 1800.0  # s; lcaba is compiled here for all types of joints, two minutes of processor time


@cache
def program() -> tuple[Path, str | None]:
    """Return the path of the loop on Pinocchio next to this file, and why it is missing."""
    return compile_program([SOURCE], FLAGS, ["pinocchio_default"])


def compile_program(
    sources: Sequence[Path], flags: Sequence[str] = (), libraries: Sequence[str] = ()
) -> tuple[Path, str | None]:
    """Return the path of a program, and why it is missing: no compiler, no headers, or the compiler's error.

    Parameters
    ----------
    sources : sequence of Path
        The file to compile, then its own headers.
    flags, libraries : sequence of str
        Beside the folders of the headers of Eigen, Boost and Pinocchio.
    """
    prefix, executable = _prefix(), compiler()
    if executable is None:
        return PROGRAMS, "no C++ compiler was found"
    if prefix is None or not (prefix / "include" / "eigen3").is_dir():
        return PROGRAMS, "Eigen's headers are missing: pip install cmeel-eigen"
    include = ["-isystem", str(prefix / "include"), "-isystem", str(prefix / "include" / "eigen3")]
    link = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", *(f"-l{name}" for name in libraries)]
    command = [executable, *flags, *include, str(sources[0]), *link]
    versions = [metadata.version(name) for name in ("libpinocchio", "cmeel-boost", "cmeel-eigen")]
    content = " ".join([*command, *versions, *(source.read_text(encoding="utf-8") for source in sources)])
    path = PROGRAMS / f"{sources[0].stem}_{hashlib.sha256(content.encode()).hexdigest()[:16]}"
    return path, None if path.exists() else _compile(command, path)


def _compile(command: list[str], path: Path) -> str | None:
    """Compile a program; return why it does not compile, None if it does. The file appears when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        try:
            done = subprocess.run(
                [*command, "-o", str(made)], capture_output=True, text=True, errors="replace", timeout=PATIENCE
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"it does not compile: {error}"
        if done.returncode:
            lines = done.stderr.splitlines()
            first = next((line for line in lines if "error" in line), lines[-1] if lines else "no message")
            return f"it does not compile: {' '.join(first.split())}"
        made.replace(path)
    return None


@cache
def version() -> str:
    """Return the versions of Pinocchio, Boost and the compiler."""
    render_blocks = subprocess.run(
        [compiler() or "c++", "--version"], capture_output=True, text=True
    ).stdout.splitlines()[0]
    return f"{metadata.version('libpinocchio')}, Boost {metadata.version('cmeel-boost')}, {render_blocks}"


def compiler() -> str | None:
    """Return the first C++ compiler on PATH, $CXX before others."""
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", "c++"), "c++", "g++", "clang++"))), None)


def _prefix() -> Path | None:
    """Return the folder of headers and libraries in Pinocchio's wheels, None for a Pinocchio from elsewhere."""
    try:
        return Path(str(metadata.distribution("libpinocchio").locate_file("cmeel.prefix"))).resolve()
    except metadata.PackageNotFoundError:
        return None
