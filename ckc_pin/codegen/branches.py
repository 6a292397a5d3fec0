"""Identical branches of a tree: joints of the same types in the same order, with other numbers.

The C code computes identical branches together, one branch a lane of a vector. To make their code the same, vectors of
a branch are resolved in the axes in which its first joint is placed.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.arguments import Arguments, constant, snap_to_units
from ckc_pin.codegen.graph import Lane
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors
from ckc_pin.mechanism.tree import Tree

__all__ = ["AxisRotations", "BranchAxes", "Lanes", "assign_argument_lanes", "find_identical_branches", "group_roots"]

Lanes = Mapping[int, tuple[Lane, int]]  # by place in a vector: its lane, and a number that its partners share

MIN_LANES, MAX_LANES = 2, 4  # of one vector: four doubles fill an AVX register
NUMBERS_PER_JOINT = 10  # of a joint's coordinates, at most seven are used


@dataclass(frozen=True)
class BranchAxes:
    """Axes of the branch that begins with a joint. Joint 0's axes are the world's."""

    rotations: AxisRotations
    joint: int

    def rotation_to(self, other: BranchAxes) -> Any:
        """Return the rotation of vectors into other axes, (3, 3)."""
        return self.rotations.rotation(self.joint, other.joint)


@dataclass
class AxisRotations:
    """Constant rotations between the axes of branches.

    The rotations of identical branches against the rest of the tree differ in value. Entries that differ become
    symbols, even where the entry of one branch is zero or one, so that all branches have the same code.

    Parameters
    ----------
    placements : sequence of (3, 3) arrays
        Rotation of each joint's placement in the world, the world's first. Only those of root joints are used.
    root_groups : sequence of sequences of int
        Root joints of identical branches.

    Attributes
    ----------
    symbols, values : list of casadi.SX, list of float
    owners : list of (int, (int, int, int))
        For each symbol, its branch's root joint, and the other axes, row and column.
    """

    placements: Sequence[Array]
    root_groups: Sequence[Sequence[int]] = ()
    symbols: list[Any] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    owners: list[tuple[int, tuple[int, int, int]]] = field(default_factory=list)
    _cache: dict[tuple[int, int], Any] = field(default_factory=dict)

    def rotation(self, source: int, target: int) -> Any:
        """Return the rotation of vectors from the axes of one root joint into those of another, (3, 3)."""
        if (source, target) not in self._cache:
            R = self._compute(source, target)
            self._cache[source, target], self._cache[target, source] = R, R.T
        return self._cache[source, target]

    def _compute(self, source: int, target: int) -> Any:
        import casadi as cs

        for branch, base in ((source, target), (target, source)):
            group = next((group for group in self.root_groups if branch in group), [branch])
            if base in group or len(group) == 1:
                continue
            relative = {k: snap_to_units(self.placements[k].T @ self.placements[base]) for k in group}
            differs = np.ptp([*relative.values()], axis=0) > 0
            R = constant(np.where(differs, 0.0, relative[branch]))
            for i, j in np.argwhere(differs).tolist():
                R[i, j] = cs.SX.sym(f"turn_{branch}_{base}_{i}_{j}")
                self.symbols.append(R[i, j])
                self.values.append(relative[branch][i, j])
                self.owners.append((branch, (base, i, j)))
            return R.T if branch == source else R
        return constant(self.placements[target].T @ self.placements[source])


def find_identical_branches(tree: Tree) -> Mapping[str, Lanes]:
    """Return the lanes of the entries of q, trig, v, u and x that belong to identical branches."""
    model = tree.model
    branches: dict[int, list[int]] = {}
    for k in range(1, model.njoints):
        root = k if model.parents[k] == 0 else next(x for x, joints in branches.items() if model.parents[k] in joints)
        branches.setdefault(root, []).append(k)
    by_structure: dict[object, list[list[int]]] = defaultdict(list)
    for root, joints in branches.items():
        by_structure[tuple(_joint_structure(tree, k, root) for k in joints)].append(joints)
    lanes: dict[str, dict[int, tuple[Lane, int]]] = {name: {} for name in ("q", "trig", "v", "u", "x")}
    group = 0
    for identical in by_structure.values():
        for first in range(0, len(identical), MAX_LANES):
            together = identical[first : first + MAX_LANES]
            if len(together) >= MIN_LANES:
                for k, joints in enumerate(together):
                    _assign_lane(tree, joints, (group, k), lanes)
                group += 1
    return lanes


def group_roots(tree: Tree, lanes: Mapping[str, Lanes]) -> list[list[int]]:
    """Return the root joints of identical branches, group by group."""
    groups: dict[int, list[int]] = defaultdict(list)
    for k in range(1, tree.model.njoints):
        in_q = tree.model.joints[k].idx_q
        if tree.model.parents[k] == 0 and in_q in lanes["q"]:
            groups[lanes["q"][in_q][0][0]].append(k)
    return [*groups.values()]


def assign_argument_lanes(
    mechanism: Mechanism, arguments: Arguments, rotations: AxisRotations, lanes: Mapping[str, Lanes]
) -> Lanes:
    """Return the lanes of the arguments, and of the symbols of `rotations` after them.

    A branch owns the numbers of its joints and bodies, and the ends of loops and springs that tie it to a part of the
    mechanism that is no branch.
    """
    tree = mechanism.tree
    joints = {k: lanes["q"][x.idx_q] for k, x in enumerate(tree.model.joints) if k and x.idx_q in lanes["q"]}
    bodies = {k: (lane, (number,)) for k, (lane, number) in joints.items()}
    coordinates = {k: (lane, (number,)) for k, (lane, number) in lanes["v"].items()}
    carriers: dict[str, Mapping[int, tuple[Lane, tuple[int, ...]]]] = {
        **dict.fromkeys(("offset", "mass", "centre", "inertia"), bodies),
        **dict.fromkeys(("armature", "constant", "joint_stiffness", "joint_rest", "joint_damping"), coordinates),
        "point": _lanes_of_ends(mechanism.closure.anchors, joints),
        "end": _lanes_of_ends(mechanism.springs.anchors, joints),
    }
    owners = [(carriers.get(name, {}).get(index[0]), (name, *index[1:])) for name, index in arguments.places]
    owners += [((joints[branch][0], ()), ("turn", *entry)) for branch, entry in rotations.owners]
    numbers: dict[object, int] = {}
    return {
        k: (carrier[0], numbers.setdefault((carrier[1], quantity), len(numbers)))
        for k, (carrier, quantity) in enumerate(owners)
        if carrier
    }


def _lanes_of_ends(anchors: Anchors, joints: Lanes) -> dict[int, tuple[Lane, tuple[int, ...]]]:
    """Return the lanes of pairs of points: a branch owns both if the other end is on no branch."""
    lanes_of_ends: dict[int, tuple[Lane, tuple[int, ...]]] = {}
    counts: Counter[object] = Counter()
    pairs = len(anchors.point_joint) // 2
    for k in range(pairs):
        ends = [joints.get(anchors.point_joint[point]) for point in (k, pairs + k)]
        lanes = {end[0] for end in ends if end}
        if len(lanes) == 1:
            numbers = tuple(-1 if end is None else end[1] for end in ends)
            (lane,) = lanes
            for side in (0, 1):
                lanes_of_ends[k + side * pairs] = lane, (*numbers, counts[lane, numbers], side)
            counts[lane, numbers] += 1
    return lanes_of_ends


def _joint_structure(tree: Tree, joint: int, root: int) -> object:
    """Return what two joints must have in common to be identical: relative parent, type and axis."""
    model_joint = tree.model.joints[joint]
    parent = tree.model.parents[joint] - root if joint != root else None
    axis = None if model_joint.nq == 7 else (tuple(tree.axis(joint)[0].tolist()), tree.axis(joint)[1])
    return (parent, model_joint.nq, axis)


def _assign_lane(tree: Tree, joints: list[int], lane: Lane, lanes: dict[str, dict[int, tuple[Lane, int]]]) -> None:
    for number, joint in enumerate(joints):
        model_joint = tree.model.joints[joint]
        for k in range(model_joint.nq):
            place = (lane, NUMBERS_PER_JOINT * number + k)
            lanes["q"][model_joint.idx_q + k] = lanes["trig"][model_joint.idx_q + k] = place
            lanes["trig"][tree.nq + model_joint.idx_q + k] = (lane, -1 - place[1])
        for k in range(model_joint.nv):
            for name in ("v", "u", "x"):
                lanes[name][model_joint.idx_v + k] = (lane, NUMBERS_PER_JOINT * number + k)
