"""Exact derivatives of eq. 1: those by Pinocchio's terms against those that CasADi takes of the terms written out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ckc_pin import Mechanism, load, load_scene
from ckc_pin.codegen.acceleration import ConstrainedInertia
from ckc_pin.codegen.arguments import numbers, present, values
from ckc_pin.codegen.expressions import expressions
from ckc_pin.codegen.library import compiled
from ckc_pin.dynamics import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.linear_model import linear_model
from ckc_pin.mechanism.library import shipped
from ckc_pin.native.plant import Plant
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.parts import scene_mechanism
from scripts.experiments.fuzz.mechanisms import random_mechanism

EQUAL = 1e-11  # relative
LONG = {"talos"}  # its derivatives are not written out
FREE = 18  # of random mechanisms: a free root on a damped spring


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
    plant = Plant(mechanism)
    for _ in range(3):
        at = sigma(mechanism, mechanism.independent_part(mechanism.q_tree) + random.uniform(-0.1, 0.1, mechanism.d)).at
        v, forces = at.rho @ random.uniform(-1, 1, mechanism.d), random.uniform(-1, 1, n)
        ours = plant.at(Terms(mechanism, at, v), forces)
        state, a_u = (np.array(x) for x in theirs(at.q_tree, v, forces, values(given, present(given))))
        steps = np.array([tree.configuration_rate(at.q_tree, unit) for unit in np.eye(n)]).T
        a_q, a_v = state[tree.nq :, : tree.nq] @ steps, state[tree.nq :, tree.nq :]
        assert np.abs(ours.T - at.rho).max() <= EQUAL
        close((ours.a_q @ at.rho + ours.a_v @ ours.V), a_q @ at.rho + a_v @ ours.V, np.abs(a_q).max())
        close(ours.a_v @ at.rho, a_v @ at.rho, np.abs(a_v).max())
        close(ours.a_u, a_u, np.abs(a_u).max())


@pytest.mark.parametrize("name", ["five_bar", "bricard", "andrews", "flyball", "free root"])
def test_linear_models_by_compiled_terms_are_those_by_pinocchios(name: str, tmp_path: Path) -> None:
    """Outputs included, friction smoothed; and where a joint is locked, if that leaves a freedom."""
    mechanism = load(str(random_mechanism(FREE).write(tmp_path))) if name == "free root" else load(name)
    library, random = compiled(mechanism), np.random.default_rng(0)
    cases = [np.zeros(0, np.intp), mechanism.partition.q[:1]] if mechanism.d > 1 else [np.zeros(0, np.intp)]
    for locked in cases:
        state = somewhere(mechanism, locked, random)
        u_tree, tau = random.uniform(-1, 1, mechanism.n), random.uniform(-1, 1, len(mechanism.actuated))
        ours, theirs = (
            linear_model(state, tau, at="there", u_tree=u_tree, locked=locked, smoothing=0.1, library=x)
            for x in (library, None)
        )
        assert ours.states == theirs.states
        assert len(ours.A) == 2 * (mechanism.d - len(locked))
        for matrix in "ABCD":
            one, other = getattr(ours, matrix), getattr(theirs, matrix)
            close(one, other, 10 * max(1.0, np.abs(other).max(initial=0.0)))


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_what_baumgarte_adds_is_there_where_nothing_has_drifted(speed: float) -> None:
    """The right-hand side is eq. 1's there, but not how it changes."""
    overrides = {"formulation": "dae", "solver.baumgarte": [5.0, 0.0], "solver.projection": False}
    scene = load_scene("five_bar/swing", {**overrides, "solver.terms": "pinocchio"})
    found = []
    for library in (compiled(scene_mechanism(scene)), None):
        ready = prepare(scene, library=library)
        ready.begin()
        y = ready.loop.y.copy()
        y[ready.mechanism.n :] = speed
        found.append(ready.loop.jacobian(0.0, y))
    assert np.abs(found[1][4:, 4:]).max() > 1.0  # 2 alpha, of what the rows' rates are
    close(found[0], found[1], np.abs(found[1]).max())


def somewhere(mechanism: Mechanism, locked: np.ndarray, random: np.random.Generator) -> Terms:
    """A motion on the closure, off rest, which leaves locked coordinates alone."""
    n = mechanism.n
    rows = np.vstack([mechanism.assembled.J, np.eye(n)[locked]])
    v = random.uniform(-1, 1, n)
    return Terms(mechanism, mechanism.assembled, v - np.linalg.pinv(rows, rcond=1e-9) @ (rows @ v))


def close(ours: np.ndarray, theirs: np.ndarray, size: float) -> None:
    assert np.abs(ours - theirs).max(initial=0.0) <= EQUAL * size
