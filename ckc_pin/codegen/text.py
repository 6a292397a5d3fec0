"""C text of CasADi functions: straight lines, in which alike branches are done several at a time.

A result that is NaN is a place that nobody reads: nothing of its own is written there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from math import isnan
from typing import Any

from ckc_pin.codegen.graph import Graph, Lane, Packing

__all__ = ["length", "operations", "result_lanes", "split", "text"]

Alike = Mapping[str, Mapping[int, tuple[Lane, int]]]  # by argument and place: whose, and which of theirs

# Functions in which several quotients share one division. Others round as they always have: the steps of stiff runs are
# other ones with the last digit of an acceleration.
INVERTED = ("state",)
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


def _formats() -> tuple[dict[int, str], dict[int, str]]:
    """C of what CasADi's operations do: on one number, and on several at a time where that can be."""
    import casadi as cs

    either = {
        cs.OP_ADD: "{0}+{1}", cs.OP_SUB: "{0}-{1}", cs.OP_MUL: "{0}*{1}", cs.OP_DIV: "{0}/{1}",
        cs.OP_NEG: "(-{0})", cs.OP_SQ: "{0}*{0}", cs.OP_TWICE: "{0}+{0}", cs.OP_INV: "1./{0}",
    }  # fmt: skip
    one = {
        cs.OP_ASSIGN: "{0}", cs.OP_SQRT: "sqrt({0})", cs.OP_SIN: "sin({0})", cs.OP_COS: "cos({0})",
        cs.OP_TAN: "tan({0})", cs.OP_ATAN2: "atan2({0},{1})", cs.OP_FABS: "fabs({0})", cs.OP_LT: "{0}<{1}",
        cs.OP_LE: "{0}<={1}", cs.OP_EQ: "{0}=={1}", cs.OP_NE: "{0}!={1}", cs.OP_NOT: "!{0}",
        cs.OP_AND: "{0}&&{1}", cs.OP_OR: "{0}||{1}", cs.OP_IF_ELSE_ZERO: "{0}?{1}:0",
        cs.OP_FMIN: "fmin({0},{1})", cs.OP_FMAX: "fmax({0},{1})",
    }  # fmt: skip
    return either | one, {**either, cs.OP_LT: "({2})(({0}<{1})&({2}_bits){2}_ones)"}


def text(functions: Sequence[Any], alike: Alike) -> str:
    """Return the C text of functions, all of whose arguments and results are asked for when they are called."""
    return HEAD + "".join(_Function(function, alike).text() for function in functions)


def result_lanes(function: Any, result: str, alike: Alike) -> dict[int, tuple[Lane, int]]:
    """Return what `alike` is to a function that takes another one's result."""
    graph, packing = _packed(function, alike)
    at = function.index_out(result)
    whose = {place: packing.whose(k) for (to, place), k in graph.results if to == at}
    return {place: found for place, found in whose.items() if found is not None}


def operations(function: Any) -> int:
    """How many operations a function is."""
    return sum(1 for node in Graph.of(function).nodes if node.of)


def length(function: Any, alike: Alike) -> int:
    """How many operations its text has, where those that are done together count as one."""
    graph, packing = _packed(function, alike)
    return sum(1 for k, node in enumerate(graph.nodes) if node.of and k not in packing.pack) + len(packing.packs)


def split(column: Any, sizes: Sequence[int]) -> list[Any]:
    """Return a column's parts of these sizes."""
    import casadi as cs

    return list(cs.vertsplit(column, [0, *accumulate(sizes)]))


def _packed(function: Any, alike: Alike) -> tuple[Graph, Packing]:
    graph, names = Graph.of(function), [function.name_in(k) for k in range(function.n_in())]
    places = {(k, at): x for k, name in enumerate(names) for at, x in alike.get(name, {}).items()}
    if function.name() in INVERTED:
        graph = graph.divided_once()
    return graph, Packing(graph, places, _formats()[1].keys())


class _Function:
    """One function's text, made as it is asked for."""

    def __init__(self, function: Any, alike: Alike) -> None:
        import casadi as cs

        self.function = function
        self.formats, self.together = _formats()
        self.constant, self.input = cs.OP_CONST, cs.OP_INPUT
        self.graph, packing = _packed(function, alike)
        self.packs, self.pack = packing.packs, packing.pack
        self.stored: dict[int, list[tuple[int, int]]] = {}
        for to, k in self.graph.results:
            if not self._is_nan(k):
                self.stored.setdefault(k, []).append(to)
        self.unread = {to for to, k in self.graph.results if self._is_nan(k)}
        self.lines: list[str] = []
        self.declared = ("", 0)  # the kind of variables that the last line is of, and how many lines there were then
        self.gathered: dict[tuple[int, ...], str] = {}

    def text(self) -> str:
        """The function, and what tells of its arguments' and results' sizes."""
        f = self.function
        name = f.name()
        self.lines += [f"const double *restrict x{k}=arg[{k}];" for k in range(f.n_in())]
        self.lines += [f"double *restrict y{k}=res[{k}];" for k in range(f.n_out())]
        self._put_all()
        head = f"int {name}(const double** arg, double** res, long long int* iw, double* w, int mem) {{"
        sizes = [
            *_sizes(f"{name}_%s_in", [f.size_in(k) for k in range(f.n_in())]),
            *_sizes(f"{name}_%s_out", [f.size_out(k) for k in range(f.n_out())]),
        ]
        return "\n".join([head, *self.lines, "return 0;", "}", *sizes, ""])

    def _put_all(self) -> None:
        """Write what results need, as late as possible."""
        done: set[int] = set()
        for _, result in (x for x in self.graph.results if not self._is_nan(x[1])):
            waiting = [result]
            while waiting:
                k = waiting[-1]
                together = self.packs[self.pack[k][0]] if k in self.pack else [k]
                before = [x for node in together for x in reversed(self.graph.nodes[node].of) if x not in done]
                if k not in done and before:
                    waiting += before
                    continue
                waiting.pop()
                if k not in done:
                    self._put(together)
                    done.update(together)

    def _put(self, nodes: list[int]) -> None:
        node = self.graph.nodes[nodes[0]]
        if node.operation not in (self.constant, self.input):
            of = [self.graph.nodes[k].of for k in nodes]
            if nodes[0] not in self.pack:
                what = self.formats[node.operation]
                self._declare("double", f"a{nodes[0]}={what.format(*map(self._scalar, of[0]))}")
            else:
                what = self.together[node.operation]
                vectors = [self._vector(operands) for operands in zip(*of, strict=True)]
                kind = _kind(nodes)
                self._declare(kind, f"p{self.pack[nodes[0]][0]}={what.format(*vectors, kind)}")
        if len(nodes) > 1 and (end := self._end(nodes)) is not None:
            result, at = end
            self.lines.append(f"*({_kind(nodes)}_at*)(y{result}+{at})=p{self.pack[nodes[0]][0]};")
            return
        for k in nodes:
            self.lines += [f"y{result}[{at}]={self._scalar(k)};" for result, at in self.stored.get(k, ())]

    def _declare(self, kind: str, what: str) -> None:
        """Write a variable, behind others of its kind without saying that again."""
        if self.declared == (kind, len(self.lines)):
            self.lines[-1] = f"{self.lines[-1][:-1]},"
            self.lines.append(f"{what};")
        else:
            self.lines.append(f"const {kind} {what};")
        self.declared = (kind, len(self.lines))

    def _scalar(self, k: int) -> str:
        node = self.graph.nodes[k]
        if node.operation == self.constant:
            return repr(node.value) if node.value >= 0 else f"({node.value!r})"
        if node.operation == self.input:
            return f"x{node.at[0]}[{node.at[1]}]"
        return "p{}[{}]".format(*self.pack[k]) if k in self.pack else f"a{k}"

    def _vector(self, nodes: tuple[int, ...]) -> str:
        """Operands of one operation in all lanes."""
        if len(set(nodes)) == 1:
            return self._scalar(nodes[0])
        if nodes[0] in self.pack and list(nodes) == self.packs[self.pack[nodes[0]][0]]:
            return f"p{self.pack[nodes[0]][0]}"
        parts = [self._scalar(k) for k in nodes]
        if len(set(parts)) == 1:
            return parts[0]
        if nodes not in self.gathered:
            if (start := self._start(nodes)) is not None:
                return f"(*(const {_kind(nodes)}_at*)(x{start[0]}+{start[1]}))"
            self.gathered[nodes] = f"g{len(self.gathered)}"
            filled = [*parts, parts[0]] if len(parts) == 3 else parts  # an ordinary number where there is no branch
            self._declare(_kind(nodes), f"{self.gathered[nodes]}={{{','.join(filled)}}}")
        return self.gathered[nodes]

    def _is_nan(self, k: int) -> bool:
        return self.graph.nodes[k].operation == self.constant and isnan(self.graph.nodes[k].value)

    def _end(self, nodes: Sequence[int]) -> tuple[int, int] | None:
        """Where they stand one behind the other in a result, and nowhere else; three before a place nobody reads."""
        places = [self.stored.get(k, []) for k in nodes]
        if any(len(x) != 1 for x in places):
            return None
        ((result, start),) = places[0]
        if any(x != [(result, start + k)] for k, x in enumerate(places)):
            return None
        return (result, start) if len(nodes) != 3 or (result, start + 3) in self.unread else None

    def _start(self, nodes: Sequence[int]) -> tuple[int, int] | None:
        """Where in an argument they stand one behind the other; three before any number."""
        of = [self.graph.nodes[k] for k in nodes]
        argument, start = of[0].at
        if any(x.operation != self.input or x.at != (argument, start + k) for k, x in enumerate(of)):
            return None
        behind = start + len(nodes) + len(nodes) % 2
        return (argument, start) if behind <= self.function.numel_in(argument) else None


def _kind(nodes: Sequence[int]) -> str:
    """C's type for as many numbers."""
    return "two" if len(nodes) == 2 else "four"


def _sizes(name: str, shapes: Sequence[tuple[int, int]]) -> Iterator[str]:
    """Functions that tell how many arguments or results there are, and of which shape."""
    table = ",".join(f"{{{rows},{columns}}}" for rows, columns in shapes)
    yield f"long long int {name % 'n'}(void) {{ return {len(shapes)}; }}"
    yield f"const long long int* {name % 'sparsity'}(long long int k) {{"
    yield f"static const long long int of[{len(shapes)}][2]={{{table}}};"
    yield "return of[k];"
    yield "}"
