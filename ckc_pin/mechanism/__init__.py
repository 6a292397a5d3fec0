"""Mechanisms: file, URDF tree, loop closures, rank and freedoms, partition into q and z, named parameters."""

from ckc_pin.mechanism.configuration import Kinematics, Partition, Psi
from ckc_pin.mechanism.library import shipped
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Kinematics", "Mechanism", "Partition", "Psi", "shipped"]
