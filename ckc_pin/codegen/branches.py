"""Branches of a tree that are alike: joints of the same kinds, which other numbers tell apart."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping

from ckc_pin.codegen.arguments import Arguments
from ckc_pin.codegen.axes import Turns
from ckc_pin.codegen.graph import Lane
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Anchors
from ckc_pin.mechanism.tree import Tree

__all__ = ["Places", "alike_branches", "alike_numbers", "alike_roots"]

Places = Mapping[int, tuple[Lane, int]]  # whose an input is, and which of theirs

FEWEST, MOST = 2, 4  # branches that are done at a time


def alike_branches(tree: Tree) -> Mapping[str, Places]:
    """Return the inputs of alike branches: their places in q, trig, v, u and x, whose they are and which of theirs."""
    model = tree.model
    branches: dict[int, list[int]] = {}
    for k in range(1, model.njoints):
        root = k if model.parents[k] == 0 else next(x for x, joints in branches.items() if model.parents[k] in joints)
        branches.setdefault(root, []).append(k)
    kinds: dict[object, list[list[int]]] = defaultdict(list)
    for root, joints in branches.items():
        kinds[tuple(_kind(tree, k, root) for k in joints)].append(joints)
    found: dict[str, dict[int, tuple[Lane, int]]] = {name: {} for name in ("q", "trig", "v", "u", "x")}
    group = 0
    for same in kinds.values():
        for first in range(0, len(same), MOST):
            together = same[first : first + MOST]
            if len(together) >= FEWEST:
                for at, joints in enumerate(together):
                    _enter(tree, joints, (group, at), found)
                group += 1
    return found


def alike_roots(tree: Tree, alike: Mapping[str, Places]) -> list[list[int]]:
    """Return the joints that alike branches begin with, group by group."""
    found: dict[int, list[int]] = defaultdict(list)
    for k in range(1, tree.model.njoints):
        at = tree.model.joints[k].idx_q
        if tree.model.parents[k] == 0 and at in alike["q"]:
            found[alike["q"][at][0][0]].append(k)
    return [*found.values()]


def alike_numbers(mechanism: Mechanism, arguments: Arguments, turns: Turns, alike: Mapping[str, Places]) -> Places:
    """Return which of the arguments, and of the symbols of `turns` after them, are of alike branches.

    A branch has what belongs to its joints, and the ends of what ties it to what is no branch.
    """
    tree = mechanism.tree
    joints = {k: alike["q"][x.idx_q] for k, x in enumerate(tree.model.joints) if k and x.idx_q in alike["q"]}
    bodies = {k: (lane, (number,)) for k, (lane, number) in joints.items()}
    coordinates = {k: (lane, (number,)) for k, (lane, number) in alike["v"].items()}
    carriers: dict[str, Mapping[int, tuple[Lane, tuple[int, ...]]]] = {
        **dict.fromkeys(("offset", "mass", "centre", "inertia"), bodies),
        **dict.fromkeys(("armature", "constant", "joint_stiffness", "joint_rest", "joint_damping"), coordinates),
        "point": _ends(mechanism.closure.anchors, joints),
        "end": _ends(mechanism.springs.anchors, joints),
    }
    of = [(carriers.get(name, {}).get(index[0]), (name, *index[1:])) for name, index in arguments.places]
    of += [((joints[branch][0], ()), ("turn", *which)) for branch, which in turns.whose]
    numbers: dict[object, int] = {}
    return {
        k: (carrier[0], numbers.setdefault((carrier[1], what), len(numbers)))
        for k, (carrier, what) in enumerate(of)
        if carrier
    }


def _ends(anchors: Anchors, joints: Places) -> dict[int, tuple[Lane, tuple[int, ...]]]:
    """Whose the ends of pairs of points are, and which of theirs: of one branch's, the other's too that is of none."""
    found: dict[int, tuple[Lane, tuple[int, ...]]] = {}
    before: Counter[object] = Counter()
    count = len(anchors.point_joint) // 2
    for k in range(count):
        ends = [joints.get(anchors.point_joint[at]) for at in (k, count + k)]
        lanes = {end[0] for end in ends if end}
        if len(lanes) == 1:
            which = tuple(-1 if end is None else end[1] for end in ends)
            (lane,) = lanes
            for side in (0, 1):
                found[k + side * count] = lane, (*which, before[lane, which], side)
            before[lane, which] += 1
    return found


def _kind(tree: Tree, joint: int, root: int) -> object:
    of = tree.model.joints[joint]
    parent = tree.model.parents[joint] - root if joint != root else None
    return (parent, of.nq, None if of.nq == 7 else (tuple(tree.axis(joint)[0].tolist()), tree.axis(joint)[1]))


def _enter(tree: Tree, joints: list[int], lane: Lane, found: dict[str, dict[int, tuple[Lane, int]]]) -> None:
    for number, joint in enumerate(joints):
        of = tree.model.joints[joint]
        for k in range(of.nq):
            place = (lane, 10 * number + k)
            found["q"][of.idx_q + k] = found["trig"][of.idx_q + k] = place
            found["trig"][tree.nq + of.idx_q + k] = (lane, -1 - place[1])
        for k in range(of.nv):
            for name in ("v", "u", "x"):
                found[name][of.idx_v + k] = (lane, 10 * number + k)
