"""From a scene to a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.control.controllers import Controller
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.lazy import Tally
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.burst import Burst, runs
from ckc_pin.simulation.clock import Clock, Legs
from ckc_pin.simulation.events import Event, Events
from ckc_pin.simulation.integrate import BudgetError, Stepper
from ckc_pin.simulation.prepare import Prepared, prepare
from ckc_pin.simulation.record import Recorder, Watch
from ckc_pin.simulation.run import Run, Status
from ckc_pin.simulation.run_file import MAX_BYTES
from ckc_pin.simulation.scene import Scene, load_scene
from ckc_pin.simulation.systems import Native

__all__ = ["Progress", "run_prepared", "simulate"]

Progress = Callable[[float, float], None]  # (t, t_end)

OUTPUTS = 500  # instants when a scene gives no output_dt
MAX_OUTPUTS = 1_000_000


def simulate(
    scene: Scene | str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    controller: Controller | None = None,
    events: Sequence[Event] = (),
    progress: Progress | None = None,
    watch: Watch | None = None,
    profile: bool = False,
) -> Run:
    """Run a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name ("five_bar/tracking"), or its path.
    changes : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    controller : Controller, optional
        Takes the place of the scene's, its sample time and delay included; `Sampled` gives it its own.
    events : sequence of Event, optional
        Functions of the state to watch, beside the scene's events.
    progress : callable, optional
        Called as progress(t, t_end) after each accepted step, of native ones after each stretch (0.05 s or less).
    watch : callable, optional
        Called as watch(t, q_tree) at each output instant, q_tree by coordinate, shape (n,).
    profile : bool
        Keep a tally of the terms evaluated in `Run.profile`.

    Returns
    -------
    Run
        With status "done", or "stopped" or "interrupted" with the reason and everything up to there.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written; known before the first step.
    NumericalError
        It cannot even start, because its initial state is singular.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(scene, changes)
    elif changes:
        raise InputError("simulate: changes go with the name of a scene; a Scene is complete")
    times = _output_instants(scene)  # refused before anything is loaded
    ready = prepare(scene, controller, measured=profile)
    run = _run(scene, ready, times, events, progress, watch, profile)
    if controller is not None:
        run.scene.pop("controller", None)  # the caller's took its place
    return run


def run_prepared(scene: Scene, ready: Prepared) -> Run:
    """Run what was prepared for a scene, once: its system ends where the run does.

    Errors are those of `simulate`.
    """
    return _run(scene, ready, _output_instants(scene))


def _run(
    scene: Scene,
    ready: Prepared,
    times: Array,
    events: Sequence[Event] = (),
    progress: Progress | None = None,
    watch: Watch | None = None,
    profile: bool = False,
) -> Run:
    mechanism, plant = ready.mechanism, ready.plant
    _refuse_too_much(mechanism, len(times))
    watched = Events(scene.spec.event, events, mechanism)
    tally = Tally() if profile else None
    mechanism.tree.tally = tally
    started = perf_counter()  # loading and assembling are not the run's work
    try:
        with one_blas_thread():
            clock = Clock(plant.controller, ready.system, scene.spec.t_end)
            stepper = Stepper(ready.system, ready.method, scene.spec.solver, clock.ends[0])
            recorder = Recorder(ready.system, plant.effort, getattr(plant.controller, "lyapunov", None), watch)
            recorder.add(0.0, stepper.y)
            status, message = _steps(stepper, recorder, times, watched, clock, progress)
    finally:
        mechanism.tree.tally = None
    stats = {**stepper.stats(), "wall_s": perf_counter() - started,
             "method": stepper.method, "backend": ready.system.backend}  # fmt: skip
    texts = {**mechanism.sources.texts, **scene.sources.texts, **ready.texts}
    run = Run(
        status=status,
        message=message,
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        max_phi=recorder.max_phi,
        max_phi_dot=recorder.max_phi_dot,
        events=watched.met,
        stats=stats,
        scene_name=scene.name,
        scene=scene.plain(),
        texts=texts,
        profile=tally.plain() if tally else {},
        **{"lyapunov": None, **recorder.arrays()},  # type: ignore[arg-type]
    )
    run.__dict__["mechanism"] = mechanism
    return run


def _output_instants(scene: Scene) -> Array:
    t_end, output_dt = scene.spec.t_end, scene.spec.solver.output_dt
    if output_dt is None:
        return np.linspace(0.0, t_end, OUTPUTS + 1, dtype=float)
    if t_end / output_dt > MAX_OUTPUTS:
        raise InputError(
            f"solver.output_dt = {output_dt:g} gives more than {MAX_OUTPUTS} output instants in {t_end:g} s"
        )
    times = np.array([k * output_dt for k in range(int(t_end / output_dt * (1 + 1e-12)) + 1)])
    if t_end - times[-1] > 1e-9 * output_dt:
        return np.append(times, t_end).astype(float)
    times[-1] = t_end
    return times


def _refuse_too_much(mechanism: Mechanism, rows: int) -> None:
    """Refuse a run whose file nobody could read again."""
    columns = 4 + 2 * mechanism.n + mechanism.d + len(mechanism.actuated) + 2 * mechanism.closure.rows
    if 8 * rows * columns > MAX_BYTES:
        raise InputError(
            f"solver.output_dt: {rows} output instants of {columns} numbers each; a run has at most "
            f"{MAX_BYTES // 2**20} MiB"
        )


def _steps(
    stepper: Stepper,
    recorder: Recorder,
    times: Array,
    events: Events,
    clock: Clock,
    progress: Progress | None,
) -> tuple[Status, str]:
    """Step to the end, recording on the way; say how it ended."""
    outputs, legs = _Outputs(recorder, times), Legs(stepper)
    legs.burst = _burst(legs, outputs, events, clock, progress)
    try:
        for end in clock:
            legs.aim(end)
            for step in legs.steps():
                halt = events.check(step, recorder.system, last=step.t >= clock.t_end)
                until = step.t if halt is None else halt
                outputs.up_to(clock.within(until, end), step.interpolant)
                if progress is not None:
                    progress(until, clock.t_end)
                if halt is not None:
                    recorder.add(halt, step.interpolant(halt))
                    return "done", f"stopped by the event at t = {halt:.9g} s: {events.stopped_by}"
            clock.tick(end, stepper.solver.y)
            outputs.up_to(clock.at(end), partial(_same, stepper.solver.y))
    except NumericalError as error:
        status: Status = "stopped"
        message = _sentence(error, legs.good[0])
    except BudgetError as error:
        status, message = "stopped", f"stopped at t = {legs.good[0]:.6g} s: {error}"
    except KeyboardInterrupt as signal:
        by = f" by {signal}" if str(signal) else ""
        status, message = "interrupted", f"interrupted at t = {legs.good[0]:.6g} s{by}"
    else:
        return "done", "reached t_end"
    with suppress(NumericalError):  # where not even that state has terms, the last output instant is the end
        recorder.add(*legs.good)
    return status, message


def _burst(
    legs: Legs, outputs: _Outputs, events: Events, clock: Clock, progress: Progress | None
) -> Callable[[], None] | None:
    """What takes plain steps natively; None where every step is to be looked at from Python."""
    stepper, recorder = legs.stepper, outputs.recorder
    system = stepper.system
    if not (isinstance(system, Native) and system.crosses and runs(stepper)):
        return None
    if events.watches or not (recorder.lyapunov is None or system.controls):
        return None
    burst = Burst(stepper, legs.guard, recorder, outputs.times, clock.within)
    legs.guard.burst = burst.unrecorded

    def run() -> None:
        more = burst.able
        while more:
            outputs.due, more = burst.run(outputs.due)
            legs.good = (stepper.t, stepper.solver.y)
            if progress is not None:
                progress(stepper.t, clock.t_end)

    return run


class _Outputs:
    """Records the output instants that have been reached."""

    def __init__(self, recorder: Recorder, times: Array) -> None:
        self.recorder, self.times, self.due = recorder, times, 1

    def up_to(self, limit: float, state: Callable[[float], Array]) -> None:
        """Record those up to a time, the state given as a function of it."""
        while self.due < len(self.times) and self.times[self.due] <= limit:
            t = float(self.times[self.due])
            self.recorder.add(t, state(t))
            self.due += 1


def _same(y: Array, t: float) -> Array:
    return y


def _sentence(error: NumericalError, t: float) -> str:
    where = ""
    if error.q_tree:
        where = " near " + ", ".join(f"{name} = {x:.6g}" for name, x in error.q_tree.items())
    return f"stopped at t = {t:.6g} s{where}: {error}"
