"""Sampled controllers: the state is sampled on a clock, and the output is held (zero-order hold).

The state is sampled at t = k sample_time. The controller's output acts from k sample_time + delay until the next one
acts. Before the first one acts, u = 0. The held output is eq. 6's force u, or motor torques: if the controller returns
torques, or if drives are described, which quantize torques. The step loop implements the clock, sensors and drives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
import numpy as np

from ckc_pin.base.toml import convert
from ckc_pin.base.validation import is_number, require_table
from ckc_pin.control.controllers import ControlLaw, Controller, TorqueController, as_controller
from ckc_pin.control.spec import DriveSpec, SensorSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Sampled", "unwrap_sampled"]

MAX_SAMPLES = 10_000_000  # in a run

T = TypeVar("T", bound=msgspec.Struct)


def unwrap_sampled(
    controller: Controller | TorqueController | Sampled | None,
) -> Controller | TorqueController | None:
    """Return the controller that a `Sampled` evaluates, or the controller itself if it is not sampled."""
    return controller.controller if isinstance(controller, Sampled) else controller


class Sampled:
    """A sampled controller: another controller's output, sampled and held.

    Parameters
    ----------
    controller : Controller, TorqueController or function u(t, terms)
        Evaluated at t = k sample_time only.
    sample_time : float
        s, greater than 0.
    delay : float
        Time from a sample to its action, s, at least 0; it may exceed the sample time.
    sensor, drive : mapping, optional
        Sensors of the state and drives of the torques, with the keys of a scene's [controller.sensor] and
        [controller.drive].

    Raises
    ------
    InputError
        A wrong sample time, delay or table.
    """

    def __init__(
        self,
        controller: Controller | TorqueController | ControlLaw,
        sample_time: float,
        delay: float = 0.0,
        sensor: SensorSpec | Mapping[str, Any] | None = None,
        drive: DriveSpec | Mapping[str, Any] | None = None,
    ) -> None:
        times: list[tuple[str, Any, str]] = [
            ("sample_time", sample_time, "greater than 0"),
            ("delay", delay, "of at least 0"),
        ]
        for name, value, bound in times:
            if not is_number(value) or not 0 <= value < np.inf or (name == "sample_time" and value == 0):
                raise InputError(f"{name} = {value!r:.80}: expected a number {bound}, in seconds")
        self.controller = as_controller(controller)
        self.sample_time, self.delay = float(sample_time), float(delay)
        self.sensor, self.drive = _read_table(sensor, SensorSpec, "sensor"), _read_table(drive, DriveSpec, "drive")

    def require_sample_count(self, t_end: float) -> None:
        """Raise InputError if a run until t_end (s) would have more than 10 million samples."""
        if t_end / self.sample_time > MAX_SAMPLES:
            raise InputError(f"sample_time = {self.sample_time:g} gives more than {MAX_SAMPLES} samples in {t_end:g} s")

    def require_usable_sensor(self, mechanism: Mechanism) -> None:
        """Check that the sensor can be used with a mechanism.

        Raises
        ------
        InputError
            Noise of a rate that is not measured, or encoders on a free root.
        """
        if self.sensor is None:
            return
        if self.sensor.rate == "difference" and self.sensor.q_dot_noise:
            raise InputError(
                'controller.sensor.q_dot_noise: with rate = "difference" no rate is measured; use q_noise instead'
            )
        if root := mechanism.independent_root_coordinates:
            raise InputError(
                f"controller.sensor: the independent coordinate {root[0]!r} belongs to a free root, which has no "
                "encoder; choose other independent coordinates"
            )


def _read_table(value: Any, spec: type[T], name: str) -> T | None:
    if value is None or isinstance(value, spec):
        return value
    require_table(value, f"Sampled: {name}", f"a table as a scene's [controller.{name}]")
    return convert(dict(value), spec, "Sampled", name)
