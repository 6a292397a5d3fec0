"""How the acceleration changes, written out: what depends on the state alone, and what is done along a direction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ckc_pin.codegen.branches import Places
from ckc_pin.codegen.graph import Graph, Lane
from ckc_pin.codegen.text import Alike, length, operations, result_lanes, split

__all__ = ["TOGETHER", "change_functions"]

TOGETHER, ALL = 4, -1  # directions; their group of lanes, which is no branches'


def change_functions(
    part: Mapping[str, Any],
    state: Mapping[str, Any],
    along: Mapping[str, Any],
    groups: Sequence[Sequence[int]],
    alike: Alike,
) -> tuple[dict[str, Any], Alike]:
    """Return CasADi functions that tell how the acceleration changes, and whose more of their arguments are.

    Parameters
    ----------
    part : mapping of str to casadi.SX
        `change` along a direction and `by_arguments` of what may be varied, where eq. 1 is solved; `acceleration_of_u`
        and `sound`.
    state : mapping of str to casadi.SX
        What they depend on beside the direction: q, trig, v, u and numbers.
    along : mapping of str to casadi.SX
        A direction, a step of q in tangent coordinates, the change of v, and `more`, and at last `varied`.
    groups : sequence of sequences of int
        What of the latter changes together: the columns of `by_arguments`.
    alike : mapping
        Whose the state's numbers are.

    Returns
    -------
    dict of str to casadi.Function
        `changes`, of several directions, only where alike branches do not already halve what one of them takes: one
        after the other costs less then than that much text does.
    mapping
    """
    import casadi as cs

    of, (step, v, more, varied) = [*state.values()], along.values()
    direction = cs.vertcat(step, v, more)
    every = cs.cse(cs.vertcat(part["change"], part["by_arguments"]))
    every, taken, made_of = cs.extract_parametric(every, cs.vertcat(*of))
    every = cs.cse(every)
    known = cs.vertcat(*taken, *_symbols_of(every, of))
    given_by = cs.substitute(known, cs.vertcat(*taken), cs.vertcat(*made_of))
    pivots = _divisors(cs.Function("change", [known, direction, varied], [every]))
    every = cs.substitute(every, known[pivots], 1 / known[pivots])  # they are inverted once a state
    given_by[pivots] = 1 / given_by[pivots]

    def of_state(given_by: Any) -> Any:
        gives = (given_by, part["acceleration_of_u"], part["sound"])
        parts = split(cs.cse(cs.vertcat(*gives)), [x.numel() for x in gives])
        return cs.Function("state", of, parts, [*state], ["known", "acceleration", "sound"])

    order = _side_by_side(known.numel(), result_lanes(of_state(given_by), "known", alike))
    known = cs.vertcat(*(cs.SX.sym("unread") if k is None else known[k] for k in order))
    given_by = cs.vertcat(*(cs.SX(np.nan) if k is None else given_by[k] for k in order))
    change, *by_arguments = split(every, [part["change"].numel(), *[more.numel()] * len(groups)])
    one = cs.Function("change", [known, direction], [change], ["known", "direction"], ["change"])
    sums = [cs.sum1(cs.fabs(varied[group])) for group in groups]
    found = {
        "state": of_state(given_by),
        "change": one,
        "groups": cs.Function("groups", [varied], [cs.vertcat(*sums)]),
    }
    found |= {f"varied_{k}": cs.Function(f"varied_{k}", [known, varied], [x]) for k, x in enumerate(by_arguments)}
    starts = {0: alike["v"], step.numel(): alike["v"], step.numel() + v.numel(): alike["u"]}
    whose: dict[str, Places] = {
        "direction": {start + k: x for start, places in starts.items() for k, x in places.items()},
        "known": result_lanes(found["state"], "known", alike),
    }
    if 2 * length(one, whose) > operations(one):
        found["changes"], whose["directions"] = _several(one)
    return found, whose


def _several(one: Any) -> tuple[Any, Places]:
    """Return code for several directions at a time, and whose their numbers are."""
    import casadi as cs

    known, direction = one.sx_in()
    directions = cs.SX.sym("directions", TOGETHER, direction.numel())
    together = cs.vertcat(*(one(known, directions[k, :].T).T for k in range(TOGETHER)))
    given, names = [known, cs.vec(directions)], (["shared", "directions"], ["changes"])
    whose = {k: ((ALL, k % TOGETHER), k // TOGETHER) for k in range(directions.numel())}
    return cs.Function("changes", given, [cs.vec(together)], *names), whose


def _divisors(function: Any) -> list[int]:
    """Return what of a function's first argument is only divided by."""
    import casadi as cs

    graph, uses = Graph.of(function), defaultdict(set)
    for node in graph.nodes:
        for at, x in enumerate(node.of):
            uses[x].add((node.operation, at))
    inputs = {k: node.at[1] for k, node in enumerate(graph.nodes) if node.operation == cs.OP_INPUT and not node.at[0]}
    return [at for k, at in inputs.items() if uses[k] and uses[k] <= {(cs.OP_DIV, 1), (cs.OP_INV, 0)}]


def _side_by_side(count: int, whose: Mapping[int, tuple[Lane, int]]) -> list[int | None]:
    """Order numbers so that those which alike branches have make vectors of two or four; None is a place left free."""
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k in sorted(whose, key=whose.__getitem__):
        (group, _), number = whose[k]
        alike[group, number].append(k)
    order: list[int | None] = []
    for together in alike.values():
        order += [*together, *[None] * (len(together) % 2)]
    return order + [k for k in range(count) if k not in whose]


def _symbols_of(x: Any, among: list[Any]) -> list[Any]:
    """Return those of the given symbols that an expression has in it."""
    import casadi as cs

    there = {symbol.element_hash() for symbol in cs.symvar(x)}
    return [symbol for symbol in cs.symvar(cs.vertcat(*among)) if symbol.element_hash() in there]
