"""Checks before a run: errors that prevent it, and warnings to print before it."""

from __future__ import annotations

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import (
    Controller,
    SetPoint,
    TorqueController,
    Tracking,
    is_torque_controller,
)
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.sampled import Sampled, unwrap_sampled
from ckc_pin.control.spec import SetPointSpec
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.dynamics.formulations import require_mass
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import CkcError, InputError
from ckc_pin.kinematics.loop_types import describe_locking_loops
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.mechanism.unit_hints import describe_degrees, looks_like_degrees
from ckc_pin.mechanism.warnings import describe_stop_violation, list_limit_violations
from ckc_pin.scene.initial import Start, find_start, require_chart
from ckc_pin.scene.parts import build_scene_controller, load_scene_mechanism, prescribed_motions
from ckc_pin.scene.scene import Scene

__all__ = ["check_desired", "desired_warnings", "limit_warnings", "require_runnable", "run_warnings", "start_warnings"]

# A desired motion gets a warning where sigma_min(phi_z) falls below this fraction of its value as assembled.
SIGMA_MIN_WARNING_FRACTION = 0.1
PRESCRIBED_SAMPLES = 1001  # instants at which a prescribed motion is compared with the joint's stops


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
    if mechanism.prescribed:
        with scene.sources.prefix_errors():
            _require_prescribable(scene, mechanism, controller)
    elif mechanism.d == 0:
        locking = describe_locking_loops(mechanism)
        reason = f"; {locking}" if locking else ""
        raise InputError(f"{mechanism.name}: the loops leave no freedom (d = 0), so nothing can move{reason}")
    if mechanism.splits_root and (controller is not None or free or scene.spec.formulation != "dae"):
        raise InputError(f"{mechanism.name}: {CONSTRAINED_IN_PART}")
    start = find_start(mechanism, scene)
    with scene.sources.prefix_errors():
        if beyond := describe_stop_violation(mechanism, start.at.q_tree):
            raise InputError(f"initial: {beyond}; give another initial.q, or a q_guess within the stops")
    if mechanism.d:
        require_mass(Terms(mechanism, start.at, np.zeros(mechanism.n)), start.at.rho, start.at.partition.q)
    law = unwrap_sampled(controller)
    has_gravity = isinstance(law, JointServo) and law.gravity
    if has_gravity and (reason := actuation.explain_undriven_freedoms(start.at)):
        raise InputError(f"controller.gravity: the motors cannot balance it: {reason}")
    if law is not None and not is_torque_controller(law):
        require_chart(mechanism, start)
        actuation.require_driven_freedoms(start.at)
    return start


def _require_prescribable(
    scene: Scene, mechanism: Mechanism, controller: Controller | TorqueController | Sampled | None
) -> None:
    """Raise InputError if a scene combines prescribed joints with something that does not know them."""
    spec, names = scene.spec, ", ".join(mechanism.prescribed)
    if spec.formulation == "spf" and (spec.spf_coordinates == "z" or spec.coriolis_velocity == "actual"):
        raise InputError(
            f'prescribed: {names}: the SPF needs spf_coordinates = "w" and coriolis_velocity = "rho" with prescribed '
            "joints"
        )
    law = unwrap_sampled(controller)
    if isinstance(law, SetPoint | Tracking):
        raise InputError(
            f"prescribed: {names}: the controllers of eqs. 14 and 16 assume loops that do not move by themselves; use "
            "torques or a controller of your own"
        )
    if isinstance(controller, Sampled) and controller.sensor is not None:
        raise InputError(f"prescribed: {names}: sensors are not supported with prescribed joints; remove the sensor")
    joints = mechanism.joints
    sticks = joints.has_events(spec.friction_smoothing) & (joints.stopped | (joints.friction != 0.0))
    driven = mechanism.freedoms.immobile.copy()
    driven[mechanism.prescribed_at] = False
    if (sticks & driven).any():
        k = int(np.flatnonzero(sticks & driven)[0])
        raise InputError(
            f"prescribed: {names}: {mechanism.coordinates[k]} moves with it alone, so its dry friction and stops "
            "cannot hold it; give friction_smoothing, or remove its friction and stops"
        )
    times = np.linspace(0.0, spec.t_end, PRESCRIBED_SAMPLES)
    for k, one, motion in zip(
        mechanism.prescribed_at, spec.prescribed, prescribed_motions(spec.prescribed), strict=True
    ):
        name = one.joint
        if one.can_be_free:
            if joints.stopped[k] or (joints.friction[k] and spec.friction_smoothing is None):
                raise InputError(
                    f"prescribed: {name} moves freely before it begins or after it ends, where its dry friction and "
                    "stops are not supported; give friction_smoothing, or remove its friction and stops"
                )
            continue
        values = np.array([motion(t)[0][0] for t in times])
        beyond = np.flatnonzero((values < joints.lower[k]) | (values > joints.upper[k]))
        if len(beyond):
            raise InputError(
                f"prescribed: {name} = {values[beyond[0]]:.6g} at t = {times[beyond[0]]:.6g} s is beyond its stop; its "
                f"range is {joints.lower[k]:g} to {joints.upper[k]:g}"
            )


def run_warnings(scene: Scene) -> list[str]:
    """Return warnings to print before a run: about the mechanism, the start and the desired motion."""
    mechanism = load_scene_mechanism(scene)
    try:
        start = find_start(mechanism, scene)
    except CkcError:  # The run reports this error itself.
        return mechanism.warnings
    desired = None
    if scene.spec.controller is not None or scene.controller is not None:
        desired = check_desired(build_scene_controller(scene, mechanism), mechanism, scene.spec.t_end, start)
    return [
        *mechanism.warnings,
        *start_warnings(scene, mechanism, start),
        *desired_warnings(mechanism, desired, scene.spec.t_end),
    ]


def start_warnings(scene: Scene, mechanism: Mechanism, start: Start) -> list[str]:
    """Return warnings of a start outside joint limits, and of a start or target that looks like degrees."""
    units = dict(zip(mechanism.coordinates, mechanism.tree.units(), strict=True))
    angles = {f"initial.q.{name}": x for name, x in scene.spec.initial.q.items() if units.get(name) == "rad"}
    if isinstance(scene.spec.controller, SetPointSpec) and scene.controller is None:
        targets = scene.spec.controller.q_d
        angles |= {f"controller.q_d.{name}": x for name, x in targets.items() if units.get(name) == "rad"}
    degrees = describe_degrees({name: x for name, x in angles.items() if looks_like_degrees(x)})
    return [*degrees, *limit_warnings(mechanism, start.at.q_tree, "the start")]


def check_desired(
    controller: Controller | TorqueController | None, mechanism: Mechanism, t_end: float, start: Start | None
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
