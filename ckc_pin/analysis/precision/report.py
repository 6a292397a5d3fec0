"""Work against precision as plain data, as a table for a terminal, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

from ckc_pin.analysis.precision import reference as references
from ckc_pin.analysis.precision.compute import Advice, WorkPrecision, fastest
from ckc_pin.analysis.precision.motion import INSTANTS, PrecisionRow

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["precision_csv", "precision_lines", "precision_markdown", "precision_plain", "precision_table"]

COLUMNS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
ERROR = (
    "Errors are the largest of q_tree and v_tree at up to {instants} instants, in SI units, relative to the largest "
    "value where that is above 1."
)
TIMES = "least time (ms) to an error"


def precision_plain(found: WorkPrecision) -> dict[str, Any]:
    """Return a comparison as JSON-ready data."""
    reference = found.reference
    return {
        "scene": found.scene,
        "status": found.status,
        "message": found.message,
        "reference": None if reference is None else {
            "of": reference.of, "confirmed_by": reference.by, "rtol": references.TIGHT,
            "accuracy": reference.accuracy, "t_end": reference.t_end, "t": reference.t.tolist(),
            "q_tree": reference.motion.q_tree.tolist(), "v_tree": reference.motion.v_tree.tolist(),
        },
        "model_difference": found.model_difference,
        "rows": [asdict(row) for row in found.rows],
        "advice": [
            {"target": a.target, "set": a.options, "remove": a.removed, "reason": a.reason,
             "wall_s": a.row.wall_s if a.row else None, "error": a.row.error if a.row else None,
             "mujoco": {"method": a.peer.method, "dt": a.peer.dt, "wall_s": a.peer.wall_s} if a.peer else None}
            for a in found.advice
        ],
        "notes": list(_notes(found)),
        "seconds": found.seconds,
    }  # fmt: skip


def precision_table(found: WorkPrecision) -> Table:
    """Return how long each family of settings takes to an error, for people."""
    from rich.table import Table

    table = Table("", *(f"{x:.0e}" for x in COLUMNS), "right-hand sides", box=None, pad_edge=False)
    table.title, table.title_justify, table.title_style = f"{TIMES} of", "left", ""
    for name, cells, _ in _families(found):
        table.add_row(name, *cells)
    return table


def precision_lines(found: WorkPrecision) -> Iterator[str]:
    """Yield what is beside the table, a sentence each; the last ones are what to take, to be pasted."""
    yield from _notes(found)
    yield from (_sentence(advice) for advice in found.advice)


def precision_markdown(every: Sequence[WorkPrecision], figures: Mapping[int, str]) -> str:
    """Return comparisons as a page: a section for each scene, with the file of its figure where there is one."""
    lines = ["# Work against precision", "", ERROR.format(instants=INSTANTS)]
    for k, found in enumerate(every):
        lines += ["", f"## {found.scene}", ""]
        lines += [f"- {note}" for note in ([found.message] if found.message else []) + list(_notes(found))]
        if k in figures:
            lines += ["", f"![Error against time]({figures[k]})"]
        if found.advice:
            lines += ["", "### Which setting to take", "", *(f"- {_sentence(advice, '`')}" for advice in found.advice)]
        if found.reference is None:
            continue
        head = ("setting", *(f"{x:.0e}" for x in COLUMNS), "right-hand sides", "")
        lines += [
            "",
            f"### {TIMES.capitalize()}",
            "",
            *_rows(head, ((name, *cells) for name, cells, _ in _families(found))),
        ]
        head = ("setting", "error", "right-hand sides", "time (ms)", "status")
        lines += ["", "### All settings", "", *_rows(head, (_line(row) for row in found.rows))]
    return "\n".join(lines) + "\n"


def precision_csv(every: Sequence[WorkPrecision]) -> str:
    """Return all rows of comparisons as CSV; what there is not is empty."""
    names = [field.name for field in fields(PrecisionRow) if field.name != "overrides"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", *names])
    for found in every:
        for row in found.rows:
            writer.writerow([found.scene, *("" if (x := getattr(row, name)) is None else x for name in names)])
    return text.getvalue()


def _notes(found: WorkPrecision) -> Iterator[str]:
    if found.reference is not None:
        yield from references.said(found.reference)
        below = sum(row.resolved is False for row in found.rows)
        if below:
            yield f"{below} settings are at or below the reference's own uncertainty: not told apart from it"
        for name, _, failed in _families(found):
            if failed:
                yield f"{name}: {failed}"
    yield from found.notes


def _families(found: WorkPrecision) -> Iterator[tuple[str, list[str], str]]:
    """Yield each formulation and method: its name, its times to some errors, and what went wrong."""
    assert found.reference is not None
    for family in dict.fromkeys(map(_family, found.rows)):
        own = [row for row in found.rows if _family(row) == family]
        best = [fastest(own, target, found.reference.accuracy, own[0].program) for target in COLUMNS]
        cells = ["" if row is None or row.wall_s is None else f"{1e3 * row.wall_s:.3g}" for row in best]
        counts = [row.rhs for row in own if row.rhs and row.status == "done"]
        failed = [row for row in own if row.status in ("refused", "stopped", "failed")]
        said = f"{len(failed)} of {len(own)} {_outcome(failed[0])}" if failed else ""
        yield family, [*cells, f"{min(counts)} ... {max(counts)}" if counts else ""], said


def _family(row: PrecisionRow) -> str:
    return f"{row.formulation}, {row.method}" if row.formulation else f"{row.program}, {row.method}"


def _setting(row: PrecisionRow) -> str:
    return f"{_family(row)}, " + (f"rtol {row.rtol:.0e}" if row.rtol is not None else f"dt {row.dt:.3g} s")


def _line(row: PrecisionRow) -> tuple[str, ...]:
    at = "" if row.resolved in (True, None) else " (not resolved)"
    error = "" if row.error is None else f"{row.error:.1e}{at}"
    wall = "" if row.wall_s is None else f"{1e3 * row.wall_s:.3g}"
    return _setting(row), error, str(row.rhs or ""), wall, _outcome(row)


def _outcome(row: PrecisionRow) -> str:
    return row.reason if row.reason.startswith(row.status) else f"{row.status}: {row.reason}".removesuffix(": ")


def _sentence(advice: Advice, mark: str = "") -> str:
    if advice.row is None:
        said = advice.reason
    else:
        row = advice.row
        options = " ".join(f"--set {option}" for option in advice.options)
        said = f"{mark}{options}{mark} ({1e3 * (row.wall_s or 0.0):.3g} ms, error {row.error:.1e})"
    if advice.removed:
        said += f"; take {', '.join(advice.removed)} out of the scene"
    if advice.peer is not None:
        peer = advice.peer
        said += f"; MuJoCo takes {1e3 * (peer.wall_s or 0.0):.3g} ms ({peer.method}, dt {peer.dt:.2g} s)"
    return f"for an error of {advice.target:.0e}: {said}"


def _rows(head: Sequence[str], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield "|" + "---|" * len(head)
    for cells in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
