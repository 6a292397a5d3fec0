"""Run the same motion in MuJoCo, with loops as soft constraints and fixed steps."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from time import perf_counter
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ckc_pin.analysis.precision.motion import FixedStepProgram, Motion, motion_without_data, starts_off_manifold
from ckc_pin.base.arrays import Array
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.scene import Scene

__all__ = [
    "INTEGRATORS",
    "STIFFNESSES",
    "StateMap",
    "configure_model",
    "explain_unsupported",
    "load_model",
    "make_program",
    "measure_deviation",
    "run_mujoco",
]

DYNAMICS_TOLERANCE = 1e-6  # relative; of mass matrix and bias, to check that both programs have one mechanism
LARGEST_STEP, HALVINGS = 1e-2, 9  # of the span, at most 2 s of it; how often this step is halved
WRONG_SPARSE_FACTOR = "4.0.0"  # of the Hessian with a sparse constraint Jacobian: MuJoCo's issue 3767, mended in 4.0.1
INTEGRATORS = ("implicitfast", "RK4")
STIFFNESSES = ("default", "solref 2 dt")  # MuJoCo's default, and the stiffest that its manual allows
DEFAULT_SOLREF, DEFAULT_SOLIMP = [0.02, 1.0], [0.9, 0.95, 0.001, 0.5, 2.0]  # MuJoCo's
DISABLED_FEATURES = ("AUTORESET", "CONTACT", "SENSOR")  # AUTORESET would restart a run that diverged
# Of the motion by which an exported model is compared.
DEVIATION_TIME_S, DEVIATION_OUTPUT_S, DEVIATION_RTOL = 1.0, 0.1, 1e-9
OUT_OF_BUDGET = "the budget is used up; give a larger one"


def explain_unsupported(scene: Scene) -> str:
    """Return why MuJoCo cannot run a scene; empty if it can."""
    if scene.spec.controller is not None or scene.controller is not None:
        return "the scene's controller needs D, C and h of the reduced model, which MuJoCo does not compute"
    if starts_off_manifold(scene):
        return "the scene starts with open loops, phi = w, which MuJoCo does not support"
    return ""


def run_mujoco(
    scene: Scene, mechanism: Mechanism, mjcf: str, t: Array, deadline: float
) -> Iterator[tuple[str, float, Motion]] | str:
    """Run a scene in MuJoCo with ever smaller steps.

    Parameters
    ----------
    scene : Scene
    mechanism : Mechanism
    mjcf : str
        The mechanism as a MuJoCo model.
    t : (m,) array
        Instants at equal distances, s.
    deadline : float
        By `perf_counter`. Runs that would end later are not tried.

    Returns
    -------
    iterator of (method, step in s, Motion), or str
        A sentence if MuJoCo refuses the model or its mechanism differs.
    """
    try:
        model = load_model(mjcf)
    except ValueError as error:
        return f"it refuses the model: {' '.join(str(error).split())}"
    start = find_start(mechanism, scene)
    state = start.at.q_tree, start.at.rho @ start.q_dot if start.v_tree is None else start.v_tree
    difference = _compare_dynamics(mechanism, model, state)
    if not difference <= DYNAMICS_TOLERANCE:
        return f"its mass matrix or its forces at the start differ by {difference:.1e}"
    return _run_settings(model, make_program(model, mechanism, state), t, deadline)


def _run_settings(
    model: Any, program: FixedStepProgram, t: Array, deadline: float
) -> Iterator[tuple[str, float, Motion]]:
    interval, instants, too_slow = float(t[1]), len(t) - 1, set[str]()
    for k, (integrator, stiffness) in product(range(HALVINGS), product(INTEGRATORS, STIFFNESSES)):
        steps = max(1, round(interval / (LARGEST_STEP * min(2.0, float(t[-1])) / 2**k)))
        method, dt = f"{integrator}, {stiffness}", interval / steps
        configure_model(model, integrator, stiffness, dt)
        if method in too_slow or program.estimate_wall_s(steps, instants) > deadline - perf_counter():
            too_slow.add(method)
            yield method, dt, motion_without_data("not tried", OUT_OF_BUDGET)
            continue
        yield method, dt, program.run(steps, instants)


def load_model(mjcf: str) -> Any:
    """Return the MuJoCo model of a mechanism, without shapes and unused features, which would only take time.

    Raises
    ------
    ValueError
        MuJoCo does not accept the model.
    """
    import mujoco

    mujoco.set_mju_user_warning(_ignore_warning)  # by default MuJoCo writes them to a file in the current folder
    root = ElementTree.fromstring(mjcf)
    for body in root.iter():
        for shape in body.findall("geom"):
            body.remove(shape)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    for feature in DISABLED_FEATURES:
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{feature}")
    if mujoco.__version__ == WRONG_SPARSE_FACTOR:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


def configure_model(model: Any, integrator: str, stiffness: str, dt: float) -> None:
    """Set integrator, step (s) and stiffness of the loops.

    A stiffness of "solref 2 dt" sets the constraints' time constant to two steps, the shortest that the manual allows.
    """
    import mujoco

    model.opt.timestep = dt
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    if stiffness == "default":
        model.eq_solref[:], model.eq_solimp[:] = DEFAULT_SOLREF, DEFAULT_SOLIMP
    else:
        model.eq_solref[:] = [float(stiffness.split()[1]) * dt, 1.0]
        model.eq_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]


def make_program(model: Any, mechanism: Mechanism, state: tuple[Array, Array]) -> FixedStepProgram:
    """Return MuJoCo at an initial state, Pinocchio's q_tree and v_tree."""
    import mujoco

    data, states = mujoco.MjData(model), StateMap(mechanism, model)

    def reset() -> None:
        mujoco.mj_resetData(model, data)
        states.set_state(data, *state)

    return FixedStepProgram(
        reset, lambda steps: mujoco.mj_step(model, data, nstep=steps), lambda: states.get_state(data)
    )


def measure_deviation(mechanism: Mechanism, mjcf: str) -> tuple[float, float]:
    """Compare a motion in a MuJoCo model, with its own time step, to the DAE.

    The motion starts as assembled, with 1 rad/s (1 size/s of slides) in each independent coordinate, without torques.

    Returns
    -------
    deviation : float
        Largest difference of a coordinate, rad or m; of a free root, of its pose. Infinite if MuJoCo diverges.
    duration : float
        Duration of the motion, s: 1 s, or until the DAE stops.

    Raises
    ------
    CkcError
        The motion cannot be computed.
    """
    rates = {name: float(mechanism.tree.step_scale[mechanism.tree.index[name]]) for name in mechanism.independent}
    start = {"at": "assembled", "q_dot": rates}
    scene = Scene(
        mechanism, t_end=DEVIATION_TIME_S, formulation="dae", initial=start,
        solver={"rtol": DEVIATION_RTOL, "output_dt": DEVIATION_OUTPUT_S},
    )  # fmt: skip
    run, model, tree = simulate(scene), load_model(mjcf), mechanism.tree
    program = make_program(model, mechanism, (tree.from_coordinates(run.q_tree[0]), run.v_tree[0]))
    program.reset()
    deviation, steps = 0.0, np.round(run.t / model.opt.timestep).astype(int)
    for count, q_tree in zip(np.diff(steps), run.q_tree[1:], strict=True):
        program.step(int(count))
        numbers, _ = program.state()
        if not np.all(np.isfinite(numbers)):
            return np.inf, float(run.t[-1])
        difference = tree.difference(tree.from_coordinates(q_tree), tree.from_coordinates(numbers))
        deviation = max(deviation, float(np.abs(difference).max()))
    return deviation, float(run.t[-1])


def _compare_dynamics(mechanism: Mechanism, model: Any, state: tuple[Array, Array]) -> float:
    """Return the relative difference of MuJoCo's and Pinocchio's D', and of the bias if there is no free root."""
    import mujoco

    tree, (q_tree, v_tree), data = mechanism.tree, state, mujoco.MjData(model)
    velocity_map = StateMap(mechanism, model).set_state(data, q_tree, v_tree)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    D_tree = tree.evaluate(pin.crba, q_tree)
    D_tree = np.triu(D_tree) + np.triu(D_tree, 1).T
    difference = float(np.abs(velocity_map.T @ mass @ velocity_map - D_tree).max() / np.abs(D_tree).max())
    if tree.is_euclidean:
        bias = tree.evaluate(pin.nonLinearEffects, q_tree, v_tree)
        scale = max(float(np.abs(bias).max()), 1e-12)
        difference = max(difference, float(np.abs(velocity_map.T @ data.qfrc_bias - bias).max() / scale))
    return difference


class StateMap:
    """Conversion between Pinocchio's and MuJoCo's states of one mechanism."""

    def __init__(self, mechanism: Mechanism, model: Any) -> None:
        self._tree = mechanism.tree
        names = list(mechanism.tree.model.names)
        self._joints = {k: model.joint(names[k]) for k in range(1, len(names))}

    def set_state(self, data: Any, q_tree: Array, v_tree: Array) -> Array:
        """Set MuJoCo's state; return the map from Pinocchio's velocities to MuJoCo's, shape (n, n)."""
        tree = self._tree
        pin.forwardKinematics(tree.model, tree.data, q_tree)
        velocity_map = np.zeros((len(data.qvel), tree.n))
        for k, mujoco_joint in self._joints.items():
            joint, q, v = tree.model.joints[k], int(mujoco_joint.qposadr[0]), int(mujoco_joint.dofadr[0])
            if joint.nv == 1:
                data.qpos[q] = q_tree[joint.idx_q]
                velocity_map[v, joint.idx_v] = 1.0
                continue
            placement = tree.data.oMi[k]
            x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
            data.qpos[q : q + 7] = [*placement.translation, w, x, y, z]
            velocity_map[v : v + 3, joint.idx_v : joint.idx_v + 3] = placement.rotation
            velocity_map[v + 3 : v + 6, joint.idx_v + 3 : joint.idx_v + 6] = np.eye(3)
        data.qvel[:] = velocity_map @ v_tree
        return velocity_map

    def get_state(self, data: Any) -> tuple[Array, Array]:
        """Return q_tree and v_tree by coordinate."""
        tree = self._tree
        q_tree, v_tree = tree.neutral(), np.zeros(tree.n)
        for k, mujoco_joint in self._joints.items():
            joint, q, v = tree.model.joints[k], int(mujoco_joint.qposadr[0]), int(mujoco_joint.dofadr[0])
            if joint.nv == 1:
                q_tree[joint.idx_q], v_tree[joint.idx_v] = data.qpos[q], data.qvel[v]
                continue
            w, x, y, z = data.qpos[q + 3 : q + 7]
            rotation = pin.Quaternion(float(w), float(x), float(y), float(z)).matrix()
            placement = tree.model.jointPlacements[k].actInv(pin.SE3(rotation, np.array(data.qpos[q : q + 3])))
            q_tree[joint.idx_q : joint.idx_q + 7] = pin.SE3ToXYZQUAT(placement)
            v_tree[joint.idx_v : joint.idx_v + 3] = rotation.T @ data.qvel[v : v + 3]
            v_tree[joint.idx_v + 3 : joint.idx_v + 6] = data.qvel[v + 3 : v + 6]
        return tree.to_coordinates(q_tree), v_tree


def _ignore_warning(message: str) -> None:
    """Ignore a warning of MuJoCo: a run that diverged is recognized by its states."""
