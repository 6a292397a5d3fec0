"""The public CasADi functions, against the reference's terms and CasADi's derivatives."""

from __future__ import annotations

import casadi as cs
import numpy as np
import pytest

import ckc_pin
from ckc_pin import InputError, Terms, load, symbolic
from ckc_pin.dynamics import dae_acceleration
from tests.conftest import assert_close


@pytest.mark.parametrize("name", ["five_bar", "slider_crank_spatial", "flyball", "stewart"])
def test_symbolic_functions_evaluate_to_the_terms(name: str) -> None:
    mechanism, functions, random = load(name), symbolic(name), np.random.default_rng(5)
    n, p = mechanism.n, functions.values
    assert (functions.coordinates, len(functions.parameters)) == (mechanism.coordinates, len(p))
    for _ in range(5):
        q = mechanism.tree.integrate(mechanism.q_tree, 0.2 * random.uniform(-1, 1, n))
        v, u = random.uniform(-2, 2, n), random.uniform(-1, 1, n)
        terms = Terms(mechanism, mechanism.kinematics(q), v)
        D = np.triu(terms.D_tree) + np.triu(terms.D_tree, 1).T
        for ours, theirs in (
            (functions.phi(q, p), terms.phi[:, None]),
            (functions.J(q, p), terms.at.J),
            (functions.J_dot_v(q, v, p), (terms.J_dot @ v)[:, None]),
            (functions.D_tree(q, p), D),
            (functions.bias_tree(q, v, p), terms.bias_tree[:, None]),
            (functions.damping(q, v, p), terms.damping_force[:, None]),
            (functions.kinetic(q, v, p) + functions.potential(q, p), terms.energy),
            (functions.q_dot(q, v), mechanism.tree.configuration_rate(q, v)[:, None]),
            (functions.v_dot(q, v, u, p), dae_acceleration(terms, u)[:, None]),
        ):
            assert_close(np.array(ours), theirs, 1e-10 * max(1.0, float(np.abs(theirs).max(initial=0.0))))


def test_casadi_derivatives_of_symbolic_functions_are_consistent() -> None:
    """J is the Jacobian of phi, and the force of gravity is the gradient of the potential energy."""
    functions = symbolic("five_bar")
    q = cs.SX.sym("q", 4)
    gradient = cs.Function("gradient", [q], [cs.jacobian(functions.phi(q, functions.values), q)])
    at = np.array([-1.2, 0.3, -1.9, -0.4])
    assert_close(np.array(gradient(at)), np.array(functions.J(at, functions.values)), 1e-14)
    h = cs.Function("h", [q], [cs.gradient(functions.potential(q, functions.values), q)])
    assert_close(np.array(h(at)), np.array(functions.bias_tree(at, np.zeros(4), functions.values)), 1e-12)


def test_parameters_are_named_arguments() -> None:
    functions = symbolic("five_bar")
    named = dict(zip(functions.parameters, functions.values, strict=True))
    mechanism = load("five_bar")
    k = mechanism.tree.model.getJointId("theta_2")
    assert named["link.link_2.mass"] == mechanism.tree.model.inertias[k].mass
    assert named["gravity.y"] == -9.81
    light = np.array(functions.values)
    light[[name.endswith(".mass") for name in functions.parameters]] = 0.0
    at = np.array(mechanism.q_tree)
    assert float(functions.potential(at, light)) == 0.0 != float(functions.potential(at, functions.values))


def test_symbolic_without_casadi_names_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "casadi", None)
    with pytest.raises(InputError, match=r"pip install ckc_pin\[symbolic\]"):
        ckc_pin.symbolic("five_bar")
