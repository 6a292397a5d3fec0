"""Directions of the unknowns that some motion of a mechanism determines, from the regressor at random states."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.identification.fit import STRUCTURAL_RANK_TOLERANCE
from ckc_pin.identification.measured_motion import MeasuredMotion, close_many, motion_along
from ckc_pin.identification.regressor import TorqueRegressor
from ckc_pin.identification.unknowns import GRAVITY
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["random_states", "structural_directions"]

AMPLITUDES = (0.5, 0.25, 0.1, 0.03, 0.01, 0.003)  # rad or sizes of the mechanism; the first that the loops allow
MAX_STEP = 0.1  # the same, of a step towards a random configuration
EQUATIONS_PER_UNKNOWN = 3


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
