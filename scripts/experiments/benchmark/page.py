"""The report as one page, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scripts.experiments.benchmark.advice import advice
from scripts.experiments.benchmark.goals import BY_HAND, PACKAGED, goals_table
from scripts.experiments.benchmark.growth import Growth
from scripts.experiments.benchmark.growth_said import growth_said
from scripts.experiments.benchmark.left_out import LeftOut
from scripts.experiments.benchmark.left_out_said import left_out_said
from scripts.experiments.benchmark.ours import PROGRAM
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import TARGETS, eq_8_ratio, fastest, here, milliseconds, sentences, times
from scripts.experiments.benchmark.table import machine, versions
from scripts.experiments.benchmark.work import Budget, Work
from scripts.experiments.markdown import escaped, table

__all__ = ["Measured", "PeerNote", "markdown"]


@dataclass(frozen=True)
class PeerNote:
    """What is known of another program.

    Attributes
    ----------
    name, version : str
    packaged : bool
    said : dict of str to str
        By work, how well it agrees at the start, or why it is missing.
    """

    name: str
    version: str
    packaged: bool
    said: Mapping[str, str]


@dataclass(frozen=True)
class Measured:
    """All that the page is made from.

    Attributes
    ----------
    works : sequence of Work
    unmade : dict of str to str
        Why works are not there, by what they are called.
    budget : Budget
    rows, references : mappings by the work's key
    peers : sequence of PeerNote
    left_out : sequence of LeftOut
    growth : sequence of Growth
    quick : bool
        Whether it is the quick report, which says so.
    """

    works: Sequence[Work]
    unmade: Mapping[str, str]
    budget: Budget
    rows: Mapping[str, Sequence[Row]]
    references: Mapping[str, Reference]
    peers: Sequence[PeerNote]
    left_out: Sequence[LeftOut]
    growth: Sequence[Growth]
    quick: bool

    @property
    def by_hand(self) -> frozenset[str]:
        """Programs that are no packages."""
        return frozenset(peer.name for peer in self.peers if not peer.packaged)


def markdown(measured: Measured) -> str:
    """Return the page."""
    works, rows, references, by_hand = measured.works, measured.rows, measured.references, measured.by_hand
    lines = ["# Error against run time", ""]
    lines += [f"- {escaped(said)}" for said in advice(works, rows, references, by_hand)]
    lines += ["", "![error against time](report.png)", "", *_method(measured), ""]
    lines += ["## The figures to reach", ""]
    for goal in (PACKAGED, BY_HAND):
        lines += [*goals_table(goal, works, rows, references, by_hand), ""]
    lines += ["## Where eq. 8 as printed pays", "", *_eq_8(measured), ""]
    for work in works:
        lines += _of_work(work, measured)
    return "\n".join([*lines, *growth_said(measured.growth, rows), *left_out_said(measured.left_out)])


def _of_work(work: Work, measured: Measured) -> list[str]:
    own, reference = measured.rows[work.key], measured.references[work.key]
    lines = [f"## {work.says}", "", f"Reference: {escaped(reference.how)}.", ""]
    lines += [f"- {escaped(said)}" for said in sentences(work, own, reference, measured.by_hand)]
    lines += ["", f"![{work.says}]({work.key}.png)", "", *_best(own), ""]
    checks = [f"{peer.name} {peer.version}: {peer.said[work.key]}" for peer in measured.peers if work.key in peer.said]
    return [*lines, *(f"- {escaped(' '.join(check.split()))}." for check in checks), ""]


def _method(measured: Measured) -> list[str]:
    used = ", ".join(f"{name} {version}" for name, version in versions().items())
    own, others = measured.budget.own, measured.budget.peer
    said = [
        f"Measured on {machine()}, one process at a time, with {used}. Each motion is compared at the same ten "
        "instants; the error is the largest along the run, the table has that at the end as well. A time is the least "
        "of its repeats, without setting up. Closure is the largest |φ|, energy drift is in units of the largest "
        "kinetic energy: soft constraints trade one for another. Every run, those that failed too with their "
        "reasons, is in `report.csv`; what a scene leaves out in `left_out.csv`, how cost grows in `growth.csv`. "
        "Curves show each program's best settings, those that no other one beats in both time and error. A run may "
        f"take {own:g} s here and {others:g} s in another program; one that would take longer counts as not getting "
        "there."
    ]
    if measured.unmade:
        said += ["", *(f"- Not measured: {name}, {escaped(why)}" for name, why in measured.unmade.items())]
    if measured.by_hand:
        said += ["", f"Written by hand around a library, and told apart: {', '.join(sorted(measured.by_hand))}."]
    if measured.quick:
        said += ["", "This is the quick report: fewer motions, methods and tolerances."]
    return said


def _eq_8(measured: Measured) -> list[str]:
    """Return a table: eq. 8's time over the reduced model's, by work, epsilon and accuracy."""
    cells = []
    for work in measured.works:
        own, accuracy = here(measured.rows[work.key]), measured.references[work.key].accuracy
        ratios = [eq_8_ratio(own, target) if target >= accuracy else None for target in TARGETS]
        said = ["" if x is None else f"{times(x)}, pays" if x < 1 else times(x) for x in ratios]
        cells.append([work.says, f"{work.epsilon:.0e}", *said])
    return [
        "Least time of eq. 8 as printed over that of the reduced model, to each accuracy; empty where one does not get "
        "there.",
        "",
        *table(["work", "ε", *(f"{target:.0e}" for target in TARGETS)], cells),
    ]


def _best(rows: Sequence[Row]) -> list[str]:
    """Return a table: for each accuracy and program the fastest setting."""
    programs = sorted(dict.fromkeys(row.program for row in rows), key=lambda name: name != PROGRAM)
    cells = []
    for target in TARGETS:
        for program in programs:
            row = fastest([row for row in rows if row.program == program], target)
            if row is not None:
                numbers = [row.error_max, row.error_end, row.closure, row.energy_drift]
                said = ["" if x is None else f"{x:.0e}" for x in numbers]
                counts = ["" if x is None else f"{x:,}" for x in (row.rhs, row.steps)]
                cells.append(
                    [f"{target:.0e}", program, row.setting, milliseconds(row).removesuffix(" ms"), *said, *counts]
                )
    header = ["accuracy", "program", "setting", "ms", "error", "at the end", "closure", "energy drift"]
    return table([*header, "right-hand sides", "steps"], cells)
