"""The `Mechanism`: a tree, its closure, an assembled configuration, and a checked split into q and z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from ckc_pin.errors import InputError, MechanismError
from ckc_pin.mechanism.assembly import Assembly, assemble
from ckc_pin.mechanism.closure import Closure, ClosureBuilder
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.freedoms import count_freedoms, idle_coordinates
from ckc_pin.mechanism.kinematics import Kinematics, Partition
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import choose_dependent, rank_of, scaled
from ckc_pin.mechanism.sigma import Sigma, sigma
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.spec import CouplingSpec, MechanismSpec
from ckc_pin.mechanism.springs import Springs
from ckc_pin.mechanism.tree import Array, IntArray, Tree
from ckc_pin.mechanism.urdf import TreeText, merge

__all__ = ["HELD_IN_PART", "Mechanism"]

EXACT = 1e-10  # |phi| in units of the mechanism's size that a closed mechanism of exact data reaches
ROUNDED = 1e-5  # the same when the numbers in the files are rounded to six digits: 2.35619 rad is 5e-6 off
LARGEST = 1e100  # m: squares of what is larger overflow, and their products

HELD_IN_PART = (
    "the loops hold a free root in part, so no q of joint coordinates describes it; it starts as assembled "
    '(at = "assembled"), runs as a DAE (formulation = "dae"), and has no controller'
)


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
    freedoms : Freedoms
        How d and rank were found.
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
        self.springs = Springs(self.tree, self.frames, spec.spring, spec.force)
        self.points = {p.name: self.frames.find(p.frame, f"point {p.name!r}") for p in spec.point}
        if len(self.points) < len(spec.point):
            raise MechanismError("point: two points have the same name")
        self.size = _size(self.tree, self.closure, sources.name)
        self.tree.measure(self.size)
        self.coordinates = self.tree.coordinates
        self.n = self.tree.n
        self.warnings += self.tree.unmodelled()
        with one_blas_thread():
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

    @property
    def rooted(self) -> tuple[str, ...]:
        """Independent coordinates that belong to free roots."""
        return tuple(name for name in self.independent if name in self.tree.free_coordinates)

    def sigma(self, q: Array, start: Kinematics | None = None, w: Array | float = 0.0) -> Sigma:
        """Return q' = sigma(q), eq. 4, on the assembly branch of `start` (default: as assembled).

        Parameters
        ----------
        q : (d,) array
            The independent coordinates, rad or m.

        Raises
        ------
        InputError
            The loops hold a free root in part: its place is no function of numbers q.
        """
        if self.splits_root:
            raise InputError(f"{self.name}: {HELD_IN_PART}")
        start = start or self.assembled
        if self.tree.flat:
            step = q - start.q_tree[self.tree.place[self.partition.q]]
        else:
            numbers = self.tree.to_coordinates(start.q_tree)
            numbers[self.partition.q] = q
            step = self.tree.difference(start.q_tree, self.tree.from_coordinates(numbers))[self.partition.q]
        return sigma(start, step, w, self.tolerance)

    def independent_part(self, q_tree: Array) -> Array:
        """Return q of a configuration, shape (d,)."""
        return self.tree.to_coordinates(q_tree)[self.partition.q]

    def best_partition(self, at: Kinematics) -> Partition | None:
        """Return the split whose phi_z is furthest from singular at a configuration, by a pivoted QR.

        None where it would split the coordinates of a free root.
        """
        jacobian = scaled(at.J, self.tree, self.closure)
        z = choose_dependent(jacobian, self.rank, [np.arange(v, v + 6) for _, v in self.tree.free])
        return None if z is None else Partition(np.setdiff1d(np.arange(self.n), z), z)

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
            known = unknown[0] in self.coordinates and tuple(names) == tuple(self.independent)
            says = f"{unknown[0]!r} follows from the loops" if known else f"no coordinate {unknown[0]!r} here"
            raise InputError(f"{what}: {says}; there are {', '.join(names)}")
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
        closed = self._close(self.tree.from_coordinates(guess))
        self.q_tree = closed.q_tree
        self.residual = closed.residual
        lengths = bool(np.all(self.closure.in_metres(self.tree)))
        rounding = 1e-13 * (self.size if lengths else max(self.size, 1.0))
        self.tolerance = rounding if closed.residual <= EXACT * self.size else 10 * closed.residual
        self.freedoms = count_freedoms(self.tree, self.closure, self.q_tree, max(self.tolerance, rounding))
        self.d, self.rank = self.freedoms.d, self.freedoms.rank.rank
        self.redundant = tuple(".".join(name) for name in self.freedoms.redundant)
        self.warnings += self.freedoms.warnings
        self._split()
        self._actuate()

    def _close(self, start: Array) -> Assembly:
        """Assemble with the independent coordinates held at their guess; if that fails, with all free."""
        closed: Assembly | None = None
        scale = self.size
        if self.spec.independent is not None:
            free = np.ones(self.n)
            free[self.tree.indices(tuple(self.spec.independent), "independent")] = 0.0
            closed = assemble(self.tree, self.closure, start, free, EXACT * scale)
        if closed is None or closed.residual > ROUNDED * scale:
            closed = assemble(self.tree, self.closure, start, np.ones(self.n), EXACT * scale)
        if closed.residual > ROUNDED * scale:
            raise MechanismError(f"{self.sources.name}: {self._why_not_closed(closed, start)}")
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

    def _why_not_closed(self, best: Assembly, start: Array) -> str:
        """Name the loop with the largest miss, loops that cannot close even alone, and what to do."""
        loop, miss = max(best.misses.items(), key=lambda item: item[1])
        message = f"not closed: nearest miss {miss:.3g} m at loop {loop}"
        if miss > 1000 * self.size:
            return f"{message}, {miss / self.size:.0f} times the mechanism's size of {self.size:.3g} m: units?"
        alone = []
        for name in dict.fromkeys(name for name, _ in self.closure.names):
            single = self.closure.only(name)
            closed = assemble(self.tree, single, start, np.ones(self.n), EXACT * self.size)
            if closed.residual > ROUNDED * self.size:
                alone.append(f"{name} (miss {closed.residual:.3g})")
        if alone:
            message += f"; cannot close even alone: {', '.join(alone)}"
        elif len(best.misses) > 1:
            others = ", ".join(f"{k} {x:.3g}" for k, x in best.misses.items() if x > ROUNDED * self.size)
            message += f"; each loop closes alone, together they contradict each other ({others})"
        return f"{message}. Check the loops' frames and types, or give a [q_guess] nearer to a closed configuration"

    def _split(self) -> None:
        """Choose q and z, or check the choice made."""
        every = set(range(self.n))
        chosen = None if self.freedoms.dependent is None else set(self.freedoms.dependent.tolist())
        best = [self.coordinates[k] for k in sorted(every - (chosen or set()))]
        remedy = f"; {', '.join(best) or 'none'} would do" if chosen is not None else ""
        if chosen is None:  # no choice keeps the six coordinates of a free root together
            pivoted = choose_dependent(self.freedoms.jacobian, self.rank)
            best = [self.coordinates[k] for k in sorted(every - set([] if pivoted is None else pivoted.tolist()))]
        names = list(self.spec.independent) if self.spec.independent is not None else best
        at = self.tree.indices(tuple(names), "independent")
        if len(set(names)) != len(names):
            raise MechanismError(f"independent: a coordinate is named twice in {names}")
        if len(names) != self.d:
            raise MechanismError(
                f"independent: {len(names)} coordinates ({', '.join(names) or 'none'}) but the mechanism has "
                f"d = {self.d} freedoms{remedy}"
            )
        z = np.array(sorted(every - set(at.tolist())), dtype=np.intp)
        if rank_of(self.freedoms.jacobian[:, z]).rank < len(z):
            raise MechanismError(
                f"independent: {', '.join(names)} cannot parametrise the mechanism where it is assembled "
                f"(phi_z is singular there){remedy}"
            )
        self.splits_root = any(0 < sum(v_at <= k < v_at + 6 for k in at) < 6 for _, v_at in self.tree.free)
        if self.splits_root and chosen is not None:
            raise MechanismError(
                f"independent: the six coordinates of a free root go together, all independent or none{remedy}"
            )
        if self.splits_root:
            self.warnings.append(HELD_IN_PART)
        self.independent = tuple(names)
        self.dependent = tuple(self.coordinates[k] for k in z)
        self.partition = Partition(at, z)

    def _actuate(self) -> None:
        joints = [name for name in self.independent if name not in self.tree.free_coordinates]
        self.actuated = tuple(self.spec.actuated if self.spec.actuated is not None else joints)
        self.actuated_at: IntArray = self.tree.indices(self.actuated, "actuated")
        if len(set(self.actuated)) != len(self.actuated):
            raise MechanismError(f"actuated: a joint is named twice in {list(self.actuated)}")
        rooted = [name for name in self.actuated if name in self.tree.free_coordinates]
        if rooted:
            raise MechanismError(f"actuated: {rooted[0]!r} belongs to a free root, which has no motor")
        idle = idle_coordinates(self.tree, self._tangent(), self.q_tree, self.actuated_at)
        if idle:
            self.warnings.append(
                f"idle freedoms, bodies that spin about themselves and move nothing: {', '.join(idle)}"
            )

    def _tangent(self) -> Array:
        if self.freedoms.singular or not self.d:
            return np.zeros((self.n, 0))
        return self.assembled.rho


def _build_model(text: str, source: str) -> pin.Model:
    try:
        return pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise MechanismError(f"{source}: Pinocchio cannot build this tree: {error}") from None


def _size(tree: Tree, closure: Closure, source: str) -> float:
    """Characteristic length: the largest offset between joints, or from a joint to a loop's point, metres."""
    offsets = [placement.translation for placement in tree.model.jointPlacements]
    parts = np.array([*offsets, *closure.anchors.point_local]).reshape(-1, 3)
    if not np.abs(parts).max(initial=0.0) <= LARGEST:
        raise MechanismError(
            f"{source}: offsets of joints or loops of {np.abs(parts).max():g} m, more than {LARGEST:g}: units?"
        )
    return float(np.linalg.norm(parts, axis=1).max(initial=0.0)) or 1.0
