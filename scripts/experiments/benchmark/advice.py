"""Which formulation, method and tolerance to take, and whether to take this program at all: what all works say."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from math import exp, log

from scripts.experiments.benchmark.ours import PROGRAM, of_row
from scripts.experiments.benchmark.reference import Reference
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import TARGETS, eq_8_ratio, faster, fastest, here, ratio, times
from scripts.experiments.benchmark.work import Work

__all__ = ["advice"]

ALIKE = 1.1  # ratio of times that are no difference
UNREACHED = 10.0  # times the fastest one: what an accuracy that a setting does not get to counts as
MOST = 0.9  # of the runs: what a tolerance is to be good for

Rows = Mapping[str, Sequence[Row]]


def advice(
    works: Sequence[Work], rows: Rows, references: Mapping[str, Reference], by_hand: Collection[str] = ()
) -> Iterator[str]:
    """Say in a few sentences what to take.

    Parameters
    ----------
    works : sequence of Work
    rows, references : mappings by the work's key
    by_hand : collection of str
        Programs that are no packages.
    """
    told = [(work.key, target) for work in works for target in TARGETS if target >= references[work.key].accuracy]
    family = _best_family(told, rows)
    if family is None:
        yield "No setting of this program got to any of the accuracies."
        return
    yield _which(family, told, rows)
    yield _tolerance(family, works, rows)
    yield from _whether(told, rows, by_hand)
    yield _eq_8(works, rows, references)


def _of(rows: Sequence[Row], family: str) -> list[Row]:
    return [row for row in here(rows) if of_row(row).family == family]


def _relative(family: str, told: Sequence[tuple[str, float]], rows: Rows) -> dict[tuple[str, float], float]:
    """A family's least time over the least of all settings here, where it gets."""
    found = {}
    for work, target in told:
        over = ratio(fastest(here(rows[work]), target), fastest(_of(rows[work], family), target))
        if over is not None:
            found[work, target] = over
    return found


def _mean(ratios: Collection[float]) -> float:
    return exp(sum(map(log, ratios)) / len(ratios))


def _best_family(told: Sequence[tuple[str, float]], rows: Rows) -> str | None:
    """Return the formulation and method that is the fastest in the mean, what it does not get to counted as slow.

    On the manifold eq. 17 is the reduced model, and chance decides between them: the reduced model is named.
    """
    families = dict.fromkeys(of_row(row).family for own in rows.values() for row in here(own))
    relative = {family: _relative(family, told, rows) for family in families}
    reached = sum(fastest(here(rows[work]), target) is not None for work, target in told)
    means = {
        family: _mean([*own.values(), *[UNREACHED] * (reached - len(own))]) for family, own in relative.items() if own
    }
    alike = [family for family, mean in means.items() if mean <= ALIKE * min(means.values())]
    return next((family for family in alike if family.startswith("reduced")), alike[0] if alike else None)


def _which(family: str, told: Sequence[tuple[str, float]], rows: Rows) -> str:
    relative = _relative(family, told, rows)
    reached = sum(fastest(here(rows[work]), target) is not None for work, target in told)
    worst = max(relative, key=relative.__getitem__)
    said = (
        f"Take {_keys(family)}: it gets to {len(relative)} of the {reached} accuracies that any setting here gets to, "
        f"in {times(_mean(relative.values()))} times the time of the fastest one in the mean, {times(relative[worst])} "
        f"times at worst ({worst[0]} to {worst[1]:.0e})."
    )
    if len(relative) < reached:
        left = [(w, x) for w, x in told if (w, x) not in relative and fastest(here(rows[w]), x)]
        best = [of_row(row).family for w, x in left if (row := fastest(here(rows[w]), x))]
        said += f" Elsewhere ({', '.join(f'{w} to {x:.0e}' for w, x in left)}) take {_keys(max(best, key=best.count))}."
    return said


def _keys(family: str) -> str:
    """Write a family as a scene has it."""
    formulation, _, method = family.rpartition(", ")
    coordinates = ', `spf_coordinates = "z"`' if "eq. 8" in formulation else ""
    return f'`formulation = "{formulation.split(",")[0]}"`, `method = "{method}"`{coordinates}'


def _tolerance(family: str, works: Sequence[Work], rows: Rows) -> str:
    """Say how far the error is from the tolerance."""
    over = sorted(
        row.error_max / of_row(row).rtol
        for work in works
        for row in _of(rows[work.key], family)
        if row.status == "done" and row.error_max
    )
    most = over[min(len(over) - 1, int(MOST * len(over)))]
    example = 1e-6 / most
    return (
        f"Its largest error along a run is up to {times(over[len(over) // 2])} times rtol in half of these runs and up "
        f"to {times(most)} times in nine of ten: for an error of 1e-06 rad or m give rtol = {_down(example):.0e}."
    )


def _down(x: float) -> float:
    """Return the power of ten at or below a number."""
    k = 0
    while 10.0**-k > x * (1 + 1e-9):
        k += 1
    return 10.0**-k


def _whether(told: Sequence[tuple[str, float]], rows: Rows, by_hand: Collection[str]) -> Iterator[str]:
    """Say how often this program is ahead of the others, and where it is not."""
    for written in (False, True):
        names = {row.program for own in rows.values() for row in own if row.program != PROGRAM}
        names = {name for name in names if (name in by_hand) == written}
        if not names:
            continue
        found: dict[tuple[str, float], float | None] = {}
        ahead_of_it: dict[str, list[tuple[str, float]]] = {}
        for work, target in told:
            other = fastest([row for row in rows[work] if row.program in names], target)
            if other is None:
                continue
            found[work, target] = over = ratio(fastest(here(rows[work]), target), other)
            if over is None or over < 1:
                ahead_of_it.setdefault(other.program, []).append((work, target))
        whom = "the loop written by hand around another library" if written else "the other packaged programs"
        if not found:
            yield f"Against {whom} ({', '.join(sorted(names))}): none of them gets to any of these accuracies."
            continue
        ahead = [over for over in found.values() if over is not None and over >= 1]
        span = (
            f", {times(min(ahead))} to {times(max(ahead))} times ({times(_mean(ahead))} in the mean)" if ahead else ""
        )
        where = "".join(
            f" {name} is ahead on {', '.join(_where(on, found))}: take it there." for name, on in ahead_of_it.items()
        )
        yield (
            f"Against {whom} ({', '.join(sorted(names))}) it is faster at {len(ahead)} of the {len(found)} works and "
            f"accuracies that one of them gets to{span}.{where}"
        )
    yield "It has no contacts, no dry friction and no deformable bodies: where those matter, take another program."


def _where(on: Sequence[tuple[str, float]], found: Mapping[tuple[str, float], float | None]) -> Iterator[str]:
    """Say on which works, to which accuracies and by how much another program is ahead."""
    for work in dict.fromkeys(work for work, _ in on):
        targets = [target for own, target in on if own == work]
        overs = [1 / over for target in targets if (over := found[work, target]) is not None]
        by = f"up to {faster(max(overs))}" if overs else "nothing here gets there"
        yield f"{work} to {', '.join(f'{target:.0e}' for target in targets)} ({by})"


def _eq_8(works: Sequence[Work], rows: Rows, references: Mapping[str, Reference]) -> str:
    """Say where eq. 8 as printed pays."""
    ratios = {
        (f"{work.key} (ε = {work.epsilon:.0e})", target): over
        for work in works
        for target in TARGETS
        if target >= references[work.key].accuracy and (over := eq_8_ratio(here(rows[work.key]), target)) is not None
    }
    pays = [f"{work} to {x:.0e}" for (work, x), over in ratios.items() if over < 1]
    if not ratios:
        return "The singular perturbation formulation as printed (eq. 8) gets to none of these accuracies."
    said = f"takes {times(min(ratios.values()))} to {times(max(ratios.values()))} times the reduced model's time"
    return f"The singular perturbation formulation as printed (eq. 8) {said}; it pays " + (
        f"on {', '.join(pays)}." if pays else "nowhere: in eq. 17's coordinates it costs what the reduced model does."
    )
