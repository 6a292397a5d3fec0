"""Exact derivatives of eq. 1: Pinocchio's terms against CasADi's derivatives of the symbolic terms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Mechanism, load, load_scene
from ckc_pin.codegen.acceleration import ConstrainedInertia
from ckc_pin.codegen.arguments import present, values
from ckc_pin.codegen.expressions import term_expressions
from ckc_pin.codegen.library import compile_terms
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.mechanism.library import shipped
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.native.plant import Plant
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.parts import load_scene_mechanism
from scripts.experiments.fuzz.mechanisms import random_mechanism

TOLERANCE = 1e-11  # relative
LARGE = {"talos"}  # its derivatives take too long to compile
FREE = 18  # seed of a random mechanism with a free root on a damped spring


@pytest.mark.parametrize("name", [x for x in shipped() if x not in LARGE])
def test_derivatives_of_the_native_core_are_those_of_the_symbolic_terms(name: str) -> None:
    """They are compared along motions that the loops allow: elsewhere redundant rows contradict each other."""
    import casadi as cs

    mechanism, random = load(name), np.random.default_rng(0)
    tree, n, terms = mechanism.tree, mechanism.n, term_expressions(mechanism)
    u, mechanism_numbers = cs.SX.sym("u", n), model_numbers(mechanism)
    parameters = values(mechanism_numbers, present(mechanism_numbers))
    jacobians = ConstrainedInertia(terms).derivatives(u)
    symbols = [terms.configuration.q, terms.v, u, terms.arguments.vector]
    theirs = cs.Function("f", symbols, [terms.configuration.as_function_of_q(x) for x in jacobians])
    plant = Plant(mechanism)
    for _ in range(3):
        at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.1, 0.1, mechanism.d)).at
        v, forces = at.rho @ random.uniform(-1, 1, mechanism.d), random.uniform(-1, 1, n)
        ours = plant.at(Terms(mechanism, at, v), forces)
        state, a_u = (np.array(x) for x in theirs(at.q_tree, v, forces, parameters))
        steps = np.array([tree.configuration_rate(at.q_tree, unit) for unit in np.eye(n)]).T
        a_q, a_v = state[tree.nq :, : tree.nq] @ steps, state[tree.nq :, tree.nq :]
        assert np.abs(ours.T - at.rho).max() <= TOLERANCE
        assert_near((ours.a_q @ at.rho + ours.a_v @ ours.V), a_q @ at.rho + a_v @ ours.V, np.abs(a_q).max())
        assert_near(ours.a_v @ at.rho, a_v @ at.rho, np.abs(a_v).max())
        assert_near(ours.a_u, a_u, np.abs(a_u).max())


@pytest.mark.parametrize("name", ["five_bar", "bricard", "andrews", "flyball", "free root"])
def test_linear_models_by_compiled_terms_are_those_by_pinocchios(name: str, tmp_path: Path) -> None:
    """Including outputs and smoothed friction, and with a locked joint if that leaves a freedom."""
    mechanism = load(str(random_mechanism(FREE).write(tmp_path))) if name == "free root" else load(name)
    library, random = compile_terms(mechanism), np.random.default_rng(0)
    cases = [np.zeros(0, np.intp), mechanism.partition.q[:1]] if mechanism.d > 1 else [np.zeros(0, np.intp)]
    for locked in cases:
        state = random_motion(mechanism, locked, random)
        u_tree, tau = random.uniform(-1, 1, mechanism.n), random.uniform(-1, 1, len(mechanism.actuated))
        ours, theirs = (
            linear_model(state, tau, at="there", u_tree=u_tree, locked=locked, smoothing=0.1, library=x)
            for x in (library, None)
        )
        assert ours.states == theirs.states
        assert len(ours.A) == 2 * (mechanism.d - len(locked))
        for matrix in "ABCD":
            expected = getattr(theirs, matrix)
            assert_near(getattr(ours, matrix), expected, 10 * max(1.0, np.abs(expected).max(initial=0.0)))


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_baumgartes_terms_enter_the_jacobian_on_the_manifold(speed: float) -> None:
    """On the manifold the right-hand side is eq. 1's, but its derivative is not."""
    overrides = {"formulation": "dae", "solver.baumgarte": [5.0, 0.0], "solver.projection": False}
    scene = load_scene("five_bar/swing", {**overrides, "solver.terms": "pinocchio"})
    jacobians = []
    for library in (compile_terms(load_scene_mechanism(scene)), None):
        ready = prepare(scene, library=library)
        ready.begin()
        y = ready.loop.y.copy()
        y[ready.mechanism.n :] = speed
        jacobians.append(ready.loop.jacobian(0.0, y))
    assert np.abs(jacobians[1][4:, 4:]).max() > 1.0  # Baumgarte's 2 alpha, times the rates of the rows
    assert_near(jacobians[0], jacobians[1], np.abs(jacobians[1]).max())


def random_motion(mechanism: Mechanism, locked: np.ndarray, random: np.random.Generator) -> Terms:
    """Return terms at a random velocity that keeps the loops closed and locked coordinates at rest."""
    n = mechanism.n
    rows = np.vstack([mechanism.assembled.J, np.eye(n)[locked]])
    v = random.uniform(-1, 1, n)
    return Terms(mechanism, mechanism.assembled, v - np.linalg.pinv(rows, rcond=1e-9) @ (rows @ v))


def assert_near(ours: np.ndarray, theirs: np.ndarray, size: float) -> None:
    assert np.abs(ours - theirs).max(initial=0.0) <= TOLERANCE * size
