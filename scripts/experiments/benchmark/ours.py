"""The program itself: formulations, methods, tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from time import perf_counter
from typing import Any

from ckc_pin.analysis.precision.motion import without_place
from ckc_pin.errors import CkcError
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.simulate import run_prepared
from scripts.experiments.benchmark.row import Motion, Row
from scripts.experiments.benchmark.work import Work

__all__ = ["PROGRAM", "Setting", "compute", "refused", "setting_of", "settings", "used_up"]

PROGRAM = "ckc_pin"
FORMULATIONS: dict[str, dict[str, Any]] = {
    "dae": {"formulation": "dae"},
    "reduced": {"formulation": "reduced"},
    "spf": {"formulation": "spf", "spf_coordinates": "w"},
    "spf, eq. 8": {"formulation": "spf", "spf_coordinates": "z"},
}
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
QUICK_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
FEW = (1e-3, 1e-6, 1e-9, 1e-12)  # of what is not the fastest
METHODS = {"auto": TOLERANCES, "DOP853": TOLERANCES, "RK45": FEW, "Radau": FEW}
QUICK_METHODS = {"auto": QUICK_TOLERANCES}
ENOUGH = 0.1  # s of runs, set-up included; up to then they are repeated
REPEATS = 50
LONG = 1.0  # s: one run of that is enough


@dataclass(frozen=True)
class Setting:
    """How a scene is run: what the report calls it, and values of the scene by dotted key.

    The name says it all, so that a row's setting can be read back: "dae, auto, rtol 1e-06".
    """

    formulation: str
    method: str
    rtol: float

    @property
    def family(self) -> str:
        """The name without the tolerance."""
        return f"{self.formulation}, {self.method}"

    @property
    def name(self) -> str:
        """The row's name of it."""
        return f"{self.family}, rtol {self.rtol:.0e}"

    @property
    def changes(self) -> dict[str, Any]:
        """Values of the scene."""
        return {**FORMULATIONS[self.formulation], "solver.method": self.method, "solver.rtol": self.rtol}


def setting_of(name: str) -> Setting:
    """Read a setting's name back."""
    family, _, rtol = name.rpartition(", rtol ")
    formulation, _, method = family.rpartition(", ")
    return Setting(formulation, method, float(rtol))


def settings(quick: bool) -> Iterator[Setting]:
    """Every formulation, method and tolerance; eq. 8 as printed is a formulation of its own."""
    for (method, tolerances), formulation in product((QUICK_METHODS if quick else METHODS).items(), FORMULATIONS):
        for rtol in tolerances:
            yield Setting(formulation, method, rtol)


def refused(work: Work, reason: str) -> Motion:
    """Return the motion of a run that was not made."""
    none = work.mechanism.q_tree[None, :0].reshape(0, work.mechanism.n)
    return Motion("refused", reason, none, none, 0.0, 0.0)


def used_up(row: Row) -> bool:
    """Whether a run was stopped by its budget of time."""
    return row.status == "stopped" and "max_wall_s" in row.reason


def compute(work: Work, changes: dict[str, Any], budget: float) -> Motion:
    """Run a work, stopped after a budget in s; short runs are repeated, after one that warms up, the fastest counts."""
    limited = {**changes, "solver.max_wall_s": budget}
    walls: list[float] = []
    began = perf_counter()
    try:
        ready = prepare(work.load(**{name.replace(".", "__"): x for name, x in limited.items()}))
        setup = perf_counter() - began
        while True:
            run = run_prepared(ready)
            if run.status == "interrupted":  # the report is, not only this run
                raise KeyboardInterrupt("SIGTERM" if "SIGTERM" in run.message else "")
            walls.append(float(run.stats["wall_s"]))
            enough = perf_counter() - began > ENOUGH and len(walls) > 1
            if run.status != "done" or enough or walls[-1] > LONG or len(walls) > REPEATS:
                break
    except CkcError as error:
        return refused(work, str(error))
    stats = run.stats
    method = f" ({stats['method']})" if changes["solver.method"] == "auto" else ""
    reason = f"{without_place(run.message)}{method}" if run.status != "done" else str(stats["method"])
    return Motion(run.status, reason, run.q_tree, run.v_tree, min(walls), setup, stats["steps"], stats["rhs"])
