"""The command's part for contact: seeds one after another or in processes, a table, a CSV, or one case at length."""

from __future__ import annotations

import argparse
import csv
import os
import pprint
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from itertools import repeat
from pathlib import Path

from scripts.experiments.fuzz.contact.record import Record, draw, judge_seed
from scripts.experiments.fuzz.contact.table import table

__all__ = ["run"]

EXPECTED = ("stopped", "unjudged")


def run(options: argparse.Namespace) -> int:
    """Run the seeds and print the table; exit code 1 where anything is wrong but a stop with joint and reason."""
    if options.one is not None:
        _show(options.one, options.kind)
        return 0
    seeds = range(options.seed, options.seed + options.runs)
    records: list[Record] = []
    with _Rows(options.out) as rows:
        if options.jobs > 1:
            with ProcessPoolExecutor(options.jobs, initializer=_use_one_thread) as pool:
                found = pool.map(judge_seed, seeds, repeat(options.kind), chunksize=4)
                records = [rows.add(record, len(seeds)) for record in found]
        else:
            records = [rows.add(judge_seed(seed, options.kind), len(seeds)) for seed in seeds]
    print(table(records))
    return 1 if any(x.category not in EXPECTED for record in records for x in record.findings) else 0


class _Rows:
    """Writes each record to a CSV at once, so that an interrupted run keeps its rows; counts them on a terminal."""

    def __init__(self, path: Path | None) -> None:
        self.file = path.open("w", newline="", encoding="utf-8") if path else None
        self.count = 0

    def __enter__(self) -> _Rows:
        if self.file:
            self.writer = csv.DictWriter(self.file, [x.name for x in fields(Record)])
            self.writer.writeheader()
        return self

    def __exit__(self, *_: object) -> None:
        if self.file:
            self.file.close()

    def add(self, record: Record, total: int) -> Record:
        self.count += 1
        if self.file:
            self.writer.writerow(record.row())
            self.file.flush()
        if sys.stderr.isatty():
            print(
                f"\rcontact {self.count}/{total}", end="\n" if self.count == total else "", file=sys.stderr, flush=True
            )
        return record


def _show(seed: int, kind: str | None) -> None:
    """One seed at length: its files, its scene, its record."""
    case = draw(seed, kind)
    with tempfile.TemporaryDirectory() as folder:
        for file in sorted(case.write(Path(folder) / "case").iterdir()):
            print(f"--- {file.name}\n{file.read_text(encoding='utf-8')}")
    print("overrides =")
    pprint.pp(case.overrides, width=118, sort_dicts=False)
    for key, value in judge_seed(seed, kind).row().items():
        print(f"{key:12s} {value}")


def _use_one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
