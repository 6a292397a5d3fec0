"""The report's rows on disk: a CSV that a stopped report goes on from, and in which no stale row looks right."""

from __future__ import annotations

import csv
import hashlib
import json
import platform
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from ckc_pin.errors import InputError
from ckc_pin.study.report.row import Row
from ckc_pin.study.report.work import Work

__all__ = ["Table", "key", "machine", "versions"]

PACKAGES = ("pin", "numpy", "scipy")


class Table:
    """Rows by key; each is on disk as soon as it is added.

    Parameters
    ----------
    path : Path
        Of the CSV; read if it is there.

    Raises
    ------
    InputError
        The file is not a report's, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, Row] = {}
        if path.exists():
            self.rows = {row.key: row for row in _read(path)}

    def add(self, row: Row) -> None:
        """Add a row."""
        self.rows[row.key] = row
        self.write(self.rows)

    def write(self, keys: Iterable[str]) -> None:
        """Write the rows of these keys, and no others."""
        columns = Row.__struct_fields__
        unfinished = self.path.with_suffix(".part")
        try:
            with unfinished.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(columns)
                for k in keys:
                    values = msgspec.to_builtins(self.rows[k])
                    writer.writerow(["" if values[name] is None else values[name] for name in columns])
            unfinished.replace(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None


def _read(path: Path) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            if tuple(lines.fieldnames or ()) != Row.__struct_fields__:
                raise ValueError("its columns are others")
            plain = [{k: x for k, x in line.items() if x or k == "reason"} for line in lines]
        defaults: dict[str, Any] = dict.fromkeys(Row.__struct_fields__)
        return [msgspec.convert({**defaults, **line}, Row, strict=False) for line in plain]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: not a report's table ({error}); move it away or give another --out") from None


def key(work: Work, program: str, version: str, setting: str) -> str:
    """Return what a row depends on as a hash: scene, texts, code, versions, machine, setting."""
    scene = work.load()
    texts = {**work.mechanism.sources.texts, **scene.sources.texts}
    content = [scene.plain(), texts, _code(), versions(), machine(), program, version, setting]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _code() -> str:
    """Return a hash of the package's own files: a changed line makes old rows stale."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].rglob("*")):
        if path.suffix in (".py", ".cpp", ".hpp"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def versions() -> dict[str, str]:
    """Return the versions that times and errors depend on."""
    from importlib import metadata

    return {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}}


@cache
def machine() -> str:
    """Return the processor and how many of it."""
    import os

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores"
