"""How cost grows, as sentences, a table and a figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from scripts.experiments.benchmark.growth import FAMILIES, Family, Growth, exponent
from scripts.experiments.benchmark.ours import of_row
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.sentences import here
from scripts.experiments.chart import COLOURS, chart, save, whole_decades
from scripts.experiments.markdown import escaped, table

__all__ = ["draw_growth", "growth_said"]

NAMES = {"dae": "DAE", "reduced": "reduced model", "spf, eq. 8": "SPF, eq. 8"}
MARKERS = "osD"


def _points(rows: Sequence[Growth], family: Family, formulation: str) -> dict[float, float]:
    """Seconds of a right-hand side by what grows."""
    return {
        row.x: row.rhs_s for row in rows if (row.family, row.formulation) == (family.key, formulation) and row.rhs_s
    }


def _counts(rows: Sequence[Growth], family: Family, formulation: str) -> dict[float, float]:
    return {row.x: row.rhs for row in rows if (row.family, row.formulation) == (family.key, formulation) and row.rhs}


def growth_said(rows: Sequence[Growth], measured: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return a section of the page.

    Parameters
    ----------
    rows : sequence of Growth
    measured : mapping of a work's key to its rows
        Which tell how the cost of a run grows as its tolerance falls.
    """
    lines = ["## How cost grows", ""]
    lines += [f"- {said}" for family in FAMILIES for said in _grows(rows, family)]
    lines += [f"- {said}" for said in _tolerances(measured)]
    lines += ["", "![how cost grows](growth.png)", ""]
    failed = [
        f"- {row.family} = {row.x}, {NAMES[row.formulation]}: {escaped(row.reason)}" for row in rows if row.reason
    ]
    return [*lines, *_table(rows), "", *failed, ""]


def _table(rows: Sequence[Growth]) -> list[str]:
    """Return a row a case: a right-hand side's time by formulation, and a run's right-hand sides."""
    cells = []
    for family in FAMILIES:
        times_of = [_points(rows, family, formulation) for formulation in NAMES]
        counts = [_counts(rows, family, formulation) for formulation in NAMES]
        for x in sorted({row.x for row in rows if row.family == family.key}):
            spent = [f"{1e6 * points[x]:.3g}" if x in points else "" for points in times_of]
            cells.append([family.says, str(x), *spent, *(_text(found.get(x)) for found in counts)])
    header = [f"{name}, {what}" for what in ("µs", "right-hand sides") for name in NAMES.values()]
    return table(["along", "", *header], cells)


def _text(x: float | None) -> str:
    return "" if x is None else f"{x:.0f}"


def _grows(rows: Sequence[Growth], family: Family) -> Iterator[str]:
    """Say with which exponents a right-hand side's time and a run's right-hand sides grow along a family."""
    parts = []
    for formulation, name in NAMES.items():
        p = exponent(_points(rows, family, formulation))
        count = exponent(_counts(rows, family, formulation), whole=True)
        if p is not None:
            number = "" if count is None else f", the number of them with {count:.2f}"
            parts.append(f"{name}: {p:.1f}{number}")
    if parts:
        yield f"{family.says}: a right-hand side's time grows with the power of {family.along}: {'; '.join(parts)}."


def _by_tolerance(rows: Sequence[Row], formulation: str) -> dict[float, tuple[int, float]]:
    """Right-hand sides and seconds of a formulation's runs under "auto", by 1 / rtol."""
    found = {}
    for row in here(rows):
        setting = of_row(row)
        if (setting.formulation, setting.method) == (formulation, "auto") and row.status == "done" and row.rhs:
            found[1 / setting.rtol] = (row.rhs, row.wall_s)
    return found


def _tolerances(measured: Mapping[str, Sequence[Row]]) -> Iterator[str]:
    for formulation, name in NAMES.items():
        counts, seconds = [], []
        for rows in measured.values():
            own = _by_tolerance(rows, formulation)
            fits = [exponent({x: pair[k] for x, pair in own.items()}, whole=True) for k in (0, 1)]
            if fits[0] is not None and fits[1] is not None:
                counts.append(fits[0])
                seconds.append(fits[1])
        if counts:
            yield (
                f"1 / rtol, {name}, by work: right-hand sides with the power {min(counts):.2f} to {max(counts):.2f}, "
                f"time with {min(seconds):.2f} to {max(seconds):.2f}."
            )


def draw_growth(rows: Sequence[Growth], measured: Mapping[str, Sequence[Row]], folder: Path) -> str:
    """Draw right-hand sides' times along each family, and runs' right-hand sides against the tolerance."""
    figure, axes = chart(columns=(len(FAMILIES) + 1) // 2, rows=2, size=(6.2, 4.2))
    for ax, family in zip(axes, FAMILIES, strict=False):
        for k, (formulation, name) in enumerate(NAMES.items()):
            points = _points(rows, family, formulation)
            p = exponent(points)
            if p is not None:
                xs = sorted(points)
                look = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 4, "clip_on": False}
                ax.plot(xs, [1e6 * points[x] for x in xs], label=f"{name}: ∝ {family.along}^{p:.1f}", **look)
        ax.set(xscale="log", yscale="log", xlabel=family.along, title=family.says)
        ax.set_ylabel("one right-hand side, µs")
    last, work = axes[-1], next(iter(measured))
    for k, (formulation, name) in enumerate(NAMES.items()):
        own = _by_tolerance(measured[work], formulation)
        p = exponent({x: pair[0] for x, pair in own.items()}, whole=True)
        if p is not None:
            xs = sorted(own)
            look = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 4, "clip_on": False}
            last.plot(xs, [own[x][0] for x in xs], label=f"{name}: ∝ rtol^-{p:.2f}", **look)
    last.set(xscale="log", yscale="log", xlabel="1 / rtol", title=f"{work}, method auto")
    last.set_ylabel("right-hand sides of a run")
    for ax in axes:
        whole_decades(ax)
        if ax.lines:
            ax.legend(fontsize=7.5)
    return save(figure, folder, "growth.png")
