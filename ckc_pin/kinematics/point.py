"""A point of a mechanism as the tool: where it is for a q, the q that puts it somewhere, and how fast it moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.continuation import follow, same_branch
from ckc_pin.kinematics.extended import Extended, Task, extend_closure, find_point
from ckc_pin.kinematics.nodes import find_solutions
from ckc_pin.kinematics.sigma import newton, sigma
from ckc_pin.mechanism.batch import difference_many, evaluate_closure, integrate_many
from ckc_pin.mechanism.closure import Closure, Selected
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose, Rate

__all__ = ["Inverse", "Point"]

SMALLEST_PIECE = 1e-6  # of the way to a place
LONGEST_STEP = 0.5  # rad, or of the mechanism's size, of any coordinate in one piece of the way
MOST = 64  # solutions of the inverse kinematics
MOST_CORRECTIONS = 8  # of Newton's method from a place nearby
OFF = 1e-9  # of the mechanism's size: how far a place that cannot be met exactly may be missed


@dataclass(frozen=True)
class Inverse:
    """A configuration that puts a point somewhere.

    Attributes
    ----------
    at : Kinematics
        Of the mechanism; `at.q_tree` is the configuration.
    q : (d,) array
        Its independent coordinates.
    """

    at: Kinematics
    q: Array


class Point:
    """Forward and inverse kinematics and the closed-chain Jacobian of a named point.

    Parameters
    ----------
    mechanism : Mechanism
    name : str, optional
        A [[point]] of it; default the first one.

    Raises
    ------
    InputError
        No such point, or one whose place and orientation do not tell the configuration.

    Notes
    -----
    Where the place alone leaves freedoms open (a planar 3-RRR's plate can turn about its point), the inverse
    kinematics keeps the orientation of the start.
    """

    def __init__(self, mechanism: Mechanism, name: str | None = None) -> None:
        require_type(mechanism, Mechanism, "Point: mechanism", "a Mechanism, as load returns it")
        self.mechanism = mechanism
        self.name = find_point(mechanism, name)
        self.extended: Extended = extend_closure(mechanism, self.name)
        chosen = np.concatenate([self.extended.loops, self.extended.fixing])
        closure = self.extended.closure
        rows = Selected(closure.groups, closure.rows, chosen)
        self._chosen = chosen
        self._psi = Closure(closure.anchors, (rows,), tuple(closure.names[k] for k in chosen), ())
        places = Selected(closure.groups, closure.rows, self.extended.place[:3])
        self._place = Closure(closure.anchors, (places,), tuple(closure.names[k] for k in self.extended.place[:3]), ())
        self._split = Partition(np.zeros(0, np.intp), np.arange(mechanism.n))

    # --- forward ---------------------------------------------------------------------------------

    def forward(self, q: Mapping[str, float] | Array, start: Kinematics | None = None) -> Array:
        """Where the point is, shape (3,), metres in the world.

        Parameters
        ----------
        q : {coordinate: value}, or (d,) array in the order of `independent`
        start : Kinematics, optional
            Whose assembly branch; default: as assembled.

        Raises
        ------
        InputError
            q is out of reach.
        NumericalError
            q is singular.
        """
        return self.position(self._sigma(q, start).q_tree)

    def position(self, q_tree: Array) -> Array:
        """Where the point is at a configuration of the tree (nq,), shape (3,)."""
        return self.mechanism.point_positions(q_tree)[self.name]

    def _sigma(self, q: Mapping[str, float] | Array, start: Kinematics | None) -> Kinematics:
        mechanism = self.mechanism
        if isinstance(q, Mapping):
            q = mechanism.vector(q, mechanism.independent, "q")
        q = np.asarray(q, dtype=float)
        if q.shape != (mechanism.d,) or not np.all(np.isfinite(q)):
            raise InputError(f"q: {mechanism.d} finite numbers needed, for {', '.join(mechanism.independent)}")
        found = sigma(mechanism, q, start)
        if found.verdict == "converged":
            return found.at
        where = ", ".join(f"{name} = {x:g}" for name, x in zip(mechanism.independent, q, strict=True))
        if found.verdict == "singular":
            raise NumericalError(f"q: {where} is singular: {found.reason}")
        raise InputError(f"q: {where} is out of reach: {found.reason}")

    # --- velocities ------------------------------------------------------------------------------

    def jacobian(self, at: Kinematics) -> Array:
        """Closed-chain Jacobian: the point's velocity is this times q_dot, shape (3, d)."""
        return self._place.jacobian(self._pose(at.q_tree)) @ at.rho

    def jacobian_dot(self, at: Kinematics, q_dot: Array) -> Array:
        """Its time derivative at velocity q_dot, shape (3, d): the acceleration is J q_ddot + J_dot q_dot."""
        v, pose = at.rho @ q_dot, self._pose(at.q_tree)
        rho_dot = np.zeros_like(at.rho)
        rho_dot[at.partition.z] = -at.phi_z_factor.solve(at.J_dot(v) @ at.rho)
        return self._place.jacobian_dot(pose, Rate(pose, v)) @ at.rho + self._place.jacobian(pose) @ rho_dot

    def _pose(self, q_tree: Array) -> Pose:
        return Pose(self.mechanism.tree, self.extended.closure.anchors, q_tree)

    # --- inverse ---------------------------------------------------------------------------------

    def inverse(self, x: Sequence[float] | Array | Mapping[str, float], start: Kinematics | None = None) -> Inverse:
        """Return the configuration that puts the point somewhere, in the working mode of the start.

        Parameters
        ----------
        x : (3,) array, or a table of x, y, z of which those that are missing stay as at the start
            Metres in the world.
        start : Kinematics, optional
            A closed configuration; default: as assembled. The straight line to the place is followed from there;
            where it leaves the workspace the place is looked for from other starts.

        Raises
        ------
        InputError
            Not a place, or one that cannot be reached in this working mode, known from others by the sign of the
            determinant of Psi's Jacobian where the line does not lead there.
        """
        begin = self.kinematics((start or self.mechanism.assembled).q_tree)
        wanted = self._wanted(x, begin)
        found = self.follow(begin, wanted) or self._anywhere(begin, wanted)
        if found is None:
            place = ", ".join(f"{value:g}" for value in wanted)
            raise InputError(
                f"the point {self.name!r} of {self.mechanism.name} cannot be at ({place}) in this working mode"
                f"{self._others(wanted, begin)}"
            )
        return self._inverse(found.q_tree)

    def every_inverse(self, x: Sequence[float] | Array | Mapping[str, float]) -> list[Inverse]:
        """List the configurations that put the point somewhere, found from random starts; empty when none was."""
        begin = self.kinematics(self.mechanism.q_tree)
        return [self._inverse(q_tree) for q_tree in self._solutions(self._wanted(x, begin), begin)]

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return Psi = [phi; the given coordinates of the point] at a configuration; its z are all coordinates."""
        return Kinematics(self.mechanism.tree, self._psi, self._split, q_tree)

    def follow(self, begin: Kinematics, wanted: Array) -> Kinematics | None:
        """Follow the straight line from a Psi to a place (3,); None where it cannot be followed to its end."""
        level = self._level(wanted, begin)
        change = level - self._level(self.position(begin.q_tree), begin)

        def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
            step = at.phi_z_factor.solve(part * change)
            if not np.abs(step / at.tree.step_scale).max() <= LONGEST_STEP:
                return None
            trial = newton(at.integrate(step), level - (1.0 - done - part) * change, self.mechanism.tolerance)
            return trial.at if trial.converged else None

        at, done = follow(begin, advance, SMALLEST_PIECE)
        return at if done == 1.0 and self._met(at, wanted) else None

    def meet(self, near: Array, wanted: Array, begin: Kinematics) -> Array | None:
        """Put the point at many places of a path, all at once.

        Parameters
        ----------
        near : (count, nq) array
            Configurations near the wanted ones, in the order of the path.
        wanted : (count, 3) array
            Metres in the world.
        begin : Kinematics
            A Psi on the path.

        Returns
        -------
        (count, nq) array, or None
            None unless each is met, from nearer by than neighbours are apart, on one side of what is singular.
        """
        tree = self.mechanism.tree
        levels = self._level(wanted, begin)
        if levels.shape[1] != self.mechanism.n:
            return None
        room = np.abs(difference_many(tree, near[:-1], near[1:])).max()
        q_tree, moved, place = near.copy(), np.zeros(len(near)), np.empty((len(near), 3))
        left, side = np.arange(len(near)), np.zeros((2, len(near)))
        for _ in range(MOST_CORRECTIONS):
            rows, J_rows = evaluate_closure(tree, self.extended.closure, q_tree[left])
            phi, J = rows[:, self._chosen], J_rows[:, self._chosen]
            place[left], side[:, left] = rows[:, self.extended.place[:3]], (np.sign(np.linalg.det(J)), self.side(J))
            if not side.all() or np.any(side != side[:, :1]):
                return None
            miss = levels[left] - phi
            open_ = np.abs(miss).max(axis=1) > self.mechanism.tolerance
            left = left[open_]
            if not len(left):
                break
            step = np.asarray(np.linalg.solve(J[open_], miss[open_][..., np.newaxis])[..., 0], dtype=float)
            moved[left] += np.abs(step).max(axis=1)
            if not np.all(moved <= room):
                return None
            q_tree[left] = integrate_many(tree, q_tree[left], step)
        else:
            return None
        place += self.position(q_tree[0]) - place[0]
        return q_tree if np.abs(place - wanted).max() <= OFF * self.mechanism.size else None

    def side(self, J: Array) -> Array:
        """Return on which side of where q stops to be coordinates Psi is, by its Jacobians (..., n, n).

        The sign of det phi_z, which changes where the assembly branch does: q cannot lead across. 1 where phi_z is not
        square.
        """
        loops, z = len(self.extended.loops), self.mechanism.partition.z
        if loops != len(z):
            return np.ones(J.shape[:-2])
        return np.asarray(np.sign(np.linalg.det(J[..., :loops, :][..., z])))

    def rates(self, psi: Kinematics, x_dot: Array, x_ddot: Array) -> tuple[Array, Array]:
        """Return v' and its rate, shape (n,) each, that give the point a velocity and an acceleration (3,)."""
        given = self.extended.fixing - self.extended.place[0]
        none = np.zeros(len(self.extended.loops))
        first, second = (np.concatenate([none, np.append(x, np.zeros(3))[given]]) for x in (x_dot, x_ddot))
        v = psi.phi_z_factor.solve(first)
        return v, psi.phi_z_factor.solve(second - psi.J_dot(v) @ v)

    # --- parts -----------------------------------------------------------------------------------

    def _wanted(self, x: Sequence[float] | Array | Mapping[str, float], begin: Kinematics) -> Array:
        if isinstance(x, Mapping):
            unknown = [name for name in x if name not in ("x", "y", "z")]
            if unknown:
                raise InputError(f"x: no coordinate {unknown[0]!r} of a point; there are x, y, z")
            here = dict(zip("xyz", self.position(begin.q_tree), strict=True))
            x = [here[name] if name not in x else x[name] for name in "xyz"]
        wanted = np.asarray(x, dtype=float)
        if wanted.shape != (3,) or not np.all(np.isfinite(wanted)):
            raise InputError(f"x: three finite numbers needed (metres in the world), got {np.asarray(x).tolist()}")
        return wanted

    def _level(self, wanted: Array, begin: Kinematics) -> Array:
        """Psi's wanted values: the loops closed, each place of (..., 3) as given, the orientation as at the start."""
        loops = len(self.extended.loops)
        level = np.tile(begin.phi, (*wanted.shape[:-1], 1))
        level[..., :loops] = 0.0
        given = self.extended.fixing - self.extended.place[0]
        level[..., loops + np.flatnonzero(given < 3)] = wanted[..., given[given < 3]]
        return level

    def _met(self, at: Kinematics, wanted: Array) -> bool:
        """Whether the point is there in all of x, y, z: some of them may not be among the given ones."""
        return bool(np.abs(self.position(at.q_tree) - wanted).max() <= OFF * self.mechanism.size)

    def _solutions(self, wanted: Array, begin: Kinematics) -> list[Array]:
        task = Task(self.extended, self.extended.fixing)
        given = self._level(wanted, begin)[len(self.extended.loops) :]
        return [q for q in find_solutions(task, given, MOST) if self._met(self.kinematics(q), wanted)]

    def _anywhere(self, begin: Kinematics, wanted: Array) -> Kinematics | None:
        """Return a solution on the same side of Psi's singular configurations, the one that is nearest."""
        tree = self.mechanism.tree
        same = [self.kinematics(q) for q in self._solutions(wanted, begin)]
        same = [at for at in same if same_branch(begin, at)]
        return min(same, key=lambda at: float(np.abs(tree.difference(begin.q_tree, at.q_tree)).max()), default=None)

    def _others(self, wanted: Array, begin: Kinematics) -> str:
        count = len(self._solutions(wanted, begin))
        return f"; in {count} others it can, see every_inverse" if count else ", nor in any other that was found"

    def _inverse(self, q_tree: Array) -> Inverse:
        return Inverse(self.mechanism.kinematics(q_tree), self.mechanism.independent_part(q_tree))
