"""Events: something along a run crosses a value, located inside the step that crosses it.

A crossing is a change of sign of (what is watched - value). A run that starts on the value has not crossed
it; touching the value and turning back is no crossing; reaching it at the very end of a run is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.crossings import PLACES, Walk, walk
from ckc_pin.simulation.integrate import Step
from ckc_pin.simulation.scene import EventSpec
from ckc_pin.simulation.systems import System

__all__ = ["Event", "Events"]

FLOOR = 1e-12  # rad, m, rad/s, m/s: what a coordinate or a rate is on the value within


@dataclass(frozen=True)
class Event:
    """Any function of the state, an event where it crosses zero.

    Parameters
    ----------
    function : callable
        (t, terms) to a number, smooth or at least continuous; `terms` are the mechanism's at that state.
    direction : -1, 0 or 1
        1: only where it rises through zero; -1: only where it falls; 0: both.
    stop : bool
        Whether the run ends there.
    name : str
        What `Run.events` calls it; the function's own name if there is none.

    Raises
    ------
    InputError
        A value of the wrong type.
    """

    function: Callable[[float, Terms], float]
    direction: int = 0
    stop: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError(f"Event: {self.function!r:.80} is no function of (t, terms)")
        if self.direction not in (-1, 0, 1) or isinstance(self.direction, bool):
            raise InputError(f"Event: direction = {self.direction!r:.80}; valid: -1, 0, 1")
        if not isinstance(self.stop, bool):
            raise InputError(f"Event: stop = {self.stop!r:.80}: True or False is needed")
        if not isinstance(self.name, str):
            raise InputError(f"Event: name = {self.name!r:.80}: a string is needed")


@dataclass(frozen=True)
class Watch:
    """One function that is watched: (t, terms, velocity of the tree) to a number that crosses zero."""

    label: dict[str, Any]
    gap: Callable[[float, Terms, Array], float]
    direction: int
    stop: bool
    floor: float = FLOOR


class Events:
    """The events of a run.

    Parameters
    ----------
    specs : sequence of EventSpec
        Those of the scene.
    own : sequence of Event
        Those given in Python.
    mechanism : Mechanism

    Raises
    ------
    InputError
        An unknown coordinate, one without limits, a margin that this mechanism does not have.

    Attributes
    ----------
    met : list of dict
        What happened, in order of time: t, name, of, coordinate, value, direction, stop.
    """

    def __init__(self, specs: Sequence[EventSpec], own: Sequence[Event], mechanism: Mechanism) -> None:
        self.watches: list[Watch] = []
        for k, spec in enumerate(specs):
            self.watches += _watches(spec, mechanism, f"event[{k}]")
        for k, event in enumerate(own):
            if not isinstance(event, Event):
                raise InputError(
                    f"events[{k}]: {event!r:.80} is no Event; write Event(function, direction, stop, name)"
                )
            self.watches.append(_watch(event))
        self.met: list[dict[str, Any]] = []
        self.begin()

    def begin(self, origin: float = 0.0) -> None:
        """Forget what came before: the motion starts anew, at a time that the steps call 0."""
        self._signs = [0] * len(self.watches)
        self.go_on(origin)

    def go_on(self, origin: float) -> None:
        """Go on with the same motion, at a time that the steps call 0 from now on."""
        self.origin = origin
        self._end: tuple[float, Array] | None = None  # when the last step ended, and the functions there

    @property
    def stopped_by(self) -> str:
        """Name of the last event that stopped."""
        return next((str(event["name"]) for event in reversed(self.met) if event["stop"]), "")

    def check(self, step: Step, system: System, last: bool = False) -> float | None:
        """Locate events in a step and note them; return the time of the first that stops the run.

        Parameters
        ----------
        step : Step
        system : System
        last : bool
            The run ends with this step.
        """
        if not self.watches:
            return None
        look = _Look(self.watches, step, system, self.origin)
        times = step.t_old + (step.t - step.t_old) * PLACES
        times[-1] = step.t
        known = self._end is not None and self._end[0] == step.t_old
        first = self._end[1] if self._end is not None and known else look.all(step.t_old)
        values = np.column_stack([first, *(look.all(t) for t in times[1:].tolist())])
        walks = [
            walk(look.function(k), times, values[k], self._signs[k], watch.floor)
            for k, watch in enumerate(self.watches)
        ]
        found = sorted(
            (
                (t, k, direction)
                for k, walked in enumerate(walks)
                for t, direction in self._counted(k, walked, step, last)
            ),
        )
        halt = min((t for t, k, _ in found if self.watches[k].stop), default=None)
        for t, k, direction in found:
            if halt is None or t <= halt:
                watch = self.watches[k]
                self.met.append({"t": self.origin + t, **watch.label, "direction": direction, "stop": watch.stop})
        self._end = (step.t, values[:, -1]) if halt is None else None
        self._signs = [_sign_at(walked, before, halt) for walked, before in zip(walks, self._signs, strict=True)]
        return halt

    def _counted(self, k: int, walked: Walk, step: Step, last: bool) -> list[tuple[float, int]]:
        found = list(walked.found)
        if last and walked.on_zero and walked.sign:
            found.append((step.t, -walked.sign))
        wanted = self.watches[k].direction
        return [(t, direction) for t, direction in found if wanted in (0, direction)]


def _sign_at(walked: Walk, before: int, halt: float | None) -> int:
    """Sign that a function goes on with, from the end of a step or from where the run was halted in it."""
    if halt is None:
        return walked.sign
    return next((direction for t, direction in reversed(walked.found) if t <= halt), before)


class _Look:
    """The watched functions within a step; each state is evaluated once."""

    def __init__(self, watches: list[Watch], step: Step, system: System, origin: float) -> None:
        self.watches, self.step, self.system, self.origin = watches, step, system, origin
        self._seen: dict[float, tuple[Terms, Array]] = {}

    def all(self, t: float) -> Array:
        """Every function at t, shape (watches,)."""
        return np.array([self._value(k, t) for k in range(len(self.watches))])

    def function(self, k: int) -> Callable[[float], float]:
        """Return one of them as a function of time."""
        return lambda t: self._value(k, t)

    def _value(self, k: int, t: float) -> float:
        if t not in self._seen:
            terms = self.system.terms(t, self.step.interpolant(t))
            self._seen[t] = terms, self.system.velocity(t, terms)
        value = self.watches[k].gap(self.origin + t, *self._seen[t])
        if not math.isfinite(value):
            raise NumericalError(f"the event {self.watches[k].label['name']!r} is {value}", t=self.origin + t)
        return value


def _watch(event: Event) -> Watch:
    name = event.name or getattr(event.function, "__name__", "event")

    def gap(t: float, terms: Terms, velocity: Array) -> float:
        value = event.function(t, terms)
        number = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
        if not isinstance(number, int | float):
            raise InputError(f"the event {name!r} gave {value!r:.80}; a number is needed")
        return float(number)

    label = {"name": name, "of": "function", "coordinate": None, "value": 0.0}
    return Watch(label, gap, event.direction, event.stop, floor=0.0)


def _watches(spec: EventSpec, mechanism: Mechanism, where: str) -> list[Watch]:
    if spec.coordinate is not None:
        mechanism.tree.indices((spec.coordinate,), f"{where}.coordinate")
    if spec.of == "limit":
        return _limits(spec, mechanism, where)
    if spec.of in ("q", "q_dot"):
        return [_coordinate(spec, mechanism)]
    return [_margin(spec, mechanism, where)]


def _coordinate(spec: EventSpec, mechanism: Mechanism) -> Watch:
    tree, name, value = mechanism.tree, str(spec.coordinate), spec.value or 0.0
    k = tree.index[name]

    def of_q(t: float, terms: Terms, velocity: Array) -> float:
        return float(tree.to_coordinates(terms.q_tree)[k] - value)

    def of_q_dot(t: float, terms: Terms, velocity: Array) -> float:
        return float(velocity[k] - value)

    says = f"{name} = {value:g}" if spec.of == "q" else f"{name}'s rate = {value:g}"
    label = {"name": says, "of": spec.of, "coordinate": name, "value": value}
    return Watch(label, of_q if spec.of == "q" else of_q_dot, spec.direction, spec.stop)


def _limits(spec: EventSpec, mechanism: Mechanism, where: str) -> list[Watch]:
    """Watch how far beyond its limits a coordinate is: rising is leaving, falling is coming back."""
    tree = mechanism.tree
    lower, upper = tree.limits()
    limited = [name for k, name in enumerate(tree.coordinates) if np.isfinite(lower[k]) or np.isfinite(upper[k])]
    if not limited:
        raise InputError(f"{where}: no joint of {mechanism.name} has limits in its URDF")
    if spec.coordinate is not None and spec.coordinate not in limited:
        raise InputError(f"{where}: {spec.coordinate} has no limits in its URDF; {', '.join(limited)} have")
    watches = []
    for name in limited if spec.coordinate is None else [spec.coordinate]:
        k = tree.index[name]
        for side, limit, outwards in (("lower", lower[k], -1.0), ("upper", upper[k], 1.0)):
            if np.isfinite(limit):
                label = {
                    "name": f"{name} at its {side} limit",
                    "of": "limit",
                    "coordinate": name,
                    "value": float(limit),
                }
                gap = _beyond(mechanism, k, float(limit), outwards)
                watches.append(Watch(label, gap, spec.direction, spec.stop))
    return watches


def _beyond(mechanism: Mechanism, k: int, limit: float, outwards: float) -> Callable[[float, Terms, Array], float]:
    tree = mechanism.tree
    return lambda t, terms, velocity: float(outwards * (tree.to_coordinates(terms.q_tree)[k] - limit))


def _margin(spec: EventSpec, mechanism: Mechanism, where: str) -> Watch:
    """Watch the least singular value of phi_z, or of J, as `ckc check` prints it: not scaled."""
    columns = mechanism.partition.z if spec.of == "sigma_min_phi_z" else np.arange(mechanism.n)
    value = spec.value or 0.0
    if mechanism.rank == 0:
        raise InputError(f"{where}: {mechanism.name} has no closed loop, so there is no {spec.of}")

    def gap(t: float, terms: Terms, velocity: Array) -> float:
        values = np.linalg.svd(terms.at.J[:, columns], compute_uv=False)
        return float(values[mechanism.rank - 1] - value)

    label = {"name": f"{spec.of} = {value:g}", "of": spec.of, "coordinate": None, "value": value}
    return Watch(label, gap, spec.direction, spec.stop)
