"""Where a motion has been on its level sets, and where z will be next.

phi(q, z) = w makes z a function of (q, w) with the known slopes rho_z and phi_z^-1. Newton needs fewer
iterations the better z is predicted: to first order from the nearest point visited, and along the motion,
which is smooth in t, by Hermite interpolation through the last points and their rates.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ckc_pin.mechanism.chart import Chart
from ckc_pin.mechanism.kinematics import Kinematics
from ckc_pin.mechanism.sigma import predict
from ckc_pin.mechanism.tree import Array

__all__ = ["Trail", "hermite_weights"]

KEPT = 8  # points
NODES = 3  # of the interpolation, which is then of degree 5
LARGEST_WEIGHT = 1e3  # sum of the weights' magnitudes: beyond, the points' own errors are magnified
RESOLVED = 3.0  # of epsilon: over longer times w's rate foretells nothing


class Trail:
    """The last points of a motion: when, where, how fast, on which level set.

    Parameters
    ----------
    start : Kinematics
        Where the motion starts; the first prediction is made from there.
    epsilon : float
        Time constant of w; over longer times w's rate foretells nothing.
    """

    def __init__(self, start: Kinematics, epsilon: float = np.inf) -> None:
        self._last = start
        self._epsilon = epsilon
        self._t: list[float] = []
        self._at: list[Kinematics] = []
        self._q_tree, self._v_tree = np.empty((KEPT, start.tree.nq)), np.empty((KEPT, start.tree.n))
        self._w = np.empty((KEPT, start.closure.rows))
        self._off = False  # whether any level was not zero

    @property
    def last(self) -> Kinematics:
        """The configuration noted last."""
        return self._last

    def add(self, t: float, at: Kinematics, v_tree: Array, w: Array) -> None:
        """Take note of a configuration closed on the level set w, moving with v_tree; the former one at t is lost."""
        self._last = at
        if t in self._t:
            k = self._t.index(t)
        elif len(self._t) < KEPT:
            k = len(self._t)
            self._t.append(t)
            self._at.append(at)
        else:
            k = min(range(KEPT), key=lambda k: -abs(self._t[k] - t))  # the furthest
        self._t[k], self._at[k] = t, at
        self._q_tree[k], self._v_tree[k], self._w[k] = at.q_tree, v_tree, w
        self._off = self._off or bool(w.any())

    def predict(self, t: float, numbers: Array, chart: Chart, w: Array) -> Kinematics:
        """Return the configuration at q, with z as the trail foretells it.

        Parameters
        ----------
        t : float
        numbers : (d,) array
            The wanted q in a chart.
        chart : Chart
        w : (rows,) array
            The wanted level set.
        """
        if not self._t:
            return predict(self.last, chart.step(self.last.q_tree, numbers))
        count = len(self._t)
        nearest = int(np.abs(chart.steps(self._q_tree[:count], numbers)).max(axis=1).argmin())
        base = self._at[nearest]
        q, z = base.partition.q, base.partition.z
        dq = chart.step(base.q_tree, numbers)
        chosen, a, b = self._foretelling(t, nearest)
        step = self._along(base, chosen, a, b)
        step[z] += base.rho[z] @ (dq - step[q])
        step[q] = dq
        if self._off:
            level = (np.array(a) - np.array(b) / self._epsilon) @ self._w[chosen]  # w_dot = -w / epsilon
            step[z] += base.phi_z_factor.solve(w - level)
        return base.moved(step)

    def _foretelling(self, t: float, nearest: int) -> tuple[list[int], list[float], list[float]]:
        """Choose points to interpolate through, the nearest in time, as many as do not magnify their errors."""
        away = {k: abs(own - t) for k, own in enumerate(self._t)}
        chosen = sorted(away, key=away.__getitem__)[:NODES] if 0.0 not in away.values() else []
        while len(chosen) > 1:
            a, b = hermite_weights([self._t[k] for k in chosen], t)
            resolved = not self._off or away[chosen[-1]] < RESOLVED * self._epsilon or not self._w[chosen].any()
            if resolved and sum(map(abs, a)) < LARGEST_WEIGHT:
                return chosen, a, b
            chosen.pop()
        return [nearest], [1.0], [0.0]  # to first order in q, whatever the time

    def _along(self, base: Kinematics, chosen: list[int], a: list[float], b: list[float]) -> Array:
        """Tangent step from a base to the configuration that points and their rates lead to, shape (n,)."""
        tree, there, v_tree = base.tree, self._q_tree[chosen], self._v_tree[chosen]
        if tree.flat:
            return np.asarray(a) @ (there - base.q_tree) + np.asarray(b) @ v_tree
        steps = [tree.difference(base.q_tree, q_tree) for q_tree in there]
        rates = [
            pin.dDifference(tree.model, base.q_tree, q_tree, pin.ARG1) @ v
            for q_tree, v in zip(there, v_tree, strict=True)
        ]
        return np.asarray(a) @ steps + np.asarray(b) @ rates


def hermite_weights(nodes: list[float], t: float) -> tuple[list[float], list[float]]:
    """Weights a, b with p(t) = sum of a_i p(t_i) + b_i p'(t_i), exact for polynomials of degree 2 k - 1.

    Parameters
    ----------
    nodes : list of k floats
        Distinct times.
    t : float
    """
    a, b = [], []
    for i, own in enumerate(nodes):
        others = [node for j, node in enumerate(nodes) if j != i]
        basis = 1.0
        for other in others:
            basis *= (t - other) / (own - other)
        slope = sum(1.0 / (own - other) for other in others)
        a.append((1.0 - 2.0 * (t - own) * slope) * basis**2)
        b.append((t - own) * basis**2)
    return a, b
