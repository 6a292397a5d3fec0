"""The uncontrolled swing: three formulations agree with each other and with an independent integration."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest

from ckc_pin import Run
from tests.conftest import REFERENCES, assert_close
from tests.regression.reference import FORMULATIONS, trajectory

pytestmark = pytest.mark.usefixtures("either_terms")

readings = pytest.mark.parametrize("file", ["swing", "swing_as_printed"])
formulations = pytest.mark.parametrize("formulation", FORMULATIONS)


@readings
@formulations
def test_swing_matches_the_independent_integration(run: Callable[..., Run], file: str, formulation: str) -> None:
    reference = trajectory(file)
    ours = run(reference.name, formulation=formulation, solver__rtol=1e-10)
    rows = reference.rows(ours)
    assert_close(ours.q_tree[rows], reference.q_tree, 1e-9)
    assert_close(ours.v_tree[rows], reference.v_tree, 1e-8)
    assert_close(ours.energy[rows], reference.energy, 1e-9)


@readings
def test_formulations_agree_pairwise(run: Callable[..., Run], file: str) -> None:
    name = trajectory(file).name
    runs = [run(name, formulation=formulation, solver__rtol=1e-10) for formulation in FORMULATIONS]
    for a, b in combinations(runs, 2):
        assert a.t[-1] == b.t[-1] == 2.0
        assert_close(a.q_tree[-1], b.q_tree[-1], 1e-8)
        assert_close(a.v_tree[-1], b.v_tree[-1], 1e-8)


def test_swing_at_two_seconds_matches_the_notes(run: Callable[..., Run]) -> None:
    ours = run("five_bar/swing", formulation="dae", solver__rtol=1e-10)
    assert_close(ours.q_tree[-1, [0, 2]], [-1.0561629, -1.2552036], 5.1e-8)


@readings
@formulations
def test_energy_is_conserved(run: Callable[..., Run], file: str, formulation: str) -> None:
    ours = run(trajectory(file).name, formulation=formulation, solver__rtol=1e-10)
    assert_close(ours.energy, ours.energy[0], 1e-9)
    assert not np.any(ours.u)


@readings
@formulations
def test_loops_are_closed_at_every_output(run: Callable[..., Run], file: str, formulation: str) -> None:
    """Checked with phi and J of the NumPy five-bar."""
    reference = trajectory(file)
    ours, model = run(reference.name, formulation=formulation, solver__rtol=1e-10), REFERENCES[reference.mechanism]
    assert_close([model.phi(q) for q in ours.q_tree], 0, 1e-12)
    assert_close([model.J(q) @ v for q, v in zip(ours.q_tree, ours.v_tree, strict=True)], 0, 1e-12)
    assert ours.max_phi <= 1e-12
    assert_close(ours.max_phi, np.abs(ours.phi).max(), 0)


@readings
@formulations
def test_loop_forces_are_the_multipliers(run: Callable[..., Run], file: str, formulation: str) -> None:
    """The multipliers by loop name are the force on the left tip in every formulation."""
    reference = trajectory(file)
    ours = run(reference.name, formulation=formulation, solver__rtol=1e-10)
    forces = ours.loop_forces()
    assert list(forces) == ["elbow"]
    assert_close(forces["elbow"][reference.rows(ours)], reference.multipliers, 1e-7)
