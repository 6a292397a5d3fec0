"""Configurations of a mechanism: sigma, assembly, continuation, branches, charts, and points as tools."""

from ckc_pin.kinematics.from_urdf import from_urdf
from ckc_pin.kinematics.loading import load
from ckc_pin.kinematics.point import Point
from ckc_pin.kinematics.sigma import Sigma, newton, predict, sigma

__all__ = ["Point", "Sigma", "from_urdf", "load", "newton", "predict", "sigma"]
