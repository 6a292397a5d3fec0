"""CasADi functions of a mechanism's terms, one C function each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ckc_pin.base.arrays import BoolArray
from ckc_pin.codegen.acceleration import ConstrainedInertia
from ckc_pin.codegen.branches import Lanes, assign_argument_lanes, find_identical_branches, group_roots
from ckc_pin.codegen.c_source import LaneMap, split_column, trace_result_lanes, write_c_source
from ckc_pin.codegen.derivatives import derivative_functions
from ckc_pin.codegen.expressions import TermExpressions, term_expressions
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FUNCTIONS", "PORTABLE_FUNCTIONS", "TermFunctions"]

# By name of the C function: arguments and results. Matrices are dense, by columns. After q, each function takes the
# cosines and sines of its entries; the last argument is the result of `numbers`.
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
# Functions of which the library may have a second version that computes several members of an ensemble in one call:
# those that an integration step evaluates at its stages, and those that it evaluates at its end. The core uses the
# latter only if the closure has the two rows of one planar loop.
STAGE_OF_MEMBERS = ("acceleration",)
END_OF_MEMBERS = ("place", "closing_step", "inertia", "potential_energy", "jacobian_rate")
ROWS_OF_ONE_LOOP = 2
# Of exported C. `bilinear` is the polarization of the terms that are quadratic in v': symmetric in v and x, and for
# x = v equal to C' v' and J_dot v'. Projected by rho^T, it gives C x of eq. 6 for trees with and without a free root.
PORTABLE_FUNCTIONS = {
    name: FUNCTIONS[name] for name in ("place", "inertia", "bias", "rest", "potential_energy", "acceleration")
} | {"bilinear": (("q", "v", "x"), ("bias_x", "J_dot_x")), "points": (("q", "v"), ("positions", "velocities"))}
# Of exported FMUs: derivatives along a `step` of q' in tangent coordinates and a change of v'. `residual_change` is
# that of eq. 1 at an acceleration `a` and the kept rows' `multipliers`; `loop_rate_change` of the kept rows of J v'.
PORTABLE_DERIVATIVES = {
    "residual_change": (("q", "v", "a", "multipliers", "step", "v_change"), ("residual_change",)),
    "loop_rate_change": (("q", "v", "step"), ("loop_rate_change",)),
    "point_changes": (("q", "v", "step", "v_change"), ("position_changes", "velocity_changes")),
    "energy_changes": (("q", "v", "step", "v_change"), ("kinetic_change", "potential_change")),
}
# Limit of (operations of the acceleration) * n, about twice the operations of its derivatives. `jacobian` is left out
# above it.
MAX_JACOBIAN_OPERATIONS = 3e4


@dataclass(frozen=True)
class TermFunctions:
    """CasADi functions of one mechanism's terms, from which its C library is written.

    - `numbers` maps the mechanism's parameters to the last argument of the other functions.
    - `FUNCTIONS` are the terms. `coriolis` is left out of a tree with a free root, whose twist has several C'.
      `jacobian` is left out where it would take too long to compile.

    With `of_members`, the functions of `STAGE_OF_MEMBERS` are also written for several members of an ensemble at a
    time, and for a closure of two rows those of `END_OF_MEMBERS`.

    With `directional_derivatives`, there are also directional derivatives of the acceleration:

    - `state` of (q, trig, v, u, numbers) gives what does not depend on the direction, the acceleration, and whether it
      is accurate.
    - `change` takes the first of these and a direction: a step of q', changes of v' and `more`, the changes of u' and
      of J v'_dot by the kept rows.
    - `changes` does the same for `derivatives.DIRECTIONS` directions, the entries of the directions interleaved as in
      its result. It is written only where it is worth its code.
    - `varied_K` gives the part of `more` due to a change of the numbers of group K, and `groups` by how much the
      numbers of each group change.

    Attributes
    ----------
    functions : dict of str to casadi.Function
    lanes : mapping
        Lanes of the arguments that belong to identical branches.
    of_members : bool
    """

    functions: dict[str, Any]
    lanes: LaneMap
    of_members: bool = False

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        which: Mapping[str, BoolArray] | None = None,
        *,
        directional_derivatives: bool = False,
        of_members: bool = False,
        portable: bool = False,
    ) -> TermFunctions:
        """Derive a mechanism's functions.

        Parameters
        ----------
        mechanism : Mechanism
        which : mapping, optional
            Numbers that are arguments (`arguments.present`).
        directional_derivatives : bool
            Whether to add directional derivatives.
        of_members : bool
            Whether to add functions of several members at a time.
        portable : bool
            Whether to derive `PORTABLE_FUNCTIONS`, for code without vectors of identical branches; with
            `directional_derivatives` also `PORTABLE_DERIVATIVES`.

        Raises
        ------
        InputError
            CasADi is not installed.
        """
        try:
            import casadi as cs
        except ModuleNotFoundError as error:
            message = "compiled terms need CasADi, which is not installed: pip install ckc_pin[symbolic]"
            raise InputError(message) from error
        lanes = dict(find_identical_branches(mechanism.tree))
        terms = term_expressions(mechanism, which, () if portable else group_roots(mechanism.tree, lanes))
        table = PORTABLE_FUNCTIONS | PORTABLE_DERIVATIVES if portable else FUNCTIONS
        symbols = {
            "q": terms.configuration.q,
            "trig": terms.configuration.trig,
            "v": terms.v,
            "u": cs.SX.sym("u", mechanism.n),
            "correction": cs.SX.sym("correction", mechanism.closure.rows),
            "residual": cs.SX.sym("residual", mechanism.closure.rows),
            "x": cs.SX.sym("x", mechanism.n),
            "a": cs.SX.sym("a", mechanism.n),
            "multipliers": cs.SX.sym("multipliers", len(terms.kept)),
        }
        direction = {
            "step": cs.SX.sym("step", mechanism.n),
            "v": cs.SX.sym("v_change", mechanism.n),
            "more": cs.SX.sym("more", mechanism.n + len(terms.kept)),
            "varied": cs.SX.sym("varied", terms.arguments.vector.numel()),
        }
        symbols |= {"step": direction["step"], "v_change": direction["v"]}
        results = _results(terms, symbols, direction if directional_derivatives else None, portable)
        column, numbers, functions, lanes["numbers"] = _extract_numbers(mechanism, terms, results, lanes)
        parts = dict(zip(results, split_column(column, [x.numel() for x in results.values()]), strict=True))
        for name, (arguments, outputs) in table.items():
            if not parts.keys() >= {*outputs}:
                continue
            inputs = {x: symbols[x] for x in ("q", "trig", *arguments[1:])} | {"numbers": numbers}
            outputs_column = cs.cse(cs.vertcat(*(parts[x] for x in outputs)))
            values = split_column(outputs_column, [results[x].numel() for x in outputs])
            functions[name] = cs.Function(name, [*inputs.values()], values, [*inputs], list(outputs))
        if directional_derivatives and not portable:
            state = {name: symbols[name] for name in ("q", "trig", "v", "u")} | {"numbers": numbers}
            groups = terms.arguments.groups
            derivatives, new_lanes = derivative_functions(parts, state, direction, groups, lanes)
            functions, lanes = functions | derivatives, {**lanes, **new_lanes}
        return cls(functions, lanes, of_members)

    def c_source(self) -> str:
        """Return the C source of all functions."""
        names: tuple[str, ...] = STAGE_OF_MEMBERS if self.of_members else ()
        if self.of_members and self.functions["place"].numel_out("phi") == ROWS_OF_ONE_LOOP:
            names += END_OF_MEMBERS
        return write_c_source([*self.functions.values()], self.lanes, [self.functions[name] for name in names])


def _extract_numbers(
    mechanism: Mechanism, terms: TermExpressions, results: Mapping[str, Any], lanes: Mapping[str, Lanes]
) -> tuple[Any, Any, dict[str, Any], Lanes]:
    """Extract from the results what depends on the mechanism's numbers only, so that it is computed once.

    Returns
    -------
    (column, numbers, functions, lanes)
        The results that are left, their argument `numbers`, the function that computes it, and its lanes.
    """
    import casadi as cs

    arguments, rotations = terms.arguments.vector, terms.rotations
    all_numbers = cs.vertcat(arguments, *rotations.symbols)
    column, extracted, definitions = cs.extract_parametric(
        cs.vertcat(*(cs.vec(x) for x in results.values())), all_numbers
    )
    values = cs.vertcat(all_numbers, *definitions)
    numbers = cs.Function("numbers", [all_numbers], [values], ["own"], ["numbers"])
    argument_lanes = assign_argument_lanes(mechanism, terms.arguments, rotations, lanes)
    number_lanes = trace_result_lanes(numbers, "numbers", {"own": argument_lanes})
    values = cs.substitute(values, cs.vertcat(*rotations.symbols), cs.DM(rotations.values))
    functions = {"numbers": cs.Function("numbers", [arguments], [values])}
    return column, cs.vertcat(all_numbers, *extracted), functions, number_lanes


def _results(
    terms: TermExpressions, symbols: dict[str, Any], direction: dict[str, Any] | None, portable: bool
) -> dict[str, Any]:
    import casadi as cs

    rows = terms.rows
    inertia = ConstrainedInertia(terms)
    acceleration, _ = inertia.acceleration(symbols["u"], symbols["correction"])
    results = {
        "phi": rows.phi,
        "J": rows.J,
        "D_tree": terms.D_tree,
        "bias_tree": terms.bias_tree,
        "J_dot_v": rows.J_dot_v,
        "damping": terms.damping,
        "h_tree": cs.substitute(terms.bias_tree, terms.v, cs.DM.zeros(terms.v.numel())),
        "potential": terms.potential,
        "acceleration": acceleration,
        "sound": inertia.accuracy(),
    }
    if portable:
        velocity_terms = cs.vertcat(terms.bias_tree, rows.J_dot_v)
        bilinear = cs.jtimes(velocity_terms, terms.v, symbols["x"]) / 2
        results["positions"], results["velocities"] = terms.points
        results["bias_x"], results["J_dot_x"] = split_column(bilinear, [terms.v.numel(), rows.phi.numel()])
        if direction is not None:
            results |= _portable_derivatives(terms, inertia, symbols)
        return {name: cs.densify(x) for name, x in results.items()}
    J_dot = terms.configuration.directional_derivative(cs.vec(rows.J), terms.q_dot)
    results["J_dot"] = cs.reshape(J_dot, rows.J.shape)
    results["step"] = inertia.closing_step(symbols["residual"])
    if not terms.quaternions:  # Christoffel symbols: the bias is quadratic in v'
        results["C_x"] = cs.jtimes(terms.bias_tree, terms.v, symbols["x"]) / 2
    if cs.n_nodes(acceleration) * terms.v.numel() < MAX_JACOBIAN_OPERATIONS:
        results["by_state"], results["by_u"] = inertia.derivatives(symbols["u"])
    if direction is None:
        return {name: cs.densify(x) for name, x in results.items()}
    uncorrected = cs.SX(rows.phi.numel(), 1)
    results["acceleration_of_u"] = inertia.acceleration(symbols["u"], uncorrected)[0]
    step, v, more, parameter_direction = direction.values()
    q_change = cs.substitute(terms.q_dot, terms.v, step)
    results["change"] = inertia.directional_derivative(symbols["u"], q_change, v, more)
    results["by_arguments"] = inertia.argument_derivative(symbols["u"], parameter_direction)
    return {name: cs.densify(x) for name, x in results.items()}


def _portable_derivatives(
    terms: TermExpressions, inertia: ConstrainedInertia, symbols: dict[str, Any]
) -> dict[str, Any]:
    import casadi as cs

    v_change = symbols["v_change"]
    q_change = cs.substitute(terms.q_dot, terms.v, symbols["step"])

    def derivative(x: Any) -> Any:
        return terms.configuration.directional_derivative(x, q_change) + cs.jtimes(x, terms.v, v_change)

    change, unknowns = inertia.residual_change(q_change, v_change)
    loop_rate = cs.mtimes(terms.rows.J[list(terms.kept), :], terms.v)
    return {
        "residual_change": cs.substitute(change, unknowns, cs.vertcat(symbols["a"], symbols["multipliers"])),
        "loop_rate_change": terms.configuration.directional_derivative(loop_rate, q_change),
        "position_changes": derivative(terms.points[0]),
        "velocity_changes": derivative(terms.points[1]),
        "kinetic_change": derivative(terms.kinetic),
        "potential_change": derivative(terms.potential),
    }
