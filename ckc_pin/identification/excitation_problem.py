"""Periodic motions of the independent coordinates, and the search for those that make parameters best known.

The regressor of an instant depends on the motion only through q, q_dot and q_ddot there. Its derivatives by the Fourier
coefficients follow by the chain rule from 3d differences at each instant, however many coefficients there are.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, BoolArray, Immutable
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import STRUCTURAL_RANK_TOLERANCE
from ckc_pin.identification.measured_motion import MeasuredMotion, close_many, motion_along
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.mechanism.batch import evaluate_closure
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Criterion", "ExcitationProblem", "Instants", "Limits", "fourier", "singular_values"]

Criterion = Literal["condition", "log_det"]

SAMPLES_PER_WAVE = 16  # of the highest harmonic, on the grid that is optimized
MAX_CONTINUATION_STEP = 0.25  # rad, or sizes of the mechanism
MAX_DECAY = 1.5  # of the amplitudes of random motions with the order of the wave, an exponent
BISECTIONS = 7  # of the amplitude of a random motion
DIFFERENCE_STEP = 1e-6  # relative to typical sizes
SLOW = 0.02  # of the typical rate: dry friction is smoothed below it while derivatives are needed
STAGES = ((4.0, 50.0), *6 * [(20.0, 200.0)])  # sharpness of condition number and of limits; the last ones narrow limits
REPAIR_STEP = 1e-3  # sizes by which limits are narrowed in addition to a violation, at the first repair
MAX_REPAIR = 0.1  # sizes by which limits are narrowed at once
OBJECTIVE_SCALE = 0.1  # so that the first steps, along the gradient, are short
VIOLATION_PRICE = 100.0  # in the criterion, of a violation by one size
FAILURE = 1e3  # value of a motion that cannot be followed, above the logarithm of any condition number


class Limits(Immutable, frozen=True):
    """Limits of all quantities of a motion: coordinates, rates, accelerations, shaft speeds, torques, singular values.

    Attributes
    ----------
    names : tuple of str
    lower, upper : (k,) arrays
        Infinite if there is no limit.
    scale : (k,) array
        Size by which a violation is measured.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    scale: Array

    @property
    def used(self) -> BoolArray:
        """Whether a quantity has a limit."""
        return np.isfinite(self.lower) | np.isfinite(self.upper)

    def violation(self, quantities: Array) -> Array:
        """Return by how much instants (m, k) exceed both limits, in sizes, shape (2, m, k); negative inside."""
        return np.array([self.lower - quantities, quantities - self.upper]) / self.scale

    def worst(self, quantities: Array) -> Array:
        """Return the largest violation of each quantity over all instants, shape (k,)."""
        return np.asarray(self.violation(quantities).max(axis=(0, 1)))


class Instants(Immutable, frozen=True):
    """A motion at m instants with its quantities and its weighted regressor.

    Attributes
    ----------
    motion : MeasuredMotion
    quantities : (m, k) array
        In the order of the limits.
    regressor : (m, motors, p) array
        Columns in typical sizes, rows in standard deviations of the motors' torques.
    """

    motion: MeasuredMotion
    quantities: Array
    regressor: Array


def fourier(t: Array, period: float, harmonics: int) -> Array:
    """Return offset, sines and cosines, their rates and accelerations, shape (3, m, 1 + 2 harmonics)."""
    w = 2 * np.pi / period * np.arange(1, harmonics + 1)
    sine, cosine, one = np.sin(np.outer(t, w)), np.cos(np.outer(t, w)), np.ones((len(t), 1))
    return np.array([np.hstack([one, sine, cosine]), np.hstack([0 * one, w * cosine, -w * sine]),
                     np.hstack([0 * one, -(w**2) * sine, -(w**2) * cosine])])  # fmt: skip


def singular_values(mechanism: Mechanism, q_tree: Array, rho: Array) -> tuple[Array, Array]:
    """Return the smallest singular values of phi_z, 1 without loops, and of the motors, (m, 2), and signs of det phi_z.

    Redundant rows are left out of phi_z.
    """
    _, J = evaluate_closure(mechanism.tree, mechanism.closure, q_tree)
    phi_z = J[:, mechanism.independent_rows][:, :, mechanism.partition.z]
    sigma = np.ones((len(q_tree), 2))
    if phi_z.shape[1]:
        sigma[:, 0] = np.linalg.svd(phi_z, compute_uv=False)[:, -1]
    sigma[:, 1] = np.linalg.svd(mechanism.motors.transmission @ rho, compute_uv=False)[:, -1]
    return sigma, np.sign(np.linalg.det(phi_z))


class ExcitationProblem:
    """The best motion of a period within limits.

    Parameters
    ----------
    regressor : TorqueRegressor
    period : float
        s.
    harmonics : int
    limits : Limits
    noise : (motors,) array
        Standard deviations of measured torques.
    criterion : "condition" or "log_det"

    Attributes
    ----------
    basis : (p, r) array
        Orthonormal directions of the unknowns that some motion determines, in typical sizes.
    """

    def __init__(
        self, regressor: TorqueRegressor, period: float, harmonics: int, limits: Limits, noise: Array,
        criterion: Criterion,
    ) -> None:  # fmt: skip
        self.mechanism, self.regressor, self.limits = regressor.mechanism, regressor, limits
        self.noise, self.criterion = noise, criterion
        tree, at = self.mechanism.tree, self.mechanism.partition.q
        self.period, self.harmonics, self.d = period, harmonics, len(at)
        self.t = np.arange(SAMPLES_PER_WAVE * harmonics) * period / (SAMPLES_PER_WAVE * harmonics)
        self.waves = fourier(self.t, period, harmonics)
        self.start = tree.to_coordinates(self.mechanism.assembled.q_tree)[at]
        self.size = np.array([1.0, 2 * np.pi / period, (2 * np.pi / period) ** 2])[:, None] * tree.step_scale[at]
        self.lower, self.upper = limits.lower[at], limits.upper[at]
        self.order = np.concatenate([[1.0], *2 * [np.arange(1, harmonics + 1)]])
        self.unit = (self.upper - self.lower)[:, None] / 2 / self.order  # of a Fourier coefficient
        assembled = self.mechanism.assembled
        _, self._sign = singular_values(self.mechanism, assembled.q_tree[None], assembled.rho[None])
        self.basis = np.eye(len(regressor.unknowns))

    # --- motions at instants ---------------------------------------------------------------------

    def evaluate(self, q_tree: Array, x: Array, waves: Array | None = None, *, smooth: bool = True) -> Instants | None:
        """Return a motion with Fourier coefficients x (d, 1 + 2 harmonics), followed from closed configurations.

        The result is None if the loops cannot follow it on their branch.
        """
        waves = self.waves if waves is None else waves
        q, v, a = np.einsum("smc,dc->smd", waves, x)
        try:
            return self.instants(self.follow(q_tree, q), q, v, a, smooth=smooth)
        except (InputError, np.linalg.LinAlgError):
            return None

    def follow(self, q_tree: Array, q: Array) -> Array:
        """Return closed configurations (m, nq) near q (m, d), by continuation from others (InputError)."""
        tree, at = self.mechanism.tree, self.mechanism.partition.q
        numbers = np.array([tree.to_coordinates(one) for one in q_tree])
        missing = q - numbers[:, at]
        count = 1 + int(np.max(np.abs(missing) / tree.step_scale[at]) / MAX_CONTINUATION_STEP)
        for k in range(1, count):
            q_tree = close_many(self.mechanism, q_tree, q - missing * (1 - k / count))
        return q_tree

    def instants(self, q_tree: Array, q: Array, v: Array, a: Array, *, smooth: bool = True) -> Instants:
        """Return quantities and regressor of instants from closed configurations near q (InputError)."""
        motion = motion_along(self.mechanism, np.zeros(len(q)), q_tree, q, v, a)
        return self._measure(motion, self._on_branch(motion), smooth=smooth)

    def _measure(self, motion: MeasuredMotion, sigma: Array, *, smooth: bool = True) -> Instants:
        tree, motors = self.mechanism.tree, self.mechanism.motors
        if smooth:
            motion = replace(motion, v_std=SLOW * 2 * np.pi / self.period * tree.step_scale)
        columns, force = self.regressor.rows(motion)
        to_forces = np.einsum("knd,mn->kdm", motion.rho, motors.transmission)
        numbers = np.array([tree.to_coordinates(one) for one in motion.q_tree])
        tau = np.einsum("kmd,kd->km", np.linalg.pinv(to_forces), force)
        whitening = np.linalg.pinv(to_forces * self.noise)
        shafts = motion.v_tree @ motors.transmission.T
        quantities = np.hstack([numbers, motion.v_tree, motion.a_tree, shafts, tau, sigma])
        return Instants(motion, quantities, whitening @ (columns * self.regressor.scale))

    def _on_branch(self, motion: MeasuredMotion) -> Array:
        """Return the singular values of instants, or raise InputError if the motion leaves its branch."""
        sigma, sign = singular_values(self.mechanism, motion.q_tree, motion.rho)
        if np.any(sign != self._sign):
            raise InputError("excite: the motion leaves its branch")
        return sigma

    # --- criterion -------------------------------------------------------------------------------

    def values(self, regressor: Array) -> tuple[float, float]:
        """Return condition number and log det of the information in the determined directions, by instant."""
        s = np.linalg.svd((regressor @ self.basis).reshape(-1, self.basis.shape[1]), compute_uv=False)
        if s[-1] <= STRUCTURAL_RANK_TOLERANCE * s[0]:
            return float("inf"), float("-inf")
        return float(s[0] / s[-1]), float(2 * np.sum(np.log(s / np.sqrt(len(regressor)))))

    def score(self, regressor: Array) -> float:
        """Return what the search makes small."""
        condition, log_det = self.values(regressor)
        return float(np.log(condition)) if self.criterion == "condition" else -log_det / 2 / self.basis.shape[1]

    def objective(self, regressor: Array, sharpness: float) -> tuple[float, Array]:
        """Return the smoothed criterion, and its derivatives by the regressor in the determined directions."""
        W = regressor @ self.basis
        values, vectors = np.linalg.eigh(np.einsum("kmi,kmj->ij", W, W) / len(W))
        values = np.maximum(values, 1e-30)
        logs = np.log(values)
        if self.criterion == "log_det":
            objective, slopes = -0.5 * float(logs.mean()), -0.5 / values / len(values)
        else:
            (high, up), (low, down) = _soft_max(sharpness * logs), _soft_max(-sharpness * logs)
            objective, slopes = 0.5 * (high + low) / sharpness, 0.5 * (up - down) / values
        return objective, 2 / len(W) * W @ ((vectors * slopes) @ vectors.T)

    def differences(self, instants: Instants, x: Array) -> tuple[Array, Array]:
        """Return derivatives of quantities (3, d, m, k) and regressor (3, d, m, motors, r) by q, q_dot and q_ddot."""
        base, d, m = instants.motion, self.d, len(self.t)
        q, v, a = np.einsum("smc,dc->smd", self.waves, x)
        h_q, h_v, h_a = steps = DIFFERENCE_STEP * self.size
        moved = np.repeat(q[None], d, axis=0) + np.einsum("d,de->de", h_q, np.eye(d))[:, None]
        by_q = motion_along(
            self.mechanism, np.zeros(d * m), np.tile(base.q_tree, (d, 1)), moved.reshape(-1, d), np.tile(v, (d, 1)),
            np.tile(a, (d, 1)),
        )  # fmt: skip
        # The rate of rho is the sum of q_dot_i d rho/dq_i, so that differences by q give those of a_tree by q_dot too.
        rho_slopes = (by_q.rho.reshape(d, m, -1, d) - base.rho) / h_q[:, None, None, None]
        curvature = np.einsum("jmni,mi->jmn", rho_slopes, v) + np.einsum("imnj,mi->jmn", rho_slopes, v)
        along = base.rho.transpose(2, 0, 1)
        v_tree = [by_q.v_tree, *(base.v_tree + h_v[:, None, None] * along), *d * [base.v_tree]]
        a_tree = [
            by_q.a_tree,
            *(base.a_tree + h_v[:, None, None] * curvature),
            *(base.a_tree + h_a[:, None, None] * along),
        ]
        there = self._measure(
            MeasuredMotion(
                np.zeros(3 * d * m), np.vstack([by_q.q_tree, *2 * d * [base.q_tree]]), np.vstack(v_tree),
                np.vstack(a_tree),
                np.concatenate([by_q.rho, *2 * d * [base.rho]]), base.v_std,
            ),
            np.vstack([self._on_branch(by_q), *2 * d * [instants.quantities[:, -2:]]]),
        )  # fmt: skip
        by_quantity = there.quantities.reshape(3 * d, m, -1) - instants.quantities
        by_regressor = (there.regressor.reshape(3 * d, *instants.regressor.shape) - instants.regressor) @ self.basis
        return (
            (by_quantity / steps.reshape(-1, 1, 1)).reshape(3, d, *instants.quantities.shape),
            (by_regressor / steps.reshape(-1, 1, 1, 1)).reshape(3, d, m, -1, self.basis.shape[1]),
        )

    # --- search ----------------------------------------------------------------------------------

    def random_motion(self, rng: np.random.Generator) -> tuple[list[tuple[Array, Instants]], Array]:
        """Return a random motion with the largest amplitude within the limits, in a list that may be empty.

        Beside it, the violation of each limit at the amplitude where the largest is smallest.
        """
        half = (self.upper - self.lower) / 2
        offset = self.lower + half * rng.uniform(0.4, 1.6, self.d)
        spectrum = self.order[1:] ** -rng.uniform(0.0, MAX_DECAY)
        x = np.hstack([offset[:, None], rng.normal(size=(self.d, 2 * self.harmonics)) * spectrum])
        reach = np.abs(np.einsum("mc,dc->md", self.waves[0, :, 1:], x[:, 1:])).max(axis=0)
        x[:, 1:] *= (np.minimum(offset - self.lower, self.upper - offset) / reach)[:, None]
        centre = np.zeros_like(x)
        centre[:, 0] = self.start
        q_tree = np.repeat(self.mechanism.assembled.q_tree[None], len(self.t), axis=0)
        best, closest = list[tuple[Array, Instants]](), np.full(len(self.limits.names), np.inf)
        amplitude, low, high = 1.0, 0.0, 1.0
        for _ in range(BISECTIONS):
            scaled = centre + amplitude * (x - centre)
            instants = self.evaluate(q_tree, scaled)
            worst = np.full(len(closest), np.inf) if instants is None else self.limits.worst(instants.quantities)
            closest = worst if worst.max() < closest.max() else closest
            if instants is not None and worst.max() <= 0:
                best, low, q_tree = [(scaled, instants)], amplitude, instants.motion.q_tree
            else:
                high = amplitude
            if low == 1.0:
                break
            amplitude = (low + high) / 2
        return best, closest

    def set_basis(self, regressors: list[Array]) -> None:
        """Take the directions of the unknowns that these motions together determine."""
        p = len(self.regressor.unknowns)
        _, s, v = np.linalg.svd(np.concatenate([W.reshape(-1, p) for W in regressors]), full_matrices=False)
        self.basis = v[: int(np.sum(s > STRUCTURAL_RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1e-300)))].T

    def optimize(
        self, x: Array, instants: Instants, iterations: int, progress: Callable[[], None]
    ) -> tuple[Array, Instants]:
        """Return a better motion than that of x, within the limits on a grid that is five times finer.

        Raises
        ------
        InputError
            No such motion was found.
        """
        search = _Search(self, instants.motion.q_tree)
        tightening, best = np.zeros(len(self.limits.names)), list[tuple[float, Array, Instants]]()
        for k, (sharpness, hardness) in enumerate(((0.0, 0.0), *STAGES)):
            if k:  # the start itself comes first
                share = iterations if k <= 2 else 1 + iterations // 2
                x = search.run(x, sharpness, hardness, share, tightening, progress)
            fine = self.fine(x, search.q_tree)
            worst = np.full(len(tightening), MAX_REPAIR) if fine is None else self.limits.worst(fine.quantities)
            if fine is not None and worst.max() <= 0:
                best = [min([*best, (self.score(fine.regressor), x, fine)], key=lambda entry: entry[0])]
                if k >= 2:
                    break
            if k:
                repair = 1.5 * np.minimum(worst, MAX_REPAIR) + k * REPAIR_STEP
                tightening = tightening + np.where(worst > 0, repair, 0.0)
        if best:
            return best[0][1:]
        names = ", ".join(name for name, over in zip(self.limits.names, worst, strict=True) if over > 0)
        raise InputError(f"excite: {names}: no motion stays within this limit between the instants; widen it")

    def fine(self, x: Array, q_tree: Array, refinement: int = 5) -> Instants | None:
        """Return the motion on a finer grid, without smoothing of friction; None if it cannot be followed."""
        count = refinement * len(self.t)
        waves = fourier(np.arange(count) * self.period / count, self.period, self.harmonics)
        return self.evaluate(np.repeat(q_tree, refinement, axis=0), x, waves, smooth=False)


class _NoStep(Exception):
    """The line search ends at a motion that the loops cannot follow."""


class _Search:
    """Sequential quadratic programming from one motion, with evaluations that start at the last accepted one.

    Each limit is one constraint: a smooth upper bound of its largest violation over the instants (Kreisselmeier and
    Steinhauser).
    """

    def __init__(self, problem: ExcitationProblem, q_tree: Array) -> None:
        self.problem, self.q_tree = problem, q_tree
        limits = problem.limits
        self.sides = np.array([np.isfinite(limits.lower), np.isfinite(limits.upper)])

    def run(
        self, x: Array, sharpness: float, hardness: float, iterations: int, tightening: Array,
        progress: Callable[[], None],
    ) -> Array:  # fmt: skip
        """Return the best coefficients that were met from x on, with a price for violated limits.

        Parameters
        ----------
        sharpness : float
            Of the smoothed condition number.
        hardness : float
            Of the bound of violations.
        tightening : (k,) array
            Sizes by which limits are narrowed.
        """
        from scipy.optimize import minimize

        problem, unit = self.problem, self.problem.unit
        visited: dict[bytes, tuple[Instants | None, Array]] = {}
        best: list[tuple[float, Array]] = []

        def violation(instants: Instants) -> Array:
            """Return the violations of used limits, shape (m, sides)."""
            exceeded = problem.limits.violation(instants.quantities) + tightening
            return np.concatenate([side[:, used] for side, used in zip(exceeded, self.sides, strict=True)], axis=1)

        def visit(y: Array) -> tuple[Instants | None, Array]:
            if y.tobytes() not in visited:
                instants = problem.evaluate(self.q_tree, y.reshape(unit.shape) * unit)
                exceeded = np.ones((1, int(self.sides.sum()))) if instants is None else violation(instants)
                visited.clear()
                visited[y.tobytes()] = instants, exceeded
                if instants is not None:
                    price = VIOLATION_PRICE * max(float(exceeded.max(initial=0.0)), 0.0)
                    best.append((problem.score(instants.regressor) + price, y.copy()))
                    best[:] = [min(best, key=lambda entry: entry[0])]
            return visited[y.tobytes()]

        def objective(y: Array) -> float:
            instants, _ = visit(y)
            return (
                FAILURE if instants is None else OBJECTIVE_SCALE * problem.objective(instants.regressor, sharpness)[0]
            )

        def constraint(y: Array) -> Array:
            return -_soft_max(hardness * visit(y)[1])[0] / hardness

        slopes: dict[bytes, tuple[Array, Array]] = {}

        def derivatives(y: Array) -> tuple[Array, Array]:
            if y.tobytes() not in slopes:
                instants, exceeded = visit(y)
                if instants is None:  # the line search found no motion that can be followed
                    raise _NoStep
                self.q_tree = instants.motion.q_tree
                by_quantity, by_regressor = problem.differences(instants, y.reshape(unit.shape) * unit)
                lower, upper = self.sides
                by_side = np.concatenate([-by_quantity[..., lower] / problem.limits.scale[lower],
                                          by_quantity[..., upper] / problem.limits.scale[upper]], axis=-1)  # fmt: skip
                _, weights = _soft_max(hardness * exceeded)
                _, gradient = problem.objective(instants.regressor, sharpness)
                local = np.concatenate([np.einsum("kmr,sdkmr->sdk", gradient, by_regressor)[..., None],
                                        by_side * weights], axis=-1)  # fmt: skip
                total = np.einsum("sdkg,skc,dc->gdc", local, problem.waves, unit).reshape(local.shape[-1], -1)
                slopes.clear()
                slopes[y.tobytes()] = OBJECTIVE_SCALE * total[0], -total[1:]
            return slopes[y.tobytes()]

        with suppress(_NoStep):
            minimize(
                objective, (x / unit).ravel(), jac=lambda y: derivatives(y)[0], method="SLSQP",
                constraints={"type": "ineq", "fun": constraint, "jac": lambda y: derivatives(y)[1]},
                options={"maxiter": iterations, "ftol": 1e-5 * OBJECTIVE_SCALE}, callback=lambda _: progress(),
            )  # fmt: skip
        return best[0][1].reshape(unit.shape) * unit if best else x


def _soft_max(values: Array) -> tuple[Any, Array]:
    """Return the logarithm of the sum of exponentials along the first axis, and its derivatives."""
    top = values.max(axis=0)
    weights = np.exp(values - top)
    total = weights.sum(axis=0)
    return top + np.log(total), weights / total
