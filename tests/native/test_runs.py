"""Runs in the native core and in Python: the same motion, the same ending, the same account of the work."""

import numpy as np
import pytest

from ckc_pin import InputError, simulate
from ckc_pin.control.controllers import SetPoint
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.scene import load_scene
from ckc_pin.simulation.systems import Native

RTOL = 1e-8
TRACKING = {"solver.method": "DOP853", "solver.spf_equation": 17}
OFF = {"initial.w": [0.01, -0.02], "epsilon": 1e-2}

RUNS = [
    ("five_bar/swing", {"t_end": 1.0}),
    ("five_bar/swing", {"formulation": "reduced", "t_end": 1.0}),
    ("five_bar/swing", {"formulation": "spf", **OFF, **TRACKING, "t_end": 0.3}),
    ("five_bar/swing", {"formulation": "spf", **OFF, **TRACKING, "coriolis_velocity": "actual", "t_end": 0.3}),
    ("five_bar/swing", {"formulation": "spf", **OFF, "solver.method": "DOP853", "t_end": 0.3}),
    ("five_bar/swing", {"solver.projection": False, "solver.baumgarte": [20.0, 20.0], "t_end": 0.5}),
    ("five_bar/tracking", {**TRACKING, "t_end": 0.3}),
    ("five_bar/tracking", {**TRACKING, "t_end": 0.1, "controller.torque_limit": 0.3}),
    ("five_bar/tracking", {"t_end": 0.3}),
    ("five_bar/set_point", {"t_end": 0.3}),
    ("five_bar/set_point", {"formulation": "reduced", "solver.method": "DOP853", "t_end": 0.5}),
    ("five_bar/set_point", {"formulation": "dae", "solver.method": "DOP853", "t_end": 0.2}),
    ("five_bar/set_point", {"controller.sample_time": 0.01, "controller.delay": 0.004, "t_end": 0.2}),
    ("andrews/default", {"formulation": "reduced", "t_end": 0.01}),
    ("bricard/default", {}),
    ("delta/default", {"t_end": 0.2}),
    ("delta/default", {"formulation": "reduced", "t_end": 0.1}),
    ("delta/default", {"solver.projection": False, "solver.baumgarte": [20.0, 20.0], "t_end": 0.1}),
    ("delta/circle", {"t_end": 0.1}),
    ("delta/circle", {**TRACKING, "t_end": 0.1}),
    ("delta/default", {**TRACKING, "formulation": "spf", "initial.w": 18 * [1e-3], "epsilon": 1e-2, "t_end": 0.1}),
    ("four_bar/turning", {"t_end": 0.5}),
    ("n_four_bar/default", {"t_end": 0.3}),
    ("three_rrr/default", {}),
    ("three_rrr/circle", {**TRACKING, "t_end": 0.2}),
    ("two_ur5/default", {"t_end": 0.2}),
    ("two_ur5/lift", {**TRACKING, "t_end": 0.1}),
    ("stewart/default", {"t_end": 0.05}),
    ("stewart/wave", {"t_end": 0.05}),
    ("talos/default", {"t_end": 0.02}),
]


def _both(scene, changes):
    return [simulate(scene, {**changes, "solver.rtol": RTOL, "solver.backend": b}) for b in ("python", "native")]


@pytest.mark.parametrize(("scene", "changes"), RUNS)
def test_runs_are_the_same(scene, changes):
    python, native = _both(scene, changes)
    assert (python.stats["backend"], native.stats["backend"]) == ("python", "native")
    assert (native.status, native.message) == (python.status, python.message)
    assert np.array_equal(native.t, python.t)
    for name, factor in (("q_tree", 1), ("v_tree", 1), ("phi", 1), ("w", 1), ("energy", 10), ("u", 100), ("tau", 100)):
        gap = np.abs(getattr(native, name) - getattr(python, name))
        size = max(1.0, np.abs(getattr(python, name)).max(initial=0.0))
        assert gap[-1].max(initial=0.0) <= factor * 10 * RTOL * size, name
        assert gap.max(initial=0.0) <= factor * 100 * RTOL * size, name  # on the way: both are as far from the truth
    if python.lyapunov is not None:
        assert np.abs(native.lyapunov - python.lyapunov).max() <= 1e2 * RTOL * max(1.0, python.lyapunov.max())
    for count in ("steps", "rhs"):
        assert native.stats[count] == pytest.approx(python.stats[count], rel=0.1, abs=16)
    assert native.max_phi <= max(2 * python.max_phi, 1e-12)


def test_what_python_alone_knows_acts_natively_too():
    """A controller of the caller's own, called once for each right-hand side, at the same states."""
    scene = load_scene("five_bar/set_point", {"formulation": "reduced", "solver.method": "DOP853", "t_end": 0.2})

    class Own:
        def __init__(self, inner):
            self.inner, self.calls = inner, 0

        def u(self, t, terms):
            self.calls += 1
            return self.inner.u(t, terms)

    inner = prepare(scene).plant.controller
    assert isinstance(inner, SetPoint)
    own = Own(inner)
    theirs, mine = simulate(scene), simulate(scene, controller=own)
    assert mine.stats["backend"] == "native"
    assert np.abs(mine.q_tree - theirs.q_tree).max() < 10 * RTOL
    assert own.calls >= mine.stats["rhs"]


def test_a_budget_ends_a_native_run_as_it_ends_pythons():
    for key, value in (("solver.max_rhs", 200), ("solver.min_step", 0.01)):
        python, native = _both("five_bar/swing", {key: value, "formulation": "reduced"})
        assert native.status == python.status == "stopped"
        assert native.message.partition(": ")[2] == python.message.partition(": ")[2]
        assert native.t[-1] == pytest.approx(python.t[-1], rel=0.05)
        assert native.stats["rhs"] == python.stats["rhs"]


def test_a_change_of_the_partition_is_pythons_and_the_run_goes_on():
    thrown = {"formulation": "reduced", "t_end": 0.5, "initial.q_dot": {"theta_1": 9.0, "theta_3": -9.0}}
    python, native = _both("five_bar/swing", thrown)
    assert native.stats["switches"] == python.stats["switches"] > 0
    assert np.abs(native.q_tree[-1] - python.q_tree[-1]).max() < 10 * RTOL * np.abs(python.q_tree).max()


def test_corners_of_a_limited_torque_are_passed_alike():
    """What is refused at a corner is chance, the motion is not."""
    python, native = _both("five_bar/tracking", {**TRACKING, "t_end": 0.3, "controller.torque_limit": 3.0})
    assert np.abs(native.q_tree - python.q_tree).max() <= 100 * RTOL
    assert np.abs(native.u).max() == np.abs(python.u).max() == 3.0


def test_a_better_partition_is_not_looked_for_at_every_step_where_there_is_none(monkeypatch):
    """A delta's phi_z is never as far from singular as |J| would have it, and no other split is much better."""
    looks, best = [], Mechanism.best_partition
    monkeypatch.setattr(Mechanism, "best_partition", lambda self, at: looks.append(at) or best(self, at))
    for backend in ("python", "native"):
        run = simulate("delta/default", {"formulation": "reduced", "t_end": 1.0, "solver.backend": backend})
        assert run.stats["steps"] > 50
        assert 0 < len(looks) < run.stats["steps"] / 5
        looks.clear()


@pytest.mark.parametrize(
    ("name", "changes"),
    [("five_bar/swing", {"formulation": "reduced"}), ("delta/default", {"t_end": 1.0}), ("stewart/wave", TRACKING)],
)
def test_plain_steps_are_taken_without_python(name, changes):
    """All but the first evaluation and those by which SciPy chooses its first step."""
    scene = load_scene(name, changes)
    system = prepare(scene).system
    assert isinstance(system, Native)
    assert system.crosses
    calls, rhs = [], type(system).rhs
    try:
        type(system).rhs = lambda self, t, y: calls.append(t) or rhs(self, t, y)
        run = simulate(scene)
    finally:
        type(system).rhs = rhs
    assert run.stats["rhs"] > 1000
    assert len(calls) == 3


@pytest.mark.parametrize("scene", ["five_bar/tracking", "five_bar/set_point", "three_rrr/circle"])
def test_the_jacobian_is_pythons(scene):
    system = prepare(load_scene(scene, {"solver.backend": "native"})).system
    y = system.start() + 0.01 * np.random.default_rng(0).standard_normal(2 * system.mechanism.d)
    wanted = system.jacobian(0.1, y, system.rhs)
    assert np.abs(system.native.jacobian(0.1, y) - wanted).max() <= 1e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("formulation", ["reduced", "dae", "spf"])
def test_states_that_are_none_are_refused(formulation):
    changes = {"formulation": formulation, "solver.backend": "native", "solver.method": "DOP853"}
    system = prepare(load_scene("five_bar/swing", changes)).system
    y = system.start()
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="y: a number is not finite"):
            system.native.rhs(0.0, np.append(y[:-1], bad))
    with pytest.raises(ValueError, match=f"y: {len(y)} numbers are needed, got {len(y) - 1}"):
        system.native.rhs(0.0, y[:-1])
    assert system.native.rhs(0.0, 1e300 * np.ones(len(y))) is None


def test_native_by_name_says_why_it_cannot_be_had(monkeypatch):
    monkeypatch.setattr("ckc_pin.simulation.backend.unavailable", lambda: "the native core was not built")
    with pytest.raises(InputError, match=r'backend = "native" cannot be had: the native core was not built'):
        simulate("five_bar/swing", {"solver.backend": "native"})
    assert simulate("five_bar/swing", {"t_end": 0.01}).stats["backend"] == "python"


def _dae(scene, backend):
    return prepare(load_scene(scene, {"formulation": "dae", "solver.backend": backend})).system


@pytest.mark.parametrize("flat", [0.3, 1e-2, 1e-3])
def test_rates_on_the_closure_are_pythons_near_a_flat_position(flat):
    """All rods at one angle, about J's least singular value, by which what is off is divided twice."""
    python, native = (_dae("n_four_bar", backend) for backend in ("python", "native"))
    random, n, turned = np.random.default_rng(0), python.mechanism.n, python.start()
    states = np.concatenate([np.tile(turned[:n] * (flat / turned[0]), (50, 1)), np.tile(turned[n:], (50, 1))], axis=1)
    states += 0.03 * flat * random.standard_normal(states.shape)
    _are_the_same(python, native, states, 1e-13 / flat**2)


def test_rates_on_the_closure_are_pythons():
    python, native = (_dae("five_bar/swing", backend) for backend in ("python", "native"))
    states = python.start() + 0.1 * np.random.default_rng(0).standard_normal((50, 8))
    _are_the_same(python, native, states, 1e-12)


@pytest.mark.parametrize("name", ["delta/default", "stewart/default", "two_ur5/default"])
def test_a_free_roots_rates_are_pythons_whatever_its_quaternion_has_become(name):
    python, native = (_dae(name, backend) for backend in ("python", "native"))
    tree, random = python.mechanism.tree, np.random.default_rng(1)
    for _ in range(50):
        q_tree = tree.integrate(python.initial.q_tree, 0.3 * random.standard_normal(tree.n))
        for q_at, _v_at in tree.free:
            q_tree[q_at + 3 : q_at + 7] *= -1.0 if random.random() < 0.5 else 1.001  # both are read as unit ones
        y = np.concatenate([q_tree, random.standard_normal(tree.n)])
        wanted, found = python.rhs(0.0, y), native.rhs(0.0, y)
        assert np.abs(found - wanted)[: tree.nq].max() <= 1e-14 * np.abs(wanted[: tree.nq]).max()
        assert np.abs(found - wanted).max() <= 1e-11 * np.abs(wanted).max()


@pytest.mark.parametrize("name", ["five_bar/swing", "andrews", "three_rrr", "delta/default"])
def test_states_put_on_the_closure_are_pythons(name):
    """Where no row is redundant: off the closure redundant ones contradict each other, and each takes its own part."""
    python, native = (_dae(name, backend) for backend in ("python", "native"))
    for y in python.start() + 1e-3 * np.random.default_rng(0).standard_normal((20, len(python.start()))):
        wanted, found = python.terms(0.0, y), native.terms(0.0, y)
        assert np.abs(found.q_tree - wanted.q_tree).max() <= 1e-12
        assert np.abs(found.v_tree - wanted.v_tree).max() <= 1e-12
    assert native.counts == python.counts
    assert native.native.projected(y) is not None
    with pytest.raises(ValueError, match="y: a number is not finite"):
        native.native.projected(np.full(len(y), np.nan))


def _are_the_same(python, native, states, tolerance):
    times = np.linspace(0.0, 1.0, len(states))
    wanted, found = python.rates_on_closure(times, states), native.rates_on_closure(times, states)
    assert np.isfinite(wanted).all()
    assert np.abs(found - wanted).max() <= tolerance * np.abs(wanted).max()
    assert native.counts.factorizations == python.counts.factorizations


def test_states_that_cannot_be_put_on_the_closure_have_no_rate_and_those_that_are_none_are_refused():
    python, native = (_dae("five_bar/swing", backend) for backend in ("python", "native"))
    states = np.array([python.start(), python.start()])
    states[1, :4] = 0.0  # stretched, all at one angle: J has lost rank
    times = np.zeros(2)
    for system in (python, native):
        assert np.isfinite(system.rates_on_closure(times, states)).all(axis=1).tolist() == [True, False]
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="states: rows of as many finite numbers as y has"):
            native.native.rates_on_closure(times, states + bad)
    with pytest.raises(ValueError, match="states: rows of as many finite numbers as y has"):
        native.native.rates_on_closure(times, states[:, 1:])
    with pytest.raises(ValueError, match="times: 2 numbers are needed, got 1"):
        native.native.rates_on_closure(times[1:], states)
