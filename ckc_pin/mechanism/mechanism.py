"""The `Mechanism`: a tree, its closure, an assembled configuration, and a checked split into q and z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.assembly import Assembly, assemble
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.kinematics import Kinematics, Partition
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import RankReport, choose_dependent, rank_of, redundant_rows
from ckc_pin.mechanism.sigma import Sigma, sigma
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.spec import CouplingSpec, MechanismSpec
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.tree import Array, IntArray, Tree
from ckc_pin.mechanism.urdf import TreeText, merge

__all__ = ["Mechanism"]

EXACT = 1e-10  # |phi| in units of the mechanism's size that a closed mechanism of exact data reaches
ROUNDED = 1e-6  # the same when the numbers in the files are rounded to six digits
RANK_TOLERANCE = 1e-7


class Mechanism:
    """A closed chain: everything that does not depend on the state.

    Parameters
    ----------
    spec : MechanismSpec
        The content of ``mechanism.toml``.
    sources : Sources
        Where the texts of its URDFs come from.

    Raises
    ------
    MechanismError
        Unknown names, loops that cannot be closed from q_guess, coordinates that cannot serve as q.

    Attributes
    ----------
    name : str
    n, d : int
        Coordinates of the tree; freedoms of the mechanism.
    coordinates, independent, dependent, actuated : tuple of str
    tree, closure, frames : Tree, Closure, Frames
    partition : Partition
    q_tree : (nq,) array
        The assembled configuration (Pinocchio's q).
    redundant : tuple of str
        Rows that the others imply, one admissible choice, as "loop.row".
    tolerance : float
        Largest |phi| that counts as closed.
    warnings : list of str
    """

    def __init__(self, spec: MechanismSpec, sources: Sources) -> None:
        self.spec = spec
        self.sources = sources
        self.name = spec.name
        text, urdf = merge(self._tree_texts())
        self.warnings = list(urdf.warnings)
        self.tree = Tree(_build_model(text, sources.name))
        self.tree.model.gravity.linear = np.array(spec.gravity)
        self.frames = Frames(self.tree.model)
        builder = ClosureBuilder(self.tree, self.frames)
        for loop in spec.loop:
            builder.add_loop(loop)
        mimic = [CouplingSpec(joint=a, other=b, ratio=r, offset=c) for a, b, r, c in urdf.mimic]
        for coupling in [*spec.coupling, *mimic]:
            builder.add_coupling(coupling)
        self.closure: Closure = builder.build()
        self.springs = Springs(self.tree, self.frames, spec.spring)
        self.points = {p.name: self.frames.find(p.frame, f"point {p.name!r}") for p in spec.point}
        self.size = _size(self.tree)
        self.coordinates = self.tree.coordinates
        self.n = self.tree.n
        self._assemble()

    def __repr__(self) -> str:
        return f"Mechanism({self.name!r}, n={self.n}, d={self.d}, independent={list(self.independent)})"

    # --- one configuration -----------------------------------------------------------------------

    def kinematics(self, q_tree: Array) -> Kinematics:
        """Return the closure's terms at a configuration of the tree."""
        return Kinematics(self.tree, self.closure, self.partition, q_tree)

    @property
    def assembled(self) -> Kinematics:
        """The closure's terms at the assembled configuration."""
        return self.kinematics(self.q_tree)

    def sigma(self, q: Array, start: Kinematics | None = None, w: Array | float = 0.0) -> Sigma:
        """Return q' = sigma(q), eq. 4, on the assembly branch of `start` (default: as assembled).

        Parameters
        ----------
        q : (d,) array
            The independent coordinates, rad or m.
        """
        start = start or self.assembled
        return sigma(start, q - self.independent_part(start.q_tree), w, self.tolerance)

    def independent_part(self, q_tree: Array) -> Array:
        """Return q of a configuration, shape (d,)."""
        return self.tree.to_coordinates(q_tree)[self.partition.q]

    def point_positions(self, q_tree: Array) -> dict[str, Array]:
        """World positions of the mechanism's named points, metres."""
        pose = Pose(self.tree, self.closure.anchors, q_tree)
        return {
            name: pose.rotation[f.joint] @ f.translation + pose.translation[f.joint] for name, f in self.points.items()
        }

    def vector(self, values: Mapping[str, float], names: Sequence[str], what: str, fill: float | None = None) -> Array:
        """Turn a table by coordinate into a vector.

        Raises
        ------
        InputError
            An unknown name, a missing one (unless `fill` is given), a value that is not finite.
        """
        unknown = [name for name in values if name not in names]
        if unknown:
            raise InputError(f"{what}: no coordinate {unknown[0]!r} here; there are {', '.join(names)}")
        missing = [name for name in names if name not in values]
        if missing and fill is None:
            raise InputError(f"{what}: {', '.join(missing)} missing; needed are {', '.join(names)}")
        vector = np.array([float(values.get(name, fill if fill is not None else np.nan)) for name in names])
        if not np.all(np.isfinite(vector)):
            bad = names[int(np.flatnonzero(~np.isfinite(vector))[0])]
            raise InputError(f"{what}: {bad} = {values[bad]} is not a finite number")
        return vector

    # --- construction ----------------------------------------------------------------------------

    def _tree_texts(self) -> list[TreeText]:
        spec, where = self.spec, self.sources.name
        if (spec.urdf is None) == (not spec.tree):
            raise InputError(f'{where}: give either urdf = "FILE" or [[tree]] entries')
        if spec.urdf is not None:
            return [TreeText(self.sources.text(spec.urdf), spec.urdf)]
        return [
            TreeText(self.sources.text(t.file), t.file, t.prefix, t.root, t.parent, t.xyz, t.rpy) for t in spec.tree
        ]

    def _assemble(self) -> None:
        guess = self.vector(self.spec.q_guess, self.coordinates, "q_guess", fill=0.0)
        start = self.tree.from_coordinates(guess)
        closed = self._close(start)
        self.q_tree = closed.q_tree
        self.residual = closed.residual
        self.tolerance = max(1e-13 * max(self.size, 1.0), 2.0 * closed.residual if closed.residual > EXACT else 0.0)
        pose = Pose(self.tree, self.closure.anchors, self.q_tree)
        jacobian = self.closure.jacobian(pose)
        self.rank: RankReport = rank_of(jacobian, max(RANK_TOLERANCE, 10 * self.residual))
        self.d = self.n - self.rank.rank
        self.redundant = tuple(".".join(self.closure.names[k]) for k in redundant_rows(jacobian, self.rank.rank))
        self._split(jacobian)
        names = self.spec.actuated if self.spec.actuated is not None else list(self.independent)
        self.actuated = tuple(names)
        self.actuated_at: IntArray = self.tree.indices(self.actuated, "actuated")
        if len(set(names)) != len(names):
            raise MechanismError(f"actuated: a joint is named twice in {names}")

    def _close(self, start: Array) -> Assembly:
        """Assemble with the independent coordinates held at their guess; if that fails, with all free."""
        closed: Assembly | None = None
        scale = max(self.size, 1e-12)
        if self.spec.independent is not None:
            free = np.ones(self.n)
            free[self.tree.indices(tuple(self.spec.independent), "independent")] = 0.0
            closed = assemble(self.tree, self.closure, start, free, EXACT * scale)
        if closed is None or closed.residual > ROUNDED * scale:
            closed = assemble(self.tree, self.closure, start, np.ones(self.n), EXACT * scale)
        if closed.residual > ROUNDED * scale:
            loop, miss = max(closed.misses.items(), key=lambda item: item[1])
            raise MechanismError(
                f"{self.sources.name}: not closed: nearest miss {miss:.3g} at loop {loop}; "
                "check the loop's frames, or give a [q_guess] nearer to a closed configuration"
            )
        reversed_ = self.closure.reversed_hinges(Pose(self.tree, self.closure.anchors, closed.q_tree))
        if reversed_:
            raise MechanismError(
                f"{self.sources.name}: loop {reversed_[0]!r} closes with its axes against each other (a . b < 0); "
                "turn axis_b around, or give a [q_guess] on the other branch"
            )
        if closed.residual > EXACT * scale:
            self.warnings.append(
                f"the loops close to {closed.residual:.2g} only, not to rounding: "
                "numbers in the files are rounded, or redundant rows contradict each other slightly"
            )
        return closed

    def _split(self, jacobian: Array) -> None:
        chosen = choose_dependent(jacobian, self.rank.rank)
        best = [name for k, name in enumerate(self.coordinates) if k not in set(chosen.tolist())]
        names = list(self.spec.independent) if self.spec.independent is not None else best
        at = self.tree.indices(tuple(names), "independent")
        if len(set(names)) != len(names):
            raise MechanismError(f"independent: a coordinate is named twice in {names}")
        if len(names) != self.d:
            raise MechanismError(
                f"independent: {len(names)} coordinates ({', '.join(names)}) but the mechanism has d = {self.d} "
                f"freedoms; {', '.join(best) or 'none'} would do"
            )
        z = np.setdiff1d(np.arange(self.n), at)
        phi_z = jacobian[:, z]
        if rank_of(phi_z, RANK_TOLERANCE).rank < len(z):
            raise MechanismError(
                f"independent: {', '.join(names)} cannot parametrise the mechanism at its assembled configuration "
                f"(phi_z is singular there); {', '.join(best)} would do"
            )
        self.independent = tuple(names)
        self.dependent = tuple(self.coordinates[k] for k in z)
        self.partition = Partition(at, z.astype(np.intp))


def _build_model(text: str, source: str) -> pin.Model:
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise MechanismError(f"{source}: Pinocchio cannot build this tree: {error}") from None


def _size(tree: Tree) -> float:
    """Characteristic length: the largest offset from one joint to the next, metres."""
    offsets = [float(np.linalg.norm(placement.translation)) for placement in tree.model.jointPlacements]
    return max(offsets, default=0.0) or 1.0
