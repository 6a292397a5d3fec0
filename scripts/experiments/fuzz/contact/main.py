"""``fuzz --contact``: run seeds, print the table and write a CSV, or print the details of one case."""

from __future__ import annotations

import argparse
import csv
import pprint
import tempfile
from contextlib import nullcontext
from dataclasses import fields
from functools import partial
from pathlib import Path

from scripts.experiments.fuzz.contact.record import Record, check_seed, draw
from scripts.experiments.fuzz.contact.table import format_table
from scripts.experiments.fuzz.pool import map_seeds

__all__ = ["run"]

ALLOWED_CATEGORIES = ("stopped", "unsupported")


def run(options: argparse.Namespace) -> int:
    """Run the seeds and print the table. The exit code is 1 if there is a fault other than a stop with its reason.

    The CSV is written row by row, so that an interrupted run keeps its rows.
    """
    if options.one is not None:
        _show(options.one, options.kind)
        return 0
    seeds = range(options.seed, options.seed + options.runs)
    records: list[Record] = []
    with options.out.open("w", newline="", encoding="utf-8") if options.out else nullcontext() as file:
        writer = csv.DictWriter(file, [x.name for x in fields(Record)]) if file else None
        if writer:
            writer.writeheader()
        for record in map_seeds(partial(check_seed, kind=options.kind), seeds, options.jobs, "contact"):
            records.append(record)
            if file and writer:
                writer.writerow(record.row())
                file.flush()
    print(format_table(records))
    return 1 if any(x.category not in ALLOWED_CATEGORIES for record in records for x in record.faults) else 0


def _show(seed: int, kind: str | None) -> None:
    """Print the details of one seed: files, overrides and record."""
    case = draw(seed, kind)
    with tempfile.TemporaryDirectory() as folder:
        for file in sorted(case.write(Path(folder) / "case").iterdir()):
            print(f"--- {file.name}\n{file.read_text(encoding='utf-8')}")
    print("overrides =")
    pprint.pp(case.overrides, width=118, sort_dicts=False)
    for key, value in check_seed(seed, kind).row().items():
        print(f"{key:12s} {value}")
