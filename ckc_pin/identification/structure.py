"""What motions of a mechanism can tell about unknowns, by the regressor at random states, and which motion tells it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import STRUCTURAL_RANK_TOLERANCE
from ckc_pin.identification.measured_motion import MeasuredMotion, close_many, motion_along
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.unknowns import GRAVITY
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["MotionAdvice", "random_states", "structural_directions"]

AMPLITUDES = (0.5, 0.25, 0.1, 0.03, 0.01, 0.003)  # rad or sizes of the mechanism; the first that the loops allow
MAX_STEP = 0.1  # the same, of a step towards a random configuration
EQUATIONS_PER_UNKNOWN = 3
LEAK_TOLERANCE = 1e-6  # part of a gradient outside of the directions that some motion determines
MAX_INSTANTS = 20  # of measured configurations, which are tried with other rates and accelerations
MIN_GAIN = 1e-3  # of the typical size of the regressor: less does not tell anything


def random_states(mechanism: Mechanism, count: int, seed: int = 0) -> MeasuredMotion:
    """Return random configurations on the assembled branch, with random rates and accelerations.

    Raises
    ------
    InputError
        The loops cannot be closed near the assembled configuration.
    """
    rng, tree, at = np.random.default_rng(seed), mechanism.tree, mechanism.partition.q
    directions = rng.uniform(-1.0, 1.0, (count, len(at))) * tree.step_scale[at]
    rate = (GRAVITY / mechanism.size) ** 0.5
    q_dot, q_ddot = rng.normal(size=(2, count, len(at))) * tree.step_scale[at]
    assembled = np.repeat(mechanism.assembled.q_tree[None], count, axis=0)
    start = tree.to_coordinates(mechanism.assembled.q_tree)[at]
    for amplitude in AMPLITUDES:
        q_tree, steps = assembled, 1 + int(amplitude / MAX_STEP)
        try:
            for k in range(1, steps + 1):
                q = start + amplitude * k / steps * directions
                q_tree = close_many(mechanism, q_tree, q)
            return motion_along(mechanism, np.zeros(count), q_tree, q, rate * q_dot, rate**2 * q_ddot)
        except (InputError, np.linalg.LinAlgError):
            continue
    raise InputError(f"identify: the loops of {mechanism.name} do not close near its assembled configuration")


def structural_directions(regressor: TorqueRegressor) -> Array:
    """Return an orthonormal basis (p, r) of the directions of the unknowns, in typical sizes, that have any influence.

    The regressor is analytic in the state, so a direction without influence at random states has none in any motion on
    the same branch.
    """
    p, d = len(regressor.unknowns), regressor.mechanism.d
    columns, _ = regressor.rows(random_states(regressor.mechanism, 2 + EQUATIONS_PER_UNKNOWN * p // max(d, 1)))
    columns = columns * regressor.scale
    sizes = np.linalg.norm(columns, axis=(1, 2), keepdims=True)  # of states: those near singular ones are very large
    columns = (columns / np.maximum(sizes, 1e-300)).reshape(-1, p)
    _, s, v = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(v[: int(np.sum(s > STRUCTURAL_RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1e-300)))].T)


class MotionAdvice:
    """Says why a motion does not determine a parameter, and which motion would.

    Parameters
    ----------
    regressor : TorqueRegressor
    q_tree : (m, nq) array
        Measured configurations.
    names : sequence of str
        Unknowns in the order of gradients.
    has_torques : bool
        Whether torques were measured.
    """

    def __init__(self, regressor: TorqueRegressor, q_tree: Array, names: Sequence[str], *, has_torques: bool) -> None:
        self.regressor = regressor
        self.order: IntArray = np.array([regressor.names.index(name) for name in names], dtype=np.intp)
        self.directions = structural_directions(regressor)[self.order]
        at = np.linspace(0, len(q_tree) - 1, MAX_INSTANTS).astype(int)
        self._q_tree, self._has_torques = q_tree[at], has_torques

    def explain(self, gradient: Array, determined: Array) -> str:
        """Return why a parameter has no value, and which motion would determine it.

        Parameters
        ----------
        gradient : (p,) array
            Of the parameter by unknown, in typical sizes.
        determined : (p, r) array
            Orthonormal directions that the data determine.
        """
        size = max(float(np.linalg.norm(gradient)), 1e-300)
        possible = self.directions @ (self.directions.T @ gradient)
        if np.linalg.norm(gradient - possible) > LEAK_TOLERANCE * size:
            alone = " alone" if np.linalg.norm(possible) > LEAK_TOLERANCE * size else ""
            return f"no motion of this mechanism determines it{alone}"
        return self._suggest(gradient - determined @ (determined.T @ gradient))

    def explain_rest(self, determined: Array) -> list[str]:
        """Return which motion would determine each combination that some motion determines, but the data do not."""
        outside = self.directions - determined @ (determined.T @ self.directions)
        u, _, _ = np.linalg.svd(outside, full_matrices=False)
        count = max(self.directions.shape[1] - determined.shape[1], 0)
        return [self._suggest(direction) for direction in u[:, :count].T]

    def _suggest(self, missing: Array) -> str:
        """Return which motion would determine a direction of the unknowns."""
        missing = missing / max(float(np.linalg.norm(missing)), 1e-300)
        start = (self.regressor.start / self.regressor.scale)[self.order]
        if not self._has_torques and abs(missing @ start) > 0.5 * np.linalg.norm(start):
            return "motor torques would tell it; without them only ratios of masses and friction are known"
        texts, columns = zip(*self._experiments, strict=True)
        gains = [float(np.linalg.norm(rows @ missing)) / len(rows) ** 0.5 for rows in columns]
        best = int(np.argmax(gains))
        if gains[best] <= MIN_GAIN * max(float(np.linalg.norm(rows) / len(rows) ** 0.5) for rows in columns):
            return "a motion of several coordinates at once would tell it"
        return f"{texts[best]} would tell it"

    @cached_property
    def _experiments(self) -> list[tuple[str, Array]]:
        """Motions of one coordinate, with the equations (equations, p) that they add to the regressor at rest."""
        mechanism, count, rng = self.regressor.mechanism, len(self._q_tree), np.random.default_rng(0)
        tree, at, rate = mechanism.tree, mechanism.partition.q, (GRAVITY / mechanism.size) ** 0.5
        q = np.array([tree.to_coordinates(one)[at] for one in self._q_tree])
        zero = np.zeros_like(q)
        at_rest = self._columns(q, zero, zero)
        experiments: list[tuple[str, Array]] = []
        for k, (name, scale) in enumerate(zip(mechanism.independent, tree.step_scale[at], strict=True)):
            unit = np.eye(len(at))[k] * scale
            step = rng.normal(size=count)[:, None] * unit
            experiments += [
                (f"larger accelerations of {name}", self._columns(q, zero, rate**2 * step) - at_rest),
                (f"a faster motion of {name}", self._columns(q, rate * step, zero) - at_rest),
            ]
            for amplitude in AMPLITUDES:
                try:
                    moved = self._columns(q + amplitude * np.sign(step), zero, zero) - at_rest
                except (InputError, np.linalg.LinAlgError):
                    continue
                experiments.append((f"other positions of {name}", moved))
                break
        return experiments

    def _columns(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        motion = motion_along(self.regressor.mechanism, np.zeros(len(q)), self._q_tree, q, q_dot, q_ddot)
        columns = self.regressor.rows(motion)[0] * self.regressor.scale
        return columns.reshape(-1, columns.shape[2])[:, self.order]
