"""Through a singular configuration: the uncontrolled mechanism carried across by its own motion, as a DAE.

If freedoms were lost where phi_z is singular, a motion through such a configuration could not exist.
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

SAMPLES = 8  # a step


@dataclass(frozen=True)
class Crossing:
    """A free motion that is at a singular configuration in its middle.

    Attributes
    ----------
    t : (m,) array
        Seconds, zero at the singular configuration.
    det_phi_z : (m,) array
        Zero there and only there; on its two sides are different assembly branches, or the same.
    sigma_min_J : (m,) array
        The singular value that decides on J's rank.
    returned : float
        How far the motion, started a while before, misses the singular configuration at t = 0, rad or m.
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
    """Let a mechanism with square phi_z fall through a singular configuration.

    The motion is fixed by its velocity at the singular configuration: half along the null vector of phi_z, half
    along the allowed velocities perpendicular to it, so that q moves too. It is found a while before by running
    it backwards, and from there it is integrated through.

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
        The DAE cannot be integrated through, as where J loses rank.
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
    """Integrate the free DAE; states at and between its steps, the middle of the time among them."""
    none = np.zeros(mechanism.n)
    dae = Dae(mechanism, at, v, lambda t, terms: none, (0.0, duration))
    way = [(0.0, dae.terms(0.0, dae.y0))]

    def note(solver: Any) -> None:
        wanted = np.union1d(np.linspace(solver.t_old, solver.t, SAMPLES + 1), [duration / 2])
        way.extend((t, dae.terms(t, y)) for t, y in between(solver, wanted))

    outcome = march(dae, "DOP853", 1e-11, duration, on_step=note)
    if outcome.stopped:
        raise NumericalError(f"the motion through the singular configuration {outcome.stopped}", t=outcome.t)
    return way
