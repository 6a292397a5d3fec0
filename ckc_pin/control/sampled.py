"""A controller that runs on a clock: it samples the state, and holds what it answers (zero-order hold).

At t = k sample_time it sees the state; from k sample_time + delay on its u acts, until the next one does.
Before the first one acts, u = 0. What is held is eq. 6's force u.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from ckc_pin.control.actuation import require_u
from ckc_pin.control.controllers import Controller
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.tree import Array

__all__ = ["Held", "Sampled"]

SAME = 1e-9  # of the sample time: instants nearer than that are one
ROUNDING = 1e-15  # of the time itself
MOST = 10_000_000  # samples in a run


class Held:
    """A controller whose u stays as it is until somebody changes it.

    Attributes
    ----------
    held : (d,) array
        What acts.
    """

    def __init__(self, d: int) -> None:
        self.held = np.zeros(d)

    def u(self, t: float, terms: Terms) -> Array:
        """Return what acts, whatever the state."""
        return self.held

    def u_rate_gradient(self, t: float, terms: Terms) -> Array:
        """d u / d q_dot between samples, shape (d, d): zero."""
        return np.zeros((len(self.held), len(self.held)))


class Sampled(Held):
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

    Notes
    -----
    A run restarts the integration at each instant where something is sampled or starts to act, so that
    no step crosses the jump.
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
        self.lyapunov = getattr(controller, "lyapunov", None)
        self.begin(0)

    def begin(self, d: int) -> None:
        """Forget everything: a run of d freedoms starts."""
        self.held = np.zeros(d)
        self._next = 0  # the number of the next sample
        self._waiting: deque[tuple[float, Array]] = deque()  # (when it acts, u)

    def instants(self, t_end: float) -> Array:
        """Return when something is sampled or starts to act, from 0 to t_end, increasing.

        Raises
        ------
        InputError
            More samples than can be meant.
        """
        if t_end / self.sample_time > MOST:
            raise InputError(f"sample_time = {self.sample_time:g} gives more than {MOST} samples in {t_end:g} s")
        samples = np.arange(int(t_end / self.sample_time * (1 + SAME)) + 1) * self.sample_time
        times = np.sort(np.concatenate([samples, samples + self.delay]))
        near = self.near(t_end)
        times = times[times <= t_end + near]
        return times[np.diff(times, prepend=-np.inf) > near]

    def near(self, t: float) -> float:
        """Return how far apart two instants around t are one, s."""
        return SAME * self.sample_time + ROUNDING * t

    def tick(self, t: float, terms: Terms) -> None:
        """Sample at t, if that is a sample's time, and let act what is due.

        Raises
        ------
        InputError
            The controller's u has the wrong shape.
        NumericalError
            It is not finite.
        """
        now = t + self.near(t)
        if self._next * self.sample_time <= now:
            u = require_u(self.controller.u(t, terms), terms.mechanism).copy()
            if not np.isfinite(u).all():
                raise NumericalError(f"the controller's u is not finite: {u.tolist()}", t=t)
            self._waiting.append((self._next * self.sample_time + self.delay, u))
            self._next += 1
        while self._waiting and self._waiting[0][0] <= now:
            self.held = self._waiting.popleft()[1]
