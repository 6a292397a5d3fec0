"""What it costs a work to have its terms written out, and from which length of run that pays."""

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

__all__ = ["WrittenOut", "written_out"]

# what the gain is measured at, as the report's best settings are
AT = {"formulation": "dae", "solver.method": "DOP853", "solver.rtol": 1e-6}


@dataclass(frozen=True)
class WrittenOut:
    """Terms written out for a work's mechanism.

    Attributes
    ----------
    compile_s : float or None
        Expressions, C, compiling and the comparison with Pinocchio, s.
    refused : str
        Why there are none.
    written_s, general_s : float or None
        Time of a run with them, and with Pinocchio's, s.
    pays_s : float or None
        Motion from which a run, all in all, takes less time with them, s.
    """

    compile_s: float | None = None
    refused: str = ""
    written_s: float | None = None
    general_s: float | None = None
    pays_s: float | None = None


def written_out(work: Work, budget: float) -> WrittenOut:
    """Compile a work's terms as if for the first time, and run it with and without."""
    with TemporaryDirectory() as folder, empty_cache(Path(folder) / "cache"):
        began = perf_counter()
        try:
            compile_terms(work.mechanism)
        except InputError as error:
            return WrittenOut(refused=str(error))
        found = WrittenOut(perf_counter() - began)
        runs = [
            time_scene(
                override_scene(work.load(), {**AT, "solver.terms": terms, "solver.max_wall_s": budget}),
                budget,
                min_runs=2,
            )[0]
            for terms in ("generated", "pinocchio")
        ]
    if any(run.status != "done" for run in runs):
        return found
    written_s, general_s = (float(run.wall_s or 0.0) for run in runs)
    saved = (general_s - written_s) / work.t_end
    pays = (found.compile_s or 0.0) / saved if saved > 0.0 else None
    return replace(found, written_s=written_s, general_s=general_s, pays_s=pays)
