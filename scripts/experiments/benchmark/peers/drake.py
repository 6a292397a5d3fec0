"""Run works in Drake: a discrete plant with loop constraints, or a continuous one with bushings in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import metadata
from itertools import product
from typing import Any

import numpy as np

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion
from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError
from ckc_pin.formats.loop_frames import place_in_plane
from ckc_pin.mechanism.couplings import coefficients_of, coupling_name, curve_of
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

__all__ = ["Drake"]

COARSEST, STEPS, QUICK_STEPS = 1e-2, 10, 6  # s, and numbers of halvings
CLOSED = ("point", "point_2d", "hinge", "weld", "distance")
POINTS = {"point", "point_2d"}  # loop types that a bushing without torques can replace
STIFFNESSES, QUICK_STIFFNESSES = (3e4, 1e5, 3e5, 1e6, 1e7, 1e8), (1e5, 1e6)  # of bushings, N/m
DAMPING = 1e-4  # s: damping of a bushing over its stiffness
ACCURACIES, QUICK_ACCURACIES = (1e-2, 1e-3), (1e-2,)


class Drake:
    """A MultibodyPlant built joint by joint from Pinocchio's tree, loops by ball, weld and distance constraints."""

    name = "Drake"
    packaged = True

    def missing(self, work: Work) -> str | None:
        try:
            metadata.version("drake")
        except metadata.PackageNotFoundError:
            return "not installed: pip install 'ckc_pin[peers]'"
        others = {loop.type for loop in work.mechanism.spec.loop} - set(CLOSED)
        if work.controlled:
            return CONTROLLED
        if others:
            return f"it has no constraint for {', '.join(sorted(others))}"
        if work.mechanism.tree.free_roots:
            return "free roots are not set up in it"
        try:
            _Plant(work.mechanism, 1e-3)
        except (InputError, RuntimeError) as error:
            return str(error)
        return None

    def version(self) -> str:
        return metadata.version("drake")

    def settings(self, work: Work, quick: bool) -> Iterator[str]:
        for dt in halved_steps(work, COARSEST, QUICK_STEPS if quick else STEPS):
            yield f"SAP, dt {dt:.3g}"
        if {loop.type for loop in work.mechanism.spec.loop} <= POINTS and not work.mechanism.spec.coupling:
            stiffnesses, accuracies = (QUICK_STIFFNESSES, QUICK_ACCURACIES) if quick else (STIFFNESSES, ACCURACIES)
            for stiffness, accuracy in product(stiffnesses, accuracies):
                yield f"RungeKutta3, bushings of {stiffness:g} N/m, accuracy {accuracy:g}"

    def check(self, work: Work) -> str:
        """Compare D' and the bias at the start."""
        import pinocchio as pin

        plant, tree = _Plant(work.mechanism, 1e-3), work.mechanism.tree
        context = plant.plant.CreateDefaultContext()
        q_tree, v_tree = start_of(work)
        plant.put(context, q_tree, v_tree)
        D = pin.crba(tree.model, tree.data, q_tree)
        D = np.triu(D) + np.triu(D, 1).T
        bias = pin.nonLinearEffects(tree.model, tree.data, q_tree, v_tree)
        M = plant.plant.CalcMassMatrixViaInverseDynamics(context)[np.ix_(plant.at, plant.at)]
        gravity = plant.plant.CalcGravityGeneralizedForces(context)
        theirs = (plant.plant.CalcBiasTerm(context) - gravity)[plant.at]
        mass, off = np.abs(M - D).max() / np.abs(D).max(), np.abs(theirs - bias).max()
        return f"D' agrees to {mass:.0e}, the bias to {off / max(float(np.abs(bias).max()), 1e-12):.0e}"

    def compute(self, work: Work, setting: str, budget: float) -> Motion:
        from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

        solver, *render_blocks = setting.split(", ")
        numbers = [float(number) for part in render_blocks for number in part.split() if number[0].isdigit()]
        discrete = solver == "SAP"
        dt = numbers[0] if discrete else work.t_end  # an integrator with its own steps advances from instant to instant
        plant = _Plant(work.mechanism, dividing_step(work, dt)) if discrete else _Plant(work.mechanism, 0.0, numbers[0])
        q_tree, v_tree = start_of(work)
        running: dict[str, Any] = {}

        def reset() -> None:
            context = plant.plant.CreateDefaultContext()
            plant.plant.get_applied_generalized_force_input_port().FixValue(context, plant.constant)
            plant.put(context, q_tree, v_tree)
            running["simulator"], running["t"] = Simulator(plant.plant, context), 0.0
            if not discrete:
                integrator: Any = ResetIntegratorFromFlags(
                    running["simulator"], "runge_kutta3", dividing_step(work, dt)
                )
                integrator.set_target_accuracy(numbers[1])
            running["simulator"].Initialize()

        def step(many: int) -> None:
            running["t"] += many * dividing_step(work, dt)
            running["simulator"].AdvanceTo(running["t"])

        def state() -> tuple[Array, Array]:
            return plant.state(running["simulator"].get_context())

        motion = run_fixed_step(work, dt, FixedStepProgram(reset, step, state), budget)
        if discrete or motion.status != "done":
            return motion
        return replace(motion, steps=running["simulator"].get_integrator().get_num_steps_taken())


class _Plant:
    """A mechanism as a Drake plant: discrete with step dt, or continuous with bushings of a stiffness in N/m."""

    def __init__(self, mechanism: Mechanism, dt: float, bushing: float = 0.0) -> None:
        from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant

        self.mechanism = mechanism
        self.plant: Any = MultibodyPlant(dt)
        if dt > 0:
            self.plant.set_discrete_contact_approximation(
                DiscreteContactApproximation.kSap
            )  # the approximation that supports constraints
            self.plant.SetUseSampledOutputPorts(False)  # saves two thirds of the time
        self.plant.mutable_gravity_field().set_gravity_vector(mechanism.tree.model.gravity.linear)
        self._bodies: list[Any] = [self.plant.world_body()]
        self._joints: list[Any] = []
        for k in range(1, mechanism.tree.model.njoints):
            self._add(k)
        if bushing:
            self._hold(bushing)
        else:
            self._close()
        self._spring()
        self.plant.Finalize()
        self.at = [int(joint.velocity_start()) for joint in self._joints]
        self.constant = np.zeros(self.plant.num_velocities())
        self.constant[self.at] = mechanism.springs.constant

    def put(self, context: Any, q_tree: Array, v_tree: Array) -> None:
        """Set a state."""
        q, v = np.zeros(len(self.at)), np.zeros(len(self.at))
        q[self.at], v[self.at] = q_tree, v_tree
        self.plant.SetPositions(context, q)
        self.plant.SetVelocities(context, v)

    def state(self, context: Any) -> tuple[Array, Array]:
        """Return q_tree and v_tree by coordinate."""
        return self.plant.GetPositions(context)[self.at], self.plant.GetVelocities(context)[self.at]

    def _add(self, k: int) -> None:
        """Add the body that joint k carries, and the joint."""
        from pydrake.multibody.tree import (
            FixedOffsetFrame,
            PrismaticJoint,
            RevoluteJoint,
            RotationalInertia,
            SpatialInertia,
        )

        model = self.mechanism.tree.model
        name, inertia, placement = model.names[k], model.inertias[k], model.jointPlacements[k]
        moments = np.array(inertia.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        spatial = SpatialInertia.MakeFromCentralInertia(inertia.mass, inertia.lever, RotationalInertia(*moments))
        body = self.plant.AddRigidBody(f"{name} body", spatial)
        place = _placed(placement)
        parent = self._bodies[int(model.parents[k])].body_frame()
        frame = self.plant.AddFrame(FixedOffsetFrame(f"{name} frame", parent, place))
        axis, turns = self.mechanism.tree.axis(k)
        make: Callable[..., Any] = RevoluteJoint if turns else PrismaticJoint
        damping = float(self.mechanism.springs.joint_damping[model.joints[k].idx_v])
        self._bodies.append(body)
        self._joints.append(self.plant.AddJoint(make(name, frame, body.body_frame(), axis, damping=damping)))

    def _close(self) -> None:
        """Add the loops and couplings."""
        mechanism, plant = self.mechanism, self.plant
        for loop in mechanism.spec.loop:
            a, b = (mechanism.frames.find(frame, f"loop {loop.name!r}") for frame in (loop.frame_a, loop.frame_b))
            b = place_in_plane(mechanism, loop, a, b, "Drake") if loop.type == "point_2d" else b
            first, second = self._bodies[a.joint], self._bodies[b.joint]
            if loop.type == "weld":
                plant.AddWeldConstraint(first, _placed(a), second, _placed(b))
            elif loop.type == "distance":
                plant.AddDistanceConstraint(first, a.translation, second, b.translation, loop.length)
            else:
                plant.AddBallConstraint(first, a.translation, second, b.translation)
            if loop.type == "hinge":  # a second point of the axis
                ends = [_point_on_axis(a, loop.axis_a, mechanism.size), _point_on_axis(b, loop.axis_b, mechanism.size)]
                plant.AddBallConstraint(first, ends[0], second, ends[1])
        for coupling in mechanism.couplings:
            coefficients = {joint: x for joint, x in coefficients_of(coupling).items() if x}
            if len(coefficients) != 2 or curve_of(coupling) is not None:
                raise InputError(
                    f"coupling {coupling_name(coupling)} has no counterpart in it: it has linear gears only"
                )
            (joint, first), (other, second) = coefficients.items()
            ends = [self._joints[mechanism.tree.index[name]] for name in (joint, other)]
            plant.AddCouplerConstraint(*ends, -second / first, coupling.offset / first)

    def _hold(self, stiffness: float) -> None:
        """Close the loops, which are all points, by bushings."""
        from pydrake.multibody.tree import FixedOffsetFrame, LinearBushingRollPitchYaw

        ones, none = np.ones(3), np.zeros(3)
        for loop in self.mechanism.spec.loop:
            a, b = (self.mechanism.frames.find(frame, f"loop {loop.name!r}") for frame in (loop.frame_a, loop.frame_b))
            b = place_in_plane(self.mechanism, loop, a, b, "Drake") if loop.type == "point_2d" else b
            ends = [
                self.plant.AddFrame(
                    FixedOffsetFrame(f"{loop.name} {side}", self._bodies[frame.joint].body_frame(), _placed(frame))
                )
                for side, frame in (("a", a), ("b", b))
            ]
            bushing: Callable[..., Any] = LinearBushingRollPitchYaw
            damping = DAMPING * stiffness
            self.plant.AddForceElement(bushing(*ends, none, none, stiffness * ones, damping * ones))

    def _spring(self) -> None:
        """Add springs between frames and on joints; Drake's joint spring exists for hinges only."""
        from pydrake.multibody.tree import LinearSpringDamper, RevoluteJoint, RevoluteSpring

        mechanism, springs = self.mechanism, self.mechanism.springs
        for spring in mechanism.spec.spring:
            if spring.frame_a is None or spring.frame_b is None:
                continue
            a, b = (mechanism.frames.find(frame, "spring") for frame in (spring.frame_a, spring.frame_b))
            ends = (self._bodies[a.joint], a.translation, self._bodies[b.joint], b.translation)
            force: Callable[..., Any] = LinearSpringDamper
            self.plant.AddForceElement(force(*ends, spring.rest_length or 0.0, spring.stiffness, spring.damping))
        for k in np.flatnonzero(springs.joint_stiffness):
            if not isinstance(self._joints[k], RevoluteJoint):
                raise InputError("a spring on a prismatic joint has no counterpart in it")
            nominal, stiffness = float(springs.joint_rest[k]), float(springs.joint_stiffness[k])
            self.plant.AddForceElement(RevoluteSpring(self._joints[k], nominal, stiffness))


def _placed(frame: Any) -> Any:
    """Return a frame or a placement as Drake's RigidTransform."""
    from pydrake.math import RigidTransform, RotationMatrix

    return RigidTransform(RotationMatrix(frame.rotation), frame.translation)


def _point_on_axis(frame: Frame, axis: tuple[float, float, float], size: float) -> Array:
    return frame.translation + frame.rotation @ np.array(axis) / np.linalg.norm(axis) * size
