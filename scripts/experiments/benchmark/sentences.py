"""What the numbers say of one work, in words: the fastest way to each accuracy, and who has it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from scripts.experiments.benchmark.ours import PROGRAM
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.work import Work

__all__ = ["TARGETS", "eq_8_ratio", "faster", "fastest", "here", "milliseconds", "ratio", "sentences", "times"]

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)


def fastest(rows: Sequence[Row], target: float) -> Row | None:
    """Return the row that took the least time among those whose error stays within a target all along."""
    good = [row for row in rows if row.status == "done" and row.error_max is not None and row.error_max <= target]
    return min(good, key=lambda row: row.wall_s, default=None)


def here(rows: Sequence[Row]) -> list[Row]:
    """Rows of this program."""
    return [row for row in rows if row.program == PROGRAM]


def ratio(own: Row | None, other: Row | None) -> float | None:
    """How many times as long the other takes; None without both."""
    return other.wall_s / own.wall_s if own and other else None


def sentences(work: Work, rows: Sequence[Row], reference: Reference, by_hand: Collection[str] = ()) -> Iterator[str]:
    """Say for each accuracy which setting here and which other program gets there first, and what eq. 8 costs.

    Parameters
    ----------
    work : Work
    rows : sequence of Row
        Of that work.
    reference : Reference
    by_hand : collection of str
        Programs that are no packages: loops that a user would write around one. They are told apart.
    """
    ours = here(rows)
    packaged = [row for row in rows if row.program != PROGRAM and row.program not in by_hand]
    written = [row for row in rows if row.program in by_hand]
    for target in TARGETS:
        if target < reference.accuracy:
            yield f"To {target:.0e}: not told, the reference is good to {reference.accuracy:.0e}."
            continue
        own = fastest(ours, target)
        said = f"To {target:.0e}: {_compared(own, fastest(packaged, target), bool(packaged))}"
        if written:
            said += f" {_against(own, fastest(written, target))}"
        yield said
    yield from _eq_8(work, ours, reference)


def _compared(own: Row | None, other: Row | None, any_others: bool) -> str:
    if own is None and other is None:
        return "no packaged program gets there, nor any setting here." if any_others else "no setting tried gets there."
    if own is None:
        assert other is not None
        return f"nothing here gets there; {_named(other)} does in {milliseconds(other)}."
    if other is None:
        none = "; no packaged program gets there" if any_others else ""
        return f"{own.setting}, {milliseconds(own)}{none}."
    return f"{own.setting}, {milliseconds(own)}; {_named(other)} takes {milliseconds(other)}, {_verdict(own, other)}."


def _against(own: Row | None, other: Row | None) -> str:
    """Say how a loop written by hand compares."""
    if other is None:
        return "The loop written by hand does not get there."
    how = f", {_verdict(own, other)}" if own else ""
    return f"Written by hand, {_named(other)} takes {milliseconds(other)}{how}."


def _verdict(own: Row, other: Row) -> str:
    found = other.wall_s / own.wall_s
    if found < 1:
        return f"{faster(1 / found)} than here"
    return f"{times(found)} times as long" if found >= 2 else f"{times(100 * (found - 1))} % longer"


def eq_8_ratio(ours: Sequence[Row], target: float) -> float | None:
    """Time of the fastest run of eq. 8 as printed over that of the reduced model; None where one does not get there."""
    printed = fastest([row for row in ours if row.setting.startswith("spf, eq. 8")], target)
    reduced = fastest([row for row in ours if row.setting.startswith("reduced")], target)
    return ratio(reduced, printed)


def _eq_8(work: Work, ours: Sequence[Row], reference: Reference) -> Iterator[str]:
    """Say what eq. 8 as printed costs against the reduced model where both get there."""
    told = [target for target in TARGETS if target >= reference.accuracy]
    found = {target: x for target in told if (x := eq_8_ratio(ours, target)) is not None}
    if not any(row.setting.startswith("spf, eq. 8") for row in ours):
        return
    if not found:
        yield f"Eq. 8 as printed at ε = {work.epsilon:.0e} gets to none of these accuracies."
        return
    parts = [f"{times(x)} times to {target:.0e}" for target, x in found.items()]
    pays = [f"{target:.0e}" for target, x in found.items() if x < 1]
    verdict = f"it pays to {', '.join(pays)}" if pays else "it does not pay"
    said = f"takes, of the reduced model's time, {', '.join(parts)}: {verdict}"
    yield f"Eq. 8 as printed at ε = {work.epsilon:.0e} {said}."


def _named(row: Row) -> str:
    return f"{row.program} ({row.setting})"


def milliseconds(row: Row) -> str:
    """A row's time for people."""
    return f"{times(row.wall_s * 1e3)} ms"


def faster(x: float) -> str:
    """How much faster x times as fast is, for people."""
    return f"{times(x)} times faster" if x >= 2 else f"{times(100 * (x - 1))} % faster"


def times(x: float) -> str:
    """A number for people: two digits, never as a power of ten."""
    if x >= 10:
        return f"{float(f'{x:.2g}' if x < 100 else f'{x:.3g}'):,.0f}"
    return f"{x:.2g}"
