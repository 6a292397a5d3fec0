"""Controllers, desired trajectories, gains and actuation."""

from ckc_pin.control.actuation import Actuation, Effort
from ckc_pin.control.controllers import Controller, Model, SetPoint, Tracking
from ckc_pin.control.desired import Desired, Harmonics, Table
from ckc_pin.control.sampled import Sampled

__all__ = [
    "Actuation",
    "Controller",
    "Desired",
    "Effort",
    "Harmonics",
    "Model",
    "Sampled",
    "SetPoint",
    "Table",
    "Tracking",
]
