"""Run a scene under one setting (formulation, method, tolerance), time it, and compare two motions."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.interrupt import interrupt_again
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.tree import Tree
from ckc_pin.run.prepare import prepare
from ckc_pin.run.run import Run
from ckc_pin.run.simulate import run_prepared
from ckc_pin.scene.scene import Scene

__all__ = [
    "FORMULATIONS",
    "INSTANTS",
    "MAX_REPEATS",
    "REPEAT_BELOW_S",
    "FixedStepProgram",
    "Motion",
    "MotionError",
    "PrecisionRow",
    "Setting",
    "compare_motions",
    "list_settings",
    "motion_without_data",
    "override_scene",
    "span_overrides",
    "starts_off_manifold",
    "time_scene",
]

INSTANTS = 20  # at which motions are compared, including the end
MIN_TIMED_S = 0.05  # runs are repeated until they took this time together
MAX_SCENE_REPEATS = 20
MAX_REPEATS, REPEAT_BELOW_S = 3, 1.0  # repeats of a fixed-step program, and the time above which it is not repeated
TRIAL_STEPS = 50  # to estimate how long a fixed-step program will take

FORMULATIONS: dict[str, dict[str, Any]] = {
    "dae": {"formulation": "dae"},
    "reduced": {"formulation": "reduced"},
    "spf, w": {"formulation": "spf", "spf_coordinates": "w"},
    "spf, z": {"formulation": "spf", "spf_coordinates": "z"},
}
TOLERANCES = tuple(10.0**-k for k in range(2, 13))
METHODS = {"auto": TOLERANCES, "DOP853": TOLERANCES, "RK45": TOLERANCES[::2], "Radau": TOLERANCES[::2]}


# --- settings ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setting:
    """Formulation, method and tolerance of a run.

    Attributes
    ----------
    formulation : str
        A key of `FORMULATIONS`.
    method : str
    rtol : float
    """

    formulation: str
    method: str
    rtol: float

    @property
    def family(self) -> tuple[str, str]:
        """Formulation and method."""
        return self.formulation, self.method

    def overrides(self, scene: Scene) -> dict[str, Any]:
        """Return the setting as values of the scene by dotted key, as `--set` takes them; None removes a key."""
        overrides = {**FORMULATIONS[self.formulation], "solver.method": self.method, "solver.rtol": self.rtol}
        solver = scene.spec.solver
        if solver.atol is not None:  # the scene's absolute tolerance belongs to the scene's relative tolerance
            overrides["solver.atol"] = float(f"{self.rtol / 100:.0e}")
        if self.formulation != "dae" and solver.baumgarte:  # only the DAE accepts this key
            overrides["solver.baumgarte"] = None
        return overrides


def list_settings(scene: Scene) -> Iterator[Setting]:
    """Yield all settings from loose to tight tolerances, those of "auto" first in case the budget runs out."""
    formulations = [name for name in FORMULATIONS if name.startswith("spf") or not starts_off_manifold(scene)]
    for methods in (["auto"], [name for name in METHODS if name != "auto"]):
        for rtol, method, formulation in product(TOLERANCES, methods, formulations):
            if rtol in METHODS[method]:
                yield Setting(formulation, method, rtol)


def starts_off_manifold(scene: Scene) -> bool:
    """Whether a scene starts with phi = w other than 0, which only the SPF supports."""
    return any(scene.spec.initial.w or [])


def override_scene(scene: Scene, overrides: Mapping[str, Any]) -> Scene:
    """Return a scene with values replaced by dotted key; None removes a key."""
    return scene.with_overrides(overrides)


def span_overrides(scene: Scene, t_end: float, dt: float) -> dict[str, Any]:
    """Return overrides that make all runs of a scene comparable: equal span and output instants, no stopping event."""
    events = [{**event, "stop": False} for event in scene.to_dict().get("event", [])]
    return {"t_end": t_end, "solver.output_dt": dt, **({"event": events} if events else {})}


# --- motions -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """The motion of a scene under one setting, and what it cost.

    Attributes
    ----------
    status : "done", "stopped", "refused", "failed" or "not tried"
    reason : str
        Why the status is not "done".
    q_tree, v_tree : (m, n) arrays
        By coordinate, at the first m instants.
    wall_s : float or None
        Shortest time of the repeats, s, without `setup_s`.
    setup_s : float or None
        Time to load and assemble, s.
    rhs, steps : int or None
        Numbers of right-hand sides and steps.
    used : str
        The method that made the steps.
    """

    status: str
    reason: str
    q_tree: Array
    v_tree: Array
    wall_s: float | None = None
    setup_s: float | None = None
    rhs: int | None = None
    steps: int | None = None
    used: str = ""


def motion_without_data(status: str, reason: str, n: int = 0) -> Motion:
    """Return the motion of n coordinates of a setting that was not run or failed."""
    return Motion(status, reason, np.empty((0, n)), np.empty((0, n)))


@dataclass(frozen=True)
class PrecisionRow:
    """One setting of a comparison: its cost and its error.

    Attributes
    ----------
    program : "ckc_pin" or "MuJoCo"
    formulation : str or None
        "dae", "reduced", "spf, w" (coordinates of eq. 17) or "spf, z" (eq. 8 as printed).
    method : str
    rtol, dt : float or None
        Relative tolerance, or fixed step in s.
    overrides : dict
        The setting as values of the scene by dotted key; None removes a key.
    status, reason, rhs, steps, used, wall_s, setup_s
        As in `Motion`.
    error_q, error_v : float or None
        Largest error of q_tree and v_tree over the instants, rad or m and per s.
    error : float or None
        The larger of both, each relative to its largest value where that is above 1.
    resolved : bool or None
        Whether the error is clearly above the reference's own uncertainty.
    """

    program: str
    formulation: str | None
    method: str
    rtol: float | None
    dt: float | None
    overrides: Mapping[str, Any]
    status: str
    reason: str
    error: float | None
    error_q: float | None
    error_v: float | None
    resolved: bool | None
    rhs: int | None
    steps: int | None
    used: str
    wall_s: float | None
    setup_s: float | None

    @property
    def family(self) -> str:
        """Formulation, or program, with the method."""
        return f"{self.formulation or self.program}, {self.method}"


@dataclass(frozen=True)
class MotionError:
    """Difference of two motions at each common instant: (m,) arrays of the largest entry.

    Attributes
    ----------
    q, v : (m,) arrays
        rad or m, and per s.
    scaled : (m,) array
        The larger of both, each relative to the second motion's largest value where that is above 1.
    """

    q: Array
    v: Array
    scaled: Array


def compare_motions(tree: Tree, motion: Motion, reference: Motion) -> MotionError:
    """Return the difference of a motion from a reference at the instants that both have."""
    m = min(len(motion.q_tree), len(reference.q_tree))
    q, q_reference = motion.q_tree[:m], reference.q_tree[:m]
    if tree.is_euclidean:
        difference = q - q_reference
    else:  # the difference of rotation vectors is wrong where one of them wraps at an angle of pi
        to_q_tree = tree.from_coordinates
        rows = [tree.difference(to_q_tree(b), to_q_tree(a)) for a, b in zip(q, q_reference, strict=True)]
        difference = np.reshape(rows, (m, tree.n))
    differences = difference, motion.v_tree[:m] - reference.v_tree[:m]
    error_q, error_v = (np.abs(x).max(axis=1, initial=0.0) for x in differences)
    scales = (max(1.0, float(np.abs(x).max(initial=0.0))) for x in (reference.q_tree, reference.v_tree))
    scaled = np.maximum(*(error / scale for error, scale in zip((error_q, error_v), scales, strict=True)))
    return MotionError(error_q, error_v, scaled)


def time_scene(
    scene: Scene, limit_s: float, *, min_runs: int = 1, max_runs: int = MAX_SCENE_REPEATS
) -> tuple[Motion, Run | None]:
    """Run a scene, repeatedly if it is short, and return its motion with the shortest time.

    Parameters
    ----------
    scene : Scene
    limit_s : float
        Runs are not repeated after this time, s.
    min_runs, max_runs : int
        With two runs, the first one warms up.

    Raises
    ------
    KeyboardInterrupt
        A signal interrupted a run. It ends the comparison, too.
    """
    start, wall_times = perf_counter(), list[float]()
    try:
        ready = prepare(scene)
        setup_s = perf_counter() - start
        while True:
            run = run_prepared(ready)
            if run.status == "interrupted":
                raise interrupt_again(run.message)
            wall_times.append(float(run.stats["wall_s"]))
            is_timed = len(wall_times) >= min_runs and sum(wall_times) > min(MIN_TIMED_S, limit_s)
            if run.status != "done" or is_timed or len(wall_times) >= max_runs:
                break
    except CkcError as error:
        return motion_without_data("refused", str(error)), None
    reason = "" if run.status == "done" else _without_configuration(run.message)
    motion = Motion(
        run.status,
        reason,
        run.q_tree,
        run.v_tree,
        wall_s=min(wall_times),
        setup_s=setup_s,
        rhs=run.stats["rhs"],
        steps=run.stats["steps"],
        used=run.stats["method"],
    )
    return motion, run


def _without_configuration(message: str) -> str:
    """Remove the configuration from a message, which may be a line of 81 coordinates."""
    return re.sub(r" near [^:]*:", ":", message)


@dataclass(frozen=True)
class FixedStepProgram:
    """A simulator with a fixed step, timed without the time to read its states.

    Attributes
    ----------
    reset : callable
        Sets the initial state.
    step : callable
        step(k) takes k steps.
    state : callable
        Returns q_tree and v_tree by coordinate.
    """

    reset: Callable[[], None]
    step: Callable[[int], None]
    state: Callable[[], tuple[Array, Array]]

    def estimate_wall_s(self, steps_per_instant: int, instants: int) -> float:
        """Return the estimated time of `run`, s, from a few trial steps."""
        self.reset()
        trial = min(TRIAL_STEPS, steps_per_instant)
        start = perf_counter()
        self.step(trial)
        return (perf_counter() - start) / trial * steps_per_instant * instants

    def run(self, steps_per_instant: int, instants: int) -> Motion:
        """Return the motion, which ends early if a state is not finite, with its shortest time."""
        wall_times: list[float] = []
        while not wall_times or (
            sum(wall_times) < REPEAT_BELOW_S and (len(wall_times) < MAX_REPEATS or sum(wall_times) < MIN_TIMED_S)
        ):
            self.reset()
            states, wall_s = [self.state()], 0.0
            for _ in range(instants):
                start = perf_counter()
                self.step(steps_per_instant)
                wall_s += perf_counter() - start
                states.append(self.state())
                if not np.all(np.isfinite(states[-1][0])):
                    break
            wall_times.append(wall_s)
        q_tree, v_tree = (np.array(rows) for rows in zip(*states, strict=True))
        steps = steps_per_instant * instants
        return Motion("done", "", q_tree, v_tree, min(wall_times), steps=steps, used="fixed step")
