"""Events of a run: a function of the state crosses a value, and the crossing is located within the step.

A crossing is a change of sign of (function - value):

- A run that starts on the value has not crossed it.
- Touching the value and turning back is no crossing; reaching it at the end of the run is one.
- A jump over the value at an impact is one crossing.
- A joint that comes to rest on the value has crossed it once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec import Struct

from ckc_pin.base.validation import require_controller_signature, require_type
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import _core
from ckc_pin.run.loop_terms import wrap_event_function
from ckc_pin.scene.spec import EventSpec, PrescribedSpec

__all__ = ["Event", "EventFunction", "build_event_functions", "list_occurrences", "switch_tables"]

# A coordinate or rate this close to the value counts as being on it: rad, m, rad/s, m/s.
VALUE_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Event:
    """An event at the zero crossings of a function of the state.

    Parameters
    ----------
    function : callable
        function(t, terms) returns a number that is at least continuous in the state; `terms` are the mechanism's
        `Terms` at that state.
    direction : -1, 0 or 1
        1: crossings where the function rises; -1: where it falls; 0: both.
    stop : bool
        Whether the run ends at the event.
    name : str
        Name in `Run.events`; by default the function's name.

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
            raise InputError(f"Event: function must be a function of (t, terms), got {self.function!r:.80}")
        name = getattr(self.function, "__name__", type(self.function).__name__)
        require_controller_signature(self.function, name, "Event")
        if self.direction not in (-1, 0, 1) or isinstance(self.direction, bool):
            raise InputError(f"Event: direction = {self.direction!r:.80}; valid: -1, 0, 1")
        if not isinstance(self.stop, bool):
            raise InputError(f"Event: stop = {self.stop!r:.80}: expected True or False")
        if not isinstance(self.name, str):
            raise InputError(f"Event: name = {self.name!r:.80}: expected a string")


class EventFunction(Struct, frozen=True):
    """An event function of the native loop.

    Attributes
    ----------
    label : dict
        name, of, coordinate and value of its occurrences.
    event : _core.Event
        The event of the native loop.
    """

    label: dict[str, Any]
    event: _core.Event

    @property
    def stop(self) -> bool:
        """Whether a run ends at the event."""
        return self.event.stop

    def occurrence(self, t: float, direction: int) -> dict[str, Any]:
        """Return an entry of `Run.events`."""
        return {"t": t, **self.label, "direction": direction, "stop": self.stop}


def build_event_functions(
    specs: Sequence[EventSpec], events: Sequence[Event], mechanism: Mechanism
) -> list[EventFunction]:
    """Return the event functions of a scene, followed by those of the caller.

    Parameters
    ----------
    specs : sequence of EventSpec
        The scene's events.
    events : sequence of Event
        The caller's events.

    Raises
    ------
    InputError
        An unknown coordinate, a coordinate without limits, a singular value that the mechanism does not have, or an
        object that is no `Event`.
    """
    require_type(events, (list, tuple), "events", "a list of Event")
    functions: list[EventFunction] = []
    for k, spec in enumerate(specs):
        functions += _scene_event_functions(spec, mechanism, f"event[{k}]")
    for k, event in enumerate(events):
        if not isinstance(event, Event):
            raise InputError(f"events[{k}]: {event!r:.80} is no Event; write Event(function, direction, stop, name)")
        name = event.name or getattr(event.function, "__name__", "event")
        label = {"name": name, "of": "function", "coordinate": None, "value": 0.0}
        call = wrap_event_function(event.function, name, mechanism)
        native_event = _core.Event(
            quantity=_core.EventQuantity.FUNCTION, direction=event.direction, stop=event.stop, function=call
        )
        functions.append(EventFunction(label, native_event))
    return functions


def switch_tables(prescribed: PrescribedSpec, functions: Sequence[EventFunction]) -> dict[str, Any]:
    """Return the instants and the indices of the events where a prescribed motion begins and ends, for the native loop.

    Raises
    ------
    InputError
        There is no event of this name.
    """
    table: dict[str, Any] = {}
    for key, switch in (("begins", prescribed.begins), ("ends", prescribed.ends)):
        names = [function.label["name"] for function in functions]
        if isinstance(switch, str) and switch not in names:
            events = ", ".join(map(repr, dict.fromkeys(names))) or "none; give one by [[event]]"
            raise InputError(
                f"prescribed, joint {prescribed.joint!r}: {key} = {switch!r}: no event has this name; "
                f"there are {events}"
            )
        table[f"{key}_at"] = switch if isinstance(switch, float) else math.inf
        table[f"{key}_with"] = [k for k, name in enumerate(names) if name == switch]
    return table


def list_occurrences(
    functions: Sequence[EventFunction], mechanism: Mechanism, loop: _core.Loop
) -> list[dict[str, Any]]:
    """Return the entries of `Run.events` in order of time: crossings and mode transitions of joints."""
    occurrences = [functions[x.event].occurrence(x.t, x.direction) for x in loop.occurrences()]
    for transition in loop.joint_transitions():
        k, kind, direction = transition.coordinate, transition.kind, transition.direction
        of, value = "friction", 0.0
        if kind not in (_core.JointTransitionKind.STICKS, _core.JointTransitionKind.SLIDES):
            of, value = "stop", float((mechanism.joints.lower if direction < 0 else mechanism.joints.upper)[k])
        name = mechanism.coordinates[k]
        label = {"name": f"{name} {kind.name.lower()}", "of": of, "coordinate": name}
        occurrences.append({"t": transition.t, **label, "value": value, "direction": direction, "stop": False})
    return sorted(occurrences, key=lambda event: float(event["t"]))


def _scene_event_functions(spec: EventSpec, mechanism: Mechanism, where: str) -> list[EventFunction]:
    if spec.coordinate is not None:
        mechanism.tree.indices((spec.coordinate,), f"{where}.coordinate")
    if spec.of == "limit":
        return _limit_functions(spec, mechanism, where)
    coordinate, value = spec.coordinate, spec.value or 0.0
    if coordinate is None and mechanism.rank == 0:
        raise InputError(f"{where}: {mechanism.name} has no closed loop, so there is no {spec.of}")
    quantity = spec.of if coordinate is None else coordinate if spec.of == "q" else f"v.{coordinate}"
    label = {"name": spec.name or f"{quantity} = {value:g}", "of": spec.of, "coordinate": coordinate, "value": value}
    k = 0 if coordinate is None else mechanism.tree.index[coordinate]
    event = _core.Event(
        quantity=_core.EventQuantity[spec.of.upper()], coordinate=k, value=value,
        direction=spec.direction, stop=spec.stop, zero_threshold=VALUE_TOLERANCE,
    )  # fmt: skip
    return [EventFunction(label, event)]


def _limit_functions(spec: EventSpec, mechanism: Mechanism, where: str) -> list[EventFunction]:
    """Return functions that rise through zero where a coordinate leaves its limits, one for each limit."""
    tree = mechanism.tree
    lower, upper = tree.limits()
    limited = [name for k, name in enumerate(tree.coordinates) if np.isfinite(lower[k]) or np.isfinite(upper[k])]
    if not limited:
        raise InputError(f"{where}: no joint of {mechanism.name} has limits in its URDF")
    if spec.coordinate is not None and spec.coordinate not in limited:
        raise InputError(f"{where}: {spec.coordinate} has no limits in its URDF; {', '.join(limited)} have")
    functions = []
    for name in limited if spec.coordinate is None else [spec.coordinate]:
        k = tree.index[name]
        for side, limit, sign in (("lower", float(lower[k]), -1.0), ("upper", float(upper[k]), 1.0)):
            if np.isfinite(limit):
                label = {
                    "name": spec.name or f"{name} at its {side} limit",
                    "of": "limit",
                    "coordinate": name,
                    "value": limit,
                }
                event = _core.Event(
                    quantity=_core.EventQuantity.Q, coordinate=k, value=limit, sign=sign,
                    direction=spec.direction, stop=spec.stop, zero_threshold=VALUE_TOLERANCE,
                )  # fmt: skip
                functions.append(EventFunction(label, event))
    return functions
