"""From joint coordinates to the absolute state of all bodies, and back.

A state of P pieces is one array (P, nb + 1, 18), the last body the world: place of the centre of mass, rotation by
rows, velocity of the centre of mass, angular velocity, all in world axes.
"""

from __future__ import annotations

import numpy as np

from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array, IntArray, apply, cross, dot, rotation, rotation_vector, turn

__all__ = ["coordinates", "difference", "energy", "joint_values", "split", "state"]


def split(Y: Array) -> tuple[Array, Array, Array, Array]:
    """x, R, v, w of a state."""
    return Y[..., :3], Y[..., 3:12].reshape(*Y.shape[:-1], 3, 3), Y[..., 12:15], Y[..., 15:]


def state(model: Model, q: Array, v: Array) -> Array:
    """The absolute state at coordinates and rates (P, n)."""
    P, nb = len(q), model.nb
    Y = np.zeros((P, nb + 1, 18))
    x, R, vel, w = split(Y)
    R[...] = np.eye(3)
    com = np.vstack([model.com, np.zeros(3)])
    for b in range(nb):
        p, k = model.parent[b], model.column[b]
        stands = R[:, p] @ model.place_R[b]
        lever = apply(R[:, p], model.place_p[b] - com[p])
        origin, speed, spin = x[:, p] + lever, vel[:, p] + cross(w[:, p], lever), w[:, p]
        if model.kind[b] == "F":  # its rates are its twist in its own axes
            R[:, b] = stands @ rotation(q[:, k + 3 : k + 6])
            origin = origin + apply(stands, q[:, k : k + 3])
            speed, spin = speed + apply(R[:, b], v[:, k : k + 3]), spin + apply(R[:, b], v[:, k + 3 : k + 6])
        else:
            axis = apply(stands, model.axis[b])
            if model.kind[b] == "R":
                R[:, b] = stands @ turn(model.axis[b], q[:, k])
                spin = spin + axis * v[:, k, None]
            else:
                R[:, b] = stands
                along = axis * q[:, k, None]
                origin, speed = origin + along, speed + cross(w[:, p], along) + axis * v[:, k, None]
        lever = apply(R[:, b], com[b])
        x[:, b], vel[:, b], w[:, b] = origin + lever, speed + cross(spin, lever), spin
    return Y


def joint_values(model: Model, Y: Array, bodies: IntArray, near: Array) -> tuple[Array, Array]:
    """Coordinates and rates (P, k) of one-freedom joints, angles within half a turn of `near`."""
    x, R, vel, w = split(Y)
    com = np.vstack([model.com, np.zeros(3)])
    p = model.parent[bodies]
    stands = R[:, p] @ model.place_R[bodies]
    axis = apply(stands, model.axis[bodies])
    turns = np.array([model.kind[b] == "R" for b in bodies])
    relative = np.swapaxes(stands, -1, -2) @ R[:, bodies]
    skew = 0.5 * np.stack(
        (
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ),
        axis=-1,
    )
    angle = np.arctan2(dot(skew, model.axis[bodies]), 0.5 * (np.trace(relative, axis1=-2, axis2=-1) - 1))
    angle = near + np.remainder(angle - near + np.pi, 2 * np.pi) - np.pi
    lever_p = apply(R[:, p], model.place_p[bodies] - com[p])
    lever_b = apply(R[:, bodies], com[bodies])
    apart = x[:, bodies] - lever_b - x[:, p] - lever_p
    rate = dot(axis, w[:, bodies] - w[:, p])
    speed = vel[:, bodies] - cross(w[:, bodies], lever_b) - vel[:, p] - cross(w[:, p], lever_p + apart)
    return np.where(turns, angle, dot(axis, apart)), np.where(turns, rate, dot(axis, speed))


def coordinates(model: Model, Y: Array, near: Array) -> tuple[Array, Array]:
    """Joint coordinates and rates (P, n) of a state, angles within half a turn of `near`."""
    q, v = np.empty_like(near), np.empty_like(near)
    single = np.array([b for b in range(model.nb) if model.kind[b] != "F"], np.intp)
    at = model.column[single]
    if len(single):
        q[:, at], v[:, at] = joint_values(model, Y, single, near[:, at])
    x, R, vel, w = split(Y)
    for b in range(model.nb):
        if model.kind[b] == "F":
            k, lever = model.column[b], apply(R[:, b], model.com[b])
            stands, own = model.place_R[b].T, np.swapaxes(R[:, b], 1, 2)
            q[:, k : k + 3] = apply(stands, x[:, b] - lever - model.place_p[b])
            q[:, k + 3 : k + 6] = rotation_vector(stands @ R[:, b])
            v[:, k : k + 3] = apply(own, vel[:, b] - cross(w[:, b], lever))
            v[:, k + 3 : k + 6] = apply(own, w[:, b])
    return q, v


def difference(model: Model, q: Array, right: Array) -> Array:
    """q - right, where a free root's turn is that between the two rotations."""
    apart = q - right
    for b in range(model.nb):
        if model.kind[b] == "F":
            turns = slice(model.column[b] + 3, model.column[b] + 6)
            apart[:, turns] = rotation_vector(np.swapaxes(rotation(right[:, turns]), 1, 2) @ rotation(q[:, turns]))
    return apart


def energy(model: Model, q: Array, v: Array) -> tuple[Array, Array]:
    """Kinetic and potential energy at coordinates and rates (P, n); what a constant force has left counts."""
    x, R, vel, w = split(state(model, q, v))
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
