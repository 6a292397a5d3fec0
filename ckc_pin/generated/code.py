"""A mechanism's terms as C: one function a term, without dependencies but the C library's mathematics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.generated.acceleration import ConstrainedInertia
from ckc_pin.generated.branches import alike_branches
from ckc_pin.generated.expressions import Expressions, expressions
from ckc_pin.generated.text import text
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
    sound; `change` takes the first of these, and `TOGETHER` directions at a time, each number's side by side as in its
    result: changes of q', v', u' and of what may be varied.

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
        state, columns = [*(symbols[x] for x in ("q", "trig", "v", "u")), once], symbols.get("columns", cs.SX(0, 1))
        change, taken, made_of = cs.extract_parametric(cs.cse(part["change"]), cs.vertcat(*state))
        known = cs.vertcat(columns, *taken, *_symbols_of(change, state))
        given_by = cs.vertcat(part.get("columns", cs.SX(0, 1)), *made_of)
        given_by = cs.substitute(known, cs.vertcat(columns, *taken), given_by)
        whole = cs.cse(cs.vertcat(given_by, part["acceleration_of_u"], part["sound"]))
        sizes = [known.numel(), mechanism.n, 1]
        found["state"] = cs.Function(
            "state", state, _split(whole, sizes), ["q", "trig", "v", "u", "numbers"], ["known", "acceleration", "sound"]
        )
        found["change"] = _of_several(known, cs.vertcat(*along.values()), cs.cse(change))
    return found


def _of_several(known: Any, direction: Any, change: Any) -> Any:
    import casadi as cs

    one = cs.Function("one", [known, direction], [change])
    directions = cs.SX.sym("directions", TOGETHER, direction.numel())
    changes = cs.vertcat(*(one(known, directions[k, :].T).T for k in range(TOGETHER)))
    return cs.Function("change", [known, cs.vec(directions)], [cs.vec(changes)], ["known", "directions"], ["changes"])


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
    columns = None
    if "by_state" in found:  # short enough: what they are once a state, and a product a direction
        columns = inertia.columns(symbols["u"], cs.vertcat(terms.v, terms.arguments.vector))
        found["columns"] = cs.vertcat(*columns.nonzeros())
        symbols["columns"] = cs.SX.sym("columns", columns.nnz())
        columns = cs.SX(columns.sparsity(), symbols["columns"])
    found["acceleration_of_u"] = inertia.acceleration(symbols["u"], cs.SX(rows.phi.numel(), 1))[0]  # uncorrected
    found["change"] = inertia.change(symbols["u"], **along, columns=columns)
    return {name: cs.densify(x) for name, x in found.items()}


def source(found: Mapping[str, Any], tree: Tree) -> str:
    """Return the C text of a mechanism's functions."""
    alike = dict(alike_branches(tree))
    if "change" in found:
        places = range(found["change"].numel_in(1))
        alike["directions"] = {k: ((ALL, k % TOGETHER), k // TOGETHER) for k in places}
    return text(list(found.values()), alike)
