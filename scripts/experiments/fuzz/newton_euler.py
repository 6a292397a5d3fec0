"""Accelerations of all bodies from the Newton-Euler equations, by the null-space method.

Body accelerations are A = T y + A_0, with joint accelerations y, body Jacobians T and bias accelerations A_0. Loops
require G y = -gamma, so y = y_0 + N s with N the null space of G. The equations of motion projected onto N give s. The
result solves the KKT system [M, G^T; G, 0], but redundant constraint rows and massless bodies do not make it singular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scripts.experiments.fuzz.joint_forces import JointForces
from scripts.experiments.fuzz.read import Frame, Model
from scripts.experiments.fuzz.spatial import Array, IntArray, apply, cross, dot
from scripts.experiments.fuzz.state import compute_joint_values, split_state

__all__ = ["MIN_RANK_GAP", "RANK_TOLERANCE", "Equations", "NewtonEuler"]

RANK_TOLERANCE = 1e-8  # relative to the largest singular value; smaller ones belong to redundant rows
MIN_RANK_GAP = 1e-5  # smallest over largest singular value; the motion is ill-conditioned closer to a loss of rank


class Equations(NamedTuple):
    """Equations of motion in joint accelerations y (P, n): H y = force + G^T (loop forces) and G y + gamma = 0.

    Accelerations of bodies are T_v y + a_0, angular accelerations are T_w y + alpha_0.
    """

    H: Array  # (P, n, n)
    force: Array  # (P, n)
    G: Array  # (P, rows, n)
    gamma: Array  # (P, rows)
    T_v: Array  # (P, n, nb + 1, 3)
    T_w: Array
    a_0: Array  # (P, nb + 1, 3)
    alpha_0: Array


class NewtonEuler:
    """Equations of motion of a model, evaluated for P segments at once."""

    def __init__(self, model: Model) -> None:
        self.model = model
        nb, n = model.nb, model.n
        self.com = np.vstack([model.com, np.zeros(3)])
        # below[b, j] is 1 if joint j moves body b
        self.below = np.zeros((nb + 1, nb + 1))
        for b in range(nb):
            self.below[b, b] = 1.0
            if model.parent[b] < nb:
                self.below[b] += self.below[model.parent[b]]
        self.one_dof = np.array([b for b in range(nb) if model.kind[b] != "F"], np.intp)
        self.is_revolute = np.array([model.kind[b] == "R" for b in self.one_dof], bool)
        self.free = [b for b in range(nb) if model.kind[b] == "F"]
        self.revolute_mask = np.array([kind == "R" for kind in model.kind], float)[:, None]
        self.is_tree_joint = np.array([kind != "F" for kind in model.kind], float)[:, None]
        self.carrier = np.zeros(n, np.intp)  # child body of a column's joint
        for b in range(nb):
            self.carrier[model.column[b] : model.column[b] + (6 if model.kind[b] == "F" else 1)] = b
        self.support = self.below[:, self.carrier].T[None, :, :, None]  # (1, n, nb + 1, 1)
        self.sprung = np.array([b for b in self.one_dof if model.stiffness[model.column[b]]], np.intp)
        self.damped = np.array([b for b in self.one_dof if model.damping[model.column[b]]], np.intp)
        self._prepare_rows()
        self.a_spring, self.s_spring = self._attachment_points([s[0] for s in model.springs])
        self.b_spring, self.t_spring = self._attachment_points([s[1] for s in model.springs])
        self.k, self.length, self.c = np.array([s[2:] for s in model.springs]).reshape(-1, 3).T
        self.rank: int | None = None

    def _attachment_points(self, frames: list[Frame]) -> tuple[IntArray, Array]:
        """Return the frames' bodies, and their origins relative to the centres of mass in body axes."""
        bodies = np.array([f.body for f in frames], np.intp)
        return bodies, np.array([f.p - self.com[f.body] for f in frames]).reshape(-1, 3)

    def _prepare_rows(self) -> None:
        model = self.model
        self.a_point, self.s_point = self._attachment_points(
            [c[0] for c in model.components] + [d[0] for d in model.distances]
        )
        self.b_point, self.t_point = self._attachment_points(
            [c[1] for c in model.components] + [d[1] for d in model.distances]
        )
        self.lengths = np.array([d[2] for d in model.distances])
        self.fixed_in = np.array([c[2] for c in model.components], np.intp)
        self.directions = np.array([c[3] for c in model.components]).reshape(-1, 3)
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

    def body_jacobians(self, Y: Array) -> tuple[Array, Array]:
        """Return T: velocities and angular velocities of bodies per unit joint rate, (P, n, nb + 1, 3) each."""
        model = self.model
        x, R, _, _ = split_state(Y)
        spin, speed, origin = (np.zeros((len(Y), model.n, 3)) for _ in range(3))
        p, columns = model.parent[self.one_dof], model.column[self.one_dof]
        axis = apply(R[:, p], apply(model.place_R[self.one_dof], model.axis[self.one_dof]))
        spin[:, columns] = axis * self.is_revolute[:, None]
        speed[:, columns] = axis * ~self.is_revolute[:, None]
        origin[:, columns] = x[:, p] + apply(R[:, p], model.place_p[self.one_dof] - self.com[p])
        for b in self.free:  # any basis of the six motions gives the same accelerations
            k = model.column[b]
            speed[:, k : k + 3] = spin[:, k + 3 : k + 6] = np.eye(3)
            origin[:, k + 3 : k + 6] = x[:, b, None]
        lever = x[:, None] - origin[:, :, None]
        return self.support * (speed[:, :, None] + cross(spin[:, :, None], lever)), self.support * spin[:, :, None]

    def bias_accelerations(self, Y: Array) -> tuple[Array, Array]:
        """Return A_0: accelerations and angular accelerations (P, nb + 1, 3) at zero joint accelerations."""
        model, nb = self.model, self.model.nb
        x, R, v, w = split_state(Y)
        p = model.parent
        alpha_0, wp, wc = np.zeros_like(x), w[:, p], w[:, :nb]
        alpha_0[:, :nb] = self.revolute_mask * cross(wp, wc - wp)
        alpha_0 = np.einsum("bj,pji->pbi", self.below, alpha_0)
        joint = x[:, p] + apply(R[:, p], model.place_p - self.com[p])
        anchor = np.where(self.revolute_mask > 0, joint, x[:, :nb])
        from_p, to_c = anchor - x[:, p], x[:, :nb] - anchor
        slides = v[:, :nb] - cross(wc, to_c) - v[:, p] - cross(wp, from_p)
        a_0 = np.zeros_like(x)
        a_0[:, :nb] = self.is_tree_joint * (
            cross(alpha_0[:, p], from_p)
            + cross(wp, cross(wp, from_p))
            + cross(alpha_0[:, :nb], to_c)
            + cross(wc, cross(wc, to_c))
            + 2 * cross(wp, slides)
        )
        return np.einsum("bj,pji->pbi", self.below, a_0), alpha_0

    def constraint_rows(self, Y: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return coefficients of the loop rows for a_A, alpha_A, a_B and alpha_B, (P, m, 3) each, and gamma (P, m)."""
        x, R, v, w = split_state(Y)
        size = self.model.size
        a, b = self.a_point, self.b_point
        s, t = apply(R[:, a], self.s_point), apply(R[:, b], self.t_point)
        ws, wt = cross(w[:, a], s), cross(w[:, b], t)
        r, r_dot = x[:, a] + s - x[:, b] - t, v[:, a] + ws - v[:, b] - wt
        k = len(self.fixed_in)
        e = np.concatenate([apply(R[:, self.fixed_in], self.directions), r[:, k:] / self.lengths[:, None]], axis=1)
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

    def applied_forces(
        self, Y: Array, q_approx: Array, joint_forces: JointForces | None = None
    ) -> tuple[Array, Array, Array]:
        """Return forces and torques on bodies (P, nb + 1, 3), and generalized forces at joints (P, n)."""
        model = self.model
        x, R, v, w = split_state(Y)
        body_force, body_torque = np.zeros_like(x), np.zeros_like(x)
        body_force[:, :-1] = model.mass[:, None] * model.gravity
        if len(self.k):
            a, b = self.a_spring, self.b_spring
            s, t = apply(R[:, a], self.s_spring), apply(R[:, b], self.t_spring)
            r = x[:, a] + s - x[:, b] - t
            r_dot = v[:, a] + cross(w[:, a], s) - v[:, b] - cross(w[:, b], t)
            length = np.linalg.norm(r, axis=-1)
            u = r / np.where(length > 0, length, 1.0)[..., None]
            pull = u * (self.k * (length - self.length) + self.c * dot(u, r_dot))[..., None]
            for k in range(len(self.k)):
                body_force[:, a[k]] -= pull[:, k]
                body_torque[:, a[k]] -= cross(s[:, k], pull[:, k])
                body_force[:, b[k]] += pull[:, k]
                body_torque[:, b[k]] += cross(t[:, k], pull[:, k])
        generalized_force = np.tile(model.constant, (len(Y), 1))
        if len(self.sprung):
            columns = model.column[self.sprung]
            value, _ = compute_joint_values(model, Y, self.sprung, q_approx[:, columns])
            generalized_force[:, columns] -= model.stiffness[columns] * (value - model.rest[columns])
        if len(self.damped):
            columns = model.column[self.damped]
            generalized_force[:, columns] -= (
                model.damping[columns] * compute_joint_values(model, Y, self.damped, q_approx[:, columns])[1]
            )
        if joint_forces is not None:
            columns = joint_forces.columns
            generalized_force[:, columns] += joint_forces.evaluate(
                *compute_joint_values(model, Y, self.carrier[columns], q_approx[:, columns])
            )
        return body_force, body_torque, generalized_force

    def compute_equations(self, Y: Array, q_approx: Array, joint_forces: JointForces | None = None) -> Equations:
        """Return the equations of motion in joint accelerations, with all loops and couplings."""
        model = self.model
        P, n = len(Y), model.n
        _, R, _, w = split_state(Y)
        T_v, T_w = self.body_jacobians(Y)
        a_0, alpha_0 = self.bias_accelerations(Y)
        body_force, body_torque, generalized_force = self.applied_forces(Y, q_approx, joint_forces)
        I = R[:, :-1] @ model.inertia @ np.swapaxes(R[:, :-1], -1, -2)
        Iw = apply(I, w[:, :-1])
        body_force[:, :-1] -= model.mass[:, None] * a_0[:, :-1]
        body_torque[:, :-1] -= apply(I, alpha_0[:, :-1]) + cross(w[:, :-1], Iw)
        flat_v, flat_w = T_v[:, :, :-1].reshape(P, n, -1), T_w[:, :, :-1].reshape(P, n, -1)
        weighted_w = (T_w[:, :, :-1, None, :] @ I[:, None])[:, :, :, 0].reshape(P, n, -1)
        H = (flat_v * np.repeat(model.mass, 3)) @ np.swapaxes(flat_v, 1, 2) + weighted_w @ np.swapaxes(flat_w, 1, 2)
        force = (
            generalized_force
            + apply(flat_v, body_force[:, :-1].reshape(P, -1))
            + apply(flat_w, body_torque[:, :-1].reshape(P, -1))
        )
        G, gamma = np.zeros((P, 0, n)), np.zeros((P, 0))
        if len(self.body_a) or len(model.couplings):
            e_a, m_a, e_b, m_b, gamma = self.constraint_rows(Y)
            a, b = self.body_a, self.body_b
            loops = sum(
                np.einsum("pnmi,pmi->pmn", T[:, :, bodies], rows)
                for T, bodies, rows in ((T_v, a, e_a), (T_w, a, m_a), (T_v, b, e_b), (T_w, b, m_b))
            )
            gamma = (
                gamma + dot(e_a, a_0[:, a]) + dot(m_a, alpha_0[:, a]) + dot(e_b, a_0[:, b]) + dot(m_b, alpha_0[:, b])
            )
            G = np.concatenate([loops, np.broadcast_to(model.couplings, (P, *model.couplings.shape))], axis=1)
            gamma = np.concatenate([gamma, np.zeros((P, len(model.couplings)))], axis=1)
        return Equations(H, force, G, gamma, T_v, T_w, a_0, alpha_0)

    def compute_accelerations(
        self, Y: Array, q_approx: Array, joint_forces: JointForces | None = None
    ) -> tuple[Array, Array, Array]:
        """Return accelerations and angular accelerations (P, nb + 1, 3), and each segment's rank gap of G (P,)."""
        H, force, G, gamma, T_v, T_w, a_0, alpha_0 = self.compute_equations(Y, q_approx, joint_forces)
        gap = np.ones(len(Y))
        if G.shape[1]:
            U, sv, Vt = np.linalg.svd(G)
            if self.rank is None:
                self.rank = int((sv > RANK_TOLERANCE * sv[:, :1]).sum(axis=1).max())
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

    def state_derivative(
        self, Y: Array, q_approx: Array, joint_forces: JointForces | None = None
    ) -> tuple[Array, Array]:
        """Return dY/dt, and each segment's rank gap of G: smallest over largest non-zero singular value."""
        _, R, v, w = split_state(Y)
        a, alpha, gap = self.compute_accelerations(Y, q_approx, joint_forces)
        out = np.empty_like(Y)
        out[..., :3], out[..., 12:15], out[..., 15:] = v, a, alpha
        out[..., 3:12] = cross(w[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2).reshape(*Y.shape[:-1], 9)
        out[:, -1] = 0.0
        return out, gap
