"""Inverse dynamics: what motors, loops and joints must bear along a prescribed motion, or bore along a recorded one.

Of a recorded run the accelerations are those of eq. 1 with the efforts that it recorded, instant by instant, so that
these come back, with their share within the mechanism, and nothing is lost between output instants. What joints that
slide, stick and touch did there, its events tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.base.sources import Sources
from ckc_pin.base.validation import require_callable, require_table
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import RecordedTorques, Tracking
from ckc_pin.control.desired import Desired
from ckc_pin.control.workspace import find_workspace_exit
from ckc_pin.dynamics.formulations import dae_acceleration, multipliers, tangent_basis, tree_force
from ckc_pin.dynamics.inverse import friction_force, joint_wrenches, loop_wrenches
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.motion_forces import MotionForces, collected
from ckc_pin.run.recorded_joints import RecordedJoints
from ckc_pin.run.run import Run, Status
from ckc_pin.scene.initial import find_start
from ckc_pin.scene.output_instants import output_instants
from ckc_pin.scene.parts import scene_actuation, scene_controller, scene_mechanism
from ckc_pin.scene.scene import OVERRIDES, Scene, apply_overrides, as_scene, make_scene

__all__ = ["inverse_dynamics"]

LEFT_OVER = 1e-7  # of the forces along a freedom: rounding, which no actuator needs to produce
ROUNDING = 1e-4  # of that along the others: a freedom that no force acts along has nothing of its own
DEAD = 1e-7  # of a motion: what an actuator moves by where it is at a dead centre


@dataclass(frozen=True)
class _Instant:
    """One instant of a motion: what the loops allow, the efforts nearest to it, what friction and stops do."""

    t: float
    terms: Terms
    acceleration: Array
    tau: Array
    of_joints: Array


def inverse_dynamics(
    what: Scene | Run | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    progress: Callable[[float, float], None] | None = None,
) -> MotionForces:
    """Find the efforts, loop forces and joint forces of a motion.

    Parameters
    ----------
    what : Scene, Run, str or Path
        A scene, its shipped name or its path: the motion is what its controller wants (``controller.desired``,
        of coordinates or of a point; of a set point, to rest there), on the assembly branch of its start. Or a run,
        its file or its folder: the motion is the recorded one.
    overrides : mapping, optional
        Values of the scene, of a run's scene too, by dotted key, e.g. ``{"controller.torque_limit": 3.0}``.
    progress : callable, optional
        Called as progress(t, t_end).

    Returns
    -------
    MotionForces
        With status "stopped" or "interrupted" everything up to there.

    Raises
    ------
    InputError, MechanismError
        No motion is prescribed, it starts out of reach, no actuator holds one of the freedoms, or the run is of
        another mechanism.
    NumericalError
        The motion starts at a singular configuration.

    Notes
    -----
    Of more motors than freedoms tau is the least, or nearest to the preload, as a run's is within limits; of redundant
    rows the multipliers are the least.
    Friction of a joint is -friction sign(v'), zero where a prescribed motion rests; along a run what it was, in joints
    that stick the least that holds them.
    """
    if isinstance(what, str | Path) and _names_a_run(str(what)):
        what = Run.load(what)
    if not isinstance(what, Run):
        what = as_scene(what, overrides, "inverse_dynamics")
    elif overrides is not None:
        require_table(overrides, "inverse_dynamics: overrides", OVERRIDES)
    require_callable(progress, "inverse_dynamics: progress", "a function of (t, t_end)")
    with one_blas_thread():
        if isinstance(what, Run):
            scene, mechanism = _scene_of(what, overrides or {}), what.mechanism
            actuation = scene_actuation(scene, mechanism)
            motion, t_end = _recorded(what, mechanism), float(what.t[-1])
        else:
            scene = what
            mechanism, t_end = scene_mechanism(scene), scene.spec.t_end
            actuation = scene_actuation(scene, mechanism)
            motion = _prescribed(scene, mechanism, actuation)
        return _along(motion, mechanism, actuation, scene.name, progress or (lambda t, t_end: None), t_end)


def _names_a_run(name: str) -> bool:
    return name.endswith(".npz") or isfile(Path(name) / "run.npz")


def _scene_of(run: Run, overrides: Mapping[str, Any]) -> Scene:
    """Return the scene of a run, with its motor limits or others."""
    if any(key.partition(".")[0] == "mechanism" for key in overrides):
        raise InputError("mechanism: the motion of a run is its own mechanism's; give a scene to take another")
    sources = Sources(run.scene_name, None, run.texts)
    return make_scene(apply_overrides(run.scene, overrides), run.scene_name, sources)


def _along(
    motion: Iterator[_Instant],
    mechanism: Mechanism,
    actuation: Actuation,
    name: str,
    progress: Callable[[float, float], None],
    t_end: float,
) -> MotionForces:
    rows: list[dict[str, Any]] = []
    status: Status = "done"
    message = "reached the end of the motion"
    try:
        for instant in motion:
            rows.append(_forces(instant, mechanism, actuation))
            progress(instant.t, t_end)
    except NumericalError as error:
        if not rows:
            raise
        status, message = "stopped", f"stopped after t = {rows[-1]['t']:.6g} s: {error}"
    except KeyboardInterrupt as signal:
        if not rows:
            raise
        status, message = "interrupted", f"interrupted at t = {rows[-1]['t']:.6g} s{acknowledge(signal)}"
    return collected(rows, mechanism, actuation.limit, name, status, message)


def _forces(instant: _Instant, mechanism: Mechanism, actuation: Actuation) -> dict[str, Any]:
    """Solve eq. 1 at one instant for tau and the multipliers; what each joint transmits follows."""
    terms, acceleration, t = instant.terms, instant.acceleration, instant.t
    needed = tree_force(terms, acceleration) - instant.of_joints
    if not np.all(np.isfinite(needed)):
        raise NumericalError(f"the motion's rates or accelerations are not finite at t = {t:.6g} s", t=t)
    tangent, _ = tangent_basis(terms, np.zeros(mechanism.closure.rows))
    u_tree = mechanism.motors.force(instant.tau)
    lacking, enough = tangent.T @ (needed - u_tree), LEFT_OVER * np.abs(tangent.T) @ (np.abs(needed) + np.abs(u_tree))
    if np.any(np.abs(lacking) > enough + ROUNDING * enough.max(initial=0.0)):
        _require_grip(mechanism, tangent, actuation, t)
    tau = instant.tau + actuation.minimum_norm_torques(tangent, lacking)
    forces = multipliers(terms, mechanism.motors.force(tau) + instant.of_joints, acceleration)
    return {
        "t": t,
        "q_tree": mechanism.tree.to_coordinates(terms.q_tree),
        "v_tree": terms.v_tree,
        "a_tree": acceleration,
        "tau": tau,
        "multipliers": forces,
        "loop_wrenches": loop_wrenches(terms, forces),
        "joint_forces": joint_wrenches(terms, acceleration, forces),
    }


def _require_grip(mechanism: Mechanism, tangent: Array, actuation: Actuation, t: float) -> None:
    """Refuse a configuration where some freedom is held by no actuator, as at a rocker's dead centre."""
    motions = tangent / mechanism.tree.step_scale[:, None]
    motions, _ = np.linalg.qr(motions)  # of one size, in radians or the mechanism's size
    grip = mechanism.motors.transmission @ motions
    values, directions = np.linalg.eigh(grip.T @ grip)
    if values[0] <= DEAD**2:
        loose = mechanism.coordinates[int(np.argmax(np.abs(motions @ directions[:, 0])))]
        raise NumericalError(f"the motion along {loose} is held by no actuator at t = {t:.6g} s", t=t)


# --- motions -------------------------------------------------------------------------------------


def _prescribed(scene: Scene, mechanism: Mechanism, actuation: Actuation) -> Iterator[_Instant]:
    """What the controller of a scene wants, from sigma: v' = rho q_dot, its rate rho q_ddot + rho_dot q_dot."""
    controller = scene_controller(scene, mechanism)
    if controller is None or isinstance(controller, RecordedTorques):
        lacks = "no [controller]" if controller is None else 'the controller\'s type is "torques"'
        raise InputError(
            f"{scene.name}: {lacks}, so no motion is prescribed; give controller.desired, or a run of the scene"
        )
    at = find_start(mechanism, scene).at
    desired = controller.desired if isinstance(controller, Tracking) else _rest(controller.q_d)
    before: float | None = None
    for t in output_instants(scene).tolist():
        q_d, q_d_dot, q_d_ddot = desired(t)
        found = sigma(mechanism, q_d, at)
        if found.verdict != "converged" and before is not None:
            end = find_workspace_exit(mechanism, desired, at, before, t).leaves_at
            raise NumericalError(f"the motion cannot be followed beyond t = {end:.5f} s: {found.reason}", t=end)
        if found.verdict != "converged":
            kind = NumericalError if found.verdict == "singular" else InputError
            raise kind(f"{scene.name}: the motion cannot be started: q_d(0) is {found.verdict}: {found.reason}")
        if before is None:
            actuation.require_driven_freedoms(found.at)
        at, before = found.at, t
        terms = Terms(mechanism, at, at.rho @ q_d_dot)
        friction = friction_force(mechanism, terms.v_tree)
        yield _Instant(t, terms, at.rho @ q_d_ddot + terms.rho_dot_times(q_d_dot), actuation.preload, friction)


def _rest(q_d: Array) -> Desired:
    """Return the motion that stays at q_d."""
    none = np.zeros_like(q_d)
    return lambda t: (q_d, none, none)


def _recorded(run: Run, mechanism: Mechanism) -> Iterator[_Instant]:
    """What a run recorded."""
    if np.any(run.w[0]):
        raise InputError(
            f"{run.scene_name}: the run starts off phi = 0, with open loops: no forces in a closed mechanism move it so"
        )
    of_joints = RecordedJoints(run)
    for k, (t, numbers) in enumerate(zip(run.t.tolist(), run.q_tree, strict=True)):
        terms = Terms(mechanism, mechanism.kinematics(mechanism.tree.from_coordinates(numbers)), run.v_tree[k])
        u_tree = mechanism.motors.force(run.tau[k])
        force = of_joints(k, terms, u_tree)
        yield _Instant(t, terms, dae_acceleration(terms, u_tree + force), run.tau[k], force)
