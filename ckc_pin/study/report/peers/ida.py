"""SUNDIALS IDA through scikit-sundae, on the Gear-Gupta-Leimkuhler form with the terms of this program."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata

from ckc_pin.study.report import ours
from ckc_pin.study.report.row import Motion
from ckc_pin.study.report.work import Work

__all__ = ["Ida"]


class Ida:
    """What `method = "IDA"` runs: a residual in Python."""

    name = "SUNDIALS IDA"
    packaged = True

    def missing(self, work: Work) -> str | None:
        try:
            metadata.version("scikit-sundae")
        except metadata.PackageNotFoundError:
            return "not installed: pip install 'ckc_pin[sundials]'"
        return "it integrates numbers, a free root has none" if work.mechanism.tree.free else None

    def version(self) -> str:
        return f"scikit-sundae {metadata.version('scikit-sundae')}"

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        for rtol in ours.QUICK_TOLERANCES if quick else ours.TOLERANCES:
            yield f"rtol {rtol:.0e}"

    def check(self, work: Work) -> str:
        return "the terms are this program's"

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        rtol = float(setting.removeprefix("rtol "))
        return ours.compute(work, {"formulation": "dae", "solver.method": "IDA", "solver.rtol": rtol}, budget)
