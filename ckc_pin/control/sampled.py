"""A controller that runs on a clock: it samples the state, and holds what it answers (zero-order hold).

At t = k sample_time it sees the state; from k sample_time + delay on its u acts, until the next one does.
Before the first one acts, u = 0. What is held is eq. 6's force u. The clock itself is the step loop's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ckc_pin.control.controllers import Controller
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.tree import Array

__all__ = ["Sampled"]

MOST = 10_000_000  # samples in a run


class Sampled:
    """Another controller's u, sampled and held.

    Parameters
    ----------
    controller : Controller
        Its u is evaluated at t = k sample_time only.
    sample_time : float
        s, greater than 0.
    delay : float
        s, at least 0, from a sample to when it acts; it may exceed the sample time.

    Raises
    ------
    InputError
        A sample time or a delay that is not as required.
    """

    def __init__(self, controller: Controller, sample_time: float, delay: float = 0.0) -> None:
        given: list[tuple[str, Any, str]] = [
            ("sample_time", sample_time, "greater than 0"),
            ("delay", delay, "of at least 0"),
        ]
        for name, value, least in given:
            number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
            if not number or not 0 <= value < np.inf or (name == "sample_time" and value == 0):
                raise InputError(f"{name} = {value!r:.80}: a number {least} is needed, in seconds")
        self.controller = controller
        self.sample_time, self.delay = float(sample_time), float(delay)

    def u(self, t: float, terms: Terms) -> Array:
        """Return what the controller answers to a sample taken at t (s), shape (d,)."""
        return self.controller.u(t, terms)

    def require_countable(self, t_end: float) -> None:
        """Refuse more samples than can be meant.

        Raises
        ------
        InputError
            That many.
        """
        if t_end / self.sample_time > MOST:
            raise InputError(f"sample_time = {self.sample_time:g} gives more than {MOST} samples in {t_end:g} s")
