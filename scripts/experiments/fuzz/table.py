"""The records as a table by mechanism and formulation, and the worst of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from scripts.experiments.fuzz.record import ALLOWED, Record

__all__ = ["table"]


def table(records: Sequence[Record]) -> str:
    """The whole report as text."""
    lines = [
        f"{'mechanism':22s} {'form':8s} {'runs':>5s} {'raw':>4s} {'wrong':>5s} {'gross':>5s} {'stop%':>6s}"
        f" {'off':>4s} {'refd':>4s} {'unres':>5s} {'p50':>9s} {'p90':>9s} {'p99':>9s} {'max':>9s} {'rhs':>8s}"
    ]
    groups = sorted({(record.mechanism, record.formulation) for record in records})
    for name, formulation in groups:
        lines.append(
            _line(name, formulation, [r for r in records if (r.mechanism, r.formulation) == (name, formulation)])
        )
    for formulation in sorted({record.formulation for record in records}):
        lines.append(_line("all", formulation, [r for r in records if r.formulation == formulation]))
    lines += [_line("all", "all", records), ""]
    lines += [_off("events located", [r.event_off for r in records]), _off("runs back", [r.reversal for r in records])]
    lines += ["", "stopped or refused, most frequent first:"]
    reasons = Counter((r.verdict, _reason(r.message)) for r in records if r.verdict in ("stopped", "refused"))
    lines += [f"  {count:4d}  {verdict}: {reason}" for (verdict, reason), count in reasons.most_common(12)]
    bad = [r for r in records if r.verdict in ("RAW", "WRONG")]
    lines += ["", f"raw: {sum(r.verdict == 'RAW' for r in bad)}, wrong: {sum(r.verdict == 'WRONG' for r in bad)}"]
    lines += [_of(r) for r in bad]
    lines += ["", "stopped, but off before:", *map(_of, [r for r in records if r.off][:10])]
    gross = [r for r in records if r.gross and r not in bad]
    lines += ["", f"gross, though within {ALLOWED:g} rtol: {len(gross)}", *map(_of, gross[:10])]
    lines += ["", "the worst by error over rtol:"]
    lines += [_of(r) for r in sorted((r for r in records if r.worst == r.worst), key=lambda r: -r.worst)[:10]]
    return "\n".join(lines)


def _line(name: str, formulation: str, records: Sequence[Record]) -> str:
    count = Counter(record.verdict for record in records)
    errors = np.array([float(x) for record in records for x in record.errors.split()])
    p = [np.percentile(errors, k) if len(errors) else np.nan for k in (50, 90, 99, 100)]
    rhs = sum(record.rhs for record in records)
    return (
        f"{name:22s} {formulation:8s} {len(records):5d} {count['RAW']:4d} {count['WRONG']:5d}"
        f" {sum(r.gross for r in records):5d} {100 * count['stopped'] / len(records):6.1f}"
        f" {sum(r.off for r in records):4d} {count['refused']:4d}"
        f" {sum(r.unresolved for r in records):5d} {p[0]:9.2g} {p[1]:9.2g} {p[2]:9.2g} {p[3]:9.2g} {rhs:8d}"
    )


def _off(what: str, numbers: Sequence[float]) -> str:
    known = np.array([x for x in numbers if x == x])
    if not len(known):
        return f"{what}: none"
    return f"{what}: {len(known)}, off by {np.median(known):.2g} rtol in the median, {known.max():.2g} at most"


def _of(record: Record) -> str:
    return (
        f"  seed {record.seed}: {record.mechanism} {record.formulation} {record.method} rtol {record.rtol:.1e}"
        f" {record.status} {record.verdict} worst {record.worst:.2g} at t = {record.worst_t:.4g},"
        f" drift {record.drift:.2g}; {record.why or record.message}"
    )


def _reason(message: str) -> str:
    """A message without its numbers and names, so that alike ones are counted together."""
    return re.sub(r"-?\d[\d.e+-]*", "#", message)[:110]
