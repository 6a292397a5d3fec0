"""Run a scene from start to end and return a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.toml_writer import to_table
from ckc_pin.base.validation import MIN_SIMILARITY, find_nearest_name, require_callable, require_flag, require_table
from ckc_pin.control.controllers import ControlLaw, Controller, TorqueController
from ckc_pin.control.forces import Force
from ckc_pin.control.sampled import Sampled, unwrap_sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.native import Loop, StopReason
from ckc_pin.run.compiled_terms import COMPILE_AFTER_RHS, NEVER, compile_during_run
from ckc_pin.run.desired_path import find_target
from ckc_pin.run.events import Event, list_occurrences
from ckc_pin.run.loop_terms import require_number
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.run.run import Run, Status
from ckc_pin.run.run_file import MAX_BYTES
from ckc_pin.run.stop_reasons import PAUSE_S, add_cause, describe_stop, find_exit
from ckc_pin.scene.overrides import EXPECTED_OVERRIDES
from ckc_pin.scene.scene import Scene, as_scene

__all__ = ["OnOutput", "Progress", "build_run", "record_columns", "record_rows", "run_prepared", "simulate"]

Progress = Callable[[float, float], None]  # (t, t_end)
OnOutput = Callable[[float, Array], None]  # (t, q_tree), q_tree by coordinate

SCALARS = ("t", "energy", "dissipated", "lyapunov", "max_phi", "max_phi_dot")  # quantities of one column


def simulate(
    scene: Scene | Mechanism | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    controller: Controller | TorqueController | Sampled | ControlLaw | Mapping[str, Any] | None = None,
    events: Sequence[Event | Mapping[str, Any]] = (),
    forces: Sequence[Force | Mapping[str, Any]] = (),
    progress: Progress | None = None,
    on_output: OnOutput | None = None,
    profile: bool = False,
    **keys: Any,
) -> Run:
    """Simulate a scene, or a mechanism.

    Parameters
    ----------
    scene : Scene, Mechanism, str or Path
        A scene, its shipped name ("five_bar/tracking"), or its path. Or a mechanism with the other arguments of
        `Scene`, as ``simulate(mechanism, t_end=1.0, initial={"q": [-1.4, -1.9]})``.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    controller : Controller, TorqueController, Sampled, function or mapping, optional
        An object with a method u(t, terms) or tau(t, terms), or a function u(t, terms). u is eq. 6's force on the
        independent coordinates. It replaces the scene's controller with its sample time, delay, sensors and drives;
        `Sampled` adds others. Or a table with the keys of a scene's [controller].
    events : sequence of Event or mapping, optional
        Event functions of the state, and tables with the keys of an [[event]], in addition to the scene's events.
    forces : sequence of Force or mapping, optional
        Forces and moments on links, and tables with the keys of a [[force]], in addition to the scene's forces.
    progress : callable, optional
        Called as progress(t, t_end), about every 0.05 s.
    on_output : callable, optional
        Called as on_output(t, q_tree) for each output instant, q_tree by coordinate, shape (n,).
    profile : bool
        Count the terms that are evaluated in `Run.profile`.
    **keys
        Keys of a scene, e.g. ``t_end=2.0``, which replace those of the scene.

    Returns
    -------
    Run
        Its status is "done", or "stopped" or "interrupted" with the reason and all results up to that time.

    Raises
    ------
    InputError, MechanismError
        The scene cannot be run as written. This is known before the first step.
    NumericalError
        The initial state is singular.
    KeyboardInterrupt
        The run was interrupted before the first output instant was recorded.
    """
    if overrides is not None:
        require_table(overrides, "simulate: overrides", EXPECTED_OVERRIDES)
        if twice := sorted(set(keys) & set(overrides)):
            raise InputError(f"simulate: {twice[0]} is given twice, as an argument and in overrides")
    if isinstance(scene, Mechanism):
        scene = _make_scene(scene, overrides or {}, controller, events, forces, keys)
    else:
        scene = as_scene(scene, {**(overrides or {}), **keys}, "simulate").with_control(controller, events, forces)
    require_callable(progress, "simulate: progress", "a function of (t, t_end)")
    require_callable(on_output, "simulate: on_output", "a function of (t, q_tree)")
    require_flag(profile, "simulate: profile")
    return run_prepared(prepare(scene, profile=profile), progress, on_output)


def _make_scene(
    mechanism: Mechanism,
    overrides: Mapping[str, Any],
    controller: Any,
    events: Sequence[Any],
    forces: Sequence[Any],
    keys: dict[str, Any],
) -> Scene:
    """Return the scene of a mechanism and keys. The overrides may have t_end, which has no default."""
    t_end = keys.pop("t_end", overrides.get("t_end"))
    if t_end is None:
        nearest = find_nearest_name("t_end", keys, MIN_SIMILARITY)
        raise InputError(
            "simulate: a Mechanism has no end time; give t_end, as simulate(mechanism, t_end=1.0)"
            + (f", not {nearest}" if nearest else "")
        )
    scene = Scene(mechanism, t_end=t_end, controller=controller, events=events, forces=forces, **keys)
    return scene.with_overrides(overrides)


def run_prepared(prepared: Prepared, progress: Progress | None = None, on_output: OnOutput | None = None) -> Run:
    """Run a prepared scene from its start; errors as of `simulate`."""
    started = perf_counter()  # Loading and assembling do not count as time of the run.
    warnings = list(prepared.warnings)
    rows, status, message = record_rows(prepared, progress, on_output, warnings)
    wall_s = perf_counter() - started
    return build_run(prepared, rows, status=status, message=message, wall_s=wall_s, warnings=warnings)


def record_rows(
    prepared: Prepared,
    progress: Progress | None = None,
    on_output: OnOutput | None = None,
    warnings: list[str] | None = None,
) -> tuple[Array, Status, str]:
    """Run a prepared scene and return the recorded rows, the status and the message of the run.

    With `warnings`, a stop is explained: the desired motion is followed up to there, and warnings about it are added.

    Returns
    -------
    rows : (m, width) array
        A row for each output instant, with the columns of `record_columns`.
    status, message : str
    """
    loop, times = prepared.loop, prepared.instants
    rows = np.empty((len(times) + 1, loop.width))
    if rows.nbytes > MAX_BYTES:
        raise InputError(
            f"solver.output_dt: {len(times)} output instants of {loop.width - 4} numbers each; a run has at most "
            f"{MAX_BYTES // 2**20} MiB"
        )
    prepared.begin()
    loop.record(times, rows)
    status, message, filled = _advance_to_end(prepared, rows, progress, on_output, warnings)
    return rows[:filled], status, message


def build_run(
    prepared: Prepared, rows: Array, *, status: Status, message: str, wall_s: float, warnings: Sequence[str] = ()
) -> Run:
    """Return the `Run` of recorded rows; `wall_s` is the time that it took, s."""
    scene, mechanism, loop = prepared.scene, prepared.mechanism, prepared.loop
    parts = _split_rows(prepared, rows)
    lyapunov, dissipated = parts.pop("lyapunov"), parts.pop("dissipated")
    works, force_values, prescribed_states = (parts.pop(name) for name in ("works", "forces", "prescribed"))
    joints, smoothing = mechanism.joints, scene.spec.friction_smoothing
    is_dissipation_known = joints.has_events(smoothing) and not joints.has_smooth_friction(smoothing)
    run = Run(
        status=status,
        message=message,
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        lyapunov=_evaluate_lyapunov(prepared, lyapunov, parts),
        dissipated=dissipated if is_dissipation_known else None,
        works=works if scene.spec.work else None,
        force_values=force_values if prepared.forces else None,
        prescribed_states=prescribed_states if prepared.mechanism.prescribed else None,
        max_phi=float(parts.pop("max_phi").max()),
        max_phi_dot=float(parts.pop("max_phi_dot").max()),
        events=list_occurrences(prepared.events, mechanism, loop),
        stats={**loop.stats().to_dict(), "wall_s": wall_s},
        scene_name=scene.name,
        scene=_describe_scene(prepared),
        texts=prepared.texts,
        warnings=tuple(warnings),
        profile={name: {"calls": calls, "seconds": seconds} for name, (calls, seconds) in loop.profile().items()},
        built_mechanism=mechanism,
        built_target=find_target(prepared.controller),
        **parts,
    )
    return run.with_warnings(run.list_speed_warnings())


def _describe_scene(prepared: Prepared) -> dict[str, Any]:
    """Return the keys of a run's scene.

    A controller that is a Python object has none. Forces that are functions of the state have their frames only.
    """
    scene = prepared.scene
    data = scene.to_dict()
    if scene.controller is not None:
        data.pop("controller", None)  # The caller's controller replaced it.
    functions = prepared.forces[len(scene.spec.force) :]
    if functions:
        data["force"] = [*data.get("force", []), *(to_table(force.spec) for force in functions)]
    return data


def _advance_to_end(
    prepared: Prepared,
    rows: Array,
    progress: Progress | None,
    on_output: OnOutput | None,
    warnings: list[str] | None,
) -> tuple[Status, str, int]:
    """Advance the loop to t_end and return status, message and the number of recorded rows."""
    loop, solver, t_end = prepared.loop, prepared.scene.spec.solver, prepared.scene.spec.t_end
    deadline = perf_counter() + (solver.max_wall_s or np.inf)
    n, shown, filled = prepared.mechanism.n, 0, 0
    may_compile = solver.terms == "auto" and (
        loop.stats().terms == "pinocchio" or prepared.missing_arguments is not None
    )
    loop.pause_at(COMPILE_AFTER_RHS if may_compile else NEVER)
    try:
        while True:
            stop = loop.advance(until=t_end, final=True, pause=PAUSE_S, budget=deadline - perf_counter())
            if may_compile and stop.reason == StopReason.PAUSE and loop.stats().rhs >= COMPILE_AFTER_RHS:
                may_compile = False
                loop.pause_at(NEVER)
                if loop.t <= t_end / 2:
                    compile_during_run(prepared.mechanism, loop, prepared.missing_arguments)
            filled = loop.filled
            if on_output is not None:
                for row in rows[shown:filled]:
                    on_output(float(row[0]), row[1 : 1 + n].copy())  # The caller may write to its copy.
                shown = filled
            if progress is not None:
                progress(loop.t, t_end)
            if stop.reason == StopReason.END:
                return "done", "reached t_end", filled
            if stop.reason == StopReason.EVENT:
                events = prepared.events
                name = next(events[x.event].label["name"] for x in reversed(loop.occurrences()) if events[x.event].stop)
                return "done", f"stopped by the event at t = {stop.t:.9g} s: {name}", filled
            if stop.reason != StopReason.PAUSE:
                break
    except KeyboardInterrupt as signal:
        if not loop.filled:  # For example in the first call of the caller's controller.
            raise
        status: Status = "interrupted"
        message = f"interrupted at t = {loop.t:.6g} s{acknowledge(signal)}"
    else:
        error = describe_stop(stop, loop, prepared.mechanism, solver, prepared.events)
        if not filled:
            raise error
        is_budget = stop.reason in (StopReason.RHS_BUDGET, StopReason.WALL_BUDGET)
        reason = str(error)
        if warnings is not None and not is_budget:
            reason, exit_warnings = add_cause(error, prepared, find_exit(prepared, loop.t))
            warnings += exit_warnings
        status, message = "stopped", _describe_error(error, reason, loop.t)
    loop.record_now()  # If the terms of this state cannot be evaluated, the last output instant is the end.
    return status, message, loop.filled


def _split_rows(prepared: Prepared, rows: Array) -> dict[str, Array]:
    """Return the recorded quantities by name, a row for each instant."""
    parts: dict[str, Array] = {}
    for name, columns in record_columns(prepared.loop).items():
        part = rows[:, columns].copy()
        parts[name] = part[:, 0] if name in SCALARS else part
    return parts


def record_columns(loop: Loop) -> dict[str, slice]:
    """Return the columns of each quantity of a run in the rows of the native loop; sensitivities follow them."""
    return {x.name: slice(x.begin, x.end) for x in loop.record_columns if x.name != "extra"}


def _evaluate_lyapunov(prepared: Prepared, recorded: Array, parts: dict[str, Array]) -> Array | None:
    """Return the controller's Lyapunov function along the run, shape (m,), or None if it has none.

    The native loop records it for the controllers of scenes. A caller's function is evaluated here.
    """
    law = unwrap_sampled(prepared.controller)
    function = getattr(law, "lyapunov", None)
    if function is None:
        return None
    if not np.isnan(recorded).any():
        return recorded
    mechanism = prepared.mechanism
    values = []
    for t, q_tree, v_tree, phi in zip(*(parts[name] for name in ("t", "q_tree", "v_tree", "phi")), strict=True):
        at = mechanism.kinematics(mechanism.tree.from_coordinates(q_tree))
        try:
            value = function(float(t), Terms(mechanism, at, v_tree), phi)
        except NumericalError:  # A sampled run may end after the desired motion left the workspace.
            value = np.nan
        values.append(require_number(value, f"controller: lyapunov at t = {float(t):.9g}"))
    return np.array(values)


def _describe_error(error: NumericalError, reason: str, t: float) -> str:
    where = ""
    if error.q_tree:
        where = " near " + ", ".join(f"{name} = {x:.6g}" for name, x in error.q_tree.items())
    return f"stopped at t = {t:.6g} s{where}: {reason}"
