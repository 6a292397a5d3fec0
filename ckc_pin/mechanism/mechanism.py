"""The `Mechanism`: a tree, its loop closures, an assembled configuration, and a checked partition into q and z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.sources import Sources, write_files
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.base.validation import require_path
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.closure import PRESCRIBED_ROW
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.couplings import describe_coupling
from ckc_pin.mechanism.files import local_texts
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.linkage import Linkage
from ckc_pin.mechanism.motors import Motors
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.rank import (
    Freedoms,
    choose_dependent,
    choose_dependent_by_priority,
    compute_rank,
    idle_coordinates,
    scale_jacobian,
)
from ckc_pin.mechanism.spec import CouplingSpec, ForceSpec, JointSpec, LoopSpec, MotorSpec, PointSpec, SpringSpec

__all__ = ["CONSTRAINED_IN_PART", "Mechanism"]

CONSTRAINED_IN_PART = (
    "the loops constrain a free root in part, so its motion has no independent coordinates q; start it as assembled "
    '(at = "assembled"), run it as a DAE (formulation = "dae"), and without a controller'
)


Table = Mapping[str, Any]  # a table of a file, as a dict


class Mechanism(HasSummary):
    """A closed kinematic chain: everything that does not depend on the state.

    `load` reads one from files, and `Mechanism.from_urdf` makes one in Python.

    Parameters
    ----------
    linkage : Linkage
        The parts of the mechanism before assembly.
    q_tree : (nq,) array
        The assembled configuration.
    residual, tolerance : float
        Largest |phi| in this configuration, and largest |phi| that counts as closed.
    freedoms : Freedoms
        Degrees of freedom, from the rank of J.
    independent : tuple of str, optional
        The independent coordinates, if neither the mechanism file names them nor a pivoted QR shall choose them.

    Raises
    ------
    MechanismError
        Unsuitable independent coordinates, or a motor without a joint.

    Attributes
    ----------
    name : str
    n, d : int
        Number of coordinates of the tree, and of degrees of freedom.
    coordinates, independent, dependent : tuple of str
        Names of all coordinates, of q and of z.
    actuated : tuple of str
        Names of the motors, in the order of tau.
    motors : Motors
    tree, closure, frames : Tree, Closure, Frames
    joints, springs : Joints, Springs
    couplings : tuple of CouplingSpec
        Of the mechanism file, then those of the URDFs' mimic joints.
    prescribed : tuple of str
        Joints whose motion is prescribed.
    prescribed_at, prescribed_rows : int array, list of int
        Their coordinates, and their constraint rows.
    overrides : dict
        Parameter values by name that replace those of the files.
    urdf : Element
        All trees merged into one <robot>, as Pinocchio read it.
    partition : Partition
    q_tree : (nq,) array
        The assembled configuration, in Pinocchio's q.
    redundant : tuple of str
        Names of redundant constraint rows, one admissible choice, as "loop.row".
    freedoms : Freedoms
        Rank of J and degrees of freedom.
    tolerance : float
        Largest |phi| that counts as closed.
    warnings : list of str
    """

    def __init__(
        self,
        linkage: Linkage,
        q_tree: Array,
        residual: float,
        tolerance: float,
        freedoms: Freedoms,
        independent: Sequence[str] | None = None,
    ) -> None:
        self.spec, self.sources, self.name = linkage.spec, linkage.sources, linkage.spec.name
        self.urdf, self.overrides = linkage.urdf.root, linkage.overrides
        self.tree, self.closure, self.frames = linkage.tree, linkage.closure, linkage.frames
        self.joints, self.springs = linkage.joints, linkage.springs
        self.points, self.size, self.couplings = linkage.points, linkage.size, linkage.couplings
        self.coordinates, self.n = self.tree.coordinates, self.tree.n
        self.q_tree, self.residual, self.tolerance = q_tree, residual, tolerance
        self.freedoms = freedoms
        self.d, self.rank = freedoms.d, freedoms.rank.rank
        self.prescribed = linkage.prescribed
        self.prescribed_at = self.tree.indices(self.prescribed, "prescribed")
        self.prescribed_rows = [self.closure.names.index((name, PRESCRIBED_ROW)) for name in self.prescribed]
        self.redundant = tuple(".".join(name) for name in freedoms.redundant)
        self.warnings = [*linkage.warnings, *freedoms.warnings]
        self._drop_ineffective_friction()
        self._choose_independent(linkage.motors, self.spec.independent if independent is None else independent)
        self._choose_motors(linkage.motors)

    @classmethod
    def from_urdf(
        cls,
        urdf: str | Path | None = None,
        *,
        loops: Sequence[LoopSpec | Table] = (),
        couplings: Sequence[CouplingSpec | Table] = (),
        springs: Sequence[SpringSpec | Table] = (),
        forces: Sequence[ForceSpec | Table] = (),
        joints: Sequence[JointSpec | Table] = (),
        motors: Sequence[MotorSpec | Table] = (),
        points: Sequence[PointSpec | Table] = (),
        trees: Sequence[Table] = (),
        name: str | None = None,
        gravity: Sequence[float] | Array | None = None,
        independent: Sequence[str] | None = None,
        actuated: Sequence[str] | None = None,
        q_guess: Mapping[str, float] | Sequence[float] | Array | None = None,
        parameters: Mapping[str, Any] | None = None,
        meshes: str | Path | None = None,
    ) -> Mechanism:
        """Make a mechanism without files, from the text or path of a URDF and the tables of a ``mechanism.toml``.

        Parameters
        ----------
        urdf : str or Path
            The text of a URDF, which begins with ``<``, or the path of a URDF.
        loops : sequence of Loop or dict
            Loop closures: ``Loop("elbow", "point_2d", "left", "right")`` or the keys of a ``[[loop]]``.
        couplings, springs, forces, joints, motors, points : sequence of dict
            Tables with the keys of ``[[coupling]]``, ``[[spring]]`` and so on.
        trees : sequence of dict
            Instead of `urdf`, for several trees or a free root: the keys of a ``[[tree]]``, whose ``file`` is the text
            or path of a URDF.
        name : str, optional
            Default: the name of the robot in the text, or of the file.
        gravity : (3,) array, optional
            m/s^2; default (0, 0, -9.81).
        independent, actuated : sequence of str, optional
            As in the file.
        q_guess : {coordinate: value} or array, optional
            Initial guess of the assembly, rad or m. An array is in the order of `independent`, which is then needed.
        parameters : mapping, optional
            Parameter values by name that replace those of the URDF and the tables, as in `load`.
        meshes : str or Path, optional
            Folder that the URDF's mesh files are relative to; default: the folder of its path.

        Raises
        ------
        InputError
            A wrong argument, an unknown key, or malformed XML.
        MechanismError
            The mechanism cannot exist as described.

        Examples
        --------
        >>> arm = '''<robot name="pendulum"><link name="base"/>
        ...   <link name="rod"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
        ...     <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        ...   <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint>
        ... </robot>'''
        >>> Mechanism.from_urdf(arm, springs=[{"joint": "hinge", "stiffness": 2.0}]).d
        1
        """
        import ckc_pin

        keys = {
            "loops": loops, "couplings": couplings, "springs": springs, "forces": forces, "joints": joints,
            "motors": motors, "points": points, "gravity": gravity, "independent": independent, "actuated": actuated,
            "q_guess": q_guess,
        }  # fmt: skip
        return ckc_pin.kinematics.from_urdf(urdf, trees, name, meshes, parameters, keys)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the mechanism's files into a folder, which `load` and the commands read.

        Mesh files are not copied; playback takes their folder as ``meshes``.

        Parameters
        ----------
        folder : str or Path
            Created if it does not exist.
        overwrite : bool
            Whether existing files may be replaced.

        Returns
        -------
        Path
            Of the ``mechanism.toml``.

        Raises
        ------
        InputError
            A file exists already, the folder cannot be written to, or the mechanism has parameter values or prescribed
            joints, which only a scene's file can have.
        """
        require_path(folder, "Mechanism.save: folder")
        for names, key in ((self.overrides, "parameters"), (self.prescribed, "prescribed")):
            if names:
                raise InputError(
                    f"Mechanism.save: {key} ({', '.join(names)}) are keys of a scene, and a mechanism.toml has none; "
                    "save a Scene of the mechanism"
                )
        write_files(Path(folder), local_texts(self), overwrite)
        return Path(folder) / MECHANISM_FILE

    def summary(self) -> Summary:
        """Return closure, loops, coordinates, motors, assembled configuration, points and warnings."""
        tree = self.tree
        loops = [f"{loop.name} ({loop.type})" for loop in self.spec.loop]
        loops += [describe_coupling(coupling) for coupling in self.spec.coupling]
        rows: list[Row] = [
            ("closure", f"{self.closure.rows} rows of rank {self.rank}"),
            ("loops", loops or "none"),
            ("independent q", ", ".join(self.independent) or "none"),
            ("dependent z", ", ".join(self.dependent) or "none"),
            ("motors", ", ".join(self.actuated) or "none"),
            ("assembled at", format_quantities(self.coordinates, tree.to_coordinates(self.q_tree), tree.units())),
        ]
        rows += [("points", list(self.points))] if self.points else []
        rows += [("warning", warning) for warning in self.warnings]
        return Summary(f"Mechanism {self.name}: {self.n} coordinates, {self.d} freedoms", rows)

    def copy(self, sources: Sources) -> Mechanism:
        """Return an independent copy of the mechanism with other sources."""
        twin = deepcopy(self)
        twin.sources = sources
        return twin

    def with_independent(self, names: Sequence[str]) -> Mechanism:
        """Return an independent copy of the mechanism with other independent coordinates, and the same motors.

        They need not determine the configuration where the mechanism is assembled.
        """
        twin = self.copy(self.sources)
        q = self.tree.indices(tuple(names), "independent")
        z = np.setdiff1d(np.arange(self.n), q)
        twin.independent, twin.dependent = tuple(names), tuple(self.coordinates[k] for k in z)
        twin.partition = Partition(q, z)
        return twin

    # --- one configuration -----------------------------------------------------------------------

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return the constraint terms at a configuration of the tree (nq,)."""
        return Kinematics(self.tree, self.closure, self.partition, q_tree)

    @property
    def assembled(self) -> Kinematics:
        """The constraint terms at the assembled configuration."""
        return self.kinematics(self.q_tree)

    @property
    def independent_rows(self) -> list[int]:
        """Constraint rows that are not redundant."""
        return [k for k, row in enumerate(self.closure.names) if ".".join(row) not in self.redundant]

    @property
    def independent_root_coordinates(self) -> tuple[str, ...]:
        """Independent coordinates that belong to free roots."""
        return tuple(name for name in self.independent if name in self.tree.free_coordinates)

    @property
    def has_direct_drives(self) -> bool:
        """Whether each motor drives one independent joint without a gear, in order, so that tau is u of eq. 6."""
        return np.array_equal(self.motors.transmission, np.eye(self.n)[self.partition.q])

    def independent_part(self, q_tree: Array) -> Array:
        """Return the independent coordinates q of a configuration, shape (d,)."""
        return self.tree.to_coordinates(q_tree)[self.partition.q]

    def choose_partition(self, at: Kinematics, *, keep_roots_together: bool = True) -> Partition | None:
        """Return the partition with the best-conditioned phi_z at a configuration, by a pivoted QR.

        None if it would split the coordinates of a free root and these are to be kept together.
        """
        jacobian = scale_jacobian(at.J, self.tree, self.closure)
        z = choose_dependent(
            jacobian, self.rank, [np.arange(v, v + 6) for _, v in self.tree.free_roots] if keep_roots_together else []
        )
        return None if z is None else Partition(np.setdiff1d(np.arange(self.n), z), z)

    def point_positions(self, q_tree: Array) -> dict[str, Array]:
        """Return the positions of the named points in the world, metres."""
        pose = Pose(self.tree, self.closure.anchors, q_tree)
        return {
            name: pose.rotation[f.joint] @ f.translation + pose.translation[f.joint] for name, f in self.points.items()
        }

    def point_jacobians(self, q_tree: Array) -> dict[str, Array]:
        """Return the Jacobians of the positions of the named points by the tangent coordinates, shape (3, n) each."""
        frames = list(self.points.values())
        if not frames:
            return {}
        ends = Anchors(
            np.array([f.joint for f in frames], dtype=np.intp),
            np.array([f.translation for f in frames]).reshape(-1, 3),
            np.zeros(0, dtype=np.intp),
            np.zeros((0, 3)),
        )
        return dict(zip(self.points, Pose(self.tree, ends, q_tree).p_jacobian, strict=True))

    def vector(self, values: Mapping[str, float], names: Sequence[str], what: str, fill: float | None = None) -> Array:
        """Convert a table by coordinate to a vector, as `Tree.vector` does; errors name dependent coordinates."""
        if tuple(names) == self.independent:
            dependent = next((name for name in values if name in self.dependent), None)
            if dependent is not None:
                raise InputError(f"{what}: {dependent!r} follows from the loops; there are {', '.join(names)}")
        return self.tree.vector(values, names, what, fill)

    def name_values(self, values: Sequence[Any], what: str, *choices: Sequence[str]) -> dict[str, Any]:
        """Return values by name, as a table of a file has them.

        Parameters
        ----------
        values : sequence
            In the order of the names.
        what : str
            What the values are, for messages.
        *choices : sequence of str
            The names; the first of several choices with as many names as there are values.

        Raises
        ------
        InputError
            There are more or fewer values than names.
        """
        names = next((names for names in choices if len(names) == len(values)), None)
        if names is None:
            orders = " or ".join(f"{len(names)}, in the order {', '.join(names) or 'none'}" for names in choices)
            raise InputError(f"{what}: got {len(values)} values; expected {orders}, or a table by name")
        return dict(zip(names, values, strict=True))

    def refuse_prescribed_joints(self, function: str) -> None:
        """Raise InputError if joints are prescribed, for a function that does not support them."""
        if self.prescribed:
            raise InputError(
                f"{function}: prescribed joints ({', '.join(self.prescribed)}) are not supported; remove [[prescribed]]"
            )

    # --- construction ----------------------------------------------------------------------------

    def _drop_ineffective_friction(self) -> None:
        """Remove friction and stops of joints that cannot move, where they would act on rounding errors."""
        idle = self.freedoms.immobile & (self.joints.stopped | (self.joints.friction != 0.0))
        if not idle.any() or self.prescribed:  # they move with the prescribed joints
            return
        self.joints = self.joints.without(idle)
        names = ", ".join(self.coordinates[k] for k in np.flatnonzero(idle))
        self.warnings.append(f"friction and stops do nothing in joints that the loops do not let move: {names}")

    def _choose_independent(self, motors: Motors | None, preset: Sequence[str] | None) -> None:
        """Choose q and z, or check a preset choice."""
        coordinates = set(range(self.n))
        splits_roots = self.freedoms.splits_roots
        if splits_roots:
            pivoted = choose_dependent(self.freedoms.jacobian, self.rank)
            best = [self.coordinates[k] for k in sorted(coordinates - set([] if pivoted is None else pivoted.tolist()))]
        else:
            best = self._prefer(np.zeros(0, np.intp) if motors is None else motors.driven_coordinates())
        remedy = "" if splits_roots else f"; {', '.join(best) or 'none'} would do"
        if preset is not None:
            names = [name for name in preset if name not in self.prescribed]
            if self.prescribed and len(names) > self.d:  # each prescribed joint takes one freedom away
                at = self.tree.indices(tuple(names), "independent")
                names = (best if splits_roots else self._prefer(at))[: self.d]
        else:
            names = best
        at = self.tree.indices(tuple(names), "independent")
        if len(set(names)) != len(names):
            raise MechanismError(f"independent: a coordinate is named twice in {names}")
        if len(names) != self.d:
            raise MechanismError(
                f"independent: {len(names)} coordinates ({', '.join(names) or 'none'}) but the mechanism has "
                f"d = {self.d} freedoms{remedy}"
            )
        z = np.array(sorted(coordinates - set(at.tolist())), dtype=np.intp)
        if compute_rank(self.freedoms.jacobian[:, z]).rank < len(z):
            raise MechanismError(
                f"independent: {', '.join(names)} cannot parametrise the mechanism where it is assembled "
                f"(phi_z is singular there){remedy}"
            )
        self.splits_root = any(0 < sum(v_at <= k < v_at + 6 for k in at) < 6 for _, v_at in self.tree.free_roots)
        if self.splits_root and not splits_roots:
            raise MechanismError(
                f"independent: the six coordinates of a free root are all independent or all dependent{remedy}"
            )
        if self.splits_root:
            self.warnings.append(CONSTRAINED_IN_PART)
        self.independent = tuple(names)
        self.dependent = tuple(self.coordinates[k] for k in z)
        self.partition = Partition(at, z)

    def complete_independent(self, names: Sequence[str]) -> tuple[str, ...] | None:
        """Return independent coordinates that contain these; None if the loops couple them where it is assembled."""
        others = np.setdiff1d(np.arange(self.n), self.tree.indices(tuple(names), "independent"))
        jacobian = self.freedoms.jacobian[:, others]
        dependent = choose_dependent(jacobian, self.rank) if compute_rank(jacobian).rank == self.rank else None
        if dependent is None:
            return None
        return (*names, *(self.coordinates[k] for i, k in enumerate(others) if i not in dependent))

    def _prefer(self, driven: IntArray) -> list[str]:
        """Return independent coordinates: the driven ones as far as phi_z stays well conditioned, then by position.

        Of the others, coordinates that follow another one by a coupling are dependent if possible, then those
        furthest from the root, then the last.
        """
        depth, parents = [0], list(self.tree.model.parents)
        for joint in range(1, len(parents)):
            depth.append(depth[parents[joint]] + 1)
        followers = {coupling.joint for coupling in self.couplings}
        rank_of = [(name in followers, depth[self.tree.parent_joint[k]]) for k, name in enumerate(self.coordinates)]
        order = sorted(range(self.n), key=lambda k: (*rank_of[k], k))
        blocks = [np.arange(v, v + 6) for _, v in self.tree.free_roots]
        z = choose_dependent_by_priority(self.freedoms.jacobian, self.rank, order, driven.tolist(), blocks)
        assert z is not None  # since the roots need not be split
        first = [int(k) for k in driven if k not in z]
        return [self.coordinates[k] for k in [*first, *(k for k in range(self.n) if k not in {*z, *first})]]

    def _choose_motors(self, motors: Motors | None) -> None:
        """Take the file's motors, or one on each independent joint. Warn of freedoms that nothing drives or holds."""
        joints = [name for name in self.independent if name not in self.tree.free_coordinates]
        self.motors = Motors.on_joints(self.tree, joints) if motors is None else motors
        self.motors = self.motors.with_joints(self.tree, self.prescribed)
        self.actuated = self.motors.names
        anchors = [self.closure.anchors, self.springs.anchors]
        shafts = np.vstack([self.motors.transmission, np.diag(self.springs.joint_stiffness)])
        idle = idle_coordinates(self.tree, self._tangent(), self.q_tree, anchors, shafts)
        if idle:
            self.warnings.append(
                f"idle freedoms: bodies can spin about themselves without moving anything: {', '.join(idle)}"
            )

    def _tangent(self) -> Array:
        if self.freedoms.singular or not self.d:
            return np.zeros((self.n, 0))
        return self.assembled.rho
