"""Events: something along a run crosses a value, located inside the step that crosses it.

A crossing is a change of sign of (function - value). A run that starts on the value has not crossed
it; touching the value and turning back is no crossing; reaching it at the very end of a run is one.
A jump over the value at an impact is one crossing. A joint that comes to rest on the value has crossed
it, once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.base.validation import require_controller_signature, require_type
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.loop_terms import event_call
from ckc_pin.scene.spec import EventSpec

__all__ = ["Event", "EventFunction", "event_functions", "events_met"]

FLOOR = 1e-12  # rad, m, rad/s, m/s: what a coordinate or a rate is on the value within
OF = {"q": 0, "q_dot": 1, "sigma_min_phi_z": 2, "sigma_min_J": 3, "function": 4}  # as the loop numbers them


@dataclass(frozen=True)
class Event:
    """Any function of the state, an event where it crosses zero.

    Parameters
    ----------
    function : callable
        (t, terms) to a number, smooth or at least continuous in the state; `terms` are the mechanism's at that state.
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
        require_controller_signature(
            self.function, getattr(self.function, "__name__", type(self.function).__name__), "Event"
        )
        if self.direction not in (-1, 0, 1) or isinstance(self.direction, bool):
            raise InputError(f"Event: direction = {self.direction!r:.80}; valid: -1, 0, 1")
        if not isinstance(self.stop, bool):
            raise InputError(f"Event: stop = {self.stop!r:.80}: expected True or False")
        if not isinstance(self.name, str):
            raise InputError(f"Event: name = {self.name!r:.80}: expected a string")


@dataclass(frozen=True)
class EventFunction:
    """One function whose sign changes the loop looks for, and what a crossing of it is called.

    Attributes
    ----------
    label : dict
        name, of, coordinate, value.
    row : tuple
        What crosses to the loop.
    """

    label: dict[str, Any]
    row: tuple[Any, ...]

    @property
    def stop(self) -> bool:
        """Whether a run ends where it crosses."""
        return bool(self.row[5])

    def met(self, t: float, direction: int) -> dict[str, Any]:
        """Return a crossing as `Run.events` has it."""
        return {"t": t, **self.label, "direction": direction, "stop": self.stop}


def event_functions(specs: Sequence[EventSpec], own: Sequence[Event], mechanism: Mechanism) -> list[EventFunction]:
    """Return the event functions: the events of a scene, then those given in Python.

    Raises
    ------
    InputError
        An unknown coordinate, one without limits, a margin that this mechanism does not have, no `Event`.
    """
    require_type(own, (list, tuple), "events", "a list of Event")
    found: list[EventFunction] = []
    for k, spec in enumerate(specs):
        found += _of_scene(spec, mechanism, f"event[{k}]")
    for k, event in enumerate(own):
        if not isinstance(event, Event):
            raise InputError(f"events[{k}]: {event!r:.80} is no Event; write Event(function, direction, stop, name)")
        name = event.name or getattr(event.function, "__name__", "event")
        label = {"name": name, "of": "function", "coordinate": None, "value": 0.0}
        call = event_call(event.function, name, mechanism)
        found.append(EventFunction(label, (OF["function"], 0, 0.0, 1.0, event.direction, event.stop, 0.0, call)))
    return found


def events_met(functions: Sequence[EventFunction], mechanism: Mechanism, loop: Any) -> list[dict[str, Any]]:
    """Return what a loop has met, in order of time: crossings, and what joints did."""
    found = [functions[k].met(t, direction) for t, k, direction in loop.met()]
    for t, k, what, direction in loop.joint_changes():
        of, value = "friction", 0.0
        if what not in ("sticks", "slides"):
            of, value = "stop", float((mechanism.joints.lower if direction < 0 else mechanism.joints.upper)[k])
        label = {"name": f"{mechanism.coordinates[k]} {what}", "of": of, "coordinate": mechanism.coordinates[k]}
        found.append({"t": t, **label, "value": value, "direction": direction, "stop": False})
    return sorted(found, key=lambda event: float(event["t"]))


def _of_scene(spec: EventSpec, mechanism: Mechanism, where: str) -> list[EventFunction]:
    if spec.coordinate is not None:
        mechanism.tree.indices((spec.coordinate,), f"{where}.coordinate")
    if spec.of == "limit":
        return _limits(spec, mechanism, where)
    name, value = spec.coordinate, spec.value or 0.0
    if name is None and mechanism.rank == 0:
        raise InputError(f"{where}: {mechanism.name} has no closed loop, so there is no {spec.of}")
    says = spec.of if name is None else name if spec.of == "q" else f"{name}'s rate"
    label = {"name": f"{says} = {value:g}", "of": spec.of, "coordinate": name, "value": value}
    k = 0 if name is None else mechanism.tree.index[name]
    return [EventFunction(label, (OF[spec.of], k, value, 1.0, spec.direction, spec.stop, FLOOR, None))]


def _limits(spec: EventSpec, mechanism: Mechanism, where: str) -> list[EventFunction]:
    """Return how far beyond its limits a coordinate is: rising is leaving, falling is coming back."""
    tree = mechanism.tree
    lower, upper = tree.limits()
    limited = [name for k, name in enumerate(tree.coordinates) if np.isfinite(lower[k]) or np.isfinite(upper[k])]
    if not limited:
        raise InputError(f"{where}: no joint of {mechanism.name} has limits in its URDF")
    if spec.coordinate is not None and spec.coordinate not in limited:
        raise InputError(f"{where}: {spec.coordinate} has no limits in its URDF; {', '.join(limited)} have")
    found = []
    for name in limited if spec.coordinate is None else [spec.coordinate]:
        k = tree.index[name]
        for side, limit, outwards in (("lower", float(lower[k]), -1.0), ("upper", float(upper[k]), 1.0)):
            if np.isfinite(limit):
                label = {"name": f"{name} at its {side} limit", "of": "limit", "coordinate": name, "value": limit}
                found.append(
                    EventFunction(label, (OF["q"], k, limit, outwards, spec.direction, spec.stop, FLOOR, None))
                )
    return found
