"""A mechanism's terms as C: one function a term, without dependencies but the C library's mathematics."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.generated.acceleration import ConstrainedInertia
from ckc_pin.generated.expressions import Expressions, expressions
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import BoolArray

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
LARGEST_JACOBIAN = 3e4  # operations of the acceleration times n, about twice those of its derivatives: above, none


def functions(mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None) -> dict[str, Any]:
    """Return CasADi functions: `numbers`, from what may be varied to what the others take last, and `FUNCTIONS`.

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
    results = _results(terms, symbols)
    parameters = terms.arguments.vector
    # what does not change with the state is computed once
    alike, alone, made_of = cs.extract_parametric(cs.vertcat(*(cs.vec(x) for x in results.values())), parameters)
    once = cs.vertcat(parameters, *alone)
    found = {"numbers": cs.Function("numbers", [parameters], [cs.vertcat(parameters, *made_of)])}
    part = dict(zip(results, _split(alike, [x.numel() for x in results.values()]), strict=True))
    for name, (given, gives) in FUNCTIONS.items():
        if not part.keys() >= {*gives}:
            continue
        takes = ("q", "trig", *given[1:])
        together = cs.cse(cs.vertcat(*(part[x] for x in gives)))
        parts = _split(together, [results[x].numel() for x in gives])
        found[name] = cs.Function(name, [*(symbols[x] for x in takes), once], parts, [*takes, "numbers"], list(gives))
    return found


def _split(column: Any, sizes: list[int]) -> list[Any]:
    import casadi as cs

    return list(cs.vertsplit(column, [0, *np.cumsum(sizes).tolist()]))


def _results(terms: Expressions, symbols: dict[str, Any]) -> dict[str, Any]:
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
    return {name: cs.densify(x) for name, x in found.items()}


def source(found: dict[str, Any]) -> str:
    """Return the C text of functions, all of whose arguments and results are asked for when they are called."""
    import casadi as cs

    generator = cs.CodeGenerator("written.c", {"with_header": False, "casadi_int": "long long int"})
    for function in found.values():
        generator.add(function)
    text = re.sub(r"(arg\[\d+\])\? (\1\[\d+\]) : 0", r"\2", str(generator.dump()))
    return re.sub(r"if \((res\[\d+\])!=0\) (\1\[\d+\]=)", r"\2", text)
