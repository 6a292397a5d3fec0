"""Measure what a scene saves: modules that its run does not import, terms that its right-hand side does not evaluate.

Each saving is measured by adding the part. A module is imported in a fresh interpreter after a run. A term is evaluated
in NumPy at states of the motion where everything that the right-hand side evaluates is available, and compared with
the time of the same right-hand side in NumPy.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from timeit import repeat
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.dynamics.formulations import multipliers
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import CkcError, NumericalError
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.run.ivp import Ivp, as_ivp
from ckc_pin.run.simulate import simulate
from ckc_pin.scene.names import list_catalogue
from ckc_pin.scene.scene import Scene, load_scene

__all__ = ["MISSING", "MODULES", "TERMS", "LeftOut", "every_scene", "module_costs", "modules_of", "terms_of"]

MISSING = "the scene itself"  # stands for a module or term if the scene cannot be loaded
BRIEF = 0.02  # s of a scene's motion: enough to import and evaluate everything that its run needs
START = "five_bar/swing"  # the run after which a module is imported
REPEATS = 3  # fresh interpreters per module
STATES, SPACING = 20, 1e-4  # number of states of the motion, and s between them
ROUNDS = 8  # repetitions over the states

Modules = Mapping[str, tuple[str, str]]

# Module: its import statement and its purpose.
MODULES: Modules = {
    "meshcat": ("import meshcat", "playback in a browser"),
    "matplotlib": ("import matplotlib.figure, matplotlib.backends.backend_agg", "figures"),
    "yourdfpy": ("import yourdfpy", "visual meshes"),
    "sksundae": ("import sksundae", "SUNDIALS, a second opinion in the benchmark"),
    "mujoco": ("import mujoco", "`ckc import` of MJCF, and MuJoCo in `ckc report`"),
    "click": ("import click, rich", "the command line; a run from Python needs none"),
    "scipy.integrate": ("import scipy.integrate", "a second opinion by SciPy's solvers"),
}

RUN = """
import json, resource, sys
import ckc_pin
scene, overrides = json.loads(sys.argv[1])
ckc_pin.simulate(scene, overrides)
"""
LOADED = RUN + "print(json.dumps([name for name in json.loads(sys.argv[2]) if name in sys.modules]))"
SWITCHED_ON = (
    RUN
    + """
from time import perf_counter
def peak():
    try:  # on Linux ru_maxrss begins with what the parent had
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM"))
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
there, began = peak(), perf_counter()
exec(sys.argv[2])
print(json.dumps([perf_counter() - began, peak() - there]))
"""
)

Probe = Callable[[Terms, Terms], Any]  # called with the terms of a state and of the state before it


def _sigma(terms: Terms, before: Terms) -> Any:
    return sigma(terms.mechanism, terms.q, before.at)


def _multipliers(terms: Terms, before: Terms) -> Any:
    return multipliers(terms, np.zeros(terms.mechanism.n), np.zeros(terms.mechanism.n))


# Term: its name in the step loop's profile, and the function that evaluates it.
TERMS: dict[str, tuple[str, Probe]] = {
    "C'": ("C_tree", lambda terms, before: terms.C_tree),
    "J̇": ("J_dot", lambda terms, before: terms.J_dot),
    "ρ̇": ("rho_dot", lambda terms, before: terms.rho_dot),
    "C": ("C", lambda terms, before: terms.C),
    "λ": ("multipliers", _multipliers),
    "σ": ("sigma", _sigma),
    "energy": ("energy", lambda terms, before: terms.energy),
}


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """Cost of a module or a term in a scene.

    Attributes
    ----------
    scene : str
        Empty for the cost of a module, which is the same for all scenes.
    what : str
    used : bool or None
        Whether the scene's run imports the module or its right-hand side evaluates the term.
    seconds : float or None
        Time that it would add: a module once, a term in each right-hand side.
    bytes : int or None
        Memory: peak resident memory for a module, memory during the evaluation for a term.
    rhs_s : float or None
        Time of a right-hand side in NumPy, for comparison with a term.
    reason : str
        Why a value is missing; empty otherwise.
    """

    scene: str
    what: str
    used: bool | None = None
    seconds: float | None = None
    bytes: int | None = None
    rhs_s: float | None = None
    reason: str = ""


def every_scene() -> list[str]:
    """Return the names of all shipped scenes."""
    return [f"{name}/{scene}" for name, _, scenes in list_catalogue() for scene in scenes]


def module_costs(repeats: int = REPEATS, modules: Modules = MODULES) -> Iterator[LeftOut]:
    """Measure the cost of importing each module after a run, the minimum over several interpreters."""
    for name, (statement, _) in modules.items():
        words = (json.dumps([START, {"t_end": BRIEF}]), statement)
        try:
            measurements = [json.loads(_interpreter(SWITCHED_ON, *words)) for _ in range(repeats)]
        except CkcError as error:
            yield LeftOut(scene="", what=name, reason=str(error))
            continue
        spent, memory = (min(column) for column in zip(*measurements, strict=True))
        yield LeftOut(scene="", what=name, seconds=spent, bytes=max(0, memory))


def modules_of(scene: str, modules: Iterable[str] = MODULES) -> Iterator[LeftOut]:
    """Run the beginning of a scene in a fresh interpreter and yield which modules it has imported."""
    words = (json.dumps([scene, {"t_end": BRIEF}]), json.dumps(list(modules)))
    try:
        loaded = json.loads(_interpreter(LOADED, *words))
    except CkcError as error:
        yield from (LeftOut(scene=scene, what=name, reason=str(error)) for name in modules)
        return
    yield from (LeftOut(scene=scene, what=name, used=name in loaded) for name in modules)


def _interpreter(code: str, *words: str) -> str:
    """Run code in a fresh interpreter and return its last line of output.

    Raises
    ------
    CkcError
        The code failed; the message is the last line of its error output.
    """
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise CkcError((done.stderr.splitlines() or [f"exit code {done.returncode}"])[-1])
    return done.stdout.splitlines()[-1]


def terms_of(scene: str, overrides: Mapping[str, Any] | None = None) -> Iterator[LeftOut]:
    """Measure the time that each term would add to a scene's right-hand side, at states of its motion."""
    try:
        loaded = load_scene(scene, {**(overrides or {}), "t_end": BRIEF})
        evaluated, ivp = _evaluated(loaded), as_ivp(loaded)
        states = _motion(ivp)
    except CkcError as error:
        yield from (LeftOut(scene=scene, what=what, reason=str(error)) for what in TERMS)
        return
    rhs_s = _rhs_seconds(ivp, states)
    for what, (name, probe) in TERMS.items():
        row = LeftOut(scene=scene, what=what, used=name in evaluated, rhs_s=rhs_s)
        if name not in evaluated:
            try:
                spent, memory = _time_probe(ivp, states, evaluated, probe)
            except CkcError as error:
                row = replace(row, reason=str(error))
            else:
                row = replace(row, seconds=spent, bytes=memory)
        yield row


def _evaluated(scene: Scene) -> set[str]:
    """Return the names of the terms that the step loop's right-hand sides evaluate, by its profile, and sigma."""
    run = simulate(scene, profile=True)
    names = set(run.profile)
    if "C_tree" in names:  # both are computed in one pass; only products of rho_dot and C are computed
        names.add("J_dot")
    if run.stats["newton"] and scene.spec.formulation != "dae":  # corrections of a DAE are the projection's
        names.add("sigma")
    return names


def _motion(ivp: Ivp) -> list[tuple[float, Array]]:
    """Return t and y of states of a motion.

    Raises
    ------
    NumericalError
        The motion ends before the last state.
    """
    from scipy.integrate import solve_ivp

    times = SPACING * np.arange(STATES)
    with np.errstate(all="ignore"):
        solution = solve_ivp(ivp.f, (0.0, times[-1]), ivp.y0, "DOP853", times)
    if not solution.success:
        raise NumericalError(solution.message)
    return list(zip(times.tolist(), solution.y.T, strict=True))


def _rhs_seconds(ivp: Ivp, states: list[tuple[float, Array]]) -> float:
    """Return the mean time of a right-hand side over the states, s, the minimum of several rounds."""

    def each() -> None:
        for t, y in states:
            ivp.f(t, y)

    with one_blas_thread():
        return min(repeat(each, repeat=ROUNDS, number=1)) / len(states)


def _time_probe(ivp: Ivp, states: list[tuple[float, Array]], evaluated: set[str], probe: Probe) -> tuple[float, int]:
    """Return a probe's mean time over the states, s, the minimum of several rounds, and its memory, bytes."""
    terms: list[Terms] = []

    def fresh() -> None:
        terms[:] = [_as_evaluated(ivp, *state, evaluated) for state in states]

    def each() -> None:
        for before, now in pairwise(terms):
            probe(now, before)

    with one_blas_thread():
        best = min(repeat(each, fresh, repeat=ROUNDS, number=1)) / (len(states) - 1)
        fresh()
        tracemalloc.start()
        try:
            probe(terms[1], terms[0])
            memory = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    return best, memory


def _as_evaluated(ivp: Ivp, t: float, y: Array, evaluated: set[str]) -> Terms:
    """Return the terms at a state with everything evaluated that the right-hand side evaluates."""
    terms = ivp.terms(t, y)
    for name in evaluated:
        for owner in (terms, terms.at):
            if hasattr(type(owner), name):
                getattr(owner, name)
    return terms
