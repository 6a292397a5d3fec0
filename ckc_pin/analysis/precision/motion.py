"""A scene's motion under one setting, timed, and how far two motions are apart."""

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
from ckc_pin.scene.scene import Scene, apply_overrides, make_scene

__all__ = [
    "FORMULATIONS",
    "INSTANTS",
    "REPEATS",
    "SHORT",
    "Apart",
    "Motion",
    "PrecisionRow",
    "Setting",
    "Stepper",
    "apart",
    "changed",
    "move",
    "no_motion",
    "off_manifold",
    "on_span",
    "settings",
]


INSTANTS = 20  # at which motions are compared, the end among them
REPEATS, ENOUGH = 20, 0.05  # runs and s: repeated up to whichever comes first


@dataclass(frozen=True)
class Motion:
    """What a setting made of a scene.

    Attributes
    ----------
    status : "done", "stopped", "refused", "failed" or "not tried"
    reason : str
        Where it is not "done".
    q_tree, v_tree : (m, n) arrays
        By coordinate, at the first m of the instants.
    wall_s : float or None
        Least time of its repeats, without `setup_s`.
    setup_s : float or None
        Time of loading and assembling, s.
    rhs, steps : int or None
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


def no_motion(status: str, reason: str, n: int = 0) -> Motion:
    """Return what is known of n coordinates where a setting was not run, or failed."""
    return Motion(status, reason, np.empty((0, n)), np.empty((0, n)))


@dataclass(frozen=True)
class PrecisionRow:
    """A line of the comparison: a setting, what it cost, how far off it is.

    Attributes
    ----------
    program : "ckc_pin" or "MuJoCo"
    formulation : str or None
        "dae", "reduced", "spf, w" (eq. 17's coordinates) or "spf, z" (eq. 8 as printed).
    method : str
    rtol, dt : float or None
        The tolerance, or the step, s.
    overrides : dict
        The setting as values of the scene by dotted key; None: the key is to be taken out.
    status, reason, rhs, steps, used, wall_s, setup_s
        As in `Motion`.
    error_q, error_v : float or None
        Largest error of q_tree and v_tree over the instants, rad or m and per s.
    error : float or None
        The larger of both, each relative to its largest value where that is above 1.
    resolved : bool or None
        Whether the error is well above the reference's own uncertainty.
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


@dataclass(frozen=True)
class Apart:
    """How far two motions are apart at each of the instants that both have: (m,) arrays."""

    q: Array
    v: Array
    scaled: Array


def apart(tree: Tree, motion: Motion, other: Motion) -> Apart:
    """Compare two motions of one mechanism; the second one's size is the scale."""
    m = min(len(motion.q_tree), len(other.q_tree))
    q, theirs = motion.q_tree[:m], other.q_tree[:m]
    if tree.is_euclidean:
        difference = q - theirs
    else:  # a rotation vector jumps where it has turned by pi
        from_numbers = tree.from_coordinates
        rows = [tree.difference(from_numbers(b), from_numbers(a)) for a, b in zip(q, theirs, strict=True)]
        difference = np.reshape(rows, (m, tree.n))
    error_q, error_v = (np.abs(x).max(axis=1, initial=0.0) for x in (difference, motion.v_tree[:m] - other.v_tree[:m]))
    scales = (max(1.0, float(np.abs(x).max(initial=0.0))) for x in (other.q_tree, other.v_tree))
    scaled = np.maximum(*(error / scale for error, scale in zip((error_q, error_v), scales, strict=True)))
    return Apart(error_q, error_v, scaled)


def on_span(scene: Scene, t_end: float, dt: float) -> dict[str, Any]:
    """Return the overrides that make all runs of a scene comparable: one span, its instants, no event that ends it."""
    events = [{**event, "stop": False} for event in scene.to_dict().get("event", [])]
    return {"t_end": t_end, "solver.output_dt": dt, **({"event": events} if events else {})}


def move(scene: Scene, limit: float, *, fewest: int = 1, most: int = REPEATS) -> tuple[Motion, Run | None]:
    """Run a scene, each run for no more than a limit in s; short runs are repeated, the fastest counts.

    KeyboardInterrupt: a signal stopped a run.

    Parameters
    ----------
    scene : Scene
    limit : float
    fewest, most : int
        Runs; of two, the first one warms up.
    """
    began, walls = perf_counter(), list[float]()
    try:
        ready = prepare(scene)
        setup = perf_counter() - began
        while True:
            run = run_prepared(ready)
            if run.status == "interrupted":  # the comparison is, not only this run
                raise interrupt_again(run.message)
            walls.append(float(run.stats["wall_s"]))
            enough = len(walls) >= fewest and sum(walls) > min(ENOUGH, limit)
            if run.status != "done" or enough or len(walls) >= most:
                break
    except CkcError as error:
        return no_motion("refused", str(error)), None
    stats = run.stats
    reason = "" if run.status == "done" else _without_place(run.message)
    return Motion(
        run.status, reason, run.q_tree, run.v_tree, min(walls), setup, stats["rhs"], stats["steps"], stats["method"]
    ), run


def _without_place(message: str) -> str:
    """Shorten a message by its configuration, which may be a line of 81 coordinates."""
    return re.sub(r" near [^:]*:", ":", message)


# --- Which ways of running a scene are compared: formulation, method, tolerance.

FORMULATIONS: dict[str, dict[str, Any]] = {
    "dae": {"formulation": "dae"},
    "reduced": {"formulation": "reduced"},
    "spf, w": {"formulation": "spf", "spf_coordinates": "w"},
    "spf, z": {"formulation": "spf", "spf_coordinates": "z"},
}
EVERY = tuple(10.0**-k for k in range(2, 13))
METHODS = {"auto": EVERY, "DOP853": EVERY, "RK45": EVERY[::2], "Radau": EVERY[::2]}


@dataclass(frozen=True)
class Setting:
    """How a scene is run.

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
        """All but the tolerance."""
        return self.formulation, self.method

    def overrides(self, scene: Scene) -> dict[str, Any]:
        """Values of the scene by dotted key, those that a person would give with --set."""
        found = {**FORMULATIONS[self.formulation], "solver.method": self.method, "solver.rtol": self.rtol}
        if scene.spec.solver.atol is not None:  # the scene's own goes with one rtol
            found["solver.atol"] = float(f"{self.rtol / 100:.0e}")
        if self.formulation != "dae":
            found |= _no_projection(scene)
        return found


def _no_projection(scene: Scene) -> dict[str, Any]:
    """Take away the keys that only a DAE has."""
    solver = scene.spec.solver
    return {"solver.baumgarte": None} if solver.baumgarte else {}


def settings(scene: Scene) -> Iterator[Setting]:
    """All settings, from loose to tight: first of "auto", so that a budget that is used up leaves out the others'."""
    formulations = [name for name in FORMULATIONS if name.startswith("spf") or not off_manifold(scene)]
    for methods in (["auto"], [name for name in METHODS if name != "auto"]):
        for rtol, method, formulation in product(EVERY, methods, formulations):
            if rtol in METHODS[method]:
                yield Setting(formulation, method, rtol)


def off_manifold(scene: Scene) -> bool:
    """Whether a scene starts with phi = w other than 0, which only the SPF can."""
    return any(scene.spec.initial.w or [])


def changed(scene: Scene, overrides: Mapping[str, Any]) -> Scene:
    """Return a scene with values replaced by dotted key; None removes a key."""
    return make_scene(apply_overrides(scene.to_dict(), overrides), scene.name, scene.sources)


# --- A program with a fixed step: stepped from instant to instant, timed without what is read out in between.

TRIAL = 50  # steps, to foresee how long all take
REPEATS, ENOUGH, SHORT = 3, 0.05, 1.0  # runs, s of runs: what takes less than the last is repeated


@dataclass(frozen=True)
class Stepper:
    """A program that takes steps.

    Attributes
    ----------
    reset : callable
        Puts it at the start.
    step : callable
        step(k) takes k steps.
    state : callable
        Returns q_tree and v_tree by coordinate.
    """

    reset: Callable[[], None]
    step: Callable[[int], None]
    state: Callable[[], tuple[Array, Array]]

    def foreseen(self, many: int, instants: int) -> float:
        """Return how long it would take, with so many steps between instants, s."""
        self.reset()
        trial = min(TRIAL, many)
        began = perf_counter()
        self.step(trial)
        return (perf_counter() - began) / trial * many * instants

    def run(self, many: int, instants: int) -> Motion:
        """Return its motion, with so many steps between instants, up to where that is not finite."""
        walls: list[float] = []
        while not walls or (sum(walls) < SHORT and (len(walls) < REPEATS or sum(walls) < ENOUGH)):
            self.reset()
            states, wall = [self.state()], 0.0
            for _ in range(instants):
                began = perf_counter()
                self.step(many)
                wall += perf_counter() - began
                states.append(self.state())
                if not np.all(np.isfinite(states[-1][0])):
                    break
            walls.append(wall)
        q_tree, v_tree = (np.array(rows) for rows in zip(*states, strict=True))
        return Motion("done", "", q_tree, v_tree, min(walls), steps=many * instants, used="fixed step")
