"""C text of CasADi functions, alike branches done together: against CasADi's own evaluation."""

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
from ckc_pin.codegen.arguments import numbers, present, values
from ckc_pin.codegen.branches import alike_branches
from ckc_pin.codegen.changes import TOGETHER
from ckc_pin.codegen.code import Code
from ckc_pin.codegen.graph import Graph, Packing
from ckc_pin.codegen.library import FLAGS
from ckc_pin.codegen.text import length, text

TWO = {"q": {k: ((0, k // 2), k % 2) for k in range(4)}}
THREE = {"q": {k: ((0, k // 2), k % 2) for k in range(6)}}  # two numbers of each of three branches


def branch(q: Any, at: int, shared: Any) -> Any:
    """What a branch does with its own numbers and one of all."""
    a, b = q[2 * at], q[2 * at + 1]
    return cs.sqrt(a**2 + b**2 + 1) * shared / (2 + a * b) - (a < b) * 0.3 + cs.if_else(a > shared, -a, 2 * b)


def met(q: Any, p: Any) -> list[Any]:
    """Branches that meet, in a sum that begins with what all share, and go on with what comes of that."""
    first = [branch(q, k, p[0]) for k in range(3)]
    total = p[1] + first[0] + first[1] + first[2]
    again = [x * total - q[2 * k] / (1 + total**2) for k, x in enumerate(first)]
    last = again[0] * again[1] * again[2]
    return [cs.vertcat(*again), cs.vertcat(total, last, cs.atan2(last, p[1]), *(x / last for x in first))]


def differ(q: Any, p: Any) -> list[Any]:
    """One branch has a term less, and two of them change places half-way."""
    first = [q[2 * k] * p[k] + (q[2 * k + 1] if k else 0) for k in range(3)]
    swapped = [first[1] * q[1], first[0] * q[3], first[2] * q[5]]
    return [cs.vertcat(*swapped), cs.vertcat(first[0] - swapped[1], *first)]


@pytest.fixture(params=[met, differ], ids=["met", "differ"])
def function(request: pytest.FixtureRequest) -> Any:
    q, p = cs.SX.sym("q", 6), cs.SX.sym("p", 3)
    return cs.Function("found", [q, p], [cs.densify(x) for x in request.param(q, p)], ["q", "p"], ["a", "b"])


@pytest.mark.parametrize(("alike", "kind"), [({}, None), (TWO, "two"), (THREE, "four")], ids=["one", "two", "three"])
def test_the_code_does_what_casadi_does(function: Any, alike: Any, kind: str | None, tmp_path: Path) -> None:
    (tmp_path / "found.c").write_text(text([function], alike))
    written = (tmp_path / "found.c").read_text()
    assert [x for x in ("two", "four") if f"const {x} " in written.partition("int found")[2]] == (
        [kind] if kind else []
    )
    command = ["cc", *FLAGS, "-o", str(tmp_path / "found.so"), str(tmp_path / "found.c"), "-lm"]
    subprocess.run(command, check=True)
    code, random = ctypes.CDLL(str(tmp_path / "found.so")), np.random.default_rng(0)
    pointer = ctypes.POINTER(ctypes.c_double)
    for _ in range(20):
        given, found = [random.uniform(-2, 2, 6), random.uniform(-2, 2, 3)], [np.zeros(3), np.zeros(6)]
        if function.size1_out(1) == 4:
            found[1] = np.zeros(4)
        arrays = ((pointer * 2)(*(x.ctypes.data_as(pointer) for x in part)) for part in (given, found))
        code.found(*arrays, None, None, 0)
        for ours, theirs in zip(found, function(*given), strict=True):
            assert np.abs(ours - theirs.full()[:, 0]).max() <= 4e-16 * np.abs(theirs.full()).max()


def test_what_branches_do_alike_is_found_up_to_where_they_meet_and_after() -> None:
    q, p = cs.SX.sym("q", 6), cs.SX.sym("p", 3)
    graph = Graph.of(cs.Function("found", [q, p], met(q, p)))
    places = {(0, at): place for at, place in THREE["q"].items()}
    vectorized = {cs.OP_ADD, cs.OP_SUB, cs.OP_MUL, cs.OP_DIV, cs.OP_SQ, cs.OP_TWICE, cs.OP_NEG}
    packs = Packing(graph, places, vectorized).packs
    assert all(len(pack) == 3 for pack in packs)
    assert all(len({graph.nodes[k].operation for k in pack}) == 1 for pack in packs)
    together = {k for pack in packs for k in pack}
    assert len(together) == sum(map(len, packs))
    divisions = [k for k, node in enumerate(graph.nodes) if node.operation == cs.OP_DIV]
    assert sum(k in together for k in divisions) == len(divisions) == 9
    adds = [k for k, node in enumerate(graph.nodes) if node.operation == cs.OP_ADD and k not in together]
    assert len(adds) == 6  # the sum of what all three do, and 1 + its square, three times


def test_the_deltas_arms_are_done_together() -> None:
    mechanism = load("delta")
    acceleration = Code.of(mechanism).functions["acceleration"]
    written = text([acceleration], alike_branches(mechanism.tree))
    assert len(re.findall(r"\bp\d+=", written)) * 3 > 0.7 * acceleration.n_instructions()


def operations(function: Any) -> int:
    kept = {cs.OP_INPUT, cs.OP_OUTPUT, cs.OP_CONST}
    return sum(function.instruction_id(k) not in kept for k in range(function.n_instructions()))


def packed(code: Code, name: str) -> int:
    """How many vectors a function's text has."""
    text = code.text().partition(f"int {name}(const")[2].partition("return 0;")[0]
    return len(re.findall(r"\bp\d+=", text))


def test_changes_along_several_directions_are_done_together() -> None:
    """All of it: what does not depend on the direction is known from the state."""
    code = Code.of(load("five_bar"), changes=True)
    assert packed(code, "changes") * TOGETHER == operations(code.functions["changes"])


def test_several_directions_are_written_only_where_branches_leave_vectors_half_empty() -> None:
    """Three arms fill three of four numbers along one direction; four directions would be more than twice the text."""
    found = Code.of(load("delta"), changes=True)
    assert "changes" not in found.functions
    assert 2 * length(found.functions["change"], found.alike) < operations(found.functions["change"])
    five_bar = Code.of(load("five_bar"), changes=True)
    assert length(five_bar.functions["changes"], five_bar.alike) == packed(five_bar, "changes")


def test_along_one_direction_alike_branches_are_done_together() -> None:
    """With few operations: eq. 1 is differentiated as inverse dynamics, D' a is never taken apart."""
    for name, most in (("five_bar", 330), ("delta", 7300)):
        code = Code.of(load(name), changes=True)
        change = code.functions["change"]
        together = 2 if name == "five_bar" else 3
        assert operations(change) <= most
        own = operations(change) - (55 if name == "delta" else 0)  # the plate's quaternion is no arm's
        assert packed(code, "change") * together > (0.8 if name == "five_bar" else 0.9) * own


def test_pivots_are_inverted_once_a_state() -> None:
    """A division takes as long as ten products: one for each of the delta's 39 pivots, none along a direction."""
    found = Code.of(load("delta"), changes=True).functions
    divisions = {cs.OP_DIV, cs.OP_INV}
    for name, most in (("state", 39), ("change", 0)):
        graph = Graph.of(found[name])
        graph = graph.divided_once() if name == "state" else graph
        assert sum(node.operation in divisions for node in graph.nodes) <= most, name


def test_an_arm_that_is_not_turned_does_what_the_other_arms_do() -> None:
    """One of the delta's arms stands in the world's axes, the others are turned out of them: zeros and ones for one."""
    code = Code.of(load("delta"), changes=True)
    for name in ("place", "acceleration", "closing_step", "state"):
        assert packed(code, name) * 3 > 0.8 * operations(code.functions[name]), name


def test_numbers_of_a_body_are_one_group_and_no_others_are() -> None:
    """And each group adds what all of them at once do, by a few operations for one body."""
    mechanism = load("five_bar")
    given = numbers(mechanism)
    found = Code.of(mechanism, changes=True).functions
    whole, random = values(given, present(given)), np.random.default_rng(0)
    heavier = given | {
        "mass": given["mass"] * [1, 1, 1.1, 1, 1],
        "centre": given["centre"] * [[1], [1], [1.1], [1], [1]],
    }
    (touched,) = np.flatnonzero(found["groups"](values(heavier, present(given)) - whole).full())
    known, along = random.uniform(-1, 1, found["change"].numel_in(0)), random.uniform(-1, 1, (2, len(whole)))
    names = [name for name in found if name.startswith("varied_")]
    assert len(names) == found["groups"].numel_out(0)
    for name in names:
        one, other, both = (found[name](known, x).full() for x in (*along, along.sum(axis=0)))
        np.testing.assert_allclose(one + other, both, rtol=1e-13, atol=1e-13)
    assert operations(found[f"varied_{touched}"]) < 0.2 * operations(found["change"])
