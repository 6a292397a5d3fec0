"""The program itself: formulations, methods, tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from time import perf_counter
from typing import Any

from ckc_pin.errors import CkcError
from ckc_pin.native import unavailable
from ckc_pin.simulation.simulate import simulate
from ckc_pin.study.report.row import Motion
from ckc_pin.study.report.work import Work

__all__ = ["PROGRAM", "Setting", "compute", "settings"]

PROGRAM = "ckc_pin"
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
METHODS = ("auto", "DOP853", "RK45", "Radau", "BDF", "LSODA")
QUICK_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
QUICK_METHODS = ("auto",)
SHORT = 1.0  # s: runs that take less are repeated
REPEATS = 3


@dataclass(frozen=True)
class Setting:
    """How a scene is run: a name, and values of it by dotted key."""

    name: str
    changes: dict[str, Any]


def settings(quick: bool, budget: float) -> Iterator[Setting]:
    """Every formulation, method and tolerance, both backends, `budget` seconds at most; eq. 8 is one of its own."""
    formulations = {
        "dae": {},
        "reduced": {},
        "spf": {"solver.spf_equation": 17},
        "spf, eq. 8": {"solver.spf_equation": 8},
    }
    backends = ("auto",) if unavailable() else ("auto", "python")
    choices = product(formulations.items(), QUICK_METHODS if quick else METHODS, backends)
    for (name, own), method, backend in choices:
        where = ", in Python" if backend != backends[0] else ""
        for rtol in QUICK_TOLERANCES if quick else TOLERANCES:
            changes = {"formulation": name.split(",")[0], "solver.method": method, "solver.rtol": rtol}
            limits = {"solver.backend": backend, "solver.max_wall_s": budget}
            yield Setting(f"{name}, {method}{where}, rtol {rtol:.0e}", {**own, **changes, **limits})


def compute(work: Work, setting: Setting) -> Motion:
    """Run a work; short runs are repeated, after one that warms up, and the fastest counts."""
    walls: list[float] = []
    setup = 0.0
    while True:
        began = perf_counter()
        try:
            run = simulate(work.load(**{name.replace(".", "__"): x for name, x in setting.changes.items()}))
        except CkcError as error:
            none = work.mechanism.q_tree[None, :0].reshape(0, work.mechanism.n)
            return Motion("refused", str(error), none, none, 0.0, perf_counter() - began)
        if run.status == "interrupted":  # the report is, not only this run
            raise KeyboardInterrupt("SIGTERM" if "SIGTERM" in run.message else "")
        walls.append(float(run.stats["wall_s"]))
        setup = perf_counter() - began - walls[-1]
        if run.status != "done" or walls[-1] > SHORT or len(walls) > REPEATS:
            break
    stats = run.stats
    method = f" ({stats['method']})" if "auto" in setting.name else ""
    reason = f"{run.message}{method}" if run.status != "done" else str(stats["method"])
    return Motion(run.status, reason, run.q_tree, run.v_tree, min(walls), setup, stats["steps"], stats["rhs"])
