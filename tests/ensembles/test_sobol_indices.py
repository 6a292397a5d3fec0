"""Sobol indices of a pendulum's energy, which is linear in gravity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin.ensembles.ensemble import load_sweep_task
from ckc_pin.ensembles.sobol_indices import compute_sobol_indices
from ckc_pin.errors import InputError
from tests.contract.helpers.command import ckc
from tests.contract.test_parameters import folder

FILE = """
scene = "own/default.scene.toml"
[overrides]
initial.at = "assembled"
t_end = 0.001
[variables]
"gravity.x" = {{normal = [0, 1]}}
"gravity.y" = {{normal = [0, 2]}}
"epsilon" = {{{epsilon}}}
[outputs]
energy = "energy"
"""


def write_sweep(at: Path, epsilon: str = "uniform = [0.1, 0.2]") -> Path:
    folder(at / "own")
    path = at / "own.sweep.toml"
    path.write_text(FILE.format(epsilon=epsilon).replace("[overrides]", "members = 2\n[overrides]"))
    return path


def test_energy_at_rest_is_linear_in_gravity(tmp_path: Path) -> None:
    task = load_sweep_task(write_sweep(tmp_path))
    indices = compute_sobol_indices(task, 64, 2)
    # E = c - sum of m g . p, so the shares have the ratio (p_x 1)^2 : (p_y 2)^2
    members = task.prepare(1)
    energy = members.run(0, np.array([[0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1]])).outputs["energy"]
    parts = np.array([energy[1] - energy[0], 2 * (energy[2] - energy[0]), 0.0]) ** 2
    for order in ("first_order", "total_order"):
        assert np.allclose(indices[order].sel(output="energy"), parts / parts.sum(), atol=0.15)
    assert float(indices["total_order"].sel(output="energy", variable="epsilon")) == pytest.approx(0, abs=1e-9)


def test_the_command_writes_indices_and_a_figure(tmp_path: Path) -> None:
    done = ckc("sweep", str(write_sweep(tmp_path)), "--out", str(tmp_path / "o"), "--indices", "4", "--json")
    assert done.code == 0, done.err
    assert len((tmp_path / "o" / "indices.csv").read_text().splitlines()) == 4
    assert (tmp_path / "o" / "indices_energy.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("epsilon", "count", "says"),
    [("uniform = [0.1, 0.2]", 6, "not a power of 2"), ("list = [0.1]", 4, "not random")],
)
def test_counts_and_variables_without_indices_are_rejected(tmp_path: Path, epsilon: str, count: int, says: str) -> None:
    with pytest.raises(InputError, match=says):
        compute_sobol_indices(load_sweep_task(write_sweep(tmp_path, epsilon)), count, 1)


@pytest.mark.parametrize(
    ("omitted", "count", "says"),
    [
        ('"gravity', "4", "epsilon is the only variable; add at least one more"),
        ("none", "6", "6 is not a power of 2, which Saltelli's design needs"),
    ],
)
def test_indices_are_checked_before_anything_is_run(tmp_path: Path, omitted: str, count: str, says: str) -> None:
    path, out = write_sweep(tmp_path), tmp_path / "o"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith(omitted)))
    done = ckc("sweep", str(path), "--out", str(out), "--indices", count, "--json")
    assert done.code == 2
    assert done.json["message"] == f"indices: {says}"
    assert not out.exists()
