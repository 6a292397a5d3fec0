"""CasADi functions evaluated at many instants at a time, by the native core."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.native import _core

__all__ = ["InstantsFunction"]

# The core's names of CasADi's operations.
OPERATIONS = {
    "OP_CONST": "constant", "OP_INPUT": "input", "OP_OUTPUT": "output", "OP_ASSIGN": "copy", "OP_ADD": "add",
    "OP_SUB": "subtract", "OP_MUL": "multiply", "OP_DIV": "divide", "OP_NEG": "negate", "OP_SQ": "square",
    "OP_TWICE": "twice", "OP_INV": "invert", "OP_SQRT": "square_root", "OP_SIN": "sine", "OP_COS": "cosine",
    "OP_TAN": "tangent", "OP_ATAN2": "arcus_tangent", "OP_FABS": "absolute", "OP_LT": "less",
    "OP_LE": "less_or_equal", "OP_EQ": "equal", "OP_NE": "unequal", "OP_NOT": "inverse_truth", "OP_AND": "both",
    "OP_OR": "either", "OP_IF_ELSE_ZERO": "if_else_zero", "OP_FMIN": "smaller", "OP_FMAX": "larger",
    "OP_POW": "power", "OP_CONSTPOW": "power",
}  # fmt: skip


class InstantsFunction:
    """A function of vectors that is evaluated at many instants.

    Parameters
    ----------
    function : casadi.Function
        With dense outputs.

    Raises
    ------
    ValueError
        The core has no counterpart of an operation.
    """

    def __init__(self, function: Any) -> None:
        import casadi as cs

        self.function = function
        self._shapes = [(function.size2_out(k), function.size1_out(k)) for k in range(function.n_out())]
        name_of = {getattr(cs, operation): name for operation, name in OPERATIONS.items()}
        operations: list[str] = []
        places: list[tuple[int, int, int]] = []
        constants: list[float] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            inputs, outputs = function.instruction_input(k), function.instruction_output(k)
            operations.append(name_of.get(code, f"CasADi's {code}"))
            if code == cs.OP_CONST:
                places.append((outputs[0], len(constants), 0))
                constants.append(function.instruction_constant(k))
            elif code == cs.OP_OUTPUT:
                places.append((outputs[0], inputs[0], outputs[1]))
            else:
                places.append((outputs[0], inputs[0], inputs[-1]))
        to, a, b = ([place[k] for place in places] for k in range(3))
        self._core = _core.ManyInstants(
            operations, to, a, b, constants=np.array(constants), numbers=function.sz_w(),
            argument_sizes=[function.numel_in(k) for k in range(function.n_in())],
            result_sizes=[function.numel_out(k) for k in range(function.n_out())],
        )  # fmt: skip

    @classmethod
    def of(cls, inputs: list[Any], outputs: list[Any]) -> InstantsFunction:
        """Return the function with CasADi expressions as outputs, which become dense."""
        import casadi as cs

        return cls(cs.Function("terms", inputs, [cs.densify(x) for x in outputs], {"cse": True}))

    def __call__(self, *columns: Array) -> list[Array]:
        """Return the results at m instants, (m, rows, columns) arrays, from arguments (m, entries)."""
        results = [np.empty((len(columns[0]), rows * size)) for rows, size in self._shapes]
        self._core.evaluate([np.ascontiguousarray(x, dtype=float) for x in columns], results)
        return [x.reshape(len(x), *shape).transpose(0, 2, 1) for x, shape in zip(results, self._shapes, strict=True)]
