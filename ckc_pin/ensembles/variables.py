"""Variables of a sweep: their names, and reproducible values for each member."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from io import StringIO

import numpy as np

from ckc_pin.base.arrays import Array, IntArray
from ckc_pin.base.sources import Sources
from ckc_pin.ensembles.spec import KINDS, MAX_MEMBERS, GridSpec, SweepSpec, VariableSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameters import AXES, Value, is_parameter, require_known, values_of, with_components
from ckc_pin.scene.scene import Scene

__all__ = ["Variables", "check_variable_names"]

BLOCK_SIZE = 1024  # members that one stream of random numbers serves
MAX_LHS_MEMBERS = 10_000_000  # a Latin hypercube needs a complete permutation of all members for each variable
ValuesByPoint = Callable[[IntArray], Array]

CROSSED = ("grid", "list", "file")
START_PREFIXES = ("initial.q.", "initial.q_dot.")


# --- values ----------------------------------------------------------------------------------------


class Variables:
    """Variables of a sweep and their values by member, which do not depend on chunks or order.

    Grids, lists and the rows of a file are crossed with each other. The last one named varies fastest. `members` is the
    number of members at each of their points, or of all members without them.

    Parameters
    ----------
    spec : SweepSpec
    sources : Sources
        For files of values.

    Raises
    ------
    InputError
        The number of members is missing or too large, or a file lacks the column of a variable.
    """

    def __init__(self, spec: SweepSpec, sources: Sources) -> None:
        self.names = tuple(spec.variables)
        self._specs: Mapping[str, VariableSpec] = spec.variables
        self._seed = spec.seed
        self._axes = self._create_axes(sources)
        self._random = [name for name in self.names if spec.variables[name].kind not in CROSSED]
        points = math.prod(size for size, _ in self._axes)
        if self._random and spec.members is None:
            raise InputError(f"{sources.name}: members is missing; give a number, because {self._random[0]} is random")
        self._members_per_point = spec.members or 1
        self.count = points * self._members_per_point
        if self.count > MAX_MEMBERS:
            raise InputError(f"{sources.name}: {self.count} members; expected at most {MAX_MEMBERS}")
        if self._names_of("lhs") and self.count > MAX_LHS_MEMBERS:
            raise InputError(
                f"{sources.name}: {self.count} members of a Latin hypercube; expected at most {MAX_LHS_MEMBERS}, use "
                "sobol instead"
            )

    def values(self, first: int, end: int) -> Array:
        """Return values of the members from `first` up to `end`, shape (members, variables)."""
        member = np.arange(first, end)
        values = np.empty((len(member), len(self.names)))
        columns = {**self._cross(member // self._members_per_point), **self._draw_random(first, end)}
        for k, name in enumerate(self.names):
            values[:, k] = columns[name]
        return values

    def _names_of(self, kind: str) -> list[str]:
        return [name for name in self.names if self._specs[name].kind == kind]

    def _create_axes(self, sources: Sources) -> list[tuple[int, dict[str, ValuesByPoint]]]:
        """Return the axes that are crossed: their size, and the values of their variables, several for a file."""
        axes: list[tuple[int, dict[str, ValuesByPoint]]] = []
        files: dict[str, dict[str, ValuesByPoint]] = {}
        for name, spec in self._specs.items():
            if spec.grid is not None:
                axes.append((spec.grid.count, {name: partial(_evaluate_grid, spec.grid)}))
            elif spec.values is not None:
                axes.append((len(spec.values), {name: np.array(spec.values, dtype=float).__getitem__}))
            elif spec.file is not None:
                column = _read_column(sources, spec.file, name)
                if spec.file not in files:
                    files[spec.file] = {}
                    axes.append((len(column), files[spec.file]))
                files[spec.file][name] = column.__getitem__
        return axes

    def _cross(self, point: IntArray) -> dict[str, Array]:
        columns: dict[str, Array] = {}
        for size, axis in reversed(self._axes):
            columns |= {name: values(point % size) for name, values in axis.items()}
            point = point // size
        return columns

    def _draw_random(self, first: int, end: int) -> dict[str, Array]:
        columns: dict[str, Array] = {}
        for k, name in enumerate(self._random):
            spec = self._specs[name]
            if spec.kind in ("uniform", "loguniform", "normal", "lognormal"):
                columns[name] = self._draw_independent(k, spec, first, end)
        for kind, draw_unit in (("sobol", self._draw_sobol), ("lhs", self._draw_hypercube)):
            names = self._names_of(kind)
            if names:
                unit = draw_unit(first, end)
                for k, name in enumerate(names):
                    low, high = getattr(self._specs[name], kind)
                    columns[name] = low + (high - low) * unit[:, k]
        return columns

    def _draw_independent(self, k: int, spec: VariableSpec, first: int, end: int) -> Array:
        parts = []
        for block in range(first // BLOCK_SIZE, (end - 1) // BLOCK_SIZE + 1):
            random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(k, block)))
            values = _draw_block(spec, random)
            parts.append(values[max(first - block * BLOCK_SIZE, 0) : min(end - block * BLOCK_SIZE, BLOCK_SIZE)])
        return np.concatenate(parts)

    def _draw_sobol(self, first: int, end: int) -> Array:
        from scipy.stats import qmc

        sequence = qmc.Sobol(len(self._names_of("sobol")), scramble=True, rng=np.random.default_rng(self._seed))
        if first:
            sequence.fast_forward(first)
            return sequence.random(end - first)
        # The first point is drawn separately, because SciPy warns of a first draw that is not a power of 2.
        return np.concatenate([sequence.random(1), sequence.random(end - 1)])

    def _draw_hypercube(self, first: int, end: int) -> Array:
        return self._complete_hypercube[first:end]

    @cached_property
    def _complete_hypercube(self) -> Array:
        from scipy.stats import qmc

        return qmc.LatinHypercube(len(self._names_of("lhs")), rng=np.random.default_rng(self._seed)).random(self.count)


def _evaluate_grid(grid: GridSpec, point: IntArray) -> Array:
    """Return the values of some points as `numpy.linspace` does, for grids that do not fit into memory."""
    step = (grid.stop - grid.start) / max(grid.count - 1, 1)
    inner = point * step + grid.start
    return np.where((point == grid.count - 1) & (grid.count > 1), grid.stop, inner)


def _draw_block(spec: VariableSpec, random: np.random.Generator) -> Array:
    """Draw a complete block, so that a member's value does not depend on the other members of a request."""
    a, b = getattr(spec, spec.kind)
    if spec.kind == "uniform":
        return random.uniform(a, b, BLOCK_SIZE)
    if spec.kind == "loguniform":
        return np.exp(random.uniform(math.log(a), math.log(b), BLOCK_SIZE))
    normal = a + b * random.standard_normal(BLOCK_SIZE)
    return normal if spec.kind == "normal" else np.exp(normal)


def _read_column(sources: Sources, file: str, name: str) -> Array:
    """Return the column of a variable in a CSV file (InputError)."""
    rows = list(csv.reader(StringIO(sources.text(file))))
    header = [cell.strip() for cell in rows[0]] if rows else []
    where = f"{sources.name}: {file}"
    if name not in header:
        raise InputError(f"{where}: no column {name!r}; there are {', '.join(header) or 'none'}")
    column, values = header.index(name), []
    for k, row in enumerate(rows[1:], 2):
        if not row:
            continue
        try:
            values.append(float(row[column]))
        except (IndexError, ValueError):
            raise InputError(f"{where}: line {k}: {name}: expected a number") from None
        if not math.isfinite(values[-1]):
            raise InputError(f"{where}: line {k}: {name}: {row[column].strip()} is not a finite number")
    if not values:
        raise InputError(f"{where}: no rows below the header; give at least one")
    return np.array(values)


# --- names -----------------------------------------------------------------------------------------


def check_variable_names(scene: Scene, mechanism: Mechanism, names: tuple[str, ...]) -> dict[str, tuple[str, int]]:
    """Check that variables are parameters of the mechanism or numbers of the scene.

    Returns
    -------
    dict of str to (str, int)
        Vector and axis of each variable that is a component of a vector which the scene overrides.

    Raises
    ------
    InputError
        An unknown name, a vector, or a key of the scene that is not a number.
    """
    present = values_of(mechanism.spec, mechanism.urdf)
    for name in names:
        _require_known_distribution(scene, mechanism, present, name)
    parameters = [name for name in names if is_parameter(name)]
    require_known(parameters, with_components(present), f"{scene.name}: variables")
    vectors: dict[str, tuple[str, int]] = {}
    for name in names:
        if name in present and isinstance(present[name], tuple):
            raise InputError(f"{scene.name}: variables: {name} has three numbers: vary {name}.x, .y or .z")
        vector, _, axis = name.rpartition(".")
        if is_parameter(name) and name not in present and vector in scene.spec.parameters:
            vectors[name] = (vector, AXES.index(axis))
    for name in names:
        if not is_parameter(name):
            _require_number_of_scene(scene, mechanism, name)
    return vectors


def _require_known_distribution(scene: Scene, mechanism: Mechanism, present: Mapping[str, Value], name: str) -> None:
    """Refuse the name of a number with one more part: an unknown distribution, which TOML reads as a table."""
    number, _, kind = name.rpartition(".")
    vector, _, axis = number.rpartition(".")
    is_number = not isinstance(present[number], tuple) if number in present else vector in present and axis in AXES
    start = next((number.removeprefix(x) for x in START_PREFIXES if number.startswith(x)), "")
    if is_number or start in mechanism.coordinates:
        raise InputError(f"{scene.name}: variables: {number}: unknown key {kind!r}; valid: {', '.join(KINDS)}")


def _require_number_of_scene(scene: Scene, mechanism: Mechanism, name: str) -> None:
    """Refuse a key of the scene that does not take a number (InputError)."""
    for prefix, names in zip(START_PREFIXES, (mechanism.coordinates, mechanism.independent), strict=True):
        if name.startswith(prefix):
            if name.removeprefix(prefix) not in names:
                raise InputError(f"{scene.name}: variables: {name!r}: no such coordinate; there are {', '.join(names)}")
            scene.with_overrides({name: 1.0})  # rejects the same starts as a single run
            return
    try:
        scene.with_overrides({name: 1})
    except InputError as error:
        # A message about the range of a number shows that the key takes one.
        if "greater than" in str(error) or "at least" in str(error) or "less than" in str(error):
            return
        raise InputError(f"variables: {name!r} is not a number of the scene: {error}") from None
