"""Controllers, desired trajectories, gains and actuation."""

from ckc_pin.control.actuation import Actuation, Effort
from ckc_pin.control.controllers import (
    Controller,
    ControllerModel,
    RecordedTorques,
    SetPoint,
    TorqueController,
    Tracking,
)
from ckc_pin.control.desired import Desired, Harmonics, Table
from ckc_pin.control.sampled import Sampled

__all__ = [
    "Actuation",
    "Controller",
    "ControllerModel",
    "Desired",
    "Effort",
    "Harmonics",
    "RecordedTorques",
    "Sampled",
    "SetPoint",
    "Table",
    "TorqueController",
    "Tracking",
]
