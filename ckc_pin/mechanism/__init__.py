"""What a mechanism is: its files, its tree, its closure, how it is assembled and split into q and z."""

from ckc_pin.mechanism.kinematics import Kinematics, Partition, Psi
from ckc_pin.mechanism.library import load, shipped
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.sigma import Sigma, newton, predict, sigma

__all__ = [
    "Kinematics",
    "Mechanism",
    "Partition",
    "Psi",
    "Sigma",
    "load",
    "newton",
    "predict",
    "shipped",
    "sigma",
]
