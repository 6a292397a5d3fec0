"""Write problems A01 to A05 of IFToMM's library of benchmark problems as result files that can be submitted there.

A result file is a text with one line of names, then one line for each instant at equal distances; columns have 23
characters, numbers 16 digits. A submission also states accuracy and processor time, which are in solutions.csv. The
instants and quantities are those of solutions that others published for the library,
https://www.iftomm-multibody.org/benchmark; its problem descriptions have the last word.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import NumericalError
from ckc_pin.run.simulate import simulate
from scripts.experiments.benchmark.reference import reference
from scripts.experiments.benchmark.stamp import machine, versions
from scripts.experiments.benchmark.work import INSTANTS, WORKS, Work

__all__ = ["PROBLEMS", "IftommProblem", "write_solutions"]

RTOL = 1e-10
WIDTH = 23  # characters of a column
REPEATS = 5  # of a run, for its processor time


@dataclass(frozen=True)
class IftommProblem:
    """A problem of the library.

    Attributes
    ----------
    key, name : str
    work : str
        The benchmark's work of the same motion.
    step : float
        Between two lines of the result file, s.
    quantities : tuple of str
        Names of the columns after the time.
    values : callable
        Returns the columns from the work and (m, n) coordinates.
    """

    key: str
    name: str
    work: str
    step: float
    quantities: tuple[str, ...]
    values: Callable[[Work, Array], Array]


def _point(name: str, axes: int) -> Callable[[Work, Array], Array]:
    def values(work: Work, q_tree: Array) -> Array:
        mechanism = work.mechanism
        states = map(mechanism.tree.from_coordinates, q_tree)
        return np.array([mechanism.point_positions(state)[name][:axes] for state in states])

    return values


def _coordinate(name: str) -> Callable[[Work, Array], Array]:
    return lambda work, q_tree: q_tree[:, [work.mechanism.coordinates.index(name)]]


def _end_of_crank(work: Work, q_tree: Array) -> Array:
    """Return point F of Andrews' mechanism, at the end of the crank of 7 mm."""
    beta = q_tree[:, work.mechanism.coordinates.index("beta")]
    return 0.007 * np.column_stack([np.cos(beta), np.sin(beta)])


PROBLEMS = (
    IftommProblem("A01", "simple pendulum", "pendulum", 0.01, ("X", "Y"), _point("P1", 2)),
    IftommProblem("A02", "N-four-bar mechanism, N = 2", "n_four_bar_2", 0.01, ("X", "Y"), _point("B0", 2)),
    IftommProblem("A03", "Andrews' mechanism", "andrews", 0.00025, ("X", "Y"), _end_of_crank),
    IftommProblem("A04", "Bricard's mechanism", "bricard", 0.01, ("X", "Y", "Z"), _point("P3", 3)),
    IftommProblem("A05", "stiff flyball governor", "flyball", 0.1, ("S",), _coordinate("slider")),
)


def write_solutions(folder: Path, problems: tuple[IftommProblem, ...] = PROBLEMS) -> list[Path]:
    """Write a result file for each problem, and solutions.csv with accuracy and time; return the files.

    Raises
    ------
    NumericalError
        A run stopped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    works = {work.key: work for work in WORKS}
    files, rows = [], []
    for problem in problems:
        work = works[problem.work]
        t, q_tree, energy, wall_s = _solve(work, problem.step)
        path = folder / f"{problem.key}_results.txt"
        path.write_text(format_results(problem.quantities, t, problem.values(work, q_tree)), encoding="ascii")
        exact = reference(work)
        error = np.abs(work.observed(q_tree[:: (len(t) - 1) // INSTANTS]) - exact.values).max()
        conserved = not (work.controlled or work.mechanism.springs.any_damping or work.mechanism.springs.constant.any())
        rows.append({
            "problem": problem.key, "name": problem.name, "largest error (m or rad)": f"{error:.1e}",
            "energy drift (J)": f"{np.ptp(energy):.1e}" if conserved else "", "CPU time (s)": f"{wall_s:.2e}",
            "CPU": machine(), "method": f"ckc_pin, DAE, rtol {RTOL:g}, Pinocchio {versions()['pin']}",
        })  # fmt: skip
        files.append(path)
    table = folder / "solutions.csv"
    with table.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return [*files, table]


def format_results(names: tuple[str, ...], t: Array, columns: Array) -> str:
    """Return the text of a result file."""
    lines = ["".join(f"{name:>{WIDTH}}" for name in ("Time", *names))]
    lines += ["".join(f"{x:{WIDTH}.15E}" for x in row) for row in np.column_stack([t, columns])]
    return "\n".join([*lines, ""])


def _solve(work: Work, step: float) -> tuple[Array, Array, Array, float]:
    """Return instants, coordinates, energies and the shortest processor time of a work."""
    overrides: dict[str, Any] = {"formulation": "dae", "solver__rtol": RTOL, "solver__terms": work.terms}
    runs = [simulate(work.load(**overrides, solver__output_dt=step)) for _ in range(REPEATS)]
    if runs[0].status != "done":
        raise NumericalError(f"{work.key}: the DAE {runs[0].message}", run=runs[0])
    return runs[0].t, runs[0].q_tree, runs[0].energy, min(float(run.stats["wall_s"]) for run in runs)
