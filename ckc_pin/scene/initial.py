"""Initial state of a scene: a closed configuration, the rates q_dot, and w for the SPF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array
from ckc_pin.control.spec import FeedbackSpec
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import newton, sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.scene.spec import SceneSpec

if TYPE_CHECKING:
    from ckc_pin.scene.scene import Scene

__all__ = ["Start", "find_branch", "find_start", "is_chart", "prescribed_velocity", "require_chart"]

# Rounded digits of a configuration that gives every coordinate may leave the loops open by this much: rad, or relative
# to the mechanism's size.
MAX_ROUNDING = 1e-4


class Start(Struct, frozen=True):
    """An initial state.

    Attributes
    ----------
    at : Kinematics
        Configuration q' with phi(q') = w, and the closure's terms there.
    q_dot : (d,) array
        Rates of the independent coordinates.
    w : (rows,) array
        Initial constraint residual; zero except for the SPF.
    v_tree : (n,) array or None
        Velocity of the tree, if it is known more exactly than rho q_dot.
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
        Unknown coordinates, a wrong number of values, or a start that is out of reach.
    NumericalError
        The start is singular.
    """
    with scene.sources.prefix_errors():
        return _find_start(mechanism, scene.spec)


def _find_start(mechanism: Mechanism, spec: SceneSpec) -> Start:
    initial, rows = spec.initial, mechanism.closure.rows
    w = np.zeros(rows)
    if initial.w is not None:
        if len(initial.w) != rows:
            names = ", ".join(".".join(name) for name in mechanism.closure.names)
            raise InputError(f"initial.w: got {len(initial.w)} numbers; the closure has {rows} rows: {names}")
        w = np.array(initial.w, dtype=float)
    # A prescribed joint starts as its motion does, whatever the scene says, or freely (`prescribed_velocity`).
    rates = {name: rate for name, rate in initial.q_dot.items() if name not in mechanism.prescribed}
    q_dot = mechanism.vector(rates, mechanism.independent, "initial.q_dot", fill=0.0)
    if initial.at == "equilibrium" and any(one.begins is not None for one in spec.prescribed):
        raise InputError(
            'initial.at = "equilibrium": it is not that of the joints which move freely at first; give initial.q'
        )
    if initial.at is not None:
        at = mechanism.assembled if initial.at == "assembled" else stable_equilibrium(mechanism)
        if mechanism.splits_root and not np.any(w):
            return Start(at, q_dot, w)
        return Start(_close_loops(mechanism, mechanism.independent_part(at.q_tree), at, w), q_dot, w)
    missing = [name for name in mechanism.independent if name not in initial.q]
    if missing and mechanism.spec.independent is None:
        needed, file = ", ".join(mechanism.independent), mechanism.sources.name
        raise InputError(
            f"initial.q: {', '.join(missing)} missing; expected {needed}, which were chosen automatically because "
            f"{file} has no key independent; set independent = [...] there to choose others"
        )
    needs_q = isinstance(spec.controller, FeedbackSpec) or np.any(q_dot)
    if spec.formulation == "dae" and not np.any(w) and not needs_q:
        at_rest = _close_full_configuration(mechanism, initial.q)
        if at_rest is not None:
            return Start(at_rest, q_dot, w)
    q = mechanism.vector(
        {name: x for name, x in initial.q.items() if name not in mechanism.dependent},
        mechanism.independent,
        "initial.q",
    )
    return Start(_close_loops(mechanism, q, find_branch(mechanism, initial.q), w), q_dot, w)


def _close_full_configuration(mechanism: Mechanism, values: dict[str, float]) -> Kinematics | None:
    """Close a configuration that gives every coordinate, where q is no chart but J has full rank.

    The DAE can start there at rest, because it needs no q. Another partition removes the rounding of the values. The
    result is None if q is a chart or some coordinate is missing.
    """
    if not all(name in values for name in mechanism.coordinates):
        return None
    numbers = mechanism.vector(values, mechanism.coordinates, "initial.q")
    at = mechanism.kinematics(mechanism.tree.from_coordinates(numbers))
    best = None if is_chart(at) else mechanism.choose_partition(at)
    if best is None:
        return None
    at = Kinematics(at.tree, at.closure, best, at.q_tree)
    if not is_chart(at):
        return None
    closed = newton(at, 0.0, mechanism.tolerance)
    moved = mechanism.tree.difference(at.q_tree, closed.at.q_tree) / mechanism.tree.step_scale
    return closed.at if closed.converged and np.abs(moved).max() <= MAX_ROUNDING else None


def prescribed_velocity(mechanism: Mechanism, at: Kinematics, rates: Array) -> Array:
    """Return the velocity of the tree that makes the prescribed joints move at these rates, with q_dot = 0, (n,)."""
    row_rates, v_tree = np.zeros(mechanism.closure.rows), np.zeros(mechanism.n)
    row_rates[mechanism.prescribed_rows] = rates
    v_tree[at.partition.z] = np.linalg.lstsq(at.phi_z, row_rates, rcond=None)[0]
    return v_tree


def find_branch(mechanism: Mechanism, values: dict[str, float]) -> Kinematics:
    """Return the configuration that selects the assembly branch.

    Without values for dependent coordinates it is the assembled one; otherwise the loops are closed near these values.

    Raises
    ------
    InputError
        The loops do not close near the values, or a value is not finite.
    """
    if not any(name in mechanism.dependent for name in values):
        return mechanism.assembled
    numbers = mechanism.tree.to_coordinates(mechanism.q_tree)
    for name, value in values.items():
        numbers[mechanism.tree.index[name]] = value
    if not np.all(np.isfinite(numbers)):
        raise InputError("initial.q: a value is not finite")
    closed = newton(mechanism.kinematics(mechanism.tree.from_coordinates(numbers)), 0.0, mechanism.tolerance)
    if not closed.converged:
        residual = np.abs(mechanism.kinematics(mechanism.tree.from_coordinates(numbers)).phi).max()
        raise InputError(
            f"initial.q: the loops do not close near the given {', '.join(mechanism.dependent)} "
            f"(|phi| = {residual:.3g} there); leave them out, or give a nearly closed configuration"
        )
    return closed.at


def _close_loops(mechanism: Mechanism, q: Array, start: Kinematics, w: Array) -> Kinematics:
    """Return the configuration with these q and phi = w, on the branch of `start`."""
    solution = sigma(mechanism, q, start, w)
    if solution.verdict == "converged":
        _require_consistent_w(mechanism, solution.at, w)
        return solution.at
    where = _format_q(mechanism, q)
    level = f" on phi = w = {w.tolist()}" if np.any(w) else ""
    if solution.verdict == "singular":
        raise _singular_start(mechanism, f"{where}{level}", solution.at)
    raise InputError(f"initial: the start {where}{level} is out of reach: {solution.reason}")


def require_chart(mechanism: Mechanism, start: Start) -> None:
    """Raise NumericalError if q is no chart at the start, for callers that need q."""
    at = start.at
    if not np.array_equal(at.partition.z, mechanism.partition.z):
        raise _singular_start(mechanism, _format_q(mechanism, mechanism.independent_part(at.q_tree)), at)


def _format_q(mechanism: Mechanism, q: Array) -> str:
    return ", ".join(f"{name} = {x:.6g}" for name, x in zip(mechanism.independent, q, strict=True))


def _singular_start(mechanism: Mechanism, where: str, at: Kinematics) -> NumericalError:
    return NumericalError(
        f"the start {where} is singular: {_suggest_remedy(mechanism, at)}",
        t=0.0,
        q_tree=mechanism.tree.named(mechanism.tree.to_coordinates(at.q_tree)),
    )


def _suggest_remedy(mechanism: Mechanism, at: Kinematics) -> str:
    """Say which matrix is singular. Other independent coordinates help if J has full rank."""
    best = mechanism.choose_partition(at)
    if best is not None and is_chart(Kinematics(at.tree, at.closure, best, at.q_tree)):
        names = ", ".join(mechanism.coordinates[k] for k in best.q)
        return (
            f"{', '.join(mechanism.independent)} do not determine {', '.join(mechanism.dependent)} there; "
            f"start elsewhere, or choose other independent coordinates, for example {names}"
        )
    return "J loses rank there, where branches of the motion meet and the loops do not determine one; start elsewhere"


def is_chart(at: Kinematics) -> bool:
    """Whether the independent coordinates determine the dependent ones near a configuration."""
    return at.margin() > _core.chart_margin


def _require_consistent_w(mechanism: Mechanism, at: Kinematics, w: Array) -> None:
    """Raise InputError if w contradicts the dependencies between redundant rows."""
    miss = float(np.abs(at.phi - w).max(initial=0.0))
    if mechanism.redundant and miss > max(10 * mechanism.tolerance, 1e-6 * float(np.abs(w).max())):
        raise InputError(
            f"initial.w: no configuration has phi = w = {w.tolist()} (smallest miss {miss:.3g}): rows of the closure "
            f"follow from others ({', '.join(mechanism.redundant)}), and w contradicts them"
        )
