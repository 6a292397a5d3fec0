"""A CasADi function as a graph of operations, and which of its operations alike branches do with other numbers."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import Any

__all__ = ["Graph", "Lane", "Node", "Packing"]

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

    def divided_once(self) -> Graph:
        """With one division by what several are divided by, whose inverse costs as much as ten products.

        CasADi makes a division of every product with an inverse.
        """
        import casadi as cs

        often = Counter(node.of[-1] for node in self.nodes if node.operation in (cs.OP_DIV, cs.OP_INV))
        nodes: list[Node] = []
        place: list[int] = []
        inverse: dict[int, int] = {}
        for node in self.nodes:
            of = tuple(place[x] for x in node.of)
            if node.operation in (cs.OP_DIV, cs.OP_INV) and often[node.of[-1]] > 1:
                if node.of[-1] not in inverse:
                    inverse[node.of[-1]] = len(nodes)
                    nodes.append(Node(cs.OP_INV, of[-1:]))
                by = inverse[node.of[-1]]
                if node.operation == cs.OP_INV:
                    place.append(by)
                    continue
                node, of = replace(node, operation=cs.OP_MUL), (of[0], by)
            place.append(len(nodes))
            nodes.append(replace(node, of=of))
        return Graph(nodes, [(to, place[k]) for to, k in self.results])


class Packing:
    """Packs of nodes that do the same in alike branches, a node a branch.

    Nodes are gone through by whose they are, level after level. A node that is of one branch and of what all share is
    the branch's, unless other branches have none like it. What is of several branches is shared, a stage later: nodes
    of one stage in different branches do not depend on each other, and of those in one branch the later is deeper.

    Parameters
    ----------
    graph : Graph
    places : mapping of (argument, place) to (lane, int)
        Inputs that belong to a branch, and which of its numbers they are.
    vectorized : set of int
        Operations that may be done together.

    Attributes
    ----------
    packs : list of lists of int
    pack : dict of int to (int, int)
        The pack of a node, and its place in it.
    """

    def __init__(self, graph: Graph, places: Mapping[tuple[int, int], tuple[Lane, int]], vectorized: Set[int]) -> None:
        self.graph, self.places, self.vectorized = graph, places, vectorized
        self.together = Counter(group for group, _ in {x for x, _ in places.values()})
        size = len(graph.nodes)
        self.lane: list[Lane | None] = [None] * size
        self.level = [(0, 0)] * size  # stage, and how deep in it
        self.key = [0] * size
        self.keys: dict[object, int] = {}
        self.packs: list[list[int]] = []
        self.pack: dict[int, tuple[int, int]] = {}
        self._waiting: dict[tuple[int, int], list[int]] = {}
        self._levels: list[tuple[int, int]] = []
        self._missing = [len(node.of) for node in graph.nodes]
        self._users: list[list[int]] = [[] for _ in graph.nodes]
        for k, node in enumerate(graph.nodes):
            for x in node.of:
                self._users[x].append(k)
        self._go_on([k for k in range(size) if not self._missing[k]])
        while self._levels:
            self._go_on(self._judge(self._waiting.pop(heappop(self._levels))))

    def whose(self, k: int) -> tuple[Lane, int] | None:
        """Whose a node is that other branches have alike, and which of theirs."""
        lane = self.lane[k]
        if lane is None:
            return None
        if k in self.pack:
            return lane, self.pack[k][0]
        node = self.graph.nodes[k]
        return (lane, -1 - self.key[k]) if not node.of and node.at in self.places else None

    def _go_on(self, ready: list[int]) -> None:
        """Settle nodes and all that is only waiting for them."""
        while ready:
            k = ready.pop()
            if self._settle(k):
                ready += self._freed(k)

    def _freed(self, k: int) -> list[int]:
        for user in self._users[k]:
            self._missing[user] -= 1
        return [x for x in dict.fromkeys(self._users[k]) if not self._missing[x]]

    def _settle(self, k: int) -> bool:
        """Whose a node is, unless that is seen only next to others of its level."""
        import casadi as cs

        node = self.graph.nodes[k]
        of = {self.lane[x] for x in node.of if self.lane[x] is not None}
        stage = max([self.level[x][0] for x in node.of], default=0)
        if node.operation == cs.OP_INPUT and node.at in self.places:
            self.lane[k], number = self.places[node.at]
            self._name(k, "input", node.at[0], number)
        elif len(of) == 1:
            depth = 1 + max(self.level[x][1] for x in node.of if self.level[x][0] == stage)
            (self.lane[k],), self.level[k] = of, (stage, depth)
            self._name(k, node.operation, *(self.key[x] for x in node.of))
            if node.operation in self.vectorized:
                if (stage, depth) not in self._waiting:
                    heappush(self._levels, (stage, depth))
                self._waiting.setdefault((stage, depth), []).append(k)
                return False
        else:
            self._share(k, stage + bool(of))
        return True

    def _judge(self, level: list[int]) -> list[int]:
        """Pack what all branches do; what is done in some is shared. Returns what is ready then."""
        alike: dict[int, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
        for k in sorted(level):
            lane = self.lane[k]
            assert lane is not None
            alike[self.key[k]][lane[1]].append(k)
        for found in alike.values():
            nodes = next(iter(found.values()))
            lane = self.lane[nodes[0]]
            assert lane is not None
            if len(found) == self.together[lane[0]] and {len(x) for x in found.values()} == {len(nodes)}:
                for x in zip(*self._in_one_order([found[at] for at in sorted(found)]), strict=True):
                    self.pack |= {node: (len(self.packs), at) for at, node in enumerate(x)}
                    self.packs.append(list(x))
            else:
                for k in (k for part in found.values() for k in part):
                    self._share(k, self.level[k][0] + 1)
        return [x for k in level for x in self._freed(k)]

    def _in_one_order(self, branches: list[list[int]]) -> list[list[int]]:
        """Nodes that do the same within a branch, in an order that is the same in each: by what they are of."""
        if len(branches[0]) == 1:
            return branches
        nodes = self.graph.nodes
        common = set.intersection(*({x for k in branch for x in nodes[k].of} for branch in branches))

        def place(x: int) -> tuple[int, ...]:
            if x in self.pack:
                return 0, self.pack[x][0]
            if x in common:
                return 1, x
            return (3,) if nodes[x].of else (2, *nodes[x].at)  # what else a branch has of its own stands in its order

        return [sorted(branch, key=lambda k: ([place(x) for x in nodes[k].of], k)) for branch in branches]

    def _share(self, k: int, stage: int) -> None:
        import casadi as cs

        node = self.graph.nodes[k]
        self.lane[k], self.level[k] = None, (stage, 0)
        self._name(k, "shared", node.value if node.operation == cs.OP_CONST else None)

    def _name(self, k: int, *what: object) -> None:
        """The same number for the same thing, in whatever branch of a group."""
        lane = self.lane[k]
        self.key[k] = self.keys.setdefault((lane and lane[0], what), len(self.keys))
