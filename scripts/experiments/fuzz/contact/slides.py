"""Event-driven simulation of mechanisms with prismatic joints only. All links translate, so the inertia is constant.

Accelerations are constant between events. Times of contact and of turning points are roots of quadratics. At an event
the impact law of `law.py` gives the velocities. Gauss' principle gives accelerations, with friction as bounded forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from scripts.experiments.fuzz.contact.law import apply_impact_law, minimize_energy_with_bounds
from scripts.experiments.fuzz.contact.stops import Contact, list_joint_stops
from scripts.experiments.fuzz.newton_euler import RANK_TOLERANCE, NewtonEuler
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import to_state

__all__ = ["History", "Slides"]

GAP_TOLERANCE_M = 1e-12  # smaller gaps are closed
DOUBTFUL_GAP_M = 1e-8  # an approaching gap below this may count as closed elsewhere
MIN_RISE_M = 1e-10  # a stop whose bounce would rise less stays in contact
DOUBTFUL_RISE_M = 1e-8  # a sequence of bounces may end at such a rise elsewhere
REST_TOLERANCE = 1e-11  # relative to the largest rate
TIME_TOLERANCE_S = 1e-9  # events closer together may be simultaneous or not
ACCELERATION_TOLERANCE = 1e-9  # relative to the largest acceleration
MAX_EVENTS = 5000


@dataclass
class History:
    """Segments of constant acceleration, and impacts as (time, joints that are hit).

    The motion after `certain_until` depends on thresholds that the impact law does not define.
    """

    t: list[float] = field(default_factory=list)
    q: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    a: list[Array] = field(default_factory=list)
    impacts: list[tuple[float, tuple[str, ...]]] = field(default_factory=list)
    certain_until: float = np.inf
    lost: float = 0.0

    def add(self, t: float, q: Array, v: Array, a: Array) -> None:
        """Start a segment."""
        self.t.append(t)
        self.q.append(q)
        self.v.append(v)
        self.a.append(a)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return coordinates and rates at times; at the time of an event, the rates after it."""
        k = np.maximum(np.searchsorted(self.t, times, side="right") - 1, 0)
        s = (times - np.array(self.t)[k])[:, None]
        q, v, a = np.array(self.q)[k], np.array(self.v)[k], np.array(self.a)[k]
        return q + s * v + 0.5 * s**2 * a, v + s * a

    def limit_certainty(self, t: float) -> None:
        """Record that the motion after a time is uncertain."""
        self.certain_until = min(self.certain_until, t)


class Slides:
    """A mechanism with prismatic joints, couplings, stops, friction and constant forces."""

    def __init__(self, model: Model, contacts: Mapping[str, Contact], *, rechoose: bool = False) -> None:
        self.model, self.rechoose = model, rechoose
        zero = np.zeros((1, model.n))
        H, force, G, *_ = NewtonEuler(model).compute_equations(to_state(model, zero, zero), zero)
        Z = np.eye(model.n)
        if G.shape[1]:
            _, sv, Vt = np.linalg.svd(G[0])
            Z = Vt[int((sv > RANK_TOLERANCE * sv[0]).sum()) :].T
        self.Z, self.D, self.force = Z, Z.T @ H[0] @ Z, Z.T @ force[0]
        self.stops = list_joint_stops(model.labels, contacts)
        self.N = np.array([stop.sign * Z[stop.column] for stop in self.stops]).reshape(-1, Z.shape[1])
        self.e = np.array([stop.restitution for stop in self.stops])
        self.friction = np.array([contacts[x].friction if x in contacts else 0.0 for x in model.labels])
        self.movable = np.linalg.norm(Z, axis=1) > 1e-9

    def compute_gaps(self, q: Array) -> Array:
        return np.array([stop.sign * (q[stop.column] - stop.limit) for stop in self.stops])

    def run(self, q: Array, v: Array, t_end: float) -> History:
        """Return the motion from q, v until t_end."""
        history, t = History(), 0.0
        for _ in range(MAX_EVENTS):
            v = self._apply_impacts(t, q, v, history)
            if t >= history.certain_until:
                return history
            a, at_rest = self._compute_accelerations(q, v)
            v = np.where(at_rest, 0.0, v)
            history.add(t, q, v, a)
            duration = self._time_to_next_event(q, v, a, at_rest, history, t)
            if t + duration > t_end:
                return history
            if duration < TIME_TOLERANCE_S:
                history.limit_certainty(t)
                return history
            q, v, t = q + duration * v + 0.5 * duration**2 * a, v + duration * a, t + duration
            q = self._snap_to_stops(q)
        history.limit_certainty(t)
        return history

    def _snap_to_stops(self, q: Array) -> Array:
        """Set coordinates that have reached a stop to its limit."""
        q = q.copy()
        for stop, gap in zip(self.stops, self.compute_gaps(q), strict=True):
            if abs(gap) < GAP_TOLERANCE_M:
                q[stop.column] = stop.limit
        return q

    def _apply_impacts(self, t: float, q: Array, v: Array, history: History) -> Array:
        gaps = self.compute_gaps(q)
        closed = gaps <= GAP_TOLERANCE_M
        u = self.Z.T @ v if len(self.Z) else v
        if np.any((gaps > GAP_TOLERANCE_M) & (gaps < DOUBTFUL_GAP_M) & (self.N @ u < 0)):
            history.limit_certainty(t)
        if not closed.any():
            return v
        closed_stops, e = np.flatnonzero(closed), self.e[closed].copy()
        while True:
            impact = apply_impact_law(self.D, self.N[closed], u, e, rechoose=self.rechoose)
            if not impact.hit:
                return v
            after = self.Z @ impact.v
            a, _ = self._compute_accelerations(q, after)
            speeds, decelerations = self.N[closed_stops] @ impact.v, -(self.N[closed_stops] @ (self.Z.T @ a))
            rise = np.where(
                decelerations > 0, speeds**2 / (2 * np.where(decelerations > 0, decelerations, 1.0)), np.inf
            )
            bounced = np.array([k in impact.hit for k in range(len(closed_stops))]) & (speeds > 0)
            if np.any(bounced & (rise < DOUBTFUL_RISE_M)):
                history.limit_certainty(t)
            vanishing = bounced & (rise < MIN_RISE_M) & (e > 0)
            if not vanishing.any():
                break
            e[vanishing] = 0.0
        if not impact.certain:
            history.limit_certainty(t)
        history.lost += impact.lost
        hit = {self.model.labels[self.stops[closed_stops[k]].column] for k in impact.hit}
        history.impacts.append((t, tuple(sorted(hit))))
        return after

    def _compute_accelerations(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return accelerations, and which joints stay at rest by friction or at a stop."""
        is_slow = np.abs(v) <= REST_TOLERANCE * np.abs(v).max(initial=0.0)
        force = self.force - self.Z.T @ np.where(is_slow, 0.0, self.friction * np.sign(v))
        free = np.asarray(np.linalg.solve(self.D, force), float)
        at_rest = np.zeros(self.model.n, bool)
        low, high = self._force_bounds(q)
        joints = np.flatnonzero(is_slow & self.movable & (low < high))
        if len(joints):
            L = np.linalg.cholesky(self.D)
            constrained = minimize_energy_with_bounds(L, self.Z[joints], free, low[joints], high[joints])
            largest = max(np.abs(self.Z @ free).max(), np.abs(self.Z @ constrained).max())
            at_rest[joints] = np.abs(self.Z[joints] @ constrained) <= ACCELERATION_TOLERANCE * largest
            if at_rest.any():  # the numerical solution has them only nearly at rest
                _, sv, Vt = np.linalg.svd(self.Z[at_rest])
                inner = Vt[int((sv > RANK_TOLERANCE * sv[0]).sum()) :].T
                constrained = inner @ np.linalg.solve(inner.T @ self.D @ inner, inner.T @ self.D @ constrained)
            free = constrained
        a = self.Z @ free
        a[at_rest] = 0.0
        return a, at_rest

    def _force_bounds(self, q: Array) -> tuple[Array, Array]:
        """Return the smallest and the largest force of friction and stops by joint."""
        low, high = -self.friction, self.friction.copy()
        for stop, gap in zip(self.stops, self.compute_gaps(q), strict=True):
            if gap <= GAP_TOLERANCE_M:
                (high if stop.sign > 0 else low)[stop.column] = stop.sign * np.inf
        return low, high

    def _time_to_next_event(
        self, q: Array, v: Array, a: Array, at_rest: np.ndarray, history: History, t: float
    ) -> float:
        """Return the time until a gap closes or a joint with friction reverses."""
        times = [np.inf]
        for stop, gap in zip(self.stops, self.compute_gaps(q), strict=True):
            if not at_rest[stop.column]:
                times.append(_time_to_contact(max(gap, 0.0), stop.sign * v[stop.column], stop.sign * a[stop.column]))
        size = np.abs(v).max(initial=0.0)
        for k in np.flatnonzero((self.friction > 0) & ~at_rest & self.movable):
            if abs(v[k]) > REST_TOLERANCE * size and v[k] * a[k] < 0:
                times.append(-v[k] / a[k])
        first, second, *_ = *np.sort(times), np.inf
        if np.isfinite(second) and 1e-12 < second - first < TIME_TOLERANCE_S:
            history.limit_certainty(t + first)
        return float(first)


def _time_to_contact(gap: float, speed: float, acceleration: float) -> float:
    """Return the time until a gap closes."""
    if gap <= GAP_TOLERANCE_M:  # in contact: the joint leaves the stop and returns, or it does not leave
        return -2 * speed / acceleration if speed > 0 > acceleration else np.inf
    if speed >= 0 and acceleration >= 0:
        return np.inf
    discriminant = speed**2 - 2 * acceleration * gap
    if discriminant < 0:
        return np.inf
    root = np.sqrt(discriminant)
    return float(2 * gap / (root - speed) if root - speed > 0 else np.inf)
