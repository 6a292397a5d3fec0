"""Accelerations of all bodies from Newton and Euler: what joints and loops forbid is eliminated, not integrated.

Every acceleration that the joints allow is A = T y + A_0, with T the bodies' motions by joint and A_0 what is left at
y = 0. Loops want G A = -gamma, so y = y_0 + N s with N all that G T does not see; forces along T N give s. The solution
is that of the system [M, G^T; G, 0] of all constraints, but rows that follow from others and bodies without mass, where
that system is singular, need no care here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scripts.experiments.fuzz.joint_forces import JointForces
from scripts.experiments.fuzz.read import Frame, Model
from scripts.experiments.fuzz.spatial import Array, IntArray, apply, cross, dot
from scripts.experiments.fuzz.state import joint_values, split

__all__ = ["LEAST_GAP", "REDUNDANT", "Equations", "Motion"]

REDUNDANT = 1e-8  # singular values below, against the largest, belong to rows that follow from others
LEAST_GAP = 1e-5  # between the last one counted and the largest; nearer to a loss of rank there is no right answer


class Equations(NamedTuple):
    """Equations of motion H y = force + G^T (loop forces), G y + gamma = 0 in joint accelerations y (P, n).

    Accelerations of bodies are T_v y + a_0, angular ones T_w y + alpha_0.
    """

    H: Array  # (P, n, n)
    force: Array  # (P, n)
    G: Array  # (P, rows, n)
    gamma: Array  # (P, rows)
    T_v: Array  # (P, n, nb + 1, 3)
    T_w: Array
    a_0: Array  # (P, nb + 1, 3)
    alpha_0: Array


class Motion:
    """The right-hand side of a model's motion, for P pieces at a time."""

    def __init__(self, model: Model) -> None:
        self.model = model
        nb, n = model.nb, model.n
        self.com = np.vstack([model.com, np.zeros(3)])
        # below[b, j] is 1 where joint j carries body b
        self.below = np.zeros((nb + 1, nb + 1))
        for b in range(nb):
            self.below[b, b] = 1.0
            if model.parent[b] < nb:
                self.below[b] += self.below[model.parent[b]]
        self.single = np.array([b for b in range(nb) if model.kind[b] != "F"], np.intp)
        self.turning = np.array([model.kind[b] == "R" for b in self.single], bool)
        self.free = [b for b in range(nb) if model.kind[b] == "F"]
        self.revolute = np.array([kind == "R" for kind in model.kind], float)[:, None]
        self.bound = np.array([kind != "F" for kind in model.kind], float)[:, None]
        self.carrier = np.zeros(n, np.intp)  # the body right below a column's joint
        for b in range(nb):
            self.carrier[model.column[b] : model.column[b] + (6 if model.kind[b] == "F" else 1)] = b
        self.support = self.below[:, self.carrier].T[None, :, :, None]  # (1, n, nb + 1, 1)
        self.sprung = np.array([b for b in self.single if model.stiffness[model.column[b]]], np.intp)
        self.damped = np.array([b for b in self.single if model.damping[model.column[b]]], np.intp)
        self._rows()
        self.a_spring, self.s_spring = self._ends([s[0] for s in model.springs])
        self.b_spring, self.t_spring = self._ends([s[1] for s in model.springs])
        self.k, self.length, self.c = np.array([s[2:] for s in model.springs]).reshape(-1, 3).T
        self.rank: int | None = None

    def _ends(self, frames: list[Frame]) -> tuple[IntArray, Array]:
        """Bodies, and places from their centres of mass in their axes."""
        at = np.array([f.body for f in frames], np.intp)
        return at, np.array([f.p - self.com[f.body] for f in frames]).reshape(-1, 3)

    def _rows(self) -> None:
        model = self.model
        self.a_point, self.s_point = self._ends([c[0] for c in model.components] + [d[0] for d in model.distances])
        self.b_point, self.t_point = self._ends([c[1] for c in model.components] + [d[1] for d in model.distances])
        self.lengths = np.array([d[2] for d in model.distances])
        self.fixed_in = np.array([c[2] for c in model.components], np.intp)
        self.along = np.array([c[3] for c in model.components]).reshape(-1, 3)
        self.turns_with_a = np.array([c[2] == c[0].body and c[2] >= 0 for c in model.components], float)[:, None]
        self.a_dot = np.array([d[0] for d in model.dots], np.intp)
        self.e_dot = np.array([d[1] for d in model.dots]).reshape(-1, 3)
        self.b_dot = np.array([d[2] for d in model.dots], np.intp)
        self.f_dot = np.array([d[3] for d in model.dots]).reshape(-1, 3)
        self.a_turn = np.array([p[0] for p in model.parallel for _ in range(3)], np.intp)
        self.b_turn = np.array([p[1] for p in model.parallel for _ in range(3)], np.intp)
        self.xyz = np.tile(np.eye(3), (len(model.parallel), 1))
        self.body_a = np.concatenate([self.a_point, self.a_dot, self.a_turn])
        self.body_b = np.concatenate([self.b_point, self.b_dot, self.b_turn])

    def motions(self, Y: Array) -> tuple[Array, Array]:
        """T: velocities and angular velocities of bodies by joint, (P, n, nb + 1, 3) each."""
        model = self.model
        x, R, _, _ = split(Y)
        spin, speed, origin = (np.zeros((len(Y), model.n, 3)) for _ in range(3))
        p, at = model.parent[self.single], model.column[self.single]
        axis = apply(R[:, p], apply(model.place_R[self.single], model.axis[self.single]))
        spin[:, at] = axis * self.turning[:, None]
        speed[:, at] = axis * ~self.turning[:, None]
        origin[:, at] = x[:, p] + apply(R[:, p], model.place_p[self.single] - self.com[p])
        for b in self.free:  # any six motions do, only accelerations come of them
            k = model.column[b]
            speed[:, k : k + 3] = spin[:, k + 3 : k + 6] = np.eye(3)
            origin[:, k + 3 : k + 6] = x[:, b, None]
        lever = x[:, None] - origin[:, :, None]
        return self.support * (speed[:, :, None] + cross(spin[:, :, None], lever)), self.support * spin[:, :, None]

    def left_over(self, Y: Array) -> tuple[Array, Array]:
        """A_0: accelerations and angular accelerations of bodies (P, nb + 1, 3) when all joints' are zero."""
        model, nb = self.model, self.model.nb
        x, R, v, w = split(Y)
        p = model.parent
        turned, wp, wc = np.zeros_like(x), w[:, p], w[:, :nb]
        turned[:, :nb] = self.revolute * cross(wp, wc - wp)
        turned = np.einsum("bj,pji->pbi", self.below, turned)
        joint = x[:, p] + apply(R[:, p], model.place_p - self.com[p])
        at = np.where(self.revolute > 0, joint, x[:, :nb])
        from_p, to_c = at - x[:, p], x[:, :nb] - at
        slides = v[:, :nb] - cross(wc, to_c) - v[:, p] - cross(wp, from_p)
        moved = np.zeros_like(x)
        moved[:, :nb] = self.bound * (
            cross(turned[:, p], from_p)
            + cross(wp, cross(wp, from_p))
            + cross(turned[:, :nb], to_c)
            + cross(wc, cross(wc, to_c))
            + 2 * cross(wp, slides)
        )
        return np.einsum("bj,pji->pbi", self.below, moved), turned

    def rows(self, Y: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Loop rows: what multiplies a_A, alpha_A, a_B, alpha_B, each (P, m, 3), and gamma (P, m)."""
        x, R, v, w = split(Y)
        size = self.model.size
        a, b = self.a_point, self.b_point
        s, t = apply(R[:, a], self.s_point), apply(R[:, b], self.t_point)
        ws, wt = cross(w[:, a], s), cross(w[:, b], t)
        r, r_dot = x[:, a] + s - x[:, b] - t, v[:, a] + ws - v[:, b] - wt
        k = len(self.fixed_in)
        e = np.concatenate([apply(R[:, self.fixed_in], self.along), r[:, k:] / self.lengths[:, None]], axis=1)
        e_dot = np.zeros_like(e)
        e_dot[:, :k] = self.turns_with_a * cross(w[:, self.fixed_in], e[:, :k])
        gamma = dot(e, cross(w[:, a], ws) - cross(w[:, b], wt)) + 2 * dot(e_dot, r_dot)
        e_bend = cross(w[:, self.fixed_in], e_dot[:, :k])
        gamma[:, :k] += dot(e_bend, r[:, :k])
        gamma[:, k:] += dot(r_dot[:, k:], r_dot[:, k:]) / self.lengths
        about_a = cross(s, e)
        about_a[:, :k] += self.turns_with_a * cross(e[:, :k], r[:, :k])
        f, g = apply(R[:, self.a_dot], self.e_dot), apply(R[:, self.b_dot], self.f_dot)
        wf, wg = cross(w[:, self.a_dot], f), cross(w[:, self.b_dot], g)
        gamma_dot = (
            dot(cross(w[:, self.a_dot], wf), g) + 2 * dot(wf, wg) + dot(f, cross(w[:, self.b_dot], wg))
        )  # fmt: skip
        across = cross(f, g)
        xyz = np.broadcast_to(self.xyz, (len(Y), *self.xyz.shape))
        none = np.zeros((len(Y), len(self.a_dot) + len(self.a_turn), 3))
        return (
            np.concatenate([e / size, none], axis=1),
            np.concatenate([about_a / size, across, xyz], axis=1),
            np.concatenate([-e / size, none], axis=1),
            np.concatenate([-cross(t, e) / size, -across, -xyz], axis=1),
            np.concatenate([gamma / size, gamma_dot, np.zeros((len(Y), len(self.a_turn)))], axis=1),
        )

    def forces(self, Y: Array, near: Array, drive: JointForces | None = None) -> tuple[Array, Array, Array]:
        """Forces and torques on bodies (P, nb + 1, 3), and along joints (P, n)."""
        model = self.model
        x, R, v, w = split(Y)
        push, torque = np.zeros_like(x), np.zeros_like(x)
        push[:, :-1] = model.mass[:, None] * model.gravity
        if len(self.k):
            a, b = self.a_spring, self.b_spring
            s, t = apply(R[:, a], self.s_spring), apply(R[:, b], self.t_spring)
            r = x[:, a] + s - x[:, b] - t
            r_dot = v[:, a] + cross(w[:, a], s) - v[:, b] - cross(w[:, b], t)
            length = np.linalg.norm(r, axis=-1)
            u = r / np.where(length > 0, length, 1.0)[..., None]
            pull = u * (self.k * (length - self.length) + self.c * dot(u, r_dot))[..., None]
            for k in range(len(self.k)):
                push[:, a[k]] -= pull[:, k]
                torque[:, a[k]] -= cross(s[:, k], pull[:, k])
                push[:, b[k]] += pull[:, k]
                torque[:, b[k]] += cross(t[:, k], pull[:, k])
        along = np.tile(model.constant, (len(Y), 1))
        if len(self.sprung):
            at = model.column[self.sprung]
            value, _ = joint_values(model, Y, self.sprung, near[:, at])
            along[:, at] -= model.stiffness[at] * (value - model.rest[at])
        if len(self.damped):
            at = model.column[self.damped]
            along[:, at] -= model.damping[at] * joint_values(model, Y, self.damped, near[:, at])[1]
        if drive is not None:
            at = drive.columns
            along[:, at] += drive.along(*joint_values(model, Y, self.carrier[at], near[:, at]))
        return push, torque, along

    def equations(self, Y: Array, near: Array, drive: JointForces | None = None) -> Equations:
        """The equations of motion in joint accelerations, of all joints and loops."""
        model = self.model
        P, n = len(Y), model.n
        _, R, _, w = split(Y)
        T_v, T_w = self.motions(Y)
        a_0, alpha_0 = self.left_over(Y)
        push, torque, along = self.forces(Y, near, drive)
        I = R[:, :-1] @ model.inertia @ np.swapaxes(R[:, :-1], -1, -2)
        Iw = apply(I, w[:, :-1])
        push[:, :-1] -= model.mass[:, None] * a_0[:, :-1]
        torque[:, :-1] -= apply(I, alpha_0[:, :-1]) + cross(w[:, :-1], Iw)
        flat_v, flat_w = T_v[:, :, :-1].reshape(P, n, -1), T_w[:, :, :-1].reshape(P, n, -1)
        turned = (T_w[:, :, :-1, None, :] @ I[:, None])[:, :, :, 0].reshape(P, n, -1)
        H = (flat_v * np.repeat(model.mass, 3)) @ np.swapaxes(flat_v, 1, 2) + turned @ np.swapaxes(flat_w, 1, 2)
        force = along + apply(flat_v, push[:, :-1].reshape(P, -1)) + apply(flat_w, torque[:, :-1].reshape(P, -1))
        G, gamma = np.zeros((P, 0, n)), np.zeros((P, 0))
        if len(self.body_a) or len(model.couplings):
            e_a, m_a, e_b, m_b, gamma = self.rows(Y)
            a, b = self.body_a, self.body_b
            loops = sum(
                np.einsum("pnmi,pmi->pmn", T[:, :, at], by)
                for T, at, by in ((T_v, a, e_a), (T_w, a, m_a), (T_v, b, e_b), (T_w, b, m_b))
            )
            gamma = (
                gamma + dot(e_a, a_0[:, a]) + dot(m_a, alpha_0[:, a]) + dot(e_b, a_0[:, b]) + dot(m_b, alpha_0[:, b])
            )
            G = np.concatenate([loops, np.broadcast_to(model.couplings, (P, *model.couplings.shape))], axis=1)
            gamma = np.concatenate([gamma, np.zeros((P, len(model.couplings)))], axis=1)
        return Equations(H, force, G, gamma, T_v, T_w, a_0, alpha_0)

    def accelerations(self, Y: Array, near: Array, drive: JointForces | None = None) -> tuple[Array, Array, Array]:
        """Accelerations and angular accelerations (P, nb + 1, 3), and each piece's distance from a loss of rank."""
        H, force, G, gamma, T_v, T_w, a_0, alpha_0 = self.equations(Y, near, drive)
        gap = np.ones(len(Y))
        if G.shape[1]:
            U, sv, Vt = np.linalg.svd(G)
            if self.rank is None:
                self.rank = int((sv > REDUNDANT * sv[:, :1]).sum(axis=1).max())
            r = self.rank
            gap = np.asarray(sv[:, r - 1] / sv[:, 0], dtype=float)
            y = -apply(np.swapaxes(Vt[:, :r], 1, 2), apply(np.swapaxes(U[:, :, :r], 1, 2), gamma) / sv[:, :r])
            N = np.swapaxes(Vt[:, r:], 1, 2)
            inner = np.swapaxes(N, 1, 2) @ H @ N
            y = y + apply(
                N, np.linalg.solve(inner, apply(np.swapaxes(N, 1, 2), force - apply(H, y))[..., None])[..., 0]
            )
        else:
            y = np.asarray(np.linalg.solve(H, force[..., None])[..., 0], dtype=float)
        return (
            a_0 + np.einsum("pnbi,pn->pbi", T_v, y),
            alpha_0 + np.einsum("pnbi,pn->pbi", T_w, y),
            gap,
        )

    def rate(self, Y: Array, near: Array, drive: JointForces | None = None) -> tuple[Array, Array]:
        """dY/dt, and each piece's distance from a loss of rank."""
        _, R, v, w = split(Y)
        a, alpha, gap = self.accelerations(Y, near, drive)
        out = np.empty_like(Y)
        out[..., :3], out[..., 12:15], out[..., 15:] = v, a, alpha
        out[..., 3:12] = cross(w[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2).reshape(*Y.shape[:-1], 9)
        out[:, -1] = 0.0
        return out, gap
