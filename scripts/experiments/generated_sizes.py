"""Benchmark of compiled terms by size of the mechanism: length of the C text, compile time, speed-up, break-even.

A row of N squares has 2 N + 1 coordinates in branches of two at most. Shipped mechanisms have longer branches. A ring
of n hinges in space is one branch and has the longest text of all mechanisms with n coordinates. Compile times are
processor times; times of right-hand sides are the minimum of many.
"""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.codegen.library import Library, compile_terms
from ckc_pin.codegen.term_functions import TermFunctions
from ckc_pin.errors import InputError
from ckc_pin.run.prepare import prepare
from ckc_pin.scene.parts import load_scene_mechanism
from ckc_pin.scene.scene import load_scene
from scripts.experiments.benchmark.growth import ROUNDS, Case, motion, write_case

__all__ = ["NAMES", "Size", "main", "measure"]

SQUARES = ("1", "2", "4", "8", "11", "16", "24", "32", "48", "64")
NAMES = (
    *SQUARES,
    "five_bar",
    "two_ur5",
    "delta",
    "stewart",
    "talos",
    "ring_12",
    "ring_24",
    "ring_36",
    "ring_40",
    "ring_48",
)
REPEATS = 5
SIDE, AXES = 0.2, ("0 0 1", "1 0 0", "0 1 0")  # of the ring: length of a link, m; axes of the hinges in turn


@dataclass(frozen=True)
class Size:
    """Measurements of one mechanism.

    Attributes
    ----------
    name : str
        Name of a shipped mechanism, number N of squares, or ring_n.
    n, operations, bytes : int
        Coordinates; operations of an acceleration; length of the C text.
    expressions_s, compile_s : float
        Time to write the C text; time of everything that `ckc compile` does.
    compiled_rhs_s, pinocchio_rhs_s : float
        Time of a right-hand side of the DAE with compiled terms, and with Pinocchio's.
    reason : str
        Why there are no times; empty otherwise.
    """

    name: str
    n: int
    operations: int
    bytes: int
    expressions_s: float
    compile_s: float
    compiled_rhs_s: float = 0.0
    pinocchio_rhs_s: float = 0.0
    reason: str = ""

    @property
    def repaid(self) -> float:
        """Number of right-hand sides after which compiling has saved the time that it took."""
        return self.compile_s / (self.pinocchio_rhs_s - self.compiled_rhs_s)

    def row(self) -> str:
        """Return the line of the Markdown table."""
        start = (
            f"| {self.name} | {self.n} | {self.operations:,} | {self.bytes / 1e3:,.0f} | {self.expressions_s:.2f} | "
            f"{self.compile_s:.1f} |"
        )
        if self.reason:
            return f"{start} {self.reason} | | | |"
        gain = self.pinocchio_rhs_s / self.compiled_rhs_s
        times_us = f"{1e6 * self.compiled_rhs_s:.2f} | {1e6 * self.pinocchio_rhs_s:.2f}"
        return f"{start} {times_us} | {gain:.1f} | {self.repaid:.1e} |"


def measure(name: str) -> Size:
    """Write, compile and time the terms of one mechanism: a shipped name, a number of squares, or ring_n."""
    with tempfile.TemporaryDirectory() as folder, empty_cache(Path(folder) / "cache"):
        scene = _scene(name, Path(folder))
        mechanism = load_scene_mechanism(load_scene(scene))
        began = _processor_seconds()
        functions = TermFunctions.of(mechanism)
        text = functions.c_source()
        expressions_s, began = _processor_seconds() - began, _processor_seconds()
        reason, library = "", None
        try:
            library = compile_terms(mechanism, limited=False)
        except InputError as error:
            reason = str(error)
        about = (
            mechanism.n,
            functions.functions["acceleration"].n_instructions(),
            len(text),
            expressions_s,
            _processor_seconds() - began,
        )
        if library is None:
            return Size(name, *about, reason=reason)
        return Size(name, *about, _rhs_s(scene, library), _rhs_s(scene, None))


def _scene(name: str, folder: Path) -> str:
    if name.isdigit():
        return str(write_case(Case(int(name), int(name)), folder))
    kind, _, number = name.partition("_")
    return str(ring(int(number), folder)) if kind == "ring" and number.isdigit() else f"{name}/default"


def ring(n: int, folder: Path) -> Path:
    """Write a ring of n links, a regular polygon with hinges about z, x, y in turn; return the path of its scene."""
    inertia = '<inertia ixx="0.01" iyy="0.011" izz="0.012" ixy="0.001" ixz="0.0005" iyz="0.0007"/>'
    parts = ['<link name="base"/>']
    for k in range(n):
        parent, at, turn = ("base", 0.0, 0.0) if k == 0 else (f"link_{k - 1}", SIDE, 2 * pi / n)
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="0.1 0.01 0.02"/><mass value="1"/>{inertia}</inertial></link>'
            f'<joint name="hinge_{k}" type="continuous"><parent link="{parent}"/><child link="link_{k}"/>'
            f'<origin xyz="{at} 0 0" rpy="0 0 {turn}"/><axis xyz="{AXES[k % 3]}"/></joint>'
        )
    (folder / "ring.urdf").write_text(f'<robot name="ring">{"".join(parts)}</robot>', encoding="utf-8")
    (folder / "mechanism.toml").write_text(
        f'name = "ring_{n}"\nurdf = "ring.urdf"\n[[loop]]\nname = "closes"\ntype = "point"\n'
        f'frame_a = {{link = "link_{n - 1}", xyz = [{SIDE}, 0.0, 0.0]}}\nframe_b = "world"\n',
        encoding="utf-8",
    )
    scene = folder / "ring.scene.toml"
    text = 'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = 1.0\ninitial.at = "assembled"\n'
    scene.write_text(text, encoding="utf-8")
    return scene


def _rhs_s(scene: str, library: Library | None) -> float:
    overrides: dict[str, Any] = {"formulation": "dae", "solver.method": "DOP853", "solver.terms": "pinocchio"}
    ready = prepare(load_scene(scene, overrides), free=True, library=library)
    ready.begin()
    states = motion(ready.loop)
    return min(float(ready.loop.seconds(states, ROUNDS)) for _ in range(REPEATS))


def _processor_seconds() -> float:
    """Return the processor time of this process and of its finished compilers, s."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


@contextmanager
def empty_cache(folder: Path) -> Iterator[None]:
    """Use a new folder as the cache of compiled terms instead of the user's cache."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(folder)
    try:
        yield
    finally:
        del os.environ["XDG_CACHE_HOME"]
        if before is not None:
            os.environ["XDG_CACHE_HOME"] = before


def main(names: Sequence[str] = ()) -> None:
    """Print a Markdown table of shipped mechanisms, rows of squares and rings."""
    print("| N or name | n | operations | text, kB | expressions, s | compiled, s | written, µs | general, µs | gain |"
          " repaid after |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")  # fmt: skip
    with one_blas_thread():
        for name in names or NAMES:
            print(measure(name).row(), flush=True)
