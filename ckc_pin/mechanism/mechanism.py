"""The `Mechanism`: a tree, its closure, an assembled configuration, and a checked split into q and z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary, format_quantities
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.configuration import Kinematics, Partition
from ckc_pin.mechanism.linkage import Linkage
from ckc_pin.mechanism.motors import Motors
from ckc_pin.mechanism.pose import Anchors, Pose
from ckc_pin.mechanism.rank import Freedoms, choose_dependent, compute_rank, idle_coordinates, scale_jacobian

__all__ = ["CONSTRAINED_IN_PART", "Mechanism"]

CONSTRAINED_IN_PART = (
    "the loops hold a free root in part, so no q of joint coordinates describes it; it starts as assembled "
    '(at = "assembled"), runs as a DAE (formulation = "dae"), and has no controller'
)


class Mechanism(HasSummary):
    """A closed chain: everything that does not depend on the state. `load` makes one.

    Parameters
    ----------
    linkage : Linkage
        What its files say.
    q_tree : (nq,) array
        The assembled configuration.
    residual, tolerance : float
        Largest |phi| there; largest |phi| that counts as closed.
    freedoms : Freedoms
        What the rank of J says there.

    Raises
    ------
    MechanismError
        Coordinates that cannot serve as q, motors on no joint.

    Attributes
    ----------
    name : str
    n, d : int
        Coordinates of the tree; freedoms of the mechanism.
    coordinates, independent, dependent : tuple of str
    actuated : tuple of str
        Names of the motors, in the order of tau.
    motors : Motors
    urdf : Element
        All its trees in one <robot>.
    tree, closure, frames : Tree, Closure, Frames
    joints, springs : Joints, Springs
    urdf : Element
        All trees in one <robot>, as Pinocchio got them.
    partition : Partition
    q_tree : (nq,) array
        The assembled configuration (Pinocchio's q).
    redundant : tuple of str
        Rows that the others imply, one admissible choice, as "loop.row".
    freedoms : Freedoms
        How d and rank were found.
    tolerance : float
        Largest |phi| that counts as closed.
    warnings : list of str
    """

    def __init__(self, linkage: Linkage, q_tree: Array, residual: float, tolerance: float, freedoms: Freedoms) -> None:
        self.spec, self.sources, self.name = linkage.spec, linkage.sources, linkage.spec.name
        self.urdf = linkage.urdf.root
        self.tree, self.closure, self.frames = linkage.tree, linkage.closure, linkage.frames
        self.joints, self.springs = linkage.joints, linkage.springs
        self.points, self.size = linkage.points, linkage.size
        self.coordinates, self.n = self.tree.coordinates, self.tree.n
        self.q_tree, self.residual, self.tolerance = q_tree, residual, tolerance
        self.freedoms = freedoms
        self.d, self.rank = freedoms.d, freedoms.rank.rank
        self.redundant = tuple(".".join(name) for name in freedoms.redundant)
        self.warnings = [*linkage.warnings, *freedoms.warnings]
        self._free_joints()
        self._split(linkage.motors)
        self._actuate(linkage.motors)

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        tree = self.tree
        loops = [f"{loop.name} ({loop.type})" for loop in self.spec.loop]
        loops += [f"{one.joint} = {one.ratio:g} {one.other} + {one.offset:g}" for one in self.spec.coupling]
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

    # --- one configuration -----------------------------------------------------------------------

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return the closure's terms at a configuration of the tree."""
        return Kinematics(self.tree, self.closure, self.partition, q_tree)

    @property
    def assembled(self) -> Kinematics:
        """The closure's terms at the assembled configuration."""
        return self.kinematics(self.q_tree)

    @property
    def independent_root_coordinates(self) -> tuple[str, ...]:
        """Independent coordinates that belong to free roots."""
        return tuple(name for name in self.independent if name in self.tree.free_coordinates)

    @property
    def has_direct_drives(self) -> bool:
        """Whether the motors turn the independent joints themselves, so that tau is u of eq. 6."""
        return np.array_equal(self.motors.transmission, np.eye(self.n)[self.partition.q])

    def independent_part(self, q_tree: Array) -> Array:
        """Return q of a configuration, shape (d,)."""
        return self.tree.to_coordinates(q_tree)[self.partition.q]

    def choose_partition(self, at: Kinematics, *, keep_roots_together: bool = True) -> Partition | None:
        """Return the split whose phi_z is furthest from singular at a configuration, by a pivoted QR.

        None if it would split the coordinates of a free root and these are to be kept together.
        """
        jacobian = scale_jacobian(at.J, self.tree, self.closure)
        z = choose_dependent(
            jacobian, self.rank, [np.arange(v, v + 6) for _, v in self.tree.free_roots] if keep_roots_together else []
        )
        return None if z is None else Partition(np.setdiff1d(np.arange(self.n), z), z)

    def point_positions(self, q_tree: Array) -> dict[str, Array]:
        """World positions of the mechanism's named points, metres."""
        pose = Pose(self.tree, self.closure.anchors, q_tree)
        return {
            name: pose.rotation[f.joint] @ f.translation + pose.translation[f.joint] for name, f in self.points.items()
        }

    def point_jacobians(self, q_tree: Array) -> dict[str, Array]:
        """Derivatives of the named points' world positions along the tangent coordinates, (3, n) each."""
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
        """Turn a table by coordinate into a vector, as `Tree.vector` does."""
        if tuple(names) == self.independent:
            follows = next((name for name in values if name in self.dependent), None)
            if follows is not None:
                raise InputError(f"{what}: {follows!r} follows from the loops; there are {', '.join(names)}")
        return self.tree.vector(values, names, what, fill)

    # --- construction ----------------------------------------------------------------------------

    def _free_joints(self) -> None:
        """Leave out friction and stops of joints that cannot move: rounding alone would decide what these do."""
        idle = self.freedoms.immobile & (self.joints.stopped | (self.joints.friction != 0.0))
        if not idle.any():
            return
        self.joints = self.joints.without(idle)
        names = ", ".join(self.coordinates[k] for k in np.flatnonzero(idle))
        self.warnings.append(f"friction and stops do nothing where the loops hold a joint still: {names}")

    def _split(self, motors: Motors | None) -> None:
        """Choose q and z, or check the choice made."""
        every = set(range(self.n))
        chosen = None if self.freedoms.dependent is None else set(self.freedoms.dependent.tolist())
        best = [self.coordinates[k] for k in sorted(every - (chosen or set()))]
        remedy = f"; {', '.join(best) or 'none'} would do" if chosen is not None else ""
        if chosen is None:  # no choice keeps the six coordinates of a free root together
            pivoted = choose_dependent(self.freedoms.jacobian, self.rank)
            best = [self.coordinates[k] for k in sorted(every - set([] if pivoted is None else pivoted.tolist()))]
        names = list(self.spec.independent) if self.spec.independent is not None else self._driven_first(best, motors)
        at = self.tree.indices(tuple(names), "independent")
        if len(set(names)) != len(names):
            raise MechanismError(f"independent: a coordinate is named twice in {names}")
        if len(names) != self.d:
            raise MechanismError(
                f"independent: {len(names)} coordinates ({', '.join(names) or 'none'}) but the mechanism has "
                f"d = {self.d} freedoms{remedy}"
            )
        z = np.array(sorted(every - set(at.tolist())), dtype=np.intp)
        if compute_rank(self.freedoms.jacobian[:, z]).rank < len(z):
            raise MechanismError(
                f"independent: {', '.join(names)} cannot parametrise the mechanism where it is assembled "
                f"(phi_z is singular there){remedy}"
            )
        self.splits_root = any(0 < sum(v_at <= k < v_at + 6 for k in at) < 6 for _, v_at in self.tree.free_roots)
        if self.splits_root and chosen is not None:
            raise MechanismError(
                f"independent: the six coordinates of a free root go together, all independent or none{remedy}"
            )
        if self.splits_root:
            self.warnings.append(CONSTRAINED_IN_PART)
        self.independent = tuple(names)
        self.dependent = tuple(self.coordinates[k] for k in z)
        self.partition = Partition(at, z)

    def _driven_first(self, best: list[str], motors: Motors | None) -> list[str]:
        """Return coordinates that can serve as q: those with motors as far as phi_z stays sound, then others."""
        if motors is None or not motors.names or self.freedoms.dependent is None:
            return best
        driven = np.flatnonzero(motors.transmission.any(axis=0))
        driven = driven[
            np.argsort(np.argmax(motors.transmission[:, driven] != 0, axis=0), kind="stable")
        ]  # in tau's order
        blocks = [np.arange(v, v + 6) for _, v in self.tree.free_roots]
        z = choose_dependent(self.freedoms.jacobian, self.rank, blocks, driven)
        if z is None:
            return best
        first = [int(k) for k in driven if k not in z]
        return [self.coordinates[k] for k in [*first, *(k for k in range(self.n) if k not in {*z, *first})]]

    def _actuate(self, motors: Motors | None) -> None:
        joints = [name for name in self.independent if name not in self.tree.free_coordinates]
        self.motors = Motors.on_joints(self.tree, joints) if motors is None else motors
        self.actuated = self.motors.names
        anchors = [self.closure.anchors, self.springs.anchors]
        turns = np.vstack([self.motors.transmission, np.diag(self.springs.joint_stiffness)])
        idle = idle_coordinates(self.tree, self._tangent(), self.q_tree, anchors, turns)
        if idle:
            self.warnings.append(
                f"idle freedoms, bodies that spin about themselves and move nothing: {', '.join(idle)}"
            )

    def _tangent(self) -> Array:
        if self.freedoms.singular or not self.d:
            return np.zeros((self.n, 0))
        return self.assembled.rho
