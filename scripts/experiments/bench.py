"""Benchmark of common calls and commands: processor times, the minimum of several repetitions.

The two times of a ratio are measured in one process.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from timeit import repeat
from typing import Any

import numpy as np

from ckc_pin import Simulator, Terms, load_scene, simulate
from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.run.prepare import Prepared, prepare
from ckc_pin.run.simulate import run_prepared
from ckc_pin.scene.names import list_catalogue
from ckc_pin.scene.parts import build_scene_controller

INERT = [{"coordinate": "theta_1", "value": 50.0}]
FORMULATIONS = ("dae", "reduced", "spf")
CIRCLE = {
    "controller.desired": {"point": "tip", "circle": {"centre": [0.15, -0.42, 0.0], "radius": 0.06, "frequency": 1.0}},
    "initial": {"q": {"theta_1": -1.2, "theta_3": -1.9}},
}


def min_processor_time(function: Callable[[], Any], times: int) -> float:
    """Return the minimum processor time of several calls of a function, s."""
    return min(repeat(function, timer=process_time, repeat=times, number=1))


def prepare_scene(scene: str, overrides: dict[str, Any] | None = None, **options: Any) -> Prepared:
    """Load a scene and prepare its run."""
    return prepare(load_scene(scene, overrides), **options)


def run_seconds(scene: str, overrides: dict[str, Any] | None = None, times: int = 5) -> float:
    """Return the processor time of a run of a prepared scene, s."""
    prepared = prepare_scene(scene, overrides)
    return min_processor_time(lambda: run_prepared(prepared), times)


def count_python_calls() -> float:
    """Count calls of Python within the step loop, over all shipped scenes in all formulations."""
    total = 0
    for name, _, scenes in list_catalogue():
        for scene in scenes:
            for formulation in FORMULATIONS:
                run = simulate(f"{name}/{scene}", {"formulation": formulation, "t_end": 0.05})
                total += run.stats["python_calls"]
    return float(total)


def measure_inert_event_ratio() -> float:
    """Return the time of the swing with an event that never triggers over the time without."""
    without_event, with_event = prepare_scene("five_bar/swing"), prepare_scene("five_bar/swing", {"event": INERT})
    pairs = [
        (
            min_processor_time(lambda: run_prepared(with_event), 5),
            min_processor_time(lambda: run_prepared(without_event), 5),
        )
        for _ in range(5)
    ]
    return min(a for a, _ in pairs) / min(b for _, b in pairs)


class UserSetPoint:
    """Set-point controller of eq. 14 as a user would write it, with scalar gains."""

    def __init__(self, scene: str) -> None:
        inner = build_scene_controller(load_scene(scene), prepare_scene(scene).mechanism)
        assert isinstance(inner, SetPoint)
        self.q_d, self.K_P, self.K_V, self.h_d = inner.q_d, inner.K_P[0, 0], inner.K_V[0, 0], inner.target.h

    def u(self, t: float, terms: Terms) -> Any:
        return self.h_d - self.K_P * (terms.q - self.q_d) - self.K_V * terms.q_dot


def user_controller_us() -> float:
    """Return the time of a right-hand side with a user's controller, microseconds. The run records only its end."""
    scene = "five_bar/set_point"
    prepared = prepare_scene(scene, {"solver.output_dt": 5.0}, controller=UserSetPoint(scene))
    spent = min_processor_time(lambda: run_prepared(prepared), 15)
    return 1e6 * spent / float(prepared.loop.stats().rhs)


def step_us(scene: str, overrides: dict[str, Any] | None = None) -> float:
    """Return the time of `Simulator.step` over 1 ms, microseconds."""
    simulator = Simulator(scene, overrides)
    u = np.zeros(simulator.mechanism.d)

    def steps() -> None:
        simulator.reset()
        for _ in range(100):
            simulator.step(u, 1e-3)

    return 1e4 * min_processor_time(steps, 7)


def measure_circle_ratio() -> float:
    """Return the time of `simulate` with a circle of the tip over that with a table of the same coordinates."""
    scene, start = "five_bar/tracking", {"formulation": "reduced", "initial": CIRCLE["initial"]}
    prepared = prepare_scene(scene, {**start, **CIRCLE})
    assert isinstance(prepared.controller, Tracking)
    times = np.linspace(0.0, 10.0, 201)
    rows = [",".join(map(repr, [float(t), *map(float, prepared.controller.desired(min(t, 9.5))[0])])) for t in times]
    with TemporaryDirectory() as folder:
        table = Path(folder) / "circle.csv"
        table.write_text("\n".join([f"t,{','.join(prepared.mechanism.independent)}", *rows]))
        in_coordinates = {**start, "controller.desired": {"file": str(table)}}
        by_point = min_processor_time(lambda: simulate(scene, {**start, **CIRCLE}), 5)
        return by_point / min_processor_time(lambda: simulate(scene, in_coordinates), 5)


def run_overhead_us() -> float:
    """Return the time that `run_prepared` takes beyond the native loop, microseconds."""
    prepared = prepare_scene("five_bar/swing", {"t_end": 1e-3, "solver.output_dt": 1e-3})
    times, rows = np.array([0.0, 1e-3]), np.empty((3, prepared.loop.width))

    def native() -> None:
        prepared.begin()
        prepared.loop.record(times, rows)
        prepared.loop.advance(1e-3, final=True, pause=0.05, budget=60.0)

    return 1e6 * (min_processor_time(lambda: run_prepared(prepared), 300) - min_processor_time(native, 300))


def process_seconds(*words: str, **variables: str) -> float:
    """Return user and system time of a process, s, the minimum of nine runs after a first one.

    Parameters
    ----------
    *words : str
        The command.
    **variables : str
        Environment variables.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"} | variables

    def once() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(words, env=environment, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    once()
    return min(once() for _ in range(9))


def measure_command_ratio(*words: str) -> float:
    """Return the time of a `ckc` command, without compiled terms, over that of importing Pinocchio."""
    with TemporaryDirectory() as empty_cache:
        command = process_seconds(str(Path(sys.executable).parent / "ckc"), *words, XDG_CACHE_HOME=empty_cache)
    return command / process_seconds(sys.executable, "-c", "import pinocchio")


def measure_import_ratio() -> float:
    """Return the time of importing ckc_pin over that of importing Pinocchio."""
    ours, theirs = (process_seconds(sys.executable, "-c", f"import {name}") for name in ("ckc_pin", "pinocchio"))
    return ours / theirs


def rows() -> Iterator[tuple[str, Callable[[], float], float, str]]:
    """Yield the lines of the table: what is measured, the function, its upper bound and the unit."""
    yield "Python calls in the loop, all shipped scenes", count_python_calls, 0, ""
    yield "swing with an inert event / without", measure_inert_event_ratio, 1.15, ""
    yield "a caller's Python controller, a right-hand side", user_controller_us, 12, "us"
    yield (
        "tracking with sample_time = 1e-3, 9.5 s",
        lambda: run_seconds("five_bar/tracking", {"controller.sample_time": 1e-3, "t_end": 9.5}, 3),
        0.35,
        "s",
    )
    for scene, bound in (("five_bar", 25), ("delta", 60), ("two_ur5", 150), ("talos", 2000)):
        yield f"Simulator.step of 1 ms, {scene}", partial(step_us, scene), bound, "us"
    yield "a tip's circle tracked / the same by a table of coordinates, whole", measure_circle_ratio, 3, ""
    yield "talos/default", lambda: run_seconds("talos/default"), 0.8, "s"
    yield "flyball as DAE to 1e-6", lambda: run_seconds("flyball", {"solver.rtol": 1e-6}), 0.3, "s"
    yield "a run again, beyond the loop's own time", run_overhead_us, 50, "us"
    yield (
        'simulate("five_bar/swing") whole, compiled terms',
        lambda: 1e3 * min_processor_time(lambda: simulate("five_bar/swing", {"solver.terms": "generated"}), 20),
        3,
        "ms",
    )
    yield "import ckc_pin / import pinocchio", measure_import_ratio, 1.25, ""
    for scene in ("five_bar/swing", "slider_crank"):
        words = ("run", scene, "--set", "t_end=1.0", "--set", "solver.rtol=1e-6", "--json")
        yield f"ckc {' '.join(words)} / import pinocchio", partial(measure_command_ratio, *words), 1.5, ""


def main(only: str = "") -> int:
    """Print a Markdown table of the lines that contain `only`; return 1 if a bound is exceeded."""
    print("| what | measured | at most |\n|---|---|---|")
    missed = 0
    with one_blas_thread():
        for what, measure, bound, unit in rows():
            if only not in what:
                continue
            value = measure()
            missed += value > bound
            print(
                f"| {what} | {value:.4g} {unit} | {bound:g} {unit}{', missed' if value > bound else ''} |", flush=True
            )
    return 1 if missed else 0
