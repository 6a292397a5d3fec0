"""Constraint rows in NumPy, in C++ and as CasADi expressions agree for every type of row at random states."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import Terms, symbolic
from ckc_pin.mechanism import rows
from ckc_pin.mechanism.spec import LoopType
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table
from tests.property.mechanisms import RowsIn, closed_mechanism
from tests.property.strategies import TYPES

STATES = 5
TOLERANCE = 1e-12  # relative to 1 + the largest entry
ROW_TYPES = {rows.Component, rows.Curved, rows.Dot, rows.Distance, rows.Affine, rows.RelativeLog}
# Loops whose rows are resolved in the world's axes have components along directions that do not turn.
CASES: list[tuple[LoopType, RowsIn, bool]] = [
    *((kind, "a", False) for kind in TYPES), ("point", "world", False), ("weld", "world", False),
    ("point_2d", "a", True),
]  # fmt: skip


def row_types(kind: LoopType, rows_in: RowsIn, nonlinear: bool) -> set[type]:
    """Return the types of a random mechanism's rows: a loop's and those of couplings."""
    mechanism = closed_mechanism(kind, 1, rows_in=rows_in, nonlinear=nonlinear).mechanism
    return {type(group) for group in mechanism.closure.groups}


def test_the_cases_have_all_types_of_rows() -> None:
    assert {x.__name__ for x in ROW_TYPES} == {name for name in rows.__all__ if name[0].isupper()} - {"Rows"}
    assert set.union(*(row_types(*case) for case in CASES)) == ROW_TYPES


@pytest.mark.parametrize(("kind", "rows_in", "nonlinear"), CASES)
def test_three_implementations_agree(kind: LoopType, rows_in: RowsIn, nonlinear: bool) -> None:
    """phi, J and J_dot v near the manifold and far from it, with a free root."""
    mechanism = closed_mechanism(kind, 1, rows_in=rows_in, nonlinear=nonlinear).mechanism
    core, functions, random = _core.Core(core_table(mechanism)), symbolic(mechanism), np.random.default_rng(2)
    for spread in np.geomspace(1e-3, 1.0, STATES):
        q = mechanism.tree.integrate(mechanism.q_tree, spread * random.uniform(-1, 1, mechanism.n))
        v = random.uniform(-2, 2, mechanism.n)
        reference = Terms(mechanism, mechanism.kinematics(q), v)
        native = core.terms(q, v)
        expressions = {
            "phi": functions.phi(q, functions.values),
            "J": functions.J(q, functions.values),
            "J_dot_v": functions.J_dot_v(q, v, functions.values),
        }
        for name, expected in (
            ("phi", reference.phi),
            ("J", reference.at.J),
            ("J_dot_v", reference.J_dot @ v),
        ):
            scale = 1 + np.abs(expected).max()
            assert np.abs(native[name] - expected).max() <= TOLERANCE * scale, name
            assert np.abs(expressions[name].full().reshape(expected.shape) - expected).max() <= TOLERANCE * scale, name
