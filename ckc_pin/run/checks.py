"""Checks before a run: errors that prevent it, and warnings to print before it."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import (
    Controller,
    RecordedTorques,
    SetPoint,
    TorqueController,
    Tracking,
    is_torque_controller,
)
from ckc_pin.control.sampled import Sampled
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.dynamics.formulations import require_mass
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import CkcError, InputError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.mechanism.warnings import describe_stop_violation, list_limit_violations
from ckc_pin.scene.initial import Start, find_start, require_chart
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["check_desired", "desired_warnings", "limit_warnings", "require_runnable", "run_warnings"]

# A desired motion gets a warning where sigma_min(phi_z) falls below this fraction of its value as assembled.
SIGMA_MIN_WARNING_FRACTION = 0.1


def require_runnable(
    scene: Scene,
    mechanism: Mechanism,
    controller: Controller | TorqueController | Sampled | None,
    actuation: Actuation,
    *,
    free: bool = False,
) -> Start:
    """Return the start of a scene, after checking that it can be run from there under a controller.

    Parameters
    ----------
    free : bool
        The caller gives u step by step; there is no controller.

    Raises
    ------
    InputError, NumericalError
        The mechanism has no freedom, the start is singular or beyond a stop, or the motors cannot produce the
        controller's u.
    """
    if isinstance(controller, Sampled):
        with scene.sources.prefix_errors():
            controller.require_sample_count(scene.spec.t_end)
            controller.require_usable_sensor(mechanism)
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: the loops leave no freedom (d = 0), so nothing can move")
    if mechanism.splits_root and (controller is not None or free or scene.spec.formulation != "dae"):
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    start = find_start(mechanism, scene)
    with scene.sources.prefix_errors():
        if beyond := describe_stop_violation(mechanism, start.at.q_tree):
            raise InputError(f"initial: {beyond}; give another initial.q, or a q_guess within the stops")
    require_mass(Terms(mechanism, start.at, np.zeros(mechanism.n)), start.at.rho, start.at.partition.q)
    law = controller.controller if isinstance(controller, Sampled) else controller
    if law is not None and not is_torque_controller(law):
        require_chart(mechanism, start)
        actuation.require_driven_freedoms(start.at)
    return start


def run_warnings(scene: Scene) -> list[str]:
    """Return warnings to print before a run: a start outside joint limits, a desired motion that cannot be followed."""
    if scene.spec.controller is None:
        return []
    mechanism = load_scene_mechanism(scene)
    try:
        start = find_start(mechanism, scene)
    except CkcError:  # The run reports this error itself.
        return []
    desired = check_desired(build_scene_controller(scene, mechanism), mechanism, scene.spec.t_end, start)
    outside = limit_warnings(mechanism, start.at.q_tree, "the start")
    return outside + desired_warnings(mechanism, desired, scene.spec.t_end)


def check_desired(
    controller: SetPoint | Tracking | RecordedTorques | None, mechanism: Mechanism, t_end: float, start: Start | None
) -> DesiredCheck | None:
    """Follow a controller's desired motion from the start: can the mechanism do it, and how close to singular is it.

    Returns None where there is no desired motion.
    """
    reference = None if start is None else start.at
    if isinstance(controller, Tracking):
        return follow_desired(mechanism, controller.desired, t_end, reference)
    if isinstance(controller, SetPoint):
        target = sigma(mechanism, controller.q_d, reference)
        return DesiredCheck(None, 0.0, target.at.sigma_min()) if target.verdict == "converged" else None
    return None


def limit_warnings(mechanism: Mechanism, q_tree: Array, configuration: str) -> list[str]:
    """Return a warning that names the joints outside their limits; `configuration` is the sentence's subject."""
    outside = list_limit_violations(mechanism, q_tree)
    return [f"{configuration} is outside joint limits: {', '.join(outside)}"] if outside else []


def desired_warnings(mechanism: Mechanism, desired: DesiredCheck | None, t_end: float) -> list[str]:
    """Return warnings of a desired motion that leaves the workspace or comes close to a singular configuration."""
    if desired is None:
        return []
    if desired.leaves_at is not None:
        return [
            f"the desired trajectory leaves the workspace at t = {desired.leaves_at:.5f} s: "
            f"{', '.join(mechanism.independent)} cannot follow it from there"
        ]
    warnings = []
    if desired.until < t_end:
        warnings.append(
            f"the desired trajectory was checked up to t = {desired.until:.5g} s only, because it oscillates or turns "
            "too fast; it may leave the workspace later"
        )
    usual = mechanism.assembled.sigma_min()
    if desired.sigma_min < SIGMA_MIN_WARNING_FRACTION * usual:
        warnings.append(
            f"the desired trajectory comes close to a singular configuration at t = {desired.closest_t:.5f} s: "
            f"sigma_min(phi_z) = {desired.sigma_min:.3g} there, {usual:.3g} as assembled"
        )
    return warnings
