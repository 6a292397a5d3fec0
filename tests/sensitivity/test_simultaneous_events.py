"""Mode transitions of joints at the start, and of several joints at one instant, in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ckc_pin
from ckc_pin import NumericalError, simulate
from ckc_pin.sensitivity.sensitivities import Sensitivities, sensitivities
from tests.regression.test_dae import IN_LINE, by_slider
from tests.sensitivity.four_bar import NUMBERS, finite_difference, write_four_bar
from tests.sensitivity.sliders import force, joint, write_sliders

TIGHT = {"solver.rtol": 1e-11, "solver.atol": 1e-13}
FORMULATIONS = pytest.mark.parametrize("formulation", ["dae", "reduced"])


def end(result: Sensitivities, parameter: str) -> Any:
    """Derivatives of x, y and their rates at the last instant."""
    assert result.run.status == "done"
    return np.stack([result.q_tree, result.v_tree])[:, -1, :, result.parameters.index(parameter)].ravel()


@FORMULATIONS
def test_an_impact_at_the_start(formulation: str, tmp_path: Path) -> None:
    """A joint rebounds with 0.6 of its speed: x = upper - 0.6 (v t - (upper - x_0)) afterwards."""
    scene = write_sliders(tmp_path, joint("x", restitution=0.6), q=(0.3, 0.0), q_dot=(1.5, 0.2), upper=0.3)
    names = ["joint.x.restitution", "joint.x.upper", "initial.q.x", "initial.q_dot.x", "link.one.mass"]
    result = sensitivities(scene, names, {**TIGHT, "formulation": formulation})
    for name, x, v in zip(names, (-1.5, 1.6, -0.6, -0.6, 0.0), (-1.5, 0.0, 0.0, -0.6, 0.0), strict=True):
        assert end(result, name) == pytest.approx([x, 0.0, v, 0.0], abs=1e-9), name


def test_an_impact_at_the_start_in_a_loop(tmp_path: Path) -> None:
    overrides = {"joint.c.restitution": 0.4, "initial.q_dot.a": 1.5}
    start = simulate(write_four_bar(tmp_path / "x", overrides), {"t_end": 1e-9}).q_tree[0]
    overrides["joint.c.upper"] = float(start[2])
    names = ["link.crank.mass", "spring.0.stiffness", "initial.q_dot.a", "joint.c.restitution"]
    result = sensitivities(write_four_bar(tmp_path / "x", overrides, stop=True, t_end=0.3), names, TIGHT)
    assert result.run.events[0]["name"] == "c bounces"
    for k, name in enumerate(names):
        h = 1e-3 * max(0.3, {**NUMBERS, **overrides}[name])
        expected = finite_difference(tmp_path / "y", name, h, overrides=overrides, stop=True, t_end=0.3)
        ours = np.stack([result.q_tree[:, :, k], result.v_tree[:, :, k]])
        assert np.abs(ours - expected)[:, 1:].max() <= 1e-7 * np.abs(expected).max(), name


@FORMULATIONS
@pytest.mark.parametrize("on", ["ground", "one"])
def test_two_joints_that_stick_at_the_same_instant(formulation: str, on: str, tmp_path: Path) -> None:
    """A step of the start separates the two events, but the final positions are differentiable."""
    friction, masses, time = np.array([2.0, 1.5]), (1.3, 0.7), 0.5
    M = np.diag(masses) if on == "ground" else np.array([[2.0, 0.7], [0.7, 0.7]])
    v = time * np.linalg.solve(M, friction)
    rubs = joint("x", friction=2.0) + joint("y", friction=1.5)
    result = sensitivities(
        write_sliders(tmp_path, rubs, q_dot=(v[0], v[1]), on=on),
        ["initial.q_dot.x", "initial.q_dot.y", "joint.x.friction"],
        {**TIGHT, "formulation": formulation},
    )  # fmt: skip
    assert end(result, "initial.q_dot.x") == pytest.approx([time, 0.0, 0.0, 0.0], abs=1e-9)
    assert end(result, "initial.q_dot.y") == pytest.approx([0.0, time, 0.0, 0.0], abs=1e-9)
    shorter = -0.5 * time**2 * np.linalg.solve(M, [1.0, 0.0])
    assert end(result, "joint.x.friction") == pytest.approx([*shorter, 0.0, 0.0], abs=1e-9)


@FORMULATIONS
def test_a_joint_that_sticks_from_the_start(formulation: str, tmp_path: Path) -> None:
    """A small initial rate stops at once, and the friction transfers its momentum to the ground."""
    rubs = joint("x", friction=2.0) + joint("y", friction=0.1)
    scene = write_sliders(tmp_path, rubs, q_dot=(0.0, 1.0), on="one")
    result = sensitivities(scene, ["initial.q_dot.x", "initial.q.x"], {**TIGHT, "formulation": formulation})
    assert end(result, "initial.q.x") == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-9)
    assert end(result, "initial.q_dot.x") == pytest.approx([0.0, 1.0, 0.0, 1.0], abs=1e-9)
    h = 1e-6
    one, other = (simulate(write_sliders(tmp_path, rubs, q_dot=(x, 1.0), on="one"), TIGHT) for x in (h, -h))
    assert ((one.q_tree - other.q_tree) / (2 * h))[-1] == pytest.approx([0.0, 1.0], abs=1e-5)


def test_an_inelastic_stop_that_releases_the_joint_at_once(tmp_path: Path) -> None:
    """A force of 1.3 N pulls 1.3 kg back. With restitution e the joint leaves at e times its impact speed."""
    scene = write_sliders(tmp_path, joint("x", restitution=0.0) + force("x", -1.3), q_dot=(1.5, 0.0), upper=0.3)
    speed = np.sqrt(1.5**2 - 2 * 0.3)
    remaining = 1.0 - (1.5 - speed)
    result = sensitivities(scene, ["joint.x.restitution"], TIGHT)
    assert end(result, "joint.x.restitution") == pytest.approx([-speed * remaining, 0.0, -speed, 0.0], abs=1e-9)


def test_the_time_of_a_position_event_does_not_depend_on_a_later_stop(tmp_path: Path) -> None:
    event = '[[event]]\ncoordinate = "x"\nof = "q"\nvalue = 0.1\nstop = true\n'
    scene = write_sliders(tmp_path, joint("x", restitution=0.6), q_dot=(1.5, 0.0), upper=0.3, scene=event)
    result = sensitivities(scene, ["initial.q_dot.x", "joint.x.upper"], TIGHT)
    assert result.end_time == pytest.approx([-0.1 / 1.5**2, 0.0], abs=1e-10)


@pytest.mark.parametrize(
    ("more", "q_dot", "upper", "name", "message"),
    [
        (joint("x", friction=0.5) + force("x", 2.0), 0.0, 9.0, "initial.q_dot.x", "x begins to move from rest"),
        (joint("x", restitution=0.5) + force("x", 2.0), 0.0, 0.0, "initial.q.x", "x comes to its stop"),
        (joint("x", restitution=0.5) + force("x", 2.0), 0.0, 0.0, "joint.x.upper", "x comes to its stop"),
    ],
)
def test_the_message_names_joint_and_parameter_of_a_start_without_derivative(
    more: str, q_dot: float, upper: float, name: str, message: str, tmp_path: Path
) -> None:
    scene = write_sliders(tmp_path, more, q_dot=(q_dot, 0.0), upper=upper)
    result = sensitivities(scene, [name])
    assert result.run.status == "stopped"
    assert f"at the start: {message}, and after a step in {name}" in result.run.message
    assert sensitivities(scene, ["link.one.mass"]).run.status == "done"  # this derivative exists


@pytest.mark.parametrize("seed", range(4))
def test_a_one_freedom_loop_with_friction_is_differentiable_at_reversals(seed: int) -> None:
    """Three joints with friction reverse at the same instant in any run, at every tolerance."""
    rng = np.random.default_rng(seed)
    overrides: dict[str, Any] = {
        f"joint.{name}.friction": rng.uniform(0.05, 0.5) for name in ("crank", "coupler", "rocker")
    }
    overrides |= {"initial.q_dot.crank": rng.uniform(-5.0, 5.0), "t_end": 3.0, "formulation": "dae"}
    names = ["link.coupler_link.mass", "initial.q_dot.crank", "joint.rocker.friction"]
    expected = sensitivities("four_bar/turning", names, {**overrides, **TIGHT})
    reversals = [event for event in expected.run.events if "slides" in event["name"] and event["t"] > 0.0]
    assert len(reversals) >= 3
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8):
        result = sensitivities("four_bar/turning", names, {**overrides, "solver.rtol": rtol})
        assert result.run.status == "done", rtol
        assert np.abs(result.q_tree - expected.q_tree).max() <= 100 * rtol * np.abs(expected.q_tree).max(), rtol


def test_the_time_of_an_event_on_a_free_root(tmp_path: Path) -> None:
    """A rotated body reaches x = 0.4 after 0.4 / v_x; its initial rates are given in its own axes."""
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
    result = sensitivities(tmp_path / "body.scene.toml", [f"initial.q_dot.{name}" for name in root[:3]], TIGHT)
    row = np.array([np.cos(turn), -np.sin(turn), 0.0])
    assert result.run.t[-1] == pytest.approx(0.4 / (row @ along))
    assert result.end_time == pytest.approx(-0.4 / (row @ along) ** 2 * row, abs=1e-9)


def test_a_start_where_q_is_not_a_chart_has_derivatives_without_shape(tmp_path: Path) -> None:
    """With the slider as q, crank and rod in line, the derivative of the crank with respect to a length is infinite."""
    scene = by_slider(tmp_path)
    overrides = {"initial": {"q": IN_LINE}, "t_end": 0.3, "solver.rtol": 1e-10, "solver.output_dt": 0.05}
    result = sensitivities(scene, ["gravity.y", "link.rod_link.mass"], overrides)
    same = sensitivities("slider_crank", ["gravity.y", "link.rod_link.mass"], {**overrides, "formulation": "dae"})
    assert np.abs(result.q_tree - same.q_tree).max() <= 1e-8 * np.abs(same.q_tree).max()
    with pytest.raises(
        NumericalError, match="at the start phi_z is singular: slider does not determine the other coordinates"
    ):
        sensitivities(scene, ["loop.slider_pin.frame_a.xyz.x"], overrides)


def test_a_start_at_an_equilibrium_that_is_not_isolated_is_rejected(tmp_path: Path) -> None:
    overrides = {"initial": {"at": "equilibrium"}, "parameters": {"gravity": [0.0, 0.0, 0.0]}, "t_end": 0.1}
    with pytest.raises(NumericalError, match="the equilibrium is not isolated"):
        sensitivities("five_bar/swing", ["link.link_2.mass"], overrides)


EVENT = '[[event]]\nof = "q_dot"\ncoordinate = "x"\nvalue = 0.2\nstop = true\n'


def test_a_rate_event_triggered_by_an_impact_has_the_impacts_time(tmp_path: Path) -> None:
    """Also if no further step follows, and with a force that delays the impact."""
    x, v, stop, pull = 0.25, 1.5, 1.0, -0.8
    for constant in (0.0, pull):
        more = joint("x", restitution=0.6) + (force("x", constant) if constant else "")
        scene = write_sliders(tmp_path / str(constant), more, q=(x, 0.0), q_dot=(v, 0.0), upper=stop, scene=EVENT)
        result = sensitivities(scene, ["initial.q.x", "initial.q_dot.x", "joint.x.restitution"], TIGHT)
        a = constant / 1.3
        t = (stop - x) / v if not a else (-v + np.sqrt(v**2 + 2 * a * (stop - x))) / a
        assert result.run.t[-1] == pytest.approx(t, abs=1e-11)
        assert "by the event" in result.run.message
        assert result.end_time == pytest.approx(np.array([-1.0, -t, 0.0]) / (v + a * t), abs=1e-9)
