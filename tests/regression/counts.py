"""What fixed runs evaluate, by backend; `python -m tests.regression.counts` writes data/counts.json anew.

To be done when a change is meant to change them, and to be looked at then: fewer, or more for a reason. The runs are
ones whose counts rounding does not change: between machines, or by 1e-9 of atol.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ckc_pin import simulate
from ckc_pin.native import unavailable

__all__ = ["BACKENDS", "COUNTED", "RUNS", "TOLERANCE", "changed", "measured", "recorded"]

FILE = Path(__file__).parent / "data" / "counts.json"
BACKENDS = ("native", "python")
COUNTED = ("rhs", "factorizations", "newton", "jacobians", "steps")
TOLERANCE = 0.02

RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "swing, reduced": ("five_bar/swing", {"formulation": "reduced"}),
    "swing, dae": ("five_bar/swing", {"formulation": "dae"}),
    "swing, eq. 8": (
        "five_bar/swing",
        {"formulation": "spf", "solver.spf_equation": 8, "epsilon": 1e-2, "solver.method": "DOP853"},
    ),
    "tracking, reduced, BDF": (
        "five_bar/tracking",
        {"formulation": "reduced", "solver.method": "BDF", "t_end": 4.0},
    ),
    "tracking, reduced, Radau": (
        "five_bar/tracking",
        {"formulation": "reduced", "solver.method": "Radau", "t_end": 2.0},
    ),
    "tracking, dae, BDF": ("five_bar/tracking", {"formulation": "dae", "t_end": 2.0}),
    "bricard, dae": ("bricard", {"formulation": "dae", "t_end": 5.0}),
    "stewart, dae": ("stewart", {"formulation": "dae", "t_end": 1.0}),
    "two_ur5, dae": ("two_ur5", {"formulation": "dae", "t_end": 1.0}),
}


def measured(name: str, backend: str) -> dict[str, int]:
    """Make a run and return its counts."""
    scene, changes = RUNS[name]
    run = simulate(scene, {"solver.rtol": 1e-8, "solver.atol": 1e-10, "solver.backend": backend, **changes})
    assert run.status == "done"
    assert run.stats["backend"] == backend
    return {count: int(run.stats[count]) for count in COUNTED}


def recorded() -> dict[str, dict[str, dict[str, int]]]:
    """Return the counts on file, by run and backend."""
    found: dict[str, dict[str, dict[str, int]]] = json.loads(FILE.read_text(encoding="utf-8"))
    return found


def changed(found: dict[str, int], known: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Return the counts that are off by more than 2 %, up or down: what was found, what is known."""
    return {
        name: (found[name], known[name]) for name in known if abs(found[name] - known[name]) > TOLERANCE * known[name]
    }


def main() -> int:
    """Write the file."""
    if reason := unavailable():
        print(f"counts: {reason}", file=sys.stderr)
        return 2
    made = {name: {backend: measured(name, backend) for backend in BACKENDS} for name in RUNS}
    lines = [
        f"  {json.dumps(name)}: {{\n"
        + ",\n".join(f"    {json.dumps(backend)}: {json.dumps(counts)}" for backend, counts in own.items())
        + "\n  }"
        for name, own in made.items()
    ]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
