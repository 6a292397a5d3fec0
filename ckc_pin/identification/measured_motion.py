"""Configurations, rates and accelerations of the whole tree from measured coordinates.

Each measured coordinate is fitted by a smooth function. The loops then give all coordinates: at each instant the
configuration on the constraint manifold that is nearest to these functions, weighted by their noise. Rates and
accelerations follow in the same sense.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ckc_pin.base.arrays import Array, BoolArray, Immutable, IntArray
from ckc_pin.errors import InputError
from ckc_pin.identification.smooth_fit import SmoothFit
from ckc_pin.mechanism.batch import evaluate_closure, integrate_many
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["MeasuredMotion", "close_many", "estimate_motion", "estimate_start", "motion_along", "shift_motion"]

MAX_ITERATIONS, MAX_START_STEPS = 20, 1600
MAX_FOLLOWED = 400  # instants that are followed one after the other; the others are interpolated between them first
GUESS_STEP = 1e-3  # size of the last Gauss-Newton step of configurations that initial guesses are interpolated between
DIFFERENCE_STEP = 1e-3  # of the largest coordinate, rad or sizes, for J_dot v
OFF_BRANCH = (
    "the loops do not let the mechanism follow the measured coordinates; they are of another branch (q_guess in the "
    "mechanism's file chooses it) or another mechanism, have an offset, or are in other units"
)
CERTAIN = 3.0  # rate in standard deviations from which its sign is known
MAX_UNCERTAIN = 0.1  # share of the instants at which the sign of a moving joint is not
FOLLOW_FACTOR = 8.0  # a larger distance of the manifold from the measurements, in units of noise, is another branch


class MeasuredMotion(Immutable, frozen=True):
    """A motion of a mechanism at m instants.

    Attributes
    ----------
    t : (m,) array
        s.
    q_tree : (m, nq) array
    v_tree, a_tree : (m, n) array
    rho : (m, n, d) array
    v_std : (n,) array
        Standard deviation of the rates; zero if they are exact.
    """

    t: Array
    q_tree: Array
    v_tree: Array
    a_tree: Array
    rho: Array
    v_std: Array

    def directions(self) -> Array:
        """Return the expected signs of the rates, given their uncertainty, shape (m, n)."""
        from scipy.special import erf

        uncertain = self.v_std > 0
        width = np.where(uncertain, np.sqrt(2.0) * self.v_std, 1.0)
        return np.where(uncertain, erf(self.v_tree / width), np.sign(self.v_tree))

    def near_reversals(self, joints: BoolArray) -> BoolArray:
        """Return whether the direction of one of these joints, (n,) booleans, is uncertain at each instant, (m,).

        A joint that hardly moves does not count. Its direction is uncertain all the time.
        """
        uncertain = (np.abs(self.v_tree) < CERTAIN * self.v_std) & joints
        return np.asarray(uncertain[:, uncertain.mean(axis=0) <= MAX_UNCERTAIN].any(axis=1))

    def at(self, instants: IntArray | BoolArray) -> MeasuredMotion:
        """Return the motion at some of its instants, given by index or as booleans."""
        arrays = {key: getattr(self, key)[instants] for key in ("t", "q_tree", "v_tree", "a_tree", "rho")}
        return replace(self, **arrays)


def close_many(mechanism: Mechanism, q_tree: Array, q: Array) -> Array:
    """Return closed configurations (m, nq) with independent coordinates q (m, d), near others (InputError)."""
    return _nearest_by_q(mechanism).solve_many(_all_coordinates(mechanism, q_tree), q)


def motion_along(
    mechanism: Mechanism, t: Array, q_tree: Array, q: Array, q_dot: Array, q_ddot: Array
) -> MeasuredMotion:
    """Return the exact motion with independent coordinates q (m, d), closed near q_tree (InputError)."""
    nearest = _nearest_by_q(mechanism)
    q_tree = nearest.solve_many(_all_coordinates(mechanism, q_tree), q)
    rho, v_tree, a_tree = nearest.rates(q_tree, q_dot, q_ddot)
    return MeasuredMotion(t, q_tree, v_tree, a_tree, rho, np.zeros(mechanism.n))


def _nearest_by_q(mechanism: Mechanism) -> _Nearest:
    return _Nearest(mechanism, mechanism.partition.q, np.ones(mechanism.d))


def _all_coordinates(mechanism: Mechanism, q_tree: Array) -> Array:
    """Return the coordinates (m, n) of configurations (m, nq)."""
    return np.array([mechanism.tree.to_coordinates(one) for one in q_tree])


def estimate_motion(mechanism: Mechanism, fits: Mapping[str, SmoothFit], instants: Array) -> MeasuredMotion:
    """Estimate the motion of all coordinates at instants from smooth functions fitted to at least d coordinates.

    Parameters
    ----------
    mechanism : Mechanism
    fits : mapping of str to SmoothFit
        By coordinate.
    instants : (m,) array
        Those at which some acceleration is extrapolated are left out.

    Raises
    ------
    InputError
        The coordinates do not determine the configuration, or the loops do not let the mechanism follow them.
    """
    tree, names = mechanism.tree, list(fits)
    at = tree.indices(tuple(names), "identify: data")
    first, last = (extreme([fit.span[k] for fit in fits.values()]) for k, extreme in enumerate((max, min)))
    instants = instants[(instants >= first) & (instants <= last)]
    if not len(instants):
        raise InputError(
            f"identify: no torque was measured from t = {first:.4g} to {last:.4g} s, where smooth functions of "
            f"{', '.join(names)} give accelerations; record a longer motion"
        )
    nearest = _Nearest(mechanism, at, _fit_noise(mechanism, at, fits))
    measured = np.array([fit.values(instants) for fit in fits.values()]).transpose(1, 2, 0)  # (3, m, coordinates)
    here = nearest.start(measured[0, 0], names)
    few = np.unique(np.linspace(0, len(instants) - 1, MAX_FOLLOWED).astype(int))
    followed = []
    for k in few:
        here = nearest.solve(here, measured[0, k], f"at t = {instants[k]:.4g} s", GUESS_STEP)
        followed.append(tree.to_coordinates(here.q_tree))
    guess = np.array([np.interp(instants, instants[few], column) for column in np.array(followed).T]).T
    q_tree = nearest.solve_many(guess, measured[0])
    off = _all_coordinates(mechanism, q_tree)[:, at] - measured[0]
    nearest.require_near(np.sqrt(np.mean(off**2, axis=0)), names)
    rho, v_tree, a_tree = nearest.rates(q_tree, measured[1], measured[2])
    spread = np.array([fit.std[1] for fit in fits.values()])
    by_rate = [(r @ np.linalg.pinv(r[at])) * spread for r in rho[:: max(1, len(rho) // 20)]]
    v_std = np.sqrt(np.mean(np.square(by_rate), axis=0).sum(axis=1))
    return MeasuredMotion(instants, q_tree, v_tree, a_tree, rho, v_std)


def shift_motion(
    mechanism: Mechanism, motion: MeasuredMotion, fits: Mapping[str, SmoothFit], order: int, name: str, shift: float
) -> MeasuredMotion:
    """Return the motion with one measured value (order 0), rate (1) or acceleration (2) shifted (InputError)."""
    at = mechanism.tree.indices(tuple(fits), "identify: data")
    nearest = _Nearest(mechanism, at, _fit_noise(mechanism, at, fits))
    shifts = np.zeros((3, len(motion.t), len(fits)))
    shifts[order, :, list(fits).index(name)] = shift
    if order == 2:
        a_tree = motion.a_tree + np.einsum("knd,kd->kn", motion.rho, nearest.independent_part(motion.rho, shifts[2]))
        return replace(motion, a_tree=a_tree)
    measured = np.array([fit.values(motion.t) for fit in fits.values()]).transpose(1, 2, 0) + shifts
    q_tree = motion.q_tree
    if order == 0:
        q_tree = nearest.solve_many(_all_coordinates(mechanism, q_tree), measured[0])
    rho, v_tree, a_tree = nearest.rates(q_tree, measured[1], measured[2])
    return replace(motion, q_tree=q_tree, v_tree=v_tree, a_tree=a_tree, rho=rho)


def estimate_start(mechanism: Mechanism, fits: Mapping[str, SmoothFit], t: float) -> tuple[Array, Array]:
    """Estimate all coordinates and the independent rates at one time from functions fitted to at least d coordinates.

    Returns
    -------
    (n,) array
        Coordinates.
    (d,) array
        Rates of the independent coordinates.

    Raises
    ------
    InputError
        As of `estimate_motion`.
    """
    at = mechanism.tree.indices(tuple(fits), "identify: data")
    nearest = _Nearest(mechanism, at, _fit_noise(mechanism, at, fits))
    numbers, rates, accelerations = np.array([fit.values(np.array([t]))[:, 0] for fit in fits.values()]).T
    here = nearest.start(numbers, list(fits))
    _, v_tree, _ = nearest.rates(here.q_tree[None], rates[None], accelerations[None])
    return mechanism.tree.to_coordinates(here.q_tree), v_tree[0, mechanism.partition.q]


def _fit_noise(mechanism: Mechanism, at: Any, fits: Mapping[str, SmoothFit]) -> Array:
    """Return the standard deviations of fitted functions, at least rounding errors."""
    smallest = 1e-12 * mechanism.tree.step_scale[at]
    return np.maximum([fit.std[0] for fit in fits.values()], smallest)


class _Nearest:
    """Finds closed configurations nearest to measured coordinates."""

    def __init__(self, mechanism: Mechanism, at: Any, noise: Array) -> None:
        self.mechanism, self.at, self.noise = mechanism, at, noise
        self.rows = mechanism.independent_rows
        if np.linalg.matrix_rank(mechanism.assembled.rho[at]) < mechanism.d:
            raise InputError(
                f"identify: {', '.join(mechanism.coordinates[k] for k in at)} do not determine the configuration; "
                f"{mechanism.d} coordinates are needed that do, such as {', '.join(mechanism.independent)}"
            )

    def start(self, measured: Array, names: Sequence[str]) -> Kinematics:
        """Follow the branch of the assembled configuration along a line to the first measurement."""
        here = self.mechanism.assembled
        first = self.mechanism.tree.to_coordinates(here.q_tree)[self.at]
        steps = 1 + int(np.max(np.abs(measured - first) / self.mechanism.tree.step_scale[self.at]) / 0.1)
        if steps > MAX_START_STEPS:
            largest = names[int(np.argmax(np.abs(measured)))]
            raise InputError(f"identify: {largest} begins at {np.abs(measured).max():.4g}; are its values in degrees?")
        for k in range(1, steps + 1):
            here = self.solve(here, first + (measured - first) * k / steps, "at the first instant")
        return here

    def solve(self, here: Kinematics, measured: Array, when: str, last_step: float = 1e-10) -> Kinematics:
        """Return the nearest closed configuration, by Gauss-Newton on the constraint manifold up to a step size."""
        mechanism, tree = self.mechanism, self.mechanism.tree
        for _ in range(MAX_ITERATIONS):
            if not np.all(np.isfinite(here.q_tree)) or here.phi_z_factor.singular:
                break
            closing = np.zeros(tree.n)
            closing[here.partition.z] = -here.phi_z_factor.solve(here.phi)
            missing = (measured - tree.to_coordinates(here.q_tree)[self.at] - closing[self.at]) / self.noise
            step = closing + here.rho @ np.linalg.lstsq(here.rho[self.at] / self.noise[:, None], missing, rcond=None)[0]
            here = here.integrate(step)
            tolerance = max(last_step, mechanism.tolerance)
            if tree.step_size(step) <= last_step and np.abs(here.phi).max(initial=0.0) <= tolerance:
                return here
        raise InputError(f"identify: {when} {OFF_BRANCH}")

    def solve_many(self, guess: Array, measured: Array) -> Array:
        """Return the nearest closed configurations (m, nq) to measurements, from guesses (m, n) of all coordinates."""
        tree = self.mechanism.tree
        q_tree = np.array([tree.from_coordinates(numbers) for numbers in guess])
        for _ in range(MAX_ITERATIONS):
            phi, rho, phi_z = self._terms(q_tree)
            closing = np.zeros((len(q_tree), tree.n))
            if phi.shape[1]:
                closing[:, self.mechanism.partition.z] = -np.linalg.solve(phi_z, phi[:, :, None])[:, :, 0]
            numbers = _all_coordinates(self.mechanism, q_tree)
            dq = self.independent_part(rho, measured - numbers[:, self.at] - closing[:, self.at])
            step = closing + np.einsum("knd,kd->kn", rho, dq)
            q_tree = integrate_many(tree, q_tree, step)
            if np.max(tree.step_size(step)) <= 1e-9:
                return q_tree
        raise InputError(f"identify: {OFF_BRANCH}")

    def rates(self, q_tree: Array, rates: Array, accelerations: Array) -> tuple[Array, Array, Array]:
        """Return rho (m, n, d), and rates and accelerations (m, n) of all coordinates."""
        tree = self.mechanism.tree
        phi, rho, phi_z = self._terms(q_tree)
        v_tree = np.einsum("knd,kd->kn", rho, self.independent_part(rho, rates))
        drift = np.zeros((len(q_tree), tree.n))
        if phi.shape[1]:
            J_dot_v = np.zeros_like(phi)
            step = DIFFERENCE_STEP / np.maximum(tree.step_size(v_tree), 1e-6)[:, None]
            for weight, far in ((8, 1), (-8, -1), (-1, 2), (1, -2)):  # a difference of fourth order
                _, J = self._closure(integrate_many(tree, q_tree, far * step * v_tree))
                J_dot_v += weight / (12 * step) * np.einsum("krn,kn->kr", J, v_tree)
            drift[:, self.mechanism.partition.z] = -np.linalg.solve(phi_z, J_dot_v[:, :, None])[:, :, 0]
        missing = self.independent_part(rho, accelerations - drift[:, self.at])
        return rho, v_tree, drift + np.einsum("knd,kd->kn", rho, missing)

    def _closure(self, q_tree: Array) -> tuple[Array, Array]:
        phi, J = evaluate_closure(self.mechanism.tree, self.mechanism.closure, q_tree)
        return phi[:, self.rows], J[:, self.rows]

    def _terms(self, q_tree: Array) -> tuple[Array, Array, Array]:
        """Return phi (m, rows), rho (m, n, d) and phi_z (m, rows, rows), without redundant rows."""
        partition = self.mechanism.partition
        phi, J = self._closure(q_tree)
        phi_z = J[:, :, partition.z]
        rho = np.zeros((len(q_tree), self.mechanism.n, self.mechanism.d))
        rho[:, partition.q, np.arange(self.mechanism.d)] = 1.0
        if phi.shape[1]:
            rho[:, partition.z] = -np.linalg.solve(phi_z, J[:, :, partition.q])
        return phi, rho, phi_z

    def independent_part(self, rho: Array, measured: Array) -> Array:
        """Return the least-squares solution q_dot (m, d) of rho q_dot = measured in the measured coordinates."""
        rows = rho[:, self.at] / self.noise[:, None]
        return np.einsum("kdi,ki->kd", np.linalg.pinv(rows), measured / self.noise)

    def require_near(self, off: Array, names: Sequence[str]) -> None:
        """Refuse measurements that the mechanism cannot follow."""
        ratio = off / np.maximum(self.noise, 1e-9)
        worst = int(np.argmax(ratio))
        if off[worst] > 1e-6 and ratio[worst] > FOLLOW_FACTOR:
            raise InputError(
                f"identify: {names[worst]} is {off[worst]:.3g} off the constraint manifold, {ratio[worst]:.0f} times "
                "its noise; the lengths differ from the mechanism's (calibrate them first), or a reading has an offset"
            )
