"""Assembly: a closed configuration near a guess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ckc_pin.mechanism.closure import Closure
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.tree import Array, Tree

__all__ = ["Assembly", "assemble"]

RESTARTS = 20


@dataclass(frozen=True)
class Assembly:
    """The best configuration found, and what is left of phi there."""

    q_tree: Array
    residual: float
    misses: dict[str, float]


def assemble(
    tree: Tree, closure: Closure, q_tree: Array, free: Array, tolerance: float, restarts: int = RESTARTS
) -> Assembly:
    """Close the loops from a guess by damped Gauss-Newton, moving as little as it takes.

    Parameters
    ----------
    tree, closure : Tree, Closure
    q_tree : (nq,) array
        The guess.
    free : (n,) array of 0 or 1
        Coordinates that may move. All others keep their guess.
    tolerance : float
        Largest |phi| that counts as closed.
    restarts : int
        How many perturbed starts to try when the guess itself does not lead there.

    Returns
    -------
    Assembly
        From the guess itself when that closes; otherwise the best of some perturbed restarts.
    """

    def at(q: Array) -> tuple[Array, Callable[[], Array]]:
        pose = Pose(tree, closure.anchors, q)
        return closure.phi(pose), lambda: closure.jacobian(pose) * free

    def outcome(q: Array) -> Assembly:
        phi, _ = at(q)
        return Assembly(q, float(np.abs(phi).max(initial=0.0)), closure.misses(phi))

    random = np.random.default_rng(0)  # the same answer every time
    best = outcome(_gauss_newton(tree, q_tree, at, tolerance))
    for attempt in range(restarts):
        if best.residual <= tolerance:
            break
        spread = 0.1 * 1.4**attempt
        start = tree.integrate(q_tree, free * tree.reach * random.uniform(-spread, spread, tree.n))
        trial = outcome(_gauss_newton(tree, start, at, tolerance))
        if trial.residual < best.residual:
            best = trial
    return best


def _gauss_newton(
    tree: Tree, q: Array, at: Callable[[Array], tuple[Array, Callable[[], Array]]], tolerance: float
) -> Array:
    """Minimum-norm steps, shortened until |phi| falls; ends at a solution or a stationary point."""
    phi, jacobian = at(q)
    for _ in range(100):
        if np.abs(phi).max(initial=0.0) <= 1e-3 * tolerance:
            break
        part: Array = -np.asarray(np.linalg.lstsq(jacobian() * tree.reach, phi, rcond=1e-6)[0], dtype=float)
        longest, step = float(np.abs(part).max(initial=0.0)), part * tree.reach
        scale = min(1.0, 0.5 / longest) if longest > 0 else 0.0
        while scale > 1e-6:
            trial = tree.integrate(q, scale * step)
            phi_trial, jacobian_trial = at(trial)
            if np.linalg.norm(phi_trial) < (1 - 1e-4 * scale) * np.linalg.norm(phi):
                q, phi, jacobian = trial, phi_trial, jacobian_trial
                break
            scale /= 2
        else:
            break
    return q
