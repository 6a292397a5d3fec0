"""Eq. 6 at many instants of a motion of the independent coordinates, with exact first and second derivatives.

The dependent coordinates, their rates and accelerations, and the multipliers are functions of q, q_dot, q_ddot and the
motor torques. They are eliminated instant by instant: the loops are closed to rounding at each instant, and derivatives
follow from the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, Immutable, IntArray
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.many_instants import InstantsFunction
from ckc_pin.optimization.motion_functions import MotionFunctions

__all__ = ["Derivatives", "MotionInstants", "ReducedDynamics"]

MAX_CONTINUATION_STEP = 0.25  # rad, or sizes of the mechanism: of q between two closures
FINER_STEPS = (0.03, 0.004, 0.0005)  # the same, one after the other where a place cannot be followed
MAX_FOLLOWED_STEP = 0.2  # rad, or sizes of the mechanism: from a configuration to those that are closed from it
MAX_NEWTON_STEPS = 12
MAX_NEWTON_STEP = 1.0  # rad, or sizes of the mechanism
MAX_PIECES = 64  # of a step of q


class MotionInstants(Immutable, frozen=True):
    """A motion at m instants.

    Attributes
    ----------
    q_tree : (m, nq) array
    v_tree, a_tree : (m, n) array
    multipliers : (m, rows) array
        Of the independent constraint rows.
    tau : (m, motors) array
        N m, N.
    force : (m, d) array
        D q_ddot + C q_dot + h less the motors' rho^T u': zero along a motion.
    """

    q_tree: Array
    v_tree: Array
    a_tree: Array
    multipliers: Array
    tau: Array
    force: Array


class Derivatives(Immutable, frozen=True):
    """Derivatives of `MotionInstants` by x = (q, q_dot, q_ddot, tau), each of shape (m, ..., 3 d + motors)."""

    q_tree: Array
    v_tree: Array
    a_tree: Array
    multipliers: Array
    force: Array
    blocks: tuple[Array, ...] = ()  # derivatives of rows and forces of the tree


class ReducedDynamics:
    """The reduced equations of motion of a mechanism at many instants.

    Parameters
    ----------
    mechanism : Mechanism

    Attributes
    ----------
    slip : float
        Dry friction is friction v / sqrt(v^2 + slip^2), with slip in rad/s, or sizes of the mechanism per second. 0:
        there is none, or that of `directions`.
    directions : (m, n) array, optional
        Signs of the rates that dry friction opposes at the instants of a motion.
    state_symbols : tuple of casadi.SX
        q', v', dv'/dt and tau.

    Raises
    ------
    InputError
        CasADi is not installed, or a free root is independent.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        try:
            import casadi
        except ModuleNotFoundError as error:
            raise InputError("optimize needs CasADi, which is not installed: pip install ckc_pin[symbolic]") from error
        tree = mechanism.tree
        of_root = [name for name in mechanism.independent if name in tree.free_coordinates]
        if of_root:
            raise InputError(f"optimize: {of_root[0]} belongs to a free root; choose independent coordinates of joints")
        self.mechanism, self.d, self.n = mechanism, mechanism.d, mechanism.n
        self.motors, self.slip = len(mechanism.motors.names), 0.0
        self.directions: Array | None = None
        self.q_at, self.z_at = mechanism.partition.q, mechanism.partition.z
        self.q_in_tree = tree.q_index[self.q_at]
        self.z_in_tree = np.setdiff1d(np.arange(tree.nq), self.q_in_tree)
        self._functions = MotionFunctions(mechanism)
        self._last = np.zeros((0, 0)), np.zeros(0), np.zeros(0)  # configurations, Jacobians and inverses
        self.state_symbols = tuple(
            casadi.SX.sym(name, size)
            for name, size in (("q", tree.nq), ("v", self.n), ("v_dot", self.n), ("tau", self.motors))
        )

    @cached_property
    def phi_z(self) -> Any:
        """CasADi expression of phi_z."""
        return self._functions.jacobian_at(self.state_symbols[0])[:, self.z_at.tolist()]

    @cached_property
    def points(self) -> Any:
        """CasADi expression of the positions of the named points, a column of 3 per point."""
        return self._functions.points_at(self.state_symbols[0])

    @cached_property
    def _points(self) -> InstantsFunction:
        return InstantsFunction.of([self.state_symbols[0]], [self.points])

    # --- values ----------------------------------------------------------------------------------

    def close(self, q_tree: Array, q: Array, step: float = MAX_CONTINUATION_STEP) -> Array | None:
        """Return closed configurations (m, nq) at q (m, d), followed from closed ones; None if the loops do not close.

        det phi_z keeps its sign. `step` is the longest of q between two closures, rad or sizes of the mechanism.
        """
        scale = self.mechanism.tree.step_scale[self.q_at]
        start = q_tree[:, self.q_in_tree]
        far = np.max(np.abs(q - start) / scale, initial=0.0)
        if not far < MAX_PIECES * MAX_CONTINUATION_STEP:
            return None
        count = 1 + int(far / step)
        _, jacobian = self._functions.closure(q_tree)
        signs = np.sign(np.linalg.det(jacobian[:, :, self.z_in_tree]))
        for k in range(1, count + 1):
            target = start + (q - start) * (k / count)
            predicted = self._newton_step(jacobian, jacobian[:, :, self.q_in_tree], target - q_tree[:, self.q_in_tree])
            q_tree = np.array(q_tree)
            q_tree[:, self.q_in_tree] = target
            q_tree[:, self.z_in_tree] += predicted
            result = self._newton(q_tree)
            if result is None:
                return None
            q_tree, jacobian = result
            if np.any(np.sign(np.linalg.det(jacobian[:, :, self.z_in_tree])) != signs):
                return None
        return q_tree

    def follow(self, start: Array, q: Array) -> Array | None:
        """Return closed configurations at q (m, d), each followed from the one before, from a start (nq,) on.

        None if the loops do not close.
        """
        scale = float(self.mechanism.tree.step_scale[self.q_at].min(initial=1.0))
        at, result, begin = start[None], np.empty((len(q), len(start))), 0
        while begin < len(q):
            # Places near the last configuration are closed together.
            reachable = np.abs(q[begin:] - at[0, self.q_in_tree]).max(axis=1, initial=0.0) <= MAX_FOLLOWED_STEP * scale
            end = begin + max(1, len(reachable) if reachable.all() else int(np.argmin(reachable)))
            closed = self.close(np.tile(at, (end - begin, 1)), q[begin:end])
            while closed is None and end > begin + 1:
                end = begin + (end - begin) // 2
                closed = self.close(np.tile(at, (end - begin, 1)), q[begin:end])
            for step in FINER_STEPS:  # near singular configurations
                closed = self.close(at, q[begin:end], step) if closed is None else closed
            if closed is None:
                return None
            result[begin:end] = closed
            at, begin = closed[-1:], end
        return result

    def residual(self, q_tree: Array) -> Array:
        """Return phi of the independent rows and of quaternions' norms at configurations (m, nq), (m, rows)."""
        return self._functions.closure(q_tree)[0][:, :, 0]

    def _newton(self, q_tree: Array) -> tuple[Array, Array] | None:
        for _ in range(MAX_NEWTON_STEPS):
            phi, jacobian = self._functions.closure(q_tree)
            size = np.abs(phi).max(initial=0.0)
            if not np.isfinite(size):
                return None
            if size <= self.mechanism.tolerance:
                return q_tree, jacobian
            step = self._newton_step(jacobian, phi, np.ones((len(phi), 1)))
            if not np.abs(step).max(initial=0.0) <= MAX_NEWTON_STEP * max(1.0, self.mechanism.size):
                return None
            q_tree[:, self.z_in_tree] += step
        return None

    def _newton_step(self, jacobian: Array, columns: Array, weights: Array) -> Array:
        """Return -phi_z^-1 (columns @ weights), (m, nz)."""
        right = np.einsum("mrd,md->mr", columns, weights)
        if not right.shape[1]:
            return right
        try:
            return -np.linalg.solve(jacobian[:, :, self.z_in_tree], right[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return np.full_like(right, np.nan)

    def rho(self, q_tree: Array) -> Array:
        """Return rho of eq. 5 at closed configurations, (m, n, d)."""
        return self._rho(*self._jacobians_and_inverses(q_tree))

    def transmission(self, q_tree: Array) -> Array:
        """Return rho^T G^T at closed configurations, (m, d, motors): forces of eq. 6 by motor torques."""
        return np.einsum("mnd,kn->mdk", self.rho(q_tree), self.mechanism.motors.transmission)

    def _rho(self, J: Array, inverse: Array) -> Array:
        rho = np.zeros((len(J), self.n, self.d))
        rho[:, self.q_at, np.arange(self.d)] = 1.0
        rho[:, self.z_at] = -inverse @ J[:, :, self.q_at]
        return rho

    def jacobians(self, q_tree: Array) -> Array:
        """Return the independent rows of J at configurations (m, nq), (m, rows, n)."""
        return self._functions.rates(q_tree, np.zeros((len(q_tree), self.n)))[0]

    def _jacobians_and_inverses(self, q_tree: Array) -> tuple[Array, Array]:
        """Return J (m, rows, n) and phi_z^-1 (m, nz, rows), which are kept until other configurations are given."""
        last = self._last
        if not np.array_equal(last[0], q_tree):
            J = self.jacobians(q_tree)
            last = self._last = np.array(q_tree), J, _inverse(J[:, :, self.z_at])
        return last[1:]

    def smallest_singular_values(self, q_tree: Array, z_at: IntArray | None = None) -> Array:
        """Return smallest singular values of phi_z at configurations (m, nq); 1 without loops.

        `z_at` are the places of the dependent coordinates, by default those of the motion.
        """
        z_at = self.z_at if z_at is None else z_at
        if not len(z_at):
            return np.ones(len(q_tree))
        return np.asarray(np.linalg.svd(self.jacobians(q_tree)[:, :, z_at], compute_uv=False)[:, -1], dtype=float)

    def margins(self, q_tree: Array, z_at: IntArray | None = None) -> Array:
        """Return the values of `smallest_singular_values`, relative to the first."""
        smallest = self.smallest_singular_values(q_tree, z_at)
        return smallest / smallest[0]

    def distances(self, q_tree: Array, spheres: Sequence[tuple[str, Array, float]]) -> Array:
        """Return the distances of points from centres at configurations, (m, spheres)."""
        if not spheres:
            return np.zeros((len(q_tree), 0))
        positions = self._points(q_tree)[0].reshape(len(q_tree), -1, 3)
        names = list(self.mechanism.points)
        return np.array([np.linalg.norm(positions[:, names.index(name)] - centre, axis=1)
                         for name, centre, _ in spheres]).T  # fmt: skip

    def instants(self, q_tree: Array, v: Array, a: Array, tau: Array) -> MotionInstants:
        """Return a motion at closed configurations with rates and accelerations (m, d) and torques (m, motors)."""
        v_tree, a_tree = np.zeros((2, len(q_tree), self.n))
        J, inverse = self._jacobians_and_inverses(q_tree)
        v_tree[:, self.q_at], a_tree[:, self.q_at] = v, a
        v_tree[:, self.z_at] = -_times(inverse, _times(J[:, :, self.q_at], v))
        _, J_dot_v = self._functions.rates(q_tree, v_tree)
        a_tree[:, self.z_at] = -_times(inverse, _times(J[:, :, self.q_at], a) + J_dot_v[:, :, 0])
        (passive,) = self._functions.forces(q_tree, v_tree, a_tree)
        forces = passive[:, :, 0] + self._friction(v_tree)[0] - tau @ self.mechanism.motors.transmission
        multipliers, missing = self._reduce(q_tree, forces)
        return MotionInstants(q_tree, v_tree, a_tree, multipliers, tau, missing)

    def with_torques(self, at: MotionInstants, tau: Array) -> MotionInstants:
        """Return a motion with other motor torques (m, motors)."""
        multipliers, force = self._reduce(at.q_tree, (at.tau - tau) @ self.mechanism.motors.transmission)
        return replace(at, multipliers=at.multipliers + multipliers, tau=tau, force=at.force + force)

    def _reduce(self, q_tree: Array, force: Array) -> tuple[Array, Array]:
        """Return the multipliers (m, rows) that balance a force (m, n) along z, and what remains of it along q."""
        J, inverse = self._jacobians_and_inverses(q_tree)
        multipliers = _times(inverse.transpose(0, 2, 1), force[:, self.z_at])
        return multipliers, force[:, self.q_at] - _times(J[:, :, self.q_at].transpose(0, 2, 1), multipliers)

    def _friction(self, v_tree: Array) -> Array:
        """Return the forces that dry friction takes, and two derivatives by the rates, (3, m, n)."""
        if not self.slip:
            forces = np.zeros((3, *v_tree.shape))
            if self.directions is not None:
                forces[0] = self.directions * self.mechanism.joints.friction
            return forces
        slip = self.slip * self.mechanism.tree.step_scale
        square = v_tree**2 + slip**2
        sign = np.array([v_tree / square**0.5, slip**2 / square**1.5, -3 * slip**2 * v_tree / square**2.5])
        return sign * self.mechanism.joints.friction

    # --- derivatives -----------------------------------------------------------------------------

    def differentiate(self, at: MotionInstants) -> Derivatives:
        """Return the derivatives of a motion's quantities by q, q_dot, q_ddot and tau of each instant."""
        m, d, n, q_at, z_at = len(at.q_tree), self.d, self.n, self.q_at, self.z_at
        blocks = self._functions.first(at.q_tree, at.v_tree, at.a_tree, at.multipliers)
        phi_q, J, rate_q, acc_q, acc_v, balance_q, balance_v, balance_a = blocks
        balance_v[:, np.arange(n), np.arange(n)] += self._friction(at.v_tree)[1]
        size = 3 * d + self.motors
        inverse, J_q = _inverse(J[:, :, z_at]), J[:, :, q_at]
        q_tree = np.zeros((m, self.mechanism.tree.nq, size))
        v_tree, a_tree = np.zeros((2, m, n, size))
        unit = np.arange(d)
        q_tree[:, self.q_in_tree, unit] = 1.0
        q_tree[:, self.z_in_tree, :d] = -_inverse(phi_q[:, :, self.z_in_tree]) @ phi_q[:, :, self.q_in_tree]
        v_tree[:, q_at, d + unit] = 1.0
        v_tree[:, z_at] = -inverse @ (rate_q @ q_tree + J_q @ v_tree[:, q_at])
        a_tree[:, q_at, 2 * d + unit] = 1.0
        a_tree[:, z_at] = -inverse @ (acc_q @ q_tree + acc_v @ v_tree + J_q @ a_tree[:, q_at])
        balance = balance_q @ q_tree + balance_v @ v_tree + balance_a @ a_tree
        balance[:, :, 3 * d :] -= self.mechanism.motors.transmission.T
        multipliers = inverse.transpose(0, 2, 1) @ balance[:, z_at]
        force = balance[:, q_at] - J_q.transpose(0, 2, 1) @ multipliers
        return Derivatives(q_tree, v_tree, a_tree, multipliers, force, tuple(blocks))

    def state_derivatives(self, by_x: Derivatives) -> Array:
        """Return the derivatives of the state (q', v', dv'/dt, tau) of each instant, (m, nq + 2 n + motors, size)."""
        tau = np.zeros((len(by_x.q_tree), self.motors, by_x.q_tree.shape[2]))
        tau[:, np.arange(self.motors), 3 * self.d + np.arange(self.motors)] = 1.0
        return np.concatenate([by_x.q_tree, by_x.v_tree, by_x.a_tree, tau], axis=1)

    def hessian(
        self, at: MotionInstants, by_x: Derivatives, weights: Array, state_weights: Array | None = None
    ) -> Array:
        """Return the second derivatives of weights (m, d) times the missing force, (m, 3 d + motors, 3 d + motors).

        Parameters
        ----------
        state_weights : (m, nq + 2 n + motors) array, optional
            The result includes the second derivatives of these weights times the state (q', v', dv'/dt, tau).
        """
        z_at = self.z_at
        phi_q, J, rate_q, acc_q, acc_v, balance_q, balance_v, balance_a = by_x.blocks
        inverse = _inverse(J[:, :, z_at])
        w_balance = _times(self._rho(J, inverse), weights)
        to_rows = inverse.transpose(0, 2, 1)
        nq, n = self.mechanism.tree.nq, self.n
        extra = np.zeros((len(weights), nq + 2 * n + self.motors)) if state_weights is None else state_weights
        by_a = _transposed(balance_a, w_balance) + extra[:, nq + n : nq + 2 * n]
        w_acceleration = -_times(to_rows, by_a[:, z_at])
        by_v = _transposed(balance_v, w_balance) + _transposed(acc_v, w_acceleration) + extra[:, nq : nq + n]
        w_rate = -_times(to_rows, by_v[:, z_at])
        by_q = _transposed(balance_q, w_balance) + _transposed(acc_q, w_acceleration) + _transposed(rate_q, w_rate)
        by_q += extra[:, :nq]
        inverse_q = _inverse(phi_q[:, :, self.z_in_tree])
        w_phi = -_times(inverse_q.transpose(0, 2, 1), by_q[:, self.z_in_tree])
        qq, qv, vv, qa, ql = self._functions.second(
            at.q_tree, at.v_tree, at.a_tree, at.multipliers, w_phi, w_rate, w_acceleration, w_balance
        )
        vv[:, np.arange(n), np.arange(n)] += w_balance * self._friction(at.v_tree)[2]
        mixed = qq @ by_x.q_tree / 2 + qv @ by_x.v_tree + qa @ by_x.a_tree + ql @ by_x.multipliers
        half = by_x.q_tree.transpose(0, 2, 1) @ mixed + by_x.v_tree.transpose(0, 2, 1) @ (vv @ by_x.v_tree) / 2
        return half + half.transpose(0, 2, 1)


def _times(matrices: Array, vectors: Array) -> Array:
    return np.einsum("mij,mj->mi", matrices, vectors)


def _transposed(matrices: Array, vectors: Array) -> Array:
    return np.einsum("mij,mi->mj", matrices, vectors)


def _inverse(matrices: Array) -> Array:
    """Return the inverses of matrices, NaN if one of them is singular."""
    try:
        return np.asarray(np.linalg.inv(matrices), dtype=float)
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)
