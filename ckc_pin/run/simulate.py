"""From a scene to a `Run`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.interrupt import acknowledge
from ckc_pin.base.validation import require_callable, require_flag
from ckc_pin.codegen.library import compile_terms
from ckc_pin.control.controllers import ControlLaw, Controller, TorqueController
from ckc_pin.control.sampled import Sampled
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError, NumericalError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.events import Event, events_met
from ckc_pin.run.loop_terms import require_number
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.run.run import Run, Status
from ckc_pin.run.run_file import MAX_BYTES
from ckc_pin.run.stop_reasons import PAUSE, Stop, explain
from ckc_pin.scene.scene import Scene, as_scene

__all__ = ["OnOutput", "Progress", "columns_of", "run_of", "run_prepared", "run_rows", "simulate"]

Progress = Callable[[float, float], None]  # (t, t_end)
OnOutput = Callable[[float, Array], None]  # (t, q_tree), q_tree by coordinate

# Right-hand sides that cost what writing terms out and compiling them does, of whatever mechanism but one of a single
# long branch, which is up to 2.5 times as many (docs/theory/generated.md); a run with as many still ahead takes them
# then, wherever it runs.
REPAYS, NEVER = 2_000_000, 2**62
SCALARS = ("t", "energy", "dissipated", "lyapunov", "max_phi", "max_phi_dot")


def simulate(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    controller: Controller | TorqueController | Sampled | ControlLaw | None = None,
    events: Sequence[Event] = (),
    progress: Progress | None = None,
    on_output: OnOutput | None = None,
    profile: bool = False,
) -> Run:
    """Run a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, its shipped name ("five_bar/tracking"), or its path.
    overrides : mapping, optional
        Values by dotted key, e.g. ``{"formulation": "dae", "solver.rtol": 1e-10}``.
    controller : Controller, TorqueController, Sampled or function, optional
        An object with a method u(t, terms) or tau(t, terms), or a plain function u(t, terms), whose u is eq. 6's force
        on the independent coordinates. Takes the place of the scene's, its sample time, delay, sensor and drive
        included; `Sampled` gives it its own.
    events : sequence of Event, optional
        Event functions of the state, beside the scene's events.
    progress : callable, optional
        Called as progress(t, t_end), every 0.05 s or so.
    on_output : callable, optional
        Called as on_output(t, q_tree) for each output instant, q_tree by coordinate, shape (n,).
    profile : bool
        Count the terms evaluated in `Run.profile`.

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
    KeyboardInterrupt
        It was interrupted before the first output instant was recorded.
    """
    scene = as_scene(scene, overrides, "simulate")
    require_callable(progress, "simulate: progress", "a function of (t, t_end)")
    require_callable(on_output, "simulate: on_output", "a function of (t, q_tree)")
    require_flag(profile, "simulate: profile")
    run = run_prepared(prepare(scene, controller, events, profile=profile), progress, on_output)
    if controller is not None:
        run.scene.pop("controller", None)  # the caller's took its place
    return run


def run_prepared(ready: Prepared, progress: Progress | None = None, on_output: OnOutput | None = None) -> Run:
    """Run what was prepared, from its start; errors are those of `simulate`."""
    started = perf_counter()  # loading and assembling are not the run's work
    rows, status, message = run_rows(ready, progress, on_output)
    return run_of(ready, rows, status, message, perf_counter() - started)


def run_rows(
    ready: Prepared, progress: Progress | None = None, on_output: OnOutput | None = None
) -> tuple[Array, Status, str]:
    """Run what was prepared, and return what the loop has recorded, how it ended and why."""
    loop, times = ready.loop, ready.instants
    rows = np.empty((len(times) + 1, loop.width))
    if rows.nbytes > MAX_BYTES:
        raise InputError(
            f"solver.output_dt: {len(times)} output instants of {loop.width - 4} numbers each; a run has at most "
            f"{MAX_BYTES // 2**20} MiB"
        )
    ready.begin()
    loop.record(times, rows)
    status, message, filled = _drive(ready, rows, progress, on_output)
    return rows[:filled], status, message


def run_of(ready: Prepared, rows: Array, status: Status, message: str, wall_s: float) -> Run:
    """Make a `Run` of what was recorded."""
    scene, mechanism, loop = ready.scene, ready.mechanism, ready.loop
    parts = _parts(ready, rows)
    lyapunov, dissipated = parts.pop("lyapunov"), parts.pop("dissipated")
    joints, smoothing = mechanism.joints, scene.spec.friction_smoothing
    accounted = joints.has_events(smoothing) and not joints.has_smooth_friction(smoothing)
    run = Run(
        status=status,
        message=message,
        coordinates=mechanism.coordinates,
        independent=mechanism.independent,
        actuated=mechanism.actuated,
        lyapunov=_lyapunov(ready, lyapunov, parts),
        dissipated=dissipated if accounted else None,
        max_phi=float(parts.pop("max_phi").max()),
        max_phi_dot=float(parts.pop("max_phi_dot").max()),
        events=events_met(ready.events, mechanism, loop),
        stats={**loop.stats(), "wall_s": wall_s},
        scene_name=scene.name,
        scene=scene.to_dict(),
        texts=ready.texts,
        profile={name: {"calls": calls, "seconds": spent} for name, (calls, spent) in loop.profile().items()},
        **parts,
    )
    run.__dict__["mechanism"] = mechanism
    return run


def _drive(
    ready: Prepared, rows: Array, progress: Progress | None, on_output: OnOutput | None
) -> tuple[Status, str, int]:
    """Advance to the end; say how it ended and how many rows there are."""
    loop, solver, t_end = ready.loop, ready.scene.spec.solver, ready.scene.spec.t_end
    deadline = perf_counter() + (solver.max_wall_s or np.inf)
    n, shown, filled = ready.mechanism.n, 0, 0
    may_compile = solver.terms == "auto" and (
        loop.stats()["terms"] == "pinocchio" or ready.missing_arguments is not None
    )
    loop.pause_at(REPAYS if may_compile else NEVER)
    try:
        while True:
            stop = Stop(*loop.advance(t_end, True, PAUSE, deadline - perf_counter()))
            if may_compile and stop.why == "pause" and loop.stats()["rhs"] >= REPAYS:
                may_compile = False
                loop.pause_at(NEVER)
                if loop.t <= t_end / 2:
                    _compile(ready)
            filled = stop.filled
            if on_output is not None:
                for row in rows[shown:filled]:
                    on_output(float(row[0]), row[1 : 1 + n].copy())  # theirs, to change as they like
                shown = filled
            if progress is not None:
                progress(loop.t, t_end)
            if stop.why == "end":
                return "done", "reached t_end", filled
            if stop.why == "event":
                name = next(ready.events[k] for _, k, _ in reversed(loop.met()) if ready.events[k].stop).label["name"]
                return "done", f"stopped by the event at t = {stop.t:.9g} s: {name}", filled
            if stop.why != "pause":
                break
    except KeyboardInterrupt as signal:
        if not loop.filled:  # not even a first row: in the first call of a caller's controller, say
            raise
        status: Status = "interrupted"
        message = f"interrupted at t = {loop.t:.6g} s{acknowledge(signal)}"
    else:
        error = explain(stop, loop, ready.mechanism, solver, ready.events)
        if not filled:  # not even a first row
            raise error
        status, message = "stopped", _sentence(error, loop.t)
    loop.record_now()  # where not even that state has terms, the last output instant is the end
    return status, message, loop.filled


def _compile(ready: Prepared) -> None:
    """Give the loop terms that are written out, where they can be."""
    with suppress(InputError):  # too many coordinates, no CasADi, no compiler: it goes on as it is
        missing = ready.missing_arguments
        library = compile_terms(ready.mechanism, missing, changes=missing is not None)
        ready.loop.write((library.path, library.parameters))


def _parts(ready: Prepared, rows: Array) -> dict[str, Array]:
    """Split what the loop has recorded, a row an instant."""
    parts: dict[str, Array] = {}
    for name, at in columns_of(ready.mechanism).items():
        part = rows[:, at].copy()
        parts[name] = part[:, 0] if name in SCALARS else part
    return parts


def columns_of(mechanism: Mechanism) -> dict[str, slice]:
    """Return where what the loop records stands in a row (`Recorder` in recorder.hpp)."""
    n, m = mechanism.n, mechanism.closure.rows
    widths = {"t": 1, "q_tree": n, "v_tree": n, "u": mechanism.d, "tau": len(mechanism.actuated), "phi": m, "w": m,
              "energy": 1, "dissipated": 1, "lyapunov": 1, "max_phi": 1, "max_phi_dot": 1}  # fmt: skip
    ends = np.cumsum([0, *widths.values()]).tolist()
    return {name: slice(ends[k], ends[k + 1]) for k, name in enumerate(widths)}


def _lyapunov(ready: Prepared, found: Array, parts: dict[str, Array]) -> Array | None:
    """Return the controller's Lyapunov function, of a caller's own evaluated here."""
    law = ready.controller.controller if isinstance(ready.controller, Sampled) else ready.controller
    function = getattr(law, "lyapunov", None)
    t, q_tree, v_tree, phi = (parts[name] for name in ("t", "q_tree", "v_tree", "phi"))
    if function is None:
        return None
    if not np.isnan(found).any():
        return found
    mechanism = ready.mechanism
    kinematics = [mechanism.kinematics(mechanism.tree.from_coordinates(numbers)) for numbers in q_tree]
    every = zip(t, kinematics, v_tree, phi, strict=True)
    values = [(float(at_t), function(float(at_t), Terms(mechanism, at, v), w)) for at_t, at, v, w in every]
    return np.array([require_number(value, f"controller: lyapunov at t = {at_t:.9g}") for at_t, value in values])


def _sentence(error: NumericalError, t: float) -> str:
    where = ""
    if error.q_tree:
        where = " near " + ", ".join(f"{name} = {x:.6g}" for name, x in error.q_tree.items())
    return f"stopped at t = {t:.6g} s{where}: {error}"
