"""From a scene to a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.control.controllers import Controller
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.lazy import Tally
from ckc_pin.mechanism.linear import one_blas_thread
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.events import Events
from ckc_pin.simulation.integrate import BudgetError, Stepper
from ckc_pin.simulation.prepare import prepare
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.record import Recorder
from ckc_pin.simulation.run import Run, Status
from ckc_pin.simulation.scene import Scene, load_scene

__all__ = ["Progress", "simulate"]

Progress = Callable[[float, float], None]  # (t, t_end)

OUTPUTS = 500  # instants when a scene gives no output_dt
MAX_OUTPUTS = 1_000_000


def simulate(
    scene: Scene | str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    controller: Controller | None = None,
    progress: Progress | None = None,
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
        Takes the place of the scene's.
    progress : callable, optional
        Called as progress(t, t_end) after each accepted step.
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
    started = perf_counter()
    times = _output_instants(scene)
    ready = prepare(scene, controller)
    mechanism, plant = ready.mechanism, ready.plant
    events = Events(scene.spec.event, mechanism)
    tally = Tally() if profile else None
    mechanism.tree.tally = tally
    try:
        with one_blas_thread():
            stepper = Stepper(ready.system, ready.method, scene.spec.solver, scene.spec.t_end)
            recorder = Recorder(ready.system, plant.effort, getattr(plant.controller, "lyapunov", None))
            recorder.add(0.0, stepper.y)
            status, message = _steps(stepper, recorder, times, events, scene.spec.t_end, progress)
    finally:
        mechanism.tree.tally = None
    stats = {**stepper.stats(), "wall_s": perf_counter() - started,
             "method": stepper.method, "backend": "python"}  # fmt: skip
    texts = {**mechanism.sources.texts, **scene.sources.texts, **ready.texts}
    run = Run(
        status=status,
        message=message,
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        max_phi=recorder.max_phi,
        max_phi_dot=recorder.max_phi_dot,
        events=events.met,
        stats=stats,
        scene_name=scene.name,
        scene=_as_run(scene, controller is not None),
        texts=texts,
        profile=tally.plain() if tally else {},
        **{"lyapunov": None, **recorder.arrays()},  # type: ignore[arg-type]
    )
    run.__dict__["mechanism"] = mechanism
    return run


def _as_run(scene: Scene, own_controller: bool) -> dict[str, Any]:
    """Return the scene as it was run: without its controller where the caller's took its place."""
    plain = scene.plain()
    if own_controller:
        plain.pop("controller", None)
    return plain


def _output_instants(scene: Scene) -> Array:
    t_end, output_dt = scene.spec.t_end, scene.spec.solver.output_dt
    if output_dt is None:
        return np.linspace(0.0, t_end, OUTPUTS + 1, dtype=float)
    if t_end / output_dt > MAX_OUTPUTS:
        raise InputError(
            f"solver.output_dt = {output_dt:g} gives more than {MAX_OUTPUTS} output instants in {t_end:g} s"
        )
    times = np.array([k * output_dt for k in range(int(t_end / output_dt * (1 + 1e-12)) + 1)])
    return times if t_end - times[-1] < 1e-9 * output_dt else np.append(times, t_end).astype(float)


def _steps(
    stepper: Stepper,
    recorder: Recorder,
    times: Array,
    events: Events,
    t_end: float,
    progress: Progress | None,
) -> tuple[Status, str]:
    """Step to the end, recording on the way; say how it ended."""
    due, guard = 1, RankGuard(stepper)
    end = (0.0, stepper.y)  # the last state that is known to be good
    try:
        while stepper.solver.status == "running":
            step = guard.step()
            end = (step.t, stepper.solver.y)
            halt = events.check(step, recorder.system)
            until = step.t if halt is None else halt
            while due < len(times) and (times[due] <= until or (until >= t_end and due == len(times) - 1)):
                recorder.add(float(times[due]), step.interpolant(float(times[due])))
                due += 1
            if progress is not None:
                progress(until, t_end)
            if halt is not None:
                recorder.add(halt, step.interpolant(halt))
                return "done", f"stopped by the event at t = {halt:.9g} s"
            if stepper.solver.status == "running":
                stepper.settle()
                end = (step.t, stepper.solver.y)
    except NumericalError as error:
        status: Status = "stopped"
        message = _sentence(error, end[0])
    except BudgetError as error:
        status, message = "stopped", f"stopped at t = {end[0]:.6g} s: {error}"
    except KeyboardInterrupt as signal:
        status, message = "interrupted", f"interrupted at t = {end[0]:.6g} s{f' by {signal}' if str(signal) else ''}"
    else:
        return "done", "reached t_end"
    with suppress(NumericalError):  # where not even that state has terms, the last output instant is the end
        recorder.add(*end)
    return status, message


def _sentence(error: NumericalError, t: float) -> str:
    where = ""
    if error.q_tree:
        where = " near " + ", ".join(f"{name} = {x:.6g}" for name, x in error.q_tree.items())
    return f"stopped at t = {t:.6g} s{where}: {error}"
