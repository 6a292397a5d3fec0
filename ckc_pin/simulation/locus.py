"""Where a closed loop's eigenvalues go as a gain of its controller is turned up."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.check import names_a_scene
from ckc_pin.simulation.closed_loop import ClosedLoop
from ckc_pin.simulation.libraries import library_of
from ckc_pin.simulation.prepare import scene_controller, scene_mechanism
from ckc_pin.simulation.scene import load_scene

__all__ = ["GainLocus", "gain_locus"]

FACTORS = np.geomspace(0.01, 10.0, 121)


@dataclass(frozen=True)
class GainLocus:
    """Eigenvalues of a scene's closed loop by a factor on one gain.

    Attributes
    ----------
    name : str
        The scene's.
    gain : "K_P" or "K_D"
        Of a set point, of tracking.
    factors : (m,) array
    eigenvalues : (m, 2 d) complex array
        1/s, at the target or at the start of the desired motion; those of one row in no order.
    """

    name: str
    gain: str
    factors: Array
    eigenvalues: NDArray[np.complex128]


def gain_locus(what: str | Path, changes: Mapping[str, Any] | None = None) -> GainLocus | None:
    """Return the locus of a scene's closed loop; None where it has no set point and no tracking, or cannot be there.

    Parameters
    ----------
    what : str or Path
        A scene; of a mechanism there is none.
    """
    if not names_a_scene(str(what)):
        return None
    scene = load_scene(what, changes)
    mechanism = scene_mechanism(scene)
    law = scene_controller(scene, mechanism)
    if not isinstance(law, SetPoint | Tracking):
        return None
    q, q_dot = (law.q_d, np.zeros(mechanism.d)) if isinstance(law, SetPoint) else law.desired(0.0)[:2]
    found = sigma(mechanism, q)
    if found.verdict != "converged":
        return None
    gain = "K_P" if isinstance(law, SetPoint) else "K_D"
    state = Terms(mechanism, found.at, found.at.rho @ q_dot)
    values = []
    with one_blas_thread():
        loop = ClosedLoop(mechanism, law, scene.spec.friction_smoothing, library_of(mechanism, scene.spec.solver.terms))
        for factor in FACTORS:
            turned = copy.copy(law)
            setattr(turned, gain, factor * getattr(law, gain))
            loop.law = turned
            values.append(np.linalg.eigvals(loop.at(0.0, state).closed))
    return GainLocus(scene.name, gain, FACTORS, np.array(values))
