"""What the numbers say, in words: the fastest way to each accuracy, and who has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ckc_pin.study.report.ours import PROGRAM
from ckc_pin.study.report.reference import Reference
from ckc_pin.study.report.row import Row
from ckc_pin.study.report.work import Work

__all__ = ["TARGETS", "fastest", "sentences"]

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)


def fastest(rows: Sequence[Row], target: float) -> Row | None:
    """Return the row that took the least time among those whose error stays within a target all along."""
    good = [row for row in rows if row.status == "done" and row.error_max is not None and row.error_max <= target]
    return min(good, key=lambda row: row.wall_s, default=None)


def sentences(work: Work, rows: Sequence[Row], reference: Reference) -> Iterator[str]:
    """Say for each accuracy which setting here and which other program gets there first, and what eq. 8 costs."""
    ours = [row for row in rows if row.program == PROGRAM]
    others = [row for row in rows if row.program != PROGRAM]
    for target in TARGETS:
        if target < reference.accuracy:
            yield f"To {target:.0e}: not told, the reference is good to {reference.accuracy:.0e}."
            continue
        yield f"To {target:.0e}: {_compared(fastest(ours, target), fastest(others, target), bool(others))}"
    yield from _eq_8(ours)


def _compared(here: Row | None, there: Row | None, any_others: bool) -> str:
    if here is None and there is None:
        return "nobody gets there." if any_others else "no setting tried gets there."
    if here is None:
        assert there is not None
        return f"nothing here gets there; {_named(there)} does in {_time(there)}."
    if there is None:
        return f"{here.setting}, {_time(here)}{'; no other program gets there' if any_others else ''}."
    ratio = there.wall_s / here.wall_s
    verdict = f"{ratio:.2g} times as long" if ratio >= 1 else f"{1 / ratio:.2g} times faster than here"
    return f"{here.setting}, {_time(here)}; {_named(there)} takes {_time(there)}, {verdict}."


def _eq_8(ours: Sequence[Row]) -> Iterator[str]:
    """Say what eq. 8 as printed costs against the reduced model where both get there."""
    for target in TARGETS[:3]:
        printed = fastest([row for row in ours if row.setting.startswith("spf, eq. 8")], target)
        reduced = fastest([row for row in ours if row.setting.startswith("reduced")], target)
        if printed and reduced:
            ratio = printed.wall_s / reduced.wall_s
            pays = "pays" if ratio < 1 else "does not pay"
            yield f"Eq. 8 as printed to {target:.0e}: {ratio:.2g} times the reduced model's time, it {pays}."


def _named(row: Row) -> str:
    return f"{row.program} ({row.setting})"


def _time(row: Row) -> str:
    return f"{row.wall_s * 1e3:.3g} ms"
