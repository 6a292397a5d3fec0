"""Numbers of evaluations of fixed runs; `python -m tests.regression.counts` records them in data/counts.json.

Record them when a change is meant to change them, and review the difference: fewer, or more for a reason. The counts of
these runs do not depend on rounding: they are equal on different machines and for atol changed by 1e-9.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ckc_pin import simulate

__all__ = ["COUNTED", "RUNS", "TOLERANCE", "changed", "measured", "recorded"]

FILE = Path(__file__).parent / "data" / "counts.json"
COUNTED = ("rhs", "factorizations", "newton", "jacobians", "steps")
TOLERANCE = 0.02

RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "swing, reduced": ("five_bar/swing", {"formulation": "reduced"}),
    "swing, dae": ("five_bar/swing", {"formulation": "dae"}),
    "swing, eq. 8": (
        "five_bar/swing",
        {"formulation": "spf", "spf_coordinates": "z", "epsilon": 1e-2, "solver.method": "DOP853"},
    ),
    "tracking, reduced, Radau": ("five_bar/tracking", {"formulation": "reduced", "t_end": 2.0}),
    "tracking, dae, Radau": ("five_bar/tracking", {"formulation": "dae", "t_end": 2.0}),
    "tracking, sampled": (
        "five_bar/tracking",
        {"formulation": "reduced", "controller.sample_time": 2e-3, "t_end": 1.0},
    ),
    "bricard, dae": ("bricard", {"formulation": "dae", "t_end": 5.0}),
    "stewart, dae": ("stewart", {"formulation": "dae", "t_end": 1.0}),
    "two_ur5, dae": ("two_ur5", {"formulation": "dae", "t_end": 1.0}),
}


def measured(name: str) -> dict[str, int]:
    """Run a scene and return its counts."""
    scene, overrides = RUNS[name]
    run = simulate(scene, {"solver.rtol": 1e-8, "solver.atol": 1e-10, **overrides})
    assert run.status == "done"
    return {count: int(run.stats[count]) for count in COUNTED}


def recorded() -> dict[str, dict[str, int]]:
    """Return the recorded counts by run."""
    counts: dict[str, dict[str, int]] = json.loads(FILE.read_text(encoding="utf-8"))
    return counts


def changed(counts: dict[str, int], recorded_counts: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Return the counts that differ from the recorded ones by more than 2 %, as (counted, recorded)."""
    return {
        name: (counts[name], recorded_counts[name])
        for name in recorded_counts
        if abs(counts[name] - recorded_counts[name]) > TOLERANCE * recorded_counts[name]
    }


def main() -> int:
    """Record the counts in the file."""
    lines = [f"  {json.dumps(name)}: {json.dumps(measured(name))}" for name in RUNS]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
