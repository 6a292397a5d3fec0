"""The values of the variables of each member: the same whatever the chunks, in any order, from a seed."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from io import StringIO

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.sources import Sources
from ckc_pin.ensembles.spec import MOST, GridSpec, SweepSpec, VariableSpec
from ckc_pin.errors import InputError

__all__ = ["Variables"]

BLOCK = 1024  # members that one stream of random numbers serves
MOST_LHS = 10_000_000  # members of a Latin hypercube, which is one whole permutation a variable
ByPoint = Callable[[IntArray], Array]

CROSSED = ("grid", "list", "file")


class Variables:
    """Variables of a sweep, and their values by member.

    Grids, lists and the rows of a file are crossed with each other, the last one named changing fastest; `members` says
    how many members there are at each of their points, or in all where there are none.

    Parameters
    ----------
    spec : SweepSpec
    sources : Sources
        For files of values.

    Raises
    ------
    InputError
        A number of members that is missing, or too large; a file without the variable's column.
    """

    def __init__(self, spec: SweepSpec, sources: Sources) -> None:
        self.names = tuple(spec.variables)
        self._specs: Mapping[str, VariableSpec] = spec.variables
        self._seed, self._source = spec.seed, sources.name
        self._axes = self._crossed(sources)
        self._random = [name for name in self.names if spec.variables[name].kind not in CROSSED]
        points = math.prod(size for size, _ in self._axes)
        if self._random and spec.members is None:
            raise InputError(f"{sources.name}: members: say how many; {self._random[0]} is drawn at random")
        self._each = spec.members or 1
        self.count = points * self._each
        if self.count > MOST:
            raise InputError(f"{sources.name}: {self.count} members; at most {MOST}")
        if self._of("lhs") and self.count > MOST_LHS:
            raise InputError(
                f"{sources.name}: {self.count} members of a Latin hypercube; at most {MOST_LHS}: take sobol"
            )

    def values(self, first: int, end: int) -> Array:
        """Return values of the members from `first` up to `end`, shape (members, variables)."""
        member = np.arange(first, end)
        found = np.empty((len(member), len(self.names)))
        columns = {**self._points(member // self._each), **self._drawn(first, end)}
        for k, name in enumerate(self.names):
            found[:, k] = columns[name]
        return found

    def _of(self, kind: str) -> list[str]:
        return [name for name in self.names if self._specs[name].kind == kind]

    def _crossed(self, sources: Sources) -> list[tuple[int, dict[str, ByPoint]]]:
        """What is crossed: how many points, and values by variable, several where they are columns of one file."""
        axes: list[tuple[int, dict[str, ByPoint]]] = []
        files: dict[str, dict[str, ByPoint]] = {}
        for name, spec in self._specs.items():
            if spec.grid is not None:
                axes.append((spec.grid.count, {name: partial(_on_grid, spec.grid)}))
            elif spec.values is not None:
                axes.append((len(spec.values), {name: np.array(spec.values, dtype=float).__getitem__}))
            elif spec.file is not None:
                column = _column(sources, spec.file, name)
                if spec.file not in files:
                    files[spec.file] = {}
                    axes.append((len(column), files[spec.file]))
                files[spec.file][name] = column.__getitem__
        return axes

    def _points(self, point: IntArray) -> dict[str, Array]:
        found: dict[str, Array] = {}
        for size, axis in reversed(self._axes):
            found |= {name: values(point % size) for name, values in axis.items()}
            point = point // size
        return found

    def _drawn(self, first: int, end: int) -> dict[str, Array]:
        found: dict[str, Array] = {}
        for k, name in enumerate(self._random):
            spec = self._specs[name]
            if spec.kind in ("uniform", "loguniform", "normal", "lognormal"):
                found[name] = self._independent(k, spec, first, end)
        for kind, unit in (("sobol", self._sobol), ("lhs", self._hypercube)):
            names = self._of(kind)
            if names:
                columns = unit(first, end)
                for k, name in enumerate(names):
                    low, high = getattr(self._specs[name], kind)
                    found[name] = low + (high - low) * columns[:, k]
        return found

    def _independent(self, k: int, spec: VariableSpec, first: int, end: int) -> Array:
        parts = []
        for block in range(first // BLOCK, (end - 1) // BLOCK + 1):
            random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(k, block)))
            drawn = _draw(spec, random)
            parts.append(drawn[max(first - block * BLOCK, 0) : min(end - block * BLOCK, BLOCK)])
        return np.concatenate(parts)

    def _sobol(self, first: int, end: int) -> Array:
        from scipy.stats import qmc

        sequence = qmc.Sobol(len(self._of("sobol")), scramble=True, rng=np.random.default_rng(self._seed))
        if first:
            sequence.fast_forward(first)
            return sequence.random(end - first)
        # the first point by itself: SciPy warns of beginnings that are no power of 2
        return np.concatenate([sequence.random(1), sequence.random(end - 1)])

    def _hypercube(self, first: int, end: int) -> Array:
        return self._whole_hypercube[first:end]

    @cached_property
    def _whole_hypercube(self) -> Array:
        from scipy.stats import qmc

        return qmc.LatinHypercube(len(self._of("lhs")), rng=np.random.default_rng(self._seed)).random(self.count)


def _on_grid(grid: GridSpec, point: IntArray) -> Array:
    """Return the values of some points, as `numpy.linspace` has them: a grid may have more than memory holds."""
    step = (grid.stop - grid.start) / max(grid.count - 1, 1)
    inner = point * step + grid.start
    return np.where((point == grid.count - 1) & (grid.count > 1), grid.stop, inner)


def _draw(spec: VariableSpec, random: np.random.Generator) -> Array:
    """Draw a whole block, so that a member's number does not depend on who else is asked for."""
    a, b = getattr(spec, spec.kind)
    if spec.kind == "uniform":
        return random.uniform(a, b, BLOCK)
    if spec.kind == "loguniform":
        return np.exp(random.uniform(math.log(a), math.log(b), BLOCK))
    normal = a + b * random.standard_normal(BLOCK)
    return normal if spec.kind == "normal" else np.exp(normal)


def _column(sources: Sources, file: str, name: str) -> Array:
    rows = list(csv.reader(StringIO(sources.text(file))))
    header = [cell.strip() for cell in rows[0]] if rows else []
    where = f"{sources.name}: {file}"
    if name not in header:
        raise InputError(f"{where}: no column {name!r}; there are {', '.join(header) or 'none'}")
    at, values = header.index(name), []
    for k, row in enumerate(rows[1:], 2):
        if not row:
            continue
        try:
            values.append(float(row[at]))
        except (IndexError, ValueError):
            raise InputError(f"{where}: line {k}: {name}: expected a number") from None
        if not math.isfinite(values[-1]):
            raise InputError(f"{where}: line {k}: {name}: {row[at].strip()} is not a finite number")
    if not values:
        raise InputError(f"{where}: no rows")
    return np.array(values)
