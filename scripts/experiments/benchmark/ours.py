"""Settings of ckc_pin in the benchmark: formulations, methods, tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from ckc_pin.analysis.precision.motion import FORMULATIONS, Motion, Setting, override_scene, time_scene
from scripts.experiments.benchmark.row import Row
from scripts.experiments.benchmark.work import Work

__all__ = ["PROGRAM", "compute", "name_of", "setting_of", "settings", "used_up"]

PROGRAM = "ckc_pin"
TOLERANCES = tuple(10.0**-k for k in range(3, 14))
QUICK_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
COARSE_TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)  # for methods that are not the fastest
METHODS = {"auto": TOLERANCES, "DOP853": TOLERANCES, "RK45": COARSE_TOLERANCES, "Radau": COARSE_TOLERANCES}
QUICK_METHODS = {"auto": QUICK_TOLERANCES}


def name_of(setting: Setting) -> str:
    """Return the name of a setting, which `setting_of` reads back: "dae, auto, rtol 1e-06"."""
    return f"{setting.formulation}, {setting.method}, rtol {setting.rtol:.0e}"


def setting_of(name: str) -> Setting:
    """Return the setting with a name of `name_of`."""
    family, _, rtol = name.rpartition(", rtol ")
    formulation, _, method = family.rpartition(", ")
    return Setting(formulation, method, float(rtol))


def settings(quick: bool) -> Iterator[Setting]:
    """Yield every formulation, method and tolerance."""
    for (method, tolerances), formulation in product((QUICK_METHODS if quick else METHODS).items(), FORMULATIONS):
        for rtol in tolerances:
            yield Setting(formulation, method, rtol)


def used_up(row: Row) -> bool:
    """Whether a run was stopped by its time budget."""
    return row.status == "stopped" and "max_wall_s" in row.reason


def compute(work: Work, setting: Setting, budget: float) -> Motion:
    """Run a work with a time budget in s. The reason of the motion names the method that "auto" chose."""
    scene = work.load()
    limited = override_scene(
        scene, {**setting.overrides(scene), "solver.terms": work.terms, "solver.max_wall_s": budget}
    )
    motion, _ = time_scene(limited, budget, min_runs=2)
    if motion.status == "done":
        return replace(motion, reason=motion.used)
    return replace(motion, reason=f"{motion.reason} ({motion.used})") if motion.used != setting.method else motion
