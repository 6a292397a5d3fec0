"""A controller that runs on a clock: it samples the state, and holds what it answers (zero-order hold).

At t = k sample_time it sees the state; from k sample_time + delay on its u acts, until the next one does.
Before the first one acts, u = 0. What is held is eq. 6's force u, or torques: where the controller gives those, or
where drives are described, which quantise torques. The clock itself is the step loop's, and so are sensors and drives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
import numpy as np

from ckc_pin.base.toml import convert
from ckc_pin.base.validation import is_number, require_table
from ckc_pin.control.controllers import Controller, Law, TorqueController, as_controller
from ckc_pin.control.spec import DriveSpec, SensorSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Sampled"]

MOST = 10_000_000  # samples in a run

T = TypeVar("T", bound=msgspec.Struct)


class Sampled:
    """Another controller's u, sampled and held.

    Parameters
    ----------
    controller : Controller, TorqueController or function u(t, terms)
        It is evaluated at t = k sample_time only.
    sample_time : float
        s, greater than 0.
    delay : float
        s, at least 0, from a sample to when it acts; it may exceed the sample time.
    sensor, drive : mapping, optional
        What it sees of the state, and what becomes of its torques: as a scene's [controller.sensor] and
        [controller.drive].

    Raises
    ------
    InputError
        A sample time, a delay or a table that is not as required.
    """

    def __init__(
        self,
        controller: Controller | TorqueController | Law,
        sample_time: float,
        delay: float = 0.0,
        sensor: SensorSpec | Mapping[str, Any] | None = None,
        drive: DriveSpec | Mapping[str, Any] | None = None,
    ) -> None:
        given: list[tuple[str, Any, str]] = [
            ("sample_time", sample_time, "greater than 0"),
            ("delay", delay, "of at least 0"),
        ]
        for name, value, least in given:
            if not is_number(value) or not 0 <= value < np.inf or (name == "sample_time" and value == 0):
                raise InputError(f"{name} = {value!r:.80}: expected a number {least}, in seconds")
        self.controller = as_controller(controller)
        self.sample_time, self.delay = float(sample_time), float(delay)
        self.sensor, self.drive = _table(sensor, SensorSpec, "sensor"), _table(drive, DriveSpec, "drive")

    def require_countable(self, t_end: float) -> None:
        """Refuse more samples than can be meant.

        Raises
        ------
        InputError
            That many.
        """
        if t_end / self.sample_time > MOST:
            raise InputError(f"sample_time = {self.sample_time:g} gives more than {MOST} samples in {t_end:g} s")

    def require_sensible(self, mechanism: Mechanism) -> None:
        """Refuse a sensor that this mechanism, or itself, has no use for.

        Raises
        ------
        InputError
            Noise of a rate that is not measured, encoders on a free root.
        """
        if self.sensor is None:
            return
        if self.sensor.rate == "difference" and self.sensor.q_dot_noise:
            raise InputError(
                'controller.sensor.q_dot_noise: with rate = "difference" no rate is measured; q_noise makes it noisy'
            )
        if root := mechanism.independent_root_coordinates:
            raise InputError(
                f"controller.sensor: the independent coordinate {root[0]!r} belongs to a free root, which has no "
                "encoder; choose other independent coordinates"
            )


def _table(given: Any, kind: type[T], name: str) -> T | None:
    if given is None or isinstance(given, kind):
        return given
    require_table(given, f"Sampled: {name}", f"a table as a scene's [controller.{name}]")
    return convert(dict(given), kind, "Sampled", name)
