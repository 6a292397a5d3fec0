"""Members whose stages are computed together in vector registers have the digits that they have alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from ckc_pin.codegen.library import Library, compile_terms
from ckc_pin.ensembles import members as members_module
from ckc_pin.ensembles.members import DONE, Chunk, Members
from ckc_pin.ensembles.spec import OutputSpec
from ckc_pin.mechanism.mechanism import Mechanism

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
}  # fmt: skip


def run(case: str) -> tuple[Chunk, int]:
    """Run the members of a case; return their results, and how many a thread computes together."""
    scene, of_case, ranges = CASES[case]
    overrides = {"t_end": 1.0, "solver.rtol": 1e-7, "solver.terms": "generated", **of_case}
    outputs = {"end": "q_tree", "rate": "v_tree", "path": OutputSpec(of="q_tree", reduce="max_abs")}
    members = Members(scene, overrides, tuple(ranges), outputs, MEMBERS, 1)
    low, high = np.array(list(ranges.values())).T
    result = members.run(0, np.random.default_rng(3).uniform(low, high, (MEMBERS, len(ranges))))
    assert members.is_batched
    return result, members._batch.lanes


@contextmanager
def computed_alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compile terms without accelerations of several members."""

    def without_members(mechanism: Mechanism, which: Any, *, of_members: bool) -> Library:
        assert of_members
        return compile_terms(mechanism, which)

    with monkeypatch.context() as patch:
        patch.setattr(members_module, "compile_terms", without_members)
        yield


@pytest.mark.parametrize("case", CASES)
def test_digits_are_those_of_members_computed_alone(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    together, lanes = run(case)
    with computed_alone(monkeypatch):
        alone, one = run(case)
    assert (lanes, one) == (8, 1)
    assert together.status.tolist() == alone.status.tolist() == [DONE] * MEMBERS
    assert together.rhs == alone.rhs
    for name, x in alone.outputs.items():
        assert np.ptp(x, axis=0).max() > 1e-6
        assert np.array_equal(together.outputs[name], x), name
