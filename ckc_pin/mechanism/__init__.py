"""What a mechanism is: its files, its tree, its closure, its freedoms and the split into q and z."""

from ckc_pin.mechanism.configuration import Kinematics, Partition, Psi
from ckc_pin.mechanism.library import shipped
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["Kinematics", "Mechanism", "Partition", "Psi", "shipped"]
