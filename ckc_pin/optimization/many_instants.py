"""CasADi functions evaluated at many instants at a time, by the native core."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.native import _core
from ckc_pin.optimization.tape import Tape

__all__ = ["InstantsFunction"]


class InstantsFunction:
    """A function of vectors that is evaluated at many instants.

    Parameters
    ----------
    tape : Tape
        Its last argument are parameters.
    parameters : (k,) array
        The same at all instants. What depends on them alone is computed once.

    Raises
    ------
    ValueError
        The core has no counterpart of an operation.
    """

    def __init__(self, tape: Tape, parameters: Array) -> None:
        self._shapes = tape.shapes
        self._core = _core.ManyInstants(
            tape.operations, np.frombuffer(tape.instructions, np.int32).reshape(-1, 4),
            constants=np.frombuffer(tape.constants), parameters=parameters, numbers=tape.numbers,
            argument_sizes=tape.argument_sizes, result_sizes=[rows * columns for rows, columns in tape.shapes],
        )  # fmt: skip

    @classmethod
    def of(cls, inputs: list[Any], outputs: list[Any]) -> InstantsFunction:
        """Return the function with CasADi expressions as outputs, which become dense, and without parameters."""
        import casadi as cs

        return cls(Tape.of([*inputs, cs.SX(0, 1)], outputs), np.zeros(0))

    def __call__(self, *columns: Array) -> list[Array]:
        """Return the results at m instants, (m, rows, columns) arrays, from arguments (m, entries)."""
        results = [np.empty((len(columns[0]), rows * size)) for rows, size in self._shapes]
        self._core.evaluate([np.ascontiguousarray(x, dtype=float) for x in columns], results)
        return [
            x.reshape(len(x), size, rows).transpose(0, 2, 1)
            for x, (rows, size) in zip(results, self._shapes, strict=True)
        ]
