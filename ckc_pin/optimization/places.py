"""Places that a motion passes: their configurations, and which of their coordinates, rates and times are given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import suggest_name
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.assembly import reassemble
from ckc_pin.kinematics.loading import check_overrides
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.optimization.end_states import EndState, resolve_state
from ckc_pin.optimization.mesh_motion import Places
from ckc_pin.optimization.reduced import ReducedDynamics
from ckc_pin.optimization.route import Stay
from ckc_pin.optimization.spec import OptimizeSpec, PeriodicSpec, StateSpec, ViaSpec

__all__ = ["ResolvedPlaces", "resolve_places"]

INERTIAL = ("mass", "com", "inertia")  # parameters of links that may change
TURN_PLACES = 200  # of a straight line in q along which the loops are followed for the end of a period


@dataclass(frozen=True, eq=False)
class ResolvedPlaces:
    """Places of a motion.

    Attributes
    ----------
    names : sequence of str
        Keys of the file.
    states : sequence of EndState
        Configurations, with guesses of free coordinates and rates.
    places : Places
        Times are those of arrival.
    stays : (phases,) sequence of Stay
        Times at rest after each phase.
    members : (phases,) sequence of ReducedDynamics
        Dynamics of each phase.
    """

    names: Sequence[str]
    states: Sequence[EndState]
    places: Places
    stays: Sequence[Stay]
    members: Sequence[ReducedDynamics]


def resolve_places(dynamics: ReducedDynamics, spec: OptimizeSpec, longest: float) -> ResolvedPlaces:
    """Return the places of a motion.

    Parameters
    ----------
    dynamics : ReducedDynamics
    spec : OptimizeSpec
    longest : float
        Longest duration, which is the duration of a motion that tracks another one, s.

    Raises
    ------
    InputError
        Unknown or contradicting keys, or a place that is out of reach.
    """
    mechanism = dynamics.mechanism
    _require_vias(mechanism, spec)
    if spec.periodic is not None:
        return _resolve_cycle(dynamics, spec, spec.periodic, longest)
    assert spec.to is not None
    start = resolve_state(mechanism, spec.start or StateSpec(at="assembled"), mechanism.assembled, "from")
    states = [start, *_resolve_vias(mechanism, spec.via, start)]
    states.append(resolve_state(mechanism, spec.to, states[-1].at, "to"))
    numbers, last = range(len(spec.via)), states[-1]
    places = Places(
        np.array([start.q, *(_given_q(mechanism, spec.via[k], states[k + 1].q) for k in numbers), last.q]),
        np.array([start.rates, *(_given_rates(mechanism, via) for via in spec.via), last.rates]),
        np.array([0.0, *map(_time, spec.via), longest if spec.minimize.tracking else np.nan]),
        jumps=not _limits_jumps(spec),
    )  # fmt: skip
    names = ["from", *(f"via[{k}]" for k in numbers), "to"]
    members = _members(dynamics, zip(names, [None, *spec.via], strict=False))
    stays = [*_stays(spec.via, 0), Stay("to", 0.0)]
    _require_ways(names, places.q, places)
    return ResolvedPlaces(names, states, places, stays, members)


def _require_vias(mechanism: Mechanism, spec: OptimizeSpec) -> None:
    """Refuse keys of places that contradict each other."""
    for k, via in enumerate(spec.via):
        where = f"optimize: via[{k}]"
        ways = [key for key in ("q", "point") if getattr(via, key) is not None]
        if len(ways) != 1:
            raise InputError(f"{where}: expected either q or point, got {'both' if ways else 'neither'}")
        if via.q_dot and (via.rest or via.dwell):
            raise InputError(f"{where}: q_dot: the motion is at rest there; remove q_dot, or rest and dwell")
        free = [name for name in mechanism.independent if via.q is not None and name not in via.q]
        if via.dwell and free:
            raise InputError(f"{where}: dwell needs all independent coordinates; give q.{free[0]}")
        if spec.minimize.tracking and via.time is None:
            raise InputError(f"{where}: minimize.tracking needs the times of all places; give time")
        for name in ("tracking", "peak_torque"):
            if via.dwell and getattr(spec.minimize, name):
                raise InputError(f"{where}: dwell: not supported with minimize.{name}; remove one of them")
        if (name := _limits_jumps(spec)) and (via.dwell or via.parameters):
            key = "dwell" if via.dwell else "parameters"
            raise InputError(f"{where}: {key}: torques jump there, which {name} excludes; remove one of them")
        if via.parameters and not (via.rest or via.dwell):
            raise InputError(f"{where}: parameters change at rest only; give rest = true, or dwell")
        if via.parameters and mechanism.joints.friction.any():
            raise InputError(f"{where}: parameters: not supported with dry friction; remove one of them")
        for name in via.parameters:
            if not (name.startswith("link.") and name.split(".")[2:3] and name.split(".")[2] in INERTIAL):
                raise InputError(f"{where}: parameters: {name} is not the mass, com or inertia of a link; remove it")


def _require_ways(names: Sequence[str], q: Array, places: Places) -> None:
    """Refuse two equal places one after the other, between which the mechanism could stay at rest for no time."""
    for k in range(1, len(names) - 1 if len(names) == 2 else len(names)):
        moves = np.nan_to_num(places.rates[[k - 1, k]]).any() or np.isfinite(places.t[k])
        if np.array_equal(q[k - 1], q[k]) and not moves:
            raise InputError(
                f"optimize: {names[k]}: the same place as {names[k - 1]}; remove one, or give a time or a place "
                "between them"
            )


def _limits_jumps(spec: OptimizeSpec) -> str:
    """Return the key because of which torques do not jump at places; empty if they may."""
    keys = {"limits.torque_rate": spec.limits.torque_rate, "limits.jerk": spec.limits.jerk,
            "minimize.jerk": spec.minimize.jerk, "minimize.torque_rate": spec.minimize.torque_rate}  # fmt: skip
    return next((name for name, value in keys.items() if value), "")


def _resolve_vias(mechanism: Mechanism, vias: Sequence[ViaSpec], start: EndState, first: int = 0) -> list[EndState]:
    """Return the configurations of places, each on the branch of the one before.

    Free coordinates are those of the place before, and free rates 0. The first place has the number `first`.
    """
    states = [start]
    for k, via in enumerate(vias):
        q = None if via.q is None else _completed(mechanism, states[-1].q, via.q)
        table = StateSpec(q=q, point=via.point, q_dot=via.q_dot)
        states.append(resolve_state(mechanism, table, states[-1].at, f"via[{first + k}]"))
    return states[1:]


def _completed(mechanism: Mechanism, q: Array, named: dict[str, float]) -> dict[str, float]:
    return dict(zip(mechanism.independent, q.tolist(), strict=True)) | named


def _given_q(mechanism: Mechanism, place: ViaSpec | StateSpec, q: Array) -> Array:
    """Return q where a place gives it, and NaN where it is free."""
    if place.q is None:
        return q
    return np.where([name in place.q for name in mechanism.independent], q, np.nan)


def _given_rates(mechanism: Mechanism, place: ViaSpec | StateSpec) -> Array:
    """Return rates where a place gives them, and NaN where they are free."""
    if isinstance(place, ViaSpec) and (place.rest or place.dwell):
        return np.zeros(mechanism.d)
    return np.array([place.q_dot.get(name, np.nan) for name in mechanism.independent])


def _time(via: ViaSpec) -> float:
    return np.nan if via.time is None else via.time


def _stays(vias: Sequence[ViaSpec], first: int) -> list[Stay]:
    return [Stay(f"via[{first + k}]", via.dwell) for k, via in enumerate(vias)]


def _members(dynamics: ReducedDynamics, begins: Iterable[tuple[str, ViaSpec | None]]) -> list[ReducedDynamics]:
    """Return the dynamics of phases, from names and keys of the places at which they begin."""
    members, mechanism = [], dynamics.mechanism
    overrides: dict[str, Any] = {}
    present = dynamics
    for name, via in begins:
        if via is not None and via.parameters:
            overrides |= check_overrides(via.parameters, f"optimize: {name}.parameters")
            try:
                rebuilt, _ = reassemble(mechanism, {**mechanism.overrides, **overrides}, mechanism.assembled)
            except (InputError, MechanismError) as error:
                raise InputError(f"optimize: {name}: {error}") from None
            present = ReducedDynamics(rebuilt)
        members.append(present)
    return members


# --- periodic motions ----------------------------------------------------------------------------


def _resolve_cycle(
    dynamics: ReducedDynamics, spec: OptimizeSpec, periodic: PeriodicSpec, longest: float
) -> ResolvedPlaces:
    """Return the places of a periodic motion, of which the last one is the first one again."""
    mechanism = dynamics.mechanism
    turns = _read_turns(mechanism, periodic)
    _require_motion(spec, turns)
    first: StateSpec | ViaSpec = spec.start or StateSpec(at="assembled")
    vias, name, number = spec.via, "from", 0
    if spec.start is None and vias:  # A period begins at any place.
        first, vias, name, number = vias[0], vias[1:], "via[0]", 1
        if first.time is not None:
            raise InputError("optimize: via[0].time: without `from`, the period begins at this place; remove it")
    assembled = mechanism.independent_part(mechanism.q_tree)
    table = StateSpec(
        q=None if first.q is None else _completed(mechanism, assembled, first.q), point=first.point,
        at=first.at if isinstance(first, StateSpec) else None, q_dot=first.q_dot,
    )  # fmt: skip
    start = resolve_state(mechanism, table, mechanism.assembled, name)
    start_q = _given_q(mechanism, first, start.q)
    is_free = spec.start is None and not spec.via
    if is_free:
        # A coordinate that turns passes each of its values. One of them fixes where the period begins.
        at = int(np.flatnonzero(turns)[0]) if turns.any() else -1
        start_q = np.where(np.arange(mechanism.d) == at, start.q, np.nan)
    states = [start, *_resolve_vias(mechanism, vias, start, number)]
    states.append(_end_of_period(dynamics, start, turns))
    jumps = not _limits_jumps(spec)
    free, has_time = np.full(mechanism.d, np.nan), periodic.time is not None or bool(spec.minimize.tracking)
    places = Places(
        np.array([start_q, *(_given_q(mechanism, via, x.q) for via, x in zip(vias, states[1:], strict=False)), free]),
        np.array([_given_rates(mechanism, first), *(_given_rates(mechanism, via) for via in vias), free]),
        np.array([0.0, *map(_time, vias), longest if has_time else np.nan]), turns=turns, jumps=jumps,
        jumps_at_start=jumps and not is_free,
    )  # fmt: skip
    numbers = range(number, number + len(vias))
    last = Stay(name, first.dwell if isinstance(first, ViaSpec) else 0.0)
    names = [name, *(f"via[{k}]" for k in numbers), "periodic"]
    members = _members(dynamics, zip(names, [first if isinstance(first, ViaSpec) else None, *vias], strict=False))
    _require_ways(names, np.vstack([places.q[:-1], places.q[:1] + turns]), places)
    return ResolvedPlaces(names, states, places, [*_stays(vias, number), last], members)


def _read_turns(mechanism: Mechanism, periodic: PeriodicSpec) -> Array:
    """Return by how much the independent coordinates grow in a period, rad."""
    turns, names = np.zeros(mechanism.d), mechanism.independent
    for name, count in periodic.turns.items():
        where = f"optimize: periodic.turns.{name}"
        if name not in names:
            raise InputError(f"{where}: no independent coordinate {name!r}; there are {', '.join(names)}"
                             f"{suggest_name(name, names)}")  # fmt: skip
        k = names.index(name)
        if mechanism.tree.in_metres[mechanism.partition.q[k]]:
            raise InputError(f"{where}: {name} is a length, which does not turn; remove it")
        turns[k] = 2 * np.pi * count
    return turns


def _require_motion(spec: OptimizeSpec, turns: Array) -> None:
    """Refuse a periodic problem whose solution is a mechanism at rest."""
    places = (spec.start is not None) + len(spec.via)
    rates = [x.q_dot for x in spec.via] + ([] if spec.start is None else [spec.start.q_dot])
    moves = any(any(x.values()) for x in rates)
    if not turns.any() and places < 2 and not moves and not spec.minimize.tracking:
        raise InputError(
            "optimize: periodic: a mechanism at rest is a solution; give turns, a second place, rates at a place, or "
            "minimize.tracking"
        )


def _end_of_period(dynamics: ReducedDynamics, start: EndState, turns: Array) -> EndState:
    """Return the start after whole turns, to which the loops are followed along a straight line."""
    if not turns.any():
        return start
    line = start.q + np.linspace(0.0, 1.0, TURN_PLACES)[:, None] * turns
    followed = dynamics.follow(start.at.q_tree, line)
    if followed is None:
        raise InputError(
            "optimize: periodic.turns: the loops do not close along these turns; choose coordinates that can turn, or "
            "another branch by q_guess of the mechanism"
        )
    return EndState(dynamics.mechanism.kinematics(followed[-1]), start.q + turns, start.rates)
