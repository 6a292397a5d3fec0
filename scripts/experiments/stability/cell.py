"""Run a case in one formulation by one method, and give a verdict on its error: a cell of the table."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, Literal

import numpy as np

from ckc_pin import Run, simulate
from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.scene.overrides import apply_overrides
from ckc_pin.scene.scene import make_scene
from scripts.experiments.stability.planar import Planar
from scripts.experiments.stability.reference import Reference

__all__ = ["ALLOWED", "BUDGET", "Case", "Cell", "Variant", "Verdict", "kinetic_energies", "run_case"]

Verdict = Literal["within", "stopped", "FAILED"]

NAN = float("nan")
ALLOWED = 1e3  # largest error over rtol, relative to the solution's scale
BUDGET = {"solver.max_rhs": 30_000, "solver.max_wall_s": 300.0}


@dataclass(frozen=True)
class Variant:
    """A formulation and a method, with the SPF in the coordinates of eq. 17 or as eq. 8 is printed."""

    formulation: str
    method: str = "auto"
    rtol: float = 1e-8
    printed: bool = False

    @property
    def overrides(self) -> dict[str, Any]:
        """Return the overrides of a scene."""
        return {
            "formulation": self.formulation,
            "spf_coordinates": "z" if self.printed else "w",
            "solver.method": self.method,
            "solver.rtol": self.rtol,
        }

    @property
    def label(self) -> str:
        """Short name, for example "spf (8)"."""
        return f"{self.formulation} (8)" if self.printed else self.formulation


@dataclass(frozen=True)
class Case:
    """A motion to run, and its reference.

    Attributes
    ----------
    group, name : str
    mechanism : Planar, str or table
        Five-bar to write as files, name of a shipped mechanism, or table of a generator.
    overrides : mapping
        Other values of the scene, by dotted key.
    reference : Reference
    variants : tuple of Variant
    conserves : bool
        Whether energy should be conserved.
    """

    group: str
    name: str
    mechanism: Planar | str | Mapping[str, Any]
    overrides: Mapping[str, Any]
    reference: Reference
    variants: tuple[Variant, ...]
    conserves: bool = True


@dataclass(frozen=True)
class Cell:
    """Result of one run: a row of the table.

    Attributes
    ----------
    error : float
        Largest error over the output instants to the end of the run, relative to the solution's scale.
    allowed : float
    max_phi : float
        Largest |phi - w| at the output instants, m.
    uncertainty : float
        Relative error bound of the reference.
    drift : float
        Drift of the energy, relative to the largest kinetic energy; NaN if energy is not conserved.
    cpu_s : float
        Processor time, s.
    """

    group: str
    case: str
    formulation: str
    method: str
    rtol: float
    reference: str
    verdict: Verdict
    error: float = NAN
    allowed: float = NAN
    uncertainty: float = NAN
    max_phi: float = NAN
    drift: float = NAN
    rhs: int = 0
    newton: int = 0
    steps: int = 0
    switches: int = 0
    t: float = 0.0
    cpu_s: float = 0.0
    message: str = ""


def run_case(case: Case) -> list[Cell]:
    """Run a case in all its formulations and methods, which share one reference."""
    with tempfile.TemporaryDirectory() as folder:
        mechanism: Any = case.mechanism
        if isinstance(mechanism, Planar):
            mechanism.write(Path(folder))
            mechanism = "mechanism.toml"
        data = apply_overrides({"mechanism": mechanism}, {**BUDGET, **case.overrides})
        return [
            _run_cell(case, variant, apply_overrides(data, variant.overrides), Path(folder))
            for variant in case.variants
        ]


def _run_cell(case: Case, variant: Variant, data: dict[str, Any], folder: Path) -> Cell:
    key: dict[str, Any] = {
        "group": case.group,
        "case": case.name,
        "formulation": variant.label,
        "method": variant.method,
    }
    key.update(rtol=variant.rtol, reference=case.reference.source)
    started = process_time()
    try:
        run = simulate(make_scene(data, f"{case.group}: {case.name}", Sources(case.name, folder)))
    except NumericalError as refused:  # a singular start
        return Cell(**key, verdict="stopped", cpu_s=process_time() - started, message=str(refused))
    except Exception as crash:  # any other exception is a failure
        return Cell(**key, verdict="FAILED", cpu_s=process_time() - started, message=f"{type(crash).__name__}: {crash}")
    spent = process_time() - started
    allowed = ALLOWED * variant.rtol
    if variant.method == "auto":
        key["method"] = f"auto: {run.stats['method']}"
    right = case.reference
    error, max_phi = right.error(run), right.phi(run)
    return Cell(
        **key,
        verdict=_verdict(run, error, max_phi, allowed),
        error=error,
        allowed=allowed,
        uncertainty=right.uncertainty(run),
        max_phi=max_phi,
        drift=_drift(run) if case.conserves else NAN,
        rhs=run.stats["rhs"],
        newton=run.stats["newton"],
        steps=run.stats["steps"],
        switches=run.stats["switches"],
        t=float(run.t[-1]),
        cpu_s=spent,
        message="" if run.status == "done" else run.message,
    )


def _verdict(run: Run, error: float, max_phi: float, allowed: float) -> Verdict:
    if run.status != "done":
        return "stopped"
    closed = max_phi <= allowed * max(1.0, run.mechanism.size)
    return "within" if error <= allowed and closed else "FAILED"


def _drift(run: Run) -> float:
    largest = float(kinetic_energies(run).max())
    return float(np.abs(run.energy - run.energy[0]).max() / largest) if largest > 0 else 0.0


def kinetic_energies(run: Run) -> Array:
    """Return the kinetic energy at a run's output instants, J."""
    mechanism = run.mechanism
    return np.array(
        [
            0.5 * v @ Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(q)), v).D_tree @ v
            for q, v in zip(run.q_tree, run.v_tree, strict=True)
        ]
    )
