"""States at the ends of planned motions: configurations on a branch, with rates, and their checks against limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.dynamics.equilibrium import stable_equilibrium
from ckc_pin.errors import InputError
from ckc_pin.kinematics.point import Point
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.free_path import FreeSpace
from ckc_pin.optimization.limits import MotionLimits
from ckc_pin.optimization.spec import MinimizeSpec, OptimizeSpec, StateSpec
from ckc_pin.scene.initial import find_branch

__all__ = [
    "EndState",
    "in_coordinates",
    "refuse_unsupported",
    "refuse_with_crossings",
    "require_inside",
    "require_regular",
    "resolve_state",
]

MAX_UNWOUND_RESIDUAL = 1e-9  # m, rad: change of phi by whole turns of dependent joints


class EndState(Immutable, frozen=True):
    """A configuration with rates of the independent coordinates."""

    at: Kinematics
    q: Array
    rates: Array


def refuse_unsupported(
    mechanism: Mechanism, minimize: MinimizeSpec, limits: MotionLimits, desired: dict[str, Any] | None
) -> None:
    """Refuse what a motion between configurations does not support, and a problem without a solution."""
    if not any(getattr(minimize, name) for name in minimize.__struct_fields__):
        raise InputError("optimize: minimize: every weight is zero; give one above zero, as time = 1.0")
    if bool(minimize.tracking) != (desired is not None):
        present, missing = ("desired", "minimize.tracking") if desired else ("minimize.tracking", "desired")
        raise InputError(f"optimize: {present} needs {missing}; give both or none")
    if minimize.tracking and (minimize.time or not np.isfinite(limits.time)):
        raise InputError(
            "optimize: minimize.tracking: the duration is limits.time; "
            + ("remove minimize.time" if minimize.time else "give it")
        )
    if not minimize.time and not np.isfinite(limits.time):
        raise InputError(
            "optimize: minimize: without a weight of time the duration has no bound; give limits.time, or minimize.time"
        )
    if not mechanism.motors.names:
        raise InputError(f"optimize: {mechanism.name} has no motors; add [[motor]] or actuated to the mechanism's file")
    others = (minimize.effort, minimize.energy, minimize.jerk, minimize.peak_torque, minimize.torque_rate)
    if (
        minimize.time
        and not any(others)
        and not np.isfinite(
            np.concatenate(
                [
                    limits.torque.ravel(),
                    limits.rate,
                    limits.acceleration,
                    limits.jerk,
                    limits.power,
                    [limits.total_power],
                    limits.speed,
                ]
            )
        ).any()
    ):
        raise InputError("optimize: limits: nothing limits the speed; give torque, rate or acceleration")


def resolve_state(mechanism: Mechanism, spec: StateSpec, branch: Kinematics, name: str) -> EndState:
    """Return the configuration that a table describes, on a branch (InputError)."""
    where = f"optimize: {name}"
    ways = [key for key in ("q", "point", "at") if getattr(spec, key) is not None]
    if len(ways) != 1:
        raise InputError(f"{where}: expected one of q, point and at, got {' and '.join(ways) or 'none'}")
    rates = mechanism.vector(spec.q_dot, mechanism.independent, f"{where}.q_dot", fill=0.0)
    if spec.at is not None:
        at = mechanism.assembled if spec.at == "assembled" else stable_equilibrium(mechanism)
        return EndState(at, mechanism.independent_part(at.q_tree), rates)
    if spec.point is not None:
        if len(spec.point) != 1:
            raise InputError(f"{where}.point: expected one point, got {', '.join(spec.point) or 'none'}")
        ((point, position),) = spec.point.items()
        try:
            inverse = Point(mechanism, point).inverse(position, branch)
        except InputError as error:
            raise InputError(f"{where}.point: unreachable: {error}") from None
        return EndState(inverse.at, inverse.q, rates)
    assert spec.q is not None
    independent = {key: value for key, value in spec.q.items() if key not in mechanism.dependent}
    q = mechanism.vector(independent, mechanism.independent, f"{where}.q")
    if len(independent) < len(spec.q):
        try:
            branch = find_branch(mechanism, spec.q)
        except InputError as error:
            raise InputError(str(error).replace("initial.q", f"{where}.q")) from None
    solution = sigma(mechanism, q, branch)
    if solution.verdict != "converged":
        raise InputError(f"{where}.q: unreachable: q is {solution.verdict}: {solution.reason}")
    return EndState(_unwind(solution.at, branch), q, rates)


def _unwind(at: Kinematics, reference: Kinematics) -> Kinematics:
    """Return a configuration with its dependent angles within half a turn of another configuration's.

    Couplings of joints may forbid this. The configuration is returned as it is then.
    """
    tree = at.tree
    turning = tree.q_index[at.partition.z[tree.is_angle[at.partition.z]]]
    q_tree = np.array(at.q_tree)
    q_tree[turning] -= 2 * np.pi * np.round((q_tree - reference.q_tree)[turning] / (2 * np.pi))
    unwound = Kinematics(tree, at.closure, at.partition, q_tree)
    is_closed = np.abs(unwound.phi - at.phi).max(initial=0.0) < MAX_UNWOUND_RESIDUAL
    return unwound if is_closed else at


def in_coordinates(planned: Mechanism, state: EndState) -> EndState:
    """Return a state in the independent coordinates of another partition."""
    at = planned.kinematics(state.at.q_tree)
    v_tree = state.at.rho @ state.rates
    return EndState(at, planned.independent_part(at.q_tree), v_tree[planned.partition.q])


def refuse_with_crossings(spec: OptimizeSpec) -> None:
    """Refuse what refers to the independent coordinates or to singular configurations."""
    keys = {"limits.singularity": spec.limits.singularity, "limits.jerk": spec.limits.jerk,
            "minimize.jerk": spec.minimize.jerk, "minimize.tracking": spec.minimize.tracking, "via": spec.via,
            "periodic": spec.periodic}  # fmt: skip
    for key, value in keys.items():
        if value:
            raise InputError(f"optimize: {key}: not supported with cross_singularities; remove one of them")


def require_inside(mechanism: Mechanism, limits: MotionLimits, state: EndState, name: str) -> None:
    """Require that a configuration and its rates are within the limits (InputError)."""
    numbers = mechanism.tree.to_coordinates(state.at.q_tree)
    beyond = np.maximum(limits.q[0] - numbers, numbers - limits.q[1])
    k = int(np.argmax(beyond))
    if beyond[k] > 1e-9:
        raise InputError(
            f"optimize: {name}: {mechanism.coordinates[k]} = {numbers[k]:.4g} is outside its limits "
            f"[{limits.q[0, k]:.4g}, {limits.q[1, k]:.4g}]; change it or limits.q"
        )
    distances = mechanism.point_positions(state.at.q_tree)
    for point, centre, radius in limits.spheres:
        if (distance := float(np.linalg.norm(distances[point] - centre))) < radius * (1 - 1e-9):
            raise InputError(
                f"optimize: {name}: the point {point!r} is {distance:.4g} m from the centre of a sphere of "
                f"limits.keep_out with radius {radius:g} m; change it or the sphere"
            )
    fast = np.abs(state.rates) > limits.rate[mechanism.partition.q]
    if fast.any():
        k = int(np.argmax(fast))
        raise InputError(
            f"optimize: {name}.q_dot: {mechanism.independent[k]} = {state.rates[k]:.4g} is above limits.rate = "
            f"{limits.rate[mechanism.partition.q[k]]:g}"
        )


def require_regular(
    mechanism: Mechanism, limits: MotionLimits, start: EndState, end: EndState, name: str = "to"
) -> None:
    """Require that an end is within the limit of singularity (InputError)."""
    if not limits.singularity:
        return
    space = FreeSpace(mechanism, limits, start.at.q_tree)
    smallest = [float(space.sigma_min(space.node(state.at.q_tree))[0]) for state in (start, end)]
    margin = smallest[1] / smallest[0] if mechanism.dependent else 1.0
    if margin < limits.singularity:
        raise InputError(
            f"optimize: {name}: sigma_min(phi_z) is {margin:.3g} of its value at the start, below limits.singularity = "
            f"{limits.singularity:g}; change one of them"
        )
