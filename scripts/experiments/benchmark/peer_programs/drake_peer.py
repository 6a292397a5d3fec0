"""A program for the benchmark: Drake's MultibodyPlant, which closes loops by constraints, joints or bushings."""

import json
import sys
from importlib import metadata
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    JacobianWrtVariable,
    LinearBushingRollPitchYaw,
    LinearSpringDamper,
    MultibodyForces,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RevoluteSpring,
    RotationalInertia,
    SpatialInertia,
    WeldJoint,
)
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from timing import fixed_step, print_motion, read_inertia, say

# CENIC is Drake's integrator with error control that takes constraints. "loop joints": the plant splits a link of each
# loop itself. SAP has a fixed step. Runge-Kutta would drop constraints without a word, so bushings replace them.
SETTINGS = ("CENIC", "CENIC, loop joints", "SAP", "RungeKutta3, bushings")
COARSEST_S = 1e-2  # step of SAP at the tolerance 1e-2
BUSHING_N_PER_M = 30.0  # divided by the tolerance
BUSHING_DAMPING_S = 1e-4  # over the stiffness
COARSEST_ACCURACY = 1e-2  # of Runge-Kutta; the bushings' softness dominates its errors
PAIRS = {"point": 1, "point_2d": 1, "hinge": 2, "weld": 3}  # pairs of coincident points by type of loop


def rotation_matrix(w: float, x: float, y: float, z: float) -> Any:
    """Return the rotation matrix of a quaternion of any length."""
    return RotationMatrix(Quaternion(np.array([w, x, y, z]) / np.hypot(np.hypot(w, x), np.hypot(y, z)))).matrix()


def read_pose(frame: dict[str, Any]) -> RigidTransform:
    """Return a frame of the protocol."""
    return RigidTransform(RotationMatrix(np.array(frame["rotation"])), frame["translation"])


class ProblemPlant:
    """A problem as a plant: discrete with step dt, or continuous. Loop joints need `tree`, its plant without loops."""

    def __init__(
        self, problem: dict[str, Any], dt: float, loops: str, stiffness: float = 0.0, tree: Any = None
    ) -> None:
        self.problem, self.plant = problem, MultibodyPlant(dt)
        plant = self.plant
        if dt > 0:
            plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
            plant.SetUseSampledOutputPorts(False)  # saves two thirds of the time
        if loops == "joints":
            plant.SetEnableLoopTopology(True)
        plant.mutable_gravity_field().set_gravity_vector(problem["gravity"])
        self.bodies: list[Any] = [plant.world_body()]
        self.joints: list[Any] = []
        self.closing: list[Any] = []
        for k, body in enumerate(problem["bodies"]):
            self._add(k, body)
        if loops == "constraints":
            self._constrain()
        elif loops == "bushings":
            self._hold(stiffness)
        elif loops == "joints":
            self._join(tree)
        self._spring()
        plant.Finalize()
        v_at = [range(joint.velocity_start(), joint.velocity_start() + joint.num_velocities()) for joint in self.joints]
        # The protocol has linear velocities of free bodies first.
        order = [[*range(3, 6), *range(3)] if len(at) == 6 else [0] for at in v_at]
        self.v_at = np.array([at[k] for at, ks in zip(v_at, order, strict=True) for k in ks])
        self.force = np.zeros(plant.num_velocities())
        self.force[self.v_at] = problem["joints"]["force"]

    def _add(self, k: int, body: dict[str, Any]) -> None:
        name, (mass, inertia) = body["name"], read_inertia(body)
        moments = RotationalInertia(*inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        spatial = SpatialInertia.MakeFromCentralInertia(mass, body["center"], moments)
        added = self.plant.AddRigidBody(f"{name} body", spatial)
        frame = self._frame(f"{name} frame", body["parent"], read_pose(body))
        at = sum(6 if other["joint"] == "free" else 1 for other in self.problem["bodies"][:k])
        if body["joint"] == "free":
            joint: Any = QuaternionFloatingJoint(name, frame, added.body_frame())
        else:
            kind: Any = RevoluteJoint if body["joint"] == "revolute" else PrismaticJoint
            damping = self.problem["joints"]["damping"][at]
            joint = kind(name, frame, added.body_frame(), body["axis"], damping=damping)
        self.bodies.append(added)
        self.joints.append(self.plant.AddJoint(joint))

    def _frame(self, name: str, body: int, pose: RigidTransform) -> Any:
        return self.plant.AddFrame(FixedOffsetFrame(name, self.bodies[body].body_frame(), pose))

    def _constrain(self) -> None:
        pairs = iter(self.problem["pairs"])
        for loop in self.problem["loops"]:
            points = [next(pairs) for _ in range(PAIRS[loop["type"]])]
            a, b = (self.bodies[loop[end]["body"]] for end in "ab")
            if loop["type"] == "weld":
                self.plant.AddWeldConstraint(a, read_pose(loop["a"]), b, read_pose(loop["b"]))
                continue
            for pair in points:
                self.plant.AddBallConstraint(a, pair["a"]["point"], b, pair["b"]["point"])

    def _hold(self, stiffness: float) -> None:
        ones, none = np.ones(3), np.zeros(3)
        for k, pair in enumerate(self.problem["pairs"]):
            ends = [self._frame(f"{end}{k}", pair[end]["body"], RigidTransform(pair[end]["point"])) for end in "ab"]
            bushing = (none, none, stiffness * ones, BUSHING_DAMPING_S * stiffness * ones)
            self.plant.AddForceElement(LinearBushingRollPitchYaw(*ends, *bushing))

    def _join(self, tree: "ProblemPlant") -> None:
        """Close loops by joints at zero. Without an axis, that of the second body's hinge is the plane's normal."""
        context = tree.start()
        for loop in self.problem["loops"]:
            poses = {end: tree.plant.EvalBodyPoseInWorld(context, tree.bodies[loop[end]["body"]]) for end in "ab"}
            if loop["type"] == "hinge":
                axis = poses["b"].rotation() @ read_pose(loop["b"]).rotation() @ np.array(loop["axis_b"])
            else:
                body = loop["b"]["body"] or loop["a"]["body"]
                pose = poses["b" if loop["b"]["body"] else "a"]
                axis = pose.rotation() @ np.array(self.problem["bodies"][body - 1]["axis"])
            turned = loop["type"] in ("hinge", "point_2d")
            rotation = RotationMatrix.MakeFromOneVector(axis, 2) if turned else RotationMatrix()
            at = RigidTransform(rotation, (poses["b"] @ read_pose(loop["b"])).translation())
            frames = [
                self._frame(f"{loop['name']} {end}", loop[end]["body"], poses[end].inverse() @ at) for end in "ab"
            ]
            if loop["type"] == "weld":
                joint: Any = WeldJoint(loop["name"], *frames, RigidTransform())
            elif turned:
                joint = RevoluteJoint(loop["name"], *frames, [0, 0, 1])
            else:
                joint = BallRpyJoint(loop["name"], *frames)
            rates = [
                tree.plant.EvalBodySpatialVelocityInWorld(context, tree.bodies[loop[end]["body"]]).rotational()
                for end in "ab"
            ]
            self.closing.append((self.plant.AddJoint(joint), rotation.matrix().T @ (rates[1] - rates[0])))

    def _spring(self) -> None:
        for spring in self.problem["springs"]:
            ends = [item for end in "ab" for item in (self.bodies[spring[end]["body"]], spring[end]["point"])]
            numbers = (spring["rest_length"], spring["stiffness"], spring["damping"])
            self.plant.AddForceElement(LinearSpringDamper(*ends, *numbers))
        on_joints = self.problem["joints"]
        one_each = [joint for joint in self.joints for _ in range(joint.num_velocities())]
        for joint, rest, stiffness in zip(one_each, on_joints["rest"], on_joints["stiffness"], strict=True):
            if stiffness:
                self.plant.AddForceElement(RevoluteSpring(joint, rest, stiffness))

    def start(self) -> Any:
        """Return a context at the start."""
        plant, context = self.plant, self.plant.CreateDefaultContext()
        plant.get_applied_generalized_force_input_port().FixValue(context, self.force)
        numbers, rates = iter(self.problem["q"]), iter(self.problem["v"])
        q, v = plant.GetPositions(context), plant.GetVelocities(context)
        for joint in self.joints:
            at, v_at = joint.position_start(), joint.velocity_start()
            if joint.num_velocities() == 6:
                position, (x, y, z, w) = [next(numbers) for _ in range(3)], [next(numbers) for _ in range(4)]
                linear, angular = ([next(rates) for _ in range(3)] for _ in range(2))
                rotation = rotation_matrix(w, x, y, z)
                q[at : at + 7] = [w, x, y, z, *position]
                v[v_at : v_at + 6] = [*(rotation @ angular), *(rotation @ linear)]
            else:
                q[at], v[v_at] = next(numbers), next(rates)
        for joint, rate in self.closing:
            if joint.num_velocities():
                chosen = rate if joint.num_velocities() == 3 else rate[2:]
                v[joint.velocity_start() : joint.velocity_start() + len(chosen)] = chosen
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        return context

    def state(self, context: Any) -> tuple[list[float], list[float]]:
        """Return q and v."""
        q, v, positions, velocities = [], [], self.plant.GetPositions(context), self.plant.GetVelocities(context)
        for joint in self.joints:
            at, v_at = joint.position_start(), joint.velocity_start()
            if joint.num_velocities() == 6:
                w, x, y, z = positions[at : at + 4]
                back = rotation_matrix(w, x, y, z).T
                q += [*positions[at + 4 : at + 7], x, y, z, w]
                v += [*(back @ velocities[v_at + 3 : v_at + 6]), *(back @ velocities[v_at : v_at + 3])]
            else:
                q.append(positions[at])
                v.append(velocities[v_at])
        return [float(x) for x in q], [float(x) for x in v]

    def acceleration(self) -> list[float]:
        """Return v_dot with closed loops, by mass matrix, forces and Jacobians of a plant without loops."""
        plant, context = self.plant, self.start()
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        damping = np.zeros(len(self.v_at))
        damping[self.v_at] = self.problem["joints"]["damping"]
        tau = self.force - damping * plant.GetVelocities(context)
        right = tau - plant.CalcInverseDynamics(context, np.zeros(len(tau)), forces)
        M, J, drift = plant.CalcMassMatrix(context), [], []
        world, kind = plant.world_frame(), JacobianWrtVariable.kV
        for pair in self.problem["pairs"]:
            rows, biases = [], []
            for end in "ab":
                point = (self.bodies[pair[end]["body"]].body_frame(), pair[end]["point"], world, world)
                rows.append(plant.CalcJacobianTranslationalVelocity(context, kind, *point))
                biases.append(plant.CalcBiasTranslationalAcceleration(context, kind, *point)[:, 0])
            J.append(rows[0] - rows[1])
            drift.append(biases[0] - biases[1])
        free = np.linalg.solve(M, right)
        if J:
            jacobian = np.vstack(J)
            mobility = np.linalg.solve(M, jacobian.T)
            target = -np.concatenate(drift) - jacobian @ free
            free += mobility @ np.linalg.lstsq(jacobian @ mobility, target, 1e-10)[0]
        rates, at = free[self.v_at], 0
        for joint in self.joints:
            if joint.num_velocities() == 6:  # from the parent's axes to the body's, which turn
                back = joint.GetPose(context).rotation().matrix().T
                angular, linear = joint.get_angular_velocity(context), joint.get_translational_velocity(context)
                rates[at : at + 3] = back @ (rates[at : at + 3] - np.cross(angular, linear))
                rates[at + 3 : at + 6] = back @ rates[at + 3 : at + 6]
            at += joint.num_velocities()
        return rates.tolist()


def find_unsupported(problem: dict[str, Any]) -> str:
    """Return what the plant lacks for a problem; empty if nothing."""
    if problem["pairs"] is None:
        return "loops that are no points, hinges or welds are not set up in it"
    if any(problem["joints"]["armature"]):
        return "armature is not set up in it"
    on_slides = zip(problem["bodies"], problem["joints"]["stiffness"], strict=False)
    if any(stiffness and body["joint"] != "revolute" for body, stiffness in on_slides):
        return "a spring on a prismatic joint has no counterpart in it"
    if problem["setting"].endswith(("bushings", "joints")) and not problem["pairs"]:
        return "it has no loops"
    return ""


def main() -> None:
    """Answer one problem."""
    problem = json.load(sys.stdin)
    say(name="Drake", version=metadata.version("drake"), packaged=True, settings=SETTINGS)
    unsupported = find_unsupported(problem)
    if unsupported:
        return say(unsupported=unsupported)
    setting, rtol, step = problem["setting"], problem["rtol"], 0.0
    if setting == "SAP":
        step = fixed_step(problem, COARSEST_S)[1]
    loops = {"RungeKutta3, bushings": "bushings", "CENIC, loop joints": "joints"}.get(setting, "constraints")
    try:
        tree = ProblemPlant(problem, 0.0, "open")
        if not problem["instants"]:
            return say(acceleration=tree.acceleration())
        plant = ProblemPlant(problem, step, loops, BUSHING_N_PER_M / rtol, tree)
    except RuntimeError as error:
        return say(unsupported=" ".join(str(error).split()))
    running = dict[str, Any]()

    def reset() -> None:
        simulator = Simulator(plant.plant, plant.start())
        if setting != "SAP":
            method = "cenic" if setting.startswith("CENIC") else "runge_kutta3"
            integrator = ResetIntegratorFromFlags(simulator, method, problem["instants"][1])
            integrator.set_target_accuracy(rtol if method == "cenic" else min(10 * rtol, COARSEST_ACCURACY))
        simulator.Initialize()
        running["simulator"] = simulator

    def count_steps() -> int:
        return round(problem["t_end"] / step) if step else running["simulator"].get_integrator().get_num_steps_taken()

    def read() -> tuple[list[float], list[float]]:
        return plant.state(running["simulator"].get_context())

    print_motion(problem, reset, lambda t: running["simulator"].AdvanceTo(t), read, count_steps)
    return None


if __name__ == "__main__":
    main()
