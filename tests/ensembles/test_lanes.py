"""Members that are computed together in vector registers have the digits that they have alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin.base.arrays import Array
from ckc_pin.ensembles.members import DONE, FAILED, STOPPED, Chunk, Members
from ckc_pin.ensembles.spec import OutputSpec

MEMBERS = 21  # two rounds of eight and a rest
HANGING = {"initial.q.theta_1": -1.434, "initial.q.theta_3": -1.707}
# scene, overrides, variables with their ranges
CASES: dict[str, tuple[str, dict[str, Any], dict[str, tuple[float, float]]]] = {
    "starts": ("five_bar/swing", {}, {"initial.q.theta_1": (-1.9, -0.9), "initial.q_dot.theta_3": (-1, 1)}),
    "coarse": ("five_bar/swing", {"solver.rtol": 1e-2}, {"initial.q.theta_1": (-1.9, -0.9)}),
    "exact": ("five_bar/swing", {"solver.rtol": 1e-12, "t_end": 0.3}, {"initial.q.theta_1": (-1.9, -0.9)}),
    "RK45": ("five_bar/swing", {"solver.method": "RK45"}, {"initial.q.theta_1": (-1.9, -0.9)}),
    "numbers": ("five_bar/swing", {}, {"link.link_2.mass": (0.1, 0.5), "joint.theta_4.xyz.x": (0.24, 0.28),
                                       "gravity.y": (-10, -5)}),
    "torques": ("andrews", {"t_end": 0.01}, {"link.K3.mass": (0.02, 0.03)}),
    "events": ("five_bar/swing",
               {"event": [{"coordinate": "theta_1", "value": -1.2, "stop": True},
                          {"coordinate": "theta_2", "value": 0.1}]}, {"initial.q.theta_3": (-1.3, -1.0)}),
    "feedback": ("five_bar/set_point", {"formulation": "dae", "solver.method": "DOP853", "initial.at": None, **HANGING},
                 {"initial.q.theta_1": (-1.5, -1.3)}),
    "many steps": ("four_bar", {"t_end": 4.0}, {"initial.q_dot.crank": (3, 8)}),
    "many turns": ("four_bar", {}, {"initial.q.crank": (627.0, 629.0)}),
    "damping": ("five_bar/swing", {}, {"joint.theta_2.damping": (0.0, 0.1)}),
    "slider": ("slider_crank",
               {"formulation": "dae", "prescribed": None, "force": None, "work": None, "initial.at": None},
               {"initial.q_dot.crank": (0, 20)}),
    "crossings": ("n_four_bar", {"mechanism.N": 1, "t_end": 1.5}, {"initial.q_dot.theta_0": (-1.2, -0.8)}),
    "without projection": ("five_bar/swing", {"solver.projection": False}, {"initial.q.theta_1": (-1.9, -0.9)}),
}  # fmt: skip

# Whose ends of steps are computed together: one planar loop, no events, no controller, projection.
WITH_ENDS = ("starts", "coarse", "exact", "RK45", "numbers", "many steps", "many turns", "damping", "slider")

# Cases in which some members do not start, or stop before their end.
IRREGULAR: dict[str, tuple[str, dict[str, Any], dict[str, tuple[float, float]]]] = {
    "not assembled": ("five_bar/swing", {}, {"initial.q.theta_1": (-1.9, 3.0)}),
    "out of budget": ("five_bar/swing", {"solver.max_rhs": 700}, {"initial.q.theta_1": (-1.9, -0.9)}),
}


def prepare(case: str, *, lanes: bool = True) -> tuple[Members, Array]:
    """Return the members of a case, and the values of their variables."""
    scene, of_case, ranges = (CASES | IRREGULAR)[case]
    overrides = {"t_end": 1.0, "solver.rtol": 1e-7, "solver.terms": "generated", **of_case}
    outputs = {"end": "q_tree", "rate": "v_tree", "path": OutputSpec(of="q_tree", reduce="max_abs")}
    low, high = np.array(list(ranges.values())).T
    values = np.random.default_rng(3).uniform(low, high, (MEMBERS, len(ranges)))
    return Members(scene, overrides, tuple(ranges), outputs, MEMBERS, 1, lanes=lanes), values


def run(case: str, *, lanes: bool) -> tuple[Chunk, int]:
    """Run the members of a case; return their results, and how many a thread computes together."""
    members, values = prepare(case, lanes=lanes)
    result = members.run(0, values)
    assert members.is_batched
    return result, members._batch.lanes


def require_equal_digits(case: str) -> Chunk:
    """Run the members of a case together and alone, compare all results, and return them."""
    (together, lanes), (alone, one) = run(case, lanes=True), run(case, lanes=False)
    assert (lanes, one) == (8, 1)
    assert together.status.tolist() == alone.status.tolist()
    assert together.rhs == alone.rhs
    for name, x in alone.outputs.items():
        assert np.ptp(x[alone.status == DONE], axis=0).max() > 1e-6
        assert np.array_equal(together.outputs[name], x, equal_nan=True), name
    return together


@pytest.mark.parametrize("case", CASES)
def test_digits_are_those_of_members_computed_alone(case: str) -> None:
    assert require_equal_digits(case).status.tolist() == [DONE] * MEMBERS


@pytest.mark.parametrize("case", CASES)
def test_ends_of_steps_are_computed_together_where_nothing_else_happens_there(case: str) -> None:
    members, values = prepare(case)
    members.run(0, values)
    stats = [ckc_pin.simulate(members.scene_of(x)).stats for x in values]
    steps = sum(x["steps"] + x["rejected"] for x in stats)
    if case in WITH_ENDS:
        assert 0.9 * steps < members._batch.end_count <= 1.01 * steps
    elif case != "crossings":
        assert members._batch.end_count == 0


@pytest.mark.parametrize(("case", "status"), [("not assembled", FAILED), ("out of budget", STOPPED)])
def test_members_next_to_irregular_ones_keep_their_digits(case: str, status: int) -> None:
    chunk = require_equal_digits(case)
    assert set(chunk.status.tolist()) == {DONE, status}


@pytest.mark.parametrize("case", ["starts", "coarse", "exact", "numbers", "torques", "many steps"])
def test_cases_contain_rejected_and_projected_steps(case: str) -> None:
    members, values = prepare(case)
    stats = [ckc_pin.simulate(members.scene_of(x)).stats for x in values[:5]]
    assert sum(x["rejected"] for x in stats) > 0
    assert sum(x["newton"] for x in stats) > 0
