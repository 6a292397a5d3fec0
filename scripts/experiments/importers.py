"""Run exported FMUs in fmusim, the importer of the FMI project, and compare their motion with `simulate`."""

from __future__ import annotations

import csv
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ckc_pin import Scene, load_scene, simulate
from ckc_pin.formats.exporting import export, write

__all__ = ["main"]

OUTPUT_DT, T_END = 0.01, 1.0
RTOL, SOLVER_TOLERANCE = 1e-11, 1e-10  # of runs and co-simulation; of fmusim's CVODE in model exchange
FRICTIONLESS = {f"joint.theta_{k}.friction": 0.0 for k in (1, 2, 3, 4)}
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "five_bar, eq. 6": ("five_bar/swing", {"formulation": "reduced"}),
    "five_bar, eq. 8": ("five_bar/swing", {"formulation": "spf", "epsilon": 1e-3}),
    "five_bar, bounces": ("five_bar/friction", {"formulation": "reduced", "parameters": FRICTIONLESS}),
    "five_bar, comes to rest": (
        "five_bar/friction",
        {"formulation": "reduced", "parameters": {**FRICTIONLESS, "gravity": [-9.81, -3.0, 0.0]}},
    ),
    "delta, eq. 6": ("delta", {"formulation": "reduced"}),
}


def main(fmusim: Path) -> int:
    """Print the largest difference from `simulate` of each scene, version of FMI and kind of simulation."""
    with TemporaryDirectory() as folder:
        for k, (name, (shipped, overrides)) in enumerate(SCENES.items()):
            solver = {"t_end": T_END, "solver.rtol": RTOL, "solver.output_dt": OUTPUT_DT, "controller": None}
            scene = load_scene(shipped, {**overrides, **solver})
            for fmi in ("2.0", "3.0"):
                (fmu,) = write(export(scene, "fmu", fmi=fmi), Path(folder) / f"{k}_{fmi}")
                differences = {kind: _compare(fmusim, fmu, kind, scene) for kind in ("cs", "me")}
                print(f"{name:26} FMI {fmi}  " + "  ".join(f"{kind} {x:.1e}" for kind, x in differences.items()))
    return 0


def _compare(fmusim: Path, fmu: Path, kind: str, scene: Scene) -> float:
    """Return the largest difference of a joint coordinate, relative to the largest value of all of them."""
    ours, results = simulate(scene), fmu.with_suffix(".csv")
    names = ours.mechanism.independent
    options = {
        "--interface-type": kind, "--stop-time": T_END, "--output-interval": OUTPUT_DT, "--output-file": results,
        "--tolerance": RTOL if kind == "cs" else SOLVER_TOLERANCE,
    }  # fmt: skip
    command = [str(fmusim), *(str(x) for option in options.items() for x in option)]
    if kind == "me":
        command += ["--solver", "cvode"]
    command += [x for name in names for x in ("--output-variable", name)]
    subprocess.run([*command, str(fmu)], check=True)
    with results.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    t = np.array([float(row["time"]) for row in rows])
    last = np.append(np.diff(t) > 0, True)  # of the rows of an event
    expected = np.array([ours[name] for name in names])
    actual = np.array([[float(row[name]) for row in rows] for name in names])
    place = [int(np.flatnonzero(last)[np.abs(t[last] - instant).argmin()]) for instant in ours.t]
    return float(np.abs(actual[:, place] - expected).max() / np.abs(expected).max())
