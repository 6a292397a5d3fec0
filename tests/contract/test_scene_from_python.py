"""Scenes from Python: `Scene`, `simulate` of a mechanism, arrays for tables, `Scene.save`."""

from __future__ import annotations

import pickle
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import (
    CkcError,
    Event,
    InputError,
    Mechanism,
    Run,
    Sampled,
    Scene,
    SetPoint,
    Simulator,
    Terms,
    Tracking,
    load,
    load_scene,
    simulate,
)
from ckc_pin.analysis.map.desired_path import read_desired
from ckc_pin.mechanism.library import GENERATORS, library
from ckc_pin.scene.names import list_catalogue
from tests.conftest import assert_close
from tests.contract.helpers.command import ckc
from tests.contract.helpers.from_python import mechanism_arguments, mechanism_from_python
from tests.property.mechanisms import closed_mechanism

SHIPPED = [(name, scene) for name, _, scenes in list_catalogue() for scene in scenes if name not in GENERATORS]
OVERRIDES = {"t_end": 0.05, "solver.output_dt": 0.01}
START = {"q": [-1.2, -1.9]}
SET_POINT = {"type": "set_point", "K_P": 10.0, "K_V": 1.0, "q_d": [-1.0, -2.0]}
MOTION = [{"offset": -1.3, "harmonics": [[0.1, 2.0, 0.0]]}, {"offset": -1.9}]
TRACKING = {"type": "tracking", "Lambda": 1.0, "K_D": 10.0, "desired": MOTION}


@pytest.fixture(scope="module")
def five_bar() -> Mechanism:
    return mechanism_from_python("five_bar")


def scene_from_python(name: str, scene: str) -> Scene:
    """Return a shipped scene without its files, where these are not CSV files."""
    keys = tomllib.loads((library() / name / f"{scene}.scene.toml").read_text())
    mechanism = mechanism_from_python(name, keys.pop("mechanism"))
    return Scene(mechanism, events=keys.pop("event", ()), forces=keys.pop("force", ()), **keys)


def assert_same_runs(run: Run, other: Run) -> None:
    """Compare the results bit for bit."""
    assert run.status == other.status
    assert run.coordinates == other.coordinates
    for name in ("t", "q_tree", "v_tree", "u", "tau", "phi", "energy"):
        np.testing.assert_array_equal(getattr(run, name), getattr(other, name), err_msg=name)
    assert run.events == other.events
    rhs = ("rhs", "steps", "rejected", "newton")
    assert [run.stats[key] for key in rhs] == [other.stats[key] for key in rhs]


# --- the same as files ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "scene"), SHIPPED)
def test_run_from_python_is_that_of_the_files(name: str, scene: str, tmp_path: Path) -> None:
    from_python = scene_from_python(name, scene)
    run = simulate(from_python, OVERRIDES)
    assert_same_runs(run, simulate(f"{name}/{scene}", OVERRIDES))
    assert_same_runs(run, simulate(from_python.with_overrides(OVERRIDES).save(tmp_path)))


@pytest.mark.parametrize("seed", range(3))
def test_run_of_a_saved_random_mechanism_is_the_same(seed: int, tmp_path: Path) -> None:
    mechanism = closed_mechanism("universal", seed, free=False).mechanism
    scene = Scene(mechanism, t_end=0.02, formulation="dae", solver={"output_dt": 0.01})
    assert_same_runs(simulate(scene), simulate(scene.save(tmp_path)))


def test_command_runs_a_saved_scene_bit_for_bit(five_bar: Mechanism, tmp_path: Path) -> None:
    scene = Scene(five_bar, t_end=0.1, initial=START, controller={**TRACKING, "model": load("five_bar")})
    path = scene.save(tmp_path / "saved", "follow")
    assert path == tmp_path / "saved/follow.scene.toml"
    outcome = ckc("run", str(path), "--out", str(tmp_path / "run"), "--json")
    assert outcome.code == 0, outcome.err
    run, by_command = simulate(scene), Run.load(tmp_path / "run")
    assert_same_runs(run, by_command)
    assert by_command.texts == run.texts
    assert by_command.scene == run.scene
    assert set(run.texts) == {"mechanism.toml", "five_bar.urdf", "model/mechanism.toml", "model/five_bar.urdf"}


def test_scene_of_a_file_is_saved_with_all_its_files(tmp_path: Path) -> None:
    """Its table is in another folder, and its mechanism is a shipped one with other parameters."""
    (tmp_path / "in").mkdir()
    (tmp_path / "way.csv").write_text("t,theta_1,theta_3\n0,-1.3,-1.9\n1,-1.2,-1.9\n")
    (tmp_path / "in/x.scene.toml").write_text(
        'mechanism = "five_bar"\nformulation = "reduced"\nt_end = 0.1\nparameters = {link.link_2.mass = 0.3}\n'
        'initial.at = "assembled"\n[controller]\ntype = "tracking"\nLambda = 1.0\nK_D = 10.0\n'
        'desired = {file = "../way.csv", interpolation = "cubic"}\n'
    )
    scene = load_scene(tmp_path / "in/x.scene.toml")
    path = scene.save(tmp_path / "out")
    names = {file.name for file in path.parent.iterdir()}
    assert names == {"default.scene.toml", "mechanism.toml", "five_bar.urdf", "way.csv"}
    assert_same_runs(simulate(scene), simulate(path))
    assert tomllib.loads(path.read_text())["parameters"] == {"link.link_2.mass": 0.3}


def test_run_from_python_is_saved_and_replayed(five_bar: Mechanism, tmp_path: Path) -> None:
    t = np.linspace(0.0, 0.2, 5)
    torques = {"type": "torques", "file": {"t": t, "theta_1": np.sin(t), "theta_3": -t}, "interpolation": "linear"}
    run = simulate(five_bar, t_end=0.2, initial=START, controller=torques)
    assert_close(run.tau[:, 0], np.interp(run.t, t, np.sin(t)), 1e-14)
    again = Run.load(run.save(tmp_path / "run.npz"))
    assert set(again.texts) == {"mechanism.toml", "five_bar.urdf", "torques.csv"}
    np.testing.assert_array_equal(again.mechanism.q_tree, five_bar.q_tree)
    np.testing.assert_array_equal(ckc_pin.inverse_dynamics(again).tau, ckc_pin.inverse_dynamics(run).tau)
    followed = simulate(five_bar, t_end=0.2, initial=START, controller=TRACKING)
    np.testing.assert_array_equal(Run.load(followed.save(tmp_path / "run.npz")).desired, followed.desired)


def test_run_takes_arrays_in_overrides_of_its_scene(five_bar: Mechanism, tmp_path: Path) -> None:
    run = simulate(five_bar, t_end=0.05, initial=START, controller=SET_POINT)
    again = Run.load(run.save(tmp_path / "run.npz"))
    for what in (run, again):
        limited = ckc_pin.inverse_dynamics(what, {"controller.torque_limit": [0.5, 100.0]})
        assert [(x["motor"], x["limit"]) for x in limited.exceeded] == [("theta_1", 0.5)]


@pytest.mark.parametrize("name", ["n_four_bar", "five_bar"])
def test_scene_takes_names_of_mechanisms(name: str, tmp_path: Path) -> None:
    scene = Scene(name, t_end=0.02)
    assert_same_runs(simulate(scene), simulate(scene.save(tmp_path)))
    assert simulate(scene).mechanism.sources.folder == load(name).sources.folder
    with pytest.raises(InputError, match="'five_bar/swing' is a scene; its mechanism is 'five_bar'"):
        Scene("five_bar/swing", t_end=1.0)
    with pytest.raises(InputError, match=r"default.scene.toml: a scene; expected a mechanism"):
        load(scene.save(tmp_path / "again"))


def test_mechanisms_from_python_use_the_compiled_terms_of_their_files(
    five_bar: Mechanism, compiled_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(compiled_cache))
    run = simulate(five_bar, t_end=0.05, initial=START)
    assert run.stats["terms"] == "generated"
    assert_same_runs(run, simulate(load("five_bar"), t_end=0.05, initial=START))


def test_parameters_of_the_mechanism_are_those_of_the_scene(tmp_path: Path) -> None:
    mechanism = load("five_bar", {"link.link_2.mass": 0.3, "gravity": [0.0, -1.0, 0.0]})
    run = simulate(mechanism, t_end=0.05, initial=START, parameters={"gravity": (0.0, -5.0, 0.0)})
    assert run.scene["parameters"] == {"link.link_2.mass": 0.3, "gravity": [0.0, -5.0, 0.0]}
    overrides = {
        "t_end": 0.05,
        "link.link_2.mass": 0.3,
        "gravity": [0.0, -5.0, 0.0],
        "initial": START,
        "controller": None,
    }
    assert_same_runs(run, simulate("five_bar/set_point", {**overrides, "formulation": "reduced", "solver": {}}))


# --- defaults and arguments ----------------------------------------------------------------------


def test_mechanism_starts_at_rest_as_assembled(five_bar: Mechanism) -> None:
    run = simulate(five_bar, t_end=0.01)
    np.testing.assert_array_equal(run.q_tree[0], five_bar.tree.to_coordinates(five_bar.q_tree))
    assert not run.v_tree[0].any()
    assert run.scene["formulation"] == "reduced"
    moving = simulate(five_bar, {"t_end": 0.01}, initial={"q_dot": np.array([0.4, -0.3])})
    assert_close(moving.q_dot[0], [0.4, -0.3], 1e-15)
    np.testing.assert_array_equal(moving.q_tree[0], run.q_tree[0])


def test_run_continues_from_arrays_of_another_run(five_bar: Mechanism) -> None:
    whole = simulate(five_bar, t_end=0.2, initial=START, solver={"rtol": 1e-12})
    half = simulate(five_bar, t_end=0.1, initial=START, solver={"rtol": 1e-12})
    rest = simulate(
        five_bar, t_end=0.1, initial={"q": half.q_tree[-1], "q_dot": half.q_dot[-1]}, solver={"rtol": 1e-12}
    )
    assert_close(rest.q_tree[-1], whole.q_tree[-1], 1e-10)


def test_keys_replace_those_of_a_named_scene() -> None:
    run = simulate("five_bar/swing", t_end=0.05, solver={"rtol": 1e-10}, initial=START)
    other = simulate("five_bar/swing", {"t_end": 0.05, "solver": {"rtol": 1e-10}, "initial": START})
    assert_same_runs(run, other)
    assert run.scene["initial"]["q"] == {"theta_1": -1.2, "theta_3": -1.9}


@pytest.mark.parametrize(
    "controller",
    [
        SET_POINT,
        TRACKING,
        {**SET_POINT, "torque_limit": [1.0, 2.0], "K_P": [10.0, 20.0]},
        {**SET_POINT, "sample_time": 0.01, "sensor": {"resolution": [1e-3, 1e-4], "q_noise": [0.0, 1e-5]}},
        {**SET_POINT, "sample_time": 0.01, "drive": {"torque_resolution": [0.1, 0.2], "torque_rate": (5.0, 6.0)}},
    ],
    ids=["set point", "tracking", "limits", "sensor", "drive"],
)
def test_arrays_stand_for_tables(five_bar: Mechanism, controller: dict[str, Any]) -> None:
    def by_name(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: by_name(inner, name) for name, inner in value.items()}
        is_array = isinstance(value, list | tuple) and len(value) == 2 and key != "K_P"
        return dict(zip(five_bar.independent, value, strict=True)) if is_array else value

    arrays, tables = (
        simulate(five_bar, t_end=0.05, initial=START, controller=x) for x in (controller, by_name(controller))
    )
    assert_same_runs(arrays, tables)
    assert arrays.scene == tables.scene
    by_overrides = simulate("five_bar/swing", {"t_end": 0.05, "initial": START, "controller": controller})
    assert by_overrides.scene["controller"] == tables.scene["controller"]


def test_arrays_by_motor_are_in_the_order_of_the_motors() -> None:
    """Three motors for two freedoms, in another order than the joints."""
    arguments: dict[str, Any] = {"actuated": ["theta_4", "theta_1", "theta_3"]}
    mechanism = Mechanism.from_urdf(**{**mechanism_arguments("five_bar"), **arguments})
    allocation = {"weights": [1.0, 2.0, 3.0], "preload": np.array([0.1, 0.2, 0.3])}
    scene = Scene(mechanism, t_end=0.01, controller={**SET_POINT, "allocation": allocation})
    spec = scene.spec.controller
    assert spec is not None
    assert spec.allocation.weights == {"theta_4": 1.0, "theta_1": 2.0, "theta_3": 3.0}  # type: ignore[union-attr]
    assert spec.allocation.preload == {"theta_4": 0.1, "theta_1": 0.2, "theta_3": 0.3}  # type: ignore[union-attr]


def test_arrays_of_a_file_are_tables(tmp_path: Path, five_bar: Mechanism) -> None:
    five_bar.save(tmp_path)
    text = 'mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 0.05\ninitial.q = '
    runs = []
    for k, q in enumerate(("[-1.2, -1.9]", "{theta_1 = -1.2, theta_3 = -1.9}")):
        (tmp_path / f"{k}.scene.toml").write_text(text + q)
        runs.append(simulate(tmp_path / f"{k}.scene.toml"))
    assert_same_runs(*runs)


def test_arrays_leave_out_prescribed_joints() -> None:
    """Of a five-bar with a prescribed crank one coordinate remains, and only its value is given."""
    mechanism = mechanism_from_python("five_bar")
    prescribed = [{"joint": "theta_1", "offset": -1.3, "rate": 0.5}]
    run = simulate(mechanism, t_end=0.05, initial={"q": [-1.9], "q_dot": [0.1]}, prescribed=prescribed)
    assert run.independent == ("theta_3",)
    assert_close(run["theta_1"], -1.3 + 0.5 * run.t, 1e-12)
    assert_close([run["theta_3"][0], run["v.theta_3"][0]], [-1.9, 0.1], 1e-12)


def test_states_are_arrays_of_terms_and_linear_models(five_bar: Mechanism) -> None:
    table, rates = {"theta_1": -1.2, "theta_3": -1.9}, {"theta_1": 0.4, "theta_3": -0.3}
    by_table, by_array = ckc_pin.terms(five_bar, table, rates), ckc_pin.terms(five_bar, [-1.2, -1.9], (0.4, -0.3))
    np.testing.assert_array_equal(by_array.C, by_table.C)
    complete = ckc_pin.terms(five_bar, by_table.q_tree, by_table.v_tree)
    np.testing.assert_array_equal(complete.q_tree, by_table.q_tree)
    np.testing.assert_array_equal(complete.v_tree, by_table.v_tree)
    models = [ckc_pin.linearize(five_bar, at) for at in (table, np.array([-1.2, -1.9]))]
    np.testing.assert_array_equal(models[0].A, models[1].A)
    with pytest.raises(
        InputError, match=r"linearize: at: got 1 values; expected 2, in the order theta_1, theta_3 or 4"
    ):
        ckc_pin.linearize(five_bar, [1.0])
    with pytest.raises(InputError, match="terms: q: got 3 values; expected 2, in the order theta_1, theta_3 or 4"):
        ckc_pin.terms(five_bar, [1.0, 2.0, 3.0])


def test_simulator_resets_to_arrays(five_bar: Mechanism) -> None:
    simulator = Simulator(Scene(five_bar, t_end=1.0))
    state = simulator.reset({"q": [-1.2, -1.9], "q_dot": [0.4, -0.3]})
    assert_close(state.q, [-1.2, -1.9], 1e-15)
    assert_close(state.q_dot, [0.4, -0.3], 1e-15)


# --- messages ------------------------------------------------------------------------------------

TORQUES = {"type": "torques"}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no end": ({}, "simulate: a Mechanism has no end time; give t_end"),
    "misspelled end": ({"t_ends": 1.0}, "give t_end, .*, not t_ends"),
    "given twice": ({"t_end": 1, "overrides": {"t_end": 2}}, "simulate: t_end is given twice, as an argument and in"),
    "unknown key": ({"t_end": 1, "solvr": {}}, "Scene: unknown key 'solvr'; .*did you mean 'solver'"),
    "unknown key of a table": ({"t_end": 1, "solver": {"rtl": 1}}, "Scene: solver: unknown key 'rtl'.*mean 'rtol'"),
    "unknown key of a controller": (
        {"t_end": 1, "controller": {**SET_POINT, "KP": 1}},
        "Scene: controller: unknown key 'KP'",
    ),
    "unknown type": ({"t_end": 1, "controller": {"type": "set_pont"}}, "controller.type = 'set_pont'.*'set_point'"),
    "short q": ({"t_end": 1, "initial": {"q": [1.0]}}, "Scene: initial.q: got 1 values; expected 2, in the order the"),
    "long rates": ({"t_end": 1, "initial": {"q_dot": [1.0] * 4}}, "initial.q_dot: got 4 values; expected 2, in the or"),
    "short target": ({"t_end": 1, "controller": {**SET_POINT, "q_d": [1]}}, "controller.q_d: got 1 values; expected 2"),
    "short motion": (
        {"t_end": 1, "controller": {**TRACKING, "desired": [{}]}},
        "controller.desired: got 1 values; exp",
    ),
    "a word in q": ({"t_end": 1, "initial": {"q": [1.0, "x"]}}, "initial.q.theta_3 = 'x': expected a number"),
    "a matrix for q": ({"t_end": 1, "initial": {"q": np.eye(2)}}, "initial.q.theta_1 = .*: expected a number"),
    "unknown coordinate": ({"t_end": 1, "initial": {"q": {"theta_1": 1, "th": 2}}}, "initial.q: theta_3 missing|'th'"),
    "a number for initial": ({"t_end": 1, "initial": 3}, "Scene: initial = 3: expected a table, got an integer"),
    "a word for t_end": ({"t_end": "1"}, "Scene: t_end = '1': expected a number, got a string"),
    "an event's key": ({"t_end": 1, "events": [{"coordinat": "x"}]}, r"Scene: events\[0\]: unknown key 'coordinat'"),
    "no events": ({"t_end": 1, "events": 3}, "events: expected a list of Event objects and of tables"),
    "event": ({"t_end": 1, "event": []}, "Scene: event: the argument is called events"),
    "an event that is none": ({"t_end": 1, "events": [3]}, "Event"),
    "a controller that is none": ({"t_end": 1, "controller": 3}, "controller: expected an object with one of the met"),
    "a joint": ({"t_end": 1, "prescribed": [{"joint": "theta_9"}]}, "no joint of one freedom called 'theta_9'"),
    "a key of prescribed": ({"t_end": 1, "prescribed": [{"joint": "theta_1", "rat": 1}]}, r"prescribed\[0\]: .*'rat'"),
    "columns": ({"t_end": 1, "controller": {**TORQUES, "file": {"t": [0, 1], "a": [1]}}}, "equal length.*t 2, a 1"),
    "no column t": ({"t_end": 1, "controller": {**TORQUES, "file": {"a": [1]}}}, "one of them t; got a 1"),
    "words": ({"t_end": 1, "controller": {**TORQUES, "file": {"t": ["x"]}}}, "column 't': expected numbers, got 'x'"),
    "no file": ({"t_end": 1, "controller": {**TORQUES, "file": "missing.csv"}}, "missing.csv: no such file"),
    "a name": ({"t_end": 1, "name": 3}, "Scene: name: expected a string, got 3"),
    "a model": (
        {"t_end": 1, "controller": {**SET_POINT, "model": load("five_bar", {"link.link_2.mass": 0.3})}},
        r"controller.model: a mechanism file has no parameters \(link.link_2.mass\)",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_argument_is_named(case: str, five_bar: Mechanism) -> None:
    arguments, message = WRONG[case]
    with pytest.raises(CkcError, match=message):
        simulate(five_bar, **arguments)


def test_prescribed_joints_belong_to_the_scene() -> None:
    with pytest.raises(InputError, match=r"Scene: mechanism: its joints crank are held at a position.*as prescribed"):
        Scene(load("slider_crank", prescribed={"crank": 0.4}), t_end=1.0)


def test_objects_of_python_are_not_saved(five_bar: Mechanism, tmp_path: Path) -> None:
    control = SetPoint(five_bar, 10.0, 1.0, [-1.0, -2.0])
    for scene, message in (
        (
            Scene(five_bar, t_end=1.0, controller=control),
            "controller, SetPoint, which is an object of Python; give a t",
        ),
        (Scene(five_bar, t_end=1.0, events=[Event(lambda t, terms: t - 0.5)]), "event function, which is an object"),
    ):
        with pytest.raises(InputError, match=f"Scene.save: files cannot describe the scene's {message}"):
            scene.save(tmp_path)
    assert not list(tmp_path.iterdir())
    scene = Scene(five_bar, t_end=1.0)
    with pytest.raises(InputError, match=r"Scene.save: name = 'a/b': expected a file name without .scene.toml"):
        scene.save(tmp_path, "a/b")
    scene.save(tmp_path)
    with pytest.raises(InputError, match="there already"):
        scene.save(tmp_path)
    scene.save(tmp_path, overwrite=True)


# --- controllers and events that are objects -------------------------------------------------------


def motion(t: float) -> tuple[Any, Any, Any]:
    """Return the motion of `TRACKING`."""
    sine, cosine = np.sin(2 * t), np.cos(2 * t)
    return np.array([-1.3 + 0.1 * sine, -1.9]), np.array([0.2 * cosine, 0.0]), np.array([-0.4 * sine, 0.0])


def test_objects_act_as_the_argument_of_simulate(five_bar: Mechanism) -> None:
    law = Tracking(1.0, 10.0, motion)
    half = Event(lambda t, terms: t - 0.05, stop=True)
    for controller in (law, Sampled(law, 0.01), lambda t, terms: -2.0 * terms.q_dot):
        scene = Scene(five_bar, t_end=0.1, initial=START, controller=controller, events=[half])
        run = simulate(scene)
        assert run.t[-1] == pytest.approx(0.05, abs=1e-12)
        other = simulate(Scene(five_bar, t_end=0.1, initial=START), controller=controller, events=[half])
        assert_same_runs(run, other)
        assert "controller" not in run.scene
    table = simulate(five_bar, t_end=0.1, initial=START, controller=TRACKING)
    assert_close(simulate(five_bar, t_end=0.1, initial=START, controller=law).q_tree, table.q_tree, 1e-10)


def test_tables_of_events_are_added_to_those_of_a_scene(five_bar: Mechanism) -> None:
    table = {"coordinate": "theta_1", "value": -1.25, "stop": True}
    runs = [
        simulate(Scene(five_bar, t_end=1.0, initial=START, events=[table])),
        simulate(five_bar, t_end=1.0, initial=START, events=[table]),
        simulate(Scene(five_bar, t_end=1.0, initial=START), events=[table, Event(lambda t, terms: t - 10.0)]),
    ]
    for run in runs:
        assert run["theta_1"][-1] == pytest.approx(-1.25, abs=1e-10)
        assert run.t[-1] < 1.0
    both = simulate(Scene(five_bar, t_end=1.0, initial=START, events=[table]), events=[{**table, "value": -1.22}])
    assert both["theta_1"][-1] == pytest.approx(-1.22, abs=1e-10)


def test_overrides_keep_objects_and_replace_them(five_bar: Mechanism) -> None:
    law = Tracking(1.0, 10.0, motion)
    scene = Scene(five_bar, t_end=0.1, initial=START, controller=law)
    longer = scene.with_overrides({"t_end": 0.2, "formulation": "dae"})
    assert longer.controller is law
    assert longer.spec.t_end == 0.2
    assert scene.with_overrides({"controller": SET_POINT}).controller is None
    assert_same_runs(
        simulate(scene, {"controller": SET_POINT}), simulate(five_bar, t_end=0.1, initial=START, controller=SET_POINT)
    )


# --- every function that takes a scene -----------------------------------------------------------


def read_desired_at(scene: Scene | Path, t: float) -> Any:
    """Return the desired motion that a singularity map draws, at a time (s)."""
    loaded = scene if isinstance(scene, Scene) else load_scene(scene)
    return np.array(read_desired(loaded, load("five_bar")).desired(t))


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "check": lambda scene: ckc_pin.check(scene).desired.until,  # type: ignore[union-attr]
    "linearize": lambda scene: ckc_pin.linearize(scene, 0.05).closed_loop,
    "locus": lambda scene: np.sort(np.abs(ckc_pin.gain_locus(scene).eigenvalues)),  # type: ignore[union-attr]
    "inverse": lambda scene: ckc_pin.inverse_dynamics(scene).tau,
    "ivp": lambda scene: (lambda problem: problem.f(0.01, problem.y0))(ckc_pin.as_ivp(scene)),
    "simulator": lambda scene: Simulator(scene).step(np.array([1.0, 0.5]), 0.01).v_tree,
    "controller": lambda scene: (lambda s: s.controller.u(0.0, s.state.terms))(Simulator(scene)),
    "sensitivities": lambda scene: ckc_pin.sensitivities(scene, ["initial.q.theta_1", "controller.K_D.theta_1"]).q_tree,
    "map": lambda scene: read_desired_at(scene, 0.05),
}


@pytest.mark.parametrize("function", FUNCTIONS)
def test_function_takes_scenes_from_python(function: str, five_bar: Mechanism, tmp_path: Path) -> None:
    call = FUNCTIONS[function]
    table = Scene(five_bar, t_end=0.1, initial=START, controller=TRACKING)
    np.testing.assert_array_equal(call(table), call(table.save(tmp_path)))
    law = Scene(five_bar, t_end=0.1, initial=START, controller=Tracking(1.0, 10.0, motion))
    if function != "sensitivities":  # with respect to gains of a controller in Python
        assert_close(call(law), call(table), 1e-9)


def test_derivatives_with_respect_to_gains_of_a_function_are_refused(five_bar: Mechanism) -> None:
    law = Scene(five_bar, t_end=0.1, initial=START, controller=Tracking(1.0, 10.0, motion))
    with pytest.raises(InputError, match=r"sensitivities: .*controller.K_D.theta_1"):
        ckc_pin.sensitivities(law, ["controller.K_D.theta_1"])
    start = ["initial.q.theta_1"]
    table = Scene(five_bar, t_end=0.1, initial=START, controller=TRACKING)
    by_law, by_table = (ckc_pin.sensitivities(scene, start).q_tree for scene in (law, table))
    assert_close(by_law, by_table, 1e-6)


def test_subclass_has_no_closed_loop_of_its_base(five_bar: Mechanism) -> None:
    class Half(Tracking):
        def u(self, t: float, terms: Terms) -> Any:
            return 0.5 * super().u(t, terms)

    scene = Scene(five_bar, t_end=0.1, initial=START, controller=Half(1.0, 10.0, motion))
    assert ckc_pin.check(scene).stability is None
    assert ckc_pin.linearize(scene, 0.05).closed_loop is None
    assert ckc_pin.gain_locus(scene) is None


def test_floquet_takes_scenes_from_python(five_bar: Mechanism) -> None:
    rest = ckc_pin.linearize(five_bar).q_tree
    scene = Scene(five_bar, t_end=0.5, initial={"q": rest}, controller=lambda t, terms: -1.0 * terms.q_dot)
    multipliers = ckc_pin.floquet(scene, 0.5).multipliers
    assert np.abs(multipliers).max() < 1.0


def test_work_precision_takes_scenes_from_python(five_bar: Mechanism) -> None:
    from ckc_pin.analysis.precision.compute import work_precision

    result = work_precision(Scene(five_bar, t_end=0.05, initial=START), {"t_end": 0.02}, budget=2.0)
    assert result.reference is not None


def test_ensemble_takes_scenes_from_python(five_bar: Mechanism, tmp_path: Path) -> None:
    scene = Scene(five_bar, t_end=0.05, initial=START, controller=SET_POINT)
    variables = {"initial.q.theta_1": [-1.2, -1.1], "link.link_2.mass": [0.2, 0.3], "controller.K_P": [10.0, 12.0]}
    results = [
        ckc_pin.ensemble(what, variables, {"end": "q_tree"}, progress=False, overrides={"solver.rtol": 1e-10})
        for what in (scene, scene.save(tmp_path))
    ]
    assert results[0].sizes["member"] == 8
    np.testing.assert_array_equal(results[0]["end"], results[1]["end"])
    last = {"initial.q.theta_1": -1.1, "link.link_2.mass": 0.3, "controller.K_P": 12.0, "solver.rtol": 1e-10}
    assert_close(results[0]["end"][-1], simulate(scene, last).q_tree[-1], 1e-9)
    for argument in ({"controller": lambda t, terms: 0.0 * terms.q}, {"events": [Event(lambda t, terms: t - 0.5)]}):
        with pytest.raises(InputError, match="ensemble: scene: a controller or event that is an object of Python"):
            ckc_pin.ensemble(Scene(five_bar, t_end=0.1, **argument), variables, {})  # type: ignore[arg-type]


def test_scene_is_pickled(five_bar: Mechanism) -> None:
    scene = Scene(five_bar, t_end=0.05, initial=START, controller=SET_POINT)
    assert_same_runs(simulate(pickle.loads(pickle.dumps(scene))), simulate(scene))
