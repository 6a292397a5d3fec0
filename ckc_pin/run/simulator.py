"""Step by step: a scene whose loop the caller closes, for model predictive control, learning, or a bench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.summary import HasSummary, Summary
from ckc_pin.base.validation import is_number
from ckc_pin.control.actuation import require_tau, require_u
from ckc_pin.control.controllers import Controller, TorqueController
from ckc_pin.errors import InputError
from ckc_pin.native import _core
from ckc_pin.run.events import Event, events_met
from ckc_pin.run.prepare import prepare
from ckc_pin.run.state import State
from ckc_pin.run.stop_reasons import PAUSE, Stop, explain
from ckc_pin.run.summary import simulator_summary
from ckc_pin.scene.initial import Start, find_start
from ckc_pin.scene.parts import scene_controller
from ckc_pin.scene.scene import Scene, apply_overrides, as_scene, make_scene

__all__ = ["Simulator"]

AT_WORK = "this simulator is at work on another call; it takes one at a time, and none from an event's function"


class Simulator(HasSummary):
    """A scene that is stepped by its caller, who gives u; as accurate as `simulate`, and it stops for the same reasons.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name, or its path. Its t_end and output_dt have no meaning here, and its
        controller does not act; of that table the torque limit holds.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    events : sequence of Event, optional
        Event functions of the state, beside the scene's events.

    Attributes
    ----------
    scene : Scene
    mechanism : Mechanism
    controller : Controller, TorqueController or None
        The scene's own, for who wants to call it: ``controller.u(state.t, state.terms)``.
    state : State
        Where it is.
    events : list of dict
        Events met since the last reset, as in `Run.events`. One that stops ends the step it happens in early.
    stats : dict
        What was evaluated since the last reset: `Run.stats` but for the time.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its initial state is singular.

    Notes
    -----
    solver.max_rhs counts from each reset; solver.max_wall_s does not apply, the time between steps is the caller's.
    While u stays as it is, a step of the method may reach beyond the caller's, and states within it are read off it, as
    accurate as the outputs of a run; a change of u goes on from the state that was read. Events keep steps from that.

    It is not copied or pickled: after ``other.reset(this.state)`` another one of the scene goes on from where this one
    is, as accurate, but not by the same steps.

    It takes one call at a time: an InputError refuses one from another thread, or from an event's function, while it is
    at work. Simulators of their own in several threads do not wait for each other.

    >>> simulator = Simulator("five_bar/set_point", {"formulation": "reduced"})
    >>> for _ in range(10):
    ...     state = simulator.step(-2.0 * simulator.state.q_dot, 0.002)
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        overrides: Mapping[str, Any] | None = None,
        *,
        events: Sequence[Event] = (),
    ) -> None:
        scene = as_scene(scene, overrides, "Simulator")
        self.scene = scene
        self._ready = prepare(scene, events=events, free=True)
        self._loop = self._ready.loop
        self.mechanism = self._ready.mechanism
        self.controller: Controller | TorqueController | None = scene_controller(scene, self.mechanism)
        self._no_u = self._ready.actuation.explain_undriven_freedoms(self._ready.start.at)
        self._none = np.zeros(self.mechanism.d)
        gate = _core.Gate(InputError)  # the loop has one state
        self._step, self._reset, self._events, self._stats = (
            gate.turn(f"{what}: {AT_WORK}") for what in ("step", "reset", "events", "stats")
        )
        self.reset()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse copies, shallow, deep or pickled: steps beyond the present state are known to one loop alone."""
        raise InputError(
            "Simulator: one cannot be copied or pickled; make another of the same scene, and take it to where this one "
            "is with other.reset(simulator.state)"
        )

    def summary(self) -> Summary:
        """Return what there is to see of it."""
        return simulator_summary(self)

    @property
    def state(self) -> State:
        """Where it is."""
        return self._state

    @property
    def events(self) -> list[dict[str, Any]]:
        """Events met since the last reset."""
        with self._events:
            return events_met(self._ready.events, self._ready.mechanism, self._loop)

    @property
    def stats(self) -> dict[str, Any]:
        """What was evaluated since the last reset, by the names of `Run.stats`."""
        with self._stats:
            return dict(self._loop.stats())

    def reset(self, state: State | Mapping[str, Any] | None = None) -> State:
        """Go to a state; what was before has no influence on what follows.

        Parameters
        ----------
        state : State, mapping or None
            A state that this or another simulator of the mechanism has been in, with its time; a table as a
            scene's [initial], e.g. ``{"q": {...}, "q_dot": {...}}``, at t = 0; or None, the scene's start.

        Returns
        -------
        State

        Raises
        ------
        InputError, NumericalError
            A state of another mechanism, out of reach or singular; a step is under way.
        """
        with self._reset:
            if isinstance(state, State):
                self._ready.begin(self._start(state), state.t)
                self._state = State(self.mechanism, state.t, state._numbers, state._q, state._z)
            else:
                self._ready.begin(None if state is None else self._initial(state))
                self._state = self._present()
            return self._state

    def step(self, u: Any = None, dt: Any = None, *, tau: Any = None) -> State:
        """Hold u, or the motors' torques, for dt seconds.

        Parameters
        ----------
        u : (d,) array or None
            Eq. 6's force on the independent coordinates, N m or N; None: no force.
        dt : float
            s, greater than 0.
        tau : (motors,) array or {motor: number}, optional
            In the place of u, the motors' own torques, N m or N; motors not in a table have none.

        Returns
        -------
        State
            At t + dt, or where an event stopped.

        Raises
        ------
        InputError
            u or tau of the wrong shape or not finite, both of them, a u that the motors cannot produce, dt not
            positive, another step is under way; nothing has moved.
        NumericalError
            The numerics stopped within the step; `state` is the last one that was reached.
        """
        if tau is not None:
            if u is not None:
                raise InputError("step: give either u or tau, not both")
            applied = require_tau(tau, self.mechanism, "tau")
        else:
            applied = self._none if u is None else require_u(u, self.mechanism, "u")
            if self._no_u and applied.any():
                raise InputError(f"u: {self._no_u}; give tau by motor instead")
        dt = self._require_dt(dt)
        with self._step:
            return self._go(applied, tau is not None, self._state.t + dt)

    def _go(self, applied: Array, of_motors: bool, until: float) -> State:
        try:
            while (found := self._loop.step(applied, of_motors, until, PAUSE)) is not None and found[0][0] == "pause":
                pass
        except BaseException:  # a caller's function may raise, and Ctrl-C
            self._state = self._present()
            raise
        if found is None:
            raise InputError(f"{'tau' if of_motors else 'u'} is not finite: {applied.tolist()}")
        stop, reached = found
        if reached is not None:
            self._state = State(self.mechanism, *reached)
        if stop[0] not in ("end", "event"):
            loop, solver = self._loop, self._ready.scene.spec.solver
            raise explain(Stop(*stop), loop, self.mechanism, solver, self._ready.events)
        return self._state

    def _present(self) -> State:
        reached = self._loop.state()
        return self._state if reached is None else State(self.mechanism, *reached)

    def _start(self, state: State) -> Start:
        theirs = state.mechanism
        if theirs.coordinates != self.mechanism.coordinates or len(state.w) != self.mechanism.closure.rows:
            raise InputError(f"reset: a state of {theirs.name}, this is {self.mechanism.name}")
        if np.any(state.w) and self._ready.scene.spec.formulation != "spf":
            raise InputError("reset: a state off phi = 0, which only the SPF can be in")
        return Start(self.mechanism.kinematics(state._q_tree), state.q_dot, state.w, state.v_tree)

    def _initial(self, table: Mapping[str, Any]) -> Start:
        """Return the start that a table as a scene's [initial] gives."""
        if not isinstance(table, Mapping):
            raise InputError(f"reset: {table!r:.80} is no State and no table as a scene's [initial]")
        scene = self._ready.scene
        data = apply_overrides(scene.to_dict(), {"initial": table})
        return find_start(self.mechanism, make_scene(data, scene.name, scene.sources))

    def _require_dt(self, dt: Any) -> float:
        if not is_number(dt) or not 0 < dt < math.inf or not self._state.t + dt > self._state.t:
            raise InputError(f"dt = {dt!r:.80}: expected a number greater than 0, in seconds")
        return float(dt)
