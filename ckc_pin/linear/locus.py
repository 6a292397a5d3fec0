"""Root locus: eigenvalues of a closed loop as functions of a gain of its controller."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.summary import HasSummary, Row, Summary, format_eigenvalues, to_pairs
from ckc_pin.base.validation import require_type
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import LAWS, ClosedLoop
from ckc_pin.linear.modes import ComplexArray, compute_eigenvalues
from ckc_pin.run.compiled_terms import select_library
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.names import is_scene_name
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["GainLocus", "gain_locus"]

FACTORS = np.geomspace(0.01, 10.0, 121)
GAINS = {SetPoint: ("K_P", "K_V"), Tracking: ("K_D", "Lambda")}


@dataclass(frozen=True, eq=False, repr=False)
class GainLocus(HasSummary):
    """Eigenvalues of a scene's closed loop for multiples of one gain. `ckc_pin.plot` draws it.

    Attributes
    ----------
    name : str
        The scene's name.
    gain : "K_P", "K_V", "K_D" or "Lambda"
        The first two are gains of a set point, the others of tracking.
    at : str
        Description of the state.
    factors : (m,) array
        Multiples of the scene's gain.
    eigenvalues : (m, 2 d) complex array
        1/s, at the target or at the start of the desired motion; in each row by decreasing real part.
    """

    name: str
    gain: str
    at: str
    factors: Array
    eigenvalues: ComplexArray

    @property
    def scene_index(self) -> int:
        """Index of the factor that is closest to 1, the scene's gain."""
        return int(np.argmin(np.abs(np.log(self.factors))))

    def summary(self) -> Summary:
        """Return the eigenvalues at both ends of the locus and at the scene's gain."""
        rows: list[Row] = [
            (f"{self.gain} times {self.factors[k]:.4g}", f"{format_eigenvalues(self.eigenvalues[k])} 1/s")
            for k in sorted({0, self.scene_index, len(self.factors) - 1})
        ]
        return Summary(f"GainLocus of {self.name}, {self.at}: {len(self.factors)} factors on {self.gain}", rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the locus as JSON-ready data, complex numbers as [re, im]."""
        return {
            "name": self.name,
            "gain": self.gain,
            "at": self.at,
            "factors": self.factors.tolist(),
            "eigenvalues": [to_pairs(row) for row in self.eigenvalues],
        }


def gain_locus(
    what: Scene | str | Path, gain: str | None = None, overrides: Mapping[str, Any] | None = None
) -> GainLocus | None:
    """Return the root locus of a scene's closed loop with respect to a gain.

    Parameters
    ----------
    what : Scene, str or Path
        A scene, or its name or path.
    gain : "K_P", "K_V", "K_D" or "Lambda", optional
        A gain of the scene's controller. Default: K_P of a set point and K_D of tracking.
    overrides : mapping, optional
        Overrides of the scene's keys.

    Returns
    -------
    GainLocus or None
        None if `what` is not a scene, has neither a set point nor tracking, or cannot reach its target or start.
        Sampling, torque limits and dry friction are ignored.

    Raises
    ------
    InputError
        The controller has no such gain, the start is out of reach, or the scene cannot be loaded.
    NumericalError
        The start is singular, or J has lost rank.
    """
    require_type(what, (Scene, str, Path), "gain_locus: what", "a scene: itself, its name or path")
    if not isinstance(what, Scene):
        if not is_scene_name(str(what)):
            return None
        what = load_scene(what, overrides)
    else:
        what = what.with_overrides(overrides)
    what.refuse_forces("gain_locus")
    mechanism = load_scene_mechanism(what)
    law = build_scene_controller(what, mechanism)
    if not isinstance(law, SetPoint | Tracking) or type(law) not in LAWS:
        return None
    gains = GAINS[type(law)]
    if gain is not None and gain not in gains:
        raise InputError(f"gain_locus: gain = {gain!r:.80}: the controller of {what.name} has {' and '.join(gains)}")
    gain = gain or gains[0]
    q, q_dot = (law.q_d, np.zeros(mechanism.d)) if isinstance(law, SetPoint) else law.desired(0.0)[:2]
    solution = sigma(mechanism, q, find_start(mechanism, what).at)  # on the assembly branch of a run
    if solution.verdict != "converged":
        return None
    state = Terms(mechanism, solution.at, solution.at.rho @ q_dot)
    values = []
    with one_blas_thread(with_scipy=True):
        library = select_library(mechanism, what.spec.solver.terms)
        loop = ClosedLoop(mechanism, law, what.spec.friction_smoothing, library)
        for factor in FACTORS:
            scaled = copy.copy(law)
            setattr(scaled, gain, factor * getattr(law, gain))
            loop.law = scaled
            values.append(compute_eigenvalues(loop.linearize(0.0, state).A_closed))
    at = "at its target" if isinstance(law, SetPoint) else "at the start of the desired motion"
    if mechanism.joints.friction.any() and what.spec.friction_smoothing is None:
        at += " without dry friction"
    return GainLocus(what.name, gain, at, FACTORS, np.array(values))
