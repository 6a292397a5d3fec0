"""Reference trajectories in `data/`, integrated by NumPy and SciPy, and comparisons of runs with them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ckc_pin import Run
from tests.analytic.five_bar import Array

DATA = Path(__file__).parent / "data"
FORMULATIONS = ("reduced", "spf", "dae")


@dataclass(frozen=True)
class Trajectory:
    """Rows at the instants t. `data/make_trajectories.py` describes their columns."""

    mechanism: str
    scene: str
    t: Array
    q_tree: Array
    v_tree: Array
    u: Array
    multipliers: Array
    energy: Array

    @property
    def name(self) -> str:
        """Of the scene, as shipped."""
        return f"{self.mechanism}/{self.scene}"

    def rows(self, run: Run) -> list[int]:
        """Where a run has the same instants."""
        rows = [run.at(t) for t in self.t]
        np.testing.assert_allclose(run.t[rows], self.t, rtol=0, atol=1e-12)
        return rows


def trajectory(name: str) -> Trajectory:
    """Read a file of `data/`."""
    content = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    arrays = {key: np.array(content[key]) for key in ("t", "q_tree", "v_tree", "u", "energy")}
    return Trajectory(content["mechanism"], content["scene"], multipliers=np.array(content["lambda"]), **arrays)
