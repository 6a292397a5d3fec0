"""Closed-loop linear models against finite differences of eq. 1 with controller, motors and joint friction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from ckc_pin import (
    InputError,
    LinearModel,
    Mechanism,
    Scene,
    SetPoint,
    check,
    gain_locus,
    linearize,
    load,
    load_scene,
    terms,
)
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import Controller
from ckc_pin.dynamics import Terms, dae_acceleration
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.library import mechanism_file
from ckc_pin.native.control import apply_u
from ckc_pin.scene.parts import build_scene_actuation, build_scene_controller
from tests.analytic.five_bar import Array

TARGET = {"theta_1": -1.2, "theta_3": -1.9}
SET_POINT = {"type": "set_point", "K_P": [[9.0, 1.0], [1.0, 7.0]], "K_V": 0.9, "q_d": TARGET}
SLIDES = """
[[joint]]
name = "theta_1"
friction = 0.05
[[joint]]
name = "theta_2"
friction = 0.2
[[joint]]
name = "theta_4"
friction = 0.1
"""
GEARED = """
[[motor]]
name = "sum"
joints = {theta_1 = 1.0, theta_3 = 0.3}
ratio = 3.0
torque_limit = 0.9
[[motor]]
name = "other"
joints = {theta_3 = 1.0, theta_1 = 0.2}
"""


def five_bar_with(folder: Path, more: str, motors: bool = False) -> Mechanism:
    for file in mechanism_file("five_bar").parent.iterdir():
        if file.is_file():
            (folder / file.name).write_bytes(file.read_bytes())
    path = folder / "mechanism.toml"
    lines = [line for line in path.read_text().splitlines() if not (motors and line.startswith("actuated"))]
    path.write_text("\n".join(lines) + more)
    return load(str(path))


def scene_of(folder: Path, controller: dict[str, Any], **keys: Any) -> Scene:
    path = folder / "it.scene.toml"
    path.write_text('mechanism = "mechanism.toml"\nformulation = "reduced"\nt_end = 1.0\n'
                    "initial.q = { theta_1 = -0.9, theta_3 = -1.5 }\n")  # fmt: skip
    return load_scene(path, {"controller": controller, "initial.q_dot": {"theta_1": 0.8, "theta_3": -0.6}, **keys})


def set_point(scene: Scene, mechanism: Mechanism) -> SetPoint:
    law = build_scene_controller(scene, mechanism)
    assert isinstance(law, SetPoint)
    return law


def closed_by_differences(
    model: LinearModel,
    controller: Controller,
    actuation: Actuation,
    extra_force: Callable[[Array], Array] | None = None,
) -> Array:
    """State matrix of the five-bar's closed loop, by differences of eq. 1; `extra_force` is a function of v'."""
    mechanism, d, t = model.mechanism, model.mechanism.d, model.t or 0.0
    start = mechanism.kinematics(mechanism.tree.from_coordinates(model.q_tree))
    q = mechanism.partition.q
    x = np.concatenate([model.q_tree[q], model.v_tree[q]])

    def acceleration(x: Array) -> Array:
        at = sigma(mechanism, x[:d], start).at
        state = Terms(mechanism, at, at.rho @ x[d:])
        force = apply_u(actuation, state, controller.u(t, state)).u_tree
        return dae_acceleration(state, force + (0.0 if extra_force is None else extra_force(state.v_tree)))[q]

    def slope(k: int, h: float) -> Array:
        step = h * np.eye(2 * d)[k]
        return (acceleration(x + step) - acceleration(x - step)) / (2 * h)

    slopes = [(4 * slope(k, 1e-4) - slope(k, 2e-4)) / 3 for k in range(2 * d)]
    return np.vstack([np.hstack([np.zeros((d, d)), np.eye(d)]), np.array(slopes).T])


def agree(ours: Array | None, theirs: Array) -> None:
    assert ours is not None
    assert np.abs(ours - theirs).max() <= 1e-7 * np.abs(theirs).max()


def test_closed_loop_includes_friction_of_sliding_joints(tmp_path: Path) -> None:
    mechanism = five_bar_with(tmp_path, SLIDES)
    scene = scene_of(tmp_path, SET_POINT)
    model = linearize(scene, 0.13)
    controller, actuation = set_point(scene, mechanism), build_scene_actuation(scene, mechanism)
    friction = mechanism.joints.friction
    assert not model.locked
    agree(model.closed_loop, closed_by_differences(model, controller, actuation, lambda v: -friction * np.sign(v)))


@pytest.mark.parametrize("t", [0.0, 0.05])
def test_a_motor_at_its_limit_does_not_respond(t: float) -> None:
    scene = load_scene("five_bar/set_point", {"controller.torque_limit": {"theta_1": 0.2}})
    mechanism = load("five_bar")
    model = linearize(scene, t)
    controller, actuation = set_point(scene, mechanism), build_scene_actuation(scene, mechanism)
    assert abs(model.tau[0]) == 0.2
    agree(model.closed_loop, closed_by_differences(model, controller, actuation))


def test_a_motor_on_several_joints_at_its_limit_does_not_respond(tmp_path: Path) -> None:
    mechanism = five_bar_with(tmp_path, GEARED, motors=True)
    scene = scene_of(tmp_path, SET_POINT)
    controller, actuation = set_point(scene, mechanism), build_scene_actuation(scene, mechanism)
    is_saturated = []
    for t in (0.0, 0.1, 0.3, 0.6):
        model = linearize(scene, t)
        is_saturated.append(abs(model.tau[0]) == 0.9)
        agree(model.closed_loop, closed_by_differences(model, controller, actuation))
    assert set(is_saturated) == {True, False}


def test_a_sticking_joint_is_not_a_state(tmp_path: Path) -> None:
    """Friction stops theta_1, while theta_3 moves on under its motor."""
    mechanism = five_bar_with(tmp_path, '\n[[joint]]\nname = "theta_1"\nfriction = 30.0\n')
    scene = scene_of(tmp_path, SET_POINT)
    model = linearize(scene, 0.4)
    assert model.locked == ("theta_1",)
    assert model.states == ("theta_3", "v.theta_3")
    controller, start = set_point(scene, mechanism), mechanism.kinematics(model.q_tree)
    q = mechanism.partition.q

    def acceleration(x: Array) -> float:
        at = sigma(mechanism, np.array([model.q_tree[0], x[0]]), start).at
        state = Terms(mechanism, at, at.rho @ [0.0, x[1]])
        u = controller.u(0.4, state)
        inertia = state.D[1, 1]  # theta_1 is at rest, so only the second row of eq. 6 remains
        return float((u - state.C_times(state.q_dot) - state.h)[1] / inertia)

    x = np.array([model.q_tree[q[1]], model.v_tree[q[1]]])
    h = 1e-5
    slopes = [(acceleration(x + h * e) - acceleration(x - h * e)) / (2 * h) for e in np.eye(2)]
    agree(model.closed_loop, np.array([[0.0, 1.0], slopes]))


def test_a_set_point_has_a_closed_loop_at_its_target() -> None:
    scene = load_scene("five_bar/set_point")
    model, mechanism = linearize(scene, "target"), load("five_bar")
    assert np.abs(model.q_tree[mechanism.partition.q] - np.pi / 4).max() < 1e-12
    agree(model.closed_loop, closed_by_differences(model, set_point(scene, mechanism), Actuation(mechanism)))
    with pytest.raises(InputError, match=r"five_bar/tracking has no set point"):
        linearize("five_bar/tracking", "target")


def test_a_note_says_that_limited_motors_cannot_hold_the_target() -> None:
    """One motor has half of the required torque, so the loop does not rest at its target."""
    needed = abs(linearize("five_bar/set_point", "target").tau[0])
    scene = load_scene("five_bar/set_point", {"controller.torque_limit": {"theta_1": needed / 2}})
    model, mechanism = linearize(scene, "target"), load("five_bar")
    assert any("not in equilibrium" in note for note in model.notes)
    controller, actuation = set_point(scene, mechanism), build_scene_actuation(scene, mechanism)
    agree(model.closed_loop, closed_by_differences(model, controller, actuation))


def test_open_loops_of_a_drifting_dae_are_rejected() -> None:
    drifts = {"formulation": "dae", "solver": {"projection": False, "rtol": 1e-3}}
    with pytest.raises(InputError, match=r"are open .* set solver\.projection = true"):
        linearize(load_scene("five_bar/swing", drifts), 2.0)


def test_target_and_locus_are_on_the_assembly_branch_of_the_run() -> None:
    """The run starts with the tip above the elbows; the five-bar is assembled with the tip below."""
    start = terms(load("five_bar"), {"theta_1": -1.0, "theta_3": -1.5}).q_tree
    mirrored = start.copy()  # the distal links are mirrored in the line between the elbows
    first, second = (_elbow(load("five_bar"), start, name) for name in ("left", "right"))
    line = np.arctan2(*(second - first)[1::-1])
    mirrored[1] = 2 * line - 2 * start[0] - start[1]
    mirrored[3] = 2 * line - 2 * start[2] - start[3]
    q = dict(zip(load("five_bar").coordinates, mirrored.tolist(), strict=True))
    scene = load_scene("five_bar/set_point", {"controller.q_d": TARGET, "initial": {"q": q}})
    model, result, locus = linearize(scene, "target"), check(scene).stability, gain_locus(scene)
    assembled = linearize(load_scene("five_bar/set_point", {"controller.q_d": TARGET}), "target")
    assert abs(model.q_tree[1] - assembled.q_tree[1]) > 0.1
    assert result is not None
    assert locus is not None
    assert model.closed_loop is not None
    ours = np.sort_complex(np.linalg.eigvals(model.closed_loop))
    assert np.abs(ours - np.sort_complex(result.eigenvalues)).max() < 1e-8 * np.abs(ours).max()
    at_scene_gain = locus.eigenvalues[int(np.argmin(np.abs(locus.factors - 1)))]
    assert np.abs(ours - np.sort_complex(at_scene_gain)).max() < 1e-8 * np.abs(ours).max()


def _elbow(mechanism: Mechanism, q_tree: Array, side: str) -> Array:
    model = mechanism.tree.model
    data = model.createData()
    pin.forwardKinematics(model, data, q_tree)
    return np.array(data.oMi[2 if side == "left" else 4].translation[:2])
