"""Loop types that would leave an overconstrained mechanism a freedom, or that would let open loops close."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import MechanismError
from ckc_pin.kinematics.closing import EXACT_TOLERANCE, ROUNDED_TOLERANCE, close_loops, find_nearby
from ckc_pin.mechanism.closure import LOOP_ROWS, Closure, ClosureBuilder
from ckc_pin.mechanism.frames import Frames
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.pose import Pose
from ckc_pin.mechanism.rank import compute_rank, count_freedoms, scale_jacobian
from ckc_pin.mechanism.spec import CouplingSpec, LoopSpec, LoopType
from ckc_pin.mechanism.tree import Tree

__all__ = ["describe_locking_loops", "list_closing_types"]

MAX_LOOPS = 12  # each one takes some ten assemblies
MAX_REPORTED = 3  # loops that one message names
TYPES: tuple[LoopType, ...] = ("hinge", "point_2d", "universal", "point", "cylindrical", "prismatic")
AXIAL = ("hinge", "point_2d")  # types that other axes are tried for
AXES = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
RESTARTS = 1  # from perturbed guesses, for each type


def describe_locking_loops(mechanism: Mechanism) -> str:
    """Name the loops that lock a mechanism without freedoms, their rows, and loop types that would leave freedoms.

    Each loop is replaced alone, and the freedoms are counted at the assembled configuration and near it. The result is
    empty if the mechanism has freedoms, or if no replacement of one loop would give it some.
    """
    if mechanism.d or not mechanism.spec.loop:
        return ""
    sentences = []
    for loop in mechanism.spec.loop[:MAX_LOOPS]:
        freedoms: dict[str, int] = {}
        for replacement in _replacements(loop):
            if not any(_names_type(text, replacement) for text in freedoms) and (
                d := _count_freedoms(mechanism, replacement)
            ):
                freedoms[_describe_type(replacement, loop)] = d
        if freedoms:
            fewest = min(freedoms.values())
            types = _join_or([text for text, d in freedoms.items() if d == fewest])
            rows = ", ".join(_locking_rows(mechanism, loop.name))
            sentences.append(
                f"loop {loop.name!r} ({loop.type}) locks it by its rows {rows}; {types} would leave "
                f"{fewest} freedom{'' if fewest == 1 else 's'}"
            )
    more = f"; so do {len(sentences) - MAX_REPORTED} more loops" if len(sentences) > MAX_REPORTED else ""
    return "; ".join(sentences[:MAX_REPORTED]) + more


def list_closing_types(
    tree: Tree, frames: Frames, loops: Sequence[LoopSpec], couplings: Sequence[CouplingSpec], name: str, start: Array
) -> list[str]:
    """Return the types of one loop, with fewer rows than its own, with which all loops close near a guess.

    The result is empty for loops without rows of the orientation: without rows of the position, any loop closes.

    Parameters
    ----------
    tree, frames, loops, couplings
        Parts of a mechanism.
    name : str
        The loop to replace.
    start : (nq,) array
        The guess.
    """
    loop = next((loop for loop in loops if loop.name == name), None)
    if loop is None or not LOOP_ROWS[loop.type][1]:
        return []
    types: list[str] = []
    for replacement in _replacements(loop):
        if any(_names_type(text, replacement) for text in types):
            continue
        closure = _replace(tree, frames, loops, couplings, replacement)
        size = tree.size
        closed = close_loops(tree, closure, start, np.ones(tree.n), EXACT_TOLERANCE * size, RESTARTS)
        is_reversed = bool(closure.reversed_hinges(Pose(tree, closure.anchors, closed.q_tree)))
        if closed.residual <= ROUNDED_TOLERANCE * size and not is_reversed:
            types.append(_describe_type(replacement, loop))
    return types


def _replacements(loop: LoopSpec) -> Iterator[LoopSpec]:
    """Return a loop about other axes, then with each type of fewer rows, about its own axes and about other axes.

    Other axes are the same coordinate axis of both frames. Sliding loops are tried about the loop's own axes only.
    """
    kinds = [kind for kind in TYPES if _row_count(LOOP_ROWS[kind]) < _row_count(LOOP_ROWS[loop.type])]
    for kind in (loop.type, *kinds):
        axes = [(loop.axis_a, loop.axis_b)] if kind != loop.type else []
        axes += [(axis, axis) for axis in AXES] if kind in AXIAL else []
        for axis_a, axis_b in axes:
            yield msgspec.structs.replace(loop, type=kind, axis_a=axis_a, axis_b=axis_b, length=None)


def _row_count(rows: tuple[str, str]) -> int:
    counts = {"r": 3, "e1.r, e2.r": 2, "length": 1, "e1.b, e2.b": 2, "a.b": 1, "log": 3, "": 0}
    return sum(counts[part] for part in rows)


def _replace(
    tree: Tree, frames: Frames, loops: Sequence[LoopSpec], couplings: Sequence[CouplingSpec], replacement: LoopSpec
) -> Closure:
    builder = ClosureBuilder(tree, frames)
    for loop in loops:
        builder.add_loop(replacement if loop.name == replacement.name else loop)
    for coupling in couplings:
        builder.add_coupling(coupling)
    return builder.build()


def _count_freedoms(mechanism: Mechanism, replacement: LoopSpec) -> int:
    """Return the freedoms with a loop replaced; 0 if the assembled configuration does not satisfy the new rows."""
    tree, q_tree, accept = mechanism.tree, mechanism.q_tree, max(mechanism.tolerance, 1e-9 * mechanism.size)
    try:
        closure = _replace(tree, mechanism.frames, mechanism.spec.loop, mechanism.couplings, replacement)
    except MechanismError:
        return 0
    pose = Pose(tree, closure.anchors, q_tree)
    if np.abs(closure.phi(pose)).max(initial=0.0) > accept or closure.reversed_hinges(pose):
        return 0

    def nearby(tangent: Array) -> list[Array]:
        return find_nearby(tree, closure, q_tree, tangent, accept)

    freedoms = count_freedoms(tree, closure, q_tree, nearby)
    return 0 if freedoms.singular else freedoms.d


def _locking_rows(mechanism: Mechanism, name: str) -> list[str]:
    """Return the rows of a loop without any one of which there would be a freedom; all its rows if there is none."""
    closure = mechanism.closure
    jacobian = scale_jacobian(mechanism.assembled.J, mechanism.tree, closure)
    of_loop = [k for k, (loop, _) in enumerate(closure.names) if loop == name]
    locking = [k for k in of_loop if compute_rank(np.delete(jacobian, k, axis=0)).rank < mechanism.n]
    return [closure.names[k][1] for k in locking or of_loop]


def _describe_type(replacement: LoopSpec, loop: LoopSpec) -> str:
    """Return a type, with its axes if they are not those of the loop."""
    used = ("axis_a",) if replacement.type == "point_2d" else ("axis_a", "axis_b")
    changed = [key for key in used if getattr(replacement, key) != getattr(loop, key)]
    axes = [f"{key} = [{', '.join(f'{x:g}' for x in getattr(replacement, key))}]" for key in changed]
    return f'"{replacement.type}"' + (f" with {' and '.join(axes)}" if axes else "")


def _names_type(text: str, replacement: LoopSpec) -> bool:
    return text.startswith(f'"{replacement.type}"')


def _join_or(texts: Sequence[str]) -> str:
    *others, last = texts
    return f"{', '.join(others)} or {last}" if others else last
