"""A CasADi function as a graph of operations, and packs of operations that identical branches have in common."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import Any

__all__ = ["Graph", "Lane", "Node", "Packing"]

Lane = tuple[int, int]  # a group of identical branches, and a branch of it


@dataclass(frozen=True)
class Node:
    """An operation.

    Attributes
    ----------
    operation : int
        CasADi's code.
    operands : tuple of int
        Nodes.
    source : (int, int)
        Argument and place, of an input.
    value : float
        Of a constant.
    """

    operation: int
    operands: tuple[int, ...] = ()
    source: tuple[int, int] = (0, 0)
    value: float = 0.0


@dataclass(frozen=True)
class Graph:
    """Operations of a function in an order of evaluation.

    Attributes
    ----------
    nodes : list of Node
    results : list of ((int, int), int)
        Result and place in it, and the node that is written there.
    """

    nodes: list[Node]
    results: list[tuple[tuple[int, int], int]]

    @classmethod
    def from_function(cls, function: Any) -> Graph:
        """Read the instructions of a casadi.Function."""
        import casadi as cs

        nodes: list[Node] = []
        results: list[tuple[tuple[int, int], int]] = []
        in_memory: dict[int, int] = {}  # node by place in the function's working memory
        for k in range(function.n_instructions()):
            operation, outputs = function.instruction_id(k), function.instruction_output(k)
            inputs = function.instruction_input(k)
            if operation == cs.OP_OUTPUT:
                results.append(((outputs[0], outputs[1]), in_memory[inputs[0]]))
                continue
            if operation == cs.OP_INPUT:
                node = Node(operation, source=(inputs[0], inputs[1]))
            elif operation == cs.OP_CONST:
                node = Node(operation, value=function.instruction_constant(k))
            else:
                node = Node(operation, tuple(in_memory[x] for x in inputs))
            in_memory[outputs[0]] = len(nodes)
            nodes.append(node)
        return cls(nodes, results)

    def share_divisions(self) -> Graph:
        """Return the graph with one division for all quotients by the same node.

        CasADi turns every product with an inverse into a division, which costs as much as ten products.
        """
        import casadi as cs

        uses = Counter(node.operands[-1] for node in self.nodes if node.operation in (cs.OP_DIV, cs.OP_INV))
        nodes: list[Node] = []
        new_index: list[int] = []
        inverse: dict[int, int] = {}
        for node in self.nodes:
            operands = tuple(new_index[x] for x in node.operands)
            if node.operation in (cs.OP_DIV, cs.OP_INV) and uses[node.operands[-1]] > 1:
                if node.operands[-1] not in inverse:
                    inverse[node.operands[-1]] = len(nodes)
                    nodes.append(Node(cs.OP_INV, operands[-1:]))
                factor = inverse[node.operands[-1]]
                if node.operation == cs.OP_INV:
                    new_index.append(factor)
                    continue
                node, operands = replace(node, operation=cs.OP_MUL), (operands[0], factor)
            new_index.append(len(nodes))
            nodes.append(replace(node, operands=operands))
        return Graph(nodes, [(place, new_index[k]) for place, k in self.results])


class Packing:
    """Packs of nodes that do the same operation in identical branches, one node of each branch.

    Nodes are visited level by level. A node whose operands belong to one branch, or to one branch and the shared part,
    belongs to that branch, unless the other branches have no node like it. A node with operands of several branches is
    shared and begins a new stage. Nodes of one stage in different branches do not depend on each other, and of two
    nodes of one branch the later one is deeper.

    Parameters
    ----------
    graph : Graph
    lanes : mapping of (argument, place) to (lane, int)
        Inputs that belong to a branch, and the number that they share with the other branches' inputs.
    vectorized : set of int
        Operations that can be done on vectors.

    Attributes
    ----------
    packs : list of lists of int
    pack : dict of int to (int, int)
        By node: its pack, and its place in the pack.
    """

    def __init__(self, graph: Graph, lanes: Mapping[tuple[int, int], tuple[Lane, int]], vectorized: Set[int]) -> None:
        self.graph, self.lanes, self.vectorized = graph, lanes, vectorized
        self.group_sizes = Counter(group for group, _ in {lane for lane, _ in lanes.values()})
        size = len(graph.nodes)
        self.lane: list[Lane | None] = [None] * size
        self.level = [(0, 0)] * size  # stage, and depth in it
        self.key = [0] * size
        self.keys: dict[object, int] = {}
        self.packs: list[list[int]] = []
        self.pack: dict[int, tuple[int, int]] = {}
        self._waiting: dict[tuple[int, int], list[int]] = {}
        self._levels: list[tuple[int, int]] = []
        self._unresolved = [len(node.operands) for node in graph.nodes]
        self._users: list[list[int]] = [[] for _ in graph.nodes]
        for k, node in enumerate(graph.nodes):
            for x in node.operands:
                self._users[x].append(k)
        self._resolve_all([k for k in range(size) if not self._unresolved[k]])
        while self._levels:
            self._resolve_all(self._pack_level(self._waiting.pop(heappop(self._levels))))

    def lane_of(self, k: int) -> tuple[Lane, int] | None:
        """Return the lane of a node that has partners in the other branches, and the number that they share."""
        lane = self.lane[k]
        if lane is None:
            return None
        if k in self.pack:
            return lane, self.pack[k][0]
        node = self.graph.nodes[k]
        return (lane, -1 - self.key[k]) if not node.operands and node.source in self.lanes else None

    def _resolve_all(self, ready: list[int]) -> None:
        """Resolve nodes, and then the nodes that waited for them only."""
        while ready:
            k = ready.pop()
            if self._resolve(k):
                ready += self._release_users(k)

    def _release_users(self, k: int) -> list[int]:
        """Count down the unresolved operands of a node's users; return the users that have none left."""
        for user in self._users[k]:
            self._unresolved[user] -= 1
        return [x for x in dict.fromkeys(self._users[k]) if not self._unresolved[x]]

    def _resolve(self, k: int) -> bool:
        """Assign a node to a lane or to the shared part; return False if that depends on other nodes of its level."""
        import casadi as cs

        node = self.graph.nodes[k]
        operand_lanes = {self.lane[x] for x in node.operands if self.lane[x] is not None}
        stage = max([self.level[x][0] for x in node.operands], default=0)
        if node.operation == cs.OP_INPUT and node.source in self.lanes:
            self.lane[k], number = self.lanes[node.source]
            self._set_key(k, "input", node.source[0], number)
        elif len(operand_lanes) == 1:
            depth = 1 + max(self.level[x][1] for x in node.operands if self.level[x][0] == stage)
            (self.lane[k],), self.level[k] = operand_lanes, (stage, depth)
            self._set_key(k, node.operation, *(self.key[x] for x in node.operands))
            if node.operation in self.vectorized:
                if (stage, depth) not in self._waiting:
                    heappush(self._levels, (stage, depth))
                self._waiting.setdefault((stage, depth), []).append(k)
                return False
        else:
            self._make_shared(k, stage + bool(operand_lanes))
        return True

    def _pack_level(self, level: list[int]) -> list[int]:
        """Pack the nodes that all branches have, make the others shared, and return the nodes that are ready then."""
        by_key: dict[int, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
        for k in sorted(level):
            lane = self.lane[k]
            assert lane is not None
            by_key[self.key[k]][lane[1]].append(k)
        for by_branch in by_key.values():
            nodes = next(iter(by_branch.values()))
            lane = self.lane[nodes[0]]
            assert lane is not None
            is_in_all = len(by_branch) == self.group_sizes[lane[0]]
            if is_in_all and {len(x) for x in by_branch.values()} == {len(nodes)}:
                for x in zip(*self._align([by_branch[branch] for branch in sorted(by_branch)]), strict=True):
                    self.pack |= {node: (len(self.packs), place) for place, node in enumerate(x)}
                    self.packs.append(list(x))
            else:
                for k in (k for part in by_branch.values() for k in part):
                    self._make_shared(k, self.level[k][0] + 1)
        return [x for k in level for x in self._release_users(k)]

    def _align(self, branches: list[list[int]]) -> list[list[int]]:
        """Sort each branch's nodes with the same key by their operands, so that partners stand at the same place."""
        if len(branches[0]) == 1:
            return branches
        nodes = self.graph.nodes
        common = set.intersection(*({x for k in branch for x in nodes[k].operands} for branch in branches))

        def rank(x: int) -> tuple[int, ...]:
            if x in self.pack:
                return 0, self.pack[x][0]
            if x in common:
                return 1, x
            return (3,) if nodes[x].operands else (2, *nodes[x].source)  # other operands keep their branch's order

        return [sorted(branch, key=lambda k: ([rank(x) for x in nodes[k].operands], k)) for branch in branches]

    def _make_shared(self, k: int, stage: int) -> None:
        import casadi as cs

        node = self.graph.nodes[k]
        self.lane[k], self.level[k] = None, (stage, 0)
        self._set_key(k, "shared", node.value if node.operation == cs.OP_CONST else None)

    def _set_key(self, k: int, *description: object) -> None:
        """Give nodes with the same description the same key, in whatever branch of a group they are."""
        lane = self.lane[k]
        self.key[k] = self.keys.setdefault((lane and lane[0], description), len(self.keys))
