"""The program itself: formulations, methods, tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from ckc_pin.analysis.precision.motion import FORMULATIONS, Motion, Setting, override_scene, time_scene
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.work import Work

__all__ = ["PROGRAM", "compute", "name_of", "setting_of", "settings", "used_up"]

PROGRAM = "ckc_pin"
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
QUICK_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
FEW = (1e-3, 1e-6, 1e-9, 1e-12)  # of what is not the fastest
METHODS = {"auto": TOLERANCES, "DOP853": TOLERANCES, "RK45": FEW, "Radau": FEW}
QUICK_METHODS = {"auto": QUICK_TOLERANCES}


def name_of(setting: Setting) -> str:
    """Return what the report calls a setting; it says all of it: "dae, auto, rtol 1e-06"."""
    return f"{setting.formulation}, {setting.method}, rtol {setting.rtol:.0e}"


def setting_of(name: str) -> Setting:
    """Return the setting of a name."""
    family, _, rtol = name.rpartition(", rtol ")
    formulation, _, method = family.rpartition(", ")
    return Setting(formulation, method, float(rtol))


def settings(quick: bool) -> Iterator[Setting]:
    """Every formulation, method and tolerance."""
    for (method, tolerances), formulation in product((QUICK_METHODS if quick else METHODS).items(), FORMULATIONS):
        for rtol in tolerances:
            yield Setting(formulation, method, rtol)


def used_up(row: Row) -> bool:
    """Whether a run was stopped by its budget of time."""
    return row.status == "stopped" and "max_wall_s" in row.reason


def compute(work: Work, setting: Setting, budget: float) -> Motion:
    """Run a work, stopped after a budget in s; its reason names the method that "auto" took."""
    scene = work.load()
    limited = override_scene(
        scene, {**setting.overrides(scene), "solver.terms": work.terms, "solver.max_wall_s": budget}
    )
    motion, _ = time_scene(limited, budget, min_runs=2)
    if motion.status == "done":
        return replace(motion, reason=motion.used)
    return replace(motion, reason=f"{motion.reason} ({motion.used})") if motion.used != setting.method else motion
