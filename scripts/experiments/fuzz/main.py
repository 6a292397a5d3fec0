"""Fuzz suite: random motions of shipped and random mechanisms, compared with an independent integration.

``./scripts/experiment fuzz [--runs N] [--seed S] [--shipped | --random] [--mechanism NAME] [--jobs J] [--out FILE]``
runs the seeds S ... S + N - 1 and prints a table; ``--out`` also writes a CSV. ``--one SEED`` prints details of a seed.
With ``--contact`` the mechanisms have stops, impacts and dry friction (`contact/`); ``--kind`` selects one kind.
``--derivatives`` compares sensitivities through impacts, stops and friction with one-sided differences instead.
"""

from __future__ import annotations

import argparse
import csv
import pprint
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any

from ckc_pin.errors import CkcError
from scripts.experiments.fuzz.contact import main as contact
from scripts.experiments.fuzz.contact.record import KINDS
from scripts.experiments.fuzz.derivatives import ColumnCheck, check_sensitivities, format_columns, is_wrong
from scripts.experiments.fuzz.motions import SHIPPED, Motion, random_motion, shipped_motion
from scripts.experiments.fuzz.pool import map_seeds
from scripts.experiments.fuzz.record import FIELDS, Record, run_motion
from scripts.experiments.fuzz.shrink import shrink
from scripts.experiments.fuzz.table import format_table

__all__ = ["check_seed", "main", "open_motion"]

THOROUGH_EVERY = 5  # every fifth seed is also checked with a reversed run and next to a turning point


@contextmanager
def open_motion(seed: int, kind: str, name: str | None) -> Iterator[Motion]:
    """Yield a seed's motion. The files of a random mechanism exist until the context is left."""
    if kind == "shipped":
        yield shipped_motion(seed, name)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield random_motion(seed, Path(folder) / "mechanism")


def check_seed(seed: int, kind: str, name: str | None = None) -> Record:
    """Draw, run and check the motion of one seed."""
    try:
        with open_motion(seed, kind, name) as motion:
            return run_motion(motion, thorough=seed % THOROUGH_EVERY == 0)[0]
    except CkcError as error:
        return Record(seed, name or kind, status="refused", message=str(error), verdict="refused")
    except Exception as error:  # raised while drawing, for example by load or sigma
        message = f"{type(error).__name__}: {error}"
        return Record(seed, name or kind, status="exception", message=message, verdict="EXCEPTION")


def show_seed(seed: int, kind: str, name: str | None, *, shrunk: bool = False) -> None:
    """Print the details of one seed: scene, overrides, files, record and statistics."""
    with open_motion(seed, kind, name) as motion:
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
    """Run the suite; return exit code 1 if a run is wrong or raises an unexpected exception."""
    parser = argparse.ArgumentParser(
        prog="fuzz", description=__doc__.splitlines()[0] if __doc__ else "", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=100, help="number of seeds")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--one", type=int, metavar="SEED", help="print the details of one seed")
    parser.add_argument("--shrink", action="store_true", help="with --one: find a smaller run with the same failure")
    parser.add_argument("--shipped", action="store_true", help="shipped mechanisms only")
    parser.add_argument("--random", action="store_true", help="random mechanisms only")
    parser.add_argument("--contact", action="store_true", help="stops, impacts and dry friction, in all formulations")
    parser.add_argument("--kind", choices=sorted(KINDS), help="with --contact: this kind of mechanism only")
    parser.add_argument("--derivatives", action="store_true", help="sensitivities of scenes with friction and stops")
    parser.add_argument("--mechanism", choices=sorted(SHIPPED), help="this shipped mechanism only")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--out", type=Path, metavar="FILE.csv", help="write a row for each run")
    options = parser.parse_args(arguments)
    if options.contact:
        return contact.run(options)
    if options.derivatives:
        return _check_derivatives(options)
    kinds = [kind for kind in ("shipped", "random") if getattr(options, kind)] or ["shipped", "random"]
    kinds = ["shipped"] if options.mechanism else kinds
    if options.one is not None:
        show_seed(options.one, kinds[0], options.mechanism, shrunk=options.shrink)
        return 0
    records: list[Record] = []
    for kind in kinds:
        check = partial(check_seed, kind=kind, name=options.mechanism)
        records += map_seeds(check, range(options.seed, options.seed + options.runs), options.jobs, kind)
    print(format_table(records))
    if options.out:
        _write_csv(options.out, FIELDS, [record.row() for record in records])
    return 1 if any(record.verdict in ("EXCEPTION", "WRONG") for record in records) else 0


def _check_derivatives(options: argparse.Namespace) -> int:
    """Compare sensitivities with differences; return exit code 1 if one is wrong."""
    seeds = range(options.seed, options.seed + options.runs) if options.one is None else [options.one]
    by_seed = map_seeds(check_sensitivities, seeds, options.jobs, "derivatives")
    columns = [column for of_seed in by_seed for column in of_seed]
    print(format_columns(columns))
    if options.out:
        names = [x.name for x in fields(ColumnCheck)]
        _write_csv(options.out, [*names, "result"], [asdict(x) | {"result": x.result} for x in columns])
    return 1 if any(map(is_wrong, columns)) else 0


def _write_csv(path: Path, names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
