"""Directional derivatives of the acceleration as CasADi functions.

What depends on the state alone is computed once a state, the rest once a direction.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ckc_pin.codegen.branches import Lanes
from ckc_pin.codegen.c_source import LaneMap, count_operations, count_statements, split_column, trace_result_lanes
from ckc_pin.codegen.graph import Graph, Lane

__all__ = ["DIRECTIONS", "derivative_functions"]

DIRECTIONS = 4  # computed together by `changes`
DIRECTION_LANES = -1  # their group of lanes, which is no group of branches


def derivative_functions(
    expressions: Mapping[str, Any],
    state: Mapping[str, Any],
    direction: Mapping[str, Any],
    groups: Sequence[Sequence[int]],
    lanes: LaneMap,
) -> tuple[dict[str, Any], LaneMap]:
    """Return the functions of the acceleration's directional derivative, and the lanes of their arguments.

    Parameters
    ----------
    expressions : mapping of str to casadi.SX
        `change` along a direction and `by_arguments` of the mechanism's numbers, where eq. 1 is solved;
        `acceleration_of_u` and `sound`.
    state : mapping of str to casadi.SX
        Symbols that these depend on beside the direction: q, trig, v, u and numbers.
    direction : mapping of str to casadi.SX
        A step of q in tangent coordinates, the change of v, `more`, and `varied`, the change of the numbers.
    groups : sequence of sequences of int
        Entries of `varied` that change together: the columns of `by_arguments`.
    lanes : mapping
        Lanes of the state's symbols.

    Returns
    -------
    dict of str to casadi.Function
        `changes`, of several directions at a time, is left out where the vectors of identical branches already halve
        the work of one direction: one direction after the other then costs less than that much code does.
    mapping
    """
    import casadi as cs

    state_symbols, (step, v, more, parameter_direction) = [*state.values()], direction.values()
    motion = cs.vertcat(step, v, more)
    derivatives = cs.cse(cs.vertcat(expressions["change"], expressions["by_arguments"]))
    derivatives, extracted, extracted_values = cs.extract_parametric(derivatives, cs.vertcat(*state_symbols))
    derivatives = cs.cse(derivatives)
    state_values = cs.vertcat(*extracted, *_symbols_in(derivatives, state_symbols))
    state_expressions = cs.substitute(state_values, cs.vertcat(*extracted), cs.vertcat(*extracted_values))
    pivots = _find_divisors(cs.Function("change", [state_values, motion, parameter_direction], [derivatives]))
    derivatives = cs.substitute(
        derivatives, state_values[pivots], 1 / state_values[pivots]
    )  # pivots are inverted once a state
    state_expressions[pivots] = 1 / state_expressions[pivots]

    def state_function(state_expressions: Any) -> Any:
        results = (state_expressions, expressions["acceleration_of_u"], expressions["sound"])
        parts = split_column(cs.cse(cs.vertcat(*results)), [x.numel() for x in results])
        return cs.Function("state", state_symbols, parts, [*state], ["known", "acceleration", "sound"])

    order = _order_for_vectors(
        state_values.numel(), trace_result_lanes(state_function(state_expressions), "known", lanes)
    )
    state_values = cs.vertcat(*(cs.SX.sym("unread") if k is None else state_values[k] for k in order))
    state_expressions = cs.vertcat(*(cs.SX(np.nan) if k is None else state_expressions[k] for k in order))
    change, *by_arguments = split_column(derivatives, [expressions["change"].numel(), *[more.numel()] * len(groups)])
    one = cs.Function("change", [state_values, motion], [change], ["known", "direction"], ["change"])
    sums = [cs.sum1(cs.fabs(parameter_direction[group])) for group in groups]
    functions = {
        "state": state_function(state_expressions),
        "change": one,
        "groups": cs.Function("groups", [parameter_direction], [cs.vertcat(*sums)]),
    }
    functions |= {
        f"varied_{k}": cs.Function(f"varied_{k}", [state_values, parameter_direction], [x])
        for k, x in enumerate(by_arguments)
    }
    starts = {0: lanes["v"], step.numel(): lanes["v"], step.numel() + v.numel(): lanes["u"]}
    new_lanes: dict[str, Lanes] = {
        "direction": {start + k: x for start, places in starts.items() for k, x in places.items()},
        "known": trace_result_lanes(functions["state"], "known", lanes),
    }
    if 2 * count_statements(one, new_lanes) > count_operations(one):
        functions["changes"], new_lanes["directions"] = _several_directions(one)
    return functions, new_lanes


def _several_directions(one: Any) -> tuple[Any, Lanes]:
    """Return the function of several directions at a time, and the lanes of the directions' entries."""
    import casadi as cs

    state_values, direction = one.sx_in()
    directions = cs.SX.sym("directions", DIRECTIONS, direction.numel())
    results = cs.vertcat(*(one(state_values, directions[k, :].T).T for k in range(DIRECTIONS)))
    arguments, names = [state_values, cs.vec(directions)], (["shared", "directions"], ["changes"])
    lanes = {k: ((DIRECTION_LANES, k % DIRECTIONS), k // DIRECTIONS) for k in range(directions.numel())}
    return cs.Function("changes", arguments, [cs.vec(results)], *names), lanes


def _find_divisors(function: Any) -> list[int]:
    """Return the entries of a function's first argument that occur only as divisors."""
    import casadi as cs

    graph, uses = Graph.from_function(function), defaultdict(set)
    for node in graph.nodes:
        for place, x in enumerate(node.operands):
            uses[x].add((node.operation, place))
    inputs = {
        k: node.source[1] for k, node in enumerate(graph.nodes) if node.operation == cs.OP_INPUT and not node.source[0]
    }
    return [entry for k, entry in inputs.items() if uses[k] and uses[k] <= {(cs.OP_DIV, 1), (cs.OP_INV, 0)}]


def _order_for_vectors(count: int, lanes: Mapping[int, tuple[Lane, int]]) -> list[int | None]:
    """Order numbers so that partners of identical branches make vectors of two or four; None is an unused place."""
    partners: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k in sorted(lanes, key=lanes.__getitem__):
        (group, _), number = lanes[k]
        partners[group, number].append(k)
    order: list[int | None] = []
    for together in partners.values():
        order += [*together, *[None] * (len(together) % 2)]
    return order + [k for k in range(count) if k not in lanes]


def _symbols_in(x: Any, candidates: list[Any]) -> list[Any]:
    """Return the candidate symbols that occur in an expression."""
    import casadi as cs

    occurring = {symbol.element_hash() for symbol in cs.symvar(x)}
    return [symbol for symbol in cs.symvar(cs.vertcat(*candidates)) if symbol.element_hash() in occurring]
