"""What a scene leaves out, as sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

from scripts.experiments.benchmark.left_out import MISSING, MODULES, TERMS, LeftOut
from scripts.experiments.benchmark.sentences import times
from scripts.experiments.markdown import escaped, table

__all__ = ["left_out_said"]

MEGA = 2**20


def left_out_said(rows: Sequence[LeftOut]) -> list[str]:
    """Return a section of the page."""
    lines = ["## What a scene leaves out", "", _modules_sentence(rows), _terms_sentence(rows), ""]
    missing = [f"- {row.scene}: {escaped(row.reason)}" for row in rows if row.what == MISSING]
    return [*lines, *_modules(rows), "", _NOTE, "", *_terms(rows), "", *missing, ""]


_NOTE = (
    "Terms: which of them the step loop's right-hand side uses, and how much longer one would take with the others. "
    "That is told in NumPy, of terms and right-hand side alike, where what the right-hand side uses is there already. "
    "J̇, ρ̇ and C are the whole matrices; the step loop has J̇ v' without J̇, and products with ρ̇ and C."
)


def _modules_sentence(rows: Sequence[LeftOut]) -> str:
    runs = {name: [row for row in rows if row.what == name and row.scene] for name in MODULES}
    never = [name for name, own in runs.items() if own and not any(row.used for row in own)]
    costs = [row for row in rows if not row.scene and row.what in never and row.seconds is not None]
    spent, memory = sum(row.seconds or 0.0 for row in costs), sum(row.bytes or 0 for row in costs)
    return (
        f"None of the {_scenes(rows)} scenes loads {', '.join(never) or 'nothing'}: to import them would take "
        f"{times(spent)} s and {memory / MEGA:.0f} MB in each process."
    )


def _terms_sentence(rows: Sequence[LeftOut]) -> str:
    said = []
    for what in TERMS:
        own = [row for row in rows if row.what == what]
        left = [100 * row.seconds / row.rhs_s for row in own if row.seconds is not None and row.rhs_s]
        if left:
            span = f"{times(min(left))} to {times(max(left))} %" if len(left) > 1 else f"{times(left[0])} %"
            said.append(f"{what} by {len(left)} of {len(own)} (+{span})")
    return f"Right-hand sides leave out, and with it would be longer by: {', '.join(said)}."


def _modules(rows: Sequence[LeftOut]) -> list[str]:
    cells = []
    for name, (_, purpose) in MODULES.items():
        runs = [row for row in rows if row.what == name and row.scene]
        cost = next((row for row in rows if row.what == name and not row.scene), None)
        users = [row.scene for row in runs if row.used]
        who = "all" if len(users) == len(runs) else f"{len(users)}: {', '.join(users)}" if users else "none"
        if cost is None or cost.seconds is None:
            numbers = ["", cost.reason if cost else ""]
        else:
            numbers = [f"{cost.seconds * 1e3:.0f}", f"{(cost.bytes or 0) / MEGA:.1f}"]
        cells.append([name, purpose, *numbers, who])
    return table(["module", "for", "ms to import", "MB", f"loaded by, of {_scenes(rows)} scenes"], cells)


def _scenes(rows: Sequence[LeftOut]) -> int:
    return len({row.scene for row in rows if row.scene and row.what in MODULES})


def _terms(rows: Sequence[LeftOut]) -> list[str]:
    cells = []
    for scene in dict.fromkeys(row.scene for row in rows if row.what in TERMS):
        own = {row.what: row for row in rows if row.scene == scene}
        there = [own[what] for what in TERMS if what in own]
        rhs_s = next((row.rhs_s for row in there if row.rhs_s), None)
        memory = sum(row.bytes or 0 for row in there)
        cells.append([
            scene, f"{rhs_s * 1e6:.0f}" if rhs_s else "", *(_said(own.get(what)) for what in TERMS),
            f"{memory / 1024:.0f}",
        ])  # fmt: skip
    return table(["scene", "right-hand side, µs", *TERMS, "kB"], cells)


def _said(row: LeftOut | None) -> str:
    if row is None:
        return ""
    if row.used:
        return "used"
    if row.seconds is None or not row.rhs_s:
        return row.reason
    return f"+{row.seconds * 1e6:.1f} µs, {100 * row.seconds / row.rhs_s:.0f} %"
