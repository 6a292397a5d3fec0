"""Forward and inverse kinematics and Jacobians of a named point of a mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Summary, format_quantities
from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.continuation import follow, is_local, same_branch
from ckc_pin.kinematics.extended import ExtendedClosure, Task, extend_closure, find_point
from ckc_pin.kinematics.nodes import find_solutions
from ckc_pin.kinematics.sigma import newton, sigma
from ckc_pin.mechanism.batch import difference_many, evaluate_closure, integrate_many
from ckc_pin.mechanism.closure import Closure, Selected
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose, Rate

__all__ = ["Inverse", "Point"]

MIN_PIECE = 1e-6  # of the straight line to a position
MAX_SOLUTIONS = 64  # of the inverse kinematics
MAX_ITERATIONS = 8  # of Newton's method from a configuration nearby
POSITION_TOLERANCE = 1e-9  # mechanism sizes: distance from the position at which the point has reached it


@dataclass(frozen=True)
class Inverse:
    """A solution of the inverse kinematics.

    Attributes
    ----------
    at : Kinematics
        The mechanism's kinematics; `at.q_tree` is the configuration.
    q : (d,) array
        Independent coordinates.
    """

    at: Kinematics = field(repr=False)
    q: Array


class Point(HasSummary):
    """A named point of a mechanism: forward and inverse kinematics and closed-chain Jacobians.

    Parameters
    ----------
    mechanism : Mechanism
    name : str, optional
        Name of a [[point]] of the mechanism. Default: the first one.

    Raises
    ------
    InputError
        There is no such point, or its position and orientation do not determine the configuration.

    Notes
    -----
    If the position does not determine the configuration, as for a planar 3-RRR whose plate can turn about its point,
    the inverse kinematics keeps the orientation of the start.
    """

    def __init__(self, mechanism: Mechanism, name: str | None = None) -> None:
        require_type(mechanism, Mechanism, "Point: mechanism", "a Mechanism, as load returns it")
        self.mechanism = mechanism
        self.name = find_point(mechanism, name)
        self.extended: ExtendedClosure = extend_closure(mechanism, self.name)
        chosen = np.concatenate([self.extended.loops, self.extended.fixing])
        closure = self.extended.closure
        rows = Selected(closure.groups, closure.rows, chosen)
        self._chosen = chosen
        self._psi = Closure(closure.anchors, (rows,), tuple(closure.names[k] for k in chosen), ())
        places = Selected(closure.groups, closure.rows, self.extended.place[:3])
        self._place = Closure(closure.anchors, (places,), tuple(closure.names[k] for k in self.extended.place[:3]), ())
        self._split = Partition(np.zeros(0, np.intp), np.arange(mechanism.n))

    def summary(self) -> Summary:
        """Return the point's body, assembled position, and the coordinates that its inverse kinematics prescribes."""
        mechanism, frame = self.mechanism, self.mechanism.points[self.name]
        position = self.position(mechanism.q_tree)
        rows = [
            ("mechanism", f"{mechanism.name}: {mechanism.d} freedoms"),
            ("fixed to", mechanism.frames.bodies[frame.joint]),
            ("assembled at", format_quantities(["x", "y", "z"], position, ["m"] * 3)),
            ("prescribes", ", ".join(self.extended.axis(int(row)) for row in self.extended.fixing)),
        ]
        return Summary(f"Point {self.name} of {mechanism.name}", rows)

    # --- forward ---------------------------------------------------------------------------------

    def forward(self, q: Mapping[str, float] | Array, start: Kinematics | None = None) -> Array:
        """Return the position of the point, shape (3,), metres in the world.

        Parameters
        ----------
        q : {coordinate: value}, or (d,) array in the order of `independent`
        start : Kinematics, optional
            A configuration on the assembly branch. Default: as assembled.

        Raises
        ------
        InputError
            q is out of reach.
        NumericalError
            q is singular.
        """
        return self.position(self._sigma(q, start).q_tree)

    def position(self, q_tree: Array) -> Array:
        """Return the position of the point at a configuration of the tree (nq,), shape (3,), metres in the world."""
        return self.mechanism.point_positions(q_tree)[self.name]

    def _sigma(self, q: Mapping[str, float] | Array, start: Kinematics | None) -> Kinematics:
        mechanism = self.mechanism
        if isinstance(q, Mapping):
            q = mechanism.vector(q, mechanism.independent, "q")
        q = np.asarray(q, dtype=float)
        if q.shape != (mechanism.d,) or not np.all(np.isfinite(q)):
            raise InputError(f"q: expected {mechanism.d} finite numbers, of {', '.join(mechanism.independent)}")
        solution = sigma(mechanism, q, start)
        if solution.verdict == "converged":
            return solution.at
        where = ", ".join(f"{name} = {x:g}" for name, x in zip(mechanism.independent, q, strict=True))
        if solution.verdict == "singular":
            raise NumericalError(f"q: {where} is singular: {solution.reason}")
        raise InputError(f"q: {where} is out of reach: {solution.reason}")

    # --- velocities ------------------------------------------------------------------------------

    def jacobian(self, at: Kinematics) -> Array:
        """Return the closed-chain Jacobian, shape (3, d): the velocity of the point is J q_dot."""
        return self._place.jacobian(self._pose(at.q_tree)) @ at.rho

    def jacobian_dot(self, at: Kinematics, q_dot: Array) -> Array:
        """Return the time derivative of the Jacobian, shape (3, d): the acceleration is J q_ddot + J_dot q_dot."""
        v, pose = at.rho @ q_dot, self._pose(at.q_tree)
        rho_dot = np.zeros_like(at.rho)
        rho_dot[at.partition.z] = -at.phi_z_factor.solve(at.J_dot(v) @ at.rho)
        return self._place.jacobian_dot(pose, Rate(pose, v)) @ at.rho + self._place.jacobian(pose) @ rho_dot

    def _pose(self, q_tree: Array) -> Pose:
        return Pose(self.mechanism.tree, self.extended.closure.anchors, q_tree)

    # --- inverse ---------------------------------------------------------------------------------

    def inverse(self, x: Sequence[float] | Array | Mapping[str, float], start: Kinematics | None = None) -> Inverse:
        """Return the configuration in which the point has a position, in the working mode of the start.

        Parameters
        ----------
        x : (3,) array, or a table of x, y, z
            Position in metres in the world. Missing coordinates stay as at the start.
        start : Kinematics, optional
            A closed configuration. Default: as assembled. The point follows the straight line to the position from
            there. If the line leaves the workspace, a search from random starts follows.

        Raises
        ------
        InputError
            `x` is not a position, or the point cannot reach it in this working mode. Working modes differ in
            the sign of the determinant of Psi's Jacobian.
        """
        begin = self.kinematics((start or self.mechanism.assembled).q_tree)
        target = self._check_position(x, begin)
        solution = self.follow(begin, target) or self._search(begin, target)
        if solution is None:
            place = ", ".join(f"{value:g}" for value in target)
            raise InputError(
                f"the point {self.name!r} of {self.mechanism.name} cannot be at ({place}) in this working mode"
                f"{self._other_modes(target, begin)}"
            )
        return self._inverse(solution.q_tree)

    def every_inverse(self, x: Sequence[float] | Array | Mapping[str, float]) -> list[Inverse]:
        """List the configurations in which the point has a position, by a search from random starts."""
        begin = self.kinematics(self.mechanism.q_tree)
        return [self._inverse(q_tree) for q_tree in self._find_solutions(self._check_position(x, begin), begin)]

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return Psi = [phi; prescribed coordinates of the point] at a configuration, with all coordinates as z."""
        return Kinematics(self.mechanism.tree, self._psi, self._split, q_tree)

    def follow(self, begin: Kinematics, target: Array) -> Kinematics | None:
        """Follow the straight line from a configuration, as `kinematics` returns it, to a position (3,).

        Return None if the line cannot be followed to its end.
        """
        level = self._level(target, begin)
        change = level - self._level(self.position(begin.q_tree), begin)

        def advance(at: Kinematics, done: float, part: float) -> Kinematics | None:
            step = at.phi_z_factor.solve(part * change)
            if not is_local(at.tree, step):
                return None
            trial = newton(at.integrate(step), level - (1.0 - done - part) * change, self.mechanism.tolerance)
            return trial.at if trial.converged else None

        at, done = follow(begin, advance, MIN_PIECE)
        return at if done == 1.0 and self._has_reached(at, target) else None

    def invert_path(self, guess: Array, targets: Array, begin: Kinematics) -> Array | None:
        """Solve the inverse kinematics for all positions of a path at once.

        Parameters
        ----------
        guess : (count, nq) array
            Configurations near the solutions, in the order of the path.
        targets : (count, 3) array
            Positions in metres in the world.
        begin : Kinematics
            A configuration on the path, as `kinematics` returns it.

        Returns
        -------
        (count, nq) array, or None
            None unless all solutions converge, are closer to their guess than neighbouring guesses are to each other,
            and lie on the same side of all singular configurations.
        """
        tree = self.mechanism.tree
        levels = self._level(targets, begin)
        if levels.shape[1] != self.mechanism.n:
            return None
        max_distance = np.abs(difference_many(tree, guess[:-1], guess[1:])).max()
        count = len(guess)
        q_tree, distance, position = guess.copy(), np.zeros(count), np.empty((count, 3))
        active, signs = np.arange(count), np.zeros((2, count))
        for _ in range(MAX_ITERATIONS):
            rows, J_rows = evaluate_closure(tree, self.extended.closure, q_tree[active])
            phi, J = rows[:, self._chosen], J_rows[:, self._chosen]
            position[active] = rows[:, self.extended.place[:3]]
            signs[:, active] = np.sign(np.linalg.det(J)), self.branch_sign(J)
            if not signs.all() or np.any(signs != signs[:, :1]):
                return None
            miss = levels[active] - phi
            is_open = np.abs(miss).max(axis=1) > self.mechanism.tolerance
            active = active[is_open]
            if not len(active):
                break
            step = np.asarray(np.linalg.solve(J[is_open], miss[is_open][..., np.newaxis])[..., 0], dtype=float)
            distance[active] += np.abs(step).max(axis=1)
            if not np.all(distance <= max_distance):
                return None
            q_tree[active] = integrate_many(tree, q_tree[active], step)
        else:
            return None
        position += self.position(q_tree[0]) - position[0]  # a point's rows are relative to its frame as assembled
        return q_tree if np.abs(position - targets).max() <= POSITION_TOLERANCE * self.mechanism.size else None

    def branch_sign(self, J: Array) -> Array:
        """Return the sign of det phi_z, which differs between assembly branches, from Jacobians of Psi (..., n, n).

        It is 1 if phi_z is not square.
        """
        loops, z = len(self.extended.loops), self.mechanism.partition.z
        if loops != len(z):
            return np.ones(J.shape[:-2])
        return np.asarray(np.sign(np.linalg.det(J[..., :loops, :][..., z])))

    def rates(self, psi: Kinematics, x_dot: Array, x_ddot: Array) -> tuple[Array, Array]:
        """Return v' and its time derivative, shape (n,) each, for a velocity and an acceleration (3,) of the point."""
        axes = self.extended.fixing - self.extended.place[0]
        zeros = np.zeros(len(self.extended.loops))
        first, second = (np.concatenate([zeros, np.append(x, np.zeros(3))[axes]]) for x in (x_dot, x_ddot))
        v = psi.phi_z_factor.solve(first)
        return v, psi.phi_z_factor.solve(second - psi.J_dot(v) @ v)

    # --- parts -----------------------------------------------------------------------------------

    def _check_position(self, x: Sequence[float] | Array | Mapping[str, float], begin: Kinematics) -> Array:
        if isinstance(x, Mapping):
            unknown = [name for name in x if name not in ("x", "y", "z")]
            if unknown:
                raise InputError(f"x: a point has no coordinate {unknown[0]!r}; there are x, y, z")
            here = dict(zip("xyz", self.position(begin.q_tree), strict=True))
            x = [here[name] if name not in x else x[name] for name in "xyz"]
        position = np.asarray(x, dtype=float)
        if position.shape != (3,) or not np.all(np.isfinite(position)):
            raise InputError(f"x: expected three finite numbers, metres in the world, got {np.asarray(x).tolist()}")
        return position

    def _level(self, position: Array, begin: Kinematics) -> Array:
        """Return the values of Psi at positions (..., 3): closed loops, and the orientation of the start."""
        loops = len(self.extended.loops)
        level = np.tile(begin.phi, (*position.shape[:-1], 1))
        level[..., :loops] = 0.0
        axes = self.extended.fixing - self.extended.place[0]
        level[..., loops + np.flatnonzero(axes < 3)] = position[..., axes[axes < 3]]
        return level

    def _has_reached(self, at: Kinematics, target: Array) -> bool:
        """Whether the point has the position in x, y and z, some of which may not be prescribed."""
        distance = np.abs(self.position(at.q_tree) - target).max()
        return bool(distance <= POSITION_TOLERANCE * self.mechanism.size)

    def _find_solutions(self, target: Array, begin: Kinematics) -> list[Array]:
        task = Task(self.extended, self.extended.fixing)
        values = self._level(target, begin)[len(self.extended.loops) :]
        solutions = find_solutions(task, values, MAX_SOLUTIONS)
        return [q for q in solutions if self._has_reached(self.kinematics(q), target)]

    def _search(self, begin: Kinematics, target: Array) -> Kinematics | None:
        """Return the nearest solution in the working mode of `begin`."""
        tree = self.mechanism.tree
        solutions = [self.kinematics(q) for q in self._find_solutions(target, begin)]
        same = [at for at in solutions if same_branch(begin, at)]
        return min(same, key=lambda at: float(np.abs(tree.difference(begin.q_tree, at.q_tree)).max()), default=None)

    def _other_modes(self, target: Array, begin: Kinematics) -> str:
        count = len(self._find_solutions(target, begin))
        return f"; in {count} others it can, see every_inverse" if count else ", nor in another one that was found"

    def _inverse(self, q_tree: Array) -> Inverse:
        return Inverse(self.mechanism.kinematics(q_tree), self.mechanism.independent_part(q_tree))
