"""Benchmark of compiled terms: what they cost and save, compared with Pinocchio's terms."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from ckc_pin import Simulator, Terms, linearize, load
from ckc_pin.base.arrays import Array
from ckc_pin.codegen.library import compile_terms
from ckc_pin.native.plant import Plant
from ckc_pin.run.simulate import run_prepared
from scripts.experiments.bench import min_processor_time, prepare_scene
from scripts.experiments.generated_sizes import empty_cache

Measured = tuple[float, float]  # with compiled terms, with Pinocchio's terms

RHS_NS = (("five_bar/swing", 150), ("andrews", 300), ("bricard", 350), ("delta", 900))
SWING_MS = ((1e-3, 0.12), (1e-6, 0.2), (1e-9, 0.35))
TERMS = ("generated", "pinocchio")


def _loop(scene: str, terms: str, overrides: dict[str, Any]) -> Any:
    prepared = prepare_scene(scene, {**overrides, "solver.terms": terms})
    prepared.begin()
    return prepared.loop


def rhs_ns(scene: str) -> Measured:
    """Return the time of a right-hand side as the loop calls it, at states near the start, ns."""
    times = []
    for terms in TERMS:
        loop = _loop(scene, terms, {"formulation": "dae"})
        times.append(1e9 * loop.seconds(_perturbed_states(loop), 2000))
    return times[0], times[1]


def _perturbed_states(loop: Any) -> Array:
    """Return 20 rows of (t, y) near the loop's state."""
    states = loop.y + 1e-3 * np.random.default_rng(0).standard_normal((20, len(loop.y)))
    return np.column_stack([np.zeros(20), states])


def jacobian() -> Measured:
    """Return the time of the five-bar's Jacobian over that of a right-hand side, both as the loop calls them."""
    ratios = []
    for terms in TERMS:
        loop = _loop("five_bar/swing", terms, {"formulation": "dae"})
        states = _perturbed_states(loop)
        ratios.append(loop.seconds(states, 5000, of_jacobian=True) / loop.seconds(states, 5000))
    return ratios[0], ratios[1]


def plant() -> Measured:
    """Return the time of A and B of the moving five-bar over that of a right-hand side."""
    mechanism = load("five_bar")
    at = mechanism.assembled
    state, ratios = Terms(mechanism, at, at.rho @ np.array([1.0, -2.0])), []
    for terms, library in zip(TERMS, (compile_terms(mechanism), None), strict=True):
        loop = _loop("five_bar/swing", terms, {"formulation": "dae"})
        alone = loop.seconds(np.append(0.0, loop.y)[np.newaxis], 20000)
        ratios.append(Plant(mechanism, library=library).seconds(state, np.zeros(mechanism.n)) / alone)
    return ratios[0], ratios[1]


def linearize_ms() -> Measured:
    """Return the time of `linearize` at given coordinates, ms. The mechanism is loaded and its terms are compiled."""
    times, q = [], {"theta_1": -1.1, "theta_3": -1.8}
    mechanism = load("five_bar")
    compile_terms(mechanism)
    for cached in (True, False):
        with TemporaryDirectory() as folder, nullcontext() if cached else empty_cache(Path(folder)):
            times.append(1e3 * min_processor_time(lambda: linearize(mechanism, q), 30))
    return times[0], times[1]


def compile_seconds(name: str) -> Measured:
    """Return the time of `compile_terms` with an empty cache, and with the library in the cache, s."""
    mechanism, times = load(name), []
    with TemporaryDirectory() as folder, empty_cache(Path(folder)):
        for _ in range(2):
            began = perf_counter()
            compile_terms(mechanism)
            times.append(perf_counter() - began)
    return times[0], times[1]


def run_ms(scene: str, overrides: dict[str, Any]) -> Measured:
    """Return the time spent in the loop, ms, the minimum of several runs."""
    times = []
    for terms in TERMS:
        prepared = prepare_scene(scene, {**overrides, "solver.terms": terms})
        times.append(1e3 * min(float(run_prepared(prepared).stats["wall_s"]) for _ in range(9)))
    return times[0], times[1]


def step_us() -> Measured:
    """Return the time of `Simulator.step` over 1 ms with another u in each step, microseconds."""
    times = []
    for terms in TERMS:
        simulator = Simulator("five_bar/swing", {"solver.terms": terms})
        us = [np.array([0.1 * np.sin(k), 0.0]) for k in range(200)]

        def steps(simulator: Simulator = simulator, us: list[Any] = us) -> None:
            simulator.reset()
            for u in us:
                simulator.step(u, 1e-3)

        times.append(1e6 * min_processor_time(steps, 15) / len(us))
    return times[0], times[1]


def rows() -> Iterator[tuple[str, Any, float, str]]:
    """Yield the lines of the table: what is measured, the function, its upper bound and the unit."""
    for scene, bound in RHS_NS:
        yield f"DAE right-hand side, {scene.partition('/')[0]}", partial(rhs_ns, scene), bound, "ns"
    yield "its Jacobian, five_bar", jacobian, 3, "right-hand sides"
    yield "A and B, five_bar", plant, 5, "right-hand sides"
    yield "linearize whole, five_bar at coordinates", linearize_ms, 5, "ms"
    for name, bound in (("five_bar", 2), ("delta", 10)):
        yield f"compiling {name}, and finding it", partial(compile_seconds, name), bound, "s"
    for rtol, bound_ms in SWING_MS:
        tight = {"solver.rtol": rtol, "solver.atol": rtol, "solver.output_dt": 2.0}
        yield f"swing 2 s to {rtol:g}, its end alone", partial(run_ms, "five_bar/swing", tight), bound_ms, "ms"
    sampled = {"controller.sample_time": 1e-3, "t_end": 9.5}
    yield "tracking with sample_time = 1e-3, 9.5 s", partial(run_ms, "five_bar/tracking", sampled), 60, "ms"
    yield "Simulator.step of 1 ms, five_bar", step_us, 6, "us"


def main(only: str = "") -> int:
    """Print a Markdown table of the lines that contain `only`; return 1 if a bound is exceeded."""
    print("| compiled terms | measured | at most | with Pinocchio's |\n|---|---|---|---|")
    missed = 0
    for what, measure, bound, unit in rows():
        if only not in what:
            continue
        ours, theirs = measure()
        missed += ours > bound
        says = ", missed" if ours > bound else ""
        print(f"| {what} | {ours:.4g} {unit} | {bound:g} {unit}{says} | {theirs:.4g} {unit} |", flush=True)
    return 1 if missed else 0
