"""Runs of 1,000 s: drift of the energy and of phi."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin import simulate
from ckc_pin.base.arrays import Array
from scripts.experiments.stability.cell import kinetic_energies
from scripts.experiments.stability.equations import to_absolute

__all__ = ["LONG_RUN_SETTINGS", "LongRun", "long_run"]

RTOL = 1e-10
T_END = 1000.0
OUTPUT_DT = 0.1
# name, formulation, overrides of five_bar/swing
LONG_RUN_SETTINGS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("swing", "reduced", {}),
    ("swing", "spf", {}),
    ("swing", "dae", {}),
    ("across type 2", "dae", {"initial.q_dot": {"theta_1": 9.0, "theta_3": -9.0}}),
)


@dataclass(frozen=True)
class LongRun:
    """Result of a long run.

    Attributes
    ----------
    drift : float
        Largest |E - E(0)|, relative to the range of the kinetic energy.
    max_phi : float
        Largest |phi| at the output instants, m.
    crossings : int
        Number of sign changes of det phi_z between output instants.
    """

    name: str
    formulation: str
    method: str
    rtol: float
    t: float
    drift: float
    max_phi: float
    crossings: int
    rhs: int
    steps: int
    outcome: str


def long_run(name: str, formulation: str, overrides: dict[str, Any], t_end: float = T_END) -> LongRun:
    """Run one of `LONG_RUN_SETTINGS`, or a shorter part of it."""
    solver = {"t_end": t_end, "solver.rtol": RTOL, "solver.output_dt": OUTPUT_DT, "formulation": formulation}
    run = simulate("five_bar/swing", {**solver, **overrides})
    kinetic = kinetic_energies(run)
    drift = np.abs(run.energy - run.energy[0]).max() / (kinetic.max() - kinetic.min())
    return LongRun(
        name=name,
        formulation=formulation,
        method=run.stats["method"],
        rtol=RTOL,
        t=float(run.t[-1]),
        drift=float(drift),
        max_phi=run.max_phi,
        crossings=_crossings(run.q_tree),
        rhs=run.stats["rhs"],
        steps=run.stats["steps"],
        outcome=run.message if run.status != "done" else "done",
    )


def _crossings(q_tree: Array) -> int:
    """Count sign changes of det phi_z, by the sine of the angle between the distal links."""
    angles = np.array([to_absolute(q) for q in q_tree.tolist()])
    side = np.sign(np.sin(angles[:, 1] - angles[:, 3]))
    return int(np.sum(side[1:] != side[:-1]))
