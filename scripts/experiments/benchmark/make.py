"""The benchmark: runs the studies that have no row yet, then writes tables, figures and page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec

from ckc_pin.errors import CkcError, InputError
from ckc_pin.simulation.prepare import scene_mechanism
from ckc_pin.simulation.scene import load_scene
from scripts.experiments.benchmark import growth, left_out, ours
from scripts.experiments.benchmark.figure import draw, draw_main
from scripts.experiments.benchmark.growth import Growth
from scripts.experiments.benchmark.growth_said import draw_growth
from scripts.experiments.benchmark.left_out import LeftOut
from scripts.experiments.benchmark.page import Measured, PeerNote, markdown
from scripts.experiments.benchmark.peers import Peer, peers
from scripts.experiments.benchmark.reference import Reference, reference
from scripts.experiments.benchmark.row import Motion, Row, judged
from scripts.experiments.benchmark.table import Table, digest, key
from scripts.experiments.benchmark.work import WORKS, Budget, Work

__all__ = ["Report", "report"]

ROOT = Path(__file__).resolve().parents[3]
BUDGET = Budget(own=1.5, peer=2.0)

Progress = Callable[[str], None]  # what is being measured


@dataclass
class Report:
    """A report on disk.

    Attributes
    ----------
    files : list of Path
        The page, the tables, the figures.
    rows : dict of str to list of Row
        By work.
    """

    files: list[Path] = field(default_factory=list)
    rows: dict[str, list[Row]] = field(default_factory=dict)


def report(out: Path, *, quick: bool = False, progress: Progress | None = None) -> Report:
    """Measure what has not been measured yet, and write the report.

    Parameters
    ----------
    out : Path
        Folder; a report there is gone on with, as far as its rows still hold.
    quick : bool
        Fewer motions, methods and tolerances.
    progress : callable, optional
        Told what is being measured.

    Raises
    ------
    InputError
        The folder cannot be written to, or has another table in it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be made: {error.strerror}") from None
    tell = progress or (lambda said: None)
    works, unmade = _at_hand(quick)
    table, found, references = Table(out / "report.csv", Row), Report(), {}
    others = peers()
    for work in works:
        measured = _Measured(work, table, tell)
        found.rows[work.key] = [*measured.ours(quick), *(row for peer in others for row in measured.peer(peer, quick))]
        references[work.key] = measured.reference()
    table.write([row.key for rows in found.rows.values() for row in rows])
    notes = [_checked(peer, works) for peer in others]
    grown, left = _grown(out, quick, tell), _left_out(out, works, quick, tell)
    figures = _figures(works, found.rows, [peer.name for peer in others], grown, out)
    text = markdown(Measured(works, unmade, BUDGET, found.rows, references, notes, left, grown, quick))
    (out / "report.md").write_text(text, encoding="utf-8")
    tables = ("report.csv", "growth.csv", "left_out.csv")
    found.files = [out / name for name in ("report.md", *tables, *figures)]
    return found


def _at_hand(quick: bool) -> tuple[list[Work], dict[str, str]]:
    """Works that can be measured here, and by what they are called why the others cannot: robots not installed."""
    works, unmade = [], {}
    for work in WORKS:
        if quick and not work.quick:
            continue
        try:
            _ = work.mechanism  # loaded here, and kept by the work
        except CkcError as error:
            unmade[work.says] = str(error)
        else:
            works.append(work)
    return works, unmade


def _figures(
    works: list[Work], rows: dict[str, list[Row]], others: list[str], grown: list[Growth], out: Path
) -> list[str]:
    figures = [draw_main(works, rows, others, out), draw_growth(grown, rows, out)]
    return [*figures, *(draw(work, rows[work.key], others, out) for work in works)]


class _Measured:
    """A work's rows, from the table where they are there already."""

    def __init__(self, work: Work, table: Table[Row], progress: Progress) -> None:
        self.work, self.table, self.progress = work, table, progress
        self._reference: Reference | None = None

    def reference(self) -> Reference:
        if self._reference is None:
            self.progress(f"{self.work.key}: reference")
            self._reference = reference(self.work)
        return self._reference

    def ours(self, quick: bool) -> Iterator[Row]:
        """Rows of this program; what used up its budget at one tolerance is not tried with a tighter one."""
        spent: dict[str, str] = {}
        for setting in ours.settings(quick):
            compute = partial(ours.compute, self.work, setting.changes, BUDGET.own)
            if setting.family in spent:
                compute = partial(ours.refused, self.work, spent[setting.family])
            row = self._row(ours.PROGRAM, "", setting.name, compute)
            if ours.used_up(row):
                spent[setting.family] = f"not tried: at rtol {setting.rtol:.0e} the {row.reason}"
            yield row

    def peer(self, peer: Peer, quick: bool) -> Iterator[Row]:
        """Rows of another program."""
        if peer.missing(self.work) is not None:
            return
        for setting in peer.settings(self.work, quick):
            yield self._row(peer.name, peer.version(), setting, partial(peer.compute, self.work, setting, BUDGET.peer))

    def _row(self, program: str, version: str, setting: str, compute: Callable[[], Motion]) -> Row:
        own = key(self.work, program, version, setting)
        if own not in self.table.rows:
            self.progress(f"{self.work.key}: {program}, {setting}")
            self.table.add(judged(own, self.work, program, setting, compute(), self.reference()))
        return self.table.rows[own]


def _checked(peer: Peer, works: list[Work]) -> PeerNote:
    said, version = {}, ""
    for work in works:
        missing = peer.missing(work)
        if missing is None:
            version = peer.version()
            said[work.key] = peer.check(work)
        else:
            said[work.key] = f"not compared, {missing}"
    return PeerNote(peer.name, version, peer.packaged, said)


def _grown(out: Path, quick: bool, progress: Progress) -> list[Growth]:
    """How cost grows: rows of the table, measured where it has none."""
    table, found = Table(out / "growth.csv", Growth), []
    for family, case, formulation in growth.every_case(quick):
        own = digest("growth", family.key, msgspec.to_builtins(case), formulation)
        if own not in table.rows:
            progress(f"growth: {family.says}, {getattr(case, family.along)}, {formulation}")
            table.add(growth.measure(case, family, formulation, own))
        found.append(table.rows[own])
    table.write([row.key for row in found])
    return found


def _left_out(out: Path, works: list[Work], quick: bool, progress: Progress) -> list[LeftOut]:
    """What scenes leave out: rows of the table, measured where it has none."""
    table = Table(out / "left_out.csv", LeftOut)
    scenes = list(dict.fromkeys(work.load().name for work in works)) if quick else left_out.every_scene()
    found: list[LeftOut] = []

    def measured(names: Iterable[str], own: str, said: str, compute: Callable[[str], Iterator[LeftOut]]) -> None:
        keys = [f"{own}.{name}" for name in names]
        if not all(k in table.rows for k in keys):
            progress(f"left out: {said}")
            table.add(*compute(own))
        found.extend(table.rows[k] for k in keys)

    repeats = 1 if quick else left_out.REPEATS
    costs = digest("module costs", repeats)
    measured(left_out.MODULES, costs, "modules", partial(left_out.module_costs, repeats=repeats))
    for name in scenes:
        try:
            scene = load_scene(name)
            content = [scene.plain(), {**scene_mechanism(scene).sources.texts, **scene.sources.texts}]
        except CkcError as error:  # robots that are not installed
            found.append(LeftOut(key=digest("scene", name), scene=name, what=left_out.MISSING, reason=str(error)))
            table.add(found[-1])
            continue
        measured(left_out.MODULES, digest("modules", *content), name, partial(left_out.modules_of, name))
        measured(left_out.TERMS, digest("terms", *content), name, partial(left_out.terms_of, name))
    table.write([row.key for row in found])
    return found


def main(arguments: list[str] | None = None) -> int:
    """Make the report."""
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer motions, methods and tolerances: minutes")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "report", help="a report there is gone on with")
    options = parser.parse_args(arguments)
    try:
        found = report(options.out, quick=options.quick, progress=lambda said: print(said, file=sys.stderr, flush=True))
    except CkcError as error:
        parser.error(str(error))
    for path in found.files:
        print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
