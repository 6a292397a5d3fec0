"""Joint and loop wrenches of random closed mechanisms: each body satisfies the Newton-Euler equations."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from ckc_pin.dynamics import (
    Terms,
    dae_acceleration,
    friction_force,
    joint_wrenches,
    loop_wrenches,
    multipliers,
    tree_force,
)
from tests.analytic.five_bar import Array
from tests.conftest import assert_close
from tests.property.mechanisms import SPRINGS, Closed
from tests.property.test_dynamics import every_mechanism

many = settings(max_examples=25)


def random_motion(closed: Closed) -> tuple[Terms, Array, Array, Array]:
    """Return a state with rotors in the joints, random joint forces u', the acceleration and the multipliers."""
    mechanism, random = closed.mechanism, closed.world.random
    jointed = np.array([name not in mechanism.tree.free_coordinates for name in mechanism.coordinates])
    mechanism.tree.model.armature = np.where(jointed, random.uniform(0, 0.5, mechanism.n), 0.0)
    terms, u_tree = closed.random_state(), np.where(jointed, closed.u_tree(), 0.0)
    acceleration = dae_acceleration(terms, u_tree)
    return terms, u_tree, acceleration, multipliers(terms, u_tree, acceleration)


def wrench_at_origin(force: Array, point: Array) -> Array:
    """Return the wrench about the world's origin of a force at a point."""
    return np.concatenate([force, np.cross(point, force)])


@many
@given(every_mechanism)
def test_every_body_obeys_newton_and_euler(closed: Closed) -> None:
    """Rates of momentum and weights are computed by Pinocchio; springs act on the line between their ends."""
    terms, _, acceleration, forces = random_motion(closed)
    mechanism, model = closed.mechanism, closed.mechanism.tree.model
    data = model.createData()
    pin.forwardKinematics(model, data, terms.q_tree, terms.v_tree, acceleration)
    residual = np.zeros((model.njoints, 6))
    for k in range(1, model.njoints):
        inertia, motion = model.inertias[k], data.v[k]
        rate = data.oMi[k].act(inertia * data.a[k] + motion.cross(inertia * motion))
        centre = data.oMi[k].act(inertia.lever)
        residual[k] = wrench_at_origin(inertia.mass * model.gravity.linear, centre) - np.array(rate.vector)
    for name, wrench in joint_wrenches(terms, acceleration, forces).items():
        k = model.getJointId(name)
        about_origin = wrench + np.concatenate([np.zeros(3), np.cross(data.oMi[k].translation, wrench[:3])])
        residual[k] += about_origin
        residual[model.parents[k]] -= about_origin
    for loop in mechanism.spec.loop:
        a, b = (mechanism.frames.find(frame, loop.name) for frame in (loop.frame_a, loop.frame_b))
        wrench = loop_wrenches(terms, forces)[loop.name]
        about_origin = wrench + np.concatenate(
            [np.zeros(3), np.cross(data.oMi[a.joint].act(a.translation), wrench[:3])]
        )
        residual[a.joint] += about_origin
        residual[b.joint] -= about_origin
    for spring in SPRINGS:
        if spring.frame_a is None or spring.frame_b is None:
            continue
        ends = [mechanism.frames.find(frame, "spring") for frame in (spring.frame_a, spring.frame_b)]
        places = [data.oMi[end.joint].act(end.translation) for end in ends]
        turning = [data.oMi[end.joint].act(data.v[end.joint]) for end in ends]  # about the world's origin
        speeds = [v.linear + np.cross(v.angular, place) for v, place in zip(turning, places, strict=True)]
        length = np.linalg.norm(places[0] - places[1])
        direction = (places[0] - places[1]) / length
        pull = spring.stiffness * (length - (spring.rest_length or 0.0)) + spring.damping * direction @ (
            speeds[0] - speeds[1]
        )
        for sign, end, place in zip((-1.0, 1.0), ends, places, strict=True):
            residual[end.joint] += wrench_at_origin(sign * pull * direction, place)
    largest = max(np.abs(forces).max(initial=0.0), np.abs(terms.bias_tree).max(), 1.0)
    assert_close(residual[1:], 0, 1e-10 * largest)


@many
@given(every_mechanism)
def test_axial_joint_wrench_is_the_actuator_and_passive_torque(closed: Closed) -> None:
    """It has actuator torque, joint spring, damper and coupling, less the torque that accelerates the rotor."""
    terms, u_tree, acceleration, forces = random_motion(closed)
    mechanism, tree = closed.mechanism, closed.mechanism.tree
    expected = u_tree - tree.model.armature * acceleration - tree.model.damping * terms.v_tree
    numbers = tree.to_coordinates(terms.q_tree)
    for spring in SPRINGS:
        if spring.joint is not None:
            at = tree.index[spring.joint]
            expected[at] -= spring.stiffness * (numbers[at] - (spring.rest or 0.0)) + spring.damping * terms.v_tree[at]
    gear = forces[[label for _, label in mechanism.closure.names].index("coupling")]
    expected[tree.index["a_j1"]] += gear
    expected[tree.index["b_j4"]] -= 0.7 * gear
    wrenches = joint_wrenches(terms, acceleration, forces)
    assert set(wrenches) == set(mechanism.coordinates) - tree.free_coordinates
    for name, wrench in wrenches.items():
        joint = tree.model.getJointId(name)
        axis, turns = tree.axis(joint)
        vector = wrench[3:] if turns else wrench[:3]
        component = float(vector @ (terms.at.pose.rotation[joint] @ axis))
        scale = max(1.0, np.abs(expected).max(), np.abs(forces).max())
        assert_close(component, expected[tree.index[name]], 1e-10 * scale)


@many
@given(every_mechanism)
def test_multipliers_of_the_motion_balance_the_tree(closed: Closed) -> None:
    terms, u_tree, acceleration, forces = random_motion(closed)
    needed = tree_force(terms, acceleration)
    assert_close(needed, u_tree + terms.at.J.T @ forces, 1e-9 * max(1.0, np.abs(needed).max()))


@many
@given(every_mechanism, st.floats(0.1, 5.0))
def test_friction_opposes_sliding_and_is_zero_at_rest(closed: Closed, size: float) -> None:
    mechanism, random = closed.mechanism, closed.world.random
    mechanism.joints.friction = size * random.uniform(0, 1, mechanism.n)
    v_tree = random.uniform(-1, 1, mechanism.n)
    v_tree[0] = 0.0
    computed = friction_force(mechanism, v_tree)
    assert computed[0] == 0
    assert_close(computed[1:], np.where(v_tree[1:] > 0, -1, 1) * mechanism.joints.friction[1:], 0)
    assert_close(friction_force(mechanism, np.zeros(mechanism.n)), 0, 0)
