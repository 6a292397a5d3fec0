"""A CasADi function as a graph of operations, and which of its operations alike branches do with other numbers."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Any

__all__ = ["Graph", "Node", "lanes"]

Lane = tuple[int, int]  # a group of alike branches, and which of them


@dataclass(frozen=True)
class Node:
    """An operation, of nodes by number; of an input which argument and place, of a constant its value."""

    operation: int
    of: tuple[int, ...] = ()
    at: tuple[int, int] = (0, 0)
    value: float = 0.0


@dataclass(frozen=True)
class Graph:
    """Nodes after those that they are of, and what is a result: (result, place) and the node."""

    nodes: list[Node]
    results: list[tuple[tuple[int, int], int]]

    @classmethod
    def of(cls, function: Any) -> Graph:
        """Read a function's instructions."""
        import casadi as cs

        nodes: list[Node] = []
        results: list[tuple[tuple[int, int], int]] = []
        at_work: dict[int, int] = {}  # by place in the function's own working memory
        for k in range(function.n_instructions()):
            operation, to = function.instruction_id(k), function.instruction_output(k)
            of = function.instruction_input(k)
            if operation == cs.OP_OUTPUT:
                results.append(((to[0], to[1]), at_work[of[0]]))
                continue
            if operation == cs.OP_INPUT:
                node = Node(operation, at=(of[0], of[1]))
            elif operation == cs.OP_CONST:
                node = Node(operation, value=function.instruction_constant(k))
            else:
                node = Node(operation, tuple(at_work[x] for x in of))
            at_work[to[0]] = len(nodes)
            nodes.append(node)
        return cls(nodes, results)


def lanes(graph: Graph, places: Mapping[tuple[int, int], tuple[Lane, int]], vectorized: Set[int]) -> list[list[int]]:
    """Return packs of nodes that do the same in alike branches, a node a branch.

    Parameters
    ----------
    graph : Graph
    places : mapping of (argument, place) to (lane, int)
        Inputs that belong to a branch, and which of its numbers they are.
    vectorized : set of int
        Operations that may be done together.

    Notes
    -----
    A node that is of one branch and of what all share is the branch's. What is of several is shared, a stage later:
    nodes of one stage in different branches do not depend on each other.
    """
    together = Counter(group for group, _ in {x for x, _ in places.values()})
    shared: set[int] = set()
    while True:
        packs = _alike(graph, places, vectorized, shared)
        alone = {
            k
            for (group, *_), alike in packs.items()
            if len(alike) < together[group] or len({len(x) for x in alike.values()}) > 1
            for found in alike.values()
            for k in found
        }
        if not alone:
            return [list(x) for alike in packs.values() for x in zip(*(alike[at] for at in sorted(alike)), strict=True)]
        follows: list[bool] = []  # others may be alone because of these
        for k, node in enumerate(graph.nodes):
            after = any(follows[x] for x in node.of)
            follows.append(after or k in alone)
            if k in alone and not after:
                shared.add(k)


def _alike(
    graph: Graph, places: Mapping[tuple[int, int], tuple[Lane, int]], vectorized: Set[int], shared: Set[int]
) -> dict[tuple[int, int, int], dict[int, list[int]]]:
    """By group, stage and what is done: the nodes of each branch. `shared`: which ones are not any branch's."""
    import casadi as cs

    lane: list[Lane | None] = []
    stage: list[int] = []
    key: list[int] = []
    keys: dict[object, int] = {}
    packs: dict[tuple[int, int, int], dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for k, node in enumerate(graph.nodes):
        found = {lane[x] for x in node.of} - {None}
        now = max((stage[x] for x in node.of), default=0)
        own = next(iter(found)) if len(found) == 1 and k not in shared else None
        what: tuple[object, ...] = (node.operation, *(key[x] for x in node.of))
        if node.operation == cs.OP_INPUT and node.at in places:
            own, number = places[node.at]
            what = ("input", node.at[0], number)
        elif own is None:
            now += len(found) > 0
            what = ("shared", node.value if node.operation == cs.OP_CONST else None)
        elif node.operation in vectorized:
            packs[own[0], now, keys.setdefault((own[0], what), len(keys))][own[1]].append(k)
        lane.append(own)
        stage.append(now)
        key.append(keys.setdefault((own and own[0], what), len(keys)))
    return packs
