"""Step by step: a scene whose loop the caller closes, for model predictive control, learning, or a bench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.control.actuation import require_u
from ckc_pin.control.controllers import Controller
from ckc_pin.control.sampled import Held
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.clock import Legs
from ckc_pin.simulation.events import Event, Events
from ckc_pin.simulation.initial import Start, find_start
from ckc_pin.simulation.integrate import BudgetError, Stepper
from ckc_pin.simulation.prepare import make_system, prepare, scene_controller
from ckc_pin.simulation.scene import Scene, load_scene, make_scene, with_changes
from ckc_pin.simulation.systems import LevelSet, System

__all__ = ["Simulator", "State"]


@dataclass(frozen=True, eq=False)
class State:
    """Where a simulator is. It stays as it is when the simulator goes on.

    Attributes
    ----------
    t : float
        Time, s.
    terms : Terms
        Every term of the mechanism at this state, each computed when first asked for.
    v_tree : (n,) array
        Rates by coordinate; off its manifold the SPF's z_dot differs from what q_dot implies.
    w : (rows,) array
        What phi is: zero but for the SPF started off its manifold.
    """

    t: float
    terms: Terms
    v_tree: Array
    w: Array

    @property
    def q_tree(self) -> Array:
        """Values by coordinate, in the order of `coordinates`, shape (n,)."""
        return self.terms.mechanism.tree.to_coordinates(self.terms.q_tree)

    @property
    def q(self) -> Array:
        """The independent ones, in the user's order, shape (d,)."""
        return self.terms.mechanism.independent_part(self.terms.q_tree)

    @property
    def q_dot(self) -> Array:
        """Their rates, shape (d,)."""
        return self.v_tree[self.terms.mechanism.partition.q]


class Simulator:
    """A scene that is stepped by its caller, who gives u; as accurate as `simulate`, and it stops for the same reasons.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name, or its path. Its t_end and output_dt have no meaning here, and its
        controller does not act; of that table the torque limit holds.
    changes : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    events : sequence of Event, optional
        Functions of the state to watch, beside the scene's events.

    Attributes
    ----------
    mechanism : Mechanism
    controller : Controller or None
        The scene's own, for who wants to call it: ``controller.u(state.t, state.terms)``.
    state : State
        Where it is.
    events : list of dict
        Events met since the last reset, as in `Run.events`. One that stops ends the step it happens in early.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written.
    NumericalError
        Its initial state is singular.

    Notes
    -----
    solver.max_rhs counts from each reset; solver.max_wall_s does not apply, the time between steps is the caller's.

    >>> simulator = Simulator("five_bar/set_point", {"formulation": "reduced"})
    >>> for _ in range(10):
    ...     state = simulator.step(-2.0 * simulator.state.q_dot, 0.002)
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        changes: Mapping[str, Any] | None = None,
        *,
        events: Sequence[Event] = (),
    ) -> None:
        if not isinstance(scene, Scene):
            scene = load_scene(scene, changes)
        elif changes:
            raise InputError("Simulator: changes go with the name of a scene; a Scene is complete")
        self._scene, self._hold = scene, Held(0)
        with one_blas_thread():
            self._ready = prepare(scene, self._hold)
            self.mechanism = self._ready.mechanism
            self.controller: Controller | None = scene_controller(scene, self.mechanism)
        self._solver = msgspec.structs.replace(scene.spec.solver, max_wall_s=None)
        self._events = Events(scene.spec.event, events, self.mechanism)
        self._legs: Legs | None = None  # until the first step
        self.reset()

    @property
    def state(self) -> State:
        """Where it is."""
        return self._state

    @property
    def events(self) -> list[dict[str, Any]]:
        """Events met since the last reset."""
        return list(self._events.met)

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
            A state of another mechanism, out of reach or singular.
        """
        with one_blas_thread():
            if isinstance(state, State):
                start, t = self._start(state), state.t
            else:
                start, t = self._ready.start if state is None else self._initial(state), 0.0
            self._begin(start, t)
            self._events.met.clear()
            self._events.begin(t)
            if isinstance(state, State):
                self._state = State(t, Terms(self.mechanism, start.at, state.terms.v_tree), state.v_tree, state.w)
            else:
                self._state = self._at(0.0, self._system.start())
        return self._state

    def step(self, u: Any, dt: float) -> State:
        """Hold u for dt seconds.

        Parameters
        ----------
        u : (d,) array or None
            Eq. 6's force on the independent coordinates, N m or N; None: no force.
        dt : float
            s, greater than 0.

        Returns
        -------
        State
            At t + dt, or where an event stopped.

        Raises
        ------
        InputError
            u of the wrong shape or not finite, dt not positive; nothing has moved.
        NumericalError
            The numerics stopped within the step; `state` is the last one that was reached.
        """
        held = np.zeros(self.mechanism.d) if u is None else require_u(u, self.mechanism, "u").copy()
        if not np.isfinite(held).all():
            raise InputError(f"u is not finite: {held.tolist()}")
        dt = self._require_dt(dt)
        with one_blas_thread():
            self._let_act(held)
            try:
                return self._step(dt)
            except BudgetError as error:
                self._fall_back()
                raise NumericalError(str(error), t=self._state.t) from None
            except NumericalError as error:
                self._fall_back()
                raise NumericalError(str(error), t=self._state.t, q_tree=error.q_tree) from None
            except BaseException:
                self._fall_back()
                raise

    def _let_act(self, u: Array) -> None:
        """Change what acts. As in `simulate`, only where nothing acts may q change; a u refers to the user's own q."""
        switched = not np.array_equal(self._state.terms.at.partition.q, self.mechanism.partition.q)
        if switched and u.any():
            self._go_on()
        self._hold.held = u
        if isinstance(self._system, LevelSet):
            self._system.may_switch = not u.any()

    def _step(self, dt: float) -> State:
        end = self._state.t - self._origin + dt
        if self._legs is None:
            self._legs = Legs(Stepper(self._system, self._ready.method, self._solver, end))
        else:
            self._legs.aim(end)
        for step in self._legs.steps():
            halt = self._events.check(step, self._system)
            if halt is not None:
                self._state = self._at(halt, step.interpolant(halt))
                self._go_on()
                return self._state
        self._state = self._at(*self._legs.good)
        return self._state

    def _fall_back(self) -> None:
        """Make the last good state the present one, and let nothing of what failed live on."""
        if self._legs is not None:
            with suppress(NumericalError):
                self._state = self._at(*self._legs.good)
        self._go_on()

    def _go_on(self) -> None:
        """Start again from the present state; events remember on which side of their values they are."""
        self._begin(self._start(self._state), self._state.t)
        self._events.go_on(self._state.t)

    def _begin(self, start: Start, t: float) -> None:
        """Start from a state, with a new clock that is 0 there."""
        self._origin = t
        self._legs = None
        self._system: System = make_system(self.mechanism, self._scene, start, self._ready.plant)

    def _at(self, t: float, y: Array) -> State:
        system = self._system
        terms = system.terms(t, y)
        return State(self._origin + t, terms, system.velocity(t, terms).copy(), system.w(t).copy())

    def _start(self, state: State) -> Start:
        theirs = state.terms.mechanism
        if theirs.coordinates != self.mechanism.coordinates or len(state.w) != self.mechanism.closure.rows:
            raise InputError(f"reset: a state of {theirs.name}, this is {self.mechanism.name}")
        if np.any(state.w) and self._scene.spec.formulation != "spf":
            raise InputError("reset: a state off phi = 0, which only the SPF can be in")
        at = self.mechanism.kinematics(state.terms.q_tree)
        return Start(at, state.q_dot, state.w, state.v_tree)

    def _initial(self, table: Mapping[str, Any]) -> Start:
        """Return the start that a table as a scene's [initial] gives."""
        if not isinstance(table, Mapping):
            raise InputError(f"reset: {table!r:.80} is no State and no table as a scene's [initial]")
        data = with_changes(self._scene.plain(), {"initial": table})
        return find_start(self.mechanism, make_scene(data, self._scene.name, self._scene.sources))

    def _require_dt(self, dt: Any) -> float:
        number = isinstance(dt, int | float | np.integer | np.floating) and not isinstance(dt, bool)
        if not number or not 0 < dt < math.inf or not self._state.t + dt > self._state.t:
            raise InputError(f"dt = {dt!r:.80}: a number greater than 0 is needed, in seconds")
        return float(dt)
