"""What holds a motion together: friction along it, the wrenches of loops on bodies, the wrenches in joints.

The tree carries every force of eq. 1 in its joints. A loop's multipliers and a spring between frames act on two bodies
each; with those as outer wrenches Newton and Euler's equations, body by body from the tips to the root, give what each
joint transmits.
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

AT_REST = 1e-12  # of the fastest coordinate: a velocity that is rounding has no direction


def friction_force(mechanism: Mechanism, v_tree: Array) -> Array:
    """Generalized force of dry friction in joints that slide, -friction sign(v'), shape (n,).

    Zero where a joint rests: what friction does there no velocity tells, anything up to its largest force.
    """
    speed = np.abs(v_tree / mechanism.tree.step_scale)
    slides = speed > AT_REST * speed.max(initial=0.0)
    return np.where(slides, -mechanism.joints.friction * np.sign(v_tree), 0.0)


def loop_wrenches(terms: Terms, multipliers: Array) -> dict[str, Array]:
    """What each loop does to the body of its frame A, at that frame's origin, in world axes.

    Parameters
    ----------
    terms : Terms
    multipliers : (rows,) array
        Of eq. 1, N or N m.

    Returns
    -------
    dict of str to (6,) array
        Force, N, then moment, N m. Couplings have none: they hold coordinates, not frames.
    """
    mechanism, pose = terms.mechanism, terms.at.pose
    jacobian, names = mechanism.closure.body_jacobian(pose), [loop for loop, _ in mechanism.closure.names]
    found = {}
    for loop in mechanism.spec.loop:
        frame, other = (mechanism.frames.find(end, loop.name) for end in (loop.frame_a, loop.frame_b))
        own = [name == loop.name for name in names]
        # the world, where it is frame A's, may hold directions of rows besides: it takes what B does not
        wrench = multipliers[own] @ (jacobian[own, frame.joint] if frame.joint else -jacobian[own, other.joint])
        origin = pose.rotation[frame.joint] @ frame.translation + pose.translation[frame.joint]
        found[loop.name] = _moved(wrench[None], origin[None])[0]
    return found


def joint_wrenches(terms: Terms, acceleration: Array, multipliers: Array) -> dict[str, Array]:
    """What each joint transmits to the body that it carries, at the joint's origin, in world axes.

    All of it: along the joint's axis that is what motor, joint spring, damper, friction, gear and rotor inertia do
    there, across it what the bearing holds. A free root transmits nothing and is left out; links that the URDF
    fixes to each other are one body.

    Parameters
    ----------
    terms : Terms
    acceleration : (n,) array
        Rate of v'.
    multipliers : (rows,) array
        Of eq. 1, N or N m.

    Returns
    -------
    dict of str to (6,) array
        Force, N, then moment, N m, by joint.
    """
    mechanism, pose = terms.mechanism, terms.at.pose
    tree = mechanism.tree
    outer = np.einsum("r,rjk->jk", multipliers, mechanism.closure.body_jacobian(pose))
    outer += mechanism.springs.body_wrenches(pose, terms.v_tree)
    own = _turned(_moved(outer, pose.translation), pose, to_world=False)

    def transmitted(model: Any, data: Any, *state: Array) -> list[Array]:
        pin.rnea(model, data, *state, [pin.Force(wrench) for wrench in own])
        return [np.array(force.vector) for force in data.f]

    wrenches = _turned(tree.evaluate(transmitted, terms.q_tree, terms.v_tree, acceleration), pose, to_world=True)
    joints = zip(list(tree.model.names), list(tree.model.joints), wrenches, strict=True)
    return {name: wrench for name, joint, wrench in list(joints)[1:] if joint.nv == 1}


def _moved(wrenches: Array, points: Array) -> Array:
    """Wrenches (k, 6) about the world's origin, taken about points (k, 3) instead."""
    return np.hstack([wrenches[:, :3], wrenches[:, 3:] - cross(points, wrenches[:, :3])])


def _turned(wrenches: Array, pose: Pose, *, to_world: bool) -> Array:
    """Wrenches (joints, 6), from world axes into each joint's own or back."""
    rotation = pose.rotation if to_world else np.swapaxes(pose.rotation, 1, 2)
    return np.concatenate([rotation @ wrenches[:, :3, None], rotation @ wrenches[:, 3:, None]], axis=1)[:, :, 0]
