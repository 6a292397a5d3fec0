"""Functions of the reduced equations of motion: constraint rows, forces of the tree, and their derivatives.

Their expressions are derived when a function is needed that the user's cache does not have.
"""

from __future__ import annotations

from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.codegen.arguments import present, values
from ckc_pin.codegen.compiler import hash_of
from ckc_pin.codegen.expressions import term_expressions
from ckc_pin.codegen.structure import structure_key
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.optimization.many_instants import InstantsFunction
from ckc_pin.optimization.tape import Tape, find_or_derive

__all__ = ["MotionExpressions", "MotionFunctions"]


class MotionExpressions:
    """CasADi expressions of a mechanism's motion q', v', dv'/dt with multipliers of the independent constraint rows.

    Attributes
    ----------
    q, v, a, multipliers, parameters : casadi.SX
        Symbols.
    phi, rate, acceleration : casadi.SX
        Independent constraint rows, with quaternions' norms, and J v', J dv'/dt + J_dot v'.
    passive, balance : casadi.SX of n
        D' dv'/dt + C' v' + h'; less J^T multipliers.
    points : casadi.SX
        Positions of the named points, a column of 3 per point.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        import casadi as cs

        terms = term_expressions(mechanism)
        expand, kept = terms.configuration.as_function_of_q, list(terms.kept)
        self.q, self.v, self.a, self.parameters = (
            terms.configuration.q, terms.v, terms.v_dot, terms.arguments.vector
        )  # fmt: skip
        self.multipliers = cs.SX.sym("multipliers", len(kept))
        self.J, self.J_dot_v = expand(terms.rows.J)[kept, :], expand(terms.rows.J_dot_v)[kept]
        norms = [(cs.sumsqr(self.q[start : start + 4]) - 1) / 2 for start in terms.quaternions]
        self.phi = cs.vertcat(expand(terms.rows.phi)[kept], *norms)
        self.rate, self.acceleration = cs.mtimes(self.J, self.v), cs.mtimes(self.J, self.a) + self.J_dot_v
        self.passive = expand(terms.inverse_dynamics - terms.damping)
        self.balance = self.passive - cs.mtimes(self.J.T, self.multipliers)
        self.points = expand(terms.points[0])

    def function(self, name: str) -> tuple[list[Any], list[Any]]:
        """Return inputs and outputs of one of the functions of `MotionFunctions`; the last input are parameters."""
        inputs, outputs = getattr(self, f"_{name}")()
        return [*inputs, self.parameters], outputs

    def _closure(self) -> tuple[list[Any], list[Any]]:
        import casadi as cs

        return [self.q], [self.phi, cs.jacobian(self.phi, self.q)]

    def _rates(self) -> tuple[list[Any], list[Any]]:
        return [self.q, self.v], [self.J, self.J_dot_v]

    def _forces(self) -> tuple[list[Any], list[Any]]:
        return [self.q, self.v, self.a], [self.passive]

    def _first(self) -> tuple[list[Any], list[Any]]:
        import casadi as cs

        q, v, a = self.q, self.v, self.a
        by = ((self.phi, q), (self.rate, v), (self.rate, q), (self.acceleration, q), (self.acceleration, v),
              (self.balance, q), (self.balance, v), (self.balance, a))  # fmt: skip
        return [q, v, a, self.multipliers], [cs.jacobian(x, y) for x, y in by]

    def _second(self) -> tuple[list[Any], list[Any]]:
        import casadi as cs

        q, v, a, multipliers = self.q, self.v, self.a, self.multipliers
        rows = self.phi, self.rate, self.acceleration, self.balance
        weights = [cs.SX.sym(f"w_{k}", x.numel()) for k, x in enumerate(rows)]
        lagrangian = sum(cs.dot(w, x) for w, x in zip(weights, rows, strict=True))
        by_q, by_v = cs.gradient(lagrangian, q), cs.gradient(lagrangian, v)
        pairs = ((by_q, q), (by_q, v), (by_v, v), (by_q, a), (by_q, multipliers))
        return [q, v, a, multipliers, *weights], [cs.jacobian(x, y) for x, y in pairs]


class MotionFunctions:
    """Functions of a mechanism's motion at many instants.

    Parameters
    ----------
    mechanism : Mechanism
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism, numbers = mechanism, model_numbers(mechanism)
        which = present(numbers)
        self._parameters: Array = values(numbers, which)
        self._key = structure_key(mechanism, which), _versions()

    @cached_property
    def expressions(self) -> MotionExpressions:
        """The expressions, with symbols as parameters."""
        return MotionExpressions(self._mechanism)

    def jacobian_at(self, q: Any) -> Any:
        """Return the CasADi expression of J at symbols of q'."""
        return self._at(q, self.expressions.J)

    def points_at(self, q: Any) -> Any:
        """Return the CasADi expression of the positions of the named points at symbols of q'."""
        return self._at(q, self.expressions.points)

    def _at(self, q: Any, expression: Any) -> Any:
        import casadi as cs

        symbols = cs.vertcat(self.expressions.q, self.expressions.parameters)
        return cs.substitute(expression, symbols, cs.vertcat(q, cs.DM(self._parameters)))

    @cached_property
    def closure(self) -> InstantsFunction:
        """phi of q', and its derivative."""
        return self._function("closure")

    @cached_property
    def rates(self) -> InstantsFunction:
        """J and J_dot v' of q' and v'."""
        return self._function("rates")

    @cached_property
    def forces(self) -> InstantsFunction:
        """D' dv'/dt + C' v' + h' of q', v' and dv'/dt."""
        return self._function("forces")

    @cached_property
    def first(self) -> InstantsFunction:
        """First derivatives of rows, their rates and accelerations, and of the forces' balance."""
        return self._function("first")

    @cached_property
    def second(self) -> InstantsFunction:
        """Second derivatives of a weighted sum of the same."""
        return self._function("second")

    def _function(self, name: str) -> InstantsFunction:
        tape = find_or_derive(hash_of((*self._key, name))[:32], lambda: Tape.of(*self.expressions.function(name)))
        return InstantsFunction(tape, self._parameters)


@cache
def _versions() -> tuple[str, ...]:
    """Return what changes tapes besides the mechanism: CasADi, and the sources that derive them."""
    import casadi as cs

    folder = Path(__file__).parent
    sources = [(folder / name).read_text(encoding="utf-8") for name in ("motion_functions.py", "tape.py")]
    return str(cs.CasadiMeta.version()), np.dtype(np.int32).newbyteorder("=").str, *sources
