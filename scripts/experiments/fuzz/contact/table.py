"""Table of contact cases by kind, followed by the seeds of faults by category."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from scripts.experiments.fuzz.contact.record import Record

__all__ = ["CATEGORIES", "format_table"]

CATEGORIES = {
    "exception": "an exception other than CkcError",
    "refused": "a valid scene is refused",
    "stopped": "stopped, with joint and reason",
    "unnamed": "stopped without naming a joint, or at a limit of the solver",
    "grown": "done, with more energy than at the start",
    "energy": "done, energy + dissipated is not constant",
    "dissipated": "dissipated decreases",
    "limits": "a joint beyond its stop, an open loop, or a torque beyond its limit",
    "rest": "jammed, but moving",
    "quiet": "events of joints that cannot move or rest on their stops",
    "slow": "more than three times the steps without stops and friction",
    "formulations": "events or states differ between formulations",
    "reference": "events or states differ from the event-driven reference",
    "stepping": "states differ from the time-stepping scheme",
    "rate event": "an impact that jumps over the value of an event on a rate does not trigger it",
}
WIDTH = {name: max(6, len(name)) for name in CATEGORIES}
MAX_GROUPS = 12


def format_table(records: Sequence[Record]) -> str:
    """Return the report of a suite as text."""
    lines = [
        f"{'kind':15s} {'cases':>5s} {'runs':>6s} {'ok':>5s} {'events':>7s} {'agreed':>7s} {'magn':>5s} {'ref':>5s} "
        + " ".join(f"{name:>{WIDTH[name]}s}" for name in CATEGORIES)
        + f" {'s/case':>7s}"
    ]
    for kind in sorted({record.kind for record in records}):
        lines.append(_line(kind, [record for record in records if record.kind == kind]))
    lines += [_line("all", records), "", _summary(records), ""]
    for category, meaning in CATEGORIES.items():
        lines += _category(category, meaning, records)
    return "\n".join(lines)


def _summary(records: Sequence[Record]) -> str:
    """Return the shares of stopped runs, of runs that gained energy, and of formulations that agree."""
    runs = sum(record.runs for record in records)
    count = Counter(x.category for record in records for x in record.faults)
    stopped = count["stopped"] + count["unnamed"]
    compared = [record for record in records if record.compared]
    agreed = sum(not any(x.category == "formulations" for x in record.faults) for record in compared)
    return (
        f"{runs} runs: {stopped} stopped ({100 * stopped / max(1, runs):.2f} %), {count['unnamed']} of them without"
        f" naming a joint; {count['exception']} unexpected exceptions; {count['grown']} with growing energy;"
        f" formulations agree in {100 * agreed / max(1, len(compared)):.2f} % of {len(compared)} cases"
    )


def _line(kind: str, records: Sequence[Record]) -> str:
    count = Counter(category for record in records for category in {x.category for x in record.faults})
    compared = [record for record in records if record.compared]
    agreed = sum(not any(x.category == "formulations" for x in record.faults) for record in compared)
    share = f"{100 * agreed / len(compared):.1f}%" if compared else "-"
    return (
        f"{kind:15s} {len(records):5d} {sum(r.runs for r in records):6d} {sum(not r.faults for r in records):5d}"
        f" {sum(r.events for r in records):7d} {share:>7s} {sum(r.magnified for r in records):5d}"
        f" {sum(r.referenced for r in records):5d} "
        + " ".join(f"{count[name]:>{WIDTH[name]}d}" for name in CATEGORIES)
        + f" {sum(r.seconds for r in records) / max(1, len(records)):7.2f}"
    )


def _category(category: str, meaning: str, records: Sequence[Record]) -> list[str]:
    matches = [(record, x) for record in records for x in record.faults if x.category == category]
    if not matches:
        return []
    seeds = sorted({record.seed for record, _ in matches})
    lines = [
        f"{category}: {meaning}",
        f"  {len(seeds)} seeds: {' '.join(map(str, seeds[:40]))}{' ...' if len(seeds) > 40 else ''}",
    ]
    texts: dict[str, list[tuple[Record, str, str]]] = {}
    for record, x in matches:
        texts.setdefault(re.sub(r"-?\d[\d.e+-]*", "#", f"{record.kind}: {x.text}")[:70], []).append(
            (record, x.formulation, x.text)
        )
    for group in sorted(texts.values(), key=len, reverse=True)[:MAX_GROUPS]:
        record, formulation, text = group[0]
        lines.append(f"  {len(group):4d}  seed {record.seed} {record.kind} ({formulation}): {text[:230]}")
    return [*lines, ""]
