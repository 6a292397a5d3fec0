"""Run works with Pinocchio's constraintDynamics and Baumgarte terms, stepped as in its closed-loop examples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, TypeAlias

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.frames import Frame
from ckc_pin.mechanism.mechanism import Mechanism
from scripts.experiments.benchmark.peers.stepping import (
    CONTROLLED,
    dividing_step,
    halved_steps,
    run_fixed_step,
    start_of,
)
from scripts.experiments.benchmark.work import Work

__all__ = ["Pinocchio", "closure_constraints", "closure_unsupported"]

COARSEST, STEPS, QUICK_STEPS = 5e-3, 10, 6  # s, and numbers of halvings
GAINS = (10.0, 100.0)  # K_p of the examples, 1/s^2, and a stiffer one; K_d = 2 sqrt(K_p)
CLOSED_BY = {
    "point": pin.ContactType.CONTACT_3D,
    "point_2d": pin.ContactType.CONTACT_3D,
    "hinge": pin.ContactType.CONTACT_3D,
    "weld": pin.ContactType.CONTACT_6D,
}

Constraint: TypeAlias = tuple[
    pin.ContactType, int, pin.SE3, int, pin.SE3
]  # contact type; joint and placement on it, for both frames


class Pinocchio:
    """Semi-implicit Euler, v += a dt and q = q + v dt, with the constrained acceleration a."""

    name = "Pinocchio constraintDynamics"
    packaged = True

    def missing(self, work: Work) -> str | None:
        if work.mechanism.springs.between_frames or work.mechanism.springs.joint_stiffness.any():
            return "springs are no part of its models"
        return closure_unsupported(work)

    def version(self) -> str:
        return str(pin.__version__)

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        for gain, dt in product(GAINS, halved_steps(work, COARSEST, QUICK_STEPS if quick else STEPS)):
            yield f"K_p {gain:g}, dt {dt:.3g}"

    def check(self, work: Work) -> str:
        return "the tree is the same model"

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        gain, dt = (float(part.split()[1]) for part in setting.split(", "))
        mechanism, model = work.mechanism, work.mechanism.tree.model
        data, constraints = model.createData(), _constraints(mechanism, gain)
        constraint_data = pin.StdVec_RigidConstraintData()
        constraint_data.extend(constraint.createData() for constraint in constraints)
        pin.initConstraintDynamics(model, data, constraints, constraint_data)
        settings = pin.ProximalSettings(1e-12, 1e-10, 10)  # loops with redundant rows need a small mu
        tau, state = mechanism.springs.constant, {"q": np.empty(0), "v": np.empty(0)}
        h = dividing_step(work, dt)

        def reset() -> None:
            state["q"], state["v"] = start_of(work)

        def step(many: int) -> None:
            q, v = state["q"], state["v"]
            for _ in range(many):
                a = pin.constraintDynamics(model, data, q, v, tau, constraints, constraint_data, settings)
                v = v + h * a
                q = pin.integrate(model, q, h * v)
            state["q"], state["v"] = q, v

        def read() -> tuple[Array, Array]:
            return mechanism.tree.to_coordinates(state["q"]), state["v"]

        return run_fixed_step(work, dt, FixedStepProgram(reset, step, read), budget)


def closure_unsupported(work: Work) -> str | None:
    """Return why Pinocchio's constraints cannot model a work, None if they can."""
    others = {loop.type for loop in work.mechanism.spec.loop} - set(CLOSED_BY)
    if work.controlled:
        return CONTROLLED
    if others or work.mechanism.spec.coupling:
        return f"it has no constraint model for {', '.join(sorted(others)) or 'couplings'}"
    return None


def closure_constraints(mechanism: Mechanism) -> Iterator[Constraint]:
    """Yield each loop as one constraint, and a hinge as two constraints at points of its axis."""
    for loop in mechanism.spec.loop:
        a, b = (mechanism.frames.find(frame, f"loop {loop.name!r}") for frame in (loop.frame_a, loop.frame_b))
        kind, axes = CLOSED_BY[loop.type], (loop.axis_a, loop.axis_b)
        yield kind, a.joint, _moved(a), b.joint, _moved(b)
        if loop.type == "hinge":
            ends = [_moved(frame, axis, mechanism.size) for frame, axis in zip((a, b), axes, strict=True)]
            yield kind, a.joint, ends[0], b.joint, ends[1]


def _moved(frame: Frame, axis: Sequence[float] = (1.0, 0.0, 0.0), by: float = 0.0) -> pin.SE3:
    """Return a frame's placement on its joint, translated along an axis of the frame."""
    direction = np.array(axis) / np.linalg.norm(axis)
    return pin.SE3(frame.rotation, frame.translation + frame.rotation @ direction * by)


def _constraints(mechanism: Mechanism, gain: float) -> Any:
    constraints = pin.StdVec_RigidConstraintModel()
    for kind, joint_a, on_a, joint_b, on_b in closure_constraints(mechanism):
        model = pin.RigidConstraintModel(
            kind, mechanism.tree.model, joint_a, on_a, joint_b, on_b, pin.ReferenceFrame.LOCAL
        )
        model.setBaumgarteCorrectorParameters(pin.BaumgarteCorrectorParameters(gain, 2 * np.sqrt(gain)))
        constraints.append(model)
    return constraints
