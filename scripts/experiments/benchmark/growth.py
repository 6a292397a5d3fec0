"""Measure how cost grows with the number of squares in a row, of freedoms and of loops.

The closed row of N squares has one freedom. With only its first loop closed, the freedoms grow with N. Closing the
loops one by one lets the loops grow with fixed coordinates. Each case counts right-hand sides and times one of them.
Exponents are fitted on log-log scales.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import CkcError
from ckc_pin.mechanism.library import GeneratorSpec, generate
from ckc_pin.run.prepare import prepare
from ckc_pin.run.simulate import run_prepared
from ckc_pin.scene.scene import load_scene

__all__ = [
    "FAMILIES",
    "FORMULATIONS",
    "Case",
    "Family",
    "Growth",
    "every_case",
    "exponent",
    "measure",
    "motion",
    "write_case",
]

RTOL, T_END = 1e-10, 0.4  # s: ends before the row lies flat
LEAN = 1.2  # rad: initial lean of the squares, since upright squares are in equilibrium
FORMULATIONS: dict[str, dict[str, Any]] = {
    "dae": {"formulation": "dae"},
    "reduced": {"formulation": "reduced"},
    "spf, z": {"formulation": "spf", "epsilon": 1e-2, "spf_coordinates": "z"},
}
BUDGET = 60.0  # s, for the run that counts right-hand sides
STATES, SPACING = 20, 1e-4  # number of states at which a right-hand side is timed, and s between them
ROUNDS = 20  # repetitions over the states; the minimum time counts


@dataclass(frozen=True)
class Case:
    """A row of N squares with its first `loops` loops closed."""

    N: int
    loops: int

    @property
    def d(self) -> int:
        """Number of freedoms: 2 N + 1 coordinates less two rows per loop."""
        return 2 * self.N + 1 - 2 * self.loops


@dataclass(frozen=True)
class Family:
    """Cases along which one quantity grows.

    Attributes
    ----------
    key, says : str
    along : "N", "d" or "loops"
    cases, quick : tuple of Case
    """

    key: str
    says: str
    along: str
    cases: tuple[Case, ...]
    quick: tuple[Case, ...]


def _family(key: str, says: str, along: str, cases: Sequence[tuple[int, int]], quick: int) -> Family:
    members = tuple(Case(N, loops) for N, loops in cases)
    return Family(key, says, along, members, members[:quick])


WIDE = 20
FAMILIES = (
    _family("N", "N squares in a row, one freedom", "N", [(N, N) for N in (1, 2, 4, 8, 16, 40, 80, 160)], 6),
    _family("d", "freedoms d, one loop", "d", [(N, 1) for N in (1, 2, 4, 8, 16, 32, 50)], 5),
    _family("loops", f"loops on {2 * WIDE + 1} coordinates", "loops", [(WIDE, k) for k in (1, 2, 4, 8, 14, 20)], 6),
)


@dataclass(frozen=True)
class Growth:
    """Measurement of one case in one formulation.

    Attributes
    ----------
    family, formulation : str
    x : int
        Value of the quantity that grows along the family.
    rhs_s : float or None
        Time of a right-hand side, s.
    rhs : int or None
        Number of right-hand sides of a run of 0.4 s at rtol 1e-10 by DOP853.
    reason : str
        Why a value is missing; empty otherwise.
    """

    family: str
    formulation: str
    x: int
    rhs_s: float | None = None
    rhs: int | None = None
    reason: str = ""


def measure(case: Case, family: Family, formulation: str, overrides: Mapping[str, Any] | None = None) -> Growth:
    """Time a right-hand side of a case and count those of a run, with Pinocchio's terms, which every size has."""
    row = Growth(family.key, formulation, getattr(case, family.along))
    scene_overrides = {
        **FORMULATIONS[formulation],
        "solver.method": "DOP853",
        "solver.terms": "pinocchio",
        **(overrides or {}),
    }
    try:
        with tempfile.TemporaryDirectory() as folder:
            ready = prepare(load_scene(write_case(case, Path(folder)), scene_overrides))
        ready.begin()
        rhs_s = float(ready.loop.seconds(motion(ready.loop), ROUNDS))
        run = run_prepared(ready)
    except CkcError as error:
        return replace(row, reason=str(error))
    if run.status != "done":
        return replace(row, rhs_s=rhs_s, reason=run.message)
    return replace(row, rhs_s=rhs_s, rhs=int(run.stats["rhs"]))


def write_case(case: Case, folder: Path) -> Path:
    """Write the files of a case; return the path of its scene."""
    text, sources = generate(GeneratorSpec(generator="n_four_bar", N=case.N))
    head, *loops = text.split("[[loop]]")
    *_, point = loops[-1].partition("# The first top pin.")
    kept = [loop.partition("# The first top pin.")[0] for loop in loops[: case.loops]]
    text = "[[loop]]".join([head, *kept]) + point
    text = re.sub(r"= (-?)1\.5707963267948966", rf"= \g<1>{LEAN}", text.replace('independent = ["theta_0"]\n', ""))
    (folder / "mechanism.toml").write_text(text, encoding="utf-8")
    for name, content in sources.available.items():
        (folder / name).write_text(content, encoding="utf-8")
    scene = folder / "row.scene.toml"
    scene.write_text(
        f'mechanism = "mechanism.toml"\nformulation = "dae"\nt_end = {T_END}\n[initial]\nat = "assembled"\n'
        f"[solver]\nrtol = {RTOL}\noutput_dt = {T_END}\nmax_wall_s = {BUDGET}\n",
        encoding="utf-8",
    )
    return scene


def motion(loop: Any) -> Array:
    """Return the first states of a started loop's motion by the midpoint rule, so that sigma needs corrections.

    Returns
    -------
    (STATES, 1 + len(y)) array
        Rows of t and y.
    """
    y, h, states = loop.y, SPACING, []
    for k in range(STATES):
        states.append([k * h, *y])
        y = y + h * loop.rhs((k + 0.5) * h, y + 0.5 * h * loop.rhs(k * h, y))
    return np.array(states)


def exponent(points: Mapping[float, float], whole: bool = False) -> float | None:
    """Fit y ~ x^p by least squares on log-log scales; None for fewer than three points.

    Parameters
    ----------
    points : mapping of x to y
        Positive.
    whole : bool
        Whether to fit over all x. By default only the upper half of their logarithmic range is used, where costs
        that do not grow have become small.
    """
    xs = np.array(sorted(points), dtype=float)
    if len(xs) and not whole:
        xs = xs[xs >= np.sqrt(xs[0] * xs[-1])]
    if len(xs) < 3:
        return None
    return float(np.polyfit(np.log(xs), np.log([points[x] for x in xs]), 1)[0])


def every_case(quick: bool) -> Iterator[tuple[Family, Case, str]]:
    """Yield family, case and formulation in the order of measurement."""
    for family in FAMILIES:
        for case in family.quick if quick else family.cases:
            for formulation in FORMULATIONS:
                yield family, case, formulation
