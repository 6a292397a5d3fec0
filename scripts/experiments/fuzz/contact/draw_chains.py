"""Pendulum chains, closed chains and jammed chains with stops and friction, from the suite's random mechanisms."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ckc_pin
from ckc_pin.kinematics.sigma import sigma
from ckc_pin.mechanism import Mechanism
from scripts.experiments.fuzz.build import Builder
from scripts.experiments.fuzz.contact.cases import RTOL, Case, choose_restitutions, mass_ratio
from scripts.experiments.fuzz.contact.stops import Contact
from scripts.experiments.fuzz.mechanisms import random_mechanism
from scripts.experiments.fuzz.spatial import Array, rotation
from scripts.experiments.mechanism_files import toml_value

__all__ = ["draw_closed", "draw_jammed", "draw_pendulums"]

CLOSED_DURATION = 0.3  # s at a size of 1 m, times sqrt(size)


def draw_pendulums(seed: int, random: np.random.Generator) -> Case:
    """Draw a serial chain of one to four links, planar or spatial."""
    builder = Builder(random, "pendulums")
    down = random.normal(size=3)
    builder.gravity = 9.81 * down / np.linalg.norm(down) * (random.random() < 0.8)
    plane_normal = rotation(random.normal(size=(1, 3)))[0][2] if random.random() < 0.6 else None
    count = int(random.integers(1, 5))
    parent = "base"
    for k, ratio in enumerate(mass_ratio(random, count)):
        axis = plane_normal if plane_normal is not None else builder.random_vector(1.0)
        at = builder.random_vector(0.6, plane_normal) if k else np.zeros(3)
        parent = builder.add_joint(f"a{k + 1}", "continuous", parent, at, axis / np.linalg.norm(axis), plane_normal)
        part = builder.parts[-1]
        part.inertia, part.mass = part.inertia * ratio / part.mass, float(ratio)
    return _draw(seed, random, "pendulums", builder.to_files(), 0.6)


def draw_closed(seed: int, random: np.random.Generator) -> Case:
    """Draw a closed chain of any kind of the suite, without dampers. Loops may prevent some joints from moving."""
    texts = _random_closed(seed, random)
    return _draw(seed, random, "closed chains", texts, CLOSED_DURATION)


def draw_jammed(seed: int, random: np.random.Generator) -> Case:
    """Draw a closed chain with one freedom that is jammed by two stops, with a non-zero initial rate."""
    for attempt in range(200):
        texts = _random_closed(seed * 1000 + attempt, random)
        mechanism = _loaded(texts)
        if mechanism is None or mechanism.d != 1 or mechanism.independent_root_coordinates:
            continue
        _, _, Vt = np.linalg.svd(mechanism.assembled.J)
        rates = Vt[-1] / mechanism.tree.step_scale
        moving = np.flatnonzero(np.abs(rates) > 0.05 * np.abs(rates).max())
        moving = moving[[mechanism.coordinates[k] not in mechanism.tree.free_coordinates for k in moving]]
        if len(moving) < 2:
            continue
        numbers = mechanism.tree.to_coordinates(mechanism.q_tree)
        e, contacts = choose_restitutions(random, 2), {}
        for k, way, restitution in zip(random.choice(moving, 2, replace=False), (1, -1), e, strict=True):
            at, blocks_above = float(numbers[k]), way * rates[k] > 0
            limits = (-np.inf, at) if blocks_above else (at, np.inf)
            contacts[mechanism.coordinates[k]] = Contact(0.0, *limits, restitution)
        rate = {mechanism.independent[0]: float(random.choice([-1, 1]) * random.uniform(0.2, 3))}
        overrides = _overrides(mechanism, rate, 0.05)
        return Case(seed, "jammed chains", texts, contacts, overrides, jammed=True)
    raise RuntimeError(f"seed {seed}: none of 200 mechanisms has one freedom and two moving joints")


def _random_closed(seed: int, random: np.random.Generator) -> dict[str, str]:
    texts = dict(random_mechanism(seed).texts)
    texts["mechanism.toml"] = re.sub(r"^damping = .*\n", "", texts["mechanism.toml"], flags=re.M)
    if random.random() < 0.3:
        texts["tree.urdf"] = _scale_masses(texts["tree.urdf"], random)
    return texts


def _scale_masses(urdf: str, random: np.random.Generator) -> str:
    """Multiply the inertia of each link by a factor from 1 to 1e4."""

    def scaled(link: re.Match[str]) -> str:
        factor = float(10 ** random.uniform(0, 4))

        def times(number: re.Match[str]) -> str:
            return f'{number[1]}="{float(number[2]) * factor!r}"'

        return re.sub(r'\b(value|i[xyz]{2})="([^"]+)"', times, link[0])

    return re.sub(r"<inertial>.*?</inertial>", scaled, urdf, flags=re.S)


def _loaded(texts: Mapping[str, str]) -> Mechanism | None:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in texts.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        try:
            return ckc_pin.load(folder)
        except ckc_pin.CkcError:
            return None


def _overrides(mechanism: Mechanism, rates: Mapping[str, float], duration: float) -> dict[str, Any]:
    pace = float(np.sqrt(mechanism.size))
    return {
        "t_end": duration * pace,
        "solver.rtol": RTOL,
        "solver.output_dt": duration * pace / 50,
        "initial": {"at": "assembled", "q_dot": dict(rates)},
    }


def _draw(seed: int, random: np.random.Generator, kind: str, texts: dict[str, str], duration: float) -> Case:
    """Add friction to joints of a mechanism, and stops close to their coordinates, one in five without a gap."""
    mechanism = _loaded(texts)
    if mechanism is None:
        return Case(seed, kind, texts, {}, {"t_end": 0.01, "solver.rtol": RTOL, "initial": {"at": "assembled"}})
    tree, reach = mechanism.tree, mechanism.tree.step_scale
    numbers = tree.to_coordinates(mechanism.q_tree)
    size = np.abs(ckc_pin.Terms(mechanism, mechanism.assembled, np.zeros(mechanism.n)).h_tree)
    size = np.where(size > 1e-9 * size.max(), size, size.max()) if size.any() else np.ones(mechanism.n)
    names = [name for name in tree.index if name not in tree.free_coordinates]
    e = choose_restitutions(random, len(names))
    friction_share, stops = random.choice([0.0, 0.0, 0.3, 0.8]), random.choice([0.3, 0.6, 1.0])
    contacts = {}
    for name, restitution in zip(names, e, strict=True):
        k = tree.index[name]
        friction = float(size[k] * 10 ** random.uniform(-2, 0)) if random.random() < friction_share else 0.0
        lower, upper = -np.inf, np.inf
        if random.random() < stops:
            below, above = random.uniform(0.01, 0.3, 2) * reach[k]
            if random.random() < 0.2:
                below, above = random.permutation([0.0, above])
            lower, upper = float(numbers[k] - below), float(numbers[k] + above)
        if friction or np.isfinite(lower):
            contacts[name] = Contact(friction, lower, upper, restitution)
    pace = np.sqrt(mechanism.size)
    rates = {
        name: float(random.normal() * random.choice([0.0, 1.0, 1.0]) * reach[tree.index[name]] / pace)
        for name in mechanism.independent
    }
    overrides = _overrides(mechanism, rates, duration)
    conservative = True
    if not mechanism.independent_root_coordinates and not mechanism.splits_root and random.random() < 0.12:
        texts = _with_motors(texts, mechanism, random, size)
        overrides["controller"] = _controller(mechanism, random, size)
        conservative = False
    return Case(seed, kind, texts, contacts, overrides, conservative=conservative)


def _controller(mechanism: Mechanism, random: np.random.Generator, size: Array) -> dict[str, Any]:
    """Draw a set-point controller whose torques are often at their limits."""
    here = mechanism.independent_part(mechanism.q_tree)
    for attempt in range(12):  # closer with each attempt
        there = here + random.uniform(-0.5, 0.5, mechanism.d) * 0.6**attempt
        if sigma(mechanism, there).verdict == "converged":
            break
    target = dict(zip(mechanism.independent, there.tolist(), strict=True))
    gain = float(size.max() * 10 ** random.uniform(-1, 1))
    controller: dict[str, Any] = {"type": "set_point", "q_d": target, "K_P": gain, "K_V": 0.1 * gain}
    controller["torque_limit"] = float(size.max() * 10 ** random.uniform(-1, 0.3))
    if random.random() < 0.5:
        controller["sample_time"] = float(10 ** random.uniform(-2.3, -1.7))
    return controller


def _with_motors(
    texts: Mapping[str, str], mechanism: Mechanism, random: np.random.Generator, size: Array
) -> dict[str, str]:
    """Add motors with torque limits to the independent joints, in half of the cases."""
    if random.random() < 0.5:
        return dict(texts)
    tables = "".join(
        "\n[[motor]]\n"
        + "".join(f"{key} = {toml_value(value)}\n" for key, value in {
            "joint": name, "ratio": float(random.uniform(1, 20)),
            "torque_limit": float(size.max() * 10 ** random.uniform(-2, 0)),
        }.items())
        for name in mechanism.independent
    )  # fmt: skip
    return {**texts, "mechanism.toml": texts["mechanism.toml"] + tables}
