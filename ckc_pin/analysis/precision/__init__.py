"""Work against precision on a scene of one's own: what each setting costs, and how far off it is."""

from ckc_pin.analysis.precision.compute import BUDGET, TARGETS, Advice, WorkPrecision, work_precision
from ckc_pin.analysis.precision.motion import PrecisionRow
from ckc_pin.analysis.precision.reference import Reference
from ckc_pin.analysis.precision.report import (
    precision_csv,
    precision_lines,
    precision_markdown,
    precision_plain,
    precision_table,
)

__all__ = [
    "BUDGET",
    "TARGETS",
    "Advice",
    "PrecisionRow",
    "Reference",
    "WorkPrecision",
    "precision_csv",
    "precision_lines",
    "precision_markdown",
    "precision_plain",
    "precision_table",
    "work_precision",
]
