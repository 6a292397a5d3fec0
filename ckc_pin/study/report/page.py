"""The report as one page, in Markdown and in HTML that opens without anything else."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from ckc_pin.study.markdown import escaped, table
from ckc_pin.study.report.reference import Reference
from ckc_pin.study.report.row import Row
from ckc_pin.study.report.sentences import TARGETS, fastest, sentences
from ckc_pin.study.report.table import machine, versions
from ckc_pin.study.report.work import Work

__all__ = ["markdown", "web"]

STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}table{border-collapse:collapse;"
    "font-size:.85rem}td,th{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:left}img{max-width:100%}"
)


def markdown(
    works: Sequence[Work],
    rows: Mapping[str, Sequence[Row]],
    references: Mapping[str, Reference],
    peers: Sequence[tuple[str, str, Mapping[str, str]]],
    quick: bool,
) -> str:
    """Return the page.

    Parameters
    ----------
    works : sequence of Work
    rows, references : mappings by the work's key
    peers : sequence of (name, version, {work: what was checked, or why it is missing})
    quick : bool
        Whether it is the quick report, which says so.
    """
    lines = ["# Error against run time", "", *_method(quick), ""]
    for work in works:
        own = rows[work.key]
        lines += [f"## {work.says}", "", f"Reference: {escaped(references[work.key].how)}.", ""]
        lines += [f"- {escaped(said)}" for said in sentences(work, own, references[work.key])]
        lines += ["", f"![{work.says}]({work.key}.png)", "", *_best(own), ""]
        checks = [f"{name} {version}: {said[work.key]}" for name, version, said in peers if work.key in said]
        lines += [f"- {escaped(check)}." for check in checks] + [""]
    return "\n".join(lines)


def _method(quick: bool) -> list[str]:
    used = ", ".join(f"{name} {version}" for name, version in versions().items())
    said = [
        f"Measured on {machine()}, one process at a time, with {used}. Each motion is compared at the same ten "
        "instants; the error is the largest along the run. A time is the least of its repeats, without setting up. "
        "The table of every run, those that failed too with their reasons, is in `report.csv`. Closure is the largest "
        "|phi|, energy drift is in units of the largest kinetic energy: soft constraints trade one for another."
    ]
    if quick:
        said += ["", "This is the quick report: fewer motions, methods and tolerances."]
    return said


def _best(rows: Sequence[Row]) -> list[str]:
    """Return a table: for each accuracy and program the fastest setting."""
    programs = list(dict.fromkeys(row.program for row in rows))
    cells = []
    for target in TARGETS:
        for program in programs:
            row = fastest([row for row in rows if row.program == program], target)
            if row is not None:
                drift = "" if row.energy_drift is None else f"{row.energy_drift:.0e}"
                cost = f"{row.wall_s * 1e3:.3g}"
                closure = f"{row.closure:.0e}"
                cells.append([f"{target:.0e}", program, row.setting, cost, f"{row.error_max:.0e}", closure, drift])
    return table(["accuracy", "program", "setting", "ms", "error", "closure, m", "energy drift"], cells)


def web(text: str, folder: Path) -> str:
    """Return the Markdown page as HTML, its figures inside."""
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark").enable("table").render(text)

    def inside(match: re.Match[str]) -> str:
        image = base64.b64encode((folder / html.unescape(match[1])).read_bytes()).decode()
        return f'src="data:image/png;base64,{image}"'

    body = re.sub(r'src="([^":]+\.png)"', inside, body)
    head = f'<meta charset="utf-8"><title>ckc_pin: error against run time</title><style>{STYLE}</style>'
    return f"<!doctype html>{head}{body}"
