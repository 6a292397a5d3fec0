"""Table of records by mechanism and formulation, followed by the worst runs."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from scripts.experiments.fuzz.record import ALLOWED_FACTOR, Record

__all__ = ["format_table"]


def format_table(records: Sequence[Record]) -> str:
    """Return the report of a suite as text."""
    lines = [
        f"{'mechanism':22s} {'form':8s} {'runs':>5s} {'exc':>4s} {'wrong':>5s} {'gross':>5s} {'stop%':>6s}"
        f" {'late':>4s} {'refd':>4s} {'unres':>5s} {'p50':>9s} {'p90':>9s} {'p99':>9s} {'max':>9s} {'rhs':>8s}"
    ]
    groups = sorted({(record.mechanism, record.formulation) for record in records})
    for name, formulation in groups:
        lines.append(
            _line(name, formulation, [r for r in records if (r.mechanism, r.formulation) == (name, formulation)])
        )
    for formulation in sorted({record.formulation for record in records}):
        lines.append(_line("all", formulation, [r for r in records if r.formulation == formulation]))
    lines += [_line("all", "all", records), ""]
    lines += [
        _summarize_errors("events", [r.event_error for r in records]),
        _summarize_errors("reversed runs", [r.reversal for r in records]),
    ]
    lines += ["", "stopped or refused, most frequent first:"]
    reasons = Counter(
        (r.verdict, _normalize_message(r.message)) for r in records if r.verdict in ("stopped", "refused")
    )
    lines += [f"  {count:4d}  {verdict}: {reason}" for (verdict, reason), count in reasons.most_common(12)]
    bad = [r for r in records if r.verdict in ("EXCEPTION", "WRONG")]
    exceptions = sum(r.verdict == "EXCEPTION" for r in bad)
    lines += ["", f"unexpected exceptions: {exceptions}, wrong: {len(bad) - exceptions}"]
    lines += [_describe(r) for r in bad]
    late = [r for r in records if r.failed_before_stop]
    lines += ["", "stopped only after they had gone wrong (late):", *map(_describe, late[:10])]
    gross = [r for r in records if r.gross and r not in bad]
    lines += ["", f"gross error, though below {ALLOWED_FACTOR:g} rtol: {len(gross)}", *map(_describe, gross[:10])]
    lines += ["", "largest errors over rtol:"]
    lines += [_describe(r) for r in sorted((r for r in records if r.worst == r.worst), key=lambda r: -r.worst)[:10]]
    return "\n".join(lines)


def _line(name: str, formulation: str, records: Sequence[Record]) -> str:
    count = Counter(record.verdict for record in records)
    errors = np.array([float(x) for record in records for x in record.errors.split()])
    p = [np.percentile(errors, k) if len(errors) else np.nan for k in (50, 90, 99, 100)]
    rhs = sum(record.rhs for record in records)
    return (
        f"{name:22s} {formulation:8s} {len(records):5d} {count['EXCEPTION']:4d} {count['WRONG']:5d}"
        f" {sum(r.gross for r in records):5d} {100 * count['stopped'] / len(records):6.1f}"
        f" {sum(r.failed_before_stop for r in records):4d} {count['refused']:4d}"
        f" {sum(r.unresolved for r in records):5d} {p[0]:9.2g} {p[1]:9.2g} {p[2]:9.2g} {p[3]:9.2g} {rhs:8d}"
    )


def _summarize_errors(label: str, errors: Sequence[float]) -> str:
    finite = np.array([x for x in errors if x == x])
    if not len(finite):
        return f"{label}: none"
    return f"{label}: {len(finite)}, error over rtol {np.median(finite):.2g} (median), {finite.max():.2g} (largest)"


def _describe(record: Record) -> str:
    return (
        f"  seed {record.seed}: {record.mechanism} {record.formulation} {record.method} rtol {record.rtol:.1e}"
        f" {record.status} {record.verdict} worst {record.worst:.2g} at t = {record.worst_t:.4g},"
        f" drift {record.drift:.2g}; {record.fault or record.message}"
    )


def _normalize_message(message: str) -> str:
    """Return a message without its numbers, so that messages of one kind are counted together."""
    return re.sub(r"-?\d[\d.e+-]*", "#", message)[:110]
