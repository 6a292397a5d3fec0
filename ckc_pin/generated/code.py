"""A mechanism's terms as C: one function a term, without dependencies but the C library's mathematics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.generated.acceleration import ConstrainedInertia
from ckc_pin.generated.branches import alike_branches
from ckc_pin.generated.expressions import Expressions, expressions
from ckc_pin.generated.graph import Graph, Lane
from ckc_pin.generated.text import Alike, result_lanes, text
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import BoolArray, Tree

__all__ = ["FUNCTIONS", "functions", "source"]

# name: arguments and results of the C functions; matrices are dense, by columns. After q each takes the cosines and
# sines of its numbers, at last what `numbers` gives.
FUNCTIONS = {
    "place": (("q",), ("phi", "J")),
    "inertia": (("q",), ("D_tree",)),
    "bias": (("q", "v"), ("bias_tree", "J_dot_v", "damping")),
    "jacobian_rate": (("q", "v"), ("J_dot",)),
    "rest": (("q",), ("h_tree",)),
    "coriolis": (("q", "v", "x"), ("C_x",)),
    "potential_energy": (("q",), ("potential",)),
    "acceleration": (("q", "v", "u", "correction"), ("acceleration", "sound")),
    "closing_step": (("q", "residual"), ("step", "sound")),
    "jacobian": (("q", "v", "u"), ("by_state", "by_u", "sound")),
}
TOGETHER, ALL = 4, -1  # directions; their group of lanes, which is no branches'
LARGEST_JACOBIAN = 3e4  # operations of the acceleration times n, about twice those of its derivatives: above, none


def functions(
    mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None, *, changes: bool = False
) -> dict[str, Any]:
    """Return CasADi functions: `numbers`, from what may be varied to what the others take last, and `FUNCTIONS`.

    With `changes` also how the acceleration changes along any direction of q', v', u' and of what may be varied:
    `state` of (q, trig, v, u, numbers) gives what does not depend on the direction, the acceleration, and whether it is
    sound; `change` takes the first of these and a direction: changes of q', v', u' and of what may be varied. So does
    `changes`, of `TOGETHER` directions, each number's side by side as in its result.

    Left out are `coriolis` of a tree with a free root, whose twist has several C', and `jacobian` where it would be too
    long to be compiled.
    """
    import casadi as cs

    terms = expressions(mechanism, which)
    symbols = {
        "q": terms.angles.q,
        "trig": terms.angles.trig,
        "v": terms.v,
        "u": cs.SX.sym("u", mechanism.n),
        "correction": cs.SX.sym("correction", mechanism.closure.rows),
        "residual": cs.SX.sym("residual", mechanism.closure.rows),
        "x": cs.SX.sym("x", mechanism.n),
    }
    arguments = terms.arguments.vector
    along = {
        "q": cs.SX.sym("q_change", mechanism.tree.nq),
        "v": cs.SX.sym("v_change", mechanism.n),
        "force": cs.SX.sym("u_change", mechanism.n),
        "arguments": cs.SX.sym("arguments_change", arguments.numel()),
    }
    results = _results(terms, symbols, along if changes else None)
    # what does not change with the state is computed once
    alike, alone, made_of = cs.extract_parametric(cs.vertcat(*(cs.vec(x) for x in results.values())), arguments)
    once = cs.vertcat(arguments, *alone)
    found = {"numbers": cs.Function("numbers", [arguments], [cs.vertcat(arguments, *made_of)])}
    part = dict(zip(results, _split(alike, [x.numel() for x in results.values()]), strict=True))
    for name, (given, gives) in FUNCTIONS.items():
        if not part.keys() >= {*gives}:
            continue
        takes = ("q", "trig", *given[1:])
        together = cs.cse(cs.vertcat(*(part[x] for x in gives)))
        parts = _split(together, [results[x].numel() for x in gives])
        found[name] = cs.Function(name, [*(symbols[x] for x in takes), once], parts, [*takes, "numbers"], list(gives))
    if changes:
        state = {name: symbols[name] for name in ("q", "trig", "v", "u")} | {"numbers": once}
        found |= _changes(part, state, cs.vertcat(*along.values()), alike_branches(mechanism.tree))
    return found


def _changes(part: Mapping[str, Any], state: Mapping[str, Any], direction: Any, alike: Alike) -> dict[str, Any]:
    """Return what tells how the acceleration changes: `state`, `change` and `changes`."""
    import casadi as cs

    of = [*state.values()]
    change, taken, made_of = cs.extract_parametric(cs.cse(part["change"]), cs.vertcat(*of))
    change = cs.cse(change)
    known = cs.vertcat(*taken, *_symbols_of(change, of))
    given_by = cs.substitute(known, cs.vertcat(*taken), cs.vertcat(*made_of))
    pivots = _divisors(cs.Function("change", [known, direction], [change]))
    change = cs.substitute(change, known[pivots], 1 / known[pivots])  # they are inverted once a state
    given_by[pivots] = 1 / given_by[pivots]

    def of_state(given_by: Any) -> Any:
        gives = (given_by, part["acceleration_of_u"], part["sound"])
        parts = _split(cs.cse(cs.vertcat(*gives)), [x.numel() for x in gives])
        return cs.Function("state", of, parts, [*state], ["known", "acceleration", "sound"])

    order = _side_by_side(known.numel(), result_lanes(of_state(given_by), "known", alike))
    known = cs.vertcat(*(cs.SX.sym("unread") if k is None else known[k] for k in order))
    given_by = cs.vertcat(*(cs.SX(np.nan) if k is None else given_by[k] for k in order))
    one = cs.Function("change", [known, direction], [change], ["known", "direction"], ["change"])
    directions = cs.SX.sym("directions", TOGETHER, direction.numel())
    every = cs.vertcat(*(one(known, directions[k, :].T).T for k in range(TOGETHER)))
    several = cs.Function(
        "changes", [known, cs.vec(directions)], [cs.vec(every)], ["shared", "directions"], ["changes"]
    )
    return {"state": of_state(given_by), "change": one, "changes": several}


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


def _split(column: Any, sizes: list[int]) -> list[Any]:
    import casadi as cs

    return list(cs.vertsplit(column, [0, *np.cumsum(sizes).tolist()]))


def _results(terms: Expressions, symbols: dict[str, Any], along: dict[str, Any] | None) -> dict[str, Any]:
    import casadi as cs

    rows = terms.rows
    inertia = ConstrainedInertia(terms)
    acceleration, _ = inertia.acceleration(symbols["u"], symbols["correction"])
    found = {
        "phi": rows.phi,
        "J": rows.J,
        "D_tree": terms.D_tree,
        "bias_tree": terms.bias_tree,
        "J_dot_v": rows.J_dot_v,
        "damping": terms.damping,
        "J_dot": cs.reshape(terms.angles.along(cs.vec(rows.J), terms.q_dot), rows.J.shape),
        "h_tree": cs.substitute(terms.bias_tree, terms.v, cs.DM.zeros(terms.v.numel())),
        "potential": terms.potential,
        "acceleration": acceleration,
        "sound": inertia.soundness(),
        "step": inertia.closing_step(symbols["residual"]),
    }
    if not terms.quaternions:  # Christoffel's symbols: the bias is quadratic in v'
        found["C_x"] = cs.jtimes(terms.bias_tree, terms.v, symbols["x"]) / 2
    if cs.n_nodes(acceleration) * terms.v.numel() < LARGEST_JACOBIAN:
        found["by_state"], found["by_u"] = inertia.derivatives(symbols["u"])
    if along is None:
        return {name: cs.densify(x) for name, x in found.items()}
    found["acceleration_of_u"] = inertia.acceleration(symbols["u"], cs.SX(rows.phi.numel(), 1))[0]  # uncorrected
    found["change"] = inertia.change(symbols["u"], **along)
    return {name: cs.densify(x) for name, x in found.items()}


def source(found: Mapping[str, Any], tree: Tree) -> str:
    """Return the C text of a mechanism's functions."""
    return text(list(found.values()), _alike(found, tree))


def _alike(found: Mapping[str, Any], tree: Tree) -> Alike:
    """Which arguments of the functions alike branches have, and which several directions."""
    alike = dict(alike_branches(tree))
    if "changes" in found:
        starts = {"q": 0, "v": tree.nq, "u": tree.nq + tree.n}
        alike["direction"] = {start + k: x for name, start in starts.items() for k, x in alike[name].items()}
        alike["known"] = result_lanes(found["state"], "known", alike)
        several = range(found["changes"].numel_in(1))
        alike["directions"] = {k: ((ALL, k % TOGETHER), k // TOGETHER) for k in several}
    return alike
