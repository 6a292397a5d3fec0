"""Motor torques that hold a pose, and the forces of its loops and joints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.forces import generalized_force
from ckc_pin.dynamics.formulations import dae_acceleration, multipliers
from ckc_pin.dynamics.inverse import friction_force, joint_wrenches, loop_wrenches
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import NumericalError
from ckc_pin.explorer.quantity import LiveQuantity, PoseState, ShownQuantities, format_number
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.units import effort, motor_units
from ckc_pin.view.arrows import (
    Arrow,
    create_joint_arrows,
    create_loop_arrows,
    create_motor_arrows,
    draw_arrows,
    format_arrow_scales,
    place_arrows,
)
from ckc_pin.view.commands import Command

__all__ = ["Forces", "HoldingTorques", "compute_pose_forces"]

MAX_JOINT_LINES = 8  # joints with the largest forces
MIN_SCALE_RATIO = 0.2  # of the largest arrow to its scale: below it the scale is chosen again
ARROW_OPACITY = 0.85
MIN_FORCE = 1e-9  # N or N m: smaller ones set no scale


class HoldingTorques(LiveQuantity):
    """Motor torques that hold the pose at rest, and h of eq. 6."""

    name, label = "holding_torques", "torques that hold this pose"

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        mechanism = self.mechanism
        if mechanism.prescribed:
            return f"the motion of {', '.join(mechanism.prescribed)} is prescribed"
        if not any(mechanism.spec.gravity) and not mechanism.springs.any:
            return "without gravity and springs, nothing has to be held"
        return "" if mechanism.d else "the mechanism has no freedoms"

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return h by coordinate, tau by motor, and the missing part of h if the motors cannot hold the pose."""
        mechanism, static = self.mechanism, state.static_forces
        names = mechanism.independent
        units = [effort(mechanism.tree.units()[k]) for k in mechanism.partition.q]
        lines = [["h", "not defined: phi_z is singular here"]]
        if not state.is_singular:
            lines = _label("h of", names, state.rest.h, units)
        lines += _label("motor", mechanism.actuated, static.tau, motor_units(mechanism))
        if static.reason:
            lines.append(["not held", static.reason])
        if static.reason and not state.is_singular:
            lines += _label("remains along", names, static.missing, units)
        if static.loaded_stops:
            lines.append(["stops that hold it", ", ".join(static.loaded_stops)])
        if static.uses_friction:
            lines.append(["dry friction", "holds a part of it"])
        return lines


class Forces(LiveQuantity):
    """Forces of loops and joints, and motor torques, as arrows."""

    name, label = "forces", "forces of loops and joints"

    def __init__(self, mechanism: Mechanism, actuation: Actuation) -> None:
        super().__init__(mechanism, actuation)
        self.scales: dict[bool, float] = {}

    def explain_unavailable(self) -> str:
        """Return why it cannot be shown for this mechanism, or an empty text."""
        names = self.mechanism.prescribed
        return f"the motion of {', '.join(names)} is prescribed" if names else ""

    def draw(self) -> Iterable[Command]:
        """Return the arrows, which are placed when they are evaluated."""
        self.scales = {}
        state = PoseState(self.mechanism, self.actuation, self.mechanism.assembled)
        zeros = np.zeros(6)
        joints = dict.fromkeys(self._joint_names(), zeros)
        arrows = self._create_arrows(
            state, {spec.name: zeros for spec in self.mechanism.spec.loop}, joints, 0.0 * self.actuation.zero.tau
        )
        return [*draw_arrows(self.root, arrows, ARROW_OPACITY), *self._place(arrows)]

    def evaluate(self, state: PoseState, shown: ShownQuantities) -> list[list[str]]:
        """Return the sizes of the forces; move the arrows."""
        loops, joints, tau = compute_pose_forces(state)
        arrows = self._create_arrows(state, loops, joints, tau)
        self._choose_scales(arrows)
        shown.commands += self._place(arrows)
        lines = [["long arrows", format_arrow_scales(self.scales) or "no forces"]]
        lines += [[f"loop {name}", _format_wrench(wrench)] for name, wrench in loops.items()]
        largest = sorted(joints, key=lambda name: -float(joints[name][:3] @ joints[name][:3]))[:MAX_JOINT_LINES]
        lines += [[f"joint {name}", _format_wrench(joints[name])] for name in largest]
        if len(joints) > MAX_JOINT_LINES:
            lines.append(["", f"and {len(joints) - MAX_JOINT_LINES} joints with smaller forces"])
        if state.v_tree is None and state.static_forces.reason:
            lines.append(["not held", "what remains acts along the independent coordinates"])
        if state.v_tree is not None and (self.mechanism.joints.friction.any() or self.mechanism.joints.stopped.any()):
            lines.append(["left out", "stops, and dry friction of joints that stick"])
        return lines

    def _joint_names(self) -> list[str]:
        model = self.mechanism.tree.model
        return [name for name, joint in zip(list(model.names), list(model.joints), strict=True) if joint.nv == 1]

    def _create_arrows(
        self, state: PoseState, loops: dict[str, Array], joints: dict[str, Array], tau: Array
    ) -> list[Arrow]:
        mechanism, poses = self.mechanism, state.placements
        return [
            *create_loop_arrows(mechanism, [loops], poses),
            *(create_joint_arrows(mechanism, [joints], poses) if joints else []),
            *create_motor_arrows(mechanism, tau[None], poses),
        ]

    def _place(self, arrows: list[Arrow]) -> Iterable[Command]:
        return place_arrows(self.root, arrows, self.mechanism.size, self.scales)

    def _choose_scales(self, arrows: list[Arrow]) -> None:
        """Keep the scale of forces and of torques while the largest arrow fits to it, so that arrows compare."""
        for is_torque in (False, True):
            vectors = np.array([arrow.vector[0] for arrow in arrows if arrow.is_torque == is_torque]).reshape(-1, 3)
            largest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
            scale = self.scales.get(is_torque, 0.0)
            if largest > MIN_FORCE and not MIN_SCALE_RATIO * scale <= largest <= scale:
                self.scales[is_torque] = _round_up(largest)


def compute_pose_forces(state: PoseState) -> tuple[dict[str, Array], dict[str, Array], Array]:
    """Return the wrenches of loops and joints, (6,) by name, and the motor torques.

    At rest they hold the pose. A part that the motors cannot hold is added along the independent coordinates. In motion
    they go with the state's velocity and torques.

    Raises
    ------
    NumericalError
        J has lost rank, or the motors cannot hold the pose and phi_z is singular.
    """
    mechanism, wrenches = state.mechanism, state.link_wrenches
    if state.v_tree is None:
        terms, tau = state.rest, state.static_forces.tau
        if np.isnan(state.static_forces.missing).any():
            raise NumericalError("the motors cannot hold this pose, and phi_z is singular here")
        other_force = state.static_forces.passive_force.copy()
        other_force[state.at.partition.q] += state.static_forces.missing
        acceleration = np.zeros(mechanism.n)
    else:
        terms = Terms(mechanism, state.at, state.v_tree)
        tau = state.actuation.zero.tau if state.tau is None else state.tau
        other_force = friction_force(mechanism, state.v_tree)
        if wrenches is not None:
            other_force = other_force + generalized_force(wrenches, terms)
        acceleration = dae_acceleration(terms, mechanism.motors.force(tau) + other_force)
    forces = multipliers(terms, mechanism.motors.force(tau) + other_force, acceleration)
    applied = 0.0 if wrenches is None or state.v_tree is None else wrenches
    return loop_wrenches(terms, forces), joint_wrenches(terms, acceleration, forces, applied), tau


def _label(what: str, names: Sequence[str], values: Array, units: Sequence[str]) -> list[list[str]]:
    return [[f"{what} {name}", format_number(x, unit)] for name, x, unit in zip(names, values, units, strict=True)]


def _format_wrench(wrench: Array) -> str:
    force, moment = (format_number(float(np.linalg.norm(part)), unit)
                     for part, unit in ((wrench[:3], "N"), (wrench[3:], "N m")))  # fmt: skip
    return f"{force}, {moment}"


def _round_up(size: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= size))
