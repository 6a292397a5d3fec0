"""CasADi functions as lists of instructions, kept in files beside the compiled terms.

Deriving a mechanism's functions takes longer than the optimization that uses them. A file is called KEY.tape, by the
hash of everything that enters the function but the values of parameters, which are arguments. It begins with the hash
of the content that follows. A damaged file is derived again. Two processes may write the same file at the same time:
the later one replaces the earlier one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.codegen.library import cache_folder, is_private, process_folder
from ckc_pin.errors import InputError

__all__ = ["Tape", "find_or_derive"]

DIGEST_SIZE = 32  # bytes

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


class Tape(msgspec.Struct, frozen=True):
    """The instructions of a function of vectors.

    Attributes
    ----------
    operations : list of str
        Names of the operations.
    instructions : bytes
        (k, 4) integers of 32 bits: the number of an operation, and three places as the core takes them.
    constants : bytes
        Double precision.
    numbers : int
        Intermediate numbers that are kept at a time.
    argument_sizes : list of int
    shapes : list of (int, int)
        Rows and columns of the results.
    """

    operations: list[str]
    instructions: bytes
    constants: bytes
    numbers: int
    argument_sizes: list[int]
    shapes: list[tuple[int, int]]

    @classmethod
    def of(cls, inputs: list[Any], outputs: list[Any]) -> Tape:
        """Return the tape of CasADi expressions, which become dense."""
        import casadi as cs

        function = cs.Function("terms", inputs, [cs.densify(x) for x in outputs], {"cse": True})
        name_of = {getattr(cs, operation): name for operation, name in OPERATIONS.items()}
        operations: dict[str, int] = {}
        instructions: list[tuple[int, int, int, int]] = []
        constants: list[float] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            to, a = function.instruction_output(k), function.instruction_input(k)
            operation = operations.setdefault(name_of.get(code, f"CasADi's {code}"), len(operations))
            if code == cs.OP_CONST:
                instructions.append((operation, to[0], len(constants), 0))
                constants.append(function.instruction_constant(k))
            elif code == cs.OP_OUTPUT:
                instructions.append((operation, to[0], a[0], to[1]))
            else:
                instructions.append((operation, to[0], a[0], a[-1]))
        return cls(
            operations=list(operations), instructions=np.array(instructions, dtype=np.int32).tobytes(),
            constants=np.array(constants, dtype=float).tobytes(), numbers=function.sz_w(),
            argument_sizes=[function.numel_in(k) for k in range(function.n_in())],
            shapes=[(function.size1_out(k), function.size2_out(k)) for k in range(function.n_out())],
        )  # fmt: skip


def find_or_derive(key: str, derive: Callable[[], Tape]) -> Tape:
    """Return the tape stored under a key. If there is none, derive it and store it in the user's cache.

    If the cache is not writable, the tape is stored in a temporary folder of this process.
    """
    tape: Tape | None = None
    for locate in (cache_folder, process_folder):
        with suppress(OSError, InputError):
            folder = locate()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if is_private(folder):
                path = folder / f"{key}.tape"
                stored = _read(path)
                if stored is not None:
                    return stored
                tape = tape or derive()
                _write(path, tape)
                return tape
    return tape or derive()


def _read(path: Path) -> Tape | None:
    """Return the tape of a file; None if it is absent or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, packed = content[:DIGEST_SIZE], content[DIGEST_SIZE:]
    return msgspec.msgpack.decode(packed, type=Tape) if sha256(packed).digest() == digest else None


def _write(path: Path, tape: Tape) -> None:
    packed = msgspec.msgpack.encode(tape)
    write_atomic(path, sha256(packed).digest() + packed)
