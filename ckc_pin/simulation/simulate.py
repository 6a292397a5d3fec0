"""From a scene to a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.control.actuation import Actuation, Effort
from ckc_pin.control.build import make_controller
from ckc_pin.control.controllers import Controller, SetPoint, Tracking
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.lazy import Tally
from ckc_pin.mechanism.library import load, mechanism_file
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.tree import Array
from ckc_pin.simulation.events import Events
from ckc_pin.simulation.initial import Start, find_start
from ckc_pin.simulation.integrate import BudgetError, Stepper
from ckc_pin.simulation.rank_guard import RankGuard
from ckc_pin.simulation.record import Recorder
from ckc_pin.simulation.run import Run, Status
from ckc_pin.simulation.scene import Scene, load_scene
from ckc_pin.simulation.systems import Dae, LevelSet, PrintedSpf, System

__all__ = ["Progress", "scene_controller", "scene_mechanism", "simulate"]

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
    mechanism = scene_mechanism(scene)
    times = _output_instants(scene)
    model_texts: dict[str, str] = {}
    own = controller is not None
    if controller is None:
        controller = scene_controller(scene, mechanism, model_texts)
    limit = scene.spec.controller.torque_limit if scene.spec.controller else None
    actuation = Actuation(mechanism, limit)
    _refuse_immobile(mechanism)
    events = Events(scene.spec.event, mechanism)
    start = find_start(mechanism, scene)
    if controller is not None:
        actuation.require_transmission(start.at)
    plant = _Plant(controller, actuation)
    tally = Tally() if profile else None
    mechanism.tree.tally = tally
    try:
        system = _system(mechanism, scene, start, plant)
        stepper = Stepper(system, _method(scene, system), scene.spec.solver, scene.spec.t_end)
        recorder = Recorder(system, plant.effort, getattr(controller, "lyapunov", None))
        recorder.add(0.0, stepper.y)
        status, message = _steps(stepper, recorder, times, events, scene.spec.t_end, progress)
    finally:
        mechanism.tree.tally = None
    stats = {**stepper.stats(), "wall_s": perf_counter() - started,
             "method": stepper.method, "backend": "python"}  # fmt: skip
    texts = {**mechanism.sources.texts, **scene.sources.texts, **model_texts}
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
        scene=_as_run(scene, own),
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


def scene_mechanism(scene: Scene) -> Mechanism:
    """Load the mechanism that a scene names, relative to its own folder or by shipped name, or has made by rule."""
    mechanism = scene.spec.mechanism
    return load(_beside(scene, mechanism) if isinstance(mechanism, str) else mechanism)


def _beside(scene: Scene, name: str) -> str | Path:
    folder = scene.sources.folder
    if folder is not None and (name.endswith(".toml") or (folder / name).exists()):
        return mechanism_file(folder / name)
    return name


def scene_controller(
    scene: Scene, mechanism: Mechanism, texts: dict[str, str] | None = None
) -> SetPoint | Tracking | None:
    """Build a scene's controller; the texts of its own model are added to `texts`."""

    def load_model(name: str) -> Mechanism:
        model = load(_beside(scene, name))
        if texts is not None:
            texts.update({f"model/{file}": text for file, text in model.sources.texts.items()})
        return model

    spec = scene.spec
    if spec.controller is None:
        return None
    return make_controller(spec.controller, mechanism, spec.coriolis_velocity, spec.t_end, scene.sources, load_model)


def _refuse_immobile(mechanism: Mechanism) -> None:
    if mechanism.d == 0:
        raise InputError(f"{mechanism.name}: d = 0, the loops leave no freedom: nothing can move")


@dataclass(frozen=True)
class _Plant:
    """What acts on the mechanism: a controller through its actuators, or nothing."""

    controller: Controller | None
    actuation: Actuation

    def effort(self, t: float, terms: Terms) -> Effort:
        if self.controller is None:
            return self.actuation.none
        return self.actuation.apply(terms, self.controller.u(t, terms))

    def force(self, t: float, terms: Terms) -> Array:
        return self.effort(t, terms).u_tree

    def u_rate_gradient(self, t: float, terms: Terms) -> Array | None:
        """d u / d q_dot: nothing acts, or the controller knows its own; None for a controller that does not."""
        if self.controller is None:
            return np.zeros((len(terms.q), len(terms.q)))
        gradient = getattr(self.controller, "u_rate_gradient", None)
        if gradient is None or not self.actuation.direct:
            return None
        free = self.actuation.unlimited(self.effort(t, terms).tau)
        return free[:, None] * gradient(t, terms)


def _system(mechanism: Mechanism, scene: Scene, start: Start, plant: _Plant) -> System:
    spec, force = scene.spec, plant.force
    free = plant.controller is None  # of a controller that lives in the mechanism's own q
    if spec.formulation == "dae":
        return Dae(mechanism, start.at, start.at.rho @ start.q_dot, force, spec.solver.projection)
    if spec.formulation == "reduced":
        return LevelSet(mechanism, start.at, start.q_dot, force, u_rate_gradient=plant.u_rate_gradient, may_switch=free)
    equation = spec.solver.spf_equation or (17 if spec.solver.method == "auto" else 8)
    if equation == 8:
        return PrintedSpf(mechanism, start.at, start.q_dot, force, spec.epsilon, spec.coriolis_velocity)
    return LevelSet(
        mechanism,
        start.at,
        start.q_dot,
        force,
        spec.epsilon,
        spec.coriolis_velocity,
        start.w,
        plant.u_rate_gradient,
        free,
    )


def _method(scene: Scene, system: System) -> str:
    """What "auto" means: closed loops are stiff through their gains, eq. 8 through epsilon."""
    spec = scene.spec
    if spec.solver.method != "auto":
        return spec.solver.method
    stiff = spec.controller is not None or isinstance(system, PrintedSpf)
    return "Radau" if stiff else "DOP853"


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
    due, guard = 1, RankGuard(stepper.system)
    end = (0.0, stepper.y)  # the last state that is known to be good
    try:
        while stepper.solver.status == "running":
            step = stepper.step()
            retry = guard.accept(step)
            if retry is not None:
                stepper.take_back(retry)
                continue
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
                end = (step.t, stepper.solver.y)
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
