"""Controllers and event functions of the caller: arguments, number of calls, and exceptions."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from ckc_pin import Event, Simulator, Terms, load_scene, simulate
from ckc_pin.run.prepare import prepare
from ckc_pin.run.simulate import run_prepared

pytestmark = pytest.mark.usefixtures("either_terms")

SCENES = [
    ("five_bar/set_point", {"formulation": "reduced", "t_end": 0.2}),
    ("five_bar/set_point", {"formulation": "dae", "t_end": 0.2}),
    ("five_bar/set_point", {"initial.w": [0.01, -0.01], "coriolis_velocity": "actual", "t_end": 0.2}),
    ("five_bar/set_point", {"initial.w": [0.01, -0.01], "spf_coordinates": "z", "t_end": 0.05}),
    ("delta/circle", {"formulation": "reduced", "t_end": 0.05}),
    # Implicit steps would know the derivatives of the scene's controller, but not those of a caller's.
    ("stewart/wave", {"formulation": "dae", "t_end": 0.1, "solver.method": "DOP853"}),
]
# all terms that a controller can use
NAMES = ("D_tree", "C_tree", "h_tree", "bias_tree", "phi", "J_dot", "rho", "rho_dot", "D", "C", "h", "energy",
         "potential_energy", "q", "q_dot")  # fmt: skip


class CustomController:
    """The scene's controller, wrapped by a caller that checks its arguments."""

    def __init__(self, inner: Any) -> None:
        self.inner, self.calls, self.kept = inner, 0, []

    def u(self, t: float, terms: Terms) -> Any:
        self.calls += 1
        if self.calls % 100 == 1:
            self.kept.append((terms, {name: np.copy(getattr(terms, name)) for name in NAMES}))
        return self.inner.u(t, terms)


@pytest.mark.parametrize(("scene", "overrides"), SCENES, ids=str)
def test_controller_is_called_once_per_evaluation_with_its_terms(scene, overrides):
    loaded = load_scene(scene, overrides)
    custom = CustomController(prepare(loaded).controller)
    theirs, mine = simulate(loaded), simulate(loaded, controller=custom)
    assert np.abs(mine.q_tree - theirs.q_tree).max() <= 1e-7
    assert theirs.stats["python_calls"] == 0
    outputs = len(mine.t)
    calls = custom.calls - 3  # before the run, to see that it has no memory
    assert mine.stats["python_calls"] == calls
    assert mine.stats["rhs"] <= calls <= mine.stats["rhs"] + outputs + 1
    assert mine.stats["rhs"] == pytest.approx(theirs.stats["rhs"], rel=0.1)
    assert len(custom.kept) > 1
    for terms, terms_seen in custom.kept:
        reference = Terms(mine.mechanism, terms.at, terms.v_tree)
        for name, value in terms_seen.items():
            expected = np.asarray(getattr(reference, name))
            assert np.abs(value - expected).max(initial=0.0) <= 1e-11 * max(1.0, np.abs(expected).max(initial=0.0)), (
                name
            )


def test_stored_terms_do_not_change():
    scene = load_scene("five_bar/set_point", {"formulation": "reduced", "t_end": 0.2})
    kept: list[Terms] = []
    inner = prepare(scene).controller
    assert inner is not None

    class Keeps:
        def u(self, t: float, terms: Terms) -> Any:
            kept.append(terms)
            return inner.u(t, terms)

    mechanism = simulate(scene, controller=Keeps()).mechanism
    assert len({terms.t for terms in kept}) > 100
    for terms in kept[3::50]:  # no term was used during the call; the first three calls are before the run
        reference = Terms(mechanism, mechanism.kinematics(terms.q_tree), terms.v_tree)
        assert np.array_equal(terms.q, reference.q)
        assert np.abs(terms.C - reference.C).max() <= 1e-12
        assert np.abs(terms.phi).max() <= 1e-9


class Broken(Exception):
    """Nobody else's."""


def test_controllers_exception_is_raised_and_the_loop_restarts():
    scene = load_scene("five_bar/set_point", {"formulation": "reduced", "t_end": 0.1})
    inner = prepare(scene).controller
    assert inner is not None
    raised = Broken("sensor 3")

    class Fails:
        fails = True

        def u(self, t: float, terms: Terms) -> Any:
            if self.fails and t > 0.05:
                raise raised
            return inner.u(t, terms)

    fails = Fails()
    ready = prepare(scene, controller=fails)
    with pytest.raises(Broken, match="sensor 3") as caught:
        run_prepared(ready)
    assert caught.value is raised
    assert any(entry.name == "u" for entry in caught.traceback)
    fails.fails = False
    again = run_prepared(ready)
    assert again.status == "done"
    assert np.array_equal(again.q_tree, simulate(scene, controller=fails).q_tree)


def test_event_functions_exception_is_raised():
    def function(t: float, terms: Terms) -> float:
        raise Broken("at once")

    with pytest.raises(Broken, match="at once"):
        simulate("five_bar/swing", {"t_end": 0.1}, events=[Event(function, name="broken")])


def test_keyboard_interrupt_in_a_controller_ends_the_run():
    class Interrupts:
        def u(self, t: float, terms: Terms) -> Any:
            if t > 0.5:
                raise KeyboardInterrupt
            return -terms.q_dot

    run = simulate("five_bar/swing", {"formulation": "reduced", "t_end": 1.0}, controller=Interrupts())
    assert run.status == "interrupted"
    assert 0.3 < run.t[-1] <= 0.5


def test_event_function_is_called_a_few_times_per_step():
    asked = []

    def function(t: float, terms: Terms) -> float:
        asked.append(t)
        return terms.q[0] - 10.0

    run = simulate("five_bar/swing", {"formulation": "reduced"}, events=[Event(function, name="far")])
    assert run.stats["python_calls"] == len(asked)
    assert len(asked) <= 9 * run.stats["steps"]


@pytest.mark.parametrize("formulation", ["dae", "reduced"])
def test_simulators_in_threads_are_independent(formulation: str):
    """Eight simulators of four mechanisms give bit for bit the results of sequential execution."""

    def walk(number: int) -> Any:
        name = ("five_bar/swing", "delta/default", "four_bar/default", "three_rrr/default")[number % 4]
        simulator = Simulator(name, {"formulation": formulation})
        u = 0.1 * np.random.default_rng(number).standard_normal(simulator.mechanism.d)
        if name == "delta/default" and formulation == "dae":
            u = 0.01 * u
        return np.array([simulator.step(u, 2e-3).q_tree for _ in range(50)])

    alone = [walk(number) for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(walk, range(8)))
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one, other)


def test_controllers_in_threads_get_their_own_terms():
    def run(number: int) -> Any:
        target = -0.5 - 0.05 * number

        class CustomController:
            def u(self, t: float, terms: Terms) -> Any:
                return terms.h + terms.D @ (20.0 * (target - terms.q) - 5.0 * terms.q_dot)

        overrides = {"formulation": "reduced", "t_end": 0.3}
        return simulate("five_bar/set_point", overrides, controller=CustomController()).q_tree

    alone = [run(number) for number in range(4)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(run, range(4)))
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one, other)
