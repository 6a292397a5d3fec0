"""A mechanism's terms as C: one function a term, without dependencies but the C library's mathematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.acceleration import ConstrainedInertia
from ckc_pin.codegen.branches import Places, alike_branches, alike_numbers, alike_roots
from ckc_pin.codegen.changes import change_functions
from ckc_pin.codegen.expressions import Expressions, expressions
from ckc_pin.codegen.text import Alike, result_lanes, split, text
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FUNCTIONS", "Code"]

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


@dataclass(frozen=True)
class Code:
    """What is written out of a mechanism.

    `numbers`, from what may be varied to what the others take last, and `FUNCTIONS`. Left out are `coriolis` of a tree
    with a free root, whose twist has several C', and `jacobian` where it would be too long to be compiled.

    With changes also how the acceleration changes along any direction: `state` of (q, trig, v, u, numbers) gives what
    does not depend on the direction, the acceleration, and whether it is sound; `change` takes the first of these and
    a direction, a step of q', changes of v' and `more`: of u', and of J v'_dot by the rows that are kept. `changes`,
    there where it is worth its text, does so of `TOGETHER` directions, each number's side by side as in its result.
    Of what may be varied, `more` is the sum of what `varied_K` gives, for each group K that changes at all; `groups`
    of a change tells by how much.

    Attributes
    ----------
    functions : dict of str to casadi.Function
    alike : mapping
        Whose their arguments are that alike branches have.
    """

    functions: dict[str, Any]
    alike: Alike

    @classmethod
    def of(cls, mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None, *, changes: bool = False) -> Code:
        """Write a mechanism out, of the numbers that are arguments (`arguments.present`)."""
        import casadi as cs

        alike = dict(alike_branches(mechanism.tree))
        terms = expressions(mechanism, which, alike_roots(mechanism.tree, alike))
        symbols = {
            "q": terms.angles.q,
            "trig": terms.angles.trig,
            "v": terms.v,
            "u": cs.SX.sym("u", mechanism.n),
            "correction": cs.SX.sym("correction", mechanism.closure.rows),
            "residual": cs.SX.sym("residual", mechanism.closure.rows),
            "x": cs.SX.sym("x", mechanism.n),
        }
        along = {
            "step": cs.SX.sym("step", mechanism.n),
            "v": cs.SX.sym("v_change", mechanism.n),
            "more": cs.SX.sym("more", mechanism.n + len(terms.kept)),
            "varied": cs.SX.sym("varied", terms.arguments.vector.numel()),
        }
        results = _results(terms, symbols, along if changes else None)
        every, once, found, alike["numbers"] = _once(mechanism, terms, results, alike)
        part = dict(zip(results, split(every, [x.numel() for x in results.values()]), strict=True))
        for name, (given, gives) in FUNCTIONS.items():
            if not part.keys() >= {*gives}:
                continue
            takes = {x: symbols[x] for x in ("q", "trig", *given[1:])} | {"numbers": once}
            together = cs.cse(cs.vertcat(*(part[x] for x in gives)))
            parts = split(together, [results[x].numel() for x in gives])
            found[name] = cs.Function(name, [*takes.values()], parts, [*takes], list(gives))
        if changes:
            state = {name: symbols[name] for name in ("q", "trig", "v", "u")} | {"numbers": once}
            more, whose = change_functions(part, state, along, terms.arguments.groups, alike)
            found, alike = found | more, {**alike, **whose}
        return cls(found, alike)

    def text(self) -> str:
        """The C text."""
        return text([*self.functions.values()], self.alike)


def _once(
    mechanism: Mechanism, terms: Expressions, results: Mapping[str, Any], alike: Mapping[str, Places]
) -> tuple[Any, Any, dict[str, Any], Places]:
    """What does not change with the state is computed once: the other results, what they take, and what gives that."""
    import casadi as cs

    arguments, turns = terms.arguments.vector, terms.turns
    own = cs.vertcat(arguments, *turns.symbols)
    every, alone, made_of = cs.extract_parametric(cs.vertcat(*(cs.vec(x) for x in results.values())), own)
    given = cs.vertcat(own, *made_of)
    numbers = cs.Function("numbers", [own], [given], ["own"], ["numbers"])
    whose = result_lanes(numbers, "numbers", {"own": alike_numbers(mechanism, terms.arguments, turns, alike)})
    given = cs.substitute(given, cs.vertcat(*turns.symbols), cs.DM(turns.values))
    return every, cs.vertcat(own, *alone), {"numbers": cs.Function("numbers", [arguments], [given])}, whose


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
    step, v, more, varied = along.values()
    moved = cs.substitute(terms.q_dot, terms.v, step)
    found["change"] = inertia.change(symbols["u"], moved, v, more)
    found["by_arguments"] = inertia.by_arguments(symbols["u"], varied)
    return {name: cs.densify(x) for name, x in found.items()}
