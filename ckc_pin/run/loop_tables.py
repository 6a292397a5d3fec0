"""A scene's formulation and solver as the tables that the native loop is made of."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.spec import SceneSpec

__all__ = ["formulation_table", "solver_table"]

SLACK = 3e-3  # of rtol: how far a right-hand side may be off the closure, relative to the mechanism's size
UNEVEN = 1e4  # ratio of inertias from which heavy links turn what that is into accelerations of light ones
CLOSED = 1e-9  # of the mechanism's size: the loops stay closed along a collocation step, or the branches do not meet
UNLIMITED = 2**62


def formulation_table(mechanism: Mechanism, spec: SceneSpec, inertias: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return what is integrated, and how far off the closure that may be.

    Parameters
    ----------
    inertias : (n,) array
        The diagonal of D' where the motion starts.

    Raises
    ------
    InputError
        The mechanism cannot be integrated in the scene's spf_coordinates, or off phi = 0.
    """
    if spec.formulation == "dae":
        alpha, beta = spec.solver.baumgarte or (0.0, 0.0)
        return {"kind": "dae", "tolerance": mechanism.tolerance, "projects": spec.solver.projection,
                "alpha": alpha, "beta": beta}  # fmt: skip
    table = {
        "tolerance": mechanism.tolerance,
        "epsilon": spec.epsilon if spec.formulation == "spf" else 1.0,
        "actual": spec.formulation == "spf" and spec.coriolis_velocity == "actual",
    }
    sticks = mechanism.joints.has_events(spec.friction_smoothing)
    if spec.formulation == "spf" and spec.spf_coordinates == "z":
        if mechanism.tree.free_roots:
            raise InputError(
                'spf_coordinates = "z": eq. 8 as printed integrates q and z as numbers, and the rotation of a free '
                'root is none; take "w"'
            )
        if sticks:
            raise InputError(
                f'{mechanism.name}: spf_coordinates = "z" leaves the loops open by its tolerance, and joints that '
                'stick or touch are rows of their closure; take "w"'
            )
        return {"kind": "printed", **table}
    if sticks and spec.initial.w is not None and any(spec.initial.w):
        raise InputError(
            f"initial.w: off phi = 0 the joints of {mechanism.name} that stick or touch cannot be held; leave it out"
        )
    # heavy links turn what a light one's closure is off by into accelerations
    evenness = min(1.0, UNEVEN * float(inertias.min()) / float(inertias.max()))
    return {"kind": "level_set", **table, "slack": SLACK * spec.solver.rtol * mechanism.size * evenness}


def solver_table(mechanism: Mechanism, spec: SceneSpec, profile: bool) -> dict[str, Any]:
    """Return the method, its tolerances and its limits; `profile` counts which terms are evaluated."""
    solver = spec.solver
    printed = spec.formulation == "spf" and spec.spf_coordinates == "z"
    return {
        "method": "Radau" if solver.method == "auto" and printed else solver.method,
        "rtol": solver.rtol,
        "atol": solver.rtol / 100 if solver.atol is None else solver.atol,
        "max_step": solver.max_step or math.inf,
        "min_step": solver.min_step,
        "max_rhs": solver.max_rhs or UNLIMITED,
        "closed": max(CLOSED * mechanism.size, 10 * mechanism.tolerance),
        "profile": profile,
    }
