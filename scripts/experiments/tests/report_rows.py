"""Made-up rows of the report's table."""

from __future__ import annotations

from typing import Any

from scripts.experiments.benchmark import ours
from scripts.experiments.benchmark.row import Row

__all__ = ["peer", "row"]


def row(**changes: Any) -> Row:
    plain: dict[str, Any] = {
        "key": "k", "work": "short", "program": ours.PROGRAM, "setting": "dae, auto, rtol 1e-06", "status": "done",
        "reason": "", "error_end": 1e-8, "error_max": 1e-7, "closure": 1e-14, "energy_drift": None, "wall_s": 0.01,
        "setup_s": 0.02, "steps": 10, "rhs": 100,
    }  # fmt: skip
    return Row(**(plain | changes))


def peer(**changes: Any) -> Row:
    return row(**{"program": "MuJoCo", "setting": "RK4", **changes})
