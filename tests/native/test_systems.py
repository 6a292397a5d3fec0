"""The native right-hand sides, Jacobians and closures against the NumPy reference at random states."""

import numpy as np
import pytest

from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import list_catalogue, load_scene
from tests.native.loops import both, started

FORMULATIONS = [{"formulation": "dae"}, {"formulation": "reduced"}, {"formulation": "spf"}]


def _joints(scene):
    return load_scene_mechanism(load_scene(scene)).joints


EVERY = [f"{name}/{scene}" for name, _, scenes in list_catalogue() for scene in scenes]
SCENES = [scene for scene in EVERY if not _joints(scene).has_events(0.1)]  # a stop is no function of t and y
OFF = {"formulation": "spf", "initial.w": [0.01, -0.02], "epsilon": 1e-2}
SPREAD = 0.02  # rad or m, and their rates, around the start


def _are_the_same(scene, overrides, spread=SPREAD, tolerance=1e-10):
    ready, ivp = both(scene, {**overrides, "solver.rtol": 1e-10})  # z closed as well as the reference closes it
    random = np.random.default_rng(0)
    for k in range(20):
        t, y = 0.01 * k, ivp.y0 + spread * random.standard_normal(len(ivp.y0)) * (k > 0)
        wanted, found = ivp.f(t, y), ready.loop.rhs(t, y)
        assert np.isfinite(wanted).all()
        assert np.abs(found - wanted).max() <= tolerance * max(1.0, np.abs(wanted).max())


@pytest.mark.parametrize("overrides", FORMULATIONS, ids=lambda overrides: overrides["formulation"])
@pytest.mark.parametrize("scene", SCENES)
def test_right_hand_sides_are_those_of_numpy(scene, overrides):
    if _joints(scene).friction.any():  # joints that stick are no function of t and y
        overrides = {**overrides, "friction_smoothing": 0.1}
    if overrides["formulation"] == "dae" and scene.split("/")[0] in ("bricard", "talos"):
        # off the closure redundant rows contradict each other, and either takes its own part of them
        _are_the_same(scene, overrides, spread=0.0)
    else:
        _are_the_same(scene, overrides, tolerance=1e-8)


@pytest.mark.parametrize("convention", ["rho", "actual"])
@pytest.mark.parametrize("coordinates", ["w", "z"])
@pytest.mark.parametrize("scene", ["five_bar/swing", "five_bar/tracking", "five_bar/set_point"])
def test_off_the_manifold_too(scene, coordinates, convention):
    _are_the_same(scene, {**OFF, "spf_coordinates": coordinates, "coriolis_velocity": convention}, tolerance=1e-9)


@pytest.mark.parametrize("limit", [0.3, {"theta_1": 1.0}])
def test_limits_of_torque_act(limit):
    _are_the_same("five_bar/tracking", {"controller.torque_limit": limit}, tolerance=1e-9)


@pytest.mark.parametrize("name", ["delta/default", "stewart/default", "two_ur5/default"])
def test_a_free_roots_rates_whatever_its_quaternion_has_become(name):
    ready, ivp = both(name, {"formulation": "dae"})
    tree, random = ivp.mechanism.tree, np.random.default_rng(1)
    for _ in range(50):
        q_tree = tree.integrate(ready.start.at.q_tree, 0.3 * random.standard_normal(tree.n))
        for q_at, _v_at in tree.free_roots:
            q_tree[q_at + 3 : q_at + 7] *= -1.0 if random.random() < 0.5 else 1.001  # both are read as unit ones
        y = np.concatenate([q_tree, random.standard_normal(tree.n)])
        wanted, found = ivp.f(0.0, y), ready.loop.rhs(0.0, y)
        assert np.abs(found - wanted)[: tree.nq].max() <= 1e-14 * np.abs(wanted[: tree.nq]).max()
        assert np.abs(found - wanted).max() <= 1e-11 * np.abs(wanted).max()


@pytest.mark.parametrize(
    ("scene", "overrides"),
    [("five_bar/tracking", {"formulation": "dae"}), ("five_bar/tracking", {}), ("three_rrr/circle", {}),
     ("five_bar/swing", {**OFF, "spf_coordinates": "z"}), ("stewart/wave", {"formulation": "dae"})],
)  # fmt: skip
def test_jacobians_are_those_of_the_reference(scene, overrides):
    """Against central differences of the NumPy right-hand side."""
    ready, ivp = both(scene, overrides)
    y, h = ivp.y0 + 0.01 * np.random.default_rng(0).standard_normal(len(ivp.y0)), 1e-6
    found = ready.loop.jacobian(0.1, y)
    wanted = np.transpose([(ivp.f(0.1, y + step) - ivp.f(0.1, y - step)) / (2 * h) for step in h * np.eye(len(y))])
    assert np.abs(found - wanted).max() <= 1e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("formulation", ["reduced", "spf"])
def test_a_coarse_tolerance_leaves_no_noise_in_jacobians(formulation):
    """What the loops may be open at a tolerance is far more than a difference moves them."""
    ready, ivp = both("five_bar/tracking", {"formulation": formulation, "solver.rtol": 1e-2})
    random, h = np.random.default_rng(0), 1e-6
    for k in range(8):
        t, y = 0.1 * k, ivp.y0 + 0.1 * random.standard_normal(len(ivp.y0))
        ready.loop.rhs(t, y + 1e-3 * random.standard_normal(len(y)))  # from where z is predicted
        found = ready.loop.jacobian(t, y)
        wanted = np.transpose([(ivp.f(t, y + step) - ivp.f(t, y - step)) / (2 * h) for step in h * np.eye(len(y))])
        assert np.abs(found - wanted).max() <= 1e-5 * np.abs(wanted).max()


@pytest.mark.parametrize("scene", ["five_bar/tracking", "stewart/wave"])
def test_the_modes_of_a_dae_are_those_of_the_reduced_model(scene):
    """From rest, where either linearization is that of the freedoms."""
    dae, reduced = (started(scene, {"formulation": formulation}).loop for formulation in ("dae", "reduced"))
    found = np.linalg.eigvals(dae.reduced_jacobian(dae.jacobian(0.0, dae.y)))
    wanted = np.linalg.eigvals(reduced.reduced_jacobian(reduced.jacobian(0.0, reduced.y)))
    found, wanted = (values[np.argsort(-np.abs(values))] for values in (found, wanted))
    fast = np.count_nonzero(np.abs(wanted) > 0.5 * np.abs(wanted[0]))
    assert np.sort(found[:fast].real) == pytest.approx(np.sort(wanted[:fast].real), rel=0.05)


@pytest.mark.parametrize("overrides", FORMULATIONS, ids=lambda overrides: overrides["formulation"])
def test_states_that_are_none_are_refused(overrides):
    loop = started("five_bar/swing", overrides).loop
    y = loop.y
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="y: a number is not finite"):
            loop.rhs(0.0, np.append(y[:-1], bad))
    with pytest.raises(ValueError, match=f"y: {len(y)} numbers are needed, got {len(y) - 1}"):
        loop.rhs(0.0, y[:-1])
    assert loop.rhs(0.0, 1e300 * np.ones(len(y))) is None


# --- a DAE's closure --------------------------------------------------------------------------------


def _closed(mechanism, y, metric):
    """(q', v') put on the closure by the shortest steps in a metric of the coordinates: Newton's method."""
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
def test_states_are_put_on_the_closure_by_the_shortest_steps_in_the_metric_of_the_inertia(name):
    """To second order in what they are off by, the metric being that of where each step begins; no row is redundant."""
    ready, ivp = both(name, {"formulation": "dae"})
    for y in ivp.y0 + 1e-6 * np.random.default_rng(0).standard_normal((20, len(ivp.y0))):
        at, v = _closed(ivp.mechanism, y, _inertia(ivp.mechanism))
        q_tree, velocity = ready.loop.project(0.0, y)
        assert np.abs(q_tree - at.q_tree).max() <= 1e-9
        assert np.abs(velocity - v).max() <= 1e-9 * max(1.0, np.abs(v).max())
        assert np.abs(ivp.mechanism.kinematics(q_tree).phi).max() <= ivp.mechanism.tolerance


def test_next_to_a_loss_of_rank_too():
    """Closed to rounding, and nothing is thrown far along a direction that J hardly determines."""
    ready, ivp = both("n_four_bar", {"mechanism.N": 2})
    mechanism, random = ivp.mechanism, np.random.default_rng(0)
    for flat in (1e-3, 1e-5):
        y = np.concatenate([np.full(mechanism.n, 0.0), random.standard_normal(mechanism.n)])
        y[: mechanism.n] = ready.start.at.q_tree * (flat / ready.start.at.q_tree[0])
        y[: mechanism.n] += 1e-2 * flat * random.standard_normal(mechanism.n)
        q_tree, _ = ready.loop.project(0.0, y)
        assert np.abs(mechanism.kinematics(q_tree).phi).max() <= mechanism.tolerance
        assert np.abs(q_tree - y[: mechanism.n]).max() <= 10 * flat


@pytest.mark.parametrize("flat", [None, 0.3, 1e-2, 1e-3])
def test_rates_on_the_closure(flat):
    """Of states put on it to rounding, also where all rods are at one angle: about J's least singular value."""
    ready, ivp = both("five_bar/swing" if flat is None else "n_four_bar", {"formulation": "dae"})
    mechanism, random, n = ivp.mechanism, np.random.default_rng(0), ivp.mechanism.n
    start, off = ivp.y0.copy(), 0.01 if flat is None else 0.03 * flat
    if flat is not None:
        start[:n] *= flat / start[0]
    for y in start + off * random.standard_normal((20, len(start))):
        at, v = _closed(mechanism, y, lambda q_tree: np.eye(n))
        wanted = dae_acceleration(Terms(mechanism, at, v), np.zeros(n))
        found = ready.loop.rate_on_manifold(0.0, y)
        assert np.abs(found[n:] - wanted).max() <= (1e-11 if flat is None else 1e-12 / flat**2) * np.abs(wanted).max()


def test_what_cannot_be_put_on_the_closure_has_no_rate():
    loop = started("five_bar/swing", {"formulation": "dae"}).loop
    assert loop.rate_on_manifold(0.0, loop.y) is not None
    assert loop.rate_on_manifold(0.0, np.append(np.zeros(4), loop.y[4:])) is None  # stretched: J has lost rank
