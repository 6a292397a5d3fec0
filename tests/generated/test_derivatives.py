"""Exact derivatives of eq. 1: the reference's against those that CasADi takes of the terms written out."""

from __future__ import annotations

import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.dynamics import Terms
from ckc_pin.dynamics.derivatives import acceleration_derivatives
from ckc_pin.generated.acceleration import ConstrainedInertia
from ckc_pin.generated.arguments import numbers, present, values
from ckc_pin.generated.expressions import expressions
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.library import shipped

EQUAL = 1e-11  # relative
LONG = {"talos"}  # its derivatives are not written out


@pytest.mark.parametrize("name", [x for x in shipped() if x not in LONG])
def test_they_are_those_of_the_terms_written_out(name: str) -> None:
    """Along what the loops allow: redundant rows contradict each other elsewhere."""
    import casadi as cs

    mechanism, random = load(name), np.random.default_rng(0)
    tree, n, terms = mechanism.tree, mechanism.n, expressions(mechanism)
    u, given = cs.SX.sym("u", n), numbers(mechanism)
    by_state, by_u = ConstrainedInertia(terms).derivatives(u)
    symbols = [terms.angles.q, terms.v, u, terms.arguments.vector]
    theirs = cs.Function("f", symbols, [terms.angles.in_q(by_state), terms.angles.in_q(by_u)])
    for _ in range(3):
        at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.1, 0.1, mechanism.d)).at
        v, forces = at.rho @ random.uniform(-1, 1, mechanism.d), random.uniform(-1, 1, n)
        ours = acceleration_derivatives(Terms(mechanism, at, v), forces)
        state, a_u = (np.array(x) for x in theirs(at.q_tree, v, forces, values(given, present(given))))
        steps = np.array([tree.configuration_rate(at.q_tree, unit) for unit in np.eye(n)]).T
        a_q, a_v = state[tree.nq :, : tree.nq] @ steps, state[tree.nq :, tree.nq :]
        follows = ours.v_q @ at.rho
        close((ours.a_q @ at.rho + ours.a_v @ follows), a_q @ at.rho + a_v @ follows, np.abs(a_q).max())
        close(ours.a_v @ at.rho, a_v @ at.rho, np.abs(a_v).max())
        close(ours.a_u, a_u, np.abs(a_u).max())


def close(ours: np.ndarray, theirs: np.ndarray, size: float) -> None:
    assert np.abs(ours - theirs).max() <= EQUAL * size
