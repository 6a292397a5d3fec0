"""Where a scene starts: q, q_dot, and for the SPF w."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import newton, sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.scene.scene import Scene
from ckc_pin.scene.spec import SceneSpec

__all__ = ["Start", "branch", "find_start", "is_chart", "require_chart"]

ROUNDED = 1e-4  # rad, or of the mechanism's size: how far a configuration that is given whole may be from a closed one


@dataclass(frozen=True)
class Start:
    """A state to start from: the closure's terms at q' (on phi = w), q_dot, w, and the velocity on phi = w.

    `v_tree` is rho q_dot where it is not known to the last digit.
    """

    at: Kinematics
    q_dot: Array
    w: Array
    v_tree: Array | None = None


def find_start(mechanism: Mechanism, scene: Scene) -> Start:
    """Assemble the initial state of a scene.

    Raises
    ------
    InputError
        Unknown coordinates, a wrong shape, a start out of reach.
    NumericalError
        A start that is singular.
    """
    with scene.sources.prefix_errors():
        return _find(mechanism, scene.spec)


def _find(mechanism: Mechanism, spec: SceneSpec) -> Start:
    initial, rows = spec.initial, mechanism.closure.rows
    w = np.zeros(rows)
    if initial.w is not None:
        if len(initial.w) != rows:
            names = ", ".join(".".join(name) for name in mechanism.closure.names)
            raise InputError(f"initial.w: {len(initial.w)} numbers, the closure has {rows} rows: {names}")
        w = np.array(initial.w, dtype=float)
    q_dot = mechanism.vector(initial.q_dot, mechanism.independent, "initial.q_dot", fill=0.0)
    if initial.at is not None:
        at = mechanism.assembled if initial.at == "assembled" else stable_equilibrium(mechanism)
        if mechanism.splits_root and not np.any(w):
            return Start(at, q_dot, w)
        return Start(_close(mechanism, mechanism.independent_part(at.q_tree), at, w), q_dot, w)
    lacking = [name for name in mechanism.independent if name not in initial.q]
    if lacking and mechanism.spec.independent is None:
        needed, file = ", ".join(mechanism.independent), mechanism.sources.name
        raise InputError(
            f"initial.q: {', '.join(lacking)} missing; expected {needed}, which were chosen because {file} does not: "
            "independent = [...] there says which it is to be"
        )
    needs_q = isinstance(spec.controller, FeedbackSpec) or np.any(q_dot)
    if spec.formulation == "dae" and not np.any(w) and not needs_q:
        given = _off_chart(mechanism, initial.q)
        if given is not None:
            return Start(given, q_dot, w)
    q = mechanism.vector(
        {k: x for k, x in initial.q.items() if k not in mechanism.dependent},
        mechanism.independent,
        "initial.q",
    )
    return Start(_close(mechanism, q, branch(mechanism, initial.q), w), q_dot, w)


def _off_chart(mechanism: Mechanism, given: dict[str, float]) -> Kinematics | None:
    """Return a configuration that is given whole, where q is no chart but J keeps its rank.

    What the DAE starts from at rest: it needs no q. In other coordinates it is closed by what the numbers are rounded
    to. None where q is a chart, or not all is given.
    """
    if not all(name in given for name in mechanism.coordinates):
        return None
    numbers = mechanism.vector(given, mechanism.coordinates, "initial.q")
    at = mechanism.kinematics(mechanism.tree.from_coordinates(numbers))
    best = None if is_chart(at) else mechanism.choose_partition(at)
    if best is None:
        return None
    at = Kinematics(at.tree, at.closure, best, at.q_tree)
    if not is_chart(at):
        return None
    closed = newton(at, 0.0, mechanism.tolerance)
    moved = mechanism.tree.difference(at.q_tree, closed.at.q_tree) / mechanism.tree.step_scale
    return closed.at if closed.converged and np.abs(moved).max() <= ROUNDED else None


def branch(mechanism: Mechanism, given: dict[str, float]) -> Kinematics:
    """Return the assembled configuration, or the one that given dependent coordinates pick."""
    if not any(name in mechanism.dependent for name in given):
        return mechanism.assembled
    numbers = mechanism.tree.to_coordinates(mechanism.q_tree)
    for name, value in given.items():
        numbers[mechanism.tree.index[name]] = value
    if not np.all(np.isfinite(numbers)):
        raise InputError("initial.q: a value is not finite")
    closed = newton(mechanism.kinematics(mechanism.tree.from_coordinates(numbers)), 0.0, mechanism.tolerance)
    if not closed.converged:
        miss = np.abs(mechanism.kinematics(mechanism.tree.from_coordinates(numbers)).phi).max()
        raise InputError(
            f"initial.q: the loops do not close near the given {', '.join(mechanism.dependent)} "
            f"(|phi| = {miss:.3g} there); leave them out, or give a nearly closed configuration"
        )
    return closed.at


def _close(mechanism: Mechanism, q: Array, start: Kinematics, w: Array) -> Kinematics:
    found = sigma(mechanism, q, start, w)
    if found.verdict == "converged":
        _refuse_contradiction(mechanism, found.at, w)
        return found.at
    where = _place(mechanism, q)
    level = f" on phi = w = {w.tolist()}" if np.any(w) else ""
    if found.verdict == "singular":
        raise _singular(mechanism, f"{where}{level}", found.at)
    raise InputError(f"initial: the start {where}{level} is out of reach: {found.reason}")


def require_chart(mechanism: Mechanism, start: Start) -> None:
    """Refuse a start where q is no chart, for who needs q.

    Raises
    ------
    NumericalError
    """
    at = start.at
    if not np.array_equal(at.partition.z, mechanism.partition.z):
        raise _singular(mechanism, _place(mechanism, mechanism.independent_part(at.q_tree)), at)


def _place(mechanism: Mechanism, q: Array) -> str:
    return ", ".join(f"{name} = {x:.6g}" for name, x in zip(mechanism.independent, q, strict=True))


def _singular(mechanism: Mechanism, where: str, at: Kinematics) -> NumericalError:
    return NumericalError(
        f"the start {where} is singular: {_what_would_help(mechanism, at)}",
        t=0.0,
        q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
    )


def _what_would_help(mechanism: Mechanism, at: Kinematics) -> str:
    """Say what is singular; other independent coordinates help where J keeps its rank."""
    best = mechanism.choose_partition(at)
    if best is not None and is_chart(Kinematics(at.tree, at.closure, best, at.q_tree)):
        names = ", ".join(mechanism.coordinates[k] for k in best.q)
        return (
            f"{', '.join(mechanism.independent)} do not determine {', '.join(mechanism.dependent)} there; "
            f"start elsewhere, or take other independent coordinates ({names} would do)"
        )
    return (
        "J loses rank there, branches of the motion meet, and the loops do not say which one it takes; start elsewhere"
    )


def is_chart(at: Kinematics) -> bool:
    """Say whether the independent coordinates determine the others there."""
    return at.margin() > _core.chart_margin


def _refuse_contradiction(mechanism: Mechanism, at: Kinematics, w: Array) -> None:
    """Redundant rows cannot be off by anything: where some are w, the others follow."""
    miss = float(np.abs(at.phi - w).max(initial=0.0))
    if mechanism.redundant and miss > max(10 * mechanism.tolerance, 1e-6 * float(np.abs(w).max())):
        raise InputError(
            f"initial.w: no configuration has phi = w = {w.tolist()} (nearest miss {miss:.3g}): rows of the closure "
            f"follow from others ({', '.join(mechanism.redundant)}), and w contradicts them"
        )
