"""Inverse dynamics against the paper's appendix, free bodies in absolute coordinates, and closed forms."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import ckc_pin
from ckc_pin import inverse_dynamics
from ckc_pin.mechanism.library import library
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR, Array, FiveBar, desired
from tests.conftest import assert_close

# --- the paper's appendix --------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "reference"), [("five_bar", FIVE_BAR), ("five_bar_as_printed", AS_PRINTED)])
def test_five_bar_along_eq_21(name: str, reference: FiveBar) -> None:
    motion = inverse_dynamics(f"{name}/tracking", {"t_end": 4.3})
    assert motion.status == "done"
    assert len(motion.t) > 100
    for k, t in enumerate(motion.t):
        q_d, q_d_dot, q_d_ddot = desired(t)
        q_tree = reference.sigma(q_d)
        v_tree = reference.rho(q_tree) @ q_d_dot
        tau = reference.D(q_tree) @ q_d_ddot + reference.C(q_tree, v_tree) @ q_d_dot + reference.h(q_tree)
        acceleration, forces = reference.acceleration_and_multipliers(q_tree, v_tree, tau)
        assert_close(np.angle(np.exp(1j * (motion.q_tree[k] - q_tree))), 0, 1e-11)
        scale = np.abs(acceleration).max()
        assert_close(motion.v_tree[k], v_tree, 1e-9 * max(1.0, scale))
        assert_close(motion.a_tree[k], acceleration, 1e-9 * max(1.0, scale))
        assert_close(motion.tau[k], tau, 1e-9 * max(1.0, np.abs(tau).max()))
        assert_close(motion.loop_forces["elbow"][k], forces, 1e-9 * max(1.0, np.abs(forces).max()))
        assert_close(motion.loop_wrenches["elbow"][k], [*forces, 0, 0, 0, 0], 1e-9 * max(1.0, np.abs(forces).max()))


def test_inverse_dynamics_returns_the_torques_of_a_run(run) -> None:
    """Accelerations equal those of the appendix and derivatives of the rates."""
    recorded = run("five_bar/tracking", formulation="reduced", solver__rtol=1e-10)
    motion = inverse_dynamics(recorded)
    assert_close(motion.tau, recorded.tau, 1e-10)
    assert_close(motion.loop_forces["elbow"], recorded.loop_forces()["elbow"], 1e-10)
    for k in range(0, len(motion.t), 7):
        theirs = FIVE_BAR.acceleration_and_multipliers(motion.q_tree[k], motion.v_tree[k], recorded.u[k])
        assert_close(motion.a_tree[k], theirs[0], 1e-9)
        assert_close(motion.loop_forces["elbow"][k], theirs[1], 1e-9)
    late = recorded.t > 3.0
    slopes = make_interp_spline(recorded.t[late], recorded.v_tree[late], k=5).derivative()(recorded.t[late])
    assert_close(slopes[5:-5], motion.a_tree[late][5:-5], 1e-6)


# --- a four-bar as three free bodies ---------------------------------------------------------------

GROUND, CRANK, COUPLER, ROCKER = 1.1, 0.5, 1.2, 0.75  # m
MASS = np.array([0.5, 1.0, 0.75])
LENGTH = np.array([CRANK, COUPLER, ROCKER])
INERTIA = MASS * (LENGTH**2 + 0.04**2) / 12  # about the centres
START = np.array([0.0, 0.0, GROUND])  # x of the fixed pins


def direction(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def normal(angle: float) -> Array:
    return np.array([-np.sin(angle), np.cos(angle)])


def bars(crank: float, rate: float, acceleration: float) -> tuple[Array, Array, Array]:
    """Return absolute angles, rates and accelerations of crank, coupler and rocker, from intersecting circles."""
    elbow = CRANK * direction(crank)
    line = np.array([GROUND, 0.0]) - elbow
    distance = np.linalg.norm(line)
    middle = (distance**2 + COUPLER**2 - ROCKER**2) / (2 * distance)
    pin = elbow + (middle * line + np.sqrt(COUPLER**2 - middle**2) * np.array([-line[1], line[0]])) / distance
    angle = np.array([crank, np.arctan2(*(pin - elbow)[::-1]), np.arctan2(*(pin - [GROUND, 0])[::-1])])
    matrix = np.array([COUPLER * normal(angle[1]), -ROCKER * normal(angle[2])]).T
    rates = np.append(rate, np.linalg.solve(matrix, -CRANK * rate * normal(crank)))
    signed = np.array([CRANK, COUPLER, -ROCKER])
    inward = sum(length * w**2 * direction(a) for length, w, a in zip(signed, rates, angle, strict=True))
    rest = np.linalg.solve(matrix, inward - CRANK * acceleration * normal(crank))
    return angle, rates, np.append(acceleration, rest)


def free_bodies(crank: float, rate: float, acceleration: float) -> tuple[float, Array]:
    """Return the crank's torque and the forces of the pins: at ground, elbow, coupler pin, and at ground again.

    The Newton-Euler equations of three bodies are nine equations for nine unknowns: four pin forces and the torque.
    """
    angle, rates, accelerations = bars(crank, rate, acceleration)

    def centre(body: int) -> Array:
        """Return the acceleration of a body's centre relative to its first pin."""
        return (
            LENGTH[body] / 2 * (accelerations[body] * normal(angle[body]) - rates[body] ** 2 * direction(angle[body]))
        )

    elbow = 2 * centre(0)
    a_centre = [centre(0), elbow + centre(1), centre(2)]
    matrix, right = np.zeros((9, 9)), np.zeros(9)
    # pin, body, whether at its first end, sign
    acts = [(0, 0, True, 1), (1, 1, True, 1), (1, 0, False, -1), (2, 1, False, 1), (2, 2, False, -1), (3, 2, True, 1)]
    for pin, body, first, sign in acts:
        lever = (-0.5 if first else 0.5) * LENGTH[body] * direction(angle[body])
        matrix[3 * body : 3 * body + 2, 2 * pin : 2 * pin + 2] += sign * np.eye(2)
        matrix[3 * body + 2, 2 * pin : 2 * pin + 2] += sign * np.array([-lever[1], lever[0]])
    matrix[2, 8] = 1.0
    for body in range(3):
        right[3 * body : 3 * body + 2] = MASS[body] * (a_centre[body] + np.array([0.0, 9.81]))
        right[3 * body + 2] = INERTIA[body] * accelerations[body]
    solution = np.linalg.solve(matrix, right)
    return float(solution[8]), solution[:8].reshape(4, 2)


def test_four_bar_as_free_bodies() -> None:
    """The crank turns twice at a varying rate. Torque and forces of all pins are compared."""
    rate = 5.0
    desired_crank = {"offset": np.pi / 2, "harmonics": [[2.9, 2.0, 0.0], [0.4, rate, 0.3]]}
    controller = {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": {"crank": desired_crank}}
    motion = inverse_dynamics("four_bar/turning", {"controller": controller})
    assert motion.status == "done"
    for k, t in enumerate(motion.t):
        crank = np.pi / 2 + 2.9 * np.sin(2 * t) + 0.4 * np.sin(rate * t + 0.3)
        crank_dot = 5.8 * np.cos(2 * t) + 0.4 * rate * np.cos(rate * t + 0.3)
        crank_ddot = -11.6 * np.sin(2 * t) - 0.4 * rate**2 * np.sin(rate * t + 0.3)
        tau, pins = free_bodies(crank, crank_dot, crank_ddot)
        scale = max(1.0, np.abs(pins).max())
        assert_close(motion.tau[k], [tau], 1e-10 * scale)
        names = ["crank", "coupler", "rocker"]
        for joint, force in zip(names, pins[[0, 1, 3]], strict=True):
            assert_close(motion.joint_forces[joint][k, :2], force, 1e-10 * scale)
        assert_close(motion.joint_forces["crank"][k, 5], tau, 1e-10 * scale)
        for joint in names:
            assert_close(motion.joint_forces[joint][k, 2:5], 0, 1e-10 * scale)
        assert_close(motion.loop_wrenches["coupler_pin"][k], [*pins[2], 0, 0, 0, 0], 1e-10 * scale)


def test_a_rocker_at_dead_centre_cannot_drive(tmp_path: Path) -> None:
    """Crank and coupler are in line at t = 0.5 s. Until then the torque is the crank's over the ratio of rates."""
    in_line = CRANK + COUPLER
    dead = np.arccos((in_line**2 + GROUND**2 - ROCKER**2) / (2 * in_line * GROUND))
    shutil.copytree(library() / "four_bar", tmp_path / "bar")
    driven = tmp_path / "bar" / "mechanism.toml"
    driven.write_text(driven.read_text().replace("[q_guess]", 'actuated = ["rocker"]\n\n[q_guess]'))
    desired_crank = {"offset": dead, "harmonics": [[0.3, np.pi, -np.pi / 2]]}
    controller = {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": {"crank": desired_crank}}
    overrides = {"controller": controller, "t_end": 1.0, "solver.output_dt": 0.1}
    motion = inverse_dynamics(tmp_path / "bar" / "turning.scene.toml", overrides)
    assert motion.status == "stopped"
    assert "the motion along" in motion.message
    assert "held by no actuator at t = 0.5 s" in motion.message
    assert_close(motion.t, [0.0, 0.1, 0.2, 0.3, 0.4], 1e-15)
    crank = inverse_dynamics("four_bar/turning", overrides)
    assert crank.status == "done"
    assert_close(crank.a_tree[:5], motion.a_tree, 1e-12)
    for k, t in enumerate(motion.t):
        phase = np.pi * t - np.pi / 2
        rates = bars(dead + 0.3 * np.sin(phase), 1.0, 0.0)[1]
        assert_close(motion.tau[k], crank.tau[k] / rates[2], 1e-9 * abs(motion.tau[k, 0]))


def test_a_rod_to_the_world_has_equal_and_opposite_wrenches(tmp_path: Path) -> None:
    """The rocker is a massless rod, with either end first; the forces at its ends are opposite."""
    forces = []
    for world_first in (True, False):
        folder = tmp_path / str(world_first)
        shutil.copytree(library() / "four_bar", folder)
        text = (folder / "mechanism.toml").read_text().partition("[[loop]]")[0].replace("rocker = 1.6\n", "")
        ends = ['{link = "world", xyz = [1.1, 0.0, 0.0]}', '{link = "coupler_link", xyz = [1.2, 0.0, 0.0]}']
        a, b = ends if world_first else ends[::-1]
        loop = f'[[loop]]\nname = "rod"\ntype = "distance"\nlength = 0.75\nframe_a = {a}\nframe_b = {b}\n'
        (folder / "mechanism.toml").write_text(text.replace('["crank"]', '["crank", "rocker"]') + loop)
        quiet = {"harmonics": [[0.4, 5.0, 0.0]]}
        desired_crank = {"offset": np.pi / 2, "harmonics": [[0.4, 5.0, 0.0]]}
        controller = {
            "type": "tracking",
            "Lambda": 1.0,
            "K_D": 1.0,
            "desired": {"crank": desired_crank, "rocker": quiet},
        }
        initial = {"at": "assembled"}
        overrides = {"controller": controller, "initial": initial, "t_end": 0.5, "solver.output_dt": 0.05}
        forces.append(inverse_dynamics(folder / "turning.scene.toml", overrides))
    on_world, on_coupler = (motion.loop_wrenches["rod"] for motion in forces)
    assert_close(on_world[:, :3], -on_coupler[:, :3], 1e-11)
    assert_close(on_world[:, 3:], 0, 1e-11)
    assert_close(on_coupler[:, 3:], 0, 1e-11)
    mechanism = forces[0].mechanism
    for k, q in enumerate(forces[0].q_tree):
        coupler = mechanism.frames.find(mechanism.spec.loop[0].frame_b, "rod")
        at = mechanism.kinematics(q).pose
        rod = at.rotation[coupler.joint] @ coupler.translation + at.translation[coupler.joint] - [1.1, 0, 0]
        assert_close(np.linalg.norm(rod), 0.75, 1e-12)
        pull = forces[0].loop_forces["rod"][k, 0]
        assert_close(on_coupler[k, :3], pull * rod / 0.75, 1e-10 * max(1.0, abs(pull)))


# --- closed forms ----------------------------------------------------------------------------------

LIFT = """<robot name="lift">
  <link name="ground"/>
  <link name="block"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="ground"/><child link="block"/><axis xyz="0 0 1"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
</robot>
"""
MECHANISM = """name = "lift"
urdf = "lift.urdf"
[[joint]]
name = "slide"
armature = 0.5
damping = 3.0
friction = 4.0
[[spring]]
joint = "slide"
stiffness = 30.0
rest = 0.1
"""
SCENE = """mechanism = "mechanism.toml"
formulation = "reduced"
t_end = 2.0
[initial]
at = "assembled"
[controller]
type = "tracking"
Lambda = 1.0
K_D = 1.0
torque_limit = 24.0
[controller.desired.slide]
harmonics = [[0.4, 3.0, 0.2]]
"""


def lift(folder: Path) -> Path:
    """Write a block on a vertical slide with rotor, damper, friction and spring; return the scene."""
    for name, text in (("lift.urdf", LIFT), ("mechanism.toml", MECHANISM), ("up.scene.toml", SCENE)):
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "up.scene.toml"


def test_block_with_rotor_damper_friction_and_spring(tmp_path: Path) -> None:
    """The motor also accelerates the rotor; the rail transmits the moments."""
    motion = inverse_dynamics(lift(tmp_path))
    x, v, a = (
        0.4 * np.sin(3 * motion.t + 0.2),
        1.2 * np.cos(3 * motion.t + 0.2),
        -3.6 * np.sin(3 * motion.t + 0.2),
    )
    tau = 2.5 * a + 3.0 * v + 4.0 * np.sign(v) + 30.0 * (x - 0.1) + 2.0 * 9.81
    assert_close(motion.tau[:, 0], tau, 1e-12 * np.abs(tau).max())
    lifted = 2.0 * (a + 9.81)
    none = np.zeros_like(a)
    rail = np.array([none, none, lifted, 0.2 * lifted, -0.1 * lifted, none]).T
    assert_close(motion.joint_forces["slide"], rail, 1e-12 * np.abs(lifted).max())
    beyond = np.abs(tau) > 24.0
    assert 0 < beyond.sum() < len(tau)
    peak = int(np.argmax(np.abs(tau)))
    (entry,) = motion.exceeded
    assert entry["motor"] == "slide"
    assert (entry["limit"], entry["t"], entry["t_most"]) == (24.0, motion.t[np.argmax(beyond)], motion.t[peak])
    assert entry["most"] == pytest.approx(abs(tau[peak]), rel=1e-12)


def test_limit_with_two_sides_is_exceeded_on_one(tmp_path: Path) -> None:
    scene = lift(tmp_path)
    free = inverse_dynamics(scene, {"gravity.z": 0.0, "controller.torque_limit": 1e3}).tau[:, 0]
    assert free.min() < -1.0
    motion = inverse_dynamics(scene, {"gravity.z": 0.0, "controller.torque_limit": [2 * free.min(), 0.8 * free.max()]})
    (entry,) = motion.exceeded
    assert (entry["limit"], entry["most"]) == (pytest.approx(0.8 * free.max()), free.max())
    motion = inverse_dynamics(scene, {"gravity.z": 0.0, "controller.torque_limit": [free.min() / 2, 2 * free.max()]})
    (entry,) = motion.exceeded
    assert (entry["limit"], entry["most"]) == (pytest.approx(-free.min() / 2), -free.min())
    assert entry["t"] == motion.t[np.argmax(free < free.min() / 2)]
    assert "limits" in str(motion)


def test_recorded_motion_with_friction(tmp_path: Path) -> None:
    """The block slides and sticks; the rail force does not depend on friction."""
    overrides = {"controller.K_D": 10.0, "t_end": 3.0, "controller.torque_limit": 60.0}
    recorded = ckc_pin.simulate(lift(tmp_path), overrides)
    assert {event["name"] for event in recorded.events} == {"slide slides", "slide sticks"}
    motion = inverse_dynamics(recorded)
    assert_close(motion.tau, recorded.tau, 1e-12)
    x, v, tau = recorded.q_tree[:, 0], recorded.v_tree[:, 0], recorded.tau[:, 0]
    rests = np.abs(v) < 1e-12
    assert 0 < rests.sum() < len(v)
    a = np.where(rests, 0.0, (tau - 3.0 * v - 4.0 * np.sign(v) - 30.0 * (x - 0.1) - 2.0 * 9.81) / 2.5)
    a[0] = motion.a_tree[0, 0]  # released from rest
    assert_close(motion.a_tree[:, 0], a, 1e-10)
    assert_close(motion.joint_forces["slide"][:, 2], 2.0 * (a + 9.81), 1e-10)


def test_friction_of_joints_at_rest_is_zero(tmp_path: Path) -> None:
    scene = lift(tmp_path)
    motion = inverse_dynamics(scene, {"controller.desired.slide.harmonics": []})
    assert_close(motion.tau, 2 * 9.81 - 3.0, 1e-12)


def test_inverse_dynamics_of_a_set_point_holds_the_target() -> None:
    motion = inverse_dynamics("five_bar/set_point")
    q_d = np.array([motion.q_tree[0, 0], motion.q_tree[0, 2]])
    assert_close(motion.q_tree, np.tile(motion.q_tree[0], (len(motion.t), 1)), 1e-12)
    assert_close(motion.v_tree, 0, 0)
    assert_close(motion.tau, np.tile(FIVE_BAR.h(FIVE_BAR.sigma(q_d)), (len(motion.t), 1)), 1e-11)


def test_inverse_dynamics_keeps_the_preload_of_a_run() -> None:
    """The recorded torques include a preload of two arms, so they are not minimum-norm; they are reproduced."""
    recorded = ckc_pin.simulate("two_ur5/lift", {"t_end": 0.05, "solver.output_dt": 0.01})
    mechanism = recorded.mechanism
    at = mechanism.kinematics(mechanism.tree.from_coordinates(recorded.q_tree[0]))
    transmission = (mechanism.motors.transmission @ at.rho).T
    strain = np.linalg.svd(transmission)[2][-1]
    assert_close(transmission @ strain, 0, 1e-12)
    strained = replace(recorded, tau=recorded.tau + 5.0 * strain)
    first, second = inverse_dynamics(recorded), inverse_dynamics(strained)
    assert_close(first.tau, recorded.tau, 1e-9)
    assert_close(second.tau[0], recorded.tau[0] + 5.0 * strain, 1e-9)
    assert_close(second.a_tree[0], first.a_tree[0], 1e-8)
    assert np.abs(second.loop_wrenches["left_grip"][0] - first.loop_wrenches["left_grip"][0]).max() > 1.0
