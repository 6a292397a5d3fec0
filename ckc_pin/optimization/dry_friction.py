"""Dry friction in optimal control: its directions in each interval, with knots where joints turn back.

The direction of each joint's motion depends on the solution. A problem with smoothed friction is solved first. Then the
joints of its solution have their directions in each interval, and knots are placed where they turn back. The problem
with these directions is smooth and exact. Its solution moves the knots, until they stay.
"""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.optimization.mesh_motion import Mesh
from ckc_pin.optimization.reduced import ReducedDynamics

__all__ = ["FrictionKnots"]

SLIPS = (1e-1, 1e-2)  # rad/s, or sizes of the mechanism per second: of smoothed friction, one after the other
MIN_GAP = 0.2  # of the shortest interval: other knots are not closer to places at which a joint turns back
RELAXATION = 0.7  # of the places' changes, which alternate in sign
END_GAP = 1e-9  # places closer to the ends of the motion are left out


class FrictionKnots:
    """Dry friction on a sequence of meshes.

    Parameters
    ----------
    dynamics : ReducedDynamics
        Its friction is set.
    """

    def __init__(self, dynamics: ReducedDynamics) -> None:
        self._dynamics = dynamics
        self._rubs = dynamics.mechanism.joints.friction > 0
        self._slips = list(SLIPS) if self._rubs.any() else []
        self._places = np.zeros(0)

    @property
    def is_smoothed(self) -> bool:
        """Whether the friction of the present mesh is smoothed."""
        return self._dynamics.slip > 0

    @property
    def is_present(self) -> bool:
        """Whether any joint has dry friction."""
        return bool(self._rubs.any())

    def begin_mesh(self, q_tree: Array, rates: Array) -> None:
        """Set the friction at the instants of a mesh, from a motion with configurations and rates nearby."""
        dynamics = self._dynamics
        dynamics.slip = self._slips.pop(0) if self._slips else 0.0
        dynamics.directions = None
        if self.is_present and not self.is_smoothed:
            at = dynamics.instants(q_tree, rates, 0 * rates, np.zeros((len(rates), dynamics.motors)))
            dynamics.directions = np.sign(at.v_tree)

    def end_mesh(self) -> None:
        """Return to equations without friction."""
        self._dynamics.directions = None

    def insert(self, mesh: Mesh, samples: Array, rates: Array) -> Mesh:
        """Return a mesh with knots where joints turn back, without other knots close to them, except ends of phases.

        Parameters
        ----------
        mesh : Mesh
        samples : (m,) array
            Places in units of the mesh.
        rates : (m, n) array
            v' there.
        """
        knots, places = mesh.knots, self._turns(samples, rates)
        if len(places) == len(self._places):
            places = self._places + RELAXATION * (places - self._places)
        self._places = places
        far = np.abs(knots[:, None] - places).min(axis=1, initial=1.0) > MIN_GAP * mesh.steps.min()
        return Mesh(np.unique(np.concatenate([knots[far | (knots == np.floor(knots))], places])))

    def _turns(self, samples: Array, rates: Array) -> Array:
        """Return the places at which joints with dry friction turn back."""
        before, after = rates[:-1, self._rubs], rates[1:, self._rubs]
        k, joint = np.nonzero(before * after < 0)
        share = before[k, joint] / (before[k, joint] - after[k, joint])
        places = np.sort(samples[k] + share * np.diff(samples)[k])
        return np.asarray(places[np.abs(places - np.rint(places)) > END_GAP])
