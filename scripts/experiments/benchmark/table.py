"""The report's rows on disk: CSVs that a stopped report goes on from, and in which no stale row looks right."""

from __future__ import annotations

import csv
import hashlib
import json
import platform
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

import ckc_pin
from ckc_pin.errors import InputError
from scripts.experiments.benchmark.work import Work

__all__ = ["Keyed", "Table", "digest", "key", "machine", "versions"]

PACKAGES = ("pin", "numpy", "scipy")


class Keyed(msgspec.Struct, frozen=True, kw_only=True):
    """A row of some kind; `key` is a hash of what it depends on."""

    key: str


R = TypeVar("R", bound=Keyed)


class Table(Generic[R]):
    """Rows by key; each is on disk as soon as it is added.

    Parameters
    ----------
    path : Path
        Of the CSV; read if it is there.
    kind : type
        Of its rows, a flat msgspec.Struct.

    Raises
    ------
    InputError
        The file is not a report's, or cannot be written.
    """

    def __init__(self, path: Path, kind: type[R]) -> None:
        self.path = path
        self._columns = [field.name for field in msgspec.structs.fields(kind)]
        self.rows: dict[str, R] = {row.key: row for row in _read(path, kind)} if path.exists() else {}

    def add(self, *rows: R) -> None:
        """Add rows."""
        self.rows.update((row.key, row) for row in rows)
        self.write(self.rows)

    def write(self, keys: Iterable[str]) -> None:
        """Write the rows of these keys, and no others."""
        columns = self._columns
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


def _read(path: Path, kind: type[R]) -> list[R]:
    fields = msgspec.structs.fields(kind)
    words = {field.name for field in fields if field.type is str}  # of other columns an empty cell is None
    absent: dict[str, Any] = {field.name: "" if field.name in words else None for field in fields}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            if list(lines.fieldnames or ()) != list(absent):
                raise ValueError("its columns are others")
            plain = [{**absent, **{name: x for name, x in line.items() if x}} for line in lines]
        return [msgspec.convert(line, kind, strict=False) for line in plain]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: not a report's table ({error}); move it away or give another --out") from None


def key(work: Work, program: str, version: str, setting: str) -> str:
    """Return what a row depends on as a hash: scene, texts, code, versions, machine, setting."""
    scene = work.load()
    texts = {**work.mechanism.sources.texts, **scene.sources.texts}
    return digest(scene.plain(), texts, program, version, setting)


def digest(*content: Any) -> str:
    """Return a hash of plain data, the package's code, the versions and the machine."""
    whole = [*content, _code(), versions(), machine()]
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _code() -> str:
    """Return a hash of the package's own files: a changed line makes old rows stale."""
    digest = hashlib.sha256()
    for path in sorted(p for root in (Path(ckc_pin.__file__).parent, Path(__file__).parent) for p in root.rglob("*")):
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
