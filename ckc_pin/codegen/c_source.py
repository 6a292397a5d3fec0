"""C source of CasADi functions: straight-line code in which identical branches are computed as vectors.

A function can also be written for several members of an ensemble at a time: the same operations on vectors that hold
one number of each member.

A result that is NaN marks an unused place of the result: no value of its own is written there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from math import isnan
from typing import Any

from ckc_pin.codegen.graph import Graph, Lane, Packing

__all__ = [
    "MEMBERS", "LaneMap", "count_operations", "count_statements", "split_column", "trace_result_lanes",
    "write_c_source", "write_static_function",
]  # fmt: skip

LaneMap = Mapping[str, Mapping[int, tuple[Lane, int]]]  # by argument and place: the lane, and the shared number

# Functions in which several quotients share one division. The others keep one division each: with another last digit of
# the acceleration, stiff runs take other steps.
SHARED_DIVISIONS = ("state",)
MEMBERS = 8  # of an ensemble, computed together; their numbers fill one cache line
HEAD = """#include <math.h>
typedef double two __attribute__((vector_size(16)));
typedef double four __attribute__((vector_size(32)));
typedef double two_at __attribute__((vector_size(16),aligned(8),may_alias));
typedef double four_at __attribute__((vector_size(32),aligned(8),may_alias));
typedef long long int two_bits __attribute__((vector_size(16)));
typedef long long int four_bits __attribute__((vector_size(32)));
static const two two_ones={1.,1.};
static const four four_ones={1.,1.,1.,1.};
"""
HEAD_OF_MEMBERS = """typedef double members __attribute__((vector_size(64)));
typedef long long int members_bits __attribute__((vector_size(64)));
static const members members_ones={1.,1.,1.,1.,1.,1.,1.,1.};
"""
# The whole library is not compiled for AVX-512, with which code on single numbers becomes slower.
TARGET_OF_MEMBERS = """#ifdef HAS_AVX512F
__attribute__((target("avx512f")))
#endif
"""


def _operation_formats() -> tuple[dict[int, str], dict[int, str]]:
    """Return the C text of CasADi's operations: on scalars, and on vectors where C has the operation."""
    import casadi as cs

    both = {
        cs.OP_ADD: "{0}+{1}", cs.OP_SUB: "{0}-{1}", cs.OP_MUL: "{0}*{1}", cs.OP_DIV: "{0}/{1}",
        cs.OP_NEG: "(-{0})", cs.OP_SQ: "{0}*{0}", cs.OP_TWICE: "{0}+{0}", cs.OP_INV: "1./{0}",
    }  # fmt: skip
    scalar = {
        cs.OP_ASSIGN: "{0}", cs.OP_SQRT: "sqrt({0})", cs.OP_SIN: "sin({0})", cs.OP_COS: "cos({0})",
        cs.OP_TAN: "tan({0})", cs.OP_ATAN2: "atan2({0},{1})", cs.OP_FABS: "fabs({0})", cs.OP_LT: "{0}<{1}",
        cs.OP_LE: "{0}<={1}", cs.OP_EQ: "{0}=={1}", cs.OP_NE: "{0}!={1}", cs.OP_NOT: "{0}==0",
        cs.OP_AND: "{0}!=0&&{1}!=0", cs.OP_OR: "{0}!=0||{1}!=0", cs.OP_IF_ELSE_ZERO: "{0}!=0?{1}:0",
        cs.OP_FMIN: "fmin({0},{1})", cs.OP_FMAX: "fmax({0},{1})",
    }  # fmt: skip
    return both | scalar, {**both, cs.OP_LT: "({2})(({0}<{1})&({2}_bits){2}_ones)"}


def write_c_source(functions: Sequence[Any], lanes: LaneMap, of_members: Sequence[Any] = ()) -> str:
    """Return the C source of CasADi functions. Callers must pass all arguments and ask for all results.

    Parameters
    ----------
    functions : sequence of casadi.Function
    lanes : mapping
        Lanes of arguments that belong to identical branches.
    of_members : sequence of casadi.Function
        Functions that are also written for `MEMBERS` members at a time, as NAME_of_members. The members' values of one
        number stand one after the other, from an address that is a multiple of 64.
    """
    texts = [_FunctionWriter(function, lanes).write() for function in functions]
    texts += [TARGET_OF_MEMBERS + _MembersWriter(function, {}).write() for function in of_members]
    return HEAD + (HEAD_OF_MEMBERS if of_members else "") + "".join(texts)


def write_static_function(function: Any, name: str) -> str:
    """Return a CasADi function as a static function of portable C99: pointers to its arguments, then to its results."""
    return _FunctionWriter(function, {}).write_static(name)


def trace_result_lanes(function: Any, result: str, lanes: LaneMap) -> dict[int, tuple[Lane, int]]:
    """Return the lanes of a function's result, for a function that takes it as an argument."""
    graph, packing = _pack(function, lanes)
    index = function.index_out(result)
    result_lanes = {place: packing.lane_of(k) for (to, place), k in graph.results if to == index}
    return {place: lane for place, lane in result_lanes.items() if lane is not None}


def count_operations(function: Any) -> int:
    """Return the number of operations of a function."""
    return sum(1 for node in Graph.from_function(function).nodes if node.operands)


def count_statements(function: Any, lanes: LaneMap) -> int:
    """Return the number of operations in a function's C source, a vector operation counted once."""
    graph, packing = _pack(function, lanes)
    scalars = sum(1 for k, node in enumerate(graph.nodes) if node.operands and k not in packing.pack)
    return scalars + len(packing.packs)


def split_column(column: Any, sizes: Sequence[int]) -> list[Any]:
    """Return a column's parts of these sizes."""
    import casadi as cs

    return list(cs.vertsplit(column, [0, *accumulate(sizes)]))


def _pack(function: Any, lanes: LaneMap) -> tuple[Graph, Packing]:
    graph, names = Graph.from_function(function), [function.name_in(k) for k in range(function.n_in())]
    inputs = {(k, place): x for k, name in enumerate(names) for place, x in lanes.get(name, {}).items()}
    if function.name() in SHARED_DIVISIONS:
        graph = graph.share_divisions()
    return graph, Packing(graph, inputs, _operation_formats()[1].keys())


class _FunctionWriter:
    """Writes one function's C source.

    Scalars are called a1, a2 ..., packs p1, p2 ..., vectors gathered from scalars g1, g2 ...
    """

    number, suffix, columns = "double", "", 1  # type of a number, suffix of the name, values of each number

    def __init__(self, function: Any, lanes: LaneMap) -> None:
        import casadi as cs

        self.function = function
        self.scalar_formats, self.vector_formats = _operation_formats()
        self.constant, self.input = cs.OP_CONST, cs.OP_INPUT
        self.graph, packing = _pack(function, lanes)
        self.packs, self.pack = packing.packs, packing.pack
        self.stored: dict[int, list[tuple[int, int]]] = {}
        for place, k in self.graph.results:
            if not self._is_nan(k):
                self.stored.setdefault(k, []).append(place)
        self.unused = {place for place, k in self.graph.results if self._is_nan(k)}
        self.lines: list[str] = []
        self.last_declaration = ("", 0)  # type of the variables of the last line, and the number of lines then
        self.gathered: dict[tuple[int, ...], str] = {}

    def write(self) -> str:
        """Return the function, and the functions that tell the sizes of its arguments and results."""
        f = self.function
        name, number = f.name() + self.suffix, self.number
        self.lines += [f"const {number} *restrict x{k}=(const {number}*)arg[{k}];" for k in range(f.n_in())]
        self.lines += [f"{number} *restrict y{k}=({number}*)res[{k}];" for k in range(f.n_out())]
        self._write_results()
        head = f"int {name}(const double** arg, double** res, long long int* iw, double* w, int mem) {{"
        sizes = [
            *_size_functions(f"{name}_%s_in", [self._size(f.size_in(k)) for k in range(f.n_in())]),
            *_size_functions(f"{name}_%s_out", [self._size(f.size_out(k)) for k in range(f.n_out())]),
        ]
        return "\n".join([head, *self.lines, "return 0;", "}", *sizes, ""])

    def write_static(self, name: str) -> str:
        """Return the function in C99, without the vectors that only GCC and Clang have."""
        self._write_results()
        inputs = [f"x{k}" for k in range(self.function.n_in())]
        outputs = [f"y{k}" for k in range(self.function.n_out())]
        text = "\n".join(self.lines)
        unused = [f"(void){x};" for x in (*inputs, *outputs) if not re.search(rf"\b{x}\[", text)]
        parameters = [*(f"const double *restrict {x}" for x in inputs), *(f"double *restrict {y}" for y in outputs)]
        return "\n".join([f"static void {name}({', '.join(parameters)}) {{", *unused, *self.lines, "}", ""])

    def _size(self, shape: tuple[int, int]) -> tuple[int, int]:
        return shape if self.columns == 1 else (self.columns, shape[0] * shape[1])

    def _write_results(self) -> None:
        """Write the operations of each result as late as possible, which keeps few numbers alive."""
        done: set[int] = set()
        for _, result in (x for x in self.graph.results if not self._is_nan(x[1])):
            waiting = [result]
            while waiting:
                k = waiting[-1]
                together = self.packs[self.pack[k][0]] if k in self.pack else [k]
                before = [x for node in together for x in reversed(self.graph.nodes[node].operands) if x not in done]
                if k not in done and before:
                    waiting += before
                    continue
                waiting.pop()
                if k not in done:
                    self._write_operation(together)
                    done.update(together)

    def _write_operation(self, nodes: list[int]) -> None:
        node = self.graph.nodes[nodes[0]]
        if node.operation not in (self.constant, self.input):
            operands = [self.graph.nodes[k].operands for k in nodes]
            if nodes[0] not in self.pack:
                self._declare(self.number, f"a{nodes[0]}={self._operation(node.operation, operands[0])}")
            else:
                text = self.vector_formats[node.operation]
                vectors = [self._vector(x) for x in zip(*operands, strict=True)]
                kind = _vector_type(nodes)
                self._declare(kind, f"p{self.pack[nodes[0]][0]}={text.format(*vectors, kind)}")
        if len(nodes) > 1 and (place := self._contiguous_result(nodes)) is not None:
            result, start = place
            self.lines.append(f"*({_vector_type(nodes)}_at*)(y{result}+{start})=p{self.pack[nodes[0]][0]};")
            return
        for k in nodes:
            self.lines += [f"y{result}[{entry}]={self._number(k)};" for result, entry in self.stored.get(k, ())]

    def _operation(self, operation: int, operands: Sequence[int]) -> str:
        """Return an operation on numbers."""
        return self.scalar_formats[operation].format(*map(self._scalar, operands))

    def _declare(self, kind: str, definition: str) -> None:
        """Write a variable's definition, in one declaration with the last line's if that has the same type."""
        if self.last_declaration == (kind, len(self.lines)):
            self.lines[-1] = f"{self.lines[-1][:-1]},"
            self.lines.append(f"{definition};")
        else:
            self.lines.append(f"const {kind} {definition};")
        self.last_declaration = (kind, len(self.lines))

    def _scalar(self, k: int) -> str:
        node = self.graph.nodes[k]
        if node.operation == self.constant:
            return repr(node.value) if node.value >= 0 else f"({node.value!r})"
        if node.operation == self.input:
            return f"x{node.source[0]}[{node.source[1]}]"
        return "p{}[{}]".format(*self.pack[k]) if k in self.pack else f"a{k}"

    def _number(self, k: int) -> str:
        return self._scalar(k)

    def _vector(self, nodes: tuple[int, ...]) -> str:
        """Return an operand of a vector operation, from its nodes in all lanes."""
        if len(set(nodes)) == 1:
            return self._scalar(nodes[0])
        if nodes[0] in self.pack and list(nodes) == self.packs[self.pack[nodes[0]][0]]:
            return f"p{self.pack[nodes[0]][0]}"
        parts = [self._scalar(k) for k in nodes]
        if len(set(parts)) == 1:
            return parts[0]
        if nodes not in self.gathered:
            if (place := self._contiguous_argument(nodes)) is not None:
                return f"(*(const {_vector_type(nodes)}_at*)(x{place[0]}+{place[1]}))"
            self.gathered[nodes] = f"g{len(self.gathered)}"
            filled = [*parts, parts[0]] if len(parts) == 3 else parts  # the fourth lane needs some ordinary number
            self._declare(_vector_type(nodes), f"{self.gathered[nodes]}={{{','.join(filled)}}}")
        return self.gathered[nodes]

    def _is_nan(self, k: int) -> bool:
        return self.graph.nodes[k].operation == self.constant and isnan(self.graph.nodes[k].value)

    def _contiguous_result(self, nodes: Sequence[int]) -> tuple[int, int] | None:
        """Return the result and start if nodes are stored one after the other and nowhere else.

        Three nodes are written as a vector of four, so the place after them must be unused.
        """
        places = [self.stored.get(k, []) for k in nodes]
        if any(len(x) != 1 for x in places):
            return None
        ((result, start),) = places[0]
        if any(x != [(result, start + k)] for k, x in enumerate(places)):
            return None
        return (result, start) if len(nodes) != 3 or (result, start + 3) in self.unused else None

    def _contiguous_argument(self, nodes: Sequence[int]) -> tuple[int, int] | None:
        """Return the argument and start if nodes are inputs one after the other. Three need any fourth number."""
        inputs = [self.graph.nodes[k] for k in nodes]
        argument, start = inputs[0].source
        if any(x.operation != self.input or x.source != (argument, start + k) for k, x in enumerate(inputs)):
            return None
        end = start + len(nodes) + len(nodes) % 2
        return (argument, start) if end <= self.function.numel_in(argument) else None


class _MembersWriter(_FunctionWriter):
    """Writes one function's C source for several members at a time: a number is a vector with an entry of each."""

    number, suffix, columns = "members", "_of_members", MEMBERS

    def _operation(self, operation: int, operands: Sequence[int]) -> str:
        if operation in self.vector_formats:
            return self.vector_formats[operation].format(*map(self._number, operands), self.number)
        entries = (
            self.scalar_formats[operation].format(*(f"{self._number(x)}[{member}]" for x in operands))
            for member in range(MEMBERS)
        )
        return f"{{{','.join(entries)}}}"

    def _number(self, k: int) -> str:
        is_constant = self.graph.nodes[k].operation == self.constant
        return f"({self._scalar(k)}-(members){{0.}})" if is_constant else self._scalar(k)


def _vector_type(nodes: Sequence[int]) -> str:
    """Return C's type for a vector of as many numbers."""
    return "two" if len(nodes) == 2 else "four"


def _size_functions(name: str, shapes: Sequence[tuple[int, int]]) -> Iterator[str]:
    """Yield the C functions that tell the number of arguments or results and their shapes."""
    table = ",".join(f"{{{rows},{columns}}}" for rows, columns in shapes)
    yield f"long long int {name % 'n'}(void) {{ return {len(shapes)}; }}"
    yield f"const long long int* {name % 'sparsity'}(long long int k) {{"
    yield f"static const long long int of[{len(shapes)}][2]={{{table}}};"
    yield "return of[k];"
    yield "}"
