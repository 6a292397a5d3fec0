"""`ckc report`: runs the studies that have no row yet, then writes table, figures and page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ckc_pin.errors import InputError
from ckc_pin.study.report import ours
from ckc_pin.study.report.figure import draw
from ckc_pin.study.report.page import markdown, web
from ckc_pin.study.report.peers import Peer, peers
from ckc_pin.study.report.reference import Reference, reference
from ckc_pin.study.report.row import Motion, Row, judged
from ckc_pin.study.report.table import Table, key
from ckc_pin.study.report.work import WORKS, Work

__all__ = ["Report", "report"]

BUDGET, QUICK_BUDGET = 60.0, 2.0  # s for one run

Progress = Callable[[str], None]  # what is being measured


@dataclass
class Report:
    """A report on disk.

    Attributes
    ----------
    files : list of Path
        The page in two forms, the table, the figures.
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
    works = [work for work in WORKS if work.quick or not quick]
    table, found, references = Table(out / "report.csv"), Report(), {}
    others = peers()
    for work in works:
        measured = _Measured(work, table, progress or (lambda said: None))
        found.rows[work.key] = [*measured.ours(quick), *(row for peer in others for row in measured.peer(peer, quick))]
        references[work.key] = measured.reference()
    table.write([row.key for rows in found.rows.values() for row in rows])
    text = markdown(works, found.rows, references, [_checked(peer, works) for peer in others], quick)
    figures = [name for work in works for name in draw(work, found.rows[work.key], out)]
    for name, content in (("report.md", text), ("report.html", web(text, out))):
        (out / name).write_text(content, encoding="utf-8")
    found.files = [out / name for name in ("report.html", "report.md", "report.csv", *figures)]
    return found


class _Measured:
    """A work's rows, from the table where they are there already."""

    def __init__(self, work: Work, table: Table, progress: Progress) -> None:
        self.work, self.table, self.progress = work, table, progress
        self._reference: Reference | None = None

    def reference(self) -> Reference:
        if self._reference is None:
            self.progress(f"{self.work.key}: reference")
            self._reference = reference(self.work)
        return self._reference

    def ours(self, quick: bool) -> Iterator[Row]:
        for setting in ours.settings(quick, QUICK_BUDGET if quick else BUDGET):
            yield self._row(ours.PROGRAM, "", setting.name, partial(ours.compute, self.work, setting))

    def peer(self, peer: Peer, quick: bool) -> Iterator[Row]:
        if peer.missing(self.work) is not None:
            return
        budget = QUICK_BUDGET if quick else BUDGET
        for setting in peer.settings(quick):
            yield self._row(peer.name, peer.version(), setting, partial(peer.compute, self.work, setting, budget))

    def _row(self, program: str, version: str, setting: str, compute: Callable[[], Motion]) -> Row:
        own = key(self.work, program, version, setting)
        if own not in self.table.rows:
            self.progress(f"{self.work.key}: {program}, {setting}")
            self.table.add(judged(own, self.work, program, setting, compute(), self.reference()))
        return self.table.rows[own]


def _checked(peer: Peer, works: list[Work]) -> tuple[str, str, dict[str, str]]:
    said, version = {}, ""
    for work in works:
        missing = peer.missing(work)
        if missing is None:
            version = peer.version()
            said[work.key] = peer.check(work)
        else:
            said[work.key] = f"not compared, {missing}"
    return peer.name, version, said
