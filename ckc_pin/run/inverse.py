"""Inverse dynamics: motor torques, loop forces and joint forces along a prescribed or a recorded motion.

For a recorded run, the result contains the torques of the run, since its accelerations follow from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.linear_algebra import null_spaces, one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.validation import require_callable, require_table
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import RecordedTorques, SetPoint, Tracking
from ckc_pin.control.desired import Desired, find_rate_jump
from ckc_pin.control.forces import body_wrenches, generalized_force
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.workspace import find_workspace_exit
from ckc_pin.dynamics.formulations import multipliers, rank_loss_error, tree_force
from ckc_pin.dynamics.inverse import friction_force, joint_wrenches_along, loop_wrenches_along
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.motion_forces import MotionForces, collect_forces
from ckc_pin.run.recorded import Instant, recorded_motion
from ckc_pin.run.run import Run, Status
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES, apply_overrides
from ckc_pin.scene.parts import (
    build_scene_actuation,
    build_scene_controller,
    build_scene_forces,
    load_scene_mechanism,
)
from ckc_pin.scene.scene import Scene, as_scene, make_scene

__all__ = ["inverse_dynamics"]

# Below this, relative to the forces along a freedom, a missing generalized force is rounding.
FORCE_TOLERANCE = 1e-7
# The same relative to the tolerance of the freedom with the largest forces, for freedoms along which no force acts.
CROSS_TOLERANCE = 1e-4
# A motor at a dead centre moves by less than this, relative to the motion of the freedom.
DEAD_CENTRE_TOLERANCE = 1e-7
MAX_BATCH = 64  # instants whose forces are computed together
MAX_BATCH_ENTRIES = 65_536  # of their matrices (n, n), which stay in the cache


def inverse_dynamics(
    what: Scene | Run | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    progress: Callable[[float, float], None] | None = None,
) -> MotionForces:
    """Compute motor torques, loop forces and joint forces along a motion.

    Parameters
    ----------
    what : Scene, Run, str or Path
        A scene, its shipped name or its path: the motion is its controller's desired motion, of coordinates or of a
        point, or rest at the target of a set point, on the assembly branch of the scene's start. Or a run, its file or
        its folder: the motion is the recorded one.
    overrides : mapping, optional
        Values of the scene, or of a run's scene, by dotted key, e.g. ``{"controller.torque_limit": 3.0}``.
    progress : callable, optional
        Called as progress(t, t_end).

    Returns
    -------
    MotionForces
        If its status is "stopped" or "interrupted", it contains all instants up to that time.

    Raises
    ------
    InputError, MechanismError
        No motion is prescribed, it starts out of reach, no motor moves one of the freedoms, or the run is of another
        mechanism.
    NumericalError
        The motion starts at a singular configuration.

    Notes
    -----
    With more motors than freedoms, tau is the minimum-norm solution, or the one nearest to the preload, as in a run
    within limits. With redundant rows the multipliers have minimum norm.

    Friction of a joint is -friction sign(v'), and zero where a prescribed motion is at rest. Along a run it is the
    friction of the run. Joints that stick have the minimum-norm friction forces that hold them.
    """
    if isinstance(what, str | Path) and _is_run_name(str(what)):
        what = Run.load(what)
    if not isinstance(what, Run):
        what = as_scene(what, overrides, "inverse_dynamics")
    elif overrides is not None:
        require_table(overrides, "inverse_dynamics: overrides", EXPECTED_OVERRIDES)
    require_callable(progress, "inverse_dynamics: progress", "a function of (t, t_end)")
    with one_blas_thread():
        if isinstance(what, Run):
            scene, mechanism = _scene_of(what, overrides or {}), what.mechanism
            actuation = build_scene_actuation(scene, mechanism)
            motion, t_end = recorded_motion(what), float(what.t[-1])
        else:
            scene = what
            mechanism, t_end = load_scene_mechanism(scene), scene.spec.t_end
            if mechanism.prescribed:
                raise InputError(
                    f"inverse_dynamics: the motion of {', '.join(mechanism.prescribed)} is prescribed, so a run "
                    "computes its torque; give a run of the scene instead of the scene"
                )
            actuation = build_scene_actuation(scene, mechanism)
            motion = _desired_motion(scene, mechanism, actuation)
        return _collect_motion(motion, mechanism, actuation, scene.name, t_end, progress)


def _is_run_name(name: str) -> bool:
    """Whether a name denotes a run file or a folder with one, and not a scene."""
    return name.endswith(".npz") or isfile(Path(name) / "run.npz")


def _scene_of(run: Run, overrides: Mapping[str, Any]) -> Scene:
    """Return the scene of a run with overrides, for example of motor limits."""
    if any(key.partition(".")[0] == "mechanism" for key in overrides):
        raise InputError("mechanism: a run belongs to its mechanism; give a scene to use another mechanism")
    sources = Sources(run.scene_name, None, run.texts)
    return make_scene(apply_overrides(run.scene, overrides), run.scene_name, sources, sources)


def _collect_motion(
    motion: Iterator[Instant],
    mechanism: Mechanism,
    actuation: Actuation,
    name: str,
    t_end: float,
    progress: Callable[[float, float], None] | None,
) -> MotionForces:
    """Compute the forces at all instants of a motion, until it ends, fails or is interrupted."""
    forces: list[dict[str, Any]] = []
    status: Status = "done"
    message = "reached the end of the motion"
    try:
        for batch in _split_into_batches(motion, mechanism.n, t_end, progress):
            _append_forces(forces, batch, mechanism, actuation)
    except NumericalError as error:
        if not forces:
            raise
        status, message = "stopped", f"stopped after t = {forces[-1]['t'][-1]:.6g} s: {error}"
    except KeyboardInterrupt as signal:
        if not forces:
            raise
        status, message = "interrupted", f"interrupted at t = {forces[-1]['t'][-1]:.6g} s{acknowledge(signal)}"
    return collect_forces(forces, mechanism, actuation.limit, name=name, status=status, message=message)


def _split_into_batches(
    motion: Iterator[Instant], n: int, t_end: float, progress: Callable[[float, float], None] | None
) -> Iterator[list[Instant]]:
    """Yield the instants of a motion in batches. If the motion fails, the instants before come first."""
    size = max(1, min(MAX_BATCH, MAX_BATCH_ENTRIES // n**2))
    batch: list[Instant] = []
    try:
        for instant in motion:
            batch.append(instant)
            if progress is not None:
                progress(instant.t, t_end)
            if len(batch) == size:
                yield batch
                batch = []
    except (NumericalError, KeyboardInterrupt) as reason:
        if batch:
            if isinstance(reason, KeyboardInterrupt):
                acknowledge(reason)  # so that it is not raised again before the forces are computed
            yield batch
        raise
    if batch:
        yield batch


def _append_forces(
    forces: list[dict[str, Any]], batch: list[Instant], mechanism: Mechanism, actuation: Actuation
) -> None:
    """Solve eq. 1 at instants for tau and the multipliers, and append them with the joint wrenches that follow.

    If there is no solution at an instant, those before are appended, and NumericalError is raised.
    """
    states = [instant.terms for instant in batch]
    acceleration = np.array([instant.acceleration for instant in batch])
    other_force = np.array([instant.other_force for instant in batch])
    preload = np.array([instant.tau for instant in batch])
    transmission = mechanism.motors.transmission
    passive = np.array([tree_force(*x) for x in zip(states, acceleration, strict=True)])
    required, u_tree = passive - other_force, preload @ transmission
    tangent, has_rank = null_spaces(np.array([terms.at.J for terms in states]), mechanism.rank)
    transposed = np.swapaxes(tangent, 1, 2)
    missing = _multiply(transposed, required - u_tree)
    tolerance = FORCE_TOLERANCE * _multiply(np.abs(transposed), np.abs(required) + np.abs(u_tree))
    tolerance += CROSS_TOLERANCE * tolerance.max(axis=1, initial=0.0, keepdims=True)
    fails = ~(np.isfinite(required).all(axis=1) & has_rank)
    needs_motors = ~fails & (np.abs(missing) > tolerance).any(axis=1)
    fails[needs_motors] = _motor_motions(mechanism, tangent[needs_motors])[0][:, 0] <= DEAD_CENTRE_TOLERANCE**2
    error: NumericalError | None = None
    if fails.any():
        k = int(np.argmax(fails))
        error = _explain_failure(batch[k], mechanism, required[k], tangent[k] if has_rank[k] else None)
        batch, states, acceleration = batch[:k], states[:k], acceleration[:k]
    m = len(batch)
    if m:
        tau = preload[:m] + actuation.minimum_norm_torques(tangent[:m], missing[:m])
        u_tree = tau @ transmission + other_force[:m]
        lambdas = np.array([multipliers(*x) for x in zip(states, u_tree, acceleration, strict=True)])
        applied = np.array([instant.link_wrenches for instant in batch])
        forces.append({
            "t": np.array([instant.t for instant in batch]),
            "q_tree": np.array([mechanism.tree.to_coordinates(terms.q_tree) for terms in states]),
            "v_tree": np.array([terms.v_tree for terms in states]),
            "a_tree": acceleration,
            "tau": tau,
            "multipliers": lambdas,
            "loop_wrenches": loop_wrenches_along(states, lambdas),
            "joint_forces": joint_wrenches_along(states, acceleration, lambdas, applied),
        })  # fmt: skip
    if error:
        raise error


def _multiply(matrices: Array, vectors: Array) -> Array:
    """Return the products of matrices (m, k, n) and vectors (m, n), shape (m, k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _motor_motions(mechanism: Mechanism, tangent: Array) -> tuple[Array, Array]:
    """Return squares of motor motions by unit motions along principal directions, (..., d), and these (..., n, d).

    `tangent` are bases (..., n, d). Lengths are relative to the mechanism's size.
    """
    motions, _ = np.linalg.qr(tangent / mechanism.tree.step_scale[:, None])
    motor_motions = mechanism.motors.transmission @ motions
    values, directions = np.linalg.eigh(np.swapaxes(motor_motions, -1, -2) @ motor_motions)
    return values, motions @ directions


def _explain_failure(instant: Instant, mechanism: Mechanism, required: Array, tangent: Array | None) -> NumericalError:
    """Return the error that tells why the motors cannot provide a required force (n,).

    The motion is not finite, J has lost rank (`tangent` is None), or no motor moves some freedom, for example at a
    rocker's dead centre.
    """
    t = instant.t
    if not np.all(np.isfinite(required)):
        return NumericalError(f"the motion's rates or accelerations are not finite at t = {t:.6g} s", t=t)
    if tangent is None:
        return rank_loss_error(instant.terms)
    _, directions = _motor_motions(mechanism, tangent)
    coordinate = mechanism.coordinates[int(np.argmax(np.abs(directions[:, 0])))]
    return NumericalError(f"the motion along {coordinate} is held by no actuator at t = {t:.6g} s", t=t)


# --- desired motions -----------------------------------------------------------------------------


def _desired_motion(scene: Scene, mechanism: Mechanism, actuation: Actuation) -> Iterator[Instant]:
    """Yield the desired motion of a scene's controller, with v' = rho q_dot and its rate rho q_ddot + rho_dot q_dot."""
    controller = build_scene_controller(scene, mechanism)
    if not isinstance(controller, SetPoint | Tracking):
        kind = scene.spec.controller and scene.spec.controller.__struct_config__.tag
        what = f'the controller\'s type is "{kind}"'
        if not isinstance(controller, RecordedTorques | JointServo):
            what = "no [controller]" if controller is None else "the controller is an object without a desired motion"
        raise InputError(
            f"{scene.name}: {what}, so no motion is prescribed; give controller.desired, or a run of the scene"
        )
    at = find_start(mechanism, scene).at
    desired = controller.desired if isinstance(controller, Tracking) else _rest_at(controller.q_d)
    jump = find_rate_jump(desired, scene.spec.t_end)
    if jump is not None:
        raise InputError(
            f"{scene.name}: controller.desired: the rate jumps at t = {jump:.6g} s, where no finite torque follows it; "
            'take another profile, or interpolation, than "linear"'
        )
    forces = build_scene_forces(scene, mechanism)
    previous_t: float | None = None
    for t in scene.output_instants().tolist():
        q_d, q_d_dot, q_d_ddot = desired(t)
        solution = sigma(mechanism, q_d, at)
        if solution.verdict != "converged" and previous_t is not None:
            end = find_workspace_exit(mechanism, desired, at, previous_t, t).leaves_at
            raise NumericalError(f"the motion cannot be followed beyond t = {end:.5f} s: {solution.reason}", t=end)
        if solution.verdict != "converged":
            error = NumericalError if solution.verdict == "singular" else InputError
            raise error(f"{scene.name}: the motion cannot be started: q_d(0) is {solution.verdict}: {solution.reason}")
        if previous_t is None:
            actuation.require_driven_freedoms(solution.at)
        at, previous_t = solution.at, t
        terms = Terms(mechanism, at, at.rho @ q_d_dot)
        acceleration = at.rho @ q_d_ddot + terms.rho_dot_times(q_d_dot)
        wrenches = body_wrenches(forces, t, terms)
        other_force = friction_force(mechanism, terms.v_tree) + generalized_force(wrenches, terms)
        yield Instant(t, terms, acceleration, actuation.preload, other_force, wrenches)


def _rest_at(q_d: Array) -> Desired:
    """Return the motion that stays at q_d."""
    zero = np.zeros_like(q_d)
    return lambda t: (q_d, zero, zero)
