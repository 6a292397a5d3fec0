"""The native right-hand sides, Jacobians and closures against the NumPy reference at random states."""

import numpy as np
import pytest

from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.scene.names import list_catalogue
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from tests.native.loops import start_loop, start_loop_and_ivp

FORMULATIONS = [{"formulation": "dae"}, {"formulation": "reduced"}, {"formulation": "spf"}]


def _joints(scene):
    return load_scene_mechanism(load_scene(scene)).joints


ALL_SCENES = [f"{name}/{scene}" for name, _, scenes in list_catalogue() for scene in scenes]
SCENES = [
    scene for scene in ALL_SCENES if not _joints(scene).has_events(0.1)
]  # the right-hand side at a stop is not a function of t and y
# integrals that are no part of the motion's state y = (q', v)
WITHOUT_INTEGRALS = {
    "four_bar/servo": {"work": False, "controller.motor.crank.K_I": 0.0},
    "slider_crank/driven": {"work": False},
}
WITHOUT_FREEDOMS = ("slider_crank/driven",)  # y is empty except in the DAE
OFF_MANIFOLD = {"formulation": "spf", "initial.w": [0.01, -0.02], "epsilon": 1e-2}
SPREAD = 0.02  # rad or m, and per second for rates: spread of the states around the start


def _assert_same_rhs(scene, overrides, spread=SPREAD, tolerance=1e-10):
    ready, ivp = start_loop_and_ivp(
        scene, {**overrides, "solver.rtol": 1e-10}
    )  # solves for z as accurately as the reference
    random = np.random.default_rng(0)
    for k in range(20):
        t, y = 0.01 * k, ivp.y0 + spread * random.standard_normal(len(ivp.y0)) * (k > 0)
        expected, computed = ivp.f(t, y), ready.loop.rhs(t, y)
        assert np.isfinite(expected).all()
        assert np.abs(computed - expected).max() <= tolerance * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize(
    ("scene", "overrides"),
    [
        pytest.param(scene, overrides, id=f"{scene}-{overrides['formulation']}")
        for scene in SCENES
        for overrides in FORMULATIONS
        if scene not in WITHOUT_FREEDOMS or overrides["formulation"] == "dae"
    ],
)
def test_right_hand_sides_equal_numpy(scene, overrides):
    overrides = {**overrides, **WITHOUT_INTEGRALS.get(scene, {})}
    if _joints(scene).friction.any():  # the right-hand side of sticking joints is not a function of t and y
        overrides = {**overrides, "friction_smoothing": 0.1}
    if overrides["formulation"] == "dae" and scene.split("/")[0] in ("bricard", "talos"):
        # off the constraint manifold redundant rows contradict each other, and both weight them differently
        _assert_same_rhs(scene, overrides, spread=0.0)
    else:
        _assert_same_rhs(scene, overrides, tolerance=1e-8)


@pytest.mark.parametrize("convention", ["rho", "actual"])
@pytest.mark.parametrize("coordinates", ["w", "z"])
@pytest.mark.parametrize("scene", ["five_bar/swing", "five_bar/tracking", "five_bar/set_point"])
def test_right_hand_sides_off_the_manifold_equal_numpy(scene, coordinates, convention):
    _assert_same_rhs(
        scene, {**OFF_MANIFOLD, "spf_coordinates": coordinates, "coriolis_velocity": convention}, tolerance=1e-9
    )


@pytest.mark.parametrize("limit", [0.3, {"theta_1": 1.0}, [-0.2, 0.6], {"theta_3": [0.0, 0.4]}])
def test_right_hand_sides_at_torque_limits_equal_numpy(limit):
    _assert_same_rhs("five_bar/tracking", {"controller.torque_limit": limit}, tolerance=1e-9)


@pytest.mark.parametrize("name", ["delta/default", "stewart/default", "two_ur5/default"])
def test_right_hand_sides_normalize_quaternions(name):
    ready, ivp = start_loop_and_ivp(name, {"formulation": "dae"})
    tree, random = ivp.mechanism.tree, np.random.default_rng(1)
    for _ in range(50):
        q_tree = tree.integrate(ready.start.at.q_tree, 0.3 * random.standard_normal(tree.n))
        for q_at, _v_at in tree.free_roots:
            q_tree[q_at + 3 : q_at + 7] *= -1.0 if random.random() < 0.5 else 1.001  # both are normalized
        y = np.concatenate([q_tree, random.standard_normal(tree.n)])
        expected, computed = ivp.f(0.0, y), ready.loop.rhs(0.0, y)
        assert np.abs(computed - expected)[: tree.nq].max() <= 1e-14 * np.abs(expected[: tree.nq]).max()
        assert np.abs(computed - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("scene", "overrides"),
    [("five_bar/tracking", {"formulation": "dae"}), ("five_bar/tracking", {}), ("three_rrr/circle", {}),
     ("five_bar/swing", {**OFF_MANIFOLD, "spf_coordinates": "z"}), ("stewart/wave", {"formulation": "dae"})],
)  # fmt: skip
def test_jacobians_equal_differences_of_numpy(scene, overrides):
    """The reference is central differences of the NumPy right-hand side."""
    ready, ivp = start_loop_and_ivp(scene, overrides)
    y, h = ivp.y0 + 0.01 * np.random.default_rng(0).standard_normal(len(ivp.y0)), 1e-6
    computed = ready.loop.jacobian(0.1, y)
    expected = np.transpose([(ivp.f(0.1, y + step) - ivp.f(0.1, y - step)) / (2 * h) for step in h * np.eye(len(y))])
    assert np.abs(computed - expected).max() <= 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("formulation", ["reduced", "spf"])
def test_jacobians_at_a_coarse_tolerance_are_accurate(formulation):
    """The tolerance allows loops to open by far more than a difference step moves them."""
    ready, ivp = start_loop_and_ivp("five_bar/tracking", {"formulation": formulation, "solver.rtol": 1e-2})
    random, h = np.random.default_rng(0), 1e-6
    for k in range(8):
        t, y = 0.1 * k, ivp.y0 + 0.1 * random.standard_normal(len(ivp.y0))
        ready.loop.rhs(t, y + 1e-3 * random.standard_normal(len(y)))  # z is predicted from this state
        computed = ready.loop.jacobian(t, y)
        expected = np.transpose([(ivp.f(t, y + step) - ivp.f(t, y - step)) / (2 * h) for step in h * np.eye(len(y))])
        assert np.abs(computed - expected).max() <= 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("scene", ["five_bar/tracking", "stewart/wave"])
def test_eigenvalues_of_the_dae_equal_those_of_the_reduced_model(scene):
    """At rest both linearizations describe the freedoms."""
    dae, reduced = (start_loop(scene, {"formulation": formulation}).loop for formulation in ("dae", "reduced"))
    computed = np.linalg.eigvals(dae.reduced_jacobian(dae.jacobian(0.0, dae.y)))
    expected = np.linalg.eigvals(reduced.reduced_jacobian(reduced.jacobian(0.0, reduced.y)))
    computed, expected = (values[np.argsort(-np.abs(values))] for values in (computed, expected))
    fast = np.count_nonzero(np.abs(expected) > 0.5 * np.abs(expected[0]))
    assert np.sort(computed[:fast].real) == pytest.approx(np.sort(expected[:fast].real), rel=0.05)


@pytest.mark.parametrize("overrides", FORMULATIONS, ids=lambda overrides: overrides["formulation"])
def test_invalid_states_are_rejected(overrides):
    loop = start_loop("five_bar/swing", overrides).loop
    y = loop.y
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="y: a number is not finite"):
            loop.rhs(0.0, np.append(y[:-1], bad))
    with pytest.raises(ValueError, match=f"y: {len(y)} numbers are needed, got {len(y) - 1}"):
        loop.rhs(0.0, y[:-1])
    assert loop.rhs(0.0, 1e300 * np.ones(len(y))) is None


# --- projection of DAE states --------------------------------------------------------------------------------


def _project(mechanism, y, metric):
    """Project (q', v') onto the constraint manifold by Newton's method with minimum-norm steps in a metric."""
    q_tree, v = y[: mechanism.tree.nq], y[mechanism.tree.nq :]

    def shortest(at, residual):
        inverse = np.linalg.inv(metric(at.q_tree))
        return -inverse @ at.J.T @ np.linalg.lstsq(at.J @ inverse @ at.J.T, residual, rcond=None)[0]

    at = mechanism.kinematics(q_tree)
    for _ in range(20):
        at = at.integrate(shortest(at, at.phi))
    return at, v + shortest(at, at.J @ v)


def _inertia(mechanism):
    return lambda q_tree: Terms(mechanism, mechanism.kinematics(q_tree), np.zeros(mechanism.n)).D_tree


@pytest.mark.parametrize("name", ["five_bar/swing", "andrews", "three_rrr", "delta/default"])
def test_projection_is_minimum_norm_in_the_inertia_metric(name):
    """They agree to second order in the distance, since the metric is evaluated at the start. No row is redundant."""
    ready, ivp = start_loop_and_ivp(name, {"formulation": "dae"})
    for y in ivp.y0 + 1e-6 * np.random.default_rng(0).standard_normal((20, len(ivp.y0))):
        at, v = _project(ivp.mechanism, y, _inertia(ivp.mechanism))
        q_tree, velocity = ready.loop.project(0.0, y)
        assert np.abs(q_tree - at.q_tree).max() <= 1e-9
        assert np.abs(velocity - v).max() <= 1e-9 * max(1.0, np.abs(v).max())
        assert np.abs(ivp.mechanism.kinematics(q_tree).phi).max() <= ivp.mechanism.tolerance


def test_projection_near_a_loss_of_rank_stays_close():
    """Loops are closed to rounding, and no coordinate moves far in the direction of a small singular value of J."""
    ready, ivp = start_loop_and_ivp("n_four_bar", {"mechanism.N": 2})
    mechanism, random = ivp.mechanism, np.random.default_rng(0)
    for flat in (1e-3, 1e-5):
        y = np.concatenate([np.full(mechanism.n, 0.0), random.standard_normal(mechanism.n)])
        y[: mechanism.n] = ready.start.at.q_tree * (flat / ready.start.at.q_tree[0])
        y[: mechanism.n] += 1e-2 * flat * random.standard_normal(mechanism.n)
        q_tree, _ = ready.loop.project(0.0, y)
        assert np.abs(mechanism.kinematics(q_tree).phi).max() <= mechanism.tolerance
        assert np.abs(q_tree - y[: mechanism.n]).max() <= 10 * flat


@pytest.mark.parametrize("flat", [None, 0.3, 1e-2, 1e-3])
def test_rates_on_the_manifold_equal_numpy(flat):
    """States are projected to rounding. Flat rods make the smallest singular value of J small."""
    ready, ivp = start_loop_and_ivp("five_bar/swing" if flat is None else "n_four_bar", {"formulation": "dae"})
    mechanism, random, n = ivp.mechanism, np.random.default_rng(0), ivp.mechanism.n
    start, off = ivp.y0.copy(), 0.01 if flat is None else 0.03 * flat
    if flat is not None:
        start[:n] *= flat / start[0]
    for y in start + off * random.standard_normal((20, len(start))):
        at, v = _project(mechanism, y, lambda q_tree: np.eye(n))
        expected = dae_acceleration(Terms(mechanism, at, v), np.zeros(n))
        computed = ready.loop.rate_on_manifold(0.0, y)
        assert (
            np.abs(computed[n:] - expected).max()
            <= (1e-11 if flat is None else 1e-12 / flat**2) * np.abs(expected).max()
        )


def test_states_that_cannot_be_projected_have_no_rate():
    loop = start_loop("five_bar/swing", {"formulation": "dae"}).loop
    assert loop.rate_on_manifold(0.0, loop.y) is not None
    assert loop.rate_on_manifold(0.0, np.append(np.zeros(4), loop.y[4:])) is None  # stretched: J has lost rank
