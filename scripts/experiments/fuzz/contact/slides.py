"""Event-driven simulation of slides: every link translates, so that inertia is constant and flight is parabolic.

Contact times and turning points are roots of quadratics; between them accelerations are constant. At each event the
impact law of `law.py` gives the velocity, and Gauss' principle the accelerations, with dry friction as bounded forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from scripts.experiments.fuzz.contact.law import answer_impact, push_within_bounds
from scripts.experiments.fuzz.contact.stops import Contact, contacts_of
from scripts.experiments.fuzz.motion import REDUNDANT, Motion
from scripts.experiments.fuzz.read import Model
from scripts.experiments.fuzz.spatial import Array
from scripts.experiments.fuzz.state import state

__all__ = ["History", "Slides"]

SAME_PLACE = 1e-12  # m: a gap below is closed
DOUBTFUL_GAP = 1e-8  # m: a gap below that closes may be taken for closed
LEAST_RISE = 1e-10  # m: a bounce that rises less is none
DOUBTFUL_RISE = 1e-8  # m: nearer to the last bounce than this, the end of a sequence is the program's own
AT_REST = 1e-11  # of the largest velocity or acceleration
SAME_TIME = 1e-9  # s: events nearer to each other may be one instant or two
NO_ACCELERATION = 1e-9  # of the largest
MAX_EVENTS = 5000


@dataclass
class History:
    """Pieces of constant acceleration, impacts as (time, joints that are hit), and until when all of it is certain.

    It ends there: what comes after depends on thresholds that the law leaves open.
    """

    t: list[float] = field(default_factory=list)
    q: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    a: list[Array] = field(default_factory=list)
    impacts: list[tuple[float, tuple[str, ...]]] = field(default_factory=list)
    certain_until: float = np.inf
    lost: float = 0.0

    def add(self, t: float, q: Array, v: Array, a: Array) -> None:
        """Begin a piece."""
        self.t.append(t)
        self.q.append(q)
        self.v.append(v)
        self.a.append(a)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Coordinates and rates at times, those after the event where a time is one."""
        k = np.maximum(np.searchsorted(self.t, times, side="right") - 1, 0)
        s = (times - np.array(self.t)[k])[:, None]
        q, v, a = np.array(self.q)[k], np.array(self.v)[k], np.array(self.a)[k]
        return q + s * v + 0.5 * s**2 * a, v + s * a

    def limit_certainty(self, t: float) -> None:
        """Note that what follows a time is not certain."""
        self.certain_until = min(self.certain_until, t)


class Slides:
    """A mechanism whose joints all slide, with couplings, stops, friction and constant forces."""

    def __init__(self, model: Model, contacts: Mapping[str, Contact], *, rechoose: bool = False) -> None:
        self.model, self.rechoose = model, rechoose
        zero = np.zeros((1, model.n))
        H, force, G, *_ = Motion(model).equations(state(model, zero, zero), zero)
        Z = np.eye(model.n)
        if G.shape[1]:
            _, sv, Vt = np.linalg.svd(G[0])
            Z = Vt[int((sv > REDUNDANT * sv[0]).sum()) :].T
        self.Z, self.D, self.force = Z, Z.T @ H[0] @ Z, Z.T @ force[0]
        self.stops = contacts_of(model.labels, contacts)
        self.N = np.array([stop.sign * Z[stop.column] for stop in self.stops]).reshape(-1, Z.shape[1])
        self.e = np.array([stop.restitution for stop in self.stops])
        self.friction = np.array([contacts[x].friction if x in contacts else 0.0 for x in model.labels])
        self.movable = np.linalg.norm(Z, axis=1) > 1e-9

    def gaps(self, q: Array) -> Array:
        return np.array([stop.sign * (q[stop.column] - stop.limit) for stop in self.stops])

    def run(self, q: Array, v: Array, t_end: float) -> History:
        """The motion from a start."""
        out, t = History(), 0.0
        for _ in range(MAX_EVENTS):
            v = self._impacts(t, q, v, out)
            if t >= out.certain_until:
                return out
            a, stays = self._accelerations(q, v)
            v = np.where(stays, 0.0, v)
            out.add(t, q, v, a)
            wait = self._next(q, v, a, stays, out, t)
            if t + wait > t_end:
                return out
            if wait < SAME_TIME:
                out.limit_certainty(t)
                return out
            q, v, t = q + wait * v + 0.5 * wait**2 * a, v + wait * a, t + wait
            q = self._exact(q)
        out.limit_certainty(t)
        return out

    def _exact(self, q: Array) -> Array:
        """Put what has reached its stop exactly onto it."""
        q = q.copy()
        for stop, gap in zip(self.stops, self.gaps(q), strict=True):
            if abs(gap) < SAME_PLACE:
                q[stop.column] = stop.limit
        return q

    def _impacts(self, t: float, q: Array, v: Array, out: History) -> Array:
        gaps = self.gaps(q)
        closed = gaps <= SAME_PLACE
        u = self.Z.T @ v if len(self.Z) else v
        if np.any((gaps > SAME_PLACE) & (gaps < DOUBTFUL_GAP) & (self.N @ u < 0)):
            out.limit_certainty(t)
        if not closed.any():
            return v
        at, e = np.flatnonzero(closed), self.e[closed].copy()
        while True:
            impact = answer_impact(self.D, self.N[closed], u, e, rechoose=self.rechoose)
            if not impact.hit:
                return v
            after = self.Z @ impact.v
            a, _ = self._accelerations(q, after)
            speeds, back = self.N[at] @ impact.v, -(self.N[at] @ (self.Z.T @ a))
            rise = np.where(back > 0, speeds**2 / (2 * np.where(back > 0, back, 1.0)), np.inf)
            bounced = np.array([k in impact.hit for k in range(len(at))]) & (speeds > 0)
            if np.any(bounced & (rise < DOUBTFUL_RISE)):
                out.limit_certainty(t)
            none = bounced & (rise < LEAST_RISE) & (e > 0)
            if not none.any():
                break
            e[none] = 0.0
        if not impact.certain:
            out.limit_certainty(t)
        out.lost += impact.lost
        hit = {self.model.labels[self.stops[at[k]].column] for k in impact.hit}
        out.impacts.append((t, tuple(sorted(hit))))
        return after

    def _accelerations(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Accelerations, and which joints stay at rest, by friction or at a stop."""
        rests = np.abs(v) <= AT_REST * np.abs(v).max(initial=0.0)
        force = self.force - self.Z.T @ np.where(rests, 0.0, self.friction * np.sign(v))
        free = np.asarray(np.linalg.solve(self.D, force), float)
        stays = np.zeros(self.model.n, bool)
        low, high = self._bounds(q)
        joints = np.flatnonzero(rests & self.movable & (low < high))
        if len(joints):
            L = np.linalg.cholesky(self.D)
            left = push_within_bounds(L, self.Z[joints], free, low[joints], high[joints])
            largest = max(np.abs(self.Z @ free).max(), np.abs(self.Z @ left).max())
            stays[joints] = np.abs(self.Z[joints] @ left) <= NO_ACCELERATION * largest
            if stays.any():  # exactly
                _, sv, Vt = np.linalg.svd(self.Z[stays])
                inner = Vt[int((sv > REDUNDANT * sv[0]).sum()) :].T
                left = inner @ np.linalg.solve(inner.T @ self.D @ inner, inner.T @ self.D @ left)
            free = left
        a = self.Z @ free
        a[stays] = 0.0
        return a, stays

    def _bounds(self, q: Array) -> tuple[Array, Array]:
        """The least and the largest force of friction and stops by joint."""
        low, high = -self.friction, self.friction.copy()
        for stop, gap in zip(self.stops, self.gaps(q), strict=True):
            if gap <= SAME_PLACE:
                (high if stop.sign > 0 else low)[stop.column] = stop.sign * np.inf
        return low, high

    def _next(self, q: Array, v: Array, a: Array, stays: np.ndarray, out: History, t: float) -> float:
        """Time until a gap closes or a joint that friction acts on turns."""
        times = [np.inf]
        for stop, gap in zip(self.stops, self.gaps(q), strict=True):
            if not stays[stop.column]:
                times.append(_closes(max(gap, 0.0), stop.sign * v[stop.column], stop.sign * a[stop.column]))
        size = np.abs(v).max(initial=0.0)
        for k in np.flatnonzero((self.friction > 0) & ~stays & self.movable):
            if abs(v[k]) > AT_REST * size and v[k] * a[k] < 0:
                times.append(-v[k] / a[k])
        ahead = np.sort(times)
        if len(ahead) > 1 and np.isfinite(ahead[1]) and 1e-12 < ahead[1] - ahead[0] < SAME_TIME:
            out.limit_certainty(t + ahead[0])
        return float(ahead[0])


def _closes(gap: float, speed: float, acceleration: float) -> float:
    """Time until a gap closes that is now opening, open or at rest."""
    if gap <= SAME_PLACE:  # now at the stop: it comes back, or it never left
        return -2 * speed / acceleration if speed > 0 > acceleration else np.inf
    if speed >= 0 and acceleration >= 0:
        return np.inf
    square = speed**2 - 2 * acceleration * gap
    if square < 0:
        return np.inf
    root = np.sqrt(square)
    return float(2 * gap / (root - speed) if root - speed > 0 else np.inf)
