"""Certify a set-point controller (eq. 14) for a start: the gain condition on a sublevel set of V_L.

With u of eq. 14, V_L = q_dot^T D q_dot / 2 + U(q) never grows along the reduced model, where

    U(q) = V(q) - V(q_d) - h(q_d)^T (q - q_d) + (q - q_d)^T K_P (q - q_d) / 2

is V_L at rest. So q stays on the part of {U <= V_L(start)} that is connected to the start. Let that part be bounded
and free of singular configurations, and let U's second derivative K_P + dh/dq be positive definite on it. Then each
solution of eq. 15 there, where U's gradient is zero, is a strict minimum of U. A connected sublevel set whose critical
points are all strict minima has only one of them, q_d, because between two minima there would be a saddle. The set need
not be convex, and no M_1 over the whole workspace is needed, which does not exist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import SetPoint
from ckc_pin.dynamics.equilibrium import h_gradient
from ckc_pin.dynamics.terms import Terms
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.initial import Start
from scripts.experiments.certificate.branch_walk import Border, find_minimum, follow, margin, same_configuration
from scripts.experiments.certificate.exploration import Explored, explore
from scripts.experiments.certificate.gradient_bounds import min_symmetric_eigenvalue

__all__ = ["Certificate", "SublevelSet", "certify", "level_of", "rest_height", "sublevel_set"]

DIVISIONS = 50  # of the radius that the set would have without gravity
SINGULAR_MARGIN = 1e-3  # |s| below which a configuration counts as singular
BORDER_MARGIN = 0.03  # |s| at which U hardly differs from its value at the singular configuration

Status = Literal["certified", "not certified"]


@dataclass(frozen=True)
class Certificate:
    """Whether eq. 14 provably brings a start to q_d, at the resolution of a lattice.

    Attributes
    ----------
    status : "certified" or "not certified"
        "not certified" does not mean that the controller fails, only that this argument does not prove it.
    reason : str
        One sentence.
    level : float
        V_L at the start, J.
    smallest_eigenvalue : float
        Of K_P + sym dh/dq on the set, N m/rad between angles; NaN where the set reaches a singular
        configuration, at which h has no derivative.
    smallest_margin : float
        Smallest |s| on the set, see `scripts.experiments.certificate.branch_walk.margin`.
    safe_level : float
        Largest level, J, at which the set around q_d satisfies the conditions, by the lattice; at most `level`.
    worst_q : (d,) array
        Where the conditions fail first as the level rises; if they never do, where the eigenvalue is smallest.
    sampled : bool
        Whether random rays were followed instead of a lattice: d > 2.
    points : int
    resolution : (d,) array
        The lattice's step, rad or m.
    """

    status: Status
    reason: str
    level: float
    smallest_eigenvalue: float
    smallest_margin: float
    safe_level: float
    worst_q: Array
    sampled: bool
    points: int
    resolution: Array


@dataclass(frozen=True)
class SublevelSet:
    """The part of {U <= level} that is connected to q_d, with the values on it.

    Attributes
    ----------
    explored : Explored
    eigenvalues, margins : (points,) arrays
        Smallest eigenvalue of K_P + sym dh/dq, and |s|, at the nodes explored.
    step : (d,) array
    """

    explored: Explored
    eigenvalues: Array
    margins: Array
    step: Array


def rest_height(mechanism: Mechanism, controller: SetPoint, at: Kinematics) -> float:
    """V_L at a configuration at rest, U of the module's docstring, joules."""
    return controller.lyapunov(0.0, Terms(mechanism, at, np.zeros(mechanism.n)), np.zeros(0))


def level_of(mechanism: Mechanism, controller: SetPoint, start: Start) -> float:
    """V_L at a start, joules."""
    return controller.lyapunov(0.0, Terms(mechanism, start.at, start.at.rho @ start.q_dot), start.w)


def sublevel_set(
    mechanism: Mechanism, controller: SetPoint, level: float, divisions: int = DIVISIONS, seed: int = 0
) -> SublevelSet:
    """Explore the part of {U <= level} around q_d.

    Parameters
    ----------
    mechanism : Mechanism
        Without free roots.
    controller : SetPoint
    level : float
        Joules.
    divisions : int
        Steps of the lattice to the radius that the set would have without gravity.
    seed : int
        Of the rays' directions, for d > 2.
    """
    step = np.sqrt(2 * max(level, 1e-12) * np.diagonal(np.linalg.inv(controller.K_P))) / divisions
    target = controller.target.at
    level = max(level, rest_height(mechanism, controller, target))  # zero but for rounding
    explored = explore(mechanism, target, step, lambda at: rest_height(mechanism, controller, at), level, seed=seed)
    return SublevelSet(
        explored=explored,
        eigenvalues=np.array([_stiffness(mechanism, controller, at) for at in explored.nodes]),
        margins=np.array([margin(at) for at in explored.nodes]),
        step=step,
    )


def certify(mechanism: Mechanism, controller: SetPoint, start: Start, divisions: int = DIVISIONS) -> Certificate:
    """Decide whether the argument of section II-B applies to a start.

    Parameters
    ----------
    mechanism : Mechanism
    controller : SetPoint
        Built for this mechanism, without a torque limit.
    start : Start
        On phi = 0.
    divisions : int
        See `sublevel_set`.
    """
    level = level_of(mechanism, controller, start)
    reason = _find_obstacle(mechanism, controller, start, level)
    if reason:
        nan = np.full(mechanism.d, np.nan)
        return Certificate("not certified", reason, level, np.nan, np.nan, 0.0, nan, mechanism.d > 2, 0, nan)
    sublevel = sublevel_set(mechanism, controller, level, divisions)
    search = _Search(mechanism, controller, sublevel, level)
    tightest, softest = search.find_smallest_margin(), search.find_smallest_stiffness()
    singular = bool(sublevel.explored.ends) or margin(tightest) <= SINGULAR_MARGIN
    failure = search.find_first_failure([tightest, softest])
    safe_level, worst = failure or (level, softest)
    return Certificate(
        status="certified"
        if failure is None and not sublevel.explored.truncated and search.is_connected(start)
        else "not certified",
        reason=search.explain(singular, tightest, softest, start),
        level=level,
        smallest_eigenvalue=np.nan if singular else search.stiffness(softest),
        smallest_margin=0.0 if singular else margin(tightest),
        safe_level=safe_level,
        worst_q=mechanism.independent_part(worst.q_tree),
        sampled=sublevel.explored.sampled,
        points=len(sublevel.explored.nodes),
        resolution=sublevel.step,
    )


def _find_obstacle(mechanism: Mechanism, controller: SetPoint, start: Start, level: float) -> str:
    """Return why the argument does not apply at all; empty if it may apply."""
    if controller.target.mechanism is not mechanism:
        return "the controller compensates the gravity of another model than the plant"
    if not mechanism.tree.is_euclidean:
        return "an independent coordinate belongs to a free root, whose orientation is not a vector"
    if np.any(start.w):
        return "the start is off phi = 0: V_L is a Lyapunov function of the reduced model only"
    if level < -1e-12 * (1.0 + abs(controller.target.potential_energy)):
        return "V_L is lower at the start than at q_d, where it must be smallest"
    return ""


@dataclass(frozen=True)
class _Search:
    """Search for smallest values and failures between the points of the lattice."""

    mechanism: Mechanism
    controller: SetPoint
    sublevel: SublevelSet
    level: float

    def height(self, at: Kinematics) -> float:
        return rest_height(self.mechanism, self.controller, at)

    def stiffness(self, at: Kinematics) -> float:
        return _stiffness(self.mechanism, self.controller, at)

    def is_failure(self, at: Kinematics) -> bool:
        """Return whether a configuration is singular, or K_P + dh/dq is not positive definite there."""
        return margin(at) <= SINGULAR_MARGIN or self.stiffness(at) <= 0

    def find_smallest_margin(self) -> Kinematics:
        if self.sublevel.explored.ends:
            return min(self.sublevel.explored.ends, key=lambda end: end.water).at
        return self._lowest(margin, self.sublevel.margins)

    def find_smallest_stiffness(self) -> Kinematics:
        if self.sublevel.explored.ends:
            return self.sublevel.explored.nodes[int(np.argmin(self.sublevel.eigenvalues))]
        return self._lowest(self.stiffness, self.sublevel.eigenvalues)

    def find_first_failure(self, refined: list[Kinematics]) -> tuple[float, Kinematics] | None:
        """Return the largest level without a failure and the first failure; None if nothing fails."""
        explored = self.sublevel.explored
        failing = [
            (w, at)
            for w, at, x in zip(explored.water, explored.nodes, self.sublevel.eigenvalues, strict=True)
            if x <= 0
        ]
        failing += [(max(0.0, self.height(at)), at) for at in refined if self.is_failure(at)]
        failing += [(end.water, end.at) for end in explored.ends]
        if not failing:
            return None
        water, first = min(failing, key=lambda pair: pair[0])
        below = max((w for w in explored.water if w < water), default=0.0)
        is_singular = margin(first) <= SINGULAR_MARGIN
        border = Border(self.mechanism, BORDER_MARGIN, accepts_singular_side=True)
        admit = border if is_singular else self._failing
        lowest = find_minimum(self.mechanism, first, self.height, self.sublevel.step, admit)
        return min(below, max(0.0, self.height(lowest))), lowest if 0.0 <= self.height(lowest) < water else first

    def explain(self, singular: bool, tightest: Kinematics, softest: Kinematics, start: Start) -> str:
        """Return the sentence of `Certificate.reason`."""
        if singular:
            return f"the set reaches a singular configuration, near {self._format_q(tightest)}"
        stiffness = self.stiffness(softest)
        if stiffness <= 0:
            return f"K_P + dh/dq has the eigenvalue {stiffness:.3g} at {self._format_q(softest)}, inside the set"
        if self.sublevel.explored.truncated:
            return f"the set extends beyond the {len(self.sublevel.explored.nodes)} points that were explored"
        if not self.is_connected(start):
            return "the start is not connected to q_d within {V_L(q, 0) <= V_L(start)}"
        return "K_P + dh/dq is positive definite on the whole set, and no singular configuration lies on it"

    def is_connected(self, start: Start) -> bool:
        """Return whether the start is next to a node of the lattice, or visible from q_d, on the same branch."""
        if self.sublevel.explored.sampled:
            return self._is_visible(start.at)
        q = self.mechanism.independent_part(start.at.q_tree)
        for at in self.sublevel.explored.nodes:
            straight = q - self.mechanism.independent_part(at.q_tree)
            if np.all(np.abs(straight) <= 1.01 * self.sublevel.step) and self._is_reached(at, straight, start.at):
                return True
        return False

    def _is_visible(self, end: Kinematics) -> bool:
        """Return whether the straight line from q_d to a configuration stays inside the set."""
        at = self.controller.target.at
        straight = self.mechanism.independent_part(end.q_tree) - self.controller.q_d
        pieces = 1 + int(np.ceil(np.max(np.abs(straight) / self.sublevel.step)))
        for _ in range(pieces - 1):
            at, reached = follow(self.mechanism, at, straight / pieces)
            if reached < 1.0 or self.height(at) > self.level:
                return False
        return self._is_reached(at, straight / pieces, end)

    def _is_reached(self, at: Kinematics, straight: Array, end: Kinematics) -> bool:
        reached, fraction = follow(self.mechanism, at, straight)
        return fraction == 1.0 and same_configuration(self.mechanism, reached, end)

    def _lowest(self, value: Callable[[Kinematics], float], values: Array) -> Kinematics:
        nodes, step = self.sublevel.explored.nodes, self.sublevel.step
        return find_minimum(self.mechanism, nodes[int(np.argmin(values))], value, step, self._inside)

    def _failing(self, at: Kinematics) -> Kinematics | None:
        return at if self.is_failure(at) else None

    def _inside(self, at: Kinematics) -> Kinematics | None:
        return at if self.height(at) <= self.level else None

    def _format_q(self, at: Kinematics) -> str:
        q = self.mechanism.independent_part(at.q_tree)
        return ", ".join(f"{name} = {x:.4g}" for name, x in zip(self.mechanism.independent, q, strict=True))


def _stiffness(mechanism: Mechanism, controller: SetPoint, at: Kinematics) -> float:
    return min_symmetric_eigenvalue(controller.K_P + h_gradient(mechanism, at))
