"""Where a closed loop's eigenvalues go as a gain of its controller is turned up."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.summary import HasSummary, Row, Summary, format_eigenvalues
from ckc_pin.base.validation import require_type
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.linear.closed_loop import ClosedLoop
from ckc_pin.linear.modes import ComplexArray, eigenvalues_of
from ckc_pin.run.compiled_terms import library_of
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.parts import scene_controller, scene_mechanism
from ckc_pin.scene.scene import Scene, load_scene, names_a_scene

__all__ = ["GainLocus", "gain_locus"]

FACTORS = np.geomspace(0.01, 10.0, 121)
GAINS = {SetPoint: ("K_P", "K_V"), Tracking: ("K_D", "Lambda")}


@dataclass(frozen=True, eq=False, repr=False)
class GainLocus(HasSummary):
    """Eigenvalues of a scene's closed loop by a factor on one gain; `ckc_pin.plot` draws it.

    Attributes
    ----------
    name : str
        The scene's.
    gain : "K_P" or "K_V"; "K_D" or "Lambda"
        Of a set point; of tracking.
    at : str
        The state, in words.
    factors : (m,) array
    eigenvalues : (m, 2 d) complex array
        1/s, at the target or at the start of the desired motion; those of one row in falling order of real parts.
    """

    name: str
    gain: str
    at: str
    factors: Array
    eigenvalues: ComplexArray

    @property
    def own(self) -> int:
        """Where the scene's own gain is among the factors."""
        return int(np.argmin(np.abs(np.log(self.factors))))

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return locus_summary(self)


def gain_locus(
    what: Scene | str | Path, gain: str | None = None, overrides: Mapping[str, Any] | None = None
) -> GainLocus | None:
    """Return the locus of a scene's closed loop over a gain.

    Parameters
    ----------
    what : Scene, str or Path
        A scene, itself, its name or path.
    gain : "K_P", "K_V", "K_D" or "Lambda", optional
        One of its controller's; absent, K_P of a set point and K_D of tracking.
    overrides : mapping, optional
        Values of the scene by dotted key; with a name.

    Returns
    -------
    GainLocus or None
        None where it is no scene, has no set point and no tracking, or cannot be at its target or start. Sampling,
        torque limits and dry friction are not in it.

    Raises
    ------
    InputError
        No such gain, a start out of reach, or what cannot be loaded.
    NumericalError
        A start that is singular, J that has lost rank.
    """
    import scipy.linalg  # noqa: F401  (with its BLAS, before that is kept on one thread)

    require_type(what, (Scene, str, Path), "gain_locus: what", "a scene: itself, its name or path")
    if not isinstance(what, Scene):
        if not names_a_scene(str(what)):
            return None
        what = load_scene(what, overrides)
    elif overrides:
        raise InputError("gain_locus: overrides go with a name; a Scene is complete")
    mechanism = scene_mechanism(what)
    law = scene_controller(what, mechanism)
    if not isinstance(law, SetPoint | Tracking):
        return None
    gains = GAINS[type(law)]
    if gain is not None and gain not in gains:
        raise InputError(f"gain_locus: gain = {gain!r:.80}: the controller of {what.name} has {' and '.join(gains)}")
    gain = gain or gains[0]
    at_rest = isinstance(law, SetPoint)
    q, q_dot = (law.q_d, np.zeros(mechanism.d)) if isinstance(law, SetPoint) else law.desired(0.0)[:2]
    found = sigma(mechanism, q, find_start(mechanism, what).at)  # on the branch that a run is on
    if found.verdict != "converged":
        return None
    state = Terms(mechanism, found.at, found.at.rho @ q_dot)
    values = []
    with one_blas_thread():
        loop = ClosedLoop(mechanism, law, what.spec.friction_smoothing, library_of(mechanism, what.spec.solver.terms))
        for factor in FACTORS:
            turned = copy.copy(law)
            setattr(turned, gain, factor * getattr(law, gain))
            loop.law = turned
            values.append(eigenvalues_of(loop.at(0.0, state).closed))
    at = "at its target" if at_rest else "at the start of the desired motion"
    if mechanism.joints.friction.any() and what.spec.friction_smoothing is None:
        at += " without dry friction"
    return GainLocus(what.name, gain, at, FACTORS, np.array(values))


def locus_summary(found: GainLocus) -> Summary:
    """Return where the eigenvalues of a closed loop are at the ends of a locus, and as the scene has the gain."""
    rows: list[Row] = [
        (f"{found.gain} times {found.factors[k]:.4g}", f"{format_eigenvalues(found.eigenvalues[k])} 1/s")
        for k in sorted({0, found.own, len(found.factors) - 1})
    ]
    return Summary(f"GainLocus of {found.name}, {found.at}: {len(found.factors)} factors on {found.gain}", rows)
