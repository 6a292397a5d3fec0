"""Cache keys of measurements: hashes of code, versions and machine. A changed line of code makes old entries stale."""

from __future__ import annotations

import os
import platform
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import joblib

import ckc_pin
from scripts.experiments.benchmark.work import Work

__all__ = ["machine", "stamp", "versions", "work_stamp"]

PACKAGES = ("pin", "numpy", "scipy")


def stamp(*content: Any) -> str:
    """Return a hash of JSON-like data, the package's code, the versions and the machine."""
    return str(joblib.hash([*content, _code(), versions(), machine()]))


def work_stamp(work: Work, version: str = "") -> str:
    """Return a hash of everything that a run of a work depends on: scene, texts, code, versions, machine."""
    scene = work.load()
    return stamp(scene.to_dict(), {**work.mechanism.sources.texts, **scene.sources.texts}, version, work.terms)


@cache
def _code() -> str:
    roots = (Path(ckc_pin.__file__).parent, Path(__file__).parent)
    files = sorted(path for root in roots for path in root.rglob("*") if path.suffix in (".py", ".cpp", ".hpp"))
    return str(joblib.hash([path.read_bytes() for path in files]))


@cache
def versions() -> dict[str, str]:
    """Return the versions that times and errors depend on."""
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}}


@cache
def machine() -> str:
    """Return the name of the processor and the number of cores."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{[*names, platform.processor() or platform.machine()][0]}, {os.cpu_count()} cores"
