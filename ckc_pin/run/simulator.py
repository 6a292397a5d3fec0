"""Step a scene under the caller's control: for model predictive control, reinforcement learning, or a test bench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Row, Summary
from ckc_pin.base.validation import describe_value, is_number, require_flag, require_table
from ckc_pin.control.actuation import require_tau, require_u
from ckc_pin.control.controllers import Controller, TorqueController, Tracking
from ckc_pin.control.forces import Force
from ckc_pin.control.sampled import unwrap_sampled
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.native import StopReason, _core
from ckc_pin.run.events import Event, list_occurrences
from ckc_pin.run.prepare import prepare
from ckc_pin.run.run import format_work
from ckc_pin.run.state import State
from ckc_pin.run.stop_reasons import PAUSE_S, describe_stop
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.parts import build_scene_controller
from ckc_pin.scene.scene import Scene, as_scene, describe_formulation

__all__ = ["Simulator"]

BUSY = "this simulator is executing another call; call it from one thread at a time, and not from an event function"


class Simulator(HasSummary):
    """A scene that its caller steps, with u, motor torques or the scene's controller, as accurate as `simulate`.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name, or its path. output_dt is not used, and t_end only by desired motions of a point,
        which are followed up to there. Without `controlled`, only the torque limit and the allocation of the scene's
        controller are used.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    events : sequence of Event or mapping, optional
        Event functions of the state, and tables with the keys of an [[event]], in addition to the scene's events.
    forces : sequence of Force or mapping, optional
        Forces and moments on links, and tables with the keys of a [[force]], in addition to the scene's forces. `step`
        can set those with constant values.
    controlled : bool
        Let the scene's controller act, with its sample time, delay, sensors and drives. `step` then takes no u or tau.

    Attributes
    ----------
    scene : Scene
    mechanism : Mechanism
    controller : Controller, TorqueController or None
        The scene's controller, without its sampling. The caller may evaluate it:
        ``controller.u(state.t, state.terms)``.
    controlled : bool
        Whether the controller acts.
    state : State
        The present state.
    tau : (motors,) array
        Motor torques at the present state, N m or N.
    events : list of dict
        Events since the last reset, as in `Run.events`. An event with ``stop`` ends its step early.
    stats : dict
        Evaluations since the last reset, as in `Run.stats` without wall_s.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its initial state is singular.

    Notes
    -----
    solver.max_rhs counts from each reset. solver.max_wall_s is not used.

    While u stays the same, a step of the integration method may be longer than the caller's. States within it are
    interpolated, as accurate as the outputs of a run. A new u or wrench continues from the interpolated state. Events
    and acting controllers prevent longer steps.

    A simulator cannot be copied or pickled. After ``other.reset(this.state)`` another simulator of the scene continues
    from this one's state, equally accurate, but with other steps.

    A simulator executes one call at a time. Calls from another thread or from an event function in the meantime raise
    InputError, except `cancel`. Several simulators in several threads do not wait for each other.

    Examples
    --------
    >>> simulator = Simulator("five_bar/set_point", {"formulation": "reduced"})
    >>> for _ in range(10):
    ...     state = simulator.step(-2.0 * simulator.state.q_dot, 0.002)

    The scene's controller acts, and the caller pushes a link:

    >>> push = Force("link_2", [0.0, 0.0, 0.0], name="push")
    >>> simulator = Simulator("five_bar/tracking", forces=[push], controlled=True)
    >>> state = simulator.step(dt=0.01, wrenches={"push": [2.0, 0.0, 0.0]})
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        overrides: Mapping[str, Any] | None = None,
        *,
        events: Sequence[Event | Mapping[str, Any]] = (),
        forces: Sequence[Force | Mapping[str, Any]] = (),
        controlled: bool = False,
    ) -> None:
        require_flag(controlled, "Simulator: controlled")
        scene = as_scene(scene, overrides, "Simulator").with_control(None, (), forces)
        self.scene, self.controlled = scene, controlled
        self._prepared = prepare(scene, events=events, free=not controlled)
        self._loop = self._prepared.loop
        self.mechanism = self._prepared.mechanism
        self.controller: Controller | TorqueController | None = (
            unwrap_sampled(self._prepared.controller) if controlled else build_scene_controller(scene, self.mechanism)
        )
        self._u_refusal = self._prepared.actuation.explain_undriven_freedoms(self._prepared.start.at)
        self._zero_u = np.zeros(self.mechanism.d)
        gate = _core.Gate(InputError)  # One call at a time, because the loop has one state.
        self._step, self._reset, self._events, self._stats, self._tau = (
            gate.turn(f"{name}: {BUSY}") for name in ("step", "reset", "events", "stats", "tau")
        )
        self.reset()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse copies and pickles: the native loop holds steps beyond the present state, which cannot be copied."""
        raise InputError(
            "Simulator: it cannot be copied or pickled; make another simulator of the same scene and call "
            "other.reset(simulator.state)"
        )

    def summary(self) -> Summary:
        """Return a one-screen summary: formulation, present state, motors and work."""
        rows: list[Row] = [
            ("formulation", describe_formulation(self.scene.to_dict(), exact=not np.any(self.state.w))),
            *self.state.summary().rows,
            ("motors", ", ".join(self.mechanism.actuated) or "none"),
        ]
        with suppress(InputError):  # Within a step, for example from an event function, the counts are not available.
            stats = self.stats
            rows += format_work(stats) if stats["rhs"] else []
        return Summary(f"Simulator of {self.scene.name} at t = {self.state.t:g} s", rows)

    @property
    def state(self) -> State:
        """The present state."""
        return self._state

    @property
    def tau(self) -> Array:
        """Motor torques at the present state, shape (motors,), N m or N.

        Those of a sampled controller are zero until the first step.

        Raises
        ------
        NumericalError
            The controller has no value there.
        """
        with self._tau:
            tau = self._loop.torques()
        if tau is None:
            raise NumericalError(f"tau: the controller has no value at t = {self._state.t:.9g} s")
        return tau

    @property
    def events(self) -> list[dict[str, Any]]:
        """Events since the last reset."""
        with self._events:
            return list_occurrences(self._prepared.events, self.mechanism, self._loop)

    @property
    def stats(self) -> dict[str, Any]:
        """Evaluations since the last reset, by the names of `Run.stats`."""
        with self._stats:
            return self._loop.stats().to_dict()

    def reset(self, state: State | Mapping[str, Any] | None = None) -> State:
        """Go to a state. Earlier steps have no influence on the following ones.

        Forces that `step` has set return to the scene's values. An acting controller restarts: integrals are zero,
        desired motions are the scene's, and a sampled controller samples the state when the next step begins, as if it
        were that of the last sample instant.

        Parameters
        ----------
        state : State, mapping or None
            A state of this or another simulator of the mechanism, with its time; or a table as a scene's [initial],
            e.g. ``{"q": {...}, "q_dot": {...}}``, at t = 0; or None for the scene's start.

        Returns
        -------
        State

        Raises
        ------
        InputError, NumericalError
            The state is of another mechanism, out of reach or singular, or a step is being executed.
        """
        with self._reset:
            if isinstance(state, State):
                prescribed = self._prepared.scene.spec.prescribed
                if in_part := [one.joint for one in prescribed if one.can_be_free]:
                    raise InputError(
                        f"reset: the prescribed motion of {', '.join(in_part)} begins or ends in the run, and a state "
                        "does not tell whether it has; reset to None or to a table"
                    )
                self._prepared.begin(self._start_of(state), state.t)
                self._state = state.with_mechanism(self.mechanism)
            else:
                self._prepared.begin(None if state is None else self._start_of_table(state))
                self._state = self._read_state()
            self._wrenches = {
                force.name: force.values(0.0, self._state.terms) for force in self._prepared.forces if force.is_constant
            }
            self._desired: Array | None = None
            self._desired_moves = False
            return self._state

    def step(
        self,
        u: Any = None,
        dt: Any = None,
        *,
        tau: Any = None,
        wrenches: Mapping[str, Any] | None = None,
        desired: Any = None,
    ) -> State:
        """Advance by dt with constant u, constant motor torques, or the scene's controller.

        Parameters
        ----------
        u : (d,) array or None
            Eq. 6's force on the independent coordinates, N m or N; None for no force.
        dt : float
            Duration, s, greater than 0.
        tau : (motors,) array or {motor: number}, optional
            Instead of u: motor torques, N m or N. Motors that a table does not name have none.
        wrenches : mapping, optional
            Constant forces of the scene or of `forces` by name: [fx, fy, fz] or [fx, fy, fz, mx, my, mz], N and N m, in
            the axes of the force. They keep these values until a later step sets others, or `reset`.
        desired : (d,) array or {coordinate: number}, optional
            With `controlled` and a controller of eq. 16: desired q at the end of this step, rad or m. They are reached
            at constant rates, and held until a later step sets others. They replace the scene's desired motion.

        Returns
        -------
        State
            State at t + dt, or at an event with ``stop``.

        Raises
        ------
        InputError
            u or tau has the wrong shape or is not finite, both are given, the controller acts instead, the motors
            cannot produce u, a force does not exist or has no constant values, dt is not positive, or another step is
            being executed. The state has not changed.
        NumericalError
            The integration stopped within the step. `state` is the last one that was reached.
        """
        effort: Array | None = None
        if self.controlled:
            if u is not None or tau is not None:
                name = "u" if tau is None else "tau"
                raise InputError(f"step: {name}: the scene's controller acts; remove {name}, or controlled=True")
        elif tau is not None:
            if u is not None:
                raise InputError("step: give either u or tau, not both")
            effort = require_tau(tau, self.mechanism, "tau")
        else:
            effort = self._zero_u if u is None else require_u(u, self.mechanism, "u")
            if self._u_refusal and effort.any():
                raise InputError(f"u: {self._u_refusal}; give tau by motor instead")
        dt = self._require_dt(dt)
        values = self._require_wrenches(wrenches) if wrenches else {}
        if values and effort is not None and not np.all(np.isfinite(effort)):
            raise self._not_finite(effort, of_motors=tau is not None)
        with self._step:
            until = self._state.t + dt
            if desired is not None or self._desired_moves:
                self._move_desired(desired, until)
            for k, force in enumerate(self._prepared.forces):
                value = values.get(force.name)
                if value is not None and not np.array_equal(value, self._wrenches[force.name]):
                    self._loop.set_wrench(k, value)
                    self._wrenches[force.name] = value
            return self._advance(effort, until=until, of_motors=tau is not None)

    def cancel(self) -> None:
        """End the step that another thread is executing within 0.05 s, unless a Python function takes longer.

        That step returns the state that it has reached.
        """
        self._is_cancelled = True

    def _advance(self, effort: Array | None, *, until: float, of_motors: bool) -> State:
        """Advance to a time (s) with a constant effort: u or, with `of_motors`, tau; None if the controller acts."""
        self._is_cancelled = False
        try:
            while True:
                result = self._loop.step(effort, until, PAUSE_S, torques=of_motors)
                if result is None or result[0].reason != StopReason.PAUSE:
                    break
                if self._is_cancelled:
                    self._state = self._read_state()
                    return self._state
        except BaseException:  # An event function may raise, and so does Ctrl-C.
            self._state = self._read_state()
            raise
        if result is None:
            raise self._not_finite(effort, of_motors=of_motors)
        stop, reached = result
        if reached is not None:
            self._state = State(self.mechanism, *reached)
        if stop.reason not in (StopReason.END, StopReason.EVENT):
            solver = self._prepared.scene.spec.solver
            raise describe_stop(stop, self._loop, self.mechanism, solver, self._prepared.events)
        return self._state

    @staticmethod
    def _not_finite(effort: Array | None, *, of_motors: bool) -> InputError:
        return InputError(f"{'tau' if of_motors else 'u'} is not finite: {np.asarray(effort).tolist()}")

    def _require_wrenches(self, wrenches: Any) -> dict[str, Array]:
        """Return wrenches of constant forces by name, (6,) each."""
        require_table(wrenches, "step: wrenches", 'a table of wrenches by force, as {"push": [1.0, 0.0, 0.0]}')
        values = {}
        for name, wrench in wrenches.items():
            if name not in self._wrenches:
                raise InputError(f"step: wrenches: {self._explain_missing_force(name)}")
            try:
                value = np.asarray(wrench, dtype=float)
            except (TypeError, ValueError):
                value = np.zeros(0)
            if value.shape not in ((3,), (6,)) or not np.all(np.isfinite(value)):
                raise InputError(
                    f"step: wrenches: {name}: expected 3 finite numbers (fx, fy, fz) or 6 (and mx, my, mz), got "
                    f"{describe_value(wrench)}"
                )
            values[name] = np.concatenate([value, np.zeros(6 - len(value))])
        return values

    def _explain_missing_force(self, name: Any) -> str:
        choices = ", ".join(self._wrenches) or "none; add Force(frame, [0.0, 0.0, 0.0], name=...) to forces"
        others = [force.name for force in self._prepared.forces]
        if name in others:
            return (
                f"the force {name!r} is a function of time or of the state and cannot be set; constant are: {choices}"
            )
        return f"there is no force {name!r:.80}; constant forces are: {choices}"

    def _move_desired(self, desired: Any, until: float) -> None:
        """Let the desired q move to new values until a time (s); None: to the last ones."""
        law = self.controller
        if not self.controlled or not isinstance(law, Tracking):
            raise InputError(
                'step: desired: it replaces the desired motion of an acting controller of type "tracking"; make the '
                "simulator with such a scene and controlled=True"
            )
        present = law.desired(self._state.t)[0] if self._desired is None else self._desired
        values = present
        if desired is not None:
            names = self.mechanism.independent
            table = {**dict(zip(names, present, strict=True)), **desired} if isinstance(desired, Mapping) else desired
            values = require_u(table, self.mechanism, "step: desired").copy()
            if not np.all(np.isfinite(values)):
                raise InputError(f"step: desired is not finite: {values.tolist()}")
        begins = self._desired is None or not np.array_equal(values, present)
        if not (begins or self._desired_moves):
            return  # They are at rest there already.
        if not self._loop.move_desired(until, values):
            raise InputError("step: desired: the controller's desired motion is a function of Python; give a table")
        self._desired, self._desired_moves = values, begins

    def _read_state(self) -> State:
        """Return the loop's state, or the last one if the terms of the loop's state cannot be evaluated."""
        reached = self._loop.state()
        return self._state if reached is None else State(self.mechanism, *reached)

    def _start_of(self, state: State) -> Start:
        """Return a start at a state of this mechanism, possibly of another simulator."""
        other = state.mechanism
        if other.coordinates != self.mechanism.coordinates or len(state.w) != self.mechanism.closure.rows:
            raise InputError(f"reset: the state is of {other.name}; this simulator is of {self.mechanism.name}")
        if np.any(state.w) and self._prepared.scene.spec.formulation != "spf":
            raise InputError("reset: the state is off phi = 0; only the SPF can start there")
        return Start(self.mechanism.kinematics(state.terms.q_tree), state.q_dot, state.w, state.v_tree)

    def _start_of_table(self, table: Mapping[str, Any]) -> Start:
        """Return the start that a table as a scene's [initial] describes."""
        if not isinstance(table, Mapping):
            raise InputError(f"reset: expected a State or a table as a scene's [initial], got {table!r:.80}")
        return find_start(self.mechanism, self._prepared.scene.with_overrides({"initial": table}))

    def _require_dt(self, dt: Any) -> float:
        if not is_number(dt) or not 0 < dt < math.inf or not self._state.t + dt > self._state.t:
            raise InputError(f"dt = {dt!r:.80}: expected a number greater than 0, in seconds")
        return float(dt)
