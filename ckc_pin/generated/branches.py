"""Branches of a tree that are alike: joints of the same kinds, which other numbers tell apart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

from ckc_pin.generated.graph import Lane
from ckc_pin.mechanism.tree import Tree

__all__ = ["alike_branches"]

FEWEST, MOST = 2, 4  # branches that are done at a time


def alike_branches(tree: Tree) -> Mapping[str, Mapping[int, tuple[Lane, int]]]:
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
