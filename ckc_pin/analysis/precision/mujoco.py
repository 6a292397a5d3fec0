"""MuJoCo on the same motion: loops as soft constraints, fixed steps, from a model's text."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from time import perf_counter
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import Motion, Stepper, no_motion, off_manifold
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.scene import Scene

__all__ = ["StateMap", "missing", "model_of", "rows", "set_up", "stepper"]

SAME = 1e-6  # relative: how well mass matrix and bias agree where both programs have one mechanism
COARSEST, STEPS = 1e-2, 9  # of the span or of 2 s, and how many halves
INTEGRATORS = ("implicitfast", "RK4")
STIFFNESSES = ("default", "solref 2 dt")  # as MuJoCo has them, and as stiff as its manual lets them be
UNUSED = ("AUTORESET", "CONTACT", "SENSOR")  # a run that blew up is not to start again


def missing(scene: Scene) -> str:
    """Say why MuJoCo cannot run a scene; empty where it can."""
    if scene.spec.controller is not None:
        return "the scene's controller needs D, C and h of the reduced model, which it does not give"
    if off_manifold(scene):
        return "the scene starts with its loops open, phi = w, which has no meaning there"
    return ""


def rows(
    scene: Scene, mechanism: Mechanism, mjcf: str, t: Array, deadline: float
) -> Iterator[tuple[str, float, Motion]] | str:
    """Return (method, step in s, motion) from coarse to fine steps; a sentence where it has another mechanism.

    Parameters
    ----------
    scene : Scene
    mechanism : Mechanism
    mjcf : str
    t : (m,) array
        Instants, evenly spaced, s.
    deadline : float
        By `perf_counter`; what would end later is not tried.
    """
    try:
        model = model_of(mjcf)
    except ValueError as error:
        return f"it refuses the model: {' '.join(str(error).split())}"
    start = find_start(mechanism, scene)
    state = start.at.q_tree, start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree
    off = _difference(mechanism, model, state)
    if not off <= SAME:
        return f"its mass matrix or its forces at the start differ by {off:.1e}"
    return _steps(model, stepper(model, mechanism, state), t, deadline)


def _steps(model: Any, program: Stepper, t: Array, deadline: float) -> Iterator[tuple[str, float, Motion]]:
    solref, solimp = model.eq_solref.copy(), model.eq_solimp.copy()
    between, instants, slow = float(t[1]), len(t) - 1, set[str]()
    for k, (integrator, stiffness) in product(range(STEPS), product(INTEGRATORS, STIFFNESSES)):
        many = max(1, round(between / (COARSEST * min(2.0, float(t[-1])) / 2**k)))
        method, dt = f"{integrator}, {stiffness}", between / many
        model.eq_solref[:], model.eq_solimp[:] = solref, solimp
        set_up(model, integrator, stiffness, dt)
        if method in slow or program.foreseen(many, instants) > deadline - perf_counter():
            slow.add(method)
            yield method, dt, no_motion("not tried", "the budget was used up before; give a larger one")
            continue
        yield method, dt, program.run(many, instants)


def model_of(mjcf: str) -> Any:
    """Return the model of a mechanism, without shapes and what a mechanism has not, so that nothing else takes time.

    ValueError: MuJoCo refuses it.
    """
    import mujoco

    mujoco.set_mju_user_warning(_silent)  # by default they go to a file in the current folder
    root = ElementTree.fromstring(mjcf)
    for body in root.iter():
        for shape in body.findall("geom"):  # nothing collides, and placing them takes time
            body.remove(shape)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    for unused in UNUSED:
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{unused}")
    return model


def set_up(model: Any, integrator: str, stiffness: str, dt: float) -> None:
    """Set integrator, step and stiffness of the loops: "default", or their time constant as "solref 2 dt".

    Two steps are the shortest one that the manual allows.
    """
    import mujoco

    model.opt.timestep = dt
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    if stiffness != "default":
        model.eq_solref[:] = [float(stiffness.split()[1]) * dt, 1.0]
        model.eq_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]


def stepper(model: Any, mechanism: Mechanism, state: tuple[Array, Array]) -> Stepper:
    """Return the program at a start, Pinocchio's q_tree and v_tree."""
    import mujoco

    data, joints = mujoco.MjData(model), StateMap(mechanism, model)

    def reset() -> None:
        mujoco.mj_resetData(model, data)
        joints.put(data, *state)

    return Stepper(reset, lambda many: mujoco.mj_step(model, data, nstep=many), lambda: joints.state(data))


def _difference(mechanism: Mechanism, model: Any, state: tuple[Array, Array]) -> float:
    """How far D', and without a free root also the bias, are from Pinocchio's at the start, relative."""
    import mujoco

    tree, (q_tree, v_tree), data = mechanism.tree, state, mujoco.MjData(model)
    to = StateMap(mechanism, model).put(data, q_tree, v_tree)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    ours = tree.evaluate(pin.crba, q_tree)
    ours = np.triu(ours) + np.triu(ours, 1).T
    off = float(np.abs(to.T @ mass @ to - ours).max() / np.abs(ours).max())
    if tree.is_euclidean:
        bias = tree.evaluate(pin.nonLinearEffects, q_tree, v_tree)
        off = max(off, float(np.abs(to.T @ data.qfrc_bias - bias).max() / max(float(np.abs(bias).max()), 1e-12)))
    return off


class StateMap:
    """Pinocchio's states in MuJoCo's order and back."""

    def __init__(self, mechanism: Mechanism, model: Any) -> None:
        self._tree = mechanism.tree
        names = list(mechanism.tree.model.names)
        self._there = {k: model.joint(names[k]) for k in range(1, len(names))}

    def put(self, data: Any, q_tree: Array, v_tree: Array) -> Array:
        """Set a state; return the map from Pinocchio's velocities to MuJoCo's, shape (n, n)."""
        tree = self._tree
        pin.forwardKinematics(tree.model, tree.data, q_tree)
        to = np.zeros((len(data.qvel), tree.n))
        for k, there in self._there.items():
            joint, at, v_at = tree.model.joints[k], int(there.qposadr[0]), int(there.dofadr[0])
            if joint.nv == 1:
                data.qpos[at] = q_tree[joint.idx_q]
                to[v_at, joint.idx_v] = 1.0
                continue
            placement = tree.data.oMi[k]
            x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
            data.qpos[at : at + 7] = [*placement.translation, w, x, y, z]
            to[v_at : v_at + 3, joint.idx_v : joint.idx_v + 3] = placement.rotation
            to[v_at + 3 : v_at + 6, joint.idx_v + 3 : joint.idx_v + 6] = np.eye(3)
        data.qvel[:] = to @ v_tree
        return to

    def state(self, data: Any) -> tuple[Array, Array]:
        """Return q_tree and v_tree by coordinate."""
        tree = self._tree
        q_tree, v_tree = tree.neutral(), np.zeros(tree.n)
        for k, there in self._there.items():
            joint, at, v_at = tree.model.joints[k], int(there.qposadr[0]), int(there.dofadr[0])
            if joint.nv == 1:
                q_tree[joint.idx_q], v_tree[joint.idx_v] = data.qpos[at], data.qvel[v_at]
                continue
            w, x, y, z = data.qpos[at + 3 : at + 7]
            rotation = pin.Quaternion(float(w), float(x), float(y), float(z)).matrix()
            placed = tree.model.jointPlacements[k].actInv(pin.SE3(rotation, np.array(data.qpos[at : at + 3])))
            q_tree[joint.idx_q : joint.idx_q + 7] = pin.SE3ToXYZQUAT(placed)
            v_tree[joint.idx_v : joint.idx_v + 3] = rotation.T @ data.qvel[v_at : v_at + 3]
            v_tree[joint.idx_v + 3 : joint.idx_v + 6] = data.qvel[v_at + 3 : v_at + 6]
        return tree.to_coordinates(q_tree), v_tree


def _silent(message: str) -> None:
    """Pass over a warning: a run that became unstable is told by its numbers."""
