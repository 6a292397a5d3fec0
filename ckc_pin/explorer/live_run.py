"""A run that starts at the explorer's pose and moves in real time, can be pushed, rewound and written as a scene."""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Literal

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.validation import describe_value, is_number
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import has_state
from ckc_pin.control.forces import Force, as_vector
from ckc_pin.control.joint_servo import JointServo
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import CkcError, InputError, NumericalError
from ckc_pin.explorer.messages import RunReport
from ckc_pin.explorer.saving import scene_at, write_new_texts
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import CONSTRAINED_IN_PART, Mechanism
from ckc_pin.run.simulate import simulate
from ckc_pin.run.simulator import Simulator
from ckc_pin.run.state import State
from ckc_pin.scene.names import SUFFIX
from ckc_pin.scene.parts import build_scene_actuation
from ckc_pin.scene.saving import scene_texts
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["LiveFrame", "LiveRun", "Mode", "list_modes"]

Mode = Literal["free", "scene", "hold"]

MAX_FRAME_S = 1.0 / 60.0  # longest simulated time of a frame
MIN_FRAME_WALL_S = 1.0 / 60.0  # between two calls of on_frame
EVENT_TOLERANCE = 1e-9  # of a frame: shorter ones have been ended by an event
MAX_LAG_S = 0.1  # a computation that is later than this does not catch up
RATE_WINDOW_S = 0.5  # in which the reached speed is measured
MAX_FRAMES = 20_000  # stored; beyond, and beyond MAX_STORED_BYTES, every second one is dropped
MAX_STORED_BYTES = 16 * 2**20
FRAME_OVERHEAD_BYTES = 600  # of a stored frame's Python objects
HOLD_FREQUENCY = 2 * math.pi * 2.0  # rad/s, of the errors under "hold", which are critically damped
TARGET_TIME_S = 0.1  # time constant with which targets follow their sliders
TARGET_TOLERANCE = 1e-6  # rad, m: a target this close to its slider's value is there
PUSH_FREQUENCY = 2 * math.pi * 1.5  # rad/s, of the spring with the mass that the grabbed point has
PUSH_DAMPING_RATIO = 0.8
MAX_PUSH_ACCELERATION = 50.0  # m/s^2 times the mechanism's mass bounds the force
MAX_PUSH_MASS = 10.0  # of the mechanism's mass: bound of the mass in a direction in which the point hardly moves


@dataclass(frozen=True)
class LiveFrame:
    """What a run shows at one instant.

    Attributes
    ----------
    t : float
        s.
    q_tree : (nq,) array
        Pinocchio's q.
    v_tree : (n,) array
    tau : (motors,) array
        N m or N.
    push : (2, 3) array or None
        Where the force of a push acts and the force, in the world, m and N.
    """

    t: float
    q_tree: Array
    v_tree: Array
    tau: Array
    push: Array | None = None


@dataclass(frozen=True)
class _Frame:
    """A computed frame, as it is stored. `desired` are the targets at its time in mode "hold"."""

    number: int
    state: State
    tau: Array
    push: Array | None
    desired: Array


@dataclass(frozen=True)
class _Input:
    """Wrenches by joint, without those that are zero, and motor torques of mode "free", from a time on."""

    t: float
    wrenches: dict[str, Array]
    tau: Array

    def equals(self, other: _Input) -> bool:
        """Whether wrenches and torques are equal, at another time."""
        return (
            self.wrenches.keys() == other.wrenches.keys()
            and all(np.array_equal(x, other.wrenches[name]) for name, x in self.wrenches.items())
            and np.array_equal(self.tau, other.tau)
        )


@dataclass(frozen=True)
class _Push:
    """A gesture: a point of a body, in the body's axes, is pulled towards a target in the world."""

    joint: int
    name: str
    point: Array
    target: Array
    normal: Array | None


def list_modes(mechanism: Mechanism, scene: Scene | None) -> list[Mode]:
    """Return the modes in which a mechanism can run: "free", "scene" with a controller, "hold" with enough motors.

    A mechanism whose loops constrain a free root in part has none.
    """
    if mechanism.splits_root:
        return []
    modes: list[Mode] = ["free"]
    if scene is not None and (scene.spec.controller is not None or scene.controller is not None):
        modes.append("scene")
    if mechanism.d and mechanism.actuated and not _explain_no_hold(mechanism, scene):
        modes.append("hold")
    return modes


def _explain_no_hold(mechanism: Mechanism, scene: Scene | None) -> str:
    if not mechanism.actuated or not mechanism.d:
        return f"{mechanism.name} has no motors" if mechanism.d else f"{mechanism.name} has no freedoms"
    try:
        actuation = Actuation(mechanism) if scene is None else build_scene_actuation(scene, mechanism)
        return actuation.explain_undriven_freedoms(mechanism.assembled)
    except CkcError as error:
        return str(error)


class LiveRun:
    """A run from a pose, in real time times a speed.

    Parameters
    ----------
    mechanism : Mechanism
        With its present parameters. The run loads its own, and does not use this one after the constructor.
    at : Kinematics
        The pose.
    scene : Scene, optional
        The explored scene, whose forces, events, friction and controller act.
    mode : "free", "scene" or "hold"
        Motors exert the torques of `set_motor`, the scene's controller acts, or motors hold targets by eq. 16 with
        gains for a critically damped error of 2 Hz at the pose.
    speed : float
        Simulated seconds per second.
    rtol : float
        Relative tolerance.
    formulation : str, optional
        Default: the scene's, else "reduced".
    q_dot : (d,) array, optional
        Rates of the independent coordinates; default: at rest.
    on_frame : callable, optional
        Called without arguments in the run's thread when a new frame can be shown, at most 60 times a second, and when
        the run stops.

    Raises
    ------
    InputError, MechanismError, NumericalError
        The mechanism does not have the mode, or cannot run from the pose.

    Notes
    -----
    The constructor prepares the run in the caller's thread, which takes as long as `Simulator` does. After `start`, a
    thread of the run's own computes frames of at most 1/60 s of simulated time. The methods only leave requests for
    that thread, or copy what it has stored, so that they return at once. Only `export` computes in its caller's thread,
    the whole run; call it from a thread that may wait.

    If the computation is slower than real time, frames come later, and `report` tells the reached speed.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        at: Kinematics,
        scene: Scene | None = None,
        mode: Mode = "free",
        *,
        speed: float = 1.0,
        rtol: float = 1e-6,
        formulation: str | None = None,
        q_dot: Array | None = None,
        on_frame: Callable[[], None] | None = None,
    ) -> None:
        if mode not in (modes := list_modes(mechanism, scene)):
            if not modes:
                raise InputError(f"run: {mechanism.name}: {CONSTRAINED_IN_PART}")
            reason = "there is no controller" if mode == "scene" else _explain_no_hold(mechanism, scene)
            raise InputError(f"run: mode {mode!r}: {reason}; choose {' or '.join(map(repr, modes))}")
        self.mode, self._on_frame = mode, on_frame
        self.set_speed(speed)
        keys: dict[str, Any] = {"solver.rtol": rtol, "solver.atol": None}
        if formulation is not None:
            keys["formulation"] = formulation
        if mode == "hold":
            keys["controller"] = _hold_law(mechanism, at, scene)
        self._scene = scene_at(mechanism, scene, at, q_dot, keys)
        self._joints = list(mechanism.tree.model.names)[1:]
        zero = [0.0, 0.0, 0.0]
        self._forces = [Force(f"joint:{name}", zero, zero, name=_force_name(name)) for name in self._joints]
        self._simulator = self._make_simulator(self._scene)
        self.mechanism = self._simulator.mechanism
        self._mass = sum(inertia.mass for inertia in self.mechanism.tree.model.inertias)
        self._has_memory = mode == "scene" and _has_memory(self._simulator)
        start = self._simulator.state
        self._max_frames = _max_frames(start)
        self._tau = np.zeros(len(self.mechanism.actuated))
        self._target = self._desired = start.q.copy()
        self._pull: _Push | None = None
        self._frames = [_Frame(0, start, self._simulator.tau, None, self._desired)]
        self._times = [start.t]
        self._stride = 1  # Frames whose numbers are multiples of it are stored, and the last one.
        self._inputs = [_Input(start.t, {}, self._tau)]
        self._knots = [(start.t, self._desired)]  # of the targets' piecewise linear motion
        self._shown = 0  # index of the frame that is shown
        self._must_restore = False  # whether the simulator is ahead of the frame that is shown
        self._is_paused, self._is_stopped, self._message = False, False, ""
        self._reached: deque[tuple[float, float]] = deque()  # (wall time, t) of the last frames
        self._frame_duration = MAX_FRAME_S
        self._change = Condition()
        self._has_thread = False

    def _make_simulator(self, scene: Scene) -> Simulator:
        return Simulator(scene, forces=self._forces, controlled=self.mode != "free")

    # --- requests --------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to compute, in a thread of the run's own."""
        self._has_thread = True
        Thread(target=self._compute_until_stopped, name="ckc_pin live run", daemon=True).start()

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second, in (0, 100]."""
        if not is_number(speed) or not 0 < speed <= 100:
            raise InputError(f"run: speed = {describe_value(speed)}: expected a number greater than 0, at most 100")
        self.speed = float(speed)

    def set_motor(self, name: str, value: float) -> None:
        """Set a motor's torque, N m or N (mode "free"), or a coordinate's target, rad or m ("hold")."""
        if self.mode == "scene":
            raise InputError(f"set_motor: {name}: the scene's controller sets the motors; start with mode free or hold")
        names, what = (
            (self.mechanism.actuated, "motor")
            if self.mode == "free"
            else (self.mechanism.independent, "independent coordinate")
        )
        if name not in names:
            raise InputError(f"set_motor: no {what} {name!r:.80}; there are {', '.join(names) or 'none'}")
        if not is_number(value) or not math.isfinite(value):
            raise InputError(f"set_motor: {name}: expected a finite number, got {describe_value(value)}")
        with self._change:
            values = (self._tau if self.mode == "free" else self._target).copy()
            values[names.index(name)] = value
            if self.mode == "free":
                self._tau = values
            else:
                self._target = values

    def push(self, body: str, point: Any, target: Any, normal: Any = None) -> None:
        """Pull a point of a body towards a target with a damped spring, until `release`.

        The spring moves the mass that the point has in each direction with 1.5 Hz and a damping ratio of 0.8. Its force
        is constant within a frame, in world axes.

        Parameters
        ----------
        body : str
            Name of the joint that moves the body.
        point : (3,) array
            In the body's axes, m.
        target : (3,) array
            In the world, m.
        normal : (3,) array, optional
            A direction along which the distance has no influence, in the world.
        """
        if body not in self._joints:
            raise InputError(f"push: no joint {body!r:.80} moves a body; there are {', '.join(self._joints)}")
        vectors = [
            as_vector(point, "push: point", "3 finite numbers"),
            as_vector(target, "push: target", "3 finite numbers"),
        ]
        direction = None if normal is None else as_vector(normal, "push: normal", "3 finite numbers")
        if direction is not None and np.linalg.norm(direction) > 0:
            direction = direction / np.linalg.norm(direction)
        with self._change:
            self._pull = _Push(self._joints.index(body) + 1, body, vectors[0], vectors[1], direction)

    def release(self) -> None:
        """End a push."""
        with self._change:
            self._pull = None

    def pause(self, on: bool = True) -> None:
        """Pause, or continue from the frame that is shown. Frames after it are then dropped."""
        with self._change:
            self._is_paused = on
            self._reached.clear()
            if not on and self._shown < len(self._frames) - 1:
                self._truncate()
            self._change.notify_all()

    def rewind(self, t: float) -> None:
        """Pause and show the last stored frame up to a time, s."""
        if not is_number(t) or not math.isfinite(t):
            raise InputError(f"rewind: t = {describe_value(t)}: expected a finite number, in seconds")
        with self._change:
            self._is_paused = True
            self._reached.clear()
            self._shown = max(bisect_right(self._times, t + 1e-9) - 1, 0)

    def stop(self) -> None:
        """End the run, and a step that is being computed within 0.05 s."""
        with self._change:
            self._is_stopped = True
            self._simulator.cancel()
            self._change.notify_all()

    def _truncate(self) -> None:
        """Drop what comes after the frame that is shown, and continue from it."""
        del self._frames[self._shown + 1 :], self._times[self._shown + 1 :]
        t, desired = self._times[-1], self._frames[-1].desired
        self._inputs = [one for one in self._inputs if one.t < t] or self._inputs[:1]
        self._knots = [*(one for one in self._knots if one[0] < t), (t, desired)]
        self._desired = desired
        was_stopped = self._is_stopped
        self._simulator.cancel()
        self._must_restore, self._is_stopped, self._message = True, False, ""
        if was_stopped and self._has_thread:
            self.start()

    # --- what is shown ---------------------------------------------------------------------------

    def frame(self) -> LiveFrame:
        """Return the frame to show: the newest one, or an earlier one after `rewind`."""
        with self._change:
            frame = self._frames[self._shown]
        state = frame.state
        q_tree = state.mechanism.tree.from_coordinates(state.q_tree)
        return LiveFrame(state.t, q_tree, state.v_tree, frame.tau, frame.push)

    def report(self) -> RunReport:
        """Return the state of the run."""
        with self._change:
            state: Literal["running", "paused", "stopped"] = "running"
            if self._is_paused and (not self._is_stopped or self._shown < len(self._frames) - 1):
                state = "paused"
            elif self._is_stopped:
                state = "stopped"
            return RunReport(
                state=state,
                t=self._times[self._shown],
                t_last=self._times[-1],
                message=self._message,
                real_time=self._measure_speed(),
                mode=self.mode,
                motors=self._describe_motors(),
            )

    def _describe_motors(self) -> dict[str, float]:
        """Return what `set_motor` has set: torques in mode "free", targets in mode "hold"."""
        match self.mode:
            case "free":
                return dict(zip(self.mechanism.actuated, self._tau.tolist(), strict=True))
            case "hold":
                return dict(zip(self.mechanism.independent, self._target.tolist(), strict=True))
            case _:
                return {}

    def _measure_speed(self) -> float:
        if len(self._reached) < 2:
            return 0.0
        (wall, t), (last_wall, last_t) = self._reached[0], self._reached[-1]
        return (last_t - t) / (last_wall - wall) if last_wall > wall else 0.0

    # --- the run's thread ------------------------------------------------------------------------

    def _compute_until_stopped(self) -> None:
        """Compute frames when they are due."""
        due, shown_at, has_stopped = time.monotonic(), 0.0, False
        while not has_stopped:
            with self._change:
                if self._is_paused and not self._is_stopped:
                    self._change.wait_for(lambda: not self._is_paused or self._is_stopped)
                    due = time.monotonic()
                delay = due - time.monotonic()
                if delay > 0 and not self._is_stopped:
                    self._change.wait(delay)
                    continue
            advanced = self.advance()
            now = time.monotonic()
            due = max(due + advanced / self.speed, now - MAX_LAG_S)
            with self._change:
                has_stopped = self._is_stopped  # `pause` may start another thread after this.
                self._has_thread = self._has_thread and not has_stopped
            if self._on_frame is not None and (has_stopped or now - shown_at >= MIN_FRAME_WALL_S):
                shown_at = now
                self._on_frame()

    def advance(self) -> float:
        """Compute one frame and return its duration, s. The run's thread calls it; without `start`, the caller may."""
        with self._change:
            if self._is_stopped or self._is_paused:
                return 0.0
            pull, tau, target, must_restore = self._pull, self._tau, self._target, self._must_restore
            self._must_restore = False
        reason = ""
        try:
            if must_restore:
                self._restore()
            frame, step_input, moved = self._make_step(pull, tau, target)
        except NumericalError as error:
            reason = str(error)
        except Exception as error:  # of a controller, event or force that is a function of the caller's
            reason = f"{type(error).__name__}: {error}"
        else:
            duration = self._store(frame, step_input, moved)
            if duration > (1 - EVENT_TOLERANCE) * self._frame_duration or not duration:
                return duration
            reason = f"event {self._simulator.events[-1]['name']}"
        with self._change:
            self._is_stopped, self._message = True, f"stopped at t = {self._times[-1]:.6g} s: {reason}"
        return 0.0

    def _make_step(self, pull: _Push | None, tau: Array, target: Array) -> tuple[_Frame, _Input, bool]:
        """Make a step and return its frame, its inputs, and whether the targets moved."""
        simulator, state = self._simulator, self._simulator.state
        wrench, push = self._compute_wrench(pull, state) if pull else (None, None)
        acting = {} if pull is None or wrench is None else {pull.name: wrench}
        wrenches = {_force_name(name): acting.get(name, np.zeros(6)) for name in {*acting, *self._inputs[-1].wrenches}}
        dt = self._frame_duration = MAX_FRAME_S * min(self.speed, 1.0)
        desired, moved = self._desired, False
        if self.mode == "hold" and not np.array_equal(desired, target):
            moved = True
            desired = desired + (target - desired) * -math.expm1(-dt / TARGET_TIME_S)
            if np.abs(target - desired).max() < TARGET_TOLERANCE:
                desired = target
        if self.mode == "free":
            reached = simulator.step(None, dt, tau=tau if len(tau) else None, wrenches=wrenches)
        else:
            reached = simulator.step(None, dt, wrenches=wrenches, desired=desired if moved else None)
        number = self._frames[-1].number + 1
        return _Frame(number, reached, simulator.tau, push, desired), _Input(state.t, acting, tau), moved

    def _store(self, frame: _Frame, step_input: _Input, moved: bool) -> float:
        """Store a frame and return its duration, s: 0 if the run has been rewound or stopped in the meantime."""
        with self._change:
            if self._must_restore or self._is_stopped:
                return 0.0
            if not step_input.equals(self._inputs[-1]):
                self._inputs[-1:] = (
                    [step_input] if step_input.t == self._inputs[-1].t else [self._inputs[-1], step_input]
                )
            if moved:
                if self._knots[-1][0] < step_input.t:
                    self._knots.append((step_input.t, self._desired))
                self._knots.append((frame.state.t, frame.desired))
            self._desired = frame.desired
            follows, t_shown = self._shown == len(self._frames) - 1, self._times[self._shown]
            if self._frames[-1].number % self._stride and follows:
                del self._frames[-1], self._times[-1]
            self._frames.append(frame)
            self._times.append(frame.state.t)
            if len(self._frames) > self._max_frames:
                self._stride *= 2
                self._frames = [x for x in self._frames[:-1] if x.number % self._stride == 0] + [frame]
                self._times = [x.state.t for x in self._frames]
            self._shown = len(self._frames) - 1 if follows else bisect_right(self._times, t_shown) - 1
            now = time.monotonic()
            self._reached.append((now, frame.state.t))
            while now - self._reached[0][0] > RATE_WINDOW_S and len(self._reached) > 2:
                self._reached.popleft()
            return frame.state.t - step_input.t

    def _restore(self) -> None:
        """Set the simulator to the last stored frame."""
        with self._change:
            frame, t, inputs = self._frames[-1], self._times[-1], list(self._inputs)
        if not self._has_memory:
            if self.mode == "hold":  # The targets at that time are those from which the next ones are reached.
                names, desired = self._simulator.mechanism.independent, frame.desired
                offsets = {name: {"offset": x} for name, x in zip(names, desired.tolist(), strict=True)}
                self._simulator = self._make_simulator(self._scene.with_overrides({"controller.desired": offsets}))
            self._simulator.reset(frame.state)
            with self._change:
                self._inputs.append(_Input(t, {}, inputs[-1].tau))
            return
        # The controller's own state, such as integrals and samples, is that of the same motion computed again.
        self._simulator.reset()
        times = [one.t for one in inputs] + [t]
        for k, one in enumerate(inputs):
            wrenches = {_force_name(name): one.wrenches.get(name, np.zeros(6)) for name in self._joints}
            while self._simulator.state.t < times[k + 1]:
                dt = min(MAX_FRAME_S, times[k + 1] - self._simulator.state.t)
                self._simulator.step(None, dt, wrenches=wrenches)
                if self._is_stopped:
                    return

    def _compute_wrench(self, pull: _Push, state: State) -> tuple[Array | None, Array | None]:
        """Return the wrench of a push about the origin of its joint, in world axes, (6,), and where it acts, (2, 3)."""
        terms = state.with_mechanism(self.mechanism).terms  # The stored state keeps no terms.
        pose = terms.at.pose
        origin, arm = pose.translation[pull.joint], pose.rotation[pull.joint] @ pull.point
        place = origin + arm
        moves = self.mechanism.tree.support[pull.joint, 0]
        jacobian = (pose.linear_part + np.cross(pose.angular_part.T, place).T) * moves
        if terms.at.phi_z_factor.singular:
            return None, None
        along = jacobian @ terms.rho
        inverse_mass, axes = np.linalg.eigh(along @ terms.D_factor.solve(along.T))
        largest = inverse_mass.max(initial=0.0)
        if not largest > 0:
            return None, None
        mass = np.where(
            inverse_mass > 1e-9 * largest, 1.0 / np.maximum(inverse_mass, 1.0 / (MAX_PUSH_MASS * self._mass)), 0.0
        )
        error = pull.target - place
        if pull.normal is not None:
            error = error - (error @ pull.normal) * pull.normal
        acceleration = PUSH_FREQUENCY**2 * error - 2 * PUSH_DAMPING_RATIO * PUSH_FREQUENCY * (jacobian @ state.v_tree)
        force = axes @ (mass * (axes.T @ acceleration))
        force *= min(1.0, MAX_PUSH_ACCELERATION * self._mass / max(float(np.linalg.norm(force)), 1e-300))
        return np.concatenate([force, np.cross(arm, force)]), np.array([place, force])

    # --- export ----------------------------------------------------------------------------------

    def export(self, folder: str | Path, name: str) -> tuple[Path, str]:
        """Write what was shown as a scene into FOLDER/NAME, run it with `simulate`, and save FOLDER/NAME/run.npz.

        Pushes become [[force]] tables with CSV files, torques of sliders a controller of torques over time, and moved
        targets the desired motion of eq. 16. The run goes up to the frame that is shown.

        Returns
        -------
        path : Path
            Of NAME.scene.toml.
        message : str
            What was written, in one line.

        Raises
        ------
        InputError
            Nothing has been computed yet, a file with other contents is there already, or the scene has objects of
            Python.
        """
        with self._change:
            t_end = self._times[self._shown]
            inputs = [one for one in self._inputs if one.t < t_end]
            knots = [one for one in self._knots if one[0] <= t_end]
        if not t_end > 0 or not inputs:
            raise InputError("export: the run has no frame after its start; let it run first")
        scene = self._describe(inputs, knots, t_end)
        place = Path(folder) / name
        file = f"{name}{SUFFIX}"
        write_new_texts(place, scene_texts(scene, file))
        run = simulate(load_scene(place / file))
        path = run.save(place / "run.npz")
        pushed = sorted({joint for one in inputs for joint in one.wrenches})
        notes = [f"pushes on {', '.join(pushed)}"] if pushed else []
        notes += ["torques of the motors' sliders"] if self.mode == "free" and _has_torques(inputs) else []
        notes += ["moved targets"] if len(knots) > 1 else []
        done = "" if run.status == "done" else f"; the run {run.message}"
        message = f"{place / file} and {path} written, {t_end:g} s{', with ' if notes else ''}{', '.join(notes)}{done}"
        return place / file, message

    def _describe(self, inputs: list[_Input], knots: list[tuple[float, Array]], t_end: float) -> Scene:
        """Return the scene of the inputs up to a time."""
        mechanism = self.mechanism
        overrides: dict[str, Any] = {"t_end": t_end, "solver.output_dt": MAX_FRAME_S}
        times = [one.t for one in inputs]
        controller: dict[str, Any] | None = None
        if self.mode == "free":
            limit = self._scene.to_dict().get("controller", {}).get("torque_limit")
            overrides["controller"] = None
            if _has_torques(inputs):
                columns = np.array([one.tau for one in inputs]).T
                file = {"t": times, **dict(zip(mechanism.actuated, columns, strict=True))}
                controller = {"type": "torques", "file": file, "interpolation": "hold"}
                controller |= {} if limit is None else {"torque_limit": limit}
        elif self.mode == "hold" and len(knots) > 1:
            ends = knots if knots[-1][0] == t_end else [*knots, (t_end, knots[-1][1])]
            columns = np.array([values for _, values in ends]).T
            file = {"t": [t for t, _ in ends], **dict(zip(mechanism.independent, columns, strict=True))}
            table = self._scene.to_dict()["controller"]
            controller = {**table, "desired": {"file": file, "interpolation": "linear"}}
        forces = []
        for name in sorted({joint for one in inputs for joint in one.wrenches}):
            values = np.array([one.wrenches.get(name, np.zeros(6)) for one in inputs]).T
            file = {"t": times, **dict(zip(("fx", "fy", "fz", "mx", "my", "mz"), values, strict=True))}
            forces.append({"frame": f"joint:{name}", "name": _force_name(name), "file": file, "interpolation": "hold"})
        return self._scene.with_overrides(overrides).with_control(controller, (), forces)


def _force_name(joint: str) -> str:
    return f"push on {joint}"


def _has_torques(inputs: list[_Input]) -> bool:
    return any(np.any(one.tau) for one in inputs)


def _has_memory(simulator: Simulator) -> bool:
    """Whether a state alone does not determine how the motion continues: integrals, samples, prescribed motions."""
    law = simulator.controller
    spec = simulator.scene.spec
    is_sampled = isinstance(simulator.scene.controller, Sampled) or bool(getattr(spec.controller, "sample_time", None))
    integrates = isinstance(law, JointServo) or (law is not None and has_state(law))
    return is_sampled or integrates or any(one.can_be_free for one in spec.prescribed)


def _max_frames(state: State) -> int:
    size = 8 * (len(state.q_tree) + 3 * len(state.v_tree) + len(state.w)) + FRAME_OVERHEAD_BYTES
    return min(MAX_FRAMES, MAX_STORED_BYTES // size)


def _hold_law(mechanism: Mechanism, at: Kinematics, scene: Scene | None) -> dict[str, Any]:
    """Return the table of eq. 16 that holds a pose, with the torque limit and allocation of the scene's controller."""
    if at.phi_z_factor.singular:
        raise NumericalError("run: mode 'hold': phi_z is singular at this pose, so motors cannot hold it by eq. 16")
    D = Terms(mechanism, at, np.zeros(mechanism.n)).D
    table: dict[str, Any] = {} if scene is None else scene.to_dict().get("controller", {})
    kept: dict[str, Any] = {key: table[key] for key in ("torque_limit", "allocation") if key in table}
    q = mechanism.independent_part(at.q_tree)
    desired = {name: {"offset": x} for name, x in zip(mechanism.independent, q.tolist(), strict=True)}
    gain = (HOLD_FREQUENCY * 0.5 * (D + D.T)).tolist()
    return {"type": "tracking", "Lambda": HOLD_FREQUENCY, "K_D": gain, "desired": desired, **kept}
