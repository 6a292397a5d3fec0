"""Constraint and joint wrenches along a motion, and the force of dry friction.

The multipliers of a loop, and a spring between frames, act on two bodies each. With these as external wrenches, the
recursive Newton-Euler algorithm computes the wrench that each joint of the tree transmits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import cross

__all__ = ["friction_force", "joint_wrenches", "joint_wrenches_along", "loop_wrenches", "loop_wrenches_along"]

REST_TOLERANCE = 1e-12  # of the fastest coordinate: a smaller velocity is rounding and has no direction


def friction_force(mechanism: Mechanism, v_tree: Array) -> Array:
    """Return the generalized force of dry friction in joints that slide, -friction sign(v'), (n,) or (m, n) as v'.

    It is zero for joints at rest, where friction takes any value up to the largest one and velocity does not tell.
    """
    speed = np.abs(v_tree / mechanism.tree.step_scale)
    slides = speed > REST_TOLERANCE * speed.max(axis=-1, initial=0.0, keepdims=True)
    return np.where(slides, -mechanism.joints.friction * np.sign(v_tree), 0.0)


def loop_wrenches(terms: Terms, multipliers: Array) -> dict[str, Array]:
    """Return the wrench of each loop on the body of its frame A, at the origin of the frame, in world axes.

    Parameters
    ----------
    terms : Terms
    multipliers : (rows,) array
        Multipliers of eq. 1, N or N m.

    Returns
    -------
    dict of str to (6,) array
        Force, N, then moment, N m, by loop. Couplings have none, since they constrain coordinates, not frames.
    """
    return {name: wrench[0] for name, wrench in loop_wrenches_along([terms], multipliers[None]).items()}


def loop_wrenches_along(states: Sequence[Terms], multipliers: Array) -> dict[str, Array]:
    """Return `loop_wrenches` at m states of one mechanism, (m, 6) by loop, from multipliers (m, rows)."""
    mechanism, poses = states[0].mechanism, _Poses(states)
    jacobian, names = _body_jacobians(states), [loop for loop, _ in mechanism.closure.names]
    wrenches = {}
    for loop in mechanism.spec.loop:
        frame, other = (mechanism.frames.find(end, loop.name) for end in (loop.frame_a, loop.frame_b))
        rows = [name == loop.name for name in names]
        # If frame A is in the world, other directions may be fixed there too, so its wrench is minus that on B.
        joint, sign = (frame.joint, 1.0) if frame.joint else (other.joint, -1.0)
        wrench = np.einsum("mr,mrk->mk", sign * multipliers[:, rows], jacobian[:, rows, joint])
        origin = poses.rotation[:, frame.joint] @ frame.translation + poses.translation[:, frame.joint]
        wrenches[loop.name] = _shift_reference(wrench, origin)
    return wrenches


def joint_wrenches(
    terms: Terms, acceleration: Array, multipliers: Array, applied: Array | float = 0.0
) -> dict[str, Array]:
    """Return the wrench that each joint transmits to the body it carries, at the joint's origin, in world axes.

    The component along the axis is the sum of motor, joint spring, damper, friction, gear and rotor inertia. The other
    components are bearing loads. A free root transmits nothing and is left out. Links that the URDF fixes to each other
    are one body.

    Parameters
    ----------
    terms : Terms
    acceleration : (n,) array
        Time derivative of v'.
    multipliers : (rows,) array
        Multipliers of eq. 1, N or N m.
    applied : (joints, 6) array, optional
        Wrenches of other forces on the bodies, in world axes, about the world's origin.

    Returns
    -------
    dict of str to (6,) array
        Force, N, then moment, N m, by joint.
    """
    wrenches = joint_wrenches_along([terms], acceleration[None], multipliers[None], applied)
    return {name: wrench[0] for name, wrench in wrenches.items()}


def joint_wrenches_along(
    states: Sequence[Terms], acceleration: Array, multipliers: Array, applied: Array | float = 0.0
) -> dict[str, Array]:
    """Return `joint_wrenches` at m states of one mechanism, (m, 6) by joint.

    The other arguments are those of `joint_wrenches` at all states: (m, n), (m, rows) and (m, joints, 6) arrays.
    """
    mechanism, poses = states[0].mechanism, _Poses(states)
    tree = mechanism.tree
    external = np.einsum("mr,mrjk->mjk", multipliers, _body_jacobians(states)) + applied
    if mechanism.springs.between_frames:
        external += [mechanism.springs.body_wrenches(terms.at.pose, terms.v_tree) for terms in states]
    in_joints = _rotate(_shift_reference(external, poses.translation), np.swapaxes(poses.rotation, -1, -2))

    def compute_forces(model: Any, data: Any, wrenches: Array, *state: Array) -> list[Array]:
        pin.rnea(model, data, *state, [pin.Force(wrench) for wrench in wrenches])
        return [force.vector for force in data.f]

    transmitted = np.array([
        tree.evaluate(compute_forces, wrenches, terms.q_tree, terms.v_tree, a)
        for terms, wrenches, a in zip(states, in_joints, acceleration, strict=True)
    ])  # fmt: skip
    in_world = _rotate(transmitted, poses.rotation)
    joints = zip(list(tree.model.names), list(tree.model.joints), strict=True)
    return {name: in_world[:, k] for k, (name, joint) in enumerate(joints) if k and joint.nv == 1}


class _Poses:
    """Poses of the bodies at m states: rotations (m, joints, 3, 3) and translations (m, joints, 3)."""

    def __init__(self, states: Sequence[Terms]) -> None:
        self.rotation = np.array([terms.at.pose.rotation for terms in states])
        self.translation = np.array([terms.at.pose.translation for terms in states])


def _body_jacobians(states: Sequence[Terms]) -> Array:
    """Return `Kinematics.body_jacobian` at m states, shape (m, rows, joints, 6)."""
    return np.array([terms.at.body_jacobian for terms in states])


def _shift_reference(wrenches: Array, points: Array) -> Array:
    """Convert wrenches (..., 6) about the world's origin to wrenches about points (..., 3)."""
    return np.concatenate([wrenches[..., :3], wrenches[..., 3:] - cross(points, wrenches[..., :3])], axis=-1)


def _rotate(wrenches: Array, rotation: Array) -> Array:
    """Rotate wrenches (..., 6) by matrices (..., 3, 3)."""
    force, moment = rotation @ wrenches[..., :3, None], rotation @ wrenches[..., 3:, None]
    return np.concatenate([force, moment], axis=-2)[..., 0]
