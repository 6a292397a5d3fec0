"""Independent high-precision model of eq. 1, computed from positions only.

Frames are placed joint by joint with mpmath. Velocities, accelerations and Jacobians are differences of placements, and
forces follow from d'Alembert's principle. Steps of 1e-20 with 80 digits leave about 40 digits; differences of solutions
leave 20. The model reads only numbers from the package: placements, axes, inertias, and anchors of rows and springs.
"""

from __future__ import annotations

from typing import Any

import mpmath as mp
import numpy as np

from ckc_pin.mechanism import Mechanism
from ckc_pin.mechanism.rows import Affine, Component, Curved, Distance, Dot, RelativeLog

mp.mp.dps = 80
DERIVATIVE_STEP = mp.mpf(10) ** -20  # of differences of placements
SOLUTION_STEP = mp.mpf(10) ** -10  # of differences of solutions

Vector = Any  # arrays of mpf


def exact(x: Any) -> Vector:
    """Convert an array to mpf."""
    return np.vectorize(mp.mpf, otypes=[object])(np.asarray(x, dtype=float))


def hat(a: Vector) -> Vector:
    zero = mp.mpf(0)
    return np.array([[zero, -a[2], a[1]], [a[2], zero, -a[0]], [-a[1], a[0], zero]], dtype=object)


def axial(m: Vector) -> Vector:
    """Return the vector of a matrix's skew-symmetric part."""
    return np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]], dtype=object) / 2


def rotation_of(a: Vector) -> Vector:
    """Return the rotation of a rotation vector."""
    angle = mp.sqrt(a @ a)
    s = hat(a)
    if angle < DERIVATIVE_STEP**3:
        return exact(np.eye(3)) + s
    half = mp.sin(angle / 2)
    return exact(np.eye(3)) + s * (mp.sin(angle) / angle) + (s @ s) * (2 * half**2 / angle**2)


def log(R: Vector) -> Vector:
    """Return the rotation vector of a rotation by less than half a turn."""
    sine = axial(R)
    size = mp.sqrt(sine @ sine)
    if size < DERIVATIVE_STEP**3:
        return sine
    return sine * (mp.atan2(size, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2) / size)


class ManyDigits:
    """Eq. 1 of a mechanism with 80 digits."""

    def __init__(self, mechanism: Mechanism) -> None:
        tree, model, springs = mechanism.tree, mechanism.tree.model, mechanism.springs
        self.tree, self.closure, self.n = tree, mechanism.closure, mechanism.n
        self.joints = [
            (model.parents[k], model.joints[k].idx_v, model.joints[k].nq == 7) for k in range(1, model.njoints)
        ]
        self.placements = [(exact(x.rotation), exact(x.translation)) for x in list(model.jointPlacements)[1:]]
        self.axes = [
            None if free else (exact(tree.axis(k)[0]), tree.axis(k)[1]) for k, (*_, free) in enumerate(self.joints, 1)
        ]
        self.bodies = [(mp.mpf(x.mass), exact(x.lever), exact(x.inertia)) for x in list(model.inertias)[1:]]
        self.gravity, self.armature = exact(model.gravity.linear), exact(model.armature)
        self.springs = springs
        self.stiffness, self.damping, self.rest = (
            exact(x) for x in (springs.stiffness, springs.damping, springs.rest_length)
        )

    def configuration(self, q_tree: Any) -> list[Any]:
        """Return the configuration by joint: a number, or a rotation and a position."""
        result: list[Any] = []
        for k, (*_, free) in enumerate(self.joints, 1):
            at = self.tree.model.joints[k].idx_q
            if not free:
                result.append(mp.mpf(float(q_tree[at])))
                continue
            x = exact(q_tree[at + 3 : at + 7])
            x = x / mp.sqrt(x @ x)
            s = hat(x[:3])
            result.append((exact(np.eye(3)) + 2 * x[3] * s + 2 * (s @ s), exact(q_tree[at : at + 3])))
        return result

    def move(self, q: list[Any], v: Vector, a: Vector, t: Any) -> list[Any]:
        """Return the configuration after time t with velocity v and acceleration a, to second order."""
        result: list[Any] = []
        for x, (_, at, free) in zip(q, self.joints, strict=True):
            if not free:
                result.append(x + v[at] * t + a[at] * t * t / 2)
                continue
            R, p = x
            (slide, spin), (slides, spins) = (v[at : at + 3], v[at + 3 : at + 6]), (a[at : at + 3], a[at + 3 : at + 6])
            slides = slides + hat(spin) @ slide
            result.append((R @ rotation_of(spin * t + spins * (t * t / 2)), p + R @ (slide * t + slides * (t * t / 2))))
        return result

    def frames(self, q: list[Any]) -> list[tuple[Vector, Vector]]:
        """Return rotation and origin of all bodies, the world first."""
        result = [(exact(np.eye(3)), exact(np.zeros(3)))]
        for k, (x, (parent, _, free)) in enumerate(zip(q, self.joints, strict=True)):
            R, p = result[parent]
            R, p = R @ self.placements[k][0], p + R @ self.placements[k][1]
            if free:
                R, p = R @ x[0], p + R @ x[1]
            elif self.axes[k][1]:
                R = R @ rotation_of(self.axes[k][0] * x)
            else:
                p = p + R @ self.axes[k][0] * x
            result.append((R, p))
        return result

    def positions_and_rotations(self, q: list[Any]) -> tuple[Vector, Vector]:
        """Return centres of mass, lengths of springs and phi as one vector, and the rotations of bodies."""
        frames = self.frames(q)
        centres = [p + R @ c for (R, p), (_, c, _) in zip(frames[1:], self.bodies, strict=True)]
        ends = self._points(frames, self.springs.anchors)
        half = len(ends) // 2
        lengths = [mp.sqrt((a - b) @ (a - b)) for a, b in zip(ends[:half], ends[half:], strict=True)]
        return np.concatenate([*centres, np.array(lengths, dtype=object), self.phi(frames, q)]), np.array(
            [R for R, _ in frames[1:]]
        )

    @staticmethod
    def _points(frames: list[tuple[Vector, Vector]], anchors: Any) -> list[Vector]:
        return [
            frames[j][1] + frames[j][0] @ exact(x)
            for j, x in zip(anchors.point_joint, anchors.point_local, strict=True)
        ]

    def phi(self, frames: list[tuple[Vector, Vector]], q: list[Any]) -> Vector:
        anchors = self.closure.anchors
        p = self._points(frames, anchors)
        e = [frames[j][0] @ exact(x) for j, x in zip(anchors.direction_joint, anchors.direction_local, strict=True)]
        r = [a - b for a, b in zip(p[: len(p) // 2], p[len(p) // 2 :], strict=True)]
        result = np.full(self.closure.rows, mp.mpf(0), dtype=object)
        for group in self.closure.groups:
            if isinstance(group, Component):
                result[group.out] = [e[d] @ r[k] for k, d in zip(group.pair, group.direction, strict=True)]
            elif isinstance(group, Dot):
                result[group.out] = [e[a] @ e[b] for a, b in zip(group.a, group.b, strict=True)]
            elif isinstance(group, Distance):
                length = exact(group.length)
                result[group.out] = [(r[k] @ r[k] - x * x) / (2 * x) for k, x in zip(group.pair, length, strict=True)]
            elif isinstance(group, Affine):
                x = np.full(self.n, mp.mpf(0), dtype=object)
                for value, (_, at, free) in zip(q, self.joints, strict=True):
                    if not free:
                        x[at] = value
                result[group.out] = exact(group.matrix) @ x - exact(group.offset)
                for row, k in enumerate(group.coordinate) if isinstance(group, Curved) else ():
                    piece = int(sum(x[k] >= group.breaks[row]))
                    s = x[k] - mp.mpf(float(group.origins[row, piece]))
                    powers = [mp.mpf(float(c)) for c in group.coefficients[row, piece]]
                    result[group.out[row]] -= sum(c * s**i for i, c in enumerate(powers))
            elif isinstance(group, RelativeLog):
                ends = zip(group.joint_a, group.rotation_a, group.joint_b, group.rotation_b, strict=True)
                result[group.out] = np.concatenate(
                    [log((frames[a][0] @ exact(A)).T @ (frames[b][0] @ exact(B))) for a, A, b, B in ends]
                )
        return result

    def acceleration(self, q: list[Any], v: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Return acceleration and multipliers of eq. 1."""
        n, rows, count, h = self.n, self.closure.rows, len(self.bodies), DERIVATIVE_STEP
        zero_vector, unit = exact(np.zeros(n)), exact(np.eye(n))
        values, R = self.positions_and_rotations(q)
        by_q = np.empty((len(values), n), dtype=object)
        spins_by_q = np.empty((3 * count, n), dtype=object)
        for k in range(n):
            (x1, R1), (x0, R0) = (
                self.positions_and_rotations(self.move(q, unit[k], zero_vector, s * h)) for s in (1, -1)
            )
            by_q[:, k] = (x1 - x0) / (2 * h)
            spins_by_q[:, k] = np.concatenate(
                [axial((a - b) @ c.T) / (2 * h) for a, b, c in zip(R1, R0, R, strict=True)]
            )
        (x1, R1), (x0, R0) = (self.positions_and_rotations(self.move(q, v, zero_vector, s * h)) for s in (1, -1))
        rate, rates = (x1 - x0) / (2 * h), (x1 - 2 * values + x0) / (h * h)
        D, force = np.diag(self.armature), np.array(u)
        for k, (mass, _, inertia) in enumerate(self.bodies):
            J, W = by_q[3 * k : 3 * k + 3], spins_by_q[3 * k : 3 * k + 3]
            I = R[k] @ inertia @ R[k].T
            omega = axial((R1[k] - R0[k]) @ R[k].T) / (2 * h)
            alpha = axial((R1[k] - 2 * R[k] + R0[k]) @ R[k].T) / (h * h)
            D = D + mass * (J.T @ J) + W.T @ I @ W
            force = force - mass * (J.T @ (rates[3 * k : 3 * k + 3] - self.gravity))
            force = force - W.T @ (I @ alpha + hat(omega) @ (I @ omega))
        at = slice(3 * count, 3 * count + len(self.stiffness))
        pull = self.stiffness * (values[at] - self.rest) + self.damping * rate[at]
        force = force - by_q[at].T @ pull if len(pull) else force
        force = force + exact(self.springs.constant) - exact(self.springs.joint_damping) * v
        for x, (_, k, free) in zip(q, self.joints, strict=True):
            if not free:
                force[k] -= mp.mpf(self.springs.joint_stiffness[k]) * (x - mp.mpf(self.springs.joint_rest[k]))
        J = by_q[at.stop :]
        matrix, right = mp.zeros(n + rows), mp.zeros(n + rows, 1)
        for i in range(n):
            right[i] = force[i]
            for j in range(n):
                matrix[i, j] = D[i, j]
        for i in range(rows):
            right[n + i] = -rates[at.stop + i]
            for j in range(n):
                matrix[n + i, j], matrix[j, n + i] = J[i, j], -J[i, j]
        result = np.array(list(mp.lu_solve(matrix, right)), dtype=object)
        return result[:n], result[n:]

    def differentiate(self, q_tree: Any, v: Any, u: Any, by: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return directional derivatives of acceleration and multipliers for directions of q', v' and u', as floats."""
        q, v, u = self.configuration(q_tree), exact(v), exact(u)
        step, dv, du = (exact(x) for x in by)
        zero_vector = exact(np.zeros(self.n))
        (a1, l1), (a0, l0) = (
            self.acceleration(
                self.move(q, step, zero_vector, s * SOLUTION_STEP),
                v + s * SOLUTION_STEP * dv,
                u + s * SOLUTION_STEP * du,
            )
            for s in (1, -1)
        )
        return tuple(np.array((one - other) / (2 * SOLUTION_STEP), dtype=float) for one, other in ((a1, a0), (l1, l0)))  # type: ignore[return-value]
