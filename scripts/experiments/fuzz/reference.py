"""Reference integrator: integrate segments of a motion with smaller and smaller steps until two results agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853

from scripts.experiments.fuzz.joint_forces import JointForces
from scripts.experiments.fuzz.newton_euler import MIN_RANK_GAP, NewtonEuler
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import subtract_coordinates, to_coordinates, to_state

__all__ = ["ReferenceEnd", "ReferenceIntegrator"]

MIN_TOLERANCE = 2e-12  # relative; two results differ by rounding below it
MAX_SUBSTEPS = 128
PERTURBATION = 1e-6  # relative, of the velocities
MAX_MAGNIFICATION = 300.0  # of a perturbation; exceeded by segments of several time constants and close to collisions
MAX_ROTATION_RAD = 2.0  # of a segment; angles are unwrapped to less than half a turn from the extrapolated ones
MAX_ACCELERATION = 1e12  # at rest
STAGES, WEIGHTS = DOP853.A, DOP853.B  # order 8, with fixed steps here


@dataclass(frozen=True)
class ReferenceEnd:
    """Ends of P segments: coordinates and rates (P, n), and which segments converged."""

    q: Array
    v: Array
    resolved: np.ndarray
    substeps: np.ndarray


class ReferenceIntegrator:
    """Integrates the motion of one mechanism in absolute coordinates."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.dynamics = NewtonEuler(model)

    def integrate_segments(
        self, q: Array, v: Array, dt: Array, target: float, joint_forces: JointForces | None = None
    ) -> ReferenceEnd:
        """Integrate segments from q, v (P, n) over times dt (P,) to a relative accuracy."""
        target = max(target, MIN_TOLERANCE)
        with np.errstate(all="ignore"):
            return self._integrate_segments(q, v, dt, target, joint_forces)

    def _integrate_segments(
        self, q: Array, v: Array, dt: Array, target: float, joint_forces: JointForces | None
    ) -> ReferenceEnd:
        Y = to_state(self.model, q, v)
        q_approx = q + v * dt[:, None]
        substeps = 1
        end, gap = self.integrate(Y, q_approx, dt, substeps, joint_forces)
        q_end, v_end = to_coordinates(self.model, end, q_approx)
        resolved, substeps_used = np.zeros(len(q), bool), np.full(len(q), MAX_SUBSTEPS)
        while substeps < MAX_SUBSTEPS and not resolved.all():
            substeps *= 2
            unresolved = ~resolved
            forces = None if joint_forces is None else joint_forces[unresolved]
            end, finer_gap = self.integrate(Y[unresolved], q_approx[unresolved], dt[unresolved], substeps, forces)
            q_new, v_new = to_coordinates(self.model, end, q_approx[unresolved])
            error = self.compute_error(q_end[unresolved], v_end[unresolved], q_new, v_new)
            q_end[unresolved], v_end[unresolved], gap[unresolved] = q_new, v_new, finer_gap
            substeps_used[unresolved] = substeps
            resolved[unresolved] = error <= target
        rotation = np.maximum(np.abs(v), np.abs(v_end)).max(axis=1) * dt
        return ReferenceEnd(
            q_end, v_end, resolved & (gap > MIN_RANK_GAP) & (rotation < MAX_ROTATION_RAD), substeps_used
        )

    def find_ill_conditioned(
        self,
        q: Array,
        v: Array,
        dt: Array,
        end: ReferenceEnd,
        mask: np.ndarray,
        joint_forces: JointForces | None = None,
    ) -> np.ndarray:
        """Return which segments of a mask magnify a perturbation of the velocity by more than MAX_MAGNIFICATION."""
        ill_conditioned = np.zeros(len(q), bool)
        selected = np.flatnonzero(mask & end.resolved)
        if len(selected):
            forces = None if joint_forces is None else joint_forces[selected]
            perturbed_rates = v[selected] * (1 + PERTURBATION)  # a multiple of v satisfies the loops
            perturbed = self.integrate_segments(q[selected], perturbed_rates, dt[selected], MIN_TOLERANCE, forces)
            error = self.compute_error(perturbed.q, perturbed.v, end.q[selected], end.v[selected])
            ill_conditioned[selected] = error > MAX_MAGNIFICATION * PERTURBATION
        return ill_conditioned

    def compute_error(self, q: Array, v: Array, q_exact: Array, v_exact: Array) -> Array:
        """Return the largest relative difference of q' or v' by segment; scales are at least 1."""
        q_error, v_error = np.abs(subtract_coordinates(self.model, q, q_exact)), np.abs(v - v_exact)
        q_scale, v_scale = (np.maximum(1, np.abs(exact).max(axis=1)) for exact in (q_exact, v_exact))
        error = np.maximum(q_error.max(axis=1) / q_scale, v_error.max(axis=1) / v_scale)
        return np.where(np.isfinite(error), error, np.inf)

    def integrate(
        self, Y: Array, q_approx: Array, dt: Array, substeps: int, joint_forces: JointForces | None = None
    ) -> tuple[Array, Array]:
        """Return states after times dt (P,) with a fixed number of steps, and each segment's smallest rank gap."""
        h = (dt / substeps)[:, None, None]
        smallest_gap = np.full(len(Y), np.inf)
        K = np.empty((len(WEIGHTS), *Y.shape))
        for _ in range(substeps):
            for s in range(len(WEIGHTS)):
                selected = Y + h * np.tensordot(STAGES[s, :s], K[:s], 1) if s else Y
                try:
                    K[s], gap = self.dynamics.state_derivative(selected, q_approx, joint_forces)
                except np.linalg.LinAlgError:
                    return np.full_like(Y, np.nan), np.zeros(len(Y))
                smallest_gap = np.minimum(smallest_gap, np.where(np.isfinite(gap), gap, 0.0))
            Y = Y + h * np.tensordot(WEIGHTS, K, 1)
        return Y, smallest_gap

    def has_no_mass(self, q: Array) -> bool:
        """Return whether a freedom moves no mass, so that its acceleration is undefined."""
        with np.errstate(all="ignore"):
            try:
                a, alpha, _ = self.dynamics.compute_accelerations(to_state(self.model, q, np.zeros_like(q)), q)
            except np.linalg.LinAlgError:
                return True
        return not (
            np.isfinite(a).all() and np.abs(a).max() < MAX_ACCELERATION and np.abs(alpha).max() < MAX_ACCELERATION
        )
