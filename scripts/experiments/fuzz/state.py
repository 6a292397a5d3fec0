"""Convert joint coordinates to absolute states of all bodies, and back.

The state of P segments is an array (P, nb + 1, 18), the last body being the world. A body's row has the position of the
centre of mass, the rotation matrix by rows, the velocity of the centre of mass and the angular velocity, in world axes.
"""

from __future__ import annotations

import numpy as np

from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array, IntArray, apply, cross, dot, rotation, rotation_vector, turn

__all__ = [
    "compute_energy",
    "compute_joint_values",
    "split_state",
    "subtract_coordinates",
    "to_coordinates",
    "to_state",
]


def split_state(Y: Array) -> tuple[Array, Array, Array, Array]:
    """Return x, R, v, w of a state as views: positions, rotation matrices, velocities and angular velocities."""
    return Y[..., :3], Y[..., 3:12].reshape(*Y.shape[:-1], 3, 3), Y[..., 12:15], Y[..., 15:]


def to_state(model: Model, q: Array, v: Array) -> Array:
    """Return the absolute state at coordinates and rates (P, n)."""
    P, nb = len(q), model.nb
    Y = np.zeros((P, nb + 1, 18))
    x, R, vel, w = split_state(Y)
    R[...] = np.eye(3)
    com = np.vstack([model.com, np.zeros(3)])
    for b in range(nb):
        p, k = model.parent[b], model.column[b]
        placement = R[:, p] @ model.place_R[b]
        lever = apply(R[:, p], model.place_p[b] - com[p])
        origin, speed, spin = x[:, p] + lever, vel[:, p] + cross(w[:, p], lever), w[:, p]
        if model.kind[b] == "F":  # its rates are its twist in body axes
            R[:, b] = placement @ rotation(q[:, k + 3 : k + 6])
            origin = origin + apply(placement, q[:, k : k + 3])
            speed, spin = speed + apply(R[:, b], v[:, k : k + 3]), spin + apply(R[:, b], v[:, k + 3 : k + 6])
        else:
            axis = apply(placement, model.axis[b])
            if model.kind[b] == "R":
                R[:, b] = placement @ turn(model.axis[b], q[:, k])
                spin = spin + axis * v[:, k, None]
            else:
                R[:, b] = placement
                along = axis * q[:, k, None]
                origin, speed = origin + along, speed + cross(w[:, p], along) + axis * v[:, k, None]
        lever = apply(R[:, b], com[b])
        x[:, b], vel[:, b], w[:, b] = origin + lever, speed + cross(spin, lever), spin
    return Y


def compute_joint_values(model: Model, Y: Array, bodies: IntArray, q_approx: Array) -> tuple[Array, Array]:
    """Return coordinates and rates (P, k) of one-freedom joints, with angles less than half a turn from `q_approx`."""
    x, R, vel, w = split_state(Y)
    com = np.vstack([model.com, np.zeros(3)])
    p = model.parent[bodies]
    placement = R[:, p] @ model.place_R[bodies]
    axis = apply(placement, model.axis[bodies])
    is_revolute = np.array([model.kind[b] == "R" for b in bodies])
    relative = np.swapaxes(placement, -1, -2) @ R[:, bodies]
    skew = 0.5 * np.stack(
        (
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ),
        axis=-1,
    )
    angle = np.arctan2(dot(skew, model.axis[bodies]), 0.5 * (np.trace(relative, axis1=-2, axis2=-1) - 1))
    angle = q_approx + np.remainder(angle - q_approx + np.pi, 2 * np.pi) - np.pi
    lever_p = apply(R[:, p], model.place_p[bodies] - com[p])
    lever_b = apply(R[:, bodies], com[bodies])
    offset = x[:, bodies] - lever_b - x[:, p] - lever_p
    rate = dot(axis, w[:, bodies] - w[:, p])
    speed = vel[:, bodies] - cross(w[:, bodies], lever_b) - vel[:, p] - cross(w[:, p], lever_p + offset)
    return np.where(is_revolute, angle, dot(axis, offset)), np.where(is_revolute, rate, dot(axis, speed))


def to_coordinates(model: Model, Y: Array, q_approx: Array) -> tuple[Array, Array]:
    """Return joint coordinates and rates (P, n) of a state, with angles less than half a turn from `q_approx`."""
    q, v = np.empty_like(q_approx), np.empty_like(q_approx)
    single = np.array([b for b in range(model.nb) if model.kind[b] != "F"], np.intp)
    at = model.column[single]
    if len(single):
        q[:, at], v[:, at] = compute_joint_values(model, Y, single, q_approx[:, at])
    x, R, vel, w = split_state(Y)
    for b in range(model.nb):
        if model.kind[b] == "F":
            k, lever = model.column[b], apply(R[:, b], model.com[b])
            placement, R_transposed = model.place_R[b].T, np.swapaxes(R[:, b], 1, 2)
            q[:, k : k + 3] = apply(placement, x[:, b] - lever - model.place_p[b])
            q[:, k + 3 : k + 6] = rotation_vector(placement @ R[:, b])
            v[:, k : k + 3] = apply(R_transposed, vel[:, b] - cross(w[:, b], lever))
            v[:, k + 3 : k + 6] = apply(R_transposed, w[:, b])
    return q, v


def subtract_coordinates(model: Model, q: Array, right: Array) -> Array:
    """Return q - right; for a free root's orientation, return the rotation vector between the two rotations."""
    offset = q - right
    for b in range(model.nb):
        if model.kind[b] == "F":
            is_revolute = slice(model.column[b] + 3, model.column[b] + 6)
            offset[:, is_revolute] = rotation_vector(
                np.swapaxes(rotation(right[:, is_revolute]), 1, 2) @ rotation(q[:, is_revolute])
            )
    return offset


def compute_energy(model: Model, q: Array, v: Array) -> tuple[Array, Array]:
    """Return kinetic and potential energy at coordinates and rates (P, n). Constant forces have a potential too."""
    x, R, vel, w = split_state(to_state(model, q, v))
    spin = apply(np.swapaxes(R[:, :-1], -1, -2), w[:, :-1])
    kinetic = 0.5 * np.sum(model.mass * dot(vel[:, :-1], vel[:, :-1]), axis=1)
    kinetic += 0.5 * np.sum(dot(spin, apply(model.inertia, spin)), axis=1)
    potential = -np.sum(model.mass * (x[:, :-1] @ model.gravity), axis=1)
    potential += 0.5 * ((q - model.rest) ** 2) @ model.stiffness - q @ model.constant
    com = np.vstack([model.com, np.zeros(3)])
    for a, b, k, rest, _ in model.springs:
        ends = [x[:, f.body] + apply(R[:, f.body], f.p - com[f.body]) for f in (a, b)]
        potential += 0.5 * k * (np.linalg.norm(ends[0] - ends[1], axis=1) - rest) ** 2
    return kinetic, potential
