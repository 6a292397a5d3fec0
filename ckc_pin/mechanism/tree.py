"""The tree: a Pinocchio model with names for its coordinates, and what its joints do in world axes.

What bites in Pinocchio 4.1 and is dealt with here: `data.oMi`, `data.J` and `data.dJ` are live views
of one workspace, so what is kept is copied; NaN passes through every algorithm in silence, so
states are checked where they enter. The placements of all joints are read as one strided array instead
of one Python object a joint; the stride is verified when the tree is made. Between an algorithm and the copy of
its result another thread may have its turn, so the two happen under a lock; Pinocchio holds the interpreter
anyway, and a workspace for each thread would take memory by the gigabyte.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from threading import RLock
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.validation import is_number
from ckc_pin.errors import InputError, MechanismError

__all__ = ["Tree"]


MOST = 325  # coordinates; Pinocchio's workspace takes about 65 n^3 bytes whatever it is used for, 2.2 GB here

MANY = 100.0  # rad, or the mechanism's size: where rounding of a coordinate begins to be seen in how loops close
COARSEST = 1e4  # with loops closed to 1e-13 of the mechanism's size, 1e-9 of it: at a million radians
WORKSPACE = ("data", "lock", "_placement", "_jacobian", "_jacobian_dot")  # what belongs to a tree's own data

_ROOT_AXES = ("x", "y", "z", "rx", "ry", "rz")


class Tree:
    """A Pinocchio model, one workspace for it, and the labels of its tangent coordinates.

    Parameters
    ----------
    model : pinocchio.Model
        Joints of one freedom, and free-flyers.

    Attributes
    ----------
    coordinates : tuple of str
        A label for each tangent coordinate, Pinocchio's order: the joint's name, or six of them
        ``root.x ... root.rz`` for a free root.
    n : int
        Number of tangent coordinates.

    Raises
    ------
    MechanismError
        More coordinates than a workspace is made for.
    """

    def __init__(self, model: Any) -> None:
        if model.nv > MOST:
            raise MechanismError(f"{model.nv} coordinates in the tree; at most {MOST} are taken")
        self._work_on(model)
        self.n: int = model.nv
        self.nq: int = model.nq
        self.is_euclidean = self.n == self.nq
        self.coordinates = tuple(_labels(model))
        self.index = {label: k for k, label in enumerate(self.coordinates)}
        # where the coordinate of a one-freedom joint stands in q (a free root's: its position, then nothing)
        self.q_index = np.array(_places(model), dtype=np.intp)
        self.free_roots = [(j.idx_q, j.idx_v) for j in list(model.joints)[1:] if j.nq == 7]
        self.free_coordinates = {self.coordinates[v + k] for _, v in self.free_roots for k in range(6)}
        self.in_metres = np.array([_in_metres(model, label) for label in self.coordinates], dtype=bool)
        self.measure(1.0)
        # support[joint, 0, k] is 1 where coordinate k moves the joint
        self.support = np.zeros((model.njoints, 1, self.n))
        parents = list(model.parents)
        self.parent_joint = np.zeros(self.n, dtype=np.intp)  # by coordinate: the joint whose body its own is fixed to
        for k, joint in list(enumerate(model.joints))[1:]:
            self.support[k] = self.support[parents[k]]
            self.support[k, 0, joint.idx_v : joint.idx_v + joint.nv] = 1.0
            self.parent_joint[joint.idx_v : joint.idx_v + joint.nv] = parents[k]

    def measure(self, size: float) -> None:
        """Take the mechanism's size, m; steps are measured in `reach`, shape (n,): one radian, or that size."""
        self.size = size
        self.step_scale = np.where(self.in_metres, size, 1.0)
        self._units = np.ones(self.nq)
        self._units[self.q_index] = self.step_scale

    def tolerance_factor(self, q_tree: Array) -> float:
        """Return how much coarser loops close there than near zero, at least 1.

        Coordinates are rounded as they are large: a crank's after many turns, all of what is far from the origin. What
        is beyond `COARSEST` does not count as closed.
        """
        return min(max(1.0, float(np.abs(q_tree / self._units).max(initial=0.0)) / MANY), COARSEST)

    def _work_on(self, model: Any) -> None:
        self.model = model
        self.lock = RLock()  # held while something is in the workspace

    @cached_property
    def data(self) -> Any:
        """Pinocchio's workspace, made where it is first needed: it has some n^3 numbers."""
        return self.model.createData()

    @cached_property
    def _placement(self) -> Array:
        return _strided_placements(self.data)

    # a matrix of one column would come as a vector
    @cached_property
    def _jacobian(self) -> Array:
        return self.data.J.reshape(6, self.n)

    @cached_property
    def _jacobian_dot(self) -> Array:
        return self.data.dJ.reshape(6, self.n)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tree:
        """Copy the model, and give the copy a workspace of its own; labels and places stay as they are."""
        twin = memo[id(self)] = Tree.__new__(Tree)
        twin.__dict__.update(self.__getstate__())
        twin._work_on(self.model.copy())
        return twin

    def __getstate__(self) -> dict[str, Any]:
        """Leave the workspace behind, whose views would come back as arrays that nothing writes to."""
        return {name: value for name, value in self.__dict__.items() if name not in WORKSPACE}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._work_on(self.model)

    def evaluate(self, algorithm: Callable[..., Any], *state: Array) -> Array:
        """Return a copy of what an algorithm of Pinocchio, (model, data, *state), leaves in the workspace."""
        with self.lock:
            return np.array(algorithm(self.model, self.data, *state))

    def kinematics(self, q_tree: Array) -> tuple[Array, Array]:
        """Placements (joints, 12; rotation by columns, then translation) and world Jacobian (6, n)."""
        with self.lock:
            pin.computeJointJacobians(self.model, self.data, q_tree)
            return self._placement.copy(), self._jacobian.copy()

    def many_kinematics(self, q_tree: Array) -> tuple[Array, Array]:
        """Return what `kinematics` does for each of (count, nq) configurations: (count, joints, 12), (count, 6, n)."""
        with self.lock:
            placement, jacobian = np.empty((len(q_tree), *self._placement.shape)), np.empty((len(q_tree), 6, self.n))
            for k, q in enumerate(q_tree):
                pin.computeJointJacobians(self.model, self.data, q)
                placement[k], jacobian[k] = self._placement, self._jacobian
        return placement, jacobian

    def jacobian_dot(self, q_tree: Array, v_tree: Array) -> Array:
        """Return d/dt of the world Jacobian (6, n) along v_tree."""
        with self.lock:
            pin.computeJointJacobiansTimeVariation(self.model, self.data, q_tree, v_tree)
            return self._jacobian_dot.copy()

    def limits(self) -> tuple[Array, Array]:
        """Lower and upper limits by coordinate, infinite where there is none, shape (n,) each."""
        lower, upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        for k, label in enumerate(self.coordinates):
            if label not in self.free_coordinates:
                low, high = (
                    self.model.lowerPositionLimit[self.q_index[k]],
                    self.model.upperPositionLimit[self.q_index[k]],
                )
                lower[k] = low if low > -1e300 else -np.inf
                upper[k] = high if high < 1e300 else np.inf
        return lower, upper

    def centre_of_mass_jacobians(self, q_tree: Array) -> Array:
        """Jacobians of the centres of mass of all moving bodies that have mass, stacked: (3 bodies, n)."""
        placement, jacobian = self.kinematics(q_tree)
        rows = [np.zeros((0, self.n))]
        for joint in range(1, self.model.njoints):
            inertia = self.model.inertias[joint]
            if inertia.mass > 0:
                lever = placement[joint, :9].reshape(3, 3).T @ inertia.lever + placement[joint, 9:]
                angular = jacobian[3:] * self.support[joint, 0]
                rows.append(jacobian[:3] * self.support[joint, 0] + np.cross(angular.T, lever).T)
        return np.vstack(rows)

    def integrate(self, q_tree: Array, step: Array) -> Array:
        """Move a configuration by a tangent step."""
        return q_tree + step if self.is_euclidean else np.asarray(pin.integrate(self.model, q_tree, step))

    def difference(self, start: Array, end: Array) -> Array:
        """Return the tangent step from one configuration to another."""
        return end - start if self.is_euclidean else np.asarray(pin.difference(self.model, start, end))

    def configuration_rate(self, q_tree: Array, v_tree: Array) -> Array:
        """Time derivative of Pinocchio's q at a tangent velocity, shape (nq,)."""
        if self.is_euclidean:
            return v_tree
        rate = np.empty(self.nq)
        rate[self.q_index] = v_tree
        for q_at, v_at in self.free_roots:
            x, y, z, w = q_tree[q_at + 3 : q_at + 7]
            p, q, r = v_tree[v_at + 3 : v_at + 6]  # angular velocity in the body's axes
            rotation = pin.Quaternion(np.array([x, y, z, w])).matrix()
            rate[q_at : q_at + 3] = rotation @ v_tree[v_at : v_at + 3]
            rate[q_at + 3 : q_at + 7] = 0.5 * np.array(
                [w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p, -x * p - y * q - z * r]
            )
        return rate

    def bracket(self, v_tree: Array) -> Array:
        """Return the (n, n) matrix that makes [v', x] of x; zero but for free roots, whose motions do not commute.

        A tangent step x beside a motion v' changes at its own rate less [v', x].
        """
        matrix = np.zeros((self.n, self.n))
        for _, at in self.free_roots:
            matrix[at : at + 6, at : at + 6] = pin.Motion(v_tree[at : at + 6]).action
        return matrix

    def axis(self, joint: int) -> tuple[Array, bool]:
        """Return the axis of a one-freedom joint in its body, shape (3,), and whether it turns; else it slides."""
        model = self.model.joints[joint]
        data = model.createData()
        model.calc(data, self.neutral())
        along = np.asarray(data.S).reshape(6)
        turns = not along[:3].any()
        return (along[3:] if turns else along[:3]), turns

    def neutral(self) -> Array:
        """Return the configuration with all coordinates zero."""
        return np.asarray(pin.neutral(self.model))

    def to_coordinates(self, q_tree: Array) -> Array:
        """Return the n numbers that files and JSON carry (a free root: position, rotation vector)."""
        if self.is_euclidean:
            return np.array(q_tree)
        numbers = np.array(q_tree[self.q_index])
        for q_at, v_at in self.free_roots:
            rotation = pin.Quaternion(np.ascontiguousarray(q_tree[q_at + 3 : q_at + 7])).normalized()
            numbers[v_at : v_at + 3] = q_tree[q_at : q_at + 3]
            numbers[v_at + 3 : v_at + 6] = pin.log3(rotation.matrix())
        return numbers

    def from_coordinates(self, numbers: Array) -> Array:
        """Inverse of `to_coordinates`."""
        if self.is_euclidean:
            return np.array(numbers, dtype=float)
        q_tree = self.neutral()
        q_tree[self.q_index] = numbers
        for q_at, v_at in self.free_roots:
            q_tree[q_at : q_at + 3] = numbers[v_at : v_at + 3]
            q_tree[q_at + 3 : q_at + 7] = pin.Quaternion(pin.exp3(numbers[v_at + 3 : v_at + 6])).coeffs()
        return q_tree

    def named(self, vector: Array) -> dict[str, float]:
        """Return a tangent vector keyed by coordinate."""
        return {label: float(x) for label, x in zip(self.coordinates, vector, strict=True)}

    def indices(self, names: tuple[str, ...], what: str) -> IntArray:
        """Return where coordinates stand; InputError names the valid ones."""
        for name in names:
            if name not in self.index:
                raise InputError(f"{what}: no coordinate {name!r}; there are {', '.join(self.coordinates)}")
        return np.array([self.index[name] for name in names], dtype=np.intp)

    def vector(self, values: Mapping[str, float], names: Sequence[str], what: str, fill: float | None = None) -> Array:
        """Turn a table by coordinate into a vector.

        Raises
        ------
        InputError
            An unknown name, a missing one (unless `fill` is given), a value that is not finite.
        """
        unknown = next((name for name in values if name not in names), None)
        if unknown is not None:
            raise InputError(f"{what}: no coordinate {unknown!r} here; there are {', '.join(names)}")
        missing = [name for name in names if name not in values]
        if missing and fill is None:
            raise InputError(f"{what}: {', '.join(missing)} missing; expected {', '.join(names)}")
        strange = next((name for name in names if not is_number(values.get(name, 0.0))), None)
        if strange is not None:
            raise InputError(f"{what}: {strange} = {values[strange]!r:.80}: expected a number")
        vector = np.array([float(values.get(name, fill if fill is not None else np.nan)) for name in names])
        if not np.all(np.isfinite(vector)):
            bad = names[int(np.flatnonzero(~np.isfinite(vector))[0])]
            raise InputError(f"{what}: {bad} = {values[bad]} is not a finite number")
        return vector

    def units(self, per: str = "") -> list[str]:
        """Return the unit of each coordinate, rad or m, ``per="/s"`` of its rate."""
        return [f"{'m' if length else 'rad'}{per}" for length in self.in_metres]

    def joint_index(self, joint: str, where: str) -> int:
        """Return where a joint of one freedom stands; MechanismError names those there are."""
        if joint not in self.index or joint in self.free_coordinates:
            single = ", ".join(c for c in self.coordinates if c not in self.free_coordinates)
            raise MechanismError(f"{where}: no joint of one freedom called {joint!r}; there are {single}")
        return self.index[joint]


def _in_metres(model: Any, label: str) -> bool:
    """Whether a coordinate is a length: a prismatic joint, or a free root's position."""
    joint, _, axis = label.rpartition(".")
    if model.existJointName(label):
        return model.joints[model.getJointId(label)].shortname().startswith("JointModelP")
    return bool(joint) and axis in ("x", "y", "z")


def _labels(model: Any) -> list[str]:
    labels: list[str] = []
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        labels += [name] if joint.nv == 1 else [f"{name}.{axis}" for axis in _ROOT_AXES]
    return labels


def _places(model: Any) -> list[int]:
    places: list[int] = []
    for joint in list(model.joints)[1:]:
        places += [joint.idx_q] if joint.nv == 1 else [joint.idx_q + k for k in (0, 1, 2, 3, 4, 5)]
    return places


def _strided_placements(data: Any) -> Array:
    """View data.oMi as (joints, 12): rotation by columns, then translation.

    Valid because Pinocchio keeps its placements in one contiguous vector; checked, not assumed.
    """
    rotations = [placement.rotation for placement in data.oMi]
    starts = np.array([r.__array_interface__["data"][0] for r in rotations])
    ends = np.array([m.translation.__array_interface__["data"][0] for m in data.oMi])
    if np.any(np.diff(starts) != 96) or np.any(ends - starts != 72):
        raise RuntimeError("this Pinocchio lays its placements out differently; ckc_pin needs pin 4.1")
    first = rotations[0].T.reshape(-1)  # stored by columns: the transpose shares the memory
    return np.lib.stride_tricks.as_strided(first, shape=(len(rotations), 12), strides=(96, 8))
