"""What of a mechanism may not be meant, and what it weighs: findings that `check` names. None is an error."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = [
    "compute_moving_mass",
    "describe_joints",
    "describe_stop_violation",
    "find_model_warnings",
    "list_limit_violations",
]

FAR = 0.5  # rad, or sizes of the mechanism: further from q_guess than that is another pose than the one described
ROUNDING = 1e-9  # rad, or sizes: at a limit, not beyond it
AT_STOP = 1e-11  # rad, or sizes: so far beyond a stop is at it
LENGTH = 1e-12  # sizes: less is no length


def find_model_warnings(mechanism: Mechanism) -> list[str]:
    """Name links without mass, springs that do nothing, and coordinates that assembly took far from their guess."""
    says = []
    if weightless := _weightless(mechanism):
        says.append(f"links that move without mass (no <inertial>, or its mass is 0): {', '.join(weightless)}")
    for k, spring in enumerate(mechanism.spec.spring):
        if not spring.stiffness and not spring.damping:
            says.append(f"spring {k + 1} does nothing: it has neither stiffness nor damping")
        elif spring.frame_a is not None and spring.frame_b is not None:
            ends = [mechanism.frames.find(frame, f"spring {k + 1}").joint for frame in (spring.frame_a, spring.frame_b)]
            if ends[0] == ends[1]:
                says.append(f"spring {k + 1} does nothing: its frames move together (the same rigid body)")
    if far := _far_from_guess(mechanism):
        says.append(
            f"assembled more than {FAR:g} rad, or {FAR:g} of the size {mechanism.size:.3g} m, from q_guess: "
            f"{', '.join(far)}"
        )
    return says


def list_limit_violations(mechanism: Mechanism, q_tree: Array) -> list[str]:
    """Return the coordinates of a configuration that are outside their joints' limits, with both."""
    lower, upper = mechanism.tree.limits()
    numbers, slack = mechanism.tree.to_coordinates(q_tree), ROUNDING * mechanism.tree.step_scale
    outside = np.flatnonzero((numbers < lower - slack) | (numbers > upper + slack))
    names = mechanism.coordinates
    return [f"{names[k]} = {numbers[k]:.6g} (limits {lower[k]:.6g} to {upper[k]:.6g})" for k in outside]


def describe_stop_violation(mechanism: Mechanism, q_tree: Array) -> str:
    """Say which coordinate of a configuration is furthest beyond its stops, with both; empty where none is."""
    joints, numbers = mechanism.joints, mechanism.tree.to_coordinates(q_tree)
    off = np.maximum(joints.lower - numbers, numbers - joints.upper) / mechanism.tree.step_scale
    worst = int(np.argmax(off))
    if off[worst] <= AT_STOP:
        return ""
    return (
        f"{mechanism.coordinates[worst]} = {numbers[worst]:.6g} is beyond its stops, "
        f"{joints.lower[worst]:.6g} to {joints.upper[worst]:.6g}"
    )


def compute_moving_mass(mechanism: Mechanism) -> tuple[float, Array]:
    """Mass of all bodies that move, kg, and their inertia as assembled, kg m^2.

    The inertia, (3, 3), is about their common centre of mass and in the world's axes. Armature has no part in either.
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
    """Return armature, damping, friction, stops and restitution of the joints that have one of them but damping.

    `lower` and `upper` are where the stops are, infinite where there is none.
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
    acting = np.flatnonzero((model.armature != 0) | (joints.friction != 0) | joints.stopped)
    return {mechanism.coordinates[k]: {name: float(x[k]) for name, x in columns.items()} for k in acting}


def _weightless(mechanism: Mechanism) -> list[str]:
    """Name moving links without mass, but for the crosses of universal and ball joints.

    Those are links without length: every joint that they carry is where their own is.
    """
    model, least = mechanism.tree.model, LENGTH * mechanism.size
    lengths: dict[int, float] = {}
    for joint in range(1, model.njoints):
        parent, arm = int(model.parents[joint]), float(np.linalg.norm(model.jointPlacements[joint].translation))
        lengths[parent] = max(lengths.get(parent, 0.0), arm)
    return [
        mechanism.frames.bodies[joint]
        for joint in range(1, model.njoints)
        if model.inertias[joint].mass == 0 and not lengths.get(joint, np.inf) <= least
    ]


def _far_from_guess(mechanism: Mechanism) -> list[str]:
    """Name the coordinates of q_guess that the assembled configuration is far from."""
    tree, guess = mechanism.tree, mechanism.spec.q_guess
    numbers = tree.to_coordinates(mechanism.q_tree)
    found = []
    for name, value in guess.items():
        at = tree.index[name]
        if abs(numbers[at] - value) > FAR * tree.step_scale[at]:
            found.append(f"{name} = {numbers[at]:.4g} (guess {value:.4g})")
    return found
