"""Native terms and accelerations equal the NumPy reference at random states."""

import numpy as np
import pytest

from ckc_pin.dynamics import Terms, dae_acceleration, reduced_acceleration
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.library import shipped
from ckc_pin.native import _core
from ckc_pin.native.tables import core_table, packed

STATES = 200
SPREAD = 0.3  # rad or m around the assembled configuration, off the constraint manifold
TREE = ("D_tree", "C_tree", "h_tree", "bias_tree")
CLOSURE = ("phi", "rho", "rho_dot", "D", "C", "h")


def _states(mechanism, seed=0):
    """Yield random states and forces: the assembled configuration first, then configurations around it."""
    random = np.random.default_rng(seed)
    for k in range(STATES):
        step = SPREAD * (k > 0) * random.standard_normal(mechanism.n)
        at = mechanism.kinematics(mechanism.tree.integrate(mechanism.q_tree, step))
        yield Terms(mechanism, at, random.standard_normal(mechanism.n)), random.standard_normal(mechanism.n)


def _project(terms):
    """Return a state with closed loops, because redundant rows are consistent only there."""
    mechanism = terms.mechanism
    at = mechanism.kinematics(mechanism.q_tree)
    q = mechanism.independent_part(0.9 * at.q_tree + 0.1 * terms.q_tree)
    computed = sigma(mechanism, q, at)
    assert computed.verdict == "converged"
    return Terms(mechanism, computed.at, terms.v_tree)


def _tolerance(terms):
    """Return the tolerance: rounding times the condition number of phi_z, between 1e-12 and 1e-10."""
    condition = np.linalg.cond(terms.at.phi_z) if terms.at.phi_z.size else 1.0
    return float(np.clip(np.finfo(float).eps / 2 * condition, 1e-12, 1e-10))


def _scales(terms):
    """Return the sizes of the summands of each term before cancellation, which rounding errors are relative to."""
    at = terms.at
    rho = np.abs(at.rho)
    inverse = np.abs(np.linalg.pinv(at.phi_z)) if at.phi_z.size else np.zeros((0, 0))
    rho_dot = np.zeros_like(rho)
    rho_dot[at.partition.z] = inverse @ np.abs(terms.J_dot) @ rho
    scales = {name: np.abs(getattr(terms, name)) for name in (*TREE, "J_dot", "D")}
    scales["phi"] = np.full(at.phi.shape, terms.mechanism.size)
    scales["rho"] = 1 + inverse @ np.abs(at.phi_q) if at.phi_q.size else rho
    scales["rho_dot"] = rho_dot
    scales["h"] = rho.T @ scales["h_tree"]
    scales["C"] = rho.T @ (scales["D_tree"] @ rho_dot + scales["C_tree"] @ rho)
    gravity = np.linalg.norm(terms.mechanism.tree.model.gravity.linear)  # the native code adds and subtracts it
    scales["J_dot_v"] = np.abs(terms.J_dot) @ np.abs(terms.v_tree) + gravity
    return {name: float(np.max(size, initial=1e-300)) for name, size in scales.items()}


@pytest.mark.parametrize("name", shipped())
def test_terms_equal_numpy(name):
    mechanism = load(name)
    core = _core.Core(core_table(mechanism))
    for terms, _ in _states(mechanism):
        computed, scales, tolerance = core.terms(terms.q_tree, terms.v_tree), _scales(terms), _tolerance(terms)
        expected = {quantity: getattr(terms, quantity) for quantity in (*TREE, *CLOSURE, "J_dot")}
        expected["J_dot_v"] = terms.J_dot @ terms.v_tree
        for quantity, value in expected.items():
            assert np.abs(computed[quantity] - value).max(initial=0.0) <= tolerance * scales[quantity], quantity
        assert np.abs(computed["J"] - terms.at.J).max(initial=0.0) <= tolerance * np.abs(terms.at.J).max(initial=1.0)
        J = core.jacobian(terms.q_tree)
        assert np.abs(J - terms.at.J).max(initial=0.0) <= tolerance * np.abs(terms.at.J).max(initial=1.0)


@pytest.mark.parametrize("name", shipped())
def test_accelerations_equal_numpy(name):
    mechanism = load(name)
    core = _core.Core(core_table(mechanism))
    for terms, u_tree in _states(mechanism, seed=1):
        q_tree, v_tree = terms.q_tree, terms.v_tree
        q_dot, tolerance = terms.q_dot, _tolerance(terms)
        tangent = Terms(mechanism, terms.at, terms.at.rho @ q_dot)
        force = float(np.abs(terms.rho.T).max() * (np.abs(u_tree) + np.abs(tangent.bias_tree)).max())
        moving = np.abs(tangent.rho_dot @ q_dot).max() * np.abs(terms.D_tree).max() * np.abs(terms.rho).max()
        size = np.abs(np.linalg.inv(terms.D)).max() * (force + moving) * mechanism.n
        computed = core.reduced_acceleration(q_tree, q_dot, tangent.v_tree, u_tree, False)
        assert np.abs(computed - reduced_acceleration(tangent, u_tree)).max() <= tolerance * size
        computed = core.reduced_acceleration(q_tree, q_dot, v_tree, u_tree, True)
        assert np.abs(computed - reduced_acceleration(terms, u_tree, q_dot)).max() <= tolerance * size
        terms = _project(terms) if mechanism.closure.rows > mechanism.rank else terms
        correction = terms.at.J @ u_tree - terms.J_dot @ terms.v_tree
        expected = dae_acceleration(terms, u_tree, correction)
        computed = core.dae_acceleration(terms.q_tree, terms.v_tree, u_tree, correction)
        assert np.abs(computed - expected).max() <= max(tolerance, 1e-11) * np.abs(expected).max()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_invalid_numbers_are_rejected(bad):
    mechanism = load("five_bar")
    core = _core.Core(core_table(mechanism))
    arguments = {"q_tree": mechanism.q_tree, "v_tree": np.zeros(4), "u_tree": np.zeros(4), "correction": np.zeros(2)}
    for name, value in arguments.items():
        invalid = value.copy()
        invalid[-1] = bad
        with pytest.raises(ValueError, match=f"{name}: a number is not finite"):
            core.dae_acceleration(**{**arguments, name: invalid})
        with pytest.raises(ValueError, match=f"{name}: {len(value)} numbers are needed, got {len(value) + 1}"):
            core.dae_acceleration(**{**arguments, name: np.append(value, 0.0)})
    with pytest.raises(ValueError, match="q_tree: a number is not finite"):
        core.jacobian(np.append(mechanism.q_tree[1:], bad))
    with pytest.raises(ValueError, match="q_tree: 4 numbers are needed, got 3"):
        core.jacobian(mechanism.q_tree[1:])


@pytest.mark.parametrize(
    ("q", "z", "says"),
    [([0, 2], [1, 4], "4 is none of 0 to 3"), ([0, 2], [1, 2], "named twice"), ([0, 2], [1], "is missing"),
     ([-1, 2], [1, 3], "-1 is none of"), ([2], [0, 1, 3], "more dependent coordinates than rows")],
)  # fmt: skip
def test_invalid_partitions_are_rejected(q, z, says):
    core = _core.Core(core_table(load("five_bar")))
    with pytest.raises(ValueError, match=says):
        core.set_partition(q, z)


@pytest.mark.parametrize("name", ["delta", "three_rrr", "stewart"])
def test_inertia_is_as_exact_far_from_the_origin(name):
    """Placements have rounding errors of 1e-12 m there, sums of moments about the origin errors of 1e-8 kg m^2."""
    mechanism = load(name)
    table = core_table(mechanism)
    model = mechanism.tree.model.copy()
    for joint, parent in enumerate(model.parents):
        if joint and not parent:
            model.jointPlacements[joint].translation += np.array([1e4, -2e4, 1e4])
    far = _core.Core({**table, "model": packed(model)})
    expected = Terms(mechanism, mechanism.kinematics(mechanism.q_tree), np.zeros(mechanism.n)).D_tree
    computed = far.terms(mechanism.q_tree, np.zeros(mechanism.n))["D_tree"]
    assert np.abs(computed - expected).max() <= 1e-10 * np.abs(expected).max()
