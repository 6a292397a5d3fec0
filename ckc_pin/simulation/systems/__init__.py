"""The three formulations as first-order systems y' = f(t, y) for an integrator.

============== ==================== =====================================================
system         y                    equations
============== ==================== =====================================================
`LevelSet`     q, q_dot             eq. 6 on the level set phi = w(0) exp(-t / epsilon): with
                                    w(0) = 0 the reduced model, else the SPF in eq. 17's
                                    coordinates, whose w is known in closed form
`PrintedSpf`   q, q_dot, z          eq. 8 as printed
`Dae`          q', v'               eq. 1, its closure differentiated twice, projected
============== ==================== =====================================================

`NativeLevelSet`, `NativePrintedSpf` and `NativeDae` are the same with their right-hand sides in C++.
"""

from ckc_pin.simulation.systems.base import CHART_MARGIN, Counts, Force, System, nearly_singular
from ckc_pin.simulation.systems.dae import Dae
from ckc_pin.simulation.systems.level_set import LevelSet
from ckc_pin.simulation.systems.native import Native, NativeDae, NativeLevelSet, NativePrintedSpf
from ckc_pin.simulation.systems.printed_spf import PrintedSpf

__all__ = [
    "CHART_MARGIN",
    "Counts",
    "Dae",
    "Force",
    "LevelSet",
    "Native",
    "NativeDae",
    "NativeLevelSet",
    "NativePrintedSpf",
    "PrintedSpf",
    "System",
    "nearly_singular",
]
