"""Invalid scenes: exit code 2 and one message with the place, the value and the expected one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.helpers.bad import Bad, expect

RUN = ("run", "bar/swing.scene.toml")
NAMED = "bar/swing.scene.toml: "
GREATER = "greater than 0"
FINITE = "expected a finite number"


def _set(*overrides: str) -> tuple[str, ...]:
    return (*RUN, *(word for change in overrides for word in ("--set", change)))


def _value(change: str, *says: str) -> Bad:
    return Bad(change[:60], _set(change), says)


def _file(what: str, old: str, new: str, *says: str) -> Bad:
    return Bad(what, RUN, [NAMED, *says], {"swing.scene.toml": (old, new)})


SCENE = [
    _value("t_end=0", f"{NAMED}t_end = 0: ", GREATER),
    _value("t_end=-1", f"{NAMED}t_end = -1: ", GREATER),
    _value("t_end=nan", "t_end = nan", GREATER),
    _value("t_end=inf", f"t_end = inf: {FINITE}"),
    _value("t_end=soon", "t_end = 'soon': expected a number, got a string"),
    _value("t_end=true", "t_end = true: expected a number"),
    _value("t_end=2020-01-01", "t_end: expected a number, got a date"),
    _value("formulation=ode", "formulation = 'ode'; valid: 'dae', 'reduced', 'spf'"),
    _value("formulation=3", "formulation = 3: expected a string, got an integer"),
    _value("epsilon=0", "epsilon = 0: ", GREATER),
    _value("epsilon=-1e-3", "epsilon = -0.001: ", GREATER),
    _value("coriolis_velocity=rhoo", "coriolis_velocity = 'rhoo'; valid: 'actual', 'rho'"),
    _value("mechanism=nothing", "no mechanism 'nothing'", "five_bar"),
    _value("mechanism=nothing.toml", "bar/nothing.toml: no such mechanism file"),
    _value("mechanism=3", "mechanism = 3: expected a string or a table"),
    _value('mechanism={generator="x"}', "mechanism.generator = 'x'; valid: 'n_four_bar'"),
    _value('mechanism={generator="n_four_bar", N=1000000000}', "mechanism.N = 1000000000: ", "at most 1000"),
    _file("no mechanism", 'mechanism = "mechanism.toml"', "", "the key 'mechanism' is missing"),
    _file("no formulation", 'formulation = "dae"', "", "'formulation' is missing; valid: 'dae', 'reduced', 'spf'"),
    _file("malformed", "t_end = 2.0", "t_end = ", "malformed TOML", "line "),
    _file("nested without end", "t_end = 2.0", f"t_end = {'[' * 10000}", "malformed TOML: nested too deeply"),
    _file("nan in the file", "rtol = 1e-8", "max_step = nan", "solver.max_step = nan: ", GREATER),
    _file("a number of 400 digits", "t_end = 2.0", f"t_end = 1{'0' * 400}", f"{NAMED}t_end: ", "64 bits"),
]

SOLVER = [
    _value("solver.rtol=0", f"{NAMED}solver.rtol = 0: ", "at least 2.3e-14 and less than 1"),
    _value("solver.rtol=-1e-8", "solver.rtol = -1e-08: expected a number of at least"),
    _value("solver.rtol=nan", "solver.rtol = nan"),
    _value("solver.rtol=inf", "solver.rtol = inf: ", "less than 1"),
    _value("solver.rtol=1e-300", "solver.rtol = 1e-300: expected a number of at least 2.3e-14"),
    _value("solver.rtol=high", "solver.rtol = 'high': expected a number, got a string"),
    _value("solver.atol=0", "solver.atol = 0: ", GREATER),
    _value("solver.method=RK4", "solver.method = 'RK4'; valid: 'DOP853', 'RK45', 'Radau', 'auto'"),
    _value("solver.method=BDF", "solver.method = 'BDF'; valid: 'DOP853', 'RK45', 'Radau', 'auto'"),
    _value("solver.backend=native", "solver: unknown key 'backend'; valid: method, rtol"),
    _value("spf_coordinates=y", "spf_coordinates = 'y'; valid: 'w', 'z'"),
    _value("solver.projection=yes", "solver.projection = 'yes': expected true or false, got a string"),
    _value("solver.max_rhs=0", "solver.max_rhs = 0: ", "of at least 1"),
    _value("solver.max_rhs=1.5", "solver.max_rhs = 1.5: expected an integer, got a number"),
    _value("solver.max_wall_s=0", "solver.max_wall_s = 0: ", GREATER),
    _value("solver.max_step=0", "solver.max_step = 0: ", GREATER),
    _value("solver.min_step=-1", "solver.min_step = -1: expected a number of at least 0"),
    _value("solver={min_step=1.0, max_step=0.1}", "solver: min_step = 1 is above max_step = 0.1"),
    _value("solver.output_dt=0", "solver.output_dt = 0: ", GREATER),
    _value("solver.output_dt=1e-300", "solver.output_dt = 1e-300 gives more than 1000000 output instants in 2 s"),
]

START = [
    _value("initial.at=rest", "initial.at = 'rest'; valid: 'assembled', 'equilibrium'"),
    _value("initial.at=equilibrium", "initial: give either at", "or q, not both"),
    _value("initial.q={}", "initial: give q (a table by coordinate)", 'at = "equilibrium"'),
    _value(
        "initial.q=[1.0, 2.0, 3.0]",
        "initial.q: got 3 values; expected 2, in the order theta_1, theta_3 or 4, in the order theta_1, theta_2, ",
    ),
    _value("initial.q=[1.0, true]", "initial.q.theta_3 = true: expected a number, got true or false"),
    _value("initial.q.theta_9=1", "initial.q: no coordinate 'theta_9'", "theta_1, theta_3"),
    _value("initial.q.theta_1=abc", f"{NAMED}initial.q.theta_1 = 'abc': expected a number, got a string"),
    _value("initial.q.theta_1=nan", f"initial.q.theta_1 = nan: {FINITE}"),
    _value("initial.q={theta_1=1.0}", "initial.q: theta_3 missing; expected theta_1, theta_3"),
    _value("initial.q={theta_1=3.1, theta_3=0.0}", "the start theta_1 = 3.1, theta_3 = 0 is out of reach"),
    _value("initial.q.theta_2=40.0", "initial.q: the loops do not close near the given theta_2", "leave them out"),
    _value("initial.q_dot.theta_9=1", "initial.q_dot: ", "'theta_9'", "theta_1, theta_3"),
    _value("initial.q_dot.theta_2=1", "initial.q_dot: 'theta_2' follows from the loops", "theta_1, theta_3"),
    _value("initial.q_dot.theta_1=inf", f"initial.q_dot.theta_1 = inf: {FINITE}"),
    _value("initial.w=[0.1, 0.1]", "initial.w: only the SPF can start off phi = 0, not 'dae'"),
    Bad("w of the reduced", _set("initial.w=[0.1, 0.1]", "formulation=reduced"), ["initial.w", "not 'reduced'"]),
    Bad(
        "w too short",
        _set("initial.w=[0.1]", "formulation=spf"),
        ["initial.w: got 1 numbers", "2 rows: elbow.x, elbow.y"],
    ),
    Bad("w that is a number", _set("initial.w=0.1", "formulation=spf"), ["initial.w = 0.1: expected a list"]),
    Bad("w with nan", _set("initial.w=[nan, 0.1]", "formulation=spf"), [f"initial.w[0] = nan: {FINITE}"]),
    Bad("w out of reach", _set("initial.w=[9.0, 0.1]", "formulation=spf"), ["phi = w = [9.0, 0.1] is out of reach"]),
]

EVENTS = [
    _value('event={coordinate="theta_1"}', "event: expected a list, got a table"),
    _value("event=[{value=1.0}]", f"{NAMED}event[0]: the key 'coordinate' is missing"),
    _value('event=[{coordinate="x"}]', "event", "no coordinate 'x'; there are theta_1, theta_2, theta_3, theta_4"),
    _value('event=[{coordinate="x", val=1.0}]', "event[0]: unknown key 'val'; valid: coordinate, of, value"),
    _value('event=[{coordinate="x", of="v"}]', "event[0].of = 'v'; valid: 'limit', 'q', 'q_dot', 'sigma_min_J'"),
    _value('event=[{coordinate="x", direction=2}]', "event[0].direction = 2; valid: -1, 0, 1"),
    _value('event=[{coordinate="x"}, {coordinate="x", stop=1}]', "event[1].stop = 1: expected true or false"),
]


@pytest.mark.parametrize("case", [*SCENE, *SOLVER, *START, *EVENTS], ids=lambda case: case.what)
def test_invalid_scene_is_rejected(case: Bad, bar: Path) -> None:
    expect(case, bar)
