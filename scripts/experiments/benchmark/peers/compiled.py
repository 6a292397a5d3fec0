"""Compile the C++ program next to this file at its first use, and keep it in the benchmark's cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

__all__ = ["compiler", "program", "version"]

SOURCE = Path(__file__).with_name("pinocchio_loop.cpp")
PROGRAMS = Path(__file__).resolve().parents[4] / ".cache" / "benchmark" / "programs"
# Definitions that Pinocchio's headers need. The other flags are those of the native core.
FLAGS = [
    *("-std=c++17", "-O3", "-DNDEBUG", "-w"),
    *("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"),
    *("-DBOOST_FUSION_INVOKE_MAX_ARITY=12", "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION"),
]
PATIENCE = 900.0  # s; lcaba is compiled here for all types of joints, two minutes of processor time


@cache
def program() -> tuple[Path, str | None]:
    """Return the path of the program, and why it is missing: no compiler, no headers, or the compiler's error."""
    prefix, executable = _prefix(), compiler()
    if executable is None:
        return PROGRAMS, "no C++ compiler was found"
    if prefix is None or not (prefix / "include" / "eigen3").is_dir():
        return PROGRAMS, "Eigen's headers are missing: pip install cmeel-eigen"
    include = ["-isystem", str(prefix / "include"), "-isystem", str(prefix / "include" / "eigen3")]
    library = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-lpinocchio_default"]
    command = [executable, *FLAGS, *include, str(SOURCE), *library]
    versions = [metadata.version(name) for name in ("libpinocchio", "cmeel-boost", "cmeel-eigen")]
    key = hashlib.sha256(" ".join([*command, *versions, SOURCE.read_text()]).encode()).hexdigest()[:16]
    path = PROGRAMS / f"loop_{key}"
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
