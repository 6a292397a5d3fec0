"""Eq. 1 along the motions that the loops allow, as an equation that is linear in parameters.

    rho^T (Y(q', v', a') p - G^T tau) = 0,

with the multipliers of the loops eliminated by J rho = 0. Y has a column for each unknown: ten for the inertia of a
link (mass, first moment, inertia about the link's origin), one for the friction or damping of a joint, the inertia of a
rotor, a stiffness, a constant force, or the offset of a motor's torque measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import partial

import numpy as np
import pinocchio as pin
from msgspec.structs import replace

from ckc_pin.base.arrays import Array
from ckc_pin.identification.measured_motion import MeasuredMotion
from ckc_pin.identification.pseudo_inertia import move
from ckc_pin.identification.unknowns import INERTIAL, Unknown, Unknowns, expand_names, moment_unknowns, typical_size
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import ParameterMap
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.units import motor_units, parameter_unit

__all__ = ["TorqueRegressor", "linear_parameters"]

_LINEAR = {("joint", "friction"), ("joint", "damping"), ("joint", "armature"), ("spring", "stiffness"),
           ("spring", "damping"), ("force", "value"), ("motor", "rotor_inertia"), ("link", "mass")}  # fmt: skip


class TorqueRegressor(Unknowns):
    """The columns of unknown parameters in eq. 1 projected by rho^T.

    Parameters
    ----------
    mechanism : Mechanism
        Its values are those of parameters that are not estimated.
    names : sequence of str
        Parameters, with wildcards: ``link.*.inertial``, ``joint.*.friction``.

    Raises
    ------
    InputError
        Unknown names, or a parameter in which the torques are not linear.

    Attributes
    ----------
    parameters : ParameterMap
    has_friction : (n,) array of bool
        Whether a joint has dry friction, given or unknown.
    """

    def __init__(self, mechanism: Mechanism, names: Sequence[str]) -> None:
        self.mechanism = mechanism
        self.parameters = ParameterMap(mechanism)
        names = expand_names(linear_parameters(mechanism, self.parameters), names)
        links = [name.split(".")[1] for name in names if name.endswith(f".{INERTIAL}")]
        super().__init__(mechanism, [unknown for name in names for unknown in self._unknowns(name)], links)
        model = mechanism.tree.model
        bodies = [inertia.toDynamicParameters() for inertia in list(model.inertias)[1:]]
        self._bodies = np.concatenate(bodies) if bodies else np.zeros(0)
        self._slopes = {key: np.zeros((len(self.unknowns), *shape)) for key, shape in self._shapes().items()}
        for i, unknown in enumerate(self.unknowns):
            for key, slope in unknown.slopes.items():
                self._slopes[key][i] = slope
        self.has_friction = (mechanism.joints.friction != 0) | np.any(self._slopes.get("friction", 0.0), axis=0)

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the slopes that some unknown has, by key."""
        return {key: slope.shape for unknown in self.unknowns for key, slope in unknown.slopes.items()}

    def rows(self, motion: MeasuredMotion) -> tuple[Array, Array]:
        """Return the columns of the unknowns (m, d, p), and the generalized forces at their start values (m, d)."""
        mechanism, tree = self.mechanism, self.mechanism.tree
        joints, springs = mechanism.joints, mechanism.springs
        count, d = len(motion.t), motion.rho.shape[2]
        inertia = tree.rotors + np.diag(tree.model.armature)
        directions = motion.directions()
        of_bodies = np.empty((count, d, len(self._bodies)))
        force = motion.a_tree @ inertia + joints.friction * directions
        with tree.lock:
            for k in range(count):
                of_tree = pin.computeJointTorqueRegressor(
                    tree.model, tree.data, motion.q_tree[k], motion.v_tree[k], motion.a_tree[k]
                )
                of_bodies[k] = motion.rho[k].T @ of_tree.reshape(tree.n, -1)  # a matrix of one row becomes a vector
        if springs.any or springs.joint_damping.any():
            for k in range(count):
                force[k] -= springs.elastic_force(motion.q_tree[k])
                force[k] -= springs.damping_force(motion.q_tree[k], motion.v_tree[k])
        columns = np.zeros((count, d, len(self.unknowns)))
        for key, slopes in self._slopes.items():
            if key == "body":
                columns += of_bodies @ slopes.reshape(len(slopes), -1).T
            else:
                columns += np.einsum("knd,knp->kdp", motion.rho, self._tree_columns(key, slopes, motion, directions))
        return columns, np.einsum("knd,kn->kd", motion.rho, force) + of_bodies @ self._bodies

    def _tree_columns(self, key: str, slopes: Array, motion: MeasuredMotion, directions: Array) -> Array:
        """Return the generalized forces on the tree (m, n, p) that the motors overcome, for one kind of number."""
        mechanism, tree = self.mechanism, self.mechanism.tree
        if key == "offset":
            return np.broadcast_to(mechanism.motors.transmission.T @ slopes.T, (len(motion.t), tree.n, len(slopes)))
        if key == "rotors":
            symmetric = slopes + np.triu(slopes, 1).swapaxes(1, 2)
            return np.einsum("pij,kj->kip", symmetric, motion.a_tree)
        if key in ("stiffness", "damping"):
            return np.array([[-force(q, v) for force in self._spring_forces(key, slopes)]
                             for q, v in zip(motion.q_tree, motion.v_tree, strict=True)]).swapaxes(1, 2)  # fmt: skip
        factors = {
            "armature": motion.a_tree, "joint_damping": motion.v_tree, "friction": directions,
            "constant": -np.ones_like(directions),
        }  # fmt: skip
        if key == "joint_stiffness":
            numbers = np.array([tree.to_coordinates(q) for q in motion.q_tree])
            factors[key] = numbers - mechanism.springs.joint_rest
        return factors[key][:, :, None] * slopes.T

    def _spring_forces(self, key: str, slopes: Array) -> list[Callable[[Array, Array], Array]]:
        """Return the forces of springs between frames by the state, of which one number each is not zero."""
        forces: list[Callable[[Array, Array], Array]] = []
        for slope in slopes:
            springs = copy(self.mechanism.springs)
            springs.joint_stiffness, springs.joint_damping, springs.constant = np.zeros((3, self.mechanism.n))
            springs.stiffness = springs.damping = np.zeros(len(springs.names))
            setattr(springs, key, slope)
            forces.append(partial(_elastic_force, springs) if key == "stiffness" else springs.damping_force)
        return forces

    def _unknowns(self, name: str) -> Iterator[Unknown]:
        root, carrier, key = name.split(".", 2)
        if key == INERTIAL:
            yield from self._moments(carrier)
            return
        if root == "motor" and key == "offset":
            at = self.mechanism.motors.names.index(carrier)
            torque = typical_size(self.mechanism, motor_units(self.mechanism)[at])
            yield Unknown(name, 0.0, torque, {"offset": np.eye(len(self.mechanism.motors.names))[at]})
            return
        slopes = dict(self.parameters.derivative(name))
        if root == "link":  # a link of unknown density
            joints = len(self.mechanism.tree.model.inertias)
            slopes = {"body": np.array([_dynamic_parameters(slopes, joint) for joint in range(1, joints)])}
        scale = typical_size(self.mechanism, parameter_unit(self.mechanism, name))
        yield Unknown(name, self.parameters.value_of(name), scale, slopes)

    def _moments(self, link: str) -> Iterator[Unknown]:
        """The ten numbers of a link, in the link's frame."""
        placed = self.mechanism.frames.find(link, "identify")
        for k, unknown in enumerate(moment_unknowns(self.mechanism, self.parameters, link)):
            slope = np.zeros((self.mechanism.tree.model.njoints - 1, 10))
            slope[placed.joint - 1] = move(np.eye(10)[k], placed.rotation, placed.translation)
            yield replace(unknown, slopes={"body": slope})


def _elastic_force(springs: Springs, q_tree: Array, v_tree: Array) -> Array:
    return springs.elastic_force(q_tree)


def _dynamic_parameters(slopes: Mapping[str, Array], joint: int) -> Array:
    """Return the derivatives of a body's ten numbers, from those of its mass, moment and inertia about its origin."""
    inertia = slopes["origin_inertia"][joint]
    return np.array([slopes["mass"][joint], *slopes["moment"][joint], inertia[0, 0], inertia[0, 1], inertia[1, 1],
                     inertia[0, 2], inertia[1, 2], inertia[2, 2]])  # fmt: skip


def linear_parameters(mechanism: Mechanism, parameters: ParameterMap) -> Iterator[str]:
    """Yield the names of all parameters in which the torques are linear."""
    for name in parameters.values:
        root, _, rest = name.partition(".")
        carrier, _, key = rest.partition(".")
        moves = root != "link" or mechanism.frames.links[carrier].joint != 0
        if root == "link" and key == "mass" and moves:
            yield f"link.{carrier}.{INERTIAL}"
        if moves and (root, key) in _LINEAR:
            yield name
    for motor in mechanism.motors.names:
        yield f"motor.{motor}.offset"
