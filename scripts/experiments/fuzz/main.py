"""The fuzz suite: random motions of shipped and of random mechanisms, judged by an integration of its own.

``./scripts/experiment fuzz [--runs N] [--seed S] [--shipped | --random] [--mechanism NAME] [--jobs J] [--out FILE]``
runs the seeds S ... S + N - 1 and prints a table, with --out writes a CSV; ``--one SEED`` shows one of them at length.
With ``--contact`` the mechanisms have stops, impacts and dry friction (`contact/`); ``--kind`` chooses one kind.
``--derivatives`` compares sensitivities through impacts, stops and friction with one-sided differences instead.
"""

from __future__ import annotations

import argparse
import csv
import os
import pprint
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, fields
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.contact import main as contact
from scripts.experiments.fuzz.contact.record import KINDS
from scripts.experiments.fuzz.derivatives import JudgedColumn, columns_of, columns_table, is_wrong
from scripts.experiments.fuzz.motions import SHIPPED, Motion, random_motion, shipped_motion
from scripts.experiments.fuzz.record import FIELDS, Record, run_motion
from scripts.experiments.fuzz.shrink import shrink
from scripts.experiments.fuzz.table import table

__all__ = ["main", "one"]

T = TypeVar("T")
SHARE_THOROUGH = 5  # every fifth is judged by runs back and beside a turn too


@contextmanager
def drawn(seed: int, kind: str, name: str | None) -> Iterator[Motion]:
    """A seed's motion; a random mechanism's files are there as long as the context."""
    if kind == "shipped":
        yield shipped_motion(seed, name)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield random_motion(seed, Path(folder) / "mechanism")


def one(seed: int, kind: str, name: str | None = None) -> Record:
    """Draw, run and judge one seed."""
    try:
        with drawn(seed, kind, name) as motion:
            return run_motion(motion, thorough=seed % SHARE_THOROUGH == 0)[0]
    except CkcError as error:
        return Record(seed, name or kind, status="refused", message=str(error), verdict="refused")
    except Exception as error:  # while drawing: loading, sigma
        return Record(seed, name or kind, status="raw", message=f"{type(error).__name__}: {error}", verdict="RAW")


def show(seed: int, kind: str, name: str | None, *, shrunk: bool = False) -> None:
    """One seed at length: its scene, its overrides, its record."""
    with drawn(seed, kind, name) as motion:
        motion = shrink(motion) if shrunk else motion
        print(f"{motion.mechanism}: ckc_pin.simulate({motion.scene!r}, overrides) with overrides =")
        pprint.pp(motion.overrides, width=118, sort_dicts=False)
        if kind == "random":
            for file in sorted(Path(motion.scene).iterdir()):
                print(f"--- {file.name}\n{file.read_text(encoding='utf-8')}")
        record, run = run_motion(motion, thorough=True)
        for key, value in record.row().items():
            print(f"{key:12s} {value}")
        if run is not None:
            print(f"events       {run.events[:4]}\nstats        {run.stats}")


EXAMPLES = """Examples:
  ./scripts/experiment fuzz --runs 200
  ./scripts/experiment fuzz --one 17 --shipped --shrink
  ./scripts/experiment fuzz --contact --seed 1000 --runs 500 --out contact.csv
  ./scripts/experiment fuzz --contact --kind gripper --runs 200
  ./scripts/experiment fuzz --derivatives --runs 250 --jobs 2"""


def main(arguments: list[str]) -> int:
    """Run the suite."""
    parser = argparse.ArgumentParser(
        prog="fuzz", description=__doc__.splitlines()[0] if __doc__ else "", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", type=int, metavar="SEED")
    parser.add_argument("--shrink", action="store_true", help="with --one: a smaller run that fails alike")
    parser.add_argument("--shipped", action="store_true")
    parser.add_argument("--random", action="store_true")
    parser.add_argument("--contact", action="store_true", help="stops, impacts and dry friction, in all formulations")
    parser.add_argument("--kind", choices=sorted(KINDS), help="with --contact: this kind of mechanism only")
    parser.add_argument("--derivatives", action="store_true", help="sensitivities of scenes with friction and stops")
    parser.add_argument("--mechanism", choices=sorted(SHIPPED), help="of the shipped ones, this one only")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, metavar="FILE.csv")
    given = parser.parse_args(arguments)
    if given.contact:
        return contact.run(given)
    if given.derivatives:
        return _derivatives(range(given.seed, given.seed + given.runs) if given.one is None else [given.one], given)
    kinds = [kind for kind in ("shipped", "random") if getattr(given, kind)] or ["shipped", "random"]
    kinds = ["shipped"] if given.mechanism else kinds
    if given.one is not None:
        show(given.one, kinds[0], given.mechanism, shrunk=given.shrink)
        return 0
    records: list[Record] = []
    for kind in kinds:
        seeds = range(given.seed, given.seed + given.runs)
        if given.jobs > 1:
            with ProcessPoolExecutor(given.jobs, initializer=_single_thread) as pool:
                found = pool.map(one, seeds, repeat(kind), repeat(given.mechanism), chunksize=4)
                records += _counted(found, kind, given.runs)
        else:
            records += _counted((one(seed, kind, given.mechanism) for seed in seeds), kind, given.runs)
    print(table(records))
    if given.out:
        _write_csv(given.out, FIELDS, [record.row() for record in records])
    return 1 if any(record.verdict in ("RAW", "WRONG") for record in records) else 0


def _derivatives(seeds: Sequence[int], given: argparse.Namespace) -> int:
    """Compare sensitivities with differences; 1 where one is wrong."""
    if given.jobs > 1:
        with ProcessPoolExecutor(given.jobs, initializer=_single_thread) as pool:
            by_seed = _counted(pool.map(columns_of, seeds, chunksize=4), "derivatives", len(seeds))
    else:
        by_seed = _counted(map(columns_of, seeds), "derivatives", len(seeds))
    columns = [column for found in by_seed for column in found]
    print(columns_table(columns))
    if given.out:
        names = [x.name for x in fields(JudgedColumn)]
        _write_csv(given.out, [*names, "result"], [asdict(x) | {"result": x.result} for x in columns])
    return 1 if any(map(is_wrong, columns)) else 0


def _write_csv(path: Path, names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def _counted(records: Iterator[T], kind: str, count: int) -> list[T]:
    """Collect records, and say on a terminal how far it is."""
    found: list[T] = []
    for record in records:
        found.append(record)
        if sys.stderr.isatty():
            print(f"\r{kind} {len(found)}/{count}", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    return found


def _single_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
