"""A mechanism's terms as C: one function a term, without dependencies but the C library's mathematics."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.generated.acceleration import acceleration
from ckc_pin.generated.expressions import Expressions, expressions
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FUNCTIONS", "functions", "source"]

# name: arguments and results of the C functions, beside `numbers`; matrices are dense, by columns
FUNCTIONS = {
    "place": (("q",), ("phi", "J")),
    "inertia": (("q",), ("D_tree",)),
    "bias": (("q", "v"), ("bias_tree", "J_dot_v", "damping")),
    "jacobian_rate": (("q", "v"), ("J_dot",)),
    "potential_energy": (("q",), ("potential",)),
    "acceleration": (("q", "v", "u", "correction"), ("acceleration", "share")),
}


def functions(mechanism: Mechanism) -> dict[str, Any]:
    """Return CasADi functions: `numbers`, from what may be varied to what the others take last, and `FUNCTIONS`."""
    import casadi as cs

    terms = expressions(mechanism)
    symbols = {
        "q": terms.q,
        "v": terms.v,
        "u": cs.SX.sym("u", mechanism.n),
        "correction": cs.SX.sym("correction", mechanism.closure.rows),
    }
    results = _results(terms, symbols)
    parameters = terms.parameters.vector
    # what does not change with the state is computed once
    alike, alone, made_of = cs.extract_parametric(cs.vertcat(*(cs.vec(x) for x in results.values())), parameters)
    once = cs.vertcat(parameters, *alone)
    found = {"numbers": cs.Function("numbers", [parameters], [cs.vertcat(parameters, *made_of)])}
    part = dict(zip(results, _split(alike, [x.numel() for x in results.values()]), strict=True))
    for name, (takes, gives) in FUNCTIONS.items():
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
    found, shares = acceleration(terms, symbols["u"], symbols["correction"])
    return {
        name: cs.densify(x)
        for name, x in {
            "phi": rows.phi,
            "J": rows.J,
            "D_tree": terms.D_tree,
            "bias_tree": terms.bias_tree,
            "J_dot_v": rows.J_dot_v,
            "damping": terms.damping,
            "J_dot": cs.reshape(cs.jtimes(cs.vec(rows.J), terms.q, terms.q_dot), rows.J.shape),
            "potential": terms.potential,
            "acceleration": found,
            "share": cs.mmin(cs.vertcat(*shares)),
        }.items()
    }


def source(found: dict[str, Any]) -> str:
    """Return the C text of functions."""
    import casadi as cs

    generator = cs.CodeGenerator("written.c", {"with_header": False, "casadi_int": "long long int"})
    for function in found.values():
        generator.add(function)
    return str(generator.dump())
