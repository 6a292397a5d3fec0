"""C source of CasADi functions with vectorized identical branches, compared with CasADi's own evaluation."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path
from typing import Any

import casadi as cs
import numpy as np
import pytest

from ckc_pin import load
from ckc_pin.codegen.arguments import present, values
from ckc_pin.codegen.branches import find_identical_branches
from ckc_pin.codegen.c_source import count_statements, write_c_source
from ckc_pin.codegen.compiler import FLAGS
from ckc_pin.codegen.derivatives import DIRECTIONS
from ckc_pin.codegen.graph import Graph, Packing
from ckc_pin.codegen.term_functions import TermFunctions
from ckc_pin.mechanism.parameter_map import model_numbers

TWO_BRANCHES = {"q": {k: ((0, k // 2), k % 2) for k in range(4)}}
THREE_BRANCHES = {"q": {k: ((0, k // 2), k % 2) for k in range(6)}}  # two numbers of each of three branches


def branch(q: Any, at: int, shared: Any) -> Any:
    """Return an expression of a branch's two numbers and a shared one."""
    a, b = q[2 * at], q[2 * at + 1]
    return cs.sqrt(a**2 + b**2 + 1) * shared / (2 + a * b) - (a < b) * 0.3 + cs.if_else(a > shared, -a, 2 * b)


def branches_that_meet(q: Any, p: Any) -> list[Any]:
    """Branches that meet in a sum, which begins with a shared number, and then use that sum."""
    first = [branch(q, k, p[0]) for k in range(3)]
    total = p[1] + first[0] + first[1] + first[2]
    again = [x * total - q[2 * k] / (1 + total**2) for k, x in enumerate(first)]
    last = again[0] * again[1] * again[2]
    return [cs.vertcat(*again), cs.vertcat(total, last, cs.atan2(last, p[1]), *(x / last for x in first))]


def branches_that_differ(q: Any, p: Any) -> list[Any]:
    """One branch has a term less, and two branches exchange their intermediate results."""
    first = [q[2 * k] * p[k] + (q[2 * k + 1] if k else 0) for k in range(3)]
    swapped = [first[1] * q[1], first[0] * q[3], first[2] * q[5]]
    return [cs.vertcat(*swapped), cs.vertcat(first[0] - swapped[1], *first)]


@pytest.fixture(params=[branches_that_meet, branches_that_differ], ids=["meet", "differ"])
def function(request: pytest.FixtureRequest) -> Any:
    q, p = cs.SX.sym("q", 6), cs.SX.sym("p", 3)
    return cs.Function("f", [q, p], [cs.densify(x) for x in request.param(q, p)], ["q", "p"], ["a", "b"])


@pytest.mark.parametrize(
    ("lanes", "vector_type"), [({}, None), (TWO_BRANCHES, "two"), (THREE_BRANCHES, "four")], ids=["one", "two", "three"]
)
def test_c_source_computes_what_casadi_computes(
    function: Any, lanes: Any, vector_type: str | None, tmp_path: Path
) -> None:
    source = write_c_source([function], lanes)
    (tmp_path / "f.c").write_text(source)
    vector_types = [x for x in ("two", "four") if f"const {x} " in source.partition("int f(")[2]]
    assert vector_types == ([vector_type] if vector_type else [])
    command = ["cc", *FLAGS, "-o", str(tmp_path / "f.so"), str(tmp_path / "f.c"), "-lm"]
    subprocess.run(command, check=True)
    library, random = ctypes.CDLL(str(tmp_path / "f.so")), np.random.default_rng(0)
    pointer = ctypes.POINTER(ctypes.c_double)
    for _ in range(20):
        arguments, results = [random.uniform(-2, 2, 6), random.uniform(-2, 2, 3)], [np.zeros(3), np.zeros(6)]
        if function.size1_out(1) == 4:
            results[1] = np.zeros(4)
        arrays = ((pointer * 2)(*(x.ctypes.data_as(pointer) for x in part)) for part in (arguments, results))
        library.f(*arrays, None, None, 0)
        for ours, theirs in zip(results, function(*arguments), strict=True):
            assert np.abs(ours - theirs.full()[:, 0]).max() <= 4e-16 * np.abs(theirs.full()).max()


def test_packs_reach_up_to_where_branches_meet_and_beyond() -> None:
    q, p = cs.SX.sym("q", 6), cs.SX.sym("p", 3)
    graph = Graph.from_function(cs.Function("f", [q, p], branches_that_meet(q, p)))
    lanes = {(0, place): lane for place, lane in THREE_BRANCHES["q"].items()}
    vectorized = {cs.OP_ADD, cs.OP_SUB, cs.OP_MUL, cs.OP_DIV, cs.OP_SQ, cs.OP_TWICE, cs.OP_NEG}
    packs = Packing(graph, lanes, vectorized).packs
    assert all(len(pack) == 3 for pack in packs)
    assert all(len({graph.nodes[k].operation for k in pack}) == 1 for pack in packs)
    packed = {k for pack in packs for k in pack}
    assert len(packed) == sum(map(len, packs))
    divisions = [k for k, node in enumerate(graph.nodes) if node.operation == cs.OP_DIV]
    assert sum(k in packed for k in divisions) == len(divisions) == 9
    additions = [k for k, node in enumerate(graph.nodes) if node.operation == cs.OP_ADD and k not in packed]
    assert len(additions) == 6  # three in the sum over the branches, and 1 + its square three times


def test_arms_of_the_delta_are_vectorized() -> None:
    mechanism = load("delta")
    acceleration = TermFunctions.of(mechanism).functions["acceleration"]
    source = write_c_source([acceleration], find_identical_branches(mechanism.tree))
    assert len(re.findall(r"\bp\d+=", source)) * 3 > 0.7 * acceleration.n_instructions()


def count_instructions(function: Any) -> int:
    """Return the number of a function's operations."""
    not_counted = {cs.OP_INPUT, cs.OP_OUTPUT, cs.OP_CONST}
    return sum(function.instruction_id(k) not in not_counted for k in range(function.n_instructions()))


def count_vectors(terms: TermFunctions, name: str) -> int:
    """Return the number of vector operations in a function's C source."""
    source = terms.c_source().partition(f"int {name}(const")[2].partition("return 0;")[0]
    return len(re.findall(r"\bp\d+=", source))


def test_derivatives_along_several_directions_are_fully_vectorized() -> None:
    """Everything that does not depend on the direction is computed in `state`."""
    terms = TermFunctions.of(load("five_bar"), directional_derivatives=True)
    assert count_vectors(terms, "changes") * DIRECTIONS == count_instructions(terms.functions["changes"])


def test_several_directions_are_written_only_if_branches_leave_vectors_half_empty() -> None:
    """Three arms fill three of four lanes along one direction. Four directions would be more than twice the source."""
    delta = TermFunctions.of(load("delta"), directional_derivatives=True)
    assert "changes" not in delta.functions
    change = delta.functions["change"]
    assert 2 * count_statements(change, delta.lanes) < count_instructions(change)
    five_bar = TermFunctions.of(load("five_bar"), directional_derivatives=True)
    assert count_statements(five_bar.functions["changes"], five_bar.lanes) == count_vectors(five_bar, "changes")


def test_derivatives_along_one_direction_vectorize_identical_branches() -> None:
    """The number of operations is small because eq. 1 is differentiated as inverse dynamics."""
    for name, max_operations in (("five_bar", 330), ("delta", 7300)):
        terms = TermFunctions.of(load(name), directional_derivatives=True)
        change = terms.functions["change"]
        branches = 2 if name == "five_bar" else 3
        assert count_instructions(change) <= max_operations
        in_branches = count_instructions(change) - (55 if name == "delta" else 0)  # 55 of the plate's quaternion
        assert count_vectors(terms, "change") * branches > (0.8 if name == "five_bar" else 0.9) * in_branches


def test_pivots_are_inverted_once_a_state() -> None:
    """A division takes as long as ten products: one for each of the delta's 39 pivots, none along a direction."""
    functions = TermFunctions.of(load("delta"), directional_derivatives=True).functions
    divisions = {cs.OP_DIV, cs.OP_INV}
    for name, max_divisions in (("state", 39), ("change", 0)):
        graph = Graph.from_function(functions[name])
        graph = graph.share_divisions() if name == "state" else graph
        assert sum(node.operation in divisions for node in graph.nodes) <= max_divisions, name


def test_an_arm_in_the_worlds_axes_is_vectorized_with_rotated_arms() -> None:
    """One of the delta's arms stands in the world's axes: its rotation has zeros and ones where others have not."""
    terms = TermFunctions.of(load("delta"), directional_derivatives=True)
    for name in ("place", "acceleration", "closing_step", "state"):
        assert count_vectors(terms, name) * 3 > 0.8 * count_instructions(terms.functions[name]), name


def test_a_bodys_numbers_are_one_group_with_an_additive_derivative() -> None:
    """The group of one body takes few operations."""
    mechanism = load("five_bar")
    mechanism_numbers = model_numbers(mechanism)
    functions = TermFunctions.of(mechanism, directional_derivatives=True).functions
    which = present(mechanism_numbers)
    parameters, random = values(mechanism_numbers, which), np.random.default_rng(0)
    heavier = mechanism_numbers | {
        "mass": mechanism_numbers["mass"] * [1, 1, 1.1, 1, 1],
        "centre": mechanism_numbers["centre"] * [[1], [1], [1.1], [1], [1]],
    }
    (changed_group,) = np.flatnonzero(functions["groups"](values(heavier, which) - parameters).full())
    state_values = random.uniform(-1, 1, functions["change"].numel_in(0))
    directions = random.uniform(-1, 1, (2, len(parameters)))
    names = [name for name in functions if name.startswith("varied_")]
    assert len(names) == functions["groups"].numel_out(0)
    for name in names:
        first, second, both = (functions[name](state_values, x).full() for x in (*directions, directions.sum(axis=0)))
        np.testing.assert_allclose(first + second, both, rtol=1e-13, atol=1e-13)
    assert count_instructions(functions[f"varied_{changed_group}"]) < 0.2 * count_instructions(functions["change"])
