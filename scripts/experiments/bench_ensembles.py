"""Benchmark of ensembles: the five-bar's swings in threads, and compared with MuJoCo's rollout at equal error.

Processor seconds are those of the whole process with all its threads. On a busy machine they vary less than the clock.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.analysis.precision.mujoco import INTEGRATORS, STIFFNESSES, StateMap, configure_model, load_model
from ckc_pin.base.arrays import Array
from ckc_pin.codegen.c_source import MEMBERS
from ckc_pin.ensembles.members import Members
from ckc_pin.formats.exporting import export

SCENE, T_END = "five_bar/swing", 2.0
START = ("initial.q.theta_1",)
LOW, HIGH = (-1.2,), (-0.9,)
PARAMETERS = (*START, "link.link_2.mass", "joint.theta_2.xyz.x")
PARAMETERS_LOW, PARAMETERS_HIGH = (*LOW, 0.24, 0.25), (*HIGH, 0.28, 0.27)
COMPARED_MEMBERS = 24  # members whose error is measured
TARGETS = (1e-3, 1e-6)


def draw(members: int, low: tuple[float, ...], high: tuple[float, ...]) -> Array:
    """Draw uniform values of the variables, shape (members, variables)."""
    return np.random.default_rng(1).uniform(low, high, (members, len(low)))


def timed(members: Members, values: Array) -> tuple[float, float, Array]:
    """Return wall time and processor time in s, and the members' q_tree at the end."""
    members.run(0, values[:2])
    clock, processor = time.perf_counter(), time.process_time()
    chunk = members.run(0, values)
    return time.perf_counter() - clock, time.process_time() - processor, chunk.outputs["end"]


def run_members(
    rtol: float, terms: str, threads: int, values: Array, names: tuple[str, ...] = START, *, lanes: bool = True
) -> tuple[float, float, Array]:
    """Run members of the ensemble: wall time and processor time in s, and q_tree at the end."""
    overrides = {"solver.rtol": rtol, "solver.terms": terms}
    return timed(Members(SCENE, overrides, names, {"end": "q_tree"}, len(values), threads, lanes=lanes), values)


def table(count: int, threads: int) -> None:
    """Print the seconds that 10,000 members take at rtol 1e-6."""
    print(f"10,000 swings of {T_END:g} s at rtol 1e-6, ends kept; measured on {count}\n")
    print("| terms | lanes | varied | threads | s of the clock | s of the processor |\n|---|---|---|---|---|---|")
    for (terms, lanes), (names, low, high), workers in product(
        (("generated", True), ("generated", False), ("pinocchio", False)),
        ((START, LOW, HIGH), (PARAMETERS, PARAMETERS_LOW, PARAMETERS_HIGH)),
        (1, threads),
    ):
        values = draw(count, low, high)
        clock, processor, _ = min(run_members(1e-6, terms, workers, values, names, lanes=lanes) for _ in range(3))
        seconds = f"{clock / count * 1e4:.2f} | {processor / count * 1e4:.2f}"
        print(f"| {terms} | {MEMBERS if lanes else 1} | {', '.join(names)} | {workers} | {seconds} |")


def rollouts(values: Array, threads: int) -> Iterator[tuple[str, float, float, Array]]:
    """Run MuJoCo's rollout from coarse to fine steps; yield method, dt, wall time in s and q_tree at the end."""
    from mujoco import MjData, mj_getState, mjtState
    from mujoco.rollout import Rollout

    mechanism = ckc_pin.load("five_bar")
    model = load_model(export(mechanism, "mjcf").text)
    joints, size = StateMap(mechanism, model), mjtState.mjSTATE_FULLPHYSICS
    datas: list[Any] = [MjData(model) for _ in range(threads)]
    first, _ = ckc_pin.simulate(SCENE, {"t_end": 1e-3}), None
    assert first.status == "done"
    states = []
    for value in values:
        run = ckc_pin.simulate(SCENE, {START[0]: float(value[0]), "t_end": 1e-9})
        joints.set_state(datas[0], run.q_tree[0], run.v_tree[0])
        datas[0].time = 0.0
        state = np.empty(model.nq + model.nv + 1)
        mj_getState(model, datas[0], state, size)
        states.append(state)
    initial = np.array(states)
    with Rollout(nthread=threads) as pool:
        for k, integrator, stiffness in product(range(7), INTEGRATORS, STIFFNESSES):
            steps = round(100 * 2**k * T_END)
            configure_model(model, integrator, stiffness, T_END / steps)
            started = time.perf_counter()
            trajectories, _ = pool.rollout(model, datas, initial, nstep=steps)
            seconds = time.perf_counter() - started
            ends = []
            for row in trajectories[:, -1]:
                datas[0].qpos[:] = row[1 : 1 + model.nq]
                datas[0].qvel[:] = row[1 + model.nq :]
                ends.append(joints.get_state(datas[0])[0])
            yield f"{integrator}, {stiffness}", T_END / steps, seconds, np.array(ends)


def compare_with_mujoco(threads: int) -> None:
    """Print members per second at equal error, both programs in turn in one process."""
    values = draw(COMPARED_MEMBERS, LOW, HIGH)
    _, _, exact = run_members(1e-12, "pinocchio", threads, values)
    many = draw(400, LOW, HIGH)
    settings: dict[float, tuple[float, float]] = {}
    for target, rtol in product(TARGETS, (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)):
        error = float(np.abs(run_members(rtol, "generated", threads, values)[2] - exact).max())
        if error <= target and target not in settings:
            settings[target] = rtol, error
    print("\n| error | ckc_pin, members a second | MuJoCo's rollout, members a second | times |\n|---|---|---|---|")
    best: dict[float, tuple[float, str]] = {}
    smallest = (np.inf, "")
    for method, dt, seconds, ends in rollouts(values, threads):
        error = float(np.abs(ends - exact).max())
        smallest = min(smallest, (error, f"{method}, dt = {dt:.2g} s"))
        for target in TARGETS:
            rate = COMPARED_MEMBERS / seconds
            if error <= target and (target not in best or best[target][0] < rate):
                best[target] = rate, f"{method}, dt = {dt:.2g} s"
    for target in TARGETS:
        rtol, error = settings[target]
        rate = len(many) / run_members(rtol, "generated", threads, many)[0]
        there = best.get(target)
        other = (
            f"{there[0]:,.1f} ({there[1]})" if there else f"none; its least error is {smallest[0]:.1e} ({smallest[1]})"
        )
        print(f"| {target:g} | {rate:,.0f} (rtol {rtol:g}, error {error:.1e}) | {other} | "
              f"{f'{rate / there[0]:,.0f}' if there else ''} |")  # fmt: skip


def main(runs: int) -> None:
    """Print both tables as Markdown, for `runs` thousand members."""
    threads = os.cpu_count() or 1
    table(1000 * runs, threads)
    compare_with_mujoco(threads)
