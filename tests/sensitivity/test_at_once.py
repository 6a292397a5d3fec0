"""Where joints change what they do at the start, or several of them at one instant, in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import NumericalError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.regression.test_dae import IN_LINE, by_slider
from tests.sensitivity.changed import NUMBERS, differentiated, written
from tests.sensitivity.sliders import force, joint, sliders

TIGHT = {"solver.rtol": 1e-11, "solver.atol": 1e-13}
FORMULATIONS = pytest.mark.parametrize("formulation", ["dae", "reduced"])


def last(found: Sensitivities, parameter: str) -> Any:
    """How x, y and their rates have changed in the end."""
    assert found.run.status == "done"
    return np.stack([found.q_tree, found.v_tree])[:, -1, :, found.parameters.index(parameter)].ravel()


@FORMULATIONS
def test_an_impact_at_the_start(formulation: str, tmp_path: Path) -> None:
    """Of one joint, thrown back with 0.6 of its speed: x = upper - 0.6 (v t - (upper - x_0)) from there on."""
    scene = sliders(tmp_path, joint("x", restitution=0.6), q=(0.3, 0.0), q_dot=(1.5, 0.2), upper=0.3)
    names = ["joint.x.restitution", "joint.x.upper", "initial.q.x", "initial.q_dot.x", "link.one.mass"]
    found = sensitivities(scene, names, {**TIGHT, "formulation": formulation})
    for name, x, v in zip(names, (-1.5, 1.6, -0.6, -0.6, 0.0), (-1.5, 0.0, 0.0, -0.6, 0.0), strict=True):
        assert last(found, name) == pytest.approx([x, 0.0, v, 0.0], abs=1e-9), name


def test_an_impact_at_the_start_in_a_loop(tmp_path: Path) -> None:
    overrides = {"joint.c.restitution": 0.4, "initial.q_dot.a": 1.5}
    start = simulate(written(tmp_path / "x", overrides), {"t_end": 1e-9}).q_tree[0]
    overrides["joint.c.upper"] = float(start[2])
    names = ["link.crank.mass", "spring.0.stiffness", "initial.q_dot.a", "joint.c.restitution"]
    found = sensitivities(written(tmp_path / "x", overrides, stop=True, t_end=0.3), names, TIGHT)
    assert found.run.events[0]["name"] == "c bounces"
    for k, name in enumerate(names):
        h = 1e-3 * max(0.3, {**NUMBERS, **overrides}[name])
        wanted = differentiated(tmp_path / "y", name, h, overrides=overrides, stop=True, t_end=0.3)
        ours = np.stack([found.q_tree[:, :, k], found.v_tree[:, :, k]])
        assert np.abs(ours - wanted)[:, 1:].max() <= 1e-7 * np.abs(wanted).max(), name


@FORMULATIONS
@pytest.mark.parametrize("on", ["ground", "one"])
def test_two_joints_that_come_to_rest_at_once_and_stick(formulation: str, on: str, tmp_path: Path) -> None:
    """With another start one comes to rest before the other; both stay where they stick, which changes smoothly."""
    friction, masses, time = np.array([2.0, 1.5]), (1.3, 0.7), 0.5
    M = np.diag(masses) if on == "ground" else np.array([[2.0, 0.7], [0.7, 0.7]])
    v = time * np.linalg.solve(M, friction)
    rubs = joint("x", friction=2.0) + joint("y", friction=1.5)
    found = sensitivities(
        sliders(tmp_path, rubs, q_dot=(v[0], v[1]), on=on), ["initial.q_dot.x", "initial.q_dot.y", "joint.x.friction"],
        {**TIGHT, "formulation": formulation},
    )  # fmt: skip
    assert last(found, "initial.q_dot.x") == pytest.approx([time, 0.0, 0.0, 0.0], abs=1e-9)
    assert last(found, "initial.q_dot.y") == pytest.approx([0.0, time, 0.0, 0.0], abs=1e-9)
    shorter = -0.5 * time**2 * np.linalg.solve(M, [1.0, 0.0])
    assert last(found, "joint.x.friction") == pytest.approx([*shorter, 0.0, 0.0], abs=1e-9)


@FORMULATIONS
def test_a_joint_that_sticks_from_the_start(formulation: str, tmp_path: Path) -> None:
    """Pushed a little it comes to rest at once, and gives its momentum to nothing but the ground."""
    rubs = joint("x", friction=2.0) + joint("y", friction=0.1)
    scene = sliders(tmp_path, rubs, q_dot=(0.0, 1.0), on="one")
    found = sensitivities(scene, ["initial.q_dot.x", "initial.q.x"], {**TIGHT, "formulation": formulation})
    assert last(found, "initial.q.x") == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-9)
    assert last(found, "initial.q_dot.x") == pytest.approx([0.0, 1.0, 0.0, 1.0], abs=1e-9)
    h = 1e-6
    one, other = (simulate(sliders(tmp_path, rubs, q_dot=(x, 1.0), on="one"), TIGHT) for x in (h, -h))
    assert ((one.q_tree - other.q_tree) / (2 * h))[-1] == pytest.approx([0.0, 1.0], abs=1e-5)


def test_a_stop_without_restitution_that_lets_go_at_once(tmp_path: Path) -> None:
    """A force of 1.3 on 1.3 kg pulls back: with a restitution e the joint leaves at e times the speed it came with."""
    scene = sliders(tmp_path, joint("x", restitution=0.0) + force("x", -1.3), q_dot=(1.5, 0.0), upper=0.3)
    speed = np.sqrt(1.5**2 - 2 * 0.3)
    left = 1.0 - (1.5 - speed)
    found = sensitivities(scene, ["joint.x.restitution"], TIGHT)
    assert last(found, "joint.x.restitution") == pytest.approx([-speed * left, 0.0, -speed, 0.0], abs=1e-9)


def test_an_event_at_a_place_does_not_move_with_the_stop(tmp_path: Path) -> None:
    event = '[[event]]\ncoordinate = "x"\nof = "q"\nvalue = 0.1\nstop = true\n'
    scene = sliders(tmp_path, joint("x", restitution=0.6), q_dot=(1.5, 0.0), upper=0.3, scene=event)
    found = sensitivities(scene, ["initial.q_dot.x", "joint.x.upper"], TIGHT)
    assert found.end_time == pytest.approx([-0.1 / 1.5**2, 0.0], abs=1e-10)


@pytest.mark.parametrize(
    ("more", "q_dot", "upper", "name", "says"),
    [
        (joint("x", friction=0.5) + force("x", 2.0), 0.0, 9.0, "initial.q_dot.x", "x begins to move from rest"),
        (joint("x", restitution=0.5) + force("x", 2.0), 0.0, 0.0, "initial.q.x", "x comes to its stop"),
        (joint("x", restitution=0.5) + force("x", 2.0), 0.0, 0.0, "joint.x.upper", "x comes to its stop"),
    ],
)
def test_a_start_without_a_derivative_is_named(
    more: str, q_dot: float, upper: float, name: str, says: str, tmp_path: Path
) -> None:
    scene = sliders(tmp_path, more, q_dot=(q_dot, 0.0), upper=upper)
    found = sensitivities(scene, [name])
    assert found.run.status == "stopped"
    assert f"at the start: {says}, and with another {name}" in found.run.message
    assert sensitivities(scene, ["link.one.mass"]).run.status == "done"  # of which it has one


@pytest.mark.parametrize("seed", range(4))
def test_joints_that_only_move_together_turn_round_together(seed: int) -> None:
    """Whatever the tolerance is: a loop of one freedom that rubs in three of its joints has a derivative everywhere."""
    rng = np.random.default_rng(seed)
    overrides: dict[str, Any] = {
        f"joint.{name}.friction": rng.uniform(0.05, 0.5) for name in ("crank", "coupler", "rocker")
    }
    overrides |= {"initial.q_dot.crank": rng.uniform(-5.0, 5.0), "t_end": 3.0, "formulation": "dae"}
    names = ["link.coupler_link.mass", "initial.q_dot.crank", "joint.rocker.friction"]
    wanted = sensitivities("four_bar/turning", names, {**overrides, **TIGHT})
    turns = [event for event in wanted.run.events if "slides" in event["name"] and event["t"] > 0.0]
    assert len(turns) >= 3
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8):
        found = sensitivities("four_bar/turning", names, {**overrides, "solver.rtol": rtol})
        assert found.run.status == "done", rtol
        assert np.abs(found.q_tree - wanted.q_tree).max() <= 100 * rtol * np.abs(wanted.q_tree).max(), rtol


def test_an_event_of_a_free_root_in_the_worlds_axes(tmp_path: Path) -> None:
    """A body that is thrown, turned as it is: it comes to x = 0.4 after 0.4 / v, with v in the body's own axes."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    (tmp_path / "body.urdf").write_text(f"""<robot name="body"><link name="world"/><link name="thing">{inertial}</link>
        <link name="arm">{inertial}</link>
        <joint name="root" type="floating"><parent link="world"/><child link="thing"/></joint>
        <joint name="swing" type="continuous"><parent link="thing"/><child link="arm"/><axis xyz="0 0 1"/></joint>
        </robot>""")
    (tmp_path / "body.toml").write_text('name = "body"\nurdf = "body.urdf"\ngravity = [0, 0, 0]\n')
    mechanism = ckc_pin.load(tmp_path / "body.toml")
    root = [name for name in mechanism.coordinates if name in mechanism.tree.free_coordinates]
    turn, along = 0.9, np.array([0.8, 0.3, -0.2])
    start = dict.fromkeys(mechanism.independent, 0.0) | {root[5]: turn}
    rates = dict.fromkeys(mechanism.independent, 0.0) | dict(zip(root, along.tolist(), strict=False))
    q, q_dot = ("{" + ", ".join(f"{name} = {x}" for name, x in table.items()) + "}" for table in (start, rates))
    event = f'[[event]]\ncoordinate = "{root[0]}"\nof = "q"\nvalue = 0.4\nstop = true\n'
    (tmp_path / "body.scene.toml").write_text(
        f'mechanism = "body.toml"\nformulation = "dae"\nt_end = 5.0\ninitial.q = {q}\ninitial.q_dot = {q_dot}\n{event}'
    )
    found = sensitivities(tmp_path / "body.scene.toml", [f"initial.q_dot.{name}" for name in root[:3]], TIGHT)
    row = np.array([np.cos(turn), -np.sin(turn), 0.0])
    assert found.run.t[-1] == pytest.approx(0.4 / (row @ along))
    assert found.end_time == pytest.approx(-0.4 / (row @ along) ** 2 * row, abs=1e-9)


def test_a_start_where_q_is_no_chart_tells_what_does_not_hang_on_it(tmp_path: Path) -> None:
    """The slider-crank with the slider as q, crank and rod in line: lengths there move the crank without bound."""
    scene = by_slider(tmp_path)
    overrides = {"initial": {"q": IN_LINE}, "t_end": 0.3, "solver.rtol": 1e-10, "solver.output_dt": 0.05}
    found = sensitivities(scene, ["gravity.y", "link.rod_link.mass"], overrides)
    same = sensitivities("slider_crank", ["gravity.y", "link.rod_link.mass"], {**overrides, "formulation": "dae"})
    assert np.abs(found.q_tree - same.q_tree).max() <= 1e-8 * np.abs(same.q_tree).max()
    with pytest.raises(NumericalError, match="at the start phi_z is singular: slider does not determine the others"):
        sensitivities(scene, ["loop.slider_pin.frame_a.xyz.x"], overrides)


def test_a_start_at_an_equilibrium_beside_others_is_refused(tmp_path: Path) -> None:
    overrides = {"initial": {"at": "equilibrium"}, "parameters": {"gravity": [0.0, 0.0, 0.0]}, "t_end": 0.1}
    with pytest.raises(NumericalError, match="an equilibrium beside which there are others"):
        sensitivities("five_bar/swing", ["link.link_2.mass"], overrides)


EVENT = '[[event]]\nof = "q_dot"\ncoordinate = "x"\nvalue = 0.2\nstop = true\n'


def test_a_rate_that_an_impact_takes_over_its_value_comes_there_with_it(tmp_path: Path) -> None:
    """At the stop at once, also where nothing happens in the step from there; with what makes the impact come later."""
    x, v, stop, pull = 0.25, 1.5, 1.0, -0.8
    for constant in (0.0, pull):
        more = joint("x", restitution=0.6) + (force("x", constant) if constant else "")
        scene = sliders(tmp_path / str(constant), more, q=(x, 0.0), q_dot=(v, 0.0), upper=stop, scene=EVENT)
        found = sensitivities(scene, ["initial.q.x", "initial.q_dot.x", "joint.x.restitution"], TIGHT)
        a = constant / 1.3
        t = (stop - x) / v if not a else (-v + np.sqrt(v**2 + 2 * a * (stop - x))) / a
        assert found.run.t[-1] == pytest.approx(t, abs=1e-11)
        assert "by the event" in found.run.message
        assert found.end_time == pytest.approx(np.array([-1.0, -t, 0.0]) / (v + a * t), abs=1e-9)
