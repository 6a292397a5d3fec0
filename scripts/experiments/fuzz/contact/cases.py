"""Cases of random motions with stops, impacts and dry friction, drawn by kind from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments.fuzz.contact.stops import Contact, add_contacts

__all__ = ["Case", "Draw", "choose_restitutions", "mass_ratio"]

SCENE = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\n\n[initial]\nat = "assembled"\n'
RTOL = 1e-11


@dataclass(frozen=True)
class Case:
    """One motion and its expected properties.

    `texts` are the mechanism's files without stops and friction, as the references read them. `contacts` has the stops
    and friction by joint.
    """

    seed: int
    kind: str
    texts: dict[str, str]
    contacts: dict[str, Contact]
    overrides: dict[str, Any]  # of the scene
    conservative: bool = True  # only stops and friction change the energy
    linear: bool = False  # all links translate, so `slides.py` is an exact reference
    jammed: bool = False  # the stops prevent all motion after t = 0
    quiet: frozenset[str] = frozenset()  # joints without events after `quiet_after`
    quiet_after: float = 0.0
    compares_steps: bool = False  # stops and friction must not increase the number of steps

    def write(self, folder: Path, *, contacts: bool = True) -> Path:
        """Write the files to a folder, with stops and friction or without."""
        folder.mkdir(parents=True, exist_ok=True)
        files = add_contacts(self.texts, self.contacts) if contacts else self.texts
        for name, text in {**files, "default.scene.toml": SCENE}.items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder


Draw = Callable[[int, np.random.Generator], Case]


def mass_ratio(random: np.random.Generator, count: int) -> np.ndarray:
    """Return masses that are equal, powers of ten, or random, with ratios up to 1e4."""
    draw = random.random()
    if draw < 0.3:
        return np.full(count, float(random.choice([1.0, 1.0, random.uniform(0.1, 10)])))
    if draw < 0.5:
        return 10.0 ** random.integers(0, 5, count)
    return np.asarray(10 ** random.uniform(0, random.choice([1.0, 4.0]), count))


def choose_restitutions(random: np.random.Generator, count: int) -> list[float]:
    """Return restitutions from 0 to 1, often 0, 1 or all equal."""

    def choose() -> float:
        return float(random.choice([0.0, 1.0, 0.5, random.uniform(0, 1)], p=[0.3, 0.2, 0.15, 0.35]))

    if random.random() < 0.5:
        return [choose()] * count
    return [choose() for _ in range(count)]
