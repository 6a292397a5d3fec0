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
from ckc_pin.base.validation import is_number
from ckc_pin.control.actuation import require_tau, require_u
from ckc_pin.control.controllers import Controller, TorqueController
from ckc_pin.errors import InputError
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
    """A scene that its caller steps with u or motor torques, as accurate as `simulate`.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name, or its path. t_end and output_dt are not used. Of the scene's controller only the
        torque limit and the allocation are used.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    events : sequence of Event or mapping, optional
        Event functions of the state, and tables with the keys of an [[event]], in addition to the scene's events.

    Attributes
    ----------
    scene : Scene
    mechanism : Mechanism
    controller : Controller, TorqueController or None
        The scene's controller, which the caller may evaluate: ``controller.u(state.t, state.terms)``.
    state : State
        The present state.
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
    interpolated, as accurate as the outputs of a run. A new u continues from the interpolated state. Events prevent
    longer steps.

    A simulator cannot be copied or pickled. After ``other.reset(this.state)`` another simulator of the scene continues
    from this one's state, equally accurate, but with other steps.

    A simulator executes one call at a time. Calls from another thread or from an event function in the meantime raise
    InputError. Several simulators in several threads do not wait for each other.

    Examples
    --------
    >>> simulator = Simulator("five_bar/set_point", {"formulation": "reduced"})
    >>> for _ in range(10):
    ...     state = simulator.step(-2.0 * simulator.state.q_dot, 0.002)
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        overrides: Mapping[str, Any] | None = None,
        *,
        events: Sequence[Event | Mapping[str, Any]] = (),
    ) -> None:
        scene = as_scene(scene, overrides, "Simulator")
        self.scene = scene
        self._prepared = prepare(scene, events=events, free=True)
        self._loop = self._prepared.loop
        self.mechanism = self._prepared.mechanism
        self.controller: Controller | TorqueController | None = build_scene_controller(scene, self.mechanism)
        self._u_refusal = self._prepared.actuation.explain_undriven_freedoms(self._prepared.start.at)
        self._zero_u = np.zeros(self.mechanism.d)
        gate = _core.Gate(InputError)  # One call at a time, because the loop has one state.
        self._step, self._reset, self._events, self._stats = (
            gate.turn(f"{name}: {BUSY}") for name in ("step", "reset", "events", "stats")
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
            return self._state

    def step(self, u: Any = None, dt: Any = None, *, tau: Any = None) -> State:
        """Advance by dt with constant u or constant motor torques.

        Parameters
        ----------
        u : (d,) array or None
            Eq. 6's force on the independent coordinates, N m or N; None for no force.
        dt : float
            Duration, s, greater than 0.
        tau : (motors,) array or {motor: number}, optional
            Instead of u: motor torques, N m or N. Motors that a table does not name have none.

        Returns
        -------
        State
            State at t + dt, or at an event with ``stop``.

        Raises
        ------
        InputError
            u or tau has the wrong shape or is not finite, both are given, the motors cannot produce u, dt is not
            positive, or another step is being executed. The state has not changed.
        NumericalError
            The integration stopped within the step. `state` is the last one that was reached.
        """
        if tau is not None:
            if u is not None:
                raise InputError("step: give either u or tau, not both")
            effort = require_tau(tau, self.mechanism, "tau")
        else:
            effort = self._zero_u if u is None else require_u(u, self.mechanism, "u")
            if self._u_refusal and effort.any():
                raise InputError(f"u: {self._u_refusal}; give tau by motor instead")
        dt = self._require_dt(dt)
        with self._step:
            return self._advance(effort, until=self._state.t + dt, of_motors=tau is not None)

    def _advance(self, effort: Array, *, until: float, of_motors: bool) -> State:
        """Advance to a time (s) with a constant effort: u or, with `of_motors`, tau."""
        try:
            while True:
                result = self._loop.step(effort, until, PAUSE_S, torques=of_motors)
                if result is None or result[0].reason != StopReason.PAUSE:
                    break
        except BaseException:  # An event function may raise, and so does Ctrl-C.
            self._state = self._read_state()
            raise
        if result is None:
            raise InputError(f"{'tau' if of_motors else 'u'} is not finite: {effort.tolist()}")
        stop, reached = result
        if reached is not None:
            self._state = State(self.mechanism, *reached)
        if stop.reason not in (StopReason.END, StopReason.EVENT):
            solver = self._prepared.scene.spec.solver
            raise describe_stop(stop, self._loop, self.mechanism, solver, self._prepared.events)
        return self._state

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
