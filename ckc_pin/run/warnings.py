"""Warnings to print before a run: the start outside joint limits, a desired motion that cannot be followed."""

from __future__ import annotations

from ckc_pin.base.arrays import Array
from ckc_pin.control.controllers import RecordedTorques, SetPoint, Tracking
from ckc_pin.control.workspace import DesiredCheck, follow_desired
from ckc_pin.errors import CkcError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.warnings import list_limit_violations
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.parts import scene_controller, scene_mechanism
from ckc_pin.scene.scene import Scene

__all__ = ["check_desired", "desired_warnings", "limit_warnings", "run_warnings"]

# A desired motion that comes nearer to singular than this part of the assembled sigma_min(phi_z) gets a warning.
SIGMA_MIN_WARNING = 0.1


def run_warnings(scene: Scene) -> list[str]:
    """Return what of a controlled scene's check may spoil a run of it: its start, its desired trajectory."""
    if scene.spec.controller is None:
        return []
    mechanism = scene_mechanism(scene)
    try:
        start = find_start(mechanism, scene)
    except CkcError:  # the run says so itself
        return []
    desired = check_desired(scene_controller(scene, mechanism), mechanism, scene.spec.t_end, start)
    outside = limit_warnings(mechanism, start.at.q_tree, "the start")
    return outside + desired_warnings(mechanism, desired, scene.spec.t_end)


def check_desired(
    controller: SetPoint | Tracking | RecordedTorques | None, mechanism: Mechanism, t_end: float, start: Start | None
) -> DesiredCheck | None:
    """Follow the desired motion from the start on: whether the mechanism can, and how close to singular it comes."""
    near = None if start is None else start.at
    if isinstance(controller, Tracking):
        return follow_desired(mechanism, controller.desired, t_end, near)
    if isinstance(controller, SetPoint):
        target = sigma(mechanism, controller.q_d, near)
        return DesiredCheck(None, 0.0, target.at.sigma_min()) if target.verdict == "converged" else None
    return None


def limit_warnings(mechanism: Mechanism, q_tree: Array, what: str) -> list[str]:
    """Name the joints that a configuration has outside their limits."""
    outside = list_limit_violations(mechanism, q_tree)
    return [f"{what} is outside joint limits: {', '.join(outside)}"] if outside else []


def desired_warnings(mechanism: Mechanism, desired: DesiredCheck | None, t_end: float) -> list[str]:
    """Say where a desired motion leaves the workspace or comes close to a singular configuration."""
    if desired is None:
        return []
    if desired.leaves_at is not None:
        return [
            f"the desired trajectory leaves the workspace at t = {desired.leaves_at:.5f} s: "
            f"{', '.join(mechanism.independent)} cannot follow it from there"
        ]
    says = []
    if desired.until < t_end:
        says.append(
            f"the desired trajectory is so quick that it was followed to t = {desired.until:.5g} s only: whether it "
            "leaves the workspace later is not known"
        )
    usual = mechanism.assembled.sigma_min()
    if desired.sigma_min < SIGMA_MIN_WARNING * usual:
        says.append(
            f"the desired trajectory comes close to a singular configuration at t = {desired.closest_t:.5f} s: "
            f"sigma_min(phi_z) = {desired.sigma_min:.3g} there, {usual:.3g} as assembled"
        )
    return says
