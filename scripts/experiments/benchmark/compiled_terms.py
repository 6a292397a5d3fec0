"""Measure the cost of compiling a work's terms, and the length of run from which that pays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from ckc_pin.analysis.precision.motion import override_scene, time_scene
from ckc_pin.codegen.library import compile_terms
from ckc_pin.errors import InputError
from scripts.experiments.benchmark.work import Work
from scripts.experiments.generated_sizes import empty_cache

__all__ = ["CompiledTermsCost", "compiled_terms_cost"]

# The setting at which the speed-up is measured, as in the report's best settings.
AT = {"formulation": "dae", "solver.method": "DOP853", "solver.rtol": 1e-6}


@dataclass(frozen=True)
class CompiledTermsCost:
    """Cost and speed-up of compiled terms for a work's mechanism.

    Attributes
    ----------
    compile_s : float or None
        Time for expressions, C text, compiler and comparison with Pinocchio, s.
    refused : str
        Why there are no compiled terms; empty otherwise.
    compiled_run_s, pinocchio_run_s : float or None
        Time of a run with compiled terms, and with Pinocchio's, s.
    pays_s : float or None
        Length of motion from which compiling and running takes less time than Pinocchio's terms, s.
    """

    compile_s: float | None = None
    refused: str = ""
    compiled_run_s: float | None = None
    pinocchio_run_s: float | None = None
    pays_s: float | None = None


def compiled_terms_cost(work: Work, budget: float) -> CompiledTermsCost:
    """Compile a work's terms with an empty cache, and time its run with them and with Pinocchio's."""
    with TemporaryDirectory() as folder, empty_cache(Path(folder) / "cache"):
        began = perf_counter()
        try:
            compile_terms(work.mechanism)
        except InputError as error:
            return CompiledTermsCost(refused=str(error))
        cost = CompiledTermsCost(perf_counter() - began)
        runs = [
            time_scene(
                override_scene(work.load(), {**AT, "solver.terms": terms, "solver.max_wall_s": budget}),
                budget,
                min_runs=2,
            )[0]
            for terms in ("generated", "pinocchio")
        ]
    if any(run.status != "done" for run in runs):
        return cost
    compiled_run_s, pinocchio_run_s = (float(run.wall_s or 0.0) for run in runs)
    saved = (pinocchio_run_s - compiled_run_s) / work.t_end
    pays = (cost.compile_s or 0.0) / saved if saved > 0.0 else None
    return replace(cost, compiled_run_s=compiled_run_s, pinocchio_run_s=pinocchio_run_s, pays_s=pays)
