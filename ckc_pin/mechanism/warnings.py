"""Warnings about a mechanism's model, joint limits and stops, its mass, and the properties of its joints."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.unit_hints import find_unit_warnings

__all__ = [
    "compute_moving_mass",
    "describe_joints",
    "describe_stop_violation",
    "find_model_warnings",
    "list_limit_violations",
]

FAR_FROM_GUESS = 0.5  # rad, or mechanism sizes: an assembled coordinate further from its guess is reported
LIMIT_TOLERANCE = 1e-9  # rad, or mechanism sizes: a coordinate so close to its limit is within it
STOP_TOLERANCE = 1e-11  # rad, or mechanism sizes: a coordinate so little beyond a stop is at the stop
MIN_LENGTH = 1e-12  # mechanism sizes: a link between joints closer than this has no length


def find_model_warnings(mechanism: Mechanism) -> list[str]:
    """Warn of units, links without mass, springs without effect, and coordinates assembled far from their guess."""
    warnings = find_unit_warnings(mechanism)
    if massless := _massless_links(mechanism):
        warnings.append(f"links that move without mass (no <inertial>, or its mass is 0): {', '.join(massless)}")
    for k, spring in enumerate(mechanism.spec.spring):
        if not spring.stiffness and not spring.damping:
            warnings.append(f"spring {k + 1} does nothing: it has neither stiffness nor damping")
        elif spring.frame_a is not None and spring.frame_b is not None:
            ends = [mechanism.frames.find(frame, f"spring {k + 1}").joint for frame in (spring.frame_a, spring.frame_b)]
            if ends[0] == ends[1]:
                warnings.append(f"spring {k + 1} does nothing: its frames belong to the same rigid body")
    if not mechanism.prescribed and (distant := _far_from_guess(mechanism)):
        warnings.append(
            f"assembled more than {FAR_FROM_GUESS:g} rad, or {FAR_FROM_GUESS:g} of the size {mechanism.size:.3g} m, "
            f"from q_guess: {', '.join(distant)}"
        )
    return warnings


def list_limit_violations(mechanism: Mechanism, q_tree: Array) -> list[str]:
    """List the coordinates that are outside their joint limits, with value and limits."""
    lower, upper = mechanism.tree.limits()
    numbers, tolerance = mechanism.tree.to_coordinates(q_tree), LIMIT_TOLERANCE * mechanism.tree.step_scale
    outside = np.flatnonzero((numbers < lower - tolerance) | (numbers > upper + tolerance))
    names = mechanism.coordinates
    return [f"{names[k]} = {numbers[k]:.6g} (limits {lower[k]:.6g} to {upper[k]:.6g})" for k in outside]


def describe_stop_violation(mechanism: Mechanism, q_tree: Array) -> str:
    """Describe the coordinate that is furthest beyond its stops; empty if there is none."""
    joints, numbers = mechanism.joints, mechanism.tree.to_coordinates(q_tree)
    excess = np.maximum(joints.lower - numbers, numbers - joints.upper) / mechanism.tree.step_scale
    worst = int(np.argmax(excess))
    if excess[worst] <= STOP_TOLERANCE:
        return ""
    return (
        f"{mechanism.coordinates[worst]} = {numbers[worst]:.6g} is beyond its stops, "
        f"{joints.lower[worst]:.6g} to {joints.upper[worst]:.6g}"
    )


def compute_moving_mass(mechanism: Mechanism) -> tuple[float, Array]:
    """Return the mass of all moving bodies, kg, and their inertia in the assembled configuration, kg m^2.

    The inertia, shape (3, 3), is about the common centre of mass, in world axes. Neither includes armature.
    """
    placement, _ = mechanism.tree.kinematics(mechanism.q_tree)
    bodies = list(mechanism.tree.model.inertias)[1:]
    mass = np.array([body.mass for body in bodies])
    turned = [place[:9].reshape(3, 3).T for place in placement[1:]]
    centres = np.array(
        [R @ body.lever + place[9:] if body.mass > 0 else place[9:]
         for R, body, place in zip(turned, bodies, placement[1:], strict=True)]
    ).reshape(-1, 3)  # fmt: skip
    total = float(mass.sum())
    arms = centres - (mass @ centres / total if total > 0 else 0.0)
    inertia = np.zeros((3, 3))
    for m, R, body, r in zip(mass, turned, bodies, arms, strict=True):
        inertia += R @ body.inertia @ R.T + m * ((r @ r) * np.eye(3) - np.outer(r, r))
    return total, inertia


def describe_joints(mechanism: Mechanism) -> dict[str, dict[str, float]]:
    """Return the properties of all joints that have armature, friction or stops.

    Keys are armature, damping, friction, lower, upper and restitution. `lower` and `upper` are the positions of the
    stops, infinite if there is none.
    """
    joints, model = mechanism.joints, mechanism.tree.model
    columns = {
        "armature": model.armature,
        "damping": model.damping,
        "friction": joints.friction,
        "lower": joints.lower,
        "upper": joints.upper,
        "restitution": joints.restitution,
    }
    listed = np.flatnonzero((model.armature != 0) | (joints.friction != 0) | joints.stopped)
    return {mechanism.coordinates[k]: {name: float(x[k]) for name, x in columns.items()} for k in listed}


def _massless_links(mechanism: Mechanism) -> list[str]:
    """Name moving links without mass, except for the crosses of universal and ball joints.

    Such a cross has no length: the joints on it have the same origin as the joint that carries it.
    """
    model, min_length = mechanism.tree.model, MIN_LENGTH * mechanism.size
    lengths: dict[int, float] = {}
    for joint in range(1, model.njoints):
        parent, arm = int(model.parents[joint]), float(np.linalg.norm(model.jointPlacements[joint].translation))
        lengths[parent] = max(lengths.get(parent, 0.0), arm)
    return [
        mechanism.frames.bodies[joint]
        for joint in range(1, model.njoints)
        if model.inertias[joint].mass == 0 and not lengths.get(joint, np.inf) <= min_length
    ]


def _far_from_guess(mechanism: Mechanism) -> list[str]:
    """List the coordinates of q_guess that differ much from the assembled configuration."""
    tree, guess = mechanism.tree, mechanism.spec.q_guess
    numbers = tree.to_coordinates(mechanism.q_tree)
    distant = []
    for name, value in guess.items():
        at = tree.index[name]
        if abs(numbers[at] - value) > FAR_FROM_GUESS * tree.step_scale[at]:
            distant.append(f"{name} = {numbers[at]:.4g} (guess {value:.4g})")
    return distant
