"""A program for the benchmark: SciPy's DOP853 on Pinocchio's constraintDynamics. docs/report/peers.md explains it."""

import json
import sys
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin
import scipy.integrate

JOINTS = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
GAIN = 100.0  # 1/s^2: the Baumgarte terms close loops that rounding has opened


def say(**values: Any) -> None:
    """Print one line of the protocol."""
    print(json.dumps(values), flush=True)


def build_model(problem: dict[str, Any]) -> pin.Model:
    """Return the tree of bodies as a Pinocchio model."""
    model = pin.Model()
    model.gravity.linear = np.array(problem["gravity"])
    for body in problem["bodies"]:
        placement = pin.SE3(np.array(body["rotation"]), np.array(body["translation"]))
        kind = JOINTS[body["joint"]](*body["axis"]) if body["joint"] in JOINTS else pin.JointModelFreeFlyer()
        joint = model.addJoint(body["parent"], kind, placement, body["name"])
        inertia = pin.Inertia(body["mass"], np.array(body["center"]), np.array(body["inertia"]))
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    model.armature = np.array(problem["joints"]["armature"])
    return model


def build_constraints(problem: dict[str, Any], model: pin.Model) -> Any:
    """Return the pairs of points that coincide as Pinocchio's constraints."""
    constraints = pin.StdVec_RigidConstraintModel()
    for pair in problem["pairs"]:
        a, b = (pin.SE3(np.eye(3), np.array(pair[end]["point"])) for end in ("a", "b"))
        sides = pair["a"]["body"], a, pair["b"]["body"], b
        constraint = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *sides, pin.ReferenceFrame.LOCAL)
        constraint.setBaumgarteCorrectorParameters(pin.BaumgarteCorrectorParameters(GAIN, 2 * GAIN**0.5))
        constraints.append(constraint)
    return constraints


def compute_q_dot(model: pin.Model, q: Any, v: Any) -> Any:
    """Return q_dot: v, except for free bodies, where q has a position and a quaternion, and v is the body's twist."""
    q_dot = q.copy()
    for joint in list(model.joints)[1:]:
        twist = v[joint.idx_v : joint.idx_v + joint.nv]
        if joint.nv == 6:
            x = q[joint.idx_q + 3 : joint.idx_q + 7]
            rotation = pin.Quaternion(x / np.linalg.norm(x))
            spin = (rotation * pin.Quaternion(0.0, *twist[3:])).coeffs() / 2
            twist = [*rotation.matrix() @ twist[:3], *spin]
        q_dot[joint.idx_q : joint.idx_q + joint.nq] = twist
    return q_dot


def main() -> None:
    """Answer one problem."""
    problem = json.load(sys.stdin)
    say(name="SciPy on Pinocchio", version=f"SciPy {scipy.__version__}, Pinocchio {pin.__version__}")
    if problem["pairs"] is None:
        return say(unsupported="it closes loops by points only")
    if problem["springs"]:
        return say(unsupported="it has no springs between bodies")
    model = build_model(problem)
    data, constraints, n = model.createData(), build_constraints(problem, model), model.nq
    constraint_data = pin.StdVec_RigidConstraintData()
    constraint_data.extend(constraint.createData() for constraint in constraints)
    pin.initConstraintDynamics(model, data, constraints, constraint_data)
    proximal = pin.ProximalSettings(1e-13, 1e-8, 3)
    stiffness, rest, damping, force = (
        np.array(problem["joints"][x]) for x in ("stiffness", "rest", "damping", "force")
    )
    q_of = np.concatenate([[joint.idx_q] * joint.nv for joint in list(model.joints)[1:]])  # free bodies have no springs

    def rate(t: float, y: Any) -> Any:
        q, v = y[:n], y[n:]
        tau = force - stiffness * (q[q_of] - rest) - damping * v
        a = pin.constraintDynamics(model, data, q, v, tau, constraints, constraint_data, proximal)
        return np.concatenate([compute_q_dot(model, q, v), a])

    start, instants = np.array([*problem["q"], *problem["v"]]), problem["instants"]
    say(acceleration=rate(0.0, start)[n:].tolist())
    if not instants:
        return None
    rtol, span, began = problem["rtol"], (0.0, instants[-1]), perf_counter()
    solution = scipy.integrate.solve_ivp(rate, span, start, "DOP853", instants, rtol=rtol, atol=rtol / 100)
    say(wall_s=perf_counter() - began, rhs=solution.nfev)
    for t, y in zip(solution.t.tolist(), solution.y.T.tolist(), strict=True):
        say(t=t, q=y[:n], v=y[n:])
    return None


if __name__ == "__main__":
    main()
