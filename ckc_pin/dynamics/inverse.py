"""Constraint and joint wrenches along a motion, and the force of dry friction.

The multipliers of a loop, and a spring between frames, act on two bodies each. With these as external wrenches, the
recursive Newton-Euler algorithm computes the wrench that each joint of the tree transmits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose, cross

__all__ = ["friction_force", "joint_wrenches", "loop_wrenches"]

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
    mechanism, pose = terms.mechanism, terms.at.pose
    jacobian, names = terms.at.body_jacobian, [loop for loop, _ in mechanism.closure.names]
    wrenches = {}
    for loop in mechanism.spec.loop:
        frame, other = (mechanism.frames.find(end, loop.name) for end in (loop.frame_a, loop.frame_b))
        rows = [name == loop.name for name in names]
        # If frame A is in the world, other directions may be fixed there too, so its wrench is minus that on B.
        wrench = multipliers[rows] @ (jacobian[rows, frame.joint] if frame.joint else -jacobian[rows, other.joint])
        origin = pose.rotation[frame.joint] @ frame.translation + pose.translation[frame.joint]
        wrenches[loop.name] = _shift_reference(wrench[None], origin[None])[0]
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
    mechanism, pose = terms.mechanism, terms.at.pose
    tree = mechanism.tree
    external = np.einsum("r,rjk->jk", multipliers, terms.at.body_jacobian)
    external += mechanism.springs.body_wrenches(pose, terms.v_tree) + applied
    in_joints = _rotate(_shift_reference(external, pose.translation), pose, to_world=False)

    def compute_forces(model: Any, data: Any, *state: Array) -> list[Array]:
        pin.rnea(model, data, *state, [pin.Force(wrench) for wrench in in_joints])
        return [np.array(force.vector) for force in data.f]

    wrenches = _rotate(tree.evaluate(compute_forces, terms.q_tree, terms.v_tree, acceleration), pose, to_world=True)
    joints = zip(list(tree.model.names), list(tree.model.joints), wrenches, strict=True)
    return {name: wrench for name, joint, wrench in list(joints)[1:] if joint.nv == 1}


def _shift_reference(wrenches: Array, points: Array) -> Array:
    """Convert wrenches (k, 6) about the world's origin to wrenches about points (k, 3)."""
    return np.hstack([wrenches[:, :3], wrenches[:, 3:] - cross(points, wrenches[:, :3])])


def _rotate(wrenches: Array, pose: Pose, *, to_world: bool) -> Array:
    """Rotate wrenches (joints, 6) from world axes to the axes of each joint, or back."""
    rotation = pose.rotation if to_world else np.swapaxes(pose.rotation, 1, 2)
    return np.concatenate([rotation @ wrenches[:, :3, None], rotation @ wrenches[:, 3:, None]], axis=1)[:, :, 0]
