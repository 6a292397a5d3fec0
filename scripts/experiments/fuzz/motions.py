"""Random motions of a mechanism: start, speed, tolerance, formulation, events and control as scene overrides."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Mechanism
from scripts.experiments.fuzz.joint_forces import PER_SAMPLE
from scripts.experiments.fuzz.mechanisms import random_mechanism
from scripts.experiments.fuzz.spatial import Array

__all__ = ["SHIPPED", "Motion", "random_motion", "shipped_motion"]


@dataclass(frozen=True)
class _Ranges:
    scene: str
    speed: float = 20.0  # rad/s
    spread: float = np.pi  # largest distance of a start from the assembled configuration, rad
    t_end: float = 4.0
    output_dt: float = 0.004
    weight: float = 1.0


SHIPPED = {
    "five_bar": _Ranges("five_bar/swing", weight=6),
    "five_bar_as_printed": _Ranges("five_bar_as_printed/swing"),
    "four_bar": _Ranges("four_bar", weight=2),
    "slider_crank": _Ranges("slider_crank", weight=2),
    "slider_crank_spatial": _Ranges("slider_crank_spatial", weight=2),
    "three_rrr": _Ranges("three_rrr", weight=2),
    "delta": _Ranges("delta", spread=0.8, t_end=1.0, weight=1),
    "stewart": _Ranges("stewart", spread=0.3, t_end=0.5, weight=1),
    "bricard": _Ranges("bricard", t_end=2.0),
    "andrews": _Ranges("andrews", speed=200.0, spread=1.0, t_end=0.03, output_dt=5e-5),
    "flyball": _Ranges("flyball", spread=0.1, t_end=0.2, weight=0.3),
    "n_four_bar": _Ranges("n_four_bar", speed=8.0, t_end=1.0, weight=0.6),
    "two_ur5": _Ranges("two_ur5", speed=4.0, spread=0.7, t_end=0.5, weight=0.6),
    "talos": _Ranges("talos", speed=2.0, spread=0.2, t_end=0.2, weight=0.3),
}
BUDGET = {"solver.max_rhs": 400_000, "solver.max_wall_s": 20.0}


@dataclass(frozen=True)
class Motion:
    """A scene, by name or folder, and its overrides."""

    seed: int
    mechanism: str
    scene: str
    overrides: dict[str, Any]


def shipped_motion(seed: int, name: str | None = None) -> Motion:
    """Return a random motion of a shipped mechanism."""
    random = np.random.default_rng([seed, 2])
    weights = np.array([shipped.weight for shipped in SHIPPED.values()])
    drawn = str(random.choice(list(SHIPPED), p=weights / weights.sum()))
    name = name or drawn
    return Motion(seed, name, SHIPPED[name].scene, _overrides(random, ckc_pin.load(name), SHIPPED[name]))


def random_motion(seed: int, folder: Path) -> Motion:
    """Return a random motion of a random mechanism, whose files are written to a folder."""
    random = np.random.default_rng([seed, 3])
    mechanism_files = random_mechanism(seed)
    mechanism_files.write(folder)
    ranges = _Ranges("", t_end=2.0, spread=1.0)
    return Motion(seed, mechanism_files.kind, str(folder), _overrides(random, ckc_pin.load(folder), ranges))


def _overrides(random: np.random.Generator, mechanism: Mechanism, ranges: _Ranges) -> dict[str, Any]:
    overrides: dict[str, Any] = {
        "formulation": str(random.choice(["reduced", "spf", "dae"])),
        "t_end": float(ranges.t_end * 10 ** random.uniform(-1, 0)),
        "solver.rtol": float(10 ** random.uniform(-10, -2)),
        "solver.output_dt": ranges.output_dt,
        **BUDGET,
    }
    if mechanism.splits_root:
        overrides["formulation"] = "dae"
    if random.random() < 0.2:
        overrides["solver.method"] = str(random.choice(["DOP853", "RK45", "Radau"]))
    q, q_dot = _start(random, mechanism, ranges)
    overrides["initial"] = {"q_dot": dict(zip(mechanism.independent, q_dot.tolist(), strict=True))}
    if q is None:
        overrides["initial"]["at"] = "assembled"
    else:
        overrides["initial"]["q"] = dict(zip(mechanism.independent, q.tolist(), strict=True))
    if overrides["formulation"] == "spf":
        overrides["epsilon"] = float(10 ** random.uniform(-8, -1))
        if random.random() < 0.05 and not mechanism.redundant:
            overrides["initial"]["w"] = (random.uniform(-1, 1, mechanism.closure.rows) * 1e-3 * mechanism.size).tolist()
    if random.random() < 1 / 3:
        overrides["event"] = _events(random, mechanism, q, q_dot)
    if q is not None and not mechanism.independent_root_coordinates and random.random() < 0.12:
        overrides["controller"] = _controller(random, mechanism, q)
        if "sample_time" in overrides["controller"]:  # u jumps at output instants only
            overrides["solver.output_dt"] = overrides["controller"]["sample_time"] / PER_SAMPLE
    else:
        overrides["controller"] = None
    return overrides


def _start(random: np.random.Generator, mechanism: Mechanism, ranges: _Ranges) -> tuple[Array | None, Array]:
    """Return q and q_dot; q is None for a start from the assembled configuration."""
    slides = mechanism.tree.in_metres[mechanism.partition.q]
    unit = np.where(slides, 0.3 * mechanism.size, 1.0)
    q_dot = random.uniform(-1, 1, mechanism.d) * ranges.speed * unit * random.choice([0.0, 0.1, 1.0, 1.0])
    if mechanism.splits_root or random.random() < 0.1:
        return None, q_dot
    assembled = mechanism.independent_part(mechanism.q_tree)
    for attempt in range(12):  # closer with each attempt
        target = assembled + random.uniform(-1, 1, mechanism.d) * ranges.spread * unit * 0.75**attempt
        solution = sigma(mechanism, target)
        if solution.verdict == "converged":
            return target, q_dot
    return assembled, q_dot


def _events(random: np.random.Generator, mechanism: Mechanism, q: Array | None, q_dot: Array) -> list[dict[str, Any]]:
    """Return one or two events, in some cases at the initial value (tangential at rest) or both at one value."""
    k = int(random.integers(mechanism.d))
    of = str(random.choice(["q", "q_dot"]))
    start = q_dot[k] if of == "q_dot" else 0.0 if q is None else q[k]
    value = start if random.random() < 0.3 else start + random.normal() * (5.0 if of == "q_dot" else 0.5)
    event = {"of": of, "coordinate": mechanism.independent[k], "value": float(value)}
    event |= {"direction": int(random.integers(-1, 2)), "stop": bool(random.random() < 0.2)}
    draw = random.random()
    if draw < 0.2:
        return [event, dict(event)]
    if draw < 0.4:
        other = mechanism.coordinates[int(random.integers(mechanism.n))]
        return [event, {"of": "q_dot", "coordinate": other, "value": 0.0}]
    return [event]


def _controller(random: np.random.Generator, mechanism: Mechanism, q: Array) -> dict[str, Any]:
    target = dict(zip(mechanism.independent, (q + random.uniform(-0.5, 0.5, mechanism.d)).tolist(), strict=True))
    gain = float(10 ** random.uniform(-1, 1.5))
    controller: dict[str, Any] = {"type": "set_point", "K_P": gain, "K_V": gain * float(random.uniform(0.05, 0.5))}
    controller["q_d"] = target
    if random.random() < 0.7:
        controller["sample_time"] = float(10 ** random.uniform(-3, -2))
        if random.random() < 0.5:
            controller["delay"] = controller["sample_time"] * float(random.choice([0.5, 1.0, 1.7]))
    if random.random() < 0.5:
        controller["torque_limit"] = float(10 ** random.uniform(-1, 1.5))
    return controller
