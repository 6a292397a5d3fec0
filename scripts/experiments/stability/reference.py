"""What each case is compared with: never the solver that is measured, nor its equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.run.run import Run
from scripts.experiments.stability.equations import Control, Reduced, free_motion, miss, to_absolute, uncontrolled
from scripts.experiments.stability.planar import Planar

__all__ = ["ByHand", "Known", "OneAngle", "Reference", "Returns", "gap"]

TIGHT = 1e-13
NOT_STIFF = ("DOP853", TIGHT), ("LSODA", 1e-12)  # the right answer, and another by which its uncertainty is known
STIFF = ("LSODA", TIGHT), ("LSODA", 1e-12)
LAYER = 40.0  # epsilons, after which w is no more


class Reference(Protocol):
    """Where the right answer comes from; all errors are relative to the solution's scale (`gap`)."""

    @property
    def source(self) -> str:
        """A few words."""

    def error(self, run: Run) -> float:
        """Largest error of a run over its output instants; NaN where none is known."""

    def uncertainty(self, run: Run) -> float:
        """How far the right answer itself may be off."""

    def phi(self, run: Run) -> float:
        """Largest |phi - w| of a run over its output instants, m."""


def gap(ours: Array, right: Array) -> float:
    """Largest difference, relative to the largest value that is right, or to 1 where that is smaller."""
    if not np.all(np.isfinite(ours)):
        return float("inf")
    return float(np.abs(ours - right).max(initial=0.0)) / max(1.0, float(np.abs(right).max(initial=0.0)))


@dataclass
class ByHand:
    """The five-bar's equations of `equations`, integrated by SciPy at 1e-13 from the run's own start.

    Without a control and with w(0) = 0 in the links' angles; else eq. 6 on circles that intersect. Where gains or
    dampers are `stiff`, by LSODA. The uncertainty is the difference from LSODA at ten times the tolerance.
    """

    planar: Planar
    control: Control | None = None
    w: tuple[float, float] = (0.0, 0.0)
    epsilon: float = 1.0
    stiff: bool = False
    _known: dict[tuple[bytes, ...], Array] = field(default_factory=dict)

    @property
    def on_level(self) -> bool:
        """Whether eq. 6 is integrated."""
        return self.control is not None or any(self.w)

    @property
    def source(self) -> str:
        """Which of the two."""
        what = "eq. 6" if self.on_level else "links"
        return f"{what} by hand, {'LSODA' if self.on_level or self.stiff else 'DOP853'} at {TIGHT:g}"

    def error(self, run: Run) -> float:
        """Compare angles and rates; of an SPF off its manifold the rates of theta_1 and theta_3 alone."""
        right = self._motion(run)
        if not np.all(np.isfinite(right)):
            return float("inf" if run.status == "done" else "nan")  # the equations have no solution there
        return self._gap(np.hstack([run.q_tree, run.v_tree]), right)

    def uncertainty(self, run: Run) -> float:
        """Compare with a looser integration."""
        right, other = self._motion(run), self._motion(run, looser=True)
        return self._gap(other, right) if np.all(np.isfinite(right)) else float("nan")

    def _gap(self, ours: Array, right: Array) -> float:
        rates = [4, 6] if any(self.w) else [4, 5, 6, 7]
        return max(gap(ours[:, :4], right[:, :4]), gap(ours[:, rates], right[:, rates]))

    def phi(self, run: Run) -> float:
        """Measure |phi - w| with the closure written by hand."""
        w = np.array(self.w)[None, :] * np.exp(-run.t / self.epsilon)[:, None]
        return float(np.abs([miss(self.planar, to_absolute(q.tolist())) for q in run.q_tree] - w).max())

    def _motion(self, run: Run, looser: bool = False) -> Array:
        """(theta, theta_dot) at a run's instants from its own start, shape (m, 8); NaN from where they end."""
        theta, theta_dot = run.q_tree[0], run.v_tree[0]
        key = (run.t.tobytes(), theta.tobytes(), theta_dot.tobytes(), bytes([looser]))
        if key not in self._known:
            integrate = self._on_level if self.on_level else self._free
            self._known[key] = integrate(run.t, theta, theta_dot, looser)
        return self._known[key]

    def _free(self, t: Array, theta: Array, theta_dot: Array, looser: bool) -> Array:
        start = np.array([*to_absolute(theta.tolist()), *to_absolute(theta_dot.tolist())])
        y = self._integrate(free_motion(self.planar), t, start, *(STIFF if self.stiff else NOT_STIFF)[looser])
        return np.hstack([_to_joints(y[:, :4]), _to_joints(y[:, 4:])])

    def _on_level(self, t: Array, theta: Array, theta_dot: Array, looser: bool) -> Array:
        a = to_absolute(theta.tolist())
        branch = float(np.sign(np.sin(a[1] - a[3])))
        acceleration = self.control or uncontrolled

        def now(t: float, y: Array) -> Reduced:
            w = [x * np.exp(-t / self.epsilon) for x in self.w]
            return Reduced(self.planar, y[:2].tolist(), y[2:].tolist(), w, branch)

        def rate(t: float, y: Array) -> Array:
            terms = now(t, y)
            return np.array([y[2], y[3], *acceleration(t, terms, y[:2].tolist(), y[2:].tolist())])

        start = np.array([theta[0], theta[2], theta_dot[0], theta_dot[2]])
        y = self._integrate(rate, t, start, *STIFF[looser])
        states = [now(float(s), row) for s, row in zip(t, y, strict=True) if np.isfinite(row[0])]
        angles = np.unwrap(_to_joints(np.array([s.a for s in states])), axis=0)
        angles += 2 * np.pi * np.round((theta - angles[0]) / (2 * np.pi))
        found = np.full((len(t), 8), np.nan)
        found[: len(states)] = np.hstack([angles, _to_joints(np.array([s.r for s in states]))])
        return found

    def _integrate(
        self, rate: Callable[..., Array | list[float]], t: Array, y: Array, method: str, rtol: float
    ) -> Array:
        """Integrate; the boundary layer of w on its own, so that no step reaches into it.

        DOP853 is stopped at each instant, since its output between steps is less accurate than they are.
        """
        from scipy.integrate import solve_ivp

        rows = np.full((len(t), len(y)), np.nan)
        rows[0] = y
        cut = [LAYER * self.epsilon] if any(self.w) and LAYER * self.epsilon < t[-1] else []
        marks = sorted({*t.tolist()} if method == "DOP853" else {float(t[0]), *cut, float(t[-1])})
        for begin, end in pairwise(marks):
            within = (t > begin) & (t <= end)
            times = np.union1d(t[within], [end])
            try:
                solution = solve_ivp(rate, (begin, end), y, method, times, rtol=rtol, atol=1e-3 * rtol)
            except (ArithmeticError, ValueError):  # circles that do not meet
                break
            if not solution.success:
                break
            rows[within] = solution.y.T[: np.count_nonzero(within)]
            y = solution.y[:, -1]
        return rows


def _to_joints(a: Array) -> Array:
    return np.column_stack([a[:, 0], a[:, 1] - a[:, 0], a[:, 2], a[:, 3] - a[:, 2]])


@dataclass
class _Given:
    """Right by publication; the closure as the run itself says."""

    source: str
    digits: float

    def uncertainty(self, run: Run) -> float:
        """As many digits as are published."""
        return self.digits

    def phi(self, run: Run) -> float:
        """As the run itself says."""
        return run.max_phi


@dataclass
class Known(_Given):
    """Values at the end of the run by coordinate, or of points (m)."""

    coordinates: Mapping[str, float] = field(default_factory=dict)
    points: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def error(self, run: Run) -> float:
        """Compare the end, if it was reached."""
        if run.status != "done":
            return float("nan")
        ours = [run.q_tree[-1, run.column(name)] for name in self.coordinates]
        ours += [x for name in self.points for x in run.points[name][-1]]
        right = [*self.coordinates.values(), *(x for point in self.points.values() for x in point)]
        return gap(np.array(ours), np.array(right))


@dataclass
class Returns(_Given):
    """A motion that ends as it began: after a whole period from rest."""

    def error(self, run: Run) -> float:
        """Compare the end, if it was reached, with the start."""
        if run.status != "done":
            return float("nan")
        return max(gap(run.q_tree[-1], run.q_tree[0]), gap(run.v_tree[-1], np.zeros(run.v_tree.shape[1])))


@dataclass
class OneAngle:
    """The N-four-bar: all rods at one angle, theta'' = -k cos(theta), psi = -theta."""

    k: float
    source: str = "closed form theta'' = -k cos(theta), DOP853 at 1e-13"

    def error(self, run: Run) -> float:
        """Compare all angles and rates."""
        sign = np.array([1.0 if name.startswith("theta") else -1.0 for name in run.coordinates])
        theta, theta_dot = self._motion(run, TIGHT)
        return max(gap(run.q_tree, np.outer(theta, sign)), gap(run.v_tree, np.outer(theta_dot, sign)))

    def uncertainty(self, run: Run) -> float:
        """Compare with ten times the tolerance."""
        return gap(self._motion(run, 10 * TIGHT), self._motion(run, TIGHT))

    def phi(self, run: Run) -> float:
        """As the run itself says."""
        return run.max_phi

    def _motion(self, run: Run, rtol: float) -> Array:
        from scipy.integrate import solve_ivp

        start = (run.q_tree[0, 0], run.v_tree[0, 0])
        span = (0.0, float(run.t[-1]))

        def rate(_: float, y: Array) -> tuple[float, float]:
            return y[1], -self.k * np.cos(y[0])

        return np.asarray(solve_ivp(rate, span, start, "DOP853", run.t, rtol=rtol, atol=rtol).y)
