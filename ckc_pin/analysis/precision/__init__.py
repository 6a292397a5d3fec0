"""Work-precision comparison of the formulations, methods and tolerances of one scene: error against run time."""

from ckc_pin.analysis.precision.compute import DEFAULT_BUDGET_S, TARGET_ERRORS, Advice, WorkPrecision, work_precision
from ckc_pin.analysis.precision.motion import PrecisionRow
from ckc_pin.analysis.precision.reference import Reference
from ckc_pin.analysis.precision.report import make_csv, make_markdown, make_time_table

__all__ = [
    "DEFAULT_BUDGET_S",
    "TARGET_ERRORS",
    "Advice",
    "PrecisionRow",
    "Reference",
    "WorkPrecision",
    "make_csv",
    "make_markdown",
    "make_time_table",
    "work_precision",
]
