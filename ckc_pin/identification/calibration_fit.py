"""Fit of parameters to readings of many poses on the constraint manifold: the implicit loop method.

Each pose has a configuration q' of its own with phi(q', p) = 0. Steps of q' are eliminated pose by pose: those that the
parameters force on it by the loops, and those along the null space of J by a projection. What remains is a linear
least-squares problem in the parameters alone, so the cost is linear in the number of poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, BoolArray, IntArray
from ckc_pin.errors import InputError
from ckc_pin.identification.calibration_geometry import Geometry
from ckc_pin.mechanism.batch import integrate_many
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rank import jacobian_scales
from ckc_pin.mechanism.rows import skew
from ckc_pin.mechanism.units import parameter_unit

__all__ = ["RANK_TOLERANCE", "Fit", "Linearization", "Readings"]

RANK_TOLERANCE = 1e-8  # of the largest singular value of the scaled Jacobian; derivatives are exact
REDUNDANT_TOLERANCE = 1e-6  # part of a parameter's derivative of phi that no motion can compensate, relative
MAX_ITERATIONS = 60  # of the Gauss-Newton method
MAX_HALVINGS = 12
MAX_STEP = 0.3  # rad, or mechanism sizes
STEP_TOLERANCE = 1e-13  # rad, or mechanism sizes: a shorter step ends the fit
DECREASE_TOLERANCE = 1e-11  # relative: parameters that can decrease the cost by no more have converged
ROBUST_DECREASE = 1e-6  # the same with Huber's loss
STALL_TOLERANCE = 1e-7  # rad, or mechanism sizes: a longer step without a decrease is no convergence
MAX_CLOSING_STEPS = 10
HOMOTOPY_STEPS = 12  # from the assembled configuration to a pose
MAX_RETRIES = 3  # for poses that miss their readings
MIN_PART = 1e-3  # of a step of a pose
POSE_STEPS = 30  # Gauss-Newton steps of a pose with fixed parameters
MAX_NOISE_ESTIMATES = 15
NOISE_TOLERANCE = 3e-3  # relative
MIN_SIGMA = 1e-12  # rad, or mechanism sizes: smaller residuals are rounding errors
MIN_REDUNDANCY = 0.1  # of readings whose residuals tell of noise one by one
SHARE_OF_NORMAL = 0.71016  # mean of min(x^2, HUBER^2) of a standard normal x
CURVATURE = 0.1  # of an outlier's loss in a step, relative to reweighted least squares
MAX_REJECTIONS = 10  # rounds
REJECTED = 3.5  # standard deviations of a residual from which a robust fit leaves a reading out
POSE_TOLERANCE = 1e-4  # rad, or mechanism sizes: step that ends them
HUBER = 1.345  # standard deviations: 95 % efficiency without outliers


@dataclass(frozen=True)
class Readings:
    """Readings of coordinates and of components of points, a row for each pose; NaN where one is missing.

    Attributes
    ----------
    names : tuple of str
    values : (poses, readings) array
    coordinate : (readings,) int array
        Coordinate that an encoder reads; -1 for a point.
    component : (readings,) int array
        3 k + axis of the k-th point; -1 for an encoder.
    in_metres : (readings,) bool array
    """

    names: tuple[str, ...]
    values: Array
    coordinate: IntArray
    component: IntArray
    in_metres: BoolArray


@dataclass(frozen=True)
class Linearization:
    """Readings near an estimate: z - h = free x + fixed dp, with x along the null space of J of each pose.

    Attributes
    ----------
    residual : (poses, readings) array
        z - h, 0 where a reading is missing.
    free, by_parameter : (poses, readings, d) and (poses, readings, p) arrays
    null_space, forced : (poses, n, d) and (poses, n, p) arrays
        Motions of the mechanism, and those that keep the loops closed when parameters change.
    """

    residual: Array
    free: Array
    by_parameter: Array
    null_space: Array
    forced: Array

    def reduce(self, weights: Array) -> tuple[Array, Array, Array, Callable[[Array], Array]]:
        """Eliminate the motions of the poses from the weighted equations.

        Returns
        -------
        residual : (equations,) array
        matrix : (equations, p) array
        leverage : (poses, readings) array
            Part of each reading that the motions of its pose fit.
        recover : function of dp (p,)
            The steps of all poses (poses, n).
        """
        u, s, vt = np.linalg.svd(weights[..., None] * self.free, full_matrices=False)
        keep = s > 1e-9 * s.max(axis=1, keepdims=True, initial=1e-300)
        u = u * keep[:, None, :]
        r, b = (weights * self.residual)[..., None], weights[..., None] * self.by_parameter

        def recover(dp: Array) -> Array:
            x = np.swapaxes(u, 1, 2) @ (r - (b @ dp)[..., None]) / np.where(keep, s, 1.0)[..., None]
            return np.asarray((self.null_space @ (np.swapaxes(vt, 1, 2) @ x))[..., 0] + self.forced @ dp)

        rest_r, rest_b = (x - u @ (np.swapaxes(u, 1, 2) @ x) for x in (r, b))
        return rest_r.ravel(), rest_b.reshape(-1, b.shape[2]), np.sum(u * u, axis=2), recover


class Fit:
    """The state of a fit: values of all parameters, and the configuration of each pose.

    Parameters are those of the geometry, then the offsets of encoders, then the six of the tracker's frame.

    Parameters
    ----------
    mechanism : Mechanism
    geometry : Geometry
    readings : Readings
    offsets : int array
        Coordinates whose encoders have unknown offsets.
    tracker : bool
        Whether the placement of the tracker's frame in the world is unknown.
    prior : (p,) array
        Standard deviations of the start values; infinite for those without a prior.
    huber : bool
    """

    def __init__(
        self,
        mechanism: Mechanism,
        geometry: Geometry,
        readings: Readings,
        offsets: IntArray,
        tracker: bool,
        prior: Array,
        huber: bool,
    ) -> None:
        self.mechanism, self.geometry, self.readings, self.offsets = mechanism, geometry, readings, offsets
        self.tracker, self.prior, self.huber, self.threshold = tracker, prior, huber, np.inf
        size = mechanism.size
        units = {"m": size, "m/rad": size, "rad/m": 1 / size}
        of_geometry = [units.get(parameter_unit(mechanism, name), 1.0) for name in geometry.names]
        of_tracker = [size] * 3 + [1.0] * 3 if tracker else []
        # Steps of parameters are compared in radians and in units of the mechanism's size.
        self.scale = np.array([*of_geometry, *geometry.tree.step_scale[offsets], *of_tracker])
        self.is_encoder = readings.coordinate >= 0
        self.present = np.isfinite(readings.values)  # a robust fit leaves outliers out
        self.start = np.concatenate([geometry.values, np.zeros(len(offsets) + 6 * tracker)])
        self.values = self.start.copy()
        self.unit = np.where(readings.in_metres, mechanism.size, 1.0)  # of each reading
        self.sigma = self.unit.copy()
        self.linear: Linearization  # at the estimate, after a fit
        # Standard deviations of residuals, relative to those of the readings' errors. A fit hides part of each error.
        self.visible = np.ones_like(readings.values)
        self.q_tree = np.tile(mechanism.q_tree, (len(readings.values), 1))

    # --- readings --------------------------------------------------------------------------------

    def predict(self, values: Array, q_tree: Array) -> Array:
        """Return the readings (poses, readings) without errors."""
        return self._read(values, q_tree, self.geometry.points(q_tree)[0])

    def _read(self, values: Array, q_tree: Array, points: Array) -> Array:
        tree, coordinate = self.geometry.tree, self.readings.coordinate
        h = np.empty((len(q_tree), len(coordinate)))
        h[:, self.is_encoder] = q_tree[:, tree.q_index[coordinate[self.is_encoder]]] + self._offset(values)
        if self.tracker:
            points = (points - values[-6:-3]) @ pin.exp3(values[-3:])
        h[:, ~self.is_encoder] = points.reshape(len(q_tree), -1)[:, self.readings.component[~self.is_encoder]]
        return h

    def _offset(self, values: Array) -> Array:
        by_coordinate, first = np.zeros(self.geometry.tree.n), len(self.geometry.names)
        by_coordinate[self.offsets] = values[first : first + len(self.offsets)]
        return by_coordinate[self.readings.coordinate[self.is_encoder]]

    def linearize(self, values: Array, q_tree: Array, target: Array | None = None) -> Linearization:
        """Return the linearization at closed configurations. The geometry must have these values.

        With a `target` in place of the readings, derivatives with respect to parameters are zero.
        """
        g, count, n = len(self.geometry.names), len(q_tree), self.geometry.tree.n
        points, by_q = self.geometry.points(q_tree)
        inverse, null_space, open_rows = self._split(self.geometry.evaluate(q_tree)[1])
        forced, points_p = np.zeros((count, n, len(values))), np.zeros((*points.shape, g))
        if target is None:
            phi_p, points_p = self.geometry.parameter_derivatives(q_tree)
            forced[..., :g] = -inverse @ phi_p
            self._require_closable(phi_p, open_rows)
        by_p = np.zeros((*points.shape, len(values)))
        by_p[..., :g] = points_p
        if self.tracker:
            rotation = pin.exp3(values[-3:])
            seen = ((points - values[-6:-3]) @ rotation).reshape(-1, 3)
            by_q, by_p = rotation.T @ by_q, rotation.T @ by_p
            by_p[..., -6:-3] = -rotation.T
            by_p[..., -3:] = (skew(seen) @ pin.Jexp3(values[-3:])).reshape(*points.shape, 3)
        c = len(self.is_encoder)
        h_q, h_p = np.zeros((count, c, n)), np.zeros((count, c, len(values)))
        encoders, components = np.flatnonzero(self.is_encoder), self.readings.component[~self.is_encoder]
        read = self.readings.coordinate[encoders]
        h_q[:, encoders, read] = 1.0
        h_p[:, encoders, g : g + len(self.offsets)] = read[:, None] == self.offsets
        h_q[:, ~self.is_encoder] = by_q.reshape(count, -1, n)[:, components]
        h_p[:, ~self.is_encoder] = by_p.reshape(count, -1, len(values))[:, components]
        z = self.readings.values if target is None else target
        residual = np.where(self.present, z - self._read(values, q_tree, points), 0.0)
        return Linearization(residual, h_q @ null_space, h_p + h_q @ forced, null_space, forced)

    def _split(self, jacobian: Array) -> tuple[Array, Array, Array]:
        """Return the pseudoinverses of J (poses, n, rows), null spaces (poses, n, d), and what redundant rows add."""
        rows, columns = jacobian_scales(self.geometry.tree, self.geometry.closure)
        rank = self.mechanism.rank
        u, s, vt = np.linalg.svd(rows[:, None] * jacobian * columns, full_matrices=True)
        s = np.maximum(s[:, :rank], 1e-9 * s[:, :1])
        v = columns[:, None] * np.swapaxes(vt, 1, 2)
        inverse = (v[:, :, :rank] / s[:, None, :]) @ np.swapaxes(u[:, :, :rank], 1, 2) * rows
        return inverse, v[:, :, rank:], np.swapaxes(u[:, :, rank:], 1, 2) * rows

    def _require_closable(self, phi_p: Array, open_rows: Array) -> None:
        """Refuse parameters that redundant rows fix (InputError)."""
        opened = np.abs(open_rows @ phi_p).max(axis=(0, 1), initial=0.0)
        limit = REDUNDANT_TOLERANCE * max(1.0, 1.0 / self.geometry.tree.size)
        if opened.max(initial=0.0) > limit:
            names = [name for name, x in zip(self.geometry.names, opened, strict=True) if x > limit]
            rows = ", ".join(self.mechanism.redundant)
            raise InputError(
                f"calibrate: parameters: {', '.join(names[:4])}{' and others' * (len(names) > 4)}: the loops do not "
                f"close with other values, because rows of theirs are redundant ({rows}); leave these parameters out, "
                "or use loop types without redundant rows, as point_2d"
            )

    # --- configurations --------------------------------------------------------------------------

    def close(self, q_tree: Array) -> tuple[Array, BoolArray]:
        """Project configurations onto phi = 0 by minimum-norm steps. Return them, and which of them are closed."""
        tree, tolerance = self.geometry.tree, max(self.mechanism.tolerance, 1e-11 * self.mechanism.size)
        phi, jacobian = self.geometry.evaluate(q_tree)
        size = np.abs(phi).max(axis=1, initial=0.0)
        for _ in range(MAX_CLOSING_STEPS):
            step = -(self._split(jacobian)[0] @ phi[..., None])[..., 0]
            long = tree.step_size(step)
            step *= np.minimum(1.0, MAX_STEP / np.maximum(long, MAX_STEP))[:, None]
            trial = integrate_many(tree, q_tree, step)
            phi_trial, jacobian_trial = self.geometry.evaluate(trial)
            trial_size = np.abs(phi_trial).max(axis=1, initial=0.0)
            better = trial_size < size
            if not better.any():
                break
            q_tree, phi = np.where(better[:, None], trial, q_tree), np.where(better[:, None], phi_trial, phi)
            jacobian = np.where(better[:, None, None], jacobian_trial, jacobian)
            size = np.where(better, trial_size, size)
            if size.max() <= 1e-15 * self.mechanism.size:
                break
        return q_tree, size <= tolerance

    def place_poses(self) -> None:
        """Find the configuration of each pose with the start values, on the branch of the assembled configuration."""
        readings, tree = self.readings, self.geometry.tree
        weights = self.present / self.unit
        if self.tracker:
            weights = weights * self.is_encoder
        read = readings.coordinate[self.is_encoder]
        measured = np.tile(self.mechanism.q_tree, (len(readings.values), 1))
        angles = readings.values[:, self.is_encoder] - self._offset(self.values)
        at = tree.q_index[read]
        measured[:, at] = np.where(self.present[:, self.is_encoder], angles, measured[:, at])
        if len(read) == tree.n:
            self.q_tree = self._fit_poses(self.close(measured)[0], readings.values, weights)
        else:
            self.q_tree = self._follow(self.q_tree, weights)
            self._retry(lambda _: self.close(measured)[0], weights)
            for _ in range(MAX_RETRIES):
                self._retry(lambda good: self._follow(self._nearest(good, weights), weights), weights)
        if self.tracker:
            self._place_tracker()
            self.q_tree = self._fit_poses(self.q_tree, readings.values, self.present / self.unit)

    def misses(self, weights: Array | None = None) -> Array:
        """Return the distance of each pose from its readings, rms in rad or mechanism sizes."""
        weights = self.present / self.unit if weights is None else weights
        residual = np.where(self.present, self.readings.values - self.predict(self.values, self.q_tree), 0.0)
        count = np.maximum(np.count_nonzero(weights, axis=1), 1)
        return np.asarray(np.linalg.norm(weights * residual, axis=1) / np.sqrt(count))

    def _fit_poses(self, q_tree: Array, target: Array, weights: Array, steps: int = POSE_STEPS) -> Array:
        """Move each pose along the manifold towards its target by Gauss-Newton steps that come nearer to it."""
        part = np.ones(len(q_tree))
        linear, zero = self.linearize(self.values, q_tree, target), np.zeros(len(self.values))
        for _ in range(steps):
            step = linear.reduce(weights)[3](zero) * part[:, None]
            size = self.geometry.tree.step_size(step)
            step *= np.minimum(1.0, MAX_STEP / np.maximum(size, MAX_STEP))[:, None]
            trial, closed = self.close(integrate_many(self.geometry.tree, q_tree, step))
            after = self.linearize(self.values, trial, target)
            before, now = (np.linalg.norm(weights * x.residual, axis=1) for x in (linear, after))
            nearer = closed & (now < before)
            q_tree = np.where(nearer[:, None], trial, q_tree)
            part = np.where(nearer, np.minimum(1.0, 2 * part), part / 4)
            if np.where(part > MIN_PART, size, 0.0).max(initial=0.0) < POSE_TOLERANCE:
                break
            linear = self.linearize(self.values, q_tree, target)
        return q_tree

    def _follow(self, q_tree: Array, weights: Array) -> Array:
        """Follow the straight line from the readings at closed configurations to those of the poses."""
        start, values = self.predict(self.values, q_tree), self.readings.values
        for part in np.linspace(0.0, 1.0, HOMOTOPY_STEPS + 1)[1:]:
            q_tree = self._fit_poses(q_tree, start + part * (values - start), weights, 2)
        return self._fit_poses(q_tree, values, weights)

    def _retry(self, find: Callable[[BoolArray], Array], weights: Array) -> None:
        """Start poses that miss their readings again where a function of the poses that meet theirs says."""
        misses = self.misses(weights)
        bad = misses > 5 * np.median(misses) + 1e-6
        if bad.any() and not bad.all():
            before, start = self.q_tree, np.where(bad[:, None], find(~bad), self.q_tree)
            self.q_tree = self._fit_poses(start, self.readings.values, weights)
            self.q_tree = np.where((self.misses(weights) < misses)[:, None], self.q_tree, before)

    def _nearest(self, good: BoolArray, weights: Array) -> Array:
        """Return for each pose the configuration of the nearest of some others."""
        values = np.nan_to_num(self.readings.values) * weights
        distance = np.linalg.norm(values[:, None] - values[None, good], axis=2)
        return np.asarray(self.q_tree[np.flatnonzero(good)[distance.argmin(axis=1)]])

    def _place_tracker(self) -> None:
        """Set the tracker's frame to the one that fits the points best (Kabsch)."""
        at = self.readings.component
        full = [k for k in range(len(self.mechanism.points)) if all(3 * k + axis in at for axis in range(3))]
        columns = [[at.tolist().index(3 * k + axis) for axis in range(3)] for k in full]
        seen = self.readings.values[:, columns].reshape(-1, 3)
        world = self.geometry.points(self.q_tree)[0][:, full].reshape(-1, 3)
        valid = np.isfinite(seen).all(axis=1)
        if np.count_nonzero(valid) < 3:
            raise InputError(
                'calibrate: tracker = "unknown" needs x, y and z of a point in at least 3 poses, to place its frame'
            )
        seen, world = seen[valid], world[valid]
        u, _, vt = np.linalg.svd((world - world.mean(axis=0)).T @ (seen - seen.mean(axis=0)))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        self.values[-3:] = pin.log3(rotation)
        self.values[-6:-3] = world.mean(axis=0) - rotation @ seen.mean(axis=0)
        self.start[-6:] = self.values[-6:]

    # --- Gauss-Newton ----------------------------------------------------------------------------

    def cost(self, values: Array, residual: Array) -> float:
        """Return half the sum of squares, or Huber's loss, with that of the prior."""
        size = self.sizes(residual)
        loss = np.where(size > self.threshold, self.threshold * (size - self.threshold / 2), size**2 / 2)
        return float(np.sum(self.visible**2 * loss) + np.sum(((values - self.start) / self.prior) ** 2) / 2)

    def sizes(self, residual: Array) -> Array:
        """Return absolute residuals in units of their standard deviations."""
        return np.asarray(np.abs(residual) / (self.sigma * self.visible))

    def _reweight(self, linear: Linearization) -> tuple[Linearization, Array]:
        """Return equations and weights whose solution is the next step.

        Huber's loss is linear for an outlier: it has a slope, and no curvature. Reweighted least squares gives it more
        curvature than a secant has, and converges slowly. Less of it, at the same slope, takes a fifth of the steps.
        """
        size = self.sizes(linear.residual)
        far = size > self.threshold
        factor = np.where(far, CURVATURE * self.threshold / np.maximum(size, 1e-300), 1.0)
        residual = np.where(far, linear.residual / CURVATURE, linear.residual)
        return replace(linear, residual=residual), self.present * np.sqrt(factor) / self.sigma

    def equations(self, linear: Linearization, weights: Array) -> tuple[Array, Array, Array, Callable[[Array], Array]]:
        """Return `Linearization.reduce` with an equation for each prior."""
        residual, matrix, leverage, recover = linear.reduce(weights)
        at = np.flatnonzero(np.isfinite(self.prior))
        rows = np.eye(len(self.prior))[at] / self.prior[at, None]
        offset = (self.start - self.values)[at] / self.prior[at]
        return np.concatenate([residual, offset]), np.vstack([matrix, rows]), leverage, recover

    def run(self) -> tuple[bool, int]:
        """Fit all parameters and poses from the present state. Return whether that converged, and the iterations."""
        scale, tree = self.scale, self.geometry.tree
        self.linear = self.linearize(self.values, self.q_tree)
        cost = self.cost(self.values, self.linear.residual)
        for iteration in range(1, MAX_ITERATIONS + 1):
            residual, matrix, _, recover = self.equations(*self._reweight(self.linear))
            u, s, vt = np.linalg.svd(matrix * scale, full_matrices=False)
            rank = int(np.sum(s > RANK_TOLERANCE * s.max(initial=0.0)))
            reduced = u[:, :rank].T @ residual
            dp = scale * (vt[:rank].T @ (reduced / s[:rank]))
            dq = recover(dp)
            longest = max(float(np.abs(dp / scale).max(initial=0.0)), float(tree.step_size(dq).max(initial=0.0)))
            tolerance = ROBUST_DECREASE if np.isfinite(self.threshold) else DECREASE_TOLERANCE
            # The motions of the poses follow those of the parameters, once there was a step.
            is_small = iteration > 1 and reduced @ reduced / 2 <= tolerance * cost
            if longest < STEP_TOLERANCE or is_small:
                return True, iteration
            part = min(1.0, MAX_STEP / longest)
            for _ in range(MAX_HALVINGS):
                values = self.values + part * dp
                self.geometry.set_values(values[: len(self.geometry.names)])
                q_tree, closed = self.close(integrate_many(tree, self.q_tree, part * dq))
                if closed.all():
                    trial = self.linearize(values, q_tree)
                    trial_cost = self.cost(values, trial.residual)
                    if trial_cost < cost:
                        break
                part /= 2
            else:
                self.geometry.set_values(self.values[: len(self.geometry.names)])
                return longest < STALL_TOLERANCE, iteration
            self.values, self.q_tree, self.linear, cost = values, q_tree, trial, trial_cost
        return False, MAX_ITERATIONS

    def fit_with_noise(self, estimated: list[BoolArray]) -> tuple[bool, int]:
        """Fit, and estimate the standard deviations of groups of readings from their residuals, until both agree.

        Huber's loss finds outliers. They are then left out, the worst of each pose at a time, and the final fit is one
        of least squares, so that its standard deviations are valid.

        Parameters
        ----------
        estimated : list of (readings,) bool arrays
            Groups of readings of one unknown standard deviation each.
        """
        total = self._fit_and_estimate(estimated)
        if self.huber:
            self.threshold = HUBER
            total += self._fit_and_estimate(estimated)
            # The residual of a reading that hardly influences the fit has the standard deviation sigma / v, not
            # sigma v, if the part v^2 of its error is visible in least squares.
            size = self.sizes(self.linear.residual)
            self._leave_out(size * np.where(size > self.threshold, self.visible**2, 1.0))
            self.threshold = np.inf
            total += self._fit_and_estimate(estimated)
        for _ in range(MAX_REJECTIONS if self.huber else 0):
            if not self._leave_out(self.sizes(self.linear.residual)):
                break
            total += self._fit_and_estimate(estimated)
        if self.huber and self._reinstate():
            total += self._fit_and_estimate(estimated)
        return self.converged, total

    def _leave_out(self, size: Array) -> bool:
        """Leave out the worst reading of each pose if its residual has a large size; return whether any is left out."""
        worst = self.present & (size >= np.maximum(size.max(axis=1, keepdims=True), REJECTED))
        self.present &= ~worst
        return bool(worst.any())

    def _reinstate(self) -> bool:
        """Take readings back that were left out because of others, and agree with the fit; return whether any does."""
        kept, values = self.present, self.readings.values
        self.present = np.isfinite(values)
        self.linear = self.linearize(self.values, self.q_tree)
        sizes = np.abs(self.linear.residual) * np.sqrt(self.redundancy()) / self.sigma
        self.present = kept | (self.present & (sizes < REJECTED))
        self.linear = self.linearize(self.values, self.q_tree)
        return bool(np.any(self.present != kept))

    def _fit_and_estimate(self, estimated: list[BoolArray]) -> int:
        total = 0
        for _ in range(MAX_NOISE_ESTIMATES):
            self.converged, iterations = self.run()
            total += iterations
            before, redundancy = self.sigma.copy(), self.redundancy()
            for group in estimated:
                sigma = self._estimate_sigma(self.linear.residual[:, group], redundancy[:, group], group)
                self.sigma[group] = np.maximum(sigma, MIN_SIGMA * self.unit[group])
            if np.all(np.abs(self.sigma / before - 1) < NOISE_TOLERANCE) or not self._depends_on_noise(estimated):
                break
        if self.huber:
            self.visible = np.sqrt(np.maximum(redundancy, MIN_REDUNDANCY))
        return total

    def _depends_on_noise(self, estimated: list[BoolArray]) -> bool:
        """Whether the estimate depends on the estimated standard deviations, not only on their ratios."""
        is_common = len(estimated) == 1 and bool(estimated[0].all())
        return np.isfinite(self.threshold) or not is_common or bool(np.isfinite(self.prior).any())

    def redundancy(self) -> Array:
        """Return the part of the error of each reading that its residual shows; 0 where a reading is missing."""
        weights = self.present / self.sigma
        _, matrix, leverage, _ = self.equations(self.linear, weights)
        u, s, _ = np.linalg.svd(matrix * self.scale, full_matrices=False)
        u = u[: weights.size, s > RANK_TOLERANCE * s.max(initial=0.0)]
        redundancy = 1.0 - leverage - np.sum(u * u, axis=1).reshape(weights.shape)
        return np.where(self.present, np.maximum(redundancy, 0.0), 0.0)

    def _estimate_sigma(self, residual: Array, redundancy: Array, group: BoolArray) -> float:
        """Return the standard deviation of readings, with Huber's loss by his proposal 2."""
        limit = self.threshold * self.sigma[group] * self.visible[:, group]
        share = SHARE_OF_NORMAL if np.isfinite(self.threshold) else 1.0
        squares = np.sum(np.minimum(np.abs(residual), limit) ** 2)
        return float(np.sqrt(squares / max(share * float(redundancy.sum()), 1e-12)))
