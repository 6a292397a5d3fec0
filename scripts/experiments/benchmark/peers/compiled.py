"""The C++ program beside this file, compiled when it is first wanted and gone with the process."""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

__all__ = ["compiler", "program", "version"]

SOURCE = Path(__file__).with_name("pinocchio_loop.cpp")
# The definitions that Pinocchio's headers need; otherwise as the native core is compiled.
FLAGS = [
    *("-std=c++17", "-O3", "-DNDEBUG", "-w"),
    *("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"),
    *("-DBOOST_FUSION_INVOKE_MAX_ARITY=12", "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION"),
]
PATIENCE = 300.0  # s


@cache
def program() -> tuple[Path, str | None]:
    """Return the program, and why there is none: no compiler, no headers, or what the compiler said."""
    folder = _folder()
    path, prefix = Path(folder.name) / "loop", _prefix()
    found = compiler()
    if found is None:
        return path, "no C++ compiler was found"
    if prefix is None or not (prefix / "include" / "eigen3").is_dir():
        return path, "Eigen's headers are missing: pip install cmeel-eigen"
    include = ["-isystem", str(prefix / "include"), "-isystem", str(prefix / "include" / "eigen3")]
    library = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-lpinocchio_default"]
    command = [found, *FLAGS, *include, str(SOURCE), "-o", str(path), *library]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=PATIENCE)
    except (OSError, subprocess.TimeoutExpired) as error:
        return path, f"it does not compile: {error}"
    if done.returncode:
        lines = done.stderr.splitlines()
        first = next((line for line in lines if "error" in line), lines[-1] if lines else "no message")
        return path, f"it does not compile: {' '.join(first.split())}"
    return path, None


@cache
def version() -> str:
    """Return the versions of what it is made of and with."""
    said = subprocess.run([compiler() or "c++", "--version"], capture_output=True, text=True).stdout.splitlines()[0]
    return f"{metadata.version('libpinocchio')}, Boost {metadata.version('cmeel-boost')}, {said}"


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="ckc_report_")  # removed when the process ends


def compiler() -> str | None:
    """Return the first C++ compiler on PATH, $CXX before others."""
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", "c++"), "c++", "g++", "clang++"))), None)


def _prefix() -> Path | None:
    """Return where Pinocchio's wheels keep headers and libraries; None for one that is not from a wheel."""
    try:
        return Path(str(metadata.distribution("libpinocchio").locate_file("cmeel.prefix"))).resolve()
    except metadata.PackageNotFoundError:
        return None
