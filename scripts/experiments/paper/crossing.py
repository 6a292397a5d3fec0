"""Run the uncontrolled mechanism through a singular configuration, as a DAE.

If freedoms were lost where phi_z is singular, no motion could pass through such a configuration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ckc_pin.analysis.singularities import SingularPoint
from ckc_pin.base.arrays import Array
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.ivp import Dae
from scripts.experiments.paper.experiment import between, march

__all__ = ["Crossing", "cross"]

SAMPLES = 8  # per step


@dataclass(frozen=True)
class Crossing:
    """A free motion with a singular configuration at its middle.

    Attributes
    ----------
    t : (m,) array
        Seconds, zero at the singular configuration.
    det_phi_z : (m,) array
        Zero only at t = 0. Before and after are two assembly branches, or the same one.
    sigma_min_J : (m,) array
        The smallest singular value of J, which decides its rank.
    returned : float
        Distance of the integrated motion from the singular configuration at t = 0, rad or m.
    energy_drift : float
        Largest |energy - energy at the start|, J.
    """

    t: Array
    det_phi_z: Array
    sigma_min_J: Array
    returned: float
    energy_drift: float

    @property
    def changes_sign(self) -> bool:
        """Whether det phi_z has different signs before and after."""
        return bool(self.det_phi_z[0] * self.det_phi_z[-1] < 0)


def cross(mechanism: Mechanism, point: SingularPoint, speed: float = 3.0, half: float = 0.05) -> Crossing:
    """Integrate a free motion of a mechanism with square phi_z through a singular configuration.

    The velocity at the singular configuration has equal parts along the null vector of phi_z and along an admissible
    velocity perpendicular to it, so that q moves too. The motion is first integrated backwards from there; from the
    resulting start it is then integrated through the singular configuration.

    Parameters
    ----------
    mechanism : Mechanism
    point : SingularPoint
    speed : float
        |v'| at the singular configuration, rad/s or m/s.
    half : float
        Seconds before and after.

    Raises
    ------
    NumericalError
        The DAE cannot be integrated through, for example because J loses rank.
    """
    allowed = np.linalg.svd(point.at.J)[2][mechanism.rank :]
    across = allowed - np.outer(allowed @ point.null, point.null)
    across = across[np.argmax(np.linalg.norm(across, axis=1))]
    v = speed * (point.null + across / np.linalg.norm(across)) / np.sqrt(2.0)
    back = _fall(mechanism, point.at, -v, half)[-1][1]
    way = _fall(mechanism, back.at, -back.v_tree, 2 * half)
    middle = min(way, key=lambda sample: abs(sample[0] - half))[1]
    energy = np.array([terms.energy for _, terms in way])
    return Crossing(
        t=np.array([t - half for t, _ in way]),
        det_phi_z=np.array([np.linalg.det(terms.at.phi_z) for _, terms in way]),
        sigma_min_J=np.array([np.linalg.svd(terms.at.J, compute_uv=False)[mechanism.rank - 1] for _, terms in way]),
        returned=float(np.abs(mechanism.tree.difference(point.at.q_tree, middle.q_tree)).max()),
        energy_drift=float(np.abs(energy - energy[0]).max()),
    )


def _fall(mechanism: Mechanism, at: Kinematics, v: Array, duration: float) -> list[tuple[float, Terms]]:
    """Integrate the free DAE; return states at and between its steps and at the middle of the interval."""
    none = np.zeros(mechanism.n)
    dae = Dae(mechanism, at, v, lambda t, terms: none, (0.0, duration))
    way = [(0.0, dae.terms(0.0, dae.y0))]

    def note(solver: Any) -> None:
        times = np.union1d(np.linspace(solver.t_old, solver.t, SAMPLES + 1), [duration / 2])
        way.extend((t, dae.terms(t, y)) for t, y in between(solver, times))

    outcome = march(dae, "DOP853", 1e-11, duration, on_step=note)
    if outcome.stopped:
        raise NumericalError(f"the motion through the singular configuration {outcome.stopped}", t=outcome.t)
    return way
