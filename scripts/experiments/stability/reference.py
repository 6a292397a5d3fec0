"""References of the cases, computed without the measured solver and its equations."""

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

__all__ = ["FiveBarEquations", "NFourBarClosedForm", "PublishedValues", "Reference", "Returns", "gap"]

TIGHT = 1e-13
NOT_STIFF = ("DOP853", TIGHT), ("LSODA", 1e-12)  # the reference, and a second solver for its uncertainty
STIFF = ("LSODA", TIGHT), ("LSODA", 1e-12)
LAYER = 40.0  # t / epsilon after which w is zero


class Reference(Protocol):
    """A reference solution. All errors are relative to the solution's scale (`gap`)."""

    @property
    def source(self) -> str:
        """Short description of the source."""

    def error(self, run: Run) -> float:
        """Return the largest error of a run over its output instants, NaN if there is no reference value."""

    def uncertainty(self, run: Run) -> float:
        """Return an error bound of the reference."""

    def phi(self, run: Run) -> float:
        """Return the largest |phi - w| of a run over its output instants, m."""


def gap(ours: Array, right: Array) -> float:
    """Return the largest difference, relative to the largest reference value or to 1 if that is larger."""
    if not np.all(np.isfinite(ours)):
        return float("inf")
    return float(np.abs(ours - right).max(initial=0.0)) / max(1.0, float(np.abs(right).max(initial=0.0)))


@dataclass
class FiveBarEquations:
    """The five-bar's `equations`, integrated by SciPy at 1e-13 from the start of the run.

    The free motion with w(0) = 0 is integrated in the links' angles, any other by eq. 6 with intersecting circles.
    `stiff` gains or dampers are integrated by LSODA. The uncertainty is the difference from LSODA at ten times the
    tolerance.
    """

    planar: Planar
    control: Control | None = None
    w: tuple[float, float] = (0.0, 0.0)
    epsilon: float = 1.0
    stiff: bool = False
    _solutions: dict[tuple[bytes, ...], Array] = field(default_factory=dict)

    @property
    def on_level(self) -> bool:
        """Whether eq. 6 is integrated."""
        return self.control is not None or any(self.w)

    @property
    def source(self) -> str:
        """Short description of the equations."""
        what = "eq. 6" if self.on_level else "links"
        return f"{what} by hand, {'LSODA' if self.on_level or self.stiff else 'DOP853'} at {TIGHT:g}"

    def error(self, run: Run) -> float:
        """Compare angles and rates; for an SPF off its manifold only the rates of theta_1 and theta_3."""
        right = self._motion(run)
        if not np.all(np.isfinite(right)):
            return float("inf" if run.status == "done" else "nan")  # the equations have no solution
        return self._gap(np.hstack([run.q_tree, run.v_tree]), right)

    def uncertainty(self, run: Run) -> float:
        """Compare with a looser integration."""
        right, other = self._motion(run), self._motion(run, looser=True)
        return self._gap(other, right) if np.all(np.isfinite(right)) else float("nan")

    def _gap(self, ours: Array, right: Array) -> float:
        rates = [4, 6] if any(self.w) else [4, 5, 6, 7]
        return max(gap(ours[:, :4], right[:, :4]), gap(ours[:, rates], right[:, rates]))

    def phi(self, run: Run) -> float:
        """Return the largest |phi - w| by the closure of `equations`."""
        w = np.array(self.w)[None, :] * np.exp(-run.t / self.epsilon)[:, None]
        return float(np.abs([miss(self.planar, to_absolute(q.tolist())) for q in run.q_tree] - w).max())

    def _motion(self, run: Run, looser: bool = False) -> Array:
        """Return (theta, theta_dot) at a run's instants from its start, shape (m, 8), NaN after their end."""
        theta, theta_dot = run.q_tree[0], run.v_tree[0]
        key = (run.t.tobytes(), theta.tobytes(), theta_dot.tobytes(), bytes([looser]))
        if key not in self._solutions:
            integrate = self._on_level if self.on_level else self._free
            self._solutions[key] = integrate(run.t, theta, theta_dot, looser)
        return self._solutions[key]

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
        solution = np.full((len(t), 8), np.nan)
        solution[: len(states)] = np.hstack([angles, _to_joints(np.array([s.r for s in states]))])
        return solution

    def _integrate(
        self, rate: Callable[..., Array | list[float]], t: Array, y: Array, method: str, rtol: float
    ) -> Array:
        """Integrate to the instants, with the boundary layer of w as a separate interval.

        DOP853 is stopped at each instant, since its interpolant is less accurate than its steps.
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
            except (ArithmeticError, ValueError):  # the circles do not intersect
                break
            if not solution.success:
                break
            rows[within] = solution.y.T[: np.count_nonzero(within)]
            y = solution.y[:, -1]
        return rows


def _to_joints(a: Array) -> Array:
    return np.column_stack([a[:, 0], a[:, 1] - a[:, 0], a[:, 2], a[:, 3] - a[:, 2]])


@dataclass
class _Published:
    """Base of published references; phi is taken from the run."""

    source: str
    digits: float

    def uncertainty(self, run: Run) -> float:
        """Return the error bound from the number of published digits."""
        return self.digits

    def phi(self, run: Run) -> float:
        """Return the run's own largest |phi|."""
        return run.max_phi


@dataclass
class PublishedValues(_Published):
    """Published values at the end of a run: coordinates, or positions of points (m)."""

    coordinates: Mapping[str, float] = field(default_factory=dict)
    points: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def error(self, run: Run) -> float:
        """Compare the end of the run, if it was reached."""
        if run.status != "done":
            return float("nan")
        ours = [run.q_tree[-1, run.column(name)] for name in self.coordinates]
        ours += [x for name in self.points for x in run.points[name][-1]]
        right = [*self.coordinates.values(), *(x for point in self.points.values() for x in point)]
        return gap(np.array(ours), np.array(right))


@dataclass
class Returns(_Published):
    """A published period: the motion from rest ends in its start."""

    def error(self, run: Run) -> float:
        """Compare the end of the run, if it was reached, with the start."""
        if run.status != "done":
            return float("nan")
        return max(gap(run.q_tree[-1], run.q_tree[0]), gap(run.v_tree[-1], np.zeros(run.v_tree.shape[1])))


@dataclass
class NFourBarClosedForm:
    """The N-four-bar, whose rods all have one angle: theta'' = -k cos(theta), psi = -theta."""

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
        """Return the run's own largest |phi|."""
        return run.max_phi

    def _motion(self, run: Run, rtol: float) -> Array:
        from scipy.integrate import solve_ivp

        start = (run.q_tree[0, 0], run.v_tree[0, 0])
        span = (0.0, float(run.t[-1]))

        def rate(_: float, y: Array) -> tuple[float, float]:
            return y[1], -self.k * np.cos(y[0])

        return np.asarray(solve_ivp(rate, span, start, "DOP853", run.t, rtol=rtol, atol=rtol).y)
