"""Tables of work-precision comparisons: for a terminal, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

from ckc_pin.analysis.precision.compute import TABLE_ERRORS, SettingFamily, WorkPrecision, describe_outcome
from ckc_pin.analysis.precision.motion import INSTANTS, PrecisionRow

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["make_csv", "make_markdown", "make_time_table"]

INTRODUCTION = (
    "Errors are the largest of q_tree and v_tree at up to {instants} instants, in SI units, relative to the largest "
    "value where that is above 1."
)
TABLE_TITLE = "shortest time (ms) within an error"


def make_time_table(result: WorkPrecision) -> Table:
    """Return the shortest time of each family of settings within several errors, as a table for a terminal."""
    from rich.table import Table

    table = Table("", *(f"{x:.0e}" for x in TABLE_ERRORS), "right-hand sides", box=None, pad_edge=False)
    table.title, table.title_justify, table.title_style = f"{TABLE_TITLE} of", "left", ""
    for family in result.families():
        table.add_row(family.name, *_cells(family))
    return table


def make_markdown(results: Sequence[WorkPrecision], figures: Mapping[int, str]) -> str:
    """Return comparisons as a page with a section for each scene.

    Parameters
    ----------
    results : sequence of WorkPrecision
    figures : mapping of int to str
        File of the figure of a scene, by the scene's number.
    """
    lines = ["# Work against precision", "", INTRODUCTION.format(instants=INSTANTS)]
    for k, result in enumerate(results):
        lines += ["", f"## {result.scene}", ""]
        messages = [result.message] if result.message else []
        lines += [f"- {note}" for note in [*messages, *result.describe_notes()]]
        if k in figures:
            lines += ["", f"![Error against time]({figures[k]})"]
        if result.advice:
            sentences = (f"- {advice.describe('`')}" for advice in result.advice)
            lines += ["", "### Which setting to use", "", *sentences]
        if result.reference is None:
            continue
        head = ("setting", *(f"{x:.0e}" for x in TABLE_ERRORS), "right-hand sides", "")
        rows = ((family.name, *_cells(family)) for family in result.families())
        lines += ["", f"### {TABLE_TITLE.capitalize()}", "", *_markdown_table(head, rows)]
        head = ("setting", "error", "right-hand sides", "time (ms)", "status")
        lines += ["", "### All settings", "", *_markdown_table(head, (_setting_cells(row) for row in result.rows))]
    return "\n".join(lines) + "\n"


def make_csv(results: Sequence[WorkPrecision]) -> str:
    """Return all rows of comparisons as CSV. Missing values are empty."""
    names = [field.name for field in fields(PrecisionRow) if field.name != "overrides"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", *names])
    for result in results:
        for row in result.rows:
            writer.writerow([result.scene, *("" if (x := getattr(row, name)) is None else x for name in names)])
    return text.getvalue()


def _cells(family: SettingFamily) -> list[str]:
    """Return the times in ms, and the range of the numbers of right-hand sides."""
    times = ["" if row is None or row.wall_s is None else f"{1e3 * row.wall_s:.3g}" for row in family.fastest]
    counts = [row.rhs for row in family.rows if row.rhs and row.status == "done"]
    return [*times, f"{min(counts)} ... {max(counts)}" if counts else ""]


def _setting_cells(row: PrecisionRow) -> tuple[str, ...]:
    setting = f"{row.family}, " + (f"rtol {row.rtol:.0e}" if row.rtol is not None else f"dt {row.dt:.3g} s")
    unresolved = "" if row.resolved in (True, None) else " (not resolved)"
    error = "" if row.error is None else f"{row.error:.1e}{unresolved}"
    wall_ms = "" if row.wall_s is None else f"{1e3 * row.wall_s:.3g}"
    return setting, error, str(row.rhs or ""), wall_ms, describe_outcome(row)


def _markdown_table(head: Sequence[str], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield "|" + "---|" * len(head)
    for cells in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
