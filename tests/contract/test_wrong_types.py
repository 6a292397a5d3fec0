"""Arguments of wrong types: public functions name the argument and the expected type in one sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Event, InputError, Run, Sampled, SetPoint, Simulator, Terms, Tracking, load, load_scene, simulate

MASS = "link.link_2.mass"
SWING, SHORT_RUN = "five_bar/swing", {"t_end": 0.01}
Q = {"theta_1": -1.2, "theta_3": -1.9}


class CustomController:
    def u(self, t: float, terms: Terms) -> Any:
        return -terms.q_dot


class OfOne:
    def u(self, t: float) -> Any:
        return t


def law(t: float, terms: Terms) -> Any:
    return -terms.q_dot


def trajectory(t: float) -> tuple[Any, Any, Any]:
    return np.zeros(2), np.zeros(2), np.zeros(2)


def run() -> Run:
    return simulate(SWING, SHORT_RUN)


def of(controller: Any) -> Callable[[], Any]:
    return lambda: simulate(SWING, SHORT_RUN, controller=controller)


def five_bar() -> ckc_pin.Mechanism:
    return load("five_bar")


def with_attributes(subject: Any, **attributes: Any) -> Any:
    for name, value in attributes.items():
        setattr(subject, name, value)
    return subject


def own_with(**attributes: Any) -> CustomController:
    controller: CustomController = with_attributes(CustomController(), **attributes)
    return controller


def set_point() -> SetPoint:
    return SetPoint(five_bar(), 10.0, 5.0, Q)


CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "simulate a mechanism": (lambda: simulate(five_bar()), "a Mechanism has no end time; give t_end, as simulate"),
    "step a mechanism": (
        lambda: ckc_pin.Simulator(five_bar()),
        r"got a Mechanism, .*Scene\(mechanism, t_end=1.0\).*five_bar/default, five_bar/friction, five_bar/set",
    ),
    "simulate a number": (lambda: simulate(3), "simulate: scene: expected a scene.*, got 3"),
    "simulate a run": (lambda: simulate(run()), "simulate: scene: expected .*, got a Run"),
    "overrides as a string": (lambda: simulate(SWING, "t_end=1"), "simulate: overrides: expected .*, got 't_end=1'"),
    "overrides by number": (lambda: simulate(SWING, {3: 4}), "overrides, a key: expected a table.*, got 3"),
    "progress of nothing": (
        lambda: simulate(SWING, SHORT_RUN, progress=lambda: None),
        r"simulate: progress: expected a function of \(t, t_end\).*, got a function of other arguments",
    ),
    "a trajectory of nothing": (
        lambda: Tracking(1.0, 1.0, lambda: 0),
        "Tracking: desired: expected a function of t that returns q_d.*, got a function of other arguments",
    ),
    "a word for a state": (
        lambda: ckc_pin.as_ivp(SWING).f(0.0, "rest"),
        "as_ivp: y: expected 8 numbers, as y0 has.*, got 'rest'",
    ),
    "words for a state": (
        lambda: ckc_pin.as_ivp(SWING, {"formulation": "dae"}).f(0.0, ["a"] * 8),
        "as_ivp: y: expected 8 numbers.*, got a list",
    ),
    "a state that is too short": (
        lambda: ckc_pin.as_ivp(SWING, {"formulation": "spf", "spf_coordinates": "z"}).velocity(0.0, [1.0, 2.0]),
        r"as_ivp: y: expected 6 numbers.*, got shape \(2,\)",
    ),
    "a word for a time": (
        lambda: ckc_pin.as_ivp(SWING).terms("now", np.zeros(8)),
        "as_ivp: t: expected a number, s.*, got 'now'",
    ),
    "a class as a controller": (of(CustomController), r"expected an object, got the class CustomController"),
    "a function of one": (of(lambda t: t), r"controller: expected a function of \(t, terms\), got <lambda>\(t\)"),
    "a method of one": (of(OfOne()), r"controller: expected a function of \(t, terms\), got u\(t\)"),
    "a forgotten return": (of(lambda t, terms: None), r"u: expected 2 numbers .*, got None; is a return missing"),
    "a string as a controller": (of("pd"), r"controller: expected an object with one of the methods.*, got 'pd'"),
    "an object as a controller": (of(object()), r"controller: expected .*or a function u\(t, terms\).*, got an object"),
    "a class that is sampled": (lambda: Sampled(CustomController, 0.1), "expected .*, got the class CustomController"),
    "a number as lyapunov": (
        of(own_with(lyapunov=3)), r"^controller: lyapunov: expected a function of \(t, terms, w\).*, got 3"
    ),
    "lyapunov of one": (
        of(own_with(lyapunov=lambda t: t)),
        r"^controller: lyapunov: expected a function of \(t, terms, w\).*, got a function of other arguments",
    ),
    "a class as lyapunov": (of(own_with(lyapunov=dict)), "^controller: lyapunov: expected a.*, got the class dict"),
    "lyapunov that is sampled": (lambda: Sampled(own_with(lyapunov="V"), 0.1), "lyapunov: expected .*got 'V'"),
    "a word from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: "V")), "^controller: lyapunov at t = 0 gave 'V'; a number is needed$"
    ),
    "nothing from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: None)), "^controller: lyapunov at t = 0 gave None; a number is needed$"
    ),
    "an array from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: np.zeros(1))), r"lyapunov at t = 0 gave array\(\[0.\]\); a number is"
    ),
    "a class as u": (of(own_with(u=dict)), r"^controller: u: expected a function of \(t, .*, got the class dict"),
    "a gain that was replaced": (
        of(with_attributes(set_point(), K_P=20.0)), r"^SetPoint: K_P: expected an array of shape \(2, .*, got 20.0"
    ),
    "a target that was replaced": (
        of(with_attributes(set_point(), target=None)), "^SetPoint: target: expected Terms.*, got None"
    ),
    "a q_d that was replaced": (
        of(with_attributes(set_point(), q_d=Q)), r"^SetPoint: q_d: expected an array of shape \(2,\).*, got a dict"
    ),
    "a trajectory that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), desired=3)), "^Tracking: desired: expected a f.*, got 3"
    ),
    "a matrix that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), Lambda=np.eye(3))), "^Tracking: Lambda: .*got a ndarray"
    ),
    "a model that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), model="five_bar")), "^Tracking: model: .*got 'five_bar'"
    ),
    "a sensor": (
        lambda: Sampled(CustomController(), 0.1, sensor=3),
        r"Sampled: sensor: expected .*\[controller.sensor\].*, got 3"),
    "one event": (lambda: simulate(SWING, SHORT_RUN, events=Event(law)), "events: expected a list of.*, got an Event"),
    "progress": (lambda: simulate(SWING, SHORT_RUN, progress=True), r"progress: expected .* \(t, t_end\).*, got True"),
    "on_output": (lambda: simulate(SWING, SHORT_RUN, on_output=3), r"on_output: expected .* \(t, q_tree\).*, got 3"),
    "profile": (lambda: simulate(SWING, SHORT_RUN, profile="no"), "profile: expected True or False.*, got 'no'"),
    "load": (lambda: load(None), "load: name: expected a mechanism's shipped name or its path.*, got None"),
    "load with words": (lambda: load("five_bar", {MASS: "x"}), "load: overrides: link.link_2.mass = 'x': expected"),
    "load with a flag": (lambda: load("five_bar", {MASS: True}), "load: overrides: link.link_2.mass = True: expected"),
    "load with no number": (lambda: load("five_bar", {MASS: np.nan}), "load: overrides: link.link_2.mass = nan: expe"),
    "load beyond numbers": (lambda: load("five_bar", {MASS: 10**400}), "load: overrides: link.link_2.mass = 1000"),
    "load half a vector": (lambda: load("five_bar", {"gravity": [0, 0]}), "gravity: expected 3 numbers, got 2"),
    "load a number": (lambda: load("five_bar", 3), "load: overrides: expected a table of numbers by name.*, got 3"),
    "load by number": (lambda: load("five_bar", {3: 1.0}), "load: overrides, a key: expected .*, got 3"),
    "torques in words": (lambda: Simulator(SWING).step(None, 0.01, tau={"theta_1": "0.5"}), "tau: expected a table of"),
    "torques as flags": (lambda: Simulator(SWING).step(None, 0.01, tau={"theta_1": True}), "tau: expected a table of"),
    "load a scene by name": (lambda: load(SWING), "'five_bar/swing' is a scene; its mechanism is 'five_bar'"),
    "load_scene": (lambda: load_scene(five_bar()), "load_scene: name: expected .*, got a Mechanism"),
    "check": (lambda: ckc_pin.check(run()), "check: what: expected a mechanism or a scene.*, got a Run"),
    "terms of a scene": (lambda: ckc_pin.terms(load_scene(SWING), Q), "terms: mechanism: expected .*, got a Scene"),
    "terms at an array": (lambda: ckc_pin.terms("five_bar", np.zeros(3)), "terms: q: got 3 values; expected 2, in the"),
    "terms at a scalar": (lambda: ckc_pin.terms("five_bar", np.array(3.0)), "or an array, got a ndarray"),
    "terms at a matrix": (lambda: ckc_pin.terms("five_bar", np.eye(2)), "theta_1 = .1.0, 0.0.: expected a number"),
    "terms at a number": (lambda: ckc_pin.terms("five_bar", 3.0), "q: expected a table by coo.*, or an array, got 3.0"),
    "terms at a word": (lambda: ckc_pin.terms("five_bar", {**Q, "theta_1": "a"}), "theta_1 = 'a': expected a number"),
    "play nothing": (ckc_pin.play, "play: no run given"),
    "play a path": (lambda: ckc_pin.play("runs/a"), "play: runs: expected runs.*, got 'runs/a'"),
    "play fast": (lambda: ckc_pin.play(run(), speed="fast"), "play: speed = 'fast'; it must be a number above zero"),
    "play at a port": (lambda: ckc_pin.play(run(), port="http"), "play: port: expected a port.*, got 'http'"),
    "plot a path": (lambda: ckc_pin.plot("runs/a"), "plot: runs: expected runs.*, got 'runs/a'"),
    "map": (lambda: ckc_pin.singularity_map(3), "singularity_map: mechanism: expected .*, got 3"),
    "cells": (lambda: ckc_pin.singularity_map("five_bar", cells="many"), "cells: expected a number.*, got 'many'"),
    "over": (lambda: ckc_pin.singularity_map("five_bar", over="theta_1"), r"expected .*\['theta_1'\].*, got 'theta_1'"),
    "a map's scene": (lambda: ckc_pin.singularity_map("five_bar", scene=3), "singularity_map: scene: expected .*got 3"),
    "symbolic": (lambda: ckc_pin.symbolic(3), "symbolic: mechanism: expected .*, got 3"),
    "as_ivp": (lambda: ckc_pin.as_ivp(five_bar()), "as_ivp: expected a scene.*got a Mechanism"),
    "inverse dynamics": (lambda: ckc_pin.inverse_dynamics(3), "inverse_dynamics: scene: expected .*, got 3"),
    "linearize": (lambda: ckc_pin.linearize(3), "linearize: what: expected a mechanism or a scene.*, got 3"),
    "linearize with words": (lambda: ckc_pin.linearize(SWING, 0.1, "t_end=1"), "linearize: overrides: expected .*"),
    "a period of words": (lambda: ckc_pin.floquet(SWING, "1 s"), "floquet: period: expected .* of seconds.*got '1 s'"),
    "floquet of a run": (lambda: ckc_pin.floquet(run(), 1.0), "floquet: scene: expected a scene.*, got a Run"),
    "no list of names": (lambda: ckc_pin.sensitivities(SWING, 5), r"sensitivities: parameters: expected .*link.link_2"),
    "names by number": (lambda: ckc_pin.sensitivities(SWING, [5]), "sensitivities: parameters: expected .*, got 5"),
    "ensemble": (lambda: ckc_pin.ensemble(five_bar(), {}, {}), "ensemble: scene: expected .*, got a Mechanism"),
    "a variable": (lambda: ckc_pin.ensemble(SWING, "t_end", {}), "ensemble: variables: expected a table.*got 't_end'"),
    "an output": (lambda: ckc_pin.ensemble(SWING, {}, ["u"]), "ensemble: outputs: expected a table by.*got a list"),
    "threads": (lambda: ckc_pin.ensemble(SWING, {}, {}, threads=0.5), "threads: expected a whole number.*, got 0.5"),
    "no chunk": (lambda: ckc_pin.ensemble(SWING, {}, {}, chunk=0), "ensemble: chunk: expected .* at least 1.*, got 0"),
    "Simulator": (lambda: Simulator(SWING, 3), "Simulator: overrides: expected .*, got 3"),
    "Point": (lambda: ckc_pin.Point("five_bar", "tip"), "Point: mechanism: expected a Mechanism.*, got 'five_bar'"),
    "Run.load": (lambda: Run.load(3), "Run.load: path: expected .*, got 3"),
    "Run.save": (lambda: run().save(3), "Run.save: path: expected .*, got 3"),
    "Run.at": (lambda: run().at("x"), "Run.at: expected a time, s.*, got 'x'"),
    "a target too short": (lambda: SetPoint(five_bar(), 1.0, 1.0, [0.1]), "q_d has 1 numbers; 2 are needed: theta_1"),
    "a target of words": (lambda: SetPoint(five_bar(), 1.0, 1.0, ["a", "b"]), "q_d: theta_1 = 'a': expected a number"),
    "a gain of words": (lambda: SetPoint(five_bar(), "ten", 1.0, Q), "K_P: expected a number.*, got 'ten'"),
    "a gain of another size": (lambda: Tracking(np.eye(3), 1.0, trajectory), "Lambda: expected .*, got a 3 x 3 matrix"),
    "no trajectory": (lambda: Tracking(1.0, 1.0, Q), "desired: expected a function of t.*, got a dict"),
    "a trajectory of one": (lambda: Tracking(1.0, 1.0, lambda t: np.zeros(2)), r"desired\(0\): expected .*got array"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_wrong_argument_is_named_with_the_expected_type(name: str) -> None:
    call, says = CALLS[name]
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert re.search(says, message), message
    assert "\n" not in message
    assert len(message) < 400


def test_numpy_numbers_and_lists_are_accepted() -> None:
    expected = load("five_bar", {MASS: 0.3, "gravity": (0.0, -5.0, 0.0)}).tree.model
    for mass, gravity in ((np.float64(0.3), np.array([0, -5.0, 0])), (np.array(0.3), [0, -5, 0])):
        result = load("five_bar", {MASS: mass, "gravity": gravity}).tree.model
        assert result == expected
    pair = np.array([-1.5, -1.0])
    taken = ckc_pin.ensemble(
        SWING, {"initial.q.theta_1": {"uniform": pair}}, {"e": "energy"}, members=np.int64(2), seed=np.int32(3),
        overrides={"t_end": np.float64(0.01), "solver.terms": "pinocchio"}, progress=False,
    )  # fmt: skip
    assert taken.sizes["member"] == 2
    assert (np.abs(taken["initial.q.theta_1"] + 1.25) <= 0.25).all()


def test_function_and_object_controllers_give_the_same_run() -> None:
    """A function, a lambda and a callable object, also sampled, give bit for bit the same motion."""

    class Called:
        def __call__(self, t: float, terms: Terms) -> Any:
            return law(t, terms)

    overrides = {"t_end": 0.3, "formulation": "reduced"}
    expected = simulate(SWING, overrides, controller=CustomController())
    for function in (law, lambda t, terms: -terms.q_dot, Called()):
        result = simulate(SWING, overrides, controller=function)
        assert np.array_equal(result.q_tree, expected.q_tree)
        assert np.array_equal(result.u, expected.u)
    sampled = [simulate(SWING, overrides, controller=Sampled(function, 0.01)) for function in (CustomController(), law)]
    assert np.array_equal(sampled[0].q_tree, sampled[1].q_tree)
    assert np.abs(sampled[0].u[-1]).max() > 1e-3


def test_controllers_accept_gains_like_scenes() -> None:
    mechanism = five_bar()
    by_number = SetPoint(mechanism, 10.0, 1, Q)
    by_name = SetPoint(mechanism, {"theta_1": 10.0, "theta_3": 10.0}, [[1, 0], [0, 1]], [-1.2, -1.9])
    terms = ckc_pin.terms("five_bar", {"theta_1": -1.0, "theta_3": -1.7}, {"theta_1": 0.4})
    assert np.array_equal(by_number.u(0.0, terms), by_name.u(0.0, terms))
    assert np.array_equal(
        Tracking(1.0, 10.0, trajectory).u(0.0, terms), Tracking(np.eye(2), 10 * np.eye(2), trajectory).u(0.0, terms)
    )


def test_runs_of_two_mechanisms_are_not_drawn_together() -> None:
    runs = [simulate(name, SHORT_RUN) for name in (SWING, "four_bar")]
    for pair in (runs, runs[::-1]):
        with pytest.raises(InputError, match="other coordinates; play runs of different mechanisms one by one"):
            ckc_pin.play(*pair)
