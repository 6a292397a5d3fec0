"""What joints and loops transmit in any closed mechanism: each body obeys Newton and Euler with what acts on it."""

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


def moving(closed: Closed) -> tuple[Terms, Array, Array, Array]:
    """A state with rotors in the joints, random efforts u' in all of them, the acceleration and the multipliers."""
    mechanism, random = closed.mechanism, closed.world.random
    jointed = np.array([name not in mechanism.tree.free_coordinates for name in mechanism.coordinates])
    mechanism.tree.model.armature = np.where(jointed, random.uniform(0, 0.5, mechanism.n), 0.0)
    terms, u_tree = closed.near(), np.where(jointed, closed.u_tree(), 0.0)
    acceleration = dae_acceleration(terms, u_tree)
    return terms, u_tree, acceleration, multipliers(terms, u_tree, acceleration)


def placed(force: Array, point: Array) -> Array:
    """A force at a point as a wrench about the world's origin."""
    return np.concatenate([force, np.cross(point, force)])


@many
@given(every_mechanism)
def test_every_body_obeys_newton_and_euler(closed: Closed) -> None:
    """The rates of momentum and the weights are Pinocchio's; springs pull along the line between their ends."""
    terms, _, acceleration, forces = moving(closed)
    mechanism, model = closed.mechanism, closed.mechanism.tree.model
    data = model.createData()
    pin.forwardKinematics(model, data, terms.q_tree, terms.v_tree, acceleration)
    left = np.zeros((model.njoints, 6))
    for k in range(1, model.njoints):
        inertia, motion = model.inertias[k], data.v[k]
        rate = data.oMi[k].act(inertia * data.a[k] + motion.cross(inertia * motion))
        centre = data.oMi[k].act(inertia.lever)
        left[k] = placed(inertia.mass * model.gravity.linear, centre) - np.array(rate.vector)
    for name, wrench in joint_wrenches(terms, acceleration, forces).items():
        k = model.getJointId(name)
        own = wrench + np.concatenate([np.zeros(3), np.cross(data.oMi[k].translation, wrench[:3])])
        left[k] += own
        left[model.parents[k]] -= own
    for loop in mechanism.spec.loop:
        a, b = (mechanism.frames.find(frame, loop.name) for frame in (loop.frame_a, loop.frame_b))
        wrench = loop_wrenches(terms, forces)[loop.name]
        own = wrench + np.concatenate([np.zeros(3), np.cross(data.oMi[a.joint].act(a.translation), wrench[:3])])
        left[a.joint] += own
        left[b.joint] -= own
    for spring in SPRINGS:
        if spring.frame_a is None or spring.frame_b is None:
            continue
        ends = [mechanism.frames.find(frame, "spring") for frame in (spring.frame_a, spring.frame_b)]
        places = [data.oMi[end.joint].act(end.translation) for end in ends]
        turning = [data.oMi[end.joint].act(data.v[end.joint]) for end in ends]  # about the world's origin
        speeds = [v.linear + np.cross(v.angular, place) for v, place in zip(turning, places, strict=True)]
        length = np.linalg.norm(places[0] - places[1])
        along = (places[0] - places[1]) / length
        pull = spring.stiffness * (length - (spring.rest_length or 0.0)) + spring.damping * along @ (
            speeds[0] - speeds[1]
        )
        for sign, end, place in zip((-1.0, 1.0), ends, places, strict=True):
            left[end.joint] += placed(sign * pull * along, place)
    largest = max(np.abs(forces).max(initial=0.0), np.abs(terms.bias_tree).max(), 1.0)
    assert_close(left[1:], 0, 1e-10 * largest)


@many
@given(every_mechanism)
def test_axial_joint_wrench_is_the_actuator_and_passive_torque(closed: Closed) -> None:
    """Effort, joint spring and damper, coupling; the rotor takes its share of the effort for itself."""
    terms, u_tree, acceleration, forces = moving(closed)
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
        along = wrench[3:] if turns else wrench[:3]
        own = float(along @ (terms.at.pose.rotation[joint] @ axis))
        assert_close(own, expected[tree.index[name]], 1e-10 * max(1.0, np.abs(expected).max(), np.abs(forces).max()))


@many
@given(every_mechanism)
def test_multipliers_of_the_motion_balance_the_tree(closed: Closed) -> None:
    terms, u_tree, acceleration, forces = moving(closed)
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
