"""Events: a coordinate or its rate crossing a value, located inside the step that crosses it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.simulation.integrate import Step
from ckc_pin.simulation.scene import EventSpec
from ckc_pin.simulation.systems import System

__all__ = ["Events"]

T_TOLERANCE = 1e-12


class Events:
    """The events of a scene.

    Parameters
    ----------
    specs : sequence of EventSpec
    mechanism : Mechanism

    Raises
    ------
    InputError
        An unknown coordinate.

    Attributes
    ----------
    met : list of dict
        What happened, in order of time: t, coordinate, of, value, stop.
    """

    def __init__(self, specs: Sequence[EventSpec], mechanism: Mechanism) -> None:
        self.specs = list(specs)
        self.at = mechanism.tree.indices(tuple(spec.coordinate for spec in specs), "event.coordinate")
        self.met: list[dict[str, Any]] = []

    def check(self, step: Step, system: System) -> float | None:
        """Locate events in a step and note them; return the time of the first that stops the run."""
        if not self.specs:
            return None
        found: list[tuple[float, EventSpec]] = []
        for k, spec in enumerate(self.specs):
            t = self._crossing(k, spec, step, system)
            if t is not None:
                found.append((t, spec))
        for t, spec in sorted(found, key=lambda item: item[0]):
            self.met.append(
                {"t": t, "coordinate": spec.coordinate, "of": spec.of, "value": spec.value, "stop": spec.stop}
            )
            if spec.stop:
                return t
        return None

    def _crossing(self, k: int, spec: EventSpec, step: Step, system: System) -> float | None:
        def gap(t: float) -> float:
            terms = system.terms(t, step.interpolant(t))
            if spec.of == "q":
                value = system.mechanism.tree.to_coordinates(terms.q_tree)[self.at[k]]
            else:
                value = system.velocity(t, terms)[self.at[k]]
            return float(value - spec.value)

        start, end = gap(step.t_old), gap(step.t)
        rising = start < 0 <= end
        falling = start > 0 >= end
        if not ((rising and spec.direction >= 0) or (falling and spec.direction <= 0)):
            return None
        from scipy.optimize import brentq

        return (
            step.t
            if end == 0
            else float(brentq(gap, step.t_old, step.t, xtol=T_TOLERANCE, rtol=4 * np.finfo(float).eps))
        )
