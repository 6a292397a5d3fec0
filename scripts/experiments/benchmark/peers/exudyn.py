"""Run works in Exudyn: rigid bodies in redundant coordinates, all joints and loops as constraints."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.closure import perpendicular
from ckc_pin.mechanism.frames import Frame
from scripts.experiments.benchmark.peers.exudyn_plane import Plane, in_plane
from scripts.experiments.benchmark.peers.exudyn_steps import Steps
from scripts.experiments.benchmark.peers.stepping import (
    CONTROLLED,
    dividing_step,
    halved_steps,
    run_fixed_step,
    start_of,
)
from scripts.experiments.benchmark.work import Work

__all__ = ["Exudyn"]

COARSEST, STEPS, QUICK_STEPS = 1e-2, 10, 7  # s, and numbers of halvings
# Spectral radius: 1 has no numerical damping, 0.9 is the default and more stable.
SOLVERS = (("GeneralizedAlpha", 1.0), ("GeneralizedAlpha", 0.9), ("TrapezoidalIndex2", 1.0))
CLOSED = ("point", "point_2d", "hinge", "weld", "distance")


class Exudyn:
    """Generalized alpha on index 3 and the trapezoidal rule on index 2; the explicit solvers do not support loops."""

    name = "Exudyn"
    packaged = True

    def missing(self, work: Work) -> str | None:
        mechanism = work.mechanism
        try:
            metadata.version("exudyn")
        except metadata.PackageNotFoundError:
            return "not installed: pip install 'ckc_pin[peers]'"
        others = {loop.type for loop in mechanism.spec.loop} - set(CLOSED)
        if work.controlled:
            return CONTROLLED
        if others or mechanism.spec.coupling or mechanism.tree.free_roots:
            return f"not set up in it: {', '.join(sorted(others)) or 'couplings and free roots'}"
        if mechanism.springs.joint_stiffness.any() or mechanism.springs.joint_damping.any():
            return "springs and dampers on joints are not set up in it"
        return None

    def version(self) -> str:
        return metadata.version("exudyn")

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        solvers, steps = (SOLVERS[1:], QUICK_STEPS) if quick else (SOLVERS, STEPS)
        for (solver, radius), dt in product(solvers, halved_steps(work, COARSEST, steps)):
            yield f"{solver}, spectral radius {radius:g}, dt {dt:.3g}"

    def check(self, work: Work) -> str:
        """Compare the energy at the start."""
        flat, tree = in_plane(work), work.mechanism.tree
        system: Plane | _System = Plane(work) if flat else _System(work)
        q_tree, v_tree = start_of(work)
        kinetic = pin.computeKineticEnergy(tree.model, tree.data, q_tree, v_tree)
        return (
            f"{'planar' if flat else 'spatial'} bodies; their kinetic energy at the start is off by "
            f"{abs(system.kinetic_energy() - kinetic):.0e} J"
        )

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        solver, radius, step_size = setting.split(", ")
        dt, flat = dividing_step(work, float(step_size.split()[-1])), in_plane(work)
        running: dict[str, Any] = {}

        def reset() -> None:
            running["system"] = Plane(work) if flat else _System(work)

        def step(many: int) -> None:
            running["system"].advance(solver, float(radius.split()[-1]), dt, many)

        def state() -> tuple[Array, Array]:
            q_tree, v_tree = running["system"].state()
            return q_tree, v_tree

        return run_fixed_step(work, dt, FixedStepProgram(reset, step, state), budget)


class _System(Steps):
    """A work's mechanism in Exudyn, at its start, in space."""

    def __init__(self, work: Work) -> None:
        super().__init__(work)
        from exudyn.utilities import RigidBodyInertia

        tree = work.mechanism.tree
        inertia_of: Any = RigidBodyInertia
        self._dt = 0.0
        q_tree, v_tree = start_of(work)
        self._q = tree.to_coordinates(q_tree)
        self._v = v_tree.copy()
        pin.forwardKinematics(tree.model, tree.data, q_tree, v_tree)
        self._placements = [pin.SE3(placement) for placement in tree.data.oMi]
        self._bodies = [self.mbs.CreateGround()]
        for k in range(1, tree.model.njoints):
            place, velocity, inertia = self._placements[k], tree.data.v[k], tree.model.inertias[k]
            body = inertia_of(inertia.mass, inertia.inertia, inertia.lever, inertiaTensorAtCOM=True)
            self._bodies.append(
                self.mbs.CreateRigidBody(
                    inertia=body,
                    referencePosition=place.translation,
                    referenceRotationMatrix=place.rotation,
                    initialVelocity=place.rotation @ velocity.linear,
                    initialAngularVelocity=place.rotation @ velocity.angular,
                    gravity=list(tree.model.gravity.linear),
                )
            )
        self._axes = [self._joint(k) for k in range(1, tree.model.njoints)]
        self._close()
        self._push()
        self.assemble()

    def advance(self, solver: str, radius: float, dt: float, many: int) -> None:
        """Advance the state by `many` steps."""
        super().advance(solver, radius, dt, many)
        self._dt = many * dt

    def state(self) -> tuple[Array, Array]:
        """Return q_tree and v_tree. Whole turns of angles are counted, since bodies only store a rotation."""
        tree, kind = self.mechanism.tree, self.exudyn.OutputVariableType
        if self.t == 0.0:
            return self._q.copy(), self._v.copy()
        values: list[list[Any]] = [
            [None, *(np.array(self.mbs.GetObjectOutputBody(body, x, [0, 0, 0])) for body in self._bodies[1:])]
            for x in (kind.RotationMatrix, kind.Position, kind.Velocity, kind.AngularVelocity)
        ]
        rotations, positions, velocities, spins = values
        q_tree, v_tree = self._q.copy(), self._v.copy()
        for k in range(1, tree.model.njoints):
            joint, parent = tree.model.joints[k], int(tree.model.parents[k])
            along, turns = self._axes[k - 1]
            base = pin.SE3.Identity() if parent == 0 else pin.SE3(rotations[parent].reshape(3, 3), positions[parent])
            here = pin.SE3(rotations[k].reshape(3, 3), positions[k])
            relative = (base * tree.model.jointPlacements[k]).actInv(here)
            spin, speed = (np.zeros(3), np.zeros(3)) if parent == 0 else (spins[parent], velocities[parent])
            axis = here.rotation @ along
            at = joint.idx_v
            if turns:
                v_tree[at] = axis @ (spins[k] - spin)
                angle = float(pin.log3(relative.rotation) @ along)
                foreseen = self._q[at] + self._dt * (self._v[at] + v_tree[at]) / 2
                q_tree[at] = angle + 2 * np.pi * round((foreseen - angle) / (2 * np.pi))
            else:
                carried = speed + np.cross(spin, here.translation - base.translation)
                q_tree[at], v_tree[at] = relative.translation @ along, axis @ (velocities[k] - carried)
        self._q, self._v = q_tree, v_tree
        return q_tree.copy(), v_tree.copy()

    def _joint(self, k: int) -> tuple[Array, bool]:
        """Add a joint; return its axis in the body, and whether it turns."""
        model = self.mechanism.tree.model
        axis, turns = self.mechanism.tree.axis(k)
        create = self.mbs.CreateRevoluteJoint if turns else self.mbs.CreatePrismaticJoint
        place = self._placements[k]
        bodies = [self._bodies[int(model.parents[k])], self._bodies[k]]
        create(itemNumbers=bodies, position=place.translation, axis=place.rotation @ axis, show=False)
        return axis, turns

    def _close(self) -> None:
        mechanism, mbs = self.mechanism, self.mbs
        for loop in mechanism.spec.loop:
            a, b = (mechanism.frames.find(frame, f"loop {loop.name!r}") for frame in (loop.frame_a, loop.frame_b))
            bodies = [self._bodies[a.joint], self._bodies[b.joint]]
            if loop.type == "distance":
                mbs.CreateDistanceConstraint(
                    itemNumbers=bodies, localPosition0=a.translation, localPosition1=b.translation, distance=loop.length
                )
                continue
            at, axis = self._world(a), np.array(loop.axis_a) / np.linalg.norm(loop.axis_a)
            turned = np.eye(3) if loop.rows_in == "world" else at.rotation
            axes = turned @ np.column_stack([*perpendicular(axis), axis])
            constrained = {"point": [1, 1, 1, 0, 0, 0], "point_2d": [1, 1, 0, 0, 0, 0], "hinge": [1, 1, 1, 1, 1, 0]}
            mbs.CreateGenericJoint(
                itemNumbers=bodies,
                position=at.translation,
                rotationMatrixAxes=axes,
                constrainedAxes=constrained.get(loop.type, [1] * 6),
                show=False,
            )

    def _push(self) -> None:
        """Add springs between frames, and constant forces on hinges."""
        mechanism, mbs = self.mechanism, self.mbs
        for spring in mechanism.spec.spring:
            if spring.frame_a is None or spring.frame_b is None:
                continue
            a, b = (mechanism.frames.find(frame, "spring") for frame in (spring.frame_a, spring.frame_b))
            mbs.CreateSpringDamper(
                itemNumbers=[self._bodies[a.joint], self._bodies[b.joint]],
                localPosition0=a.translation,
                localPosition1=b.translation,
                referenceLength=spring.rest_length or 0.0,
                stiffness=spring.stiffness,
                damping=spring.damping,
            )
        model = mechanism.tree.model
        for k in range(1, model.njoints):
            force = float(mechanism.springs.constant[model.joints[k].idx_v])
            if force:
                place = self._placements[k]
                mbs.CreateTorsionalSpringDamper(
                    itemNumbers=[self._bodies[int(model.parents[k])], self._bodies[k]],
                    position=place.translation,
                    axis=place.rotation @ self._axes[k - 1][0],
                    torque=-force,  # it acts on the second body with the opposite sign
                )

    def _world(self, frame: Frame) -> pin.SE3:
        base = pin.SE3.Identity() if frame.joint == 0 else self._placements[frame.joint]
        return base * pin.SE3(frame.rotation, frame.translation)
