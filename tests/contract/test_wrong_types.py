"""Arguments of the wrong kind: every public function says, in one sentence, what it was given and what it takes."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import Event, InputError, Run, Sampled, SetPoint, Simulator, Terms, Tracking, load, load_scene, simulate

MASS = "link.link_2.mass"
SWING, SHORT = "five_bar/swing", {"t_end": 0.01}
Q = {"theta_1": -1.2, "theta_3": -1.9}


class Own:
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
    return simulate(SWING, SHORT)


def of(controller: Any) -> Callable[[], Any]:
    return lambda: simulate(SWING, SHORT, controller=controller)


def five_bar() -> ckc_pin.Mechanism:
    return load("five_bar")


def with_attributes(given: Any, **attributes: Any) -> Any:
    for name, value in attributes.items():
        setattr(given, name, value)
    return given


def own_with(**attributes: Any) -> Own:
    own: Own = with_attributes(Own(), **attributes)
    return own


def set_point() -> SetPoint:
    return SetPoint(five_bar(), 10.0, 5.0, Q)


CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "simulate a mechanism": (
        lambda: simulate(five_bar()),
        "a Mechanism was given, .*five_bar/default, five_bar/friction, five_bar/set",
    ),
    "simulate a number": (lambda: simulate(3), "simulate: scene: 3 was given; it takes a scene"),
    "simulate a run": (lambda: simulate(run()), "simulate: scene: a Run was given"),
    "overrides as a string": (lambda: simulate(SWING, "t_end=1"), "simulate: overrides: 't_end=1' was given"),
    "overrides by number": (lambda: simulate(SWING, {3: 4}), "overrides, a key: 3 was given; it takes a table"),
    "progress of nothing": (
        lambda: simulate(SWING, SHORT, progress=lambda: None),
        r"simulate: progress: a function of other arguments was given; it takes a function of \(t, t_end\)",
    ),
    "a trajectory of nothing": (
        lambda: Tracking(1.0, 1.0, lambda: 0),
        "Tracking: desired: a function of other arguments was given; it takes a function of t that returns q_d",
    ),
    "a word for a state": (
        lambda: ckc_pin.as_ivp(SWING).f(0.0, "rest"),
        "as_ivp: y: 'rest' was given; it takes 8 numbers, as y0 has",
    ),
    "words for a state": (
        lambda: ckc_pin.as_ivp(SWING, {"formulation": "dae"}).f(0.0, ["a"] * 8),
        "as_ivp: y: a list was given; it takes 8 numbers",
    ),
    "a state that is too short": (
        lambda: ckc_pin.as_ivp(SWING, {"formulation": "spf", "spf_coordinates": "z"}).velocity(0.0, [1.0, 2.0]),
        r"as_ivp: y: shape \(2,\) was given; it takes 6 numbers",
    ),
    "a word for a time": (
        lambda: ckc_pin.as_ivp(SWING).terms("now", np.zeros(8)),
        "as_ivp: t: 'now' was given; it takes a number, s",
    ),
    "a class as a controller": (of(Own), r"the class Own was given; give an object of it, as Own\(\) makes one"),
    "a function of one": (of(lambda t: t), r"controller: <lambda>\(t\) was given; it must take \(t, terms\)"),
    "a method of one": (of(OfOne()), r"controller: u\(t\) was given; it must take \(t, terms\)"),
    "a forgotten return": (of(lambda t, terms: None), "controller's u is None; 2 numbers are .*is a return missing"),
    "a string as a controller": (of("pd"), r"controller: 'pd' was given; it takes an object with one of the methods"),
    "an object as a controller": (of(object()), r"controller: an object was given; .*or a function u\(t, terms\)"),
    "a class that is sampled": (lambda: Sampled(Own, 0.1), "the class Own was given"),
    "a number as lyapunov": (
        of(own_with(lyapunov=3)), r"^controller: lyapunov: 3 was given; it takes a function of \(t, terms, w\)"
    ),
    "lyapunov of one": (
        of(own_with(lyapunov=lambda t: t)),
        r"^controller: lyapunov: a function of other arguments was given; it takes a function of \(t, terms, w\)",
    ),
    "a class as lyapunov": (of(own_with(lyapunov=dict)), "^controller: lyapunov: the class dict was given; it takes a"),
    "lyapunov that is sampled": (lambda: Sampled(own_with(lyapunov="V"), 0.1), "^controller: lyapunov: 'V' was given;"),
    "a word from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: "V")), "^controller: lyapunov at t = 0 gave 'V'; a number is needed$"
    ),
    "nothing from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: None)), "^controller: lyapunov at t = 0 gave None; a number is needed$"
    ),
    "an array from lyapunov": (
        of(own_with(lyapunov=lambda t, terms, w: np.zeros(1))), r"lyapunov at t = 0 gave array\(\[0.\]\); a number is"
    ),
    "a class as u": (of(own_with(u=dict)), r"^controller: u: the class dict was given; it takes a function of \(t, "),
    "a gain that was replaced": (
        of(with_attributes(set_point(), K_P=20.0)), r"^SetPoint: K_P: 20.0 was given; it takes an array of shape \(2, "
    ),
    "a target that was replaced": (
        of(with_attributes(set_point(), target=None)), "^SetPoint: target: None was given; it takes Terms"
    ),
    "a q_d that was replaced": (
        of(with_attributes(set_point(), q_d=Q)), r"^SetPoint: q_d: a dict was given; it takes an array of shape \(2,\)"
    ),
    "a trajectory that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), desired=3)), "^Tracking: desired: 3 was given; it takes a f"
    ),
    "a matrix that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), Lambda=np.eye(3))), "^Tracking: Lambda: a ndarray was given;"
    ),
    "a model that was replaced": (
        of(with_attributes(Tracking(1.0, 1.0, trajectory), model="five_bar")), "^Tracking: model: 'five_bar' was given;"
    ),
    "a sensor": (lambda: Sampled(Own(), 0.1, sensor=3), r"Sampled: sensor: 3 was given; .*\[controller.sensor\]"),
    "one event": (lambda: simulate(SWING, SHORT, events=Event(law)), "events: an Event was given; it takes a list of"),
    "progress": (lambda: simulate(SWING, SHORT, progress=True), r"progress: True was given; .* \(t, t_end\)"),
    "on_output": (lambda: simulate(SWING, SHORT, on_output=3), r"on_output: 3 was given; .* \(t, q_tree\)"),
    "profile": (lambda: simulate(SWING, SHORT, profile="no"), "profile: 'no' was given; it takes True or False"),
    "load": (lambda: load(None), "load: name: None was given; it takes a mechanism's shipped name or its path"),
    "load with words": (lambda: load("five_bar", {MASS: "x"}), "load: overrides: link.link_2.mass = 'x'; it takes"),
    "load with a flag": (lambda: load("five_bar", {MASS: True}), "load: overrides: link.link_2.mass = True; it takes"),
    "load with no number": (lambda: load("five_bar", {MASS: np.nan}), "load: overrides: link.link_2.mass = nan; it"),
    "load beyond numbers": (lambda: load("five_bar", {MASS: 10**400}), "load: overrides: link.link_2.mass = 1000"),
    "load half a vector": (lambda: load("five_bar", {"gravity": [0, 0]}), "gravity: 2 numbers were given; a vector"),
    "load a number": (lambda: load("five_bar", 3), "load: overrides: 3 was given; it takes a table of numbers by name"),
    "load by number": (lambda: load("five_bar", {3: 1.0}), "load: overrides, a key: 3 was given"),
    "torques in words": (lambda: Simulator(SWING).step(None, 0.01, tau={"theta_1": "0.5"}), "tau: .* is no table of"),
    "torques as flags": (lambda: Simulator(SWING).step(None, 0.01, tau={"theta_1": True}), "tau: .* is no table of"),
    "load a scene by name": (lambda: load(SWING), "'five_bar/swing' is a scene; its mechanism is 'five_bar'"),
    "load_scene": (lambda: load_scene(five_bar()), "load_scene: name: a Mechanism was given"),
    "check": (lambda: ckc_pin.check(run()), "check: what: a Run was given; it takes a mechanism or a scene"),
    "terms of a scene": (lambda: ckc_pin.terms(load_scene(SWING), Q), "terms: mechanism: a Scene was given"),
    "terms at an array": (lambda: ckc_pin.terms("five_bar", np.zeros(2)), "q: a ndarray was given; it takes a table"),
    "terms at a word": (lambda: ckc_pin.terms("five_bar", {**Q, "theta_1": "a"}), "theta_1 = 'a': a number is needed"),
    "play nothing": (ckc_pin.play, "play: no run given"),
    "play a path": (lambda: ckc_pin.play("runs/a"), "play: runs: 'runs/a' was given; it takes runs"),
    "play fast": (lambda: ckc_pin.play(run(), speed="fast"), "play: speed = 'fast'; it must be a number above zero"),
    "play at a port": (lambda: ckc_pin.play(run(), port="http"), "play: port: 'http' was given; it takes a port"),
    "plot a path": (lambda: ckc_pin.plot("runs/a"), "plot: runs: 'runs/a' was given; it takes runs"),
    "map": (lambda: ckc_pin.singularity_map(3), "singularity_map: mechanism: 3 was given"),
    "cells": (lambda: ckc_pin.singularity_map("five_bar", cells="many"), "cells: 'many' was given; it takes a number"),
    "over": (lambda: ckc_pin.singularity_map("five_bar", over="theta_1"), r"'theta_1' was given; .*\['theta_1'\]"),
    "a map's scene": (lambda: ckc_pin.singularity_map("five_bar", scene=3), "singularity_map: scene: 3 was given"),
    "symbolic": (lambda: ckc_pin.symbolic(3), "symbolic: mechanism: 3 was given"),
    "as_ivp": (lambda: ckc_pin.as_ivp(five_bar()), "as_ivp: a Mechanism was given"),
    "inverse dynamics": (lambda: ckc_pin.inverse_dynamics(3), "inverse_dynamics: scene: 3 was given"),
    "linearize": (lambda: ckc_pin.linearize(3), "linearize: what: 3 was given; it takes a mechanism or a scene"),
    "linearize with words": (lambda: ckc_pin.linearize(SWING, 0.1, "t_end=1"), "linearize: overrides: 't_end=1' was"),
    "a period of words": (lambda: ckc_pin.floquet(SWING, "1 s"), "floquet: period: '1 s' was given; .* of seconds"),
    "floquet of a run": (lambda: ckc_pin.floquet(run(), 1.0), "floquet: scene: a Run was given; it takes a scene"),
    "no list of names": (lambda: ckc_pin.sensitivities(SWING, 5), r"sensitivities: parameters: 5 .*\[\"link.link_2"),
    "names by number": (lambda: ckc_pin.sensitivities(SWING, [5]), "sensitivities: parameters: 5 was given"),
    "ensemble": (lambda: ckc_pin.ensemble(load_scene(SWING), {}, {}), "ensemble: scene: a Scene was given"),
    "a variable": (lambda: ckc_pin.ensemble(SWING, "t_end", {}), "ensemble: variables: 't_end' was given; .* a table"),
    "an output": (lambda: ckc_pin.ensemble(SWING, {}, ["u"]), "ensemble: outputs: a list was given; .* a table by"),
    "threads": (lambda: ckc_pin.ensemble(SWING, {}, {}, threads=0.5), "threads: 0.5 was given; .* a whole number"),
    "no chunk": (lambda: ckc_pin.ensemble(SWING, {}, {}, chunk=0), "ensemble: chunk: 0 was given; .* at least 1"),
    "Simulator": (lambda: Simulator(SWING, 3), "Simulator: overrides: 3 was given"),
    "Point": (lambda: ckc_pin.Point("five_bar", "tip"), "Point: mechanism: 'five_bar' was given; it takes a Mechanism"),
    "Run.load": (lambda: Run.load(3), "Run.load: path: 3 was given"),
    "Run.save": (lambda: run().save(3), "Run.save: path: 3 was given"),
    "Run.at": (lambda: run().at("x"), "Run.at: 'x' was given; it takes a time, s"),
    "a target too short": (lambda: SetPoint(five_bar(), 1.0, 1.0, [0.1]), "q_d has 1 numbers; 2 are needed: theta_1"),
    "a target of words": (lambda: SetPoint(five_bar(), 1.0, 1.0, ["a", "b"]), "q_d: theta_1 = 'a': a number is needed"),
    "a gain of words": (lambda: SetPoint(five_bar(), "ten", 1.0, Q), "K_P: 'ten' was given; it takes a number"),
    "a gain of another size": (lambda: Tracking(np.eye(3), 1.0, trajectory), "Lambda: a matrix must be 2 x 2"),
    "no trajectory": (lambda: Tracking(1.0, 1.0, Q), "desired: a dict was given; it takes a function of t"),
    "a trajectory of one": (lambda: Tracking(1.0, 1.0, lambda t: np.zeros(2)), r"desired\(0\) is array.*its rate and"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_it_says_what_it_takes(name: str) -> None:
    call, says = CALLS[name]
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert re.search(says, message), message
    assert "\n" not in message
    assert len(message) < 400


def test_numbers_of_numpy_and_lists_are_taken_as_pythons() -> None:
    wanted = load("five_bar", {MASS: 0.3, "gravity": (0.0, -5.0, 0.0)}).tree.model
    for mass, gravity in ((np.float64(0.3), np.array([0, -5.0, 0])), (np.array(0.3), [0, -5, 0])):
        found = load("five_bar", {MASS: mass, "gravity": gravity}).tree.model
        assert found == wanted
    pair = np.array([-1.5, -1.0])
    taken = ckc_pin.ensemble(
        SWING, {"initial.q.theta_1": {"uniform": pair}}, {"e": "energy"}, members=np.int64(2), seed=np.int32(3),
        overrides={"t_end": np.float64(0.01), "solver.terms": "pinocchio"}, progress=False,
    )  # fmt: skip
    assert taken.sizes["member"] == 2
    assert (np.abs(taken["initial.q.theta_1"] + 1.25) <= 0.25).all()


def test_a_plain_function_is_a_controller_as_good_as_an_object() -> None:
    """Of itself, sampled, as a lambda, as an object that can be called: bit for bit the same motion."""

    class Called:
        def __call__(self, t: float, terms: Terms) -> Any:
            return law(t, terms)

    overrides = {"t_end": 0.3, "formulation": "reduced"}
    wanted = simulate(SWING, overrides, controller=Own())
    for own in (law, lambda t, terms: -terms.q_dot, Called()):
        found = simulate(SWING, overrides, controller=own)
        assert np.array_equal(found.q_tree, wanted.q_tree)
        assert np.array_equal(found.u, wanted.u)
    sampled = [simulate(SWING, overrides, controller=Sampled(own, 0.01)) for own in (Own(), law)]
    assert np.array_equal(sampled[0].q_tree, sampled[1].q_tree)
    assert np.abs(sampled[0].u[-1]).max() > 1e-3


def test_gains_of_controllers_are_taken_as_a_scene_takes_them() -> None:
    mechanism = five_bar()
    by_number = SetPoint(mechanism, 10.0, 1, Q)
    by_name = SetPoint(mechanism, {"theta_1": 10.0, "theta_3": 10.0}, [[1, 0], [0, 1]], [-1.2, -1.9])
    terms = ckc_pin.terms("five_bar", {"theta_1": -1.0, "theta_3": -1.7}, {"theta_1": 0.4})
    assert np.array_equal(by_number.u(0.0, terms), by_name.u(0.0, terms))
    assert np.array_equal(
        Tracking(1.0, 10.0, trajectory).u(0.0, terms), Tracking(np.eye(2), 10 * np.eye(2), trajectory).u(0.0, terms)
    )


def test_runs_of_two_mechanisms_do_not_lie_on_each_other() -> None:
    runs = [simulate(name, SHORT) for name in (SWING, "four_bar")]
    for pair in (runs, runs[::-1]):
        with pytest.raises(InputError, match="other coordinates; only runs of one mechanism lie on each other"):
            ckc_pin.play(*pair)
