"""The URDF tree as a Pinocchio model with named coordinates, and its kinematics in world axes.

Three properties of Pinocchio 4.1 shape this module:

- `data.oMi`, `data.J` and `data.dJ` are views of one workspace that the next algorithm overwrites. Results are
  therefore copied. Another thread could run between an algorithm and the copy, so both happen under a lock. A workspace
  for each thread would take gigabytes of memory, and Pinocchio holds the interpreter lock anyway.
- The algorithms do not report NaN. States are therefore checked where they enter the program.
- Reading `data.oMi` creates a Python object for each joint. The placements are therefore read as one strided array,
  whose layout is checked when the workspace is created.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from threading import RLock
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.validation import is_number, suggest_name
from ckc_pin.errors import InputError, MechanismError

__all__ = ["Tree"]


MAX_COORDINATES = 3000  # matrices of one state then take 70 MB each
MAX_FULL_WORKSPACE = 325  # coordinates; a full workspace takes about 65 n^3 bytes, here 2.2 GB
LARGE_COORDINATE = 100.0  # rad, or mechanism sizes: above it, rounding of a coordinate shows in the closure of loops
MAX_TOLERANCE_FACTOR = 1e4  # reached at a million radians; a closure to 1e-13 of the size is then one to 1e-9
UNLIMITED = 1e300  # joint limits of this size and above mean that there is no limit
# attributes that copies do not share
WORKSPACE = ("data", "lock", "_workspace", "_placement", "_jacobian", "_jacobian_dot")

# Algorithms that do not need a full workspace.
FAST = frozenset(
    (
        pin.nonLinearEffects,
        pin.computeGeneralizedGravity,
        pin.computeCoriolisMatrix,
        pin.computePotentialEnergy,
        pin.centerOfMass,
    )
)
_ZERO_BY_JOINT: dict[tuple[str, ...], Any] = {
    ("v", "ov", "a", "oa", "a_gf", "oa_gf"): pin.Motion.Zero(),
    ("f", "of", "h", "oh"): pin.Force.Zero(),
    ("oMi", "liMi"): pin.SE3.Identity(),
    ("Ycrb", "oYcrb"): pin.Inertia.Zero(),
    ("B", "vxI", "Ivx"): np.zeros((6, 6)),
    ("com", "vcom", "acom"): np.zeros(3),
    ("mass",): -1.0,
}

_ROOT_AXES = ("x", "y", "z", "rx", "ry", "rz")


class Tree:
    """A Pinocchio model with named coordinates and a workspace.

    Parameters
    ----------
    model : pinocchio.Model
        Its joints have one degree of freedom, or are free-flyers.
    size : float
        Characteristic length of the mechanism, metres.

    Attributes
    ----------
    coordinates : tuple of str
        Names of the tangent coordinates in Pinocchio's order: the joint's name, or ``root.x`` to ``root.rz`` for a
        free root.
    n, nq : int
        Number of tangent coordinates, and of entries of Pinocchio's q.
    is_euclidean : bool
        There is no free root, so that q is a vector of n numbers.
    index : dict of str to int
        Place of each name in `coordinates`.
    q_index : (n,) int array
        Place in q of each coordinate of a one-freedom joint. For a free root: of its position, then unspecified.
    free_roots : list of (int, int)
        Place in q and in v' of each free root.
    free_coordinates : set of str
        Names of the coordinates of free roots.
    is_angle : (n,) bool array
        Angles of joints with one freedom.
    in_metres : (n,) bool array
        Whether each coordinate is a length; the others are angles.
    step_scale : (n,) array
        Unit in which steps of each coordinate are compared: one radian, or `size`.
    support : (joints, 1, n) array
        1 where a coordinate moves a joint, otherwise 0.
    parent_joint : (n,) int array
        Joint that carries the joint of each coordinate.
    rotors : (n, n) array
        What rotors of motors on several joints add to D'.

    Raises
    ------
    MechanismError
        More than `MAX_COORDINATES` coordinates.
    """

    def __init__(self, model: Any, size: float = 1.0) -> None:
        if model.nv > MAX_COORDINATES:
            raise MechanismError(f"the tree has {model.nv} coordinates; at most {MAX_COORDINATES} are supported")
        self._attach(model)
        self.n: int = model.nv
        self.nq: int = model.nq
        self.is_euclidean = self.n == self.nq
        self.coordinates = tuple(_labels(model))
        self.index = {label: k for k, label in enumerate(self.coordinates)}
        self.q_index = np.array(_q_indices(model), dtype=np.intp)
        self.free_roots = [(j.idx_q, j.idx_v) for j in list(model.joints)[1:] if j.nq == 7]
        self.free_coordinates = {self.coordinates[v + k] for _, v in self.free_roots for k in range(6)}
        self.in_metres = np.array([_in_metres(model, label) for label in self.coordinates], dtype=bool)
        self.size = size
        self.is_angle = ~self.in_metres & [name not in self.free_coordinates for name in self.coordinates]
        self.step_scale = np.where(self.in_metres, size, 1.0)
        self._q_scale = np.ones(self.nq)
        self._q_scale[self.q_index] = self.step_scale
        self.rotors = np.zeros((self.n, self.n))
        self.support = np.zeros((model.njoints, 1, self.n))
        parents = list(model.parents)
        self.parent_joint = np.zeros(self.n, dtype=np.intp)
        for k, joint in list(enumerate(model.joints))[1:]:
            self.support[k] = self.support[parents[k]]
            self.support[k, 0, joint.idx_v : joint.idx_v + joint.nv] = 1.0
            self.parent_joint[joint.idx_v : joint.idx_v + joint.nv] = parents[k]

    def tolerance_factor(self, q_tree: Array) -> float:
        """Return the factor by which rounding of large coordinates increases the closure tolerance.

        Coordinates are rounded relative to their size: a crank after many turns, a mechanism far from the origin. The
        factor is 1 up to `LARGE_COORDINATE`, and at most `MAX_TOLERANCE_FACTOR`.
        """
        largest = float(np.abs(q_tree / self._q_scale).max(initial=0.0))
        return min(max(1.0, largest / LARGE_COORDINATE), MAX_TOLERANCE_FACTOR)

    def step_size(self, step: Array) -> Any:
        """Return the largest entry of each tangent step (..., n), in radians or in units of the mechanism's size."""
        return np.abs(step / self.step_scale).max(axis=-1, initial=0.0)

    def _attach(self, model: Any) -> None:
        self.model = model
        self.lock = RLock()  # held until a result has been copied from the workspace

    @cached_property
    def data(self) -> Any:
        """A full workspace for any algorithm of Pinocchio, created at first use.

        Raises
        ------
        MechanismError
            The tree has so many coordinates that the workspace, of about 65 n^3 bytes, would fill the memory.
        """
        if self.n > MAX_FULL_WORKSPACE:
            raise MechanismError(
                f"the tree has {self.n} coordinates; this analysis needs a workspace of Pinocchio, which takes too much"
                f" memory for more than {MAX_FULL_WORKSPACE}"
            )
        return self.model.createData()

    @cached_property
    def _workspace(self) -> Any:
        return _create_workspace(self.model)

    @cached_property
    def _placement(self) -> Array:
        return _strided_placements(self._workspace)

    # Pinocchio returns a matrix of one column as a vector, hence the reshape.
    @cached_property
    def _jacobian(self) -> Array:
        return self._workspace.J.reshape(6, self.n)

    @cached_property
    def _jacobian_dot(self) -> Array:
        return self._workspace.dJ.reshape(6, self.n)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tree:
        """Copy the model, with a new workspace. Names and indices are shared."""
        twin = memo[id(self)] = Tree.__new__(Tree)
        twin.__dict__.update(self.__getstate__())
        twin._attach(self.model.copy())
        return twin

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the workspace: its views would be restored as arrays that Pinocchio does not update."""
        return {name: value for name, value in self.__dict__.items() if name not in WORKSPACE}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._attach(self.model)

    def evaluate(self, algorithm: Callable[..., Any], *state: Array) -> Array:
        """Call an algorithm of Pinocchio, (model, data, *state), and return a copy of its result."""
        with self.lock:
            return np.array(algorithm(self.model, self._workspace if algorithm in FAST else self.data, *state))

    def mass_matrix(self, q_tree: Array) -> Array:
        """Return D' with all rotors, shape (n, n)."""
        with self.lock:
            return np.asarray(pin.crba(self.model, self._workspace, q_tree, pin.Convention.WORLD)) + self.rotors

    def kinematics(self, q_tree: Array) -> tuple[Array, Array]:
        """Placements (joints, 12; rotation by columns, then translation) and world Jacobian (6, n)."""
        with self.lock:
            pin.computeJointJacobians(self.model, self._workspace, q_tree)
            return self._placement.copy(), self._jacobian.copy()

    def many_kinematics(self, q_tree: Array) -> tuple[Array, Array]:
        """Return `kinematics` of (count, nq) configurations, shapes (count, joints, 12) and (count, 6, n)."""
        with self.lock:
            placement, jacobian = np.empty((len(q_tree), *self._placement.shape)), np.empty((len(q_tree), 6, self.n))
            for k, q in enumerate(q_tree):
                pin.computeJointJacobians(self.model, self._workspace, q)
                placement[k], jacobian[k] = self._placement, self._jacobian
        return placement, jacobian

    def jacobian_dot(self, q_tree: Array, v_tree: Array) -> Array:
        """Return the time derivative of the world Jacobian along v', shape (6, n)."""
        with self.lock:
            pin.computeJointJacobiansTimeVariation(self.model, self._workspace, q_tree, v_tree)
            return self._jacobian_dot.copy()

    def limits(self) -> tuple[Array, Array]:
        """Return lower and upper joint limits, shape (n,) each, infinite if there is no limit."""
        lower, upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        for k, label in enumerate(self.coordinates):
            if label not in self.free_coordinates:
                low, high = (
                    self.model.lowerPositionLimit[self.q_index[k]],
                    self.model.upperPositionLimit[self.q_index[k]],
                )
                lower[k] = low if low > -UNLIMITED else -np.inf
                upper[k] = high if high < UNLIMITED else np.inf
        return lower, upper

    def body_motions(self, q_tree: Array, tangent: Array) -> Array:
        """Return the spatial velocities of all bodies for columns of v' (n, d), in world axes at the world's origin.

        Shape (joints, 6, d), linear velocities first.
        """
        _, jacobian = self.kinematics(q_tree)
        motions = np.zeros((self.model.njoints, 6, tangent.shape[1]))
        for joint, parent in list(enumerate(self.model.parents))[1:]:
            columns = slice(self.model.idx_vs[joint], self.model.idx_vs[joint] + self.model.nvs[joint])
            motions[joint] = motions[parent] + jacobian[:, columns] @ tangent[columns]
        return motions

    def centre_of_mass_motions(self, q_tree: Array, tangent: Array) -> Array:
        """Return the velocities of the centres of mass of all moving bodies with mass, shape (3 bodies, d)."""
        placement, _ = self.kinematics(q_tree)
        motions = self.body_motions(q_tree, tangent)
        joints = [k for k in range(1, self.model.njoints) if self.model.inertias[k].mass > 0]
        lever = np.array([self.model.inertias[k].lever for k in joints]).reshape(-1, 3, 1)
        rotation = placement[joints, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
        centre = rotation @ lever + placement[joints, 9:, None]
        velocities = motions[joints, :3] + np.cross(motions[joints, 3:], centre, axis=1)
        return velocities.reshape(3 * len(joints), tangent.shape[1])

    def integrate(self, q_tree: Array, step: Array) -> Array:
        """Return the configuration that a tangent step leads to."""
        return q_tree + step if self.is_euclidean else np.asarray(pin.integrate(self.model, q_tree, step))

    def difference(self, start: Array, end: Array) -> Array:
        """Return the tangent step from one configuration to another."""
        return end - start if self.is_euclidean else np.asarray(pin.difference(self.model, start, end))

    def configuration_rate(self, q_tree: Array, v_tree: Array) -> Array:
        """Return the time derivative of Pinocchio's q at a tangent velocity v', shape (nq,)."""
        if self.is_euclidean:
            return v_tree
        rate = np.empty(self.nq)
        rate[self.q_index] = v_tree
        for q_at, v_at in self.free_roots:
            x, y, z, w = q_tree[q_at + 3 : q_at + 7]
            p, q, r = v_tree[v_at + 3 : v_at + 6]  # angular velocity in body axes
            rotation = pin.Quaternion(np.array([x, y, z, w])).matrix()
            rate[q_at : q_at + 3] = rotation @ v_tree[v_at : v_at + 3]
            rate[q_at + 3 : q_at + 7] = 0.5 * np.array(
                [w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p, -x * p - y * q - z * r]
            )
        return rate

    def axis(self, joint: int) -> tuple[Array, bool]:
        """Return the axis of a one-freedom joint in its body, shape (3,), and whether the joint is revolute."""
        model = self.model.joints[joint]
        data = model.createData()
        model.calc(data, self.neutral())
        motion = np.asarray(data.S).reshape(6)
        is_revolute = not motion[:3].any()
        return (motion[3:] if is_revolute else motion[:3]), is_revolute

    def neutral(self) -> Array:
        """Return the configuration in which all coordinates are zero, shape (nq,)."""
        return np.asarray(pin.neutral(self.model))

    def to_coordinates(self, q_tree: Array) -> Array:
        """Convert q to the n numbers of files and JSON. A free root has its position and rotation vector."""
        if self.is_euclidean:
            return np.array(q_tree)
        numbers = np.array(q_tree[self.q_index])
        for q_at, v_at in self.free_roots:
            rotation = pin.Quaternion(np.ascontiguousarray(q_tree[q_at + 3 : q_at + 7])).normalized()
            numbers[v_at : v_at + 3] = q_tree[q_at : q_at + 3]
            numbers[v_at + 3 : v_at + 6] = pin.log3(rotation.matrix())
        return numbers

    def from_coordinates(self, numbers: Array) -> Array:
        """Convert the n numbers of files and JSON to q, the inverse of `to_coordinates`."""
        if self.is_euclidean:
            return np.array(numbers, dtype=float)
        q_tree = self.neutral()
        q_tree[self.q_index] = numbers
        for q_at, v_at in self.free_roots:
            q_tree[q_at : q_at + 3] = numbers[v_at : v_at + 3]
            q_tree[q_at + 3 : q_at + 7] = pin.Quaternion(pin.exp3(numbers[v_at + 3 : v_at + 6])).coeffs()
        return q_tree

    def named(self, vector: Array) -> dict[str, float]:
        """Return a vector (n,) as a table by coordinate."""
        return {label: float(x) for label, x in zip(self.coordinates, vector, strict=True)}

    def indices(self, names: tuple[str, ...], what: str) -> IntArray:
        """Return the places of coordinates in `coordinates` (InputError lists the valid names)."""
        for name in names:
            if name not in self.index:
                nearest = suggest_name(name, self.coordinates)
                raise InputError(f"{what}: no coordinate {name!r}; there are {', '.join(self.coordinates)}{nearest}")
        return np.array([self.index[name] for name in names], dtype=np.intp)

    def vector(self, values: Mapping[str, float], names: Sequence[str], what: str, fill: float | None = None) -> Array:
        """Convert a table by coordinate to a vector in the order of `names`.

        Raises
        ------
        InputError
            An unknown name, a missing one (unless `fill` is given), or a value that is not a finite number.
        """
        unknown = next((name for name in values if name not in names), None)
        if unknown is not None:
            nearest = suggest_name(unknown, names)
            raise InputError(f"{what}: no coordinate {unknown!r} here; there are {', '.join(names)}{nearest}")
        missing = [name for name in names if name not in values]
        if missing and fill is None:
            raise InputError(f"{what}: {', '.join(missing)} missing; expected {', '.join(names)}")
        invalid = next((name for name in names if not is_number(values.get(name, 0.0))), None)
        if invalid is not None:
            raise InputError(f"{what}: {invalid} = {values[invalid]!r:.80}: expected a number")
        vector = np.array([float(values.get(name, fill if fill is not None else np.nan)) for name in names])
        if not np.all(np.isfinite(vector)):
            name = names[int(np.flatnonzero(~np.isfinite(vector))[0])]
            raise InputError(f"{what}: {name} = {values[name]} is not a finite number")
        return vector

    def units(self, per: str = "") -> list[str]:
        """Return the unit of each coordinate, "rad" or "m", followed by `per`, such as "/s" for its rate."""
        return [f"{'m' if length else 'rad'}{per}" for length in self.in_metres]

    def joint_index(self, joint: str, where: str) -> int:
        """Return the place in `coordinates` of a joint with one freedom (MechanismError lists these joints)."""
        if joint not in self.index or joint in self.free_coordinates:
            single = ", ".join(c for c in self.coordinates if c not in self.free_coordinates)
            raise MechanismError(f"{where}: no joint of one freedom called {joint!r}; there are {single}")
        return self.index[joint]


def _in_metres(model: Any, label: str) -> bool:
    """Whether a coordinate is a length: of a prismatic joint, or the position of a free root."""
    joint, _, axis = label.rpartition(".")
    if model.existJointName(label):
        return model.joints[model.getJointId(label)].shortname().startswith("JointModelP")
    return bool(joint) and axis in ("x", "y", "z")


def _labels(model: Any) -> list[str]:
    labels: list[str] = []
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        labels += [name] if joint.nv == 1 else [f"{name}.{axis}" for axis in _ROOT_AXES]
    return labels


def _q_indices(model: Any) -> list[int]:
    indices: list[int] = []
    for joint in list(model.joints)[1:]:
        indices += [joint.idx_q] if joint.nv == 1 else [joint.idx_q + k for k in (0, 1, 2, 3, 4, 5)]
    return indices


def _create_workspace(model: Any) -> Any:
    """Return a workspace for `mass_matrix`, `kinematics`, `jacobian_dot` and the algorithms of `FAST`.

    Pinocchio's own has tensors of 40 n^3 bytes for second derivatives, which nothing here computes.
    """
    n, joints, data = model.nv, model.njoints, pin.Data()
    for joint in model.joints:
        data.joints.append(joint.createData())
    for names, start in _ZERO_BY_JOINT.items():
        for name in names:
            getattr(data, name).extend([start] * joints)
    for name in ("J", "dJ", "Ag", "dAg", "dAdq", "dFda", "dFdq", "dFdv"):
        setattr(data, name, np.zeros((6, n)))
    for name in ("tau", "nle", "g"):
        setattr(data, name, np.zeros(n))
    for name in ("M", "C"):
        setattr(data, name, np.zeros((n, n)))
    data.Fcrb.append(np.zeros((6, n)))  # the only one that is used
    data.a_gf[0] = -model.gravity
    parents, first, size = list(model.parents), list(model.idx_vs), list(model.nvs)
    above, below = [-1] * n, [0] * joints  # by coordinate: the one above it; by joint: the number at and below it
    for joint in range(joints - 1, 0, -1):
        parent = parents[joint]
        below[joint] += size[joint]
        below[parent] += below[joint]
        above[first[joint] : first[joint] + size[joint]] = range(first[joint] - 1, first[joint] + size[joint] - 1)
        above[first[joint]] = first[parent] + size[parent] - 1 if parent else -1
    data.nvSubtree.extend(below)
    data.parents_fromRow.extend(above)
    return data


def _strided_placements(data: Any) -> Array:
    """Return a view of data.oMi of shape (joints, 12): the rotation by columns, then the translation.

    Pinocchio stores its placements in one contiguous vector, which is checked here.
    """
    rotations = [placement.rotation for placement in data.oMi]
    starts = np.array([r.__array_interface__["data"][0] for r in rotations])
    ends = np.array([m.translation.__array_interface__["data"][0] for m in data.oMi])
    if np.any(np.diff(starts) != 96) or np.any(ends - starts != 72):
        raise RuntimeError("this version of Pinocchio stores joint placements in another layout; install pin 4.1")
    first = rotations[0].T.reshape(-1)  # the rotation is stored by columns, so the transpose shares its memory
    return np.lib.stride_tricks.as_strided(first, shape=(len(rotations), 12), strides=(96, 8))
