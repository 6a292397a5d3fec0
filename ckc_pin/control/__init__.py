"""Controllers, desired trajectories, gains and actuation."""

from ckc_pin.control.actuation import Actuation, Effort
from ckc_pin.control.controllers import Controller, Model, SetPoint, TorqueController, Tracking
from ckc_pin.control.desired import Desired, Harmonics, Table
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.torques import Torques

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
    "TorqueController",
    "Torques",
    "Tracking",
]
