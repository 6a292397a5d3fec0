"""A sweep's file, `NAME.sweep.toml`, as a typed structure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert, join_dotted_keys, read_text, read_toml
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import is_path

__all__ = [
    "KINDS",
    "SUFFIX",
    "GridSpec",
    "OutputSpec",
    "Reduction",
    "SweepSpec",
    "VariableSpec",
    "read_sweep",
    "sweep_of",
]

SUFFIX = ".sweep.toml"
MOST = 10**9  # members

Pair = tuple[float, float]
Count = Annotated[int, msgspec.Meta(ge=1, le=MOST)]
Reduction = Literal["end", "min", "max", "max_abs", "mean", "rms", "integral", "trajectory"]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class GridSpec(_Spec, frozen=True):
    """Values at equal distances, both ends among them.

    Attributes
    ----------
    start : its own
        The first.
        ``start = -1.9``
    stop : its own
        The last.
        ``stop = 1.9``
    count
        How many.
        ``count = 41``
    """

    start: float
    stop: float
    count: Count


class VariableSpec(_Spec, frozen=True):
    """How one variable differs between members: one of the keys.

    Grids, lists and files are crossed with each other, the last one named changing fastest.

    Attributes
    ----------
    uniform : its own
        From, to.
        ``uniform = [-1.9, -0.9]``
    loguniform : its own
        From, to, both greater than 0: the logarithm is uniform.
        ``loguniform = [0.1, 10.0]``
    normal : its own
        Mean, standard deviation.
        ``normal = [0.2611, 0.01]``
    lognormal : of its logarithm
        Mean and standard deviation of the logarithm.
        ``lognormal = [0.0, 0.1]``
    sobol : its own
        From, to: a scrambled Sobol sequence over all variables of this kind; members in powers of 2 are balanced.
        ``sobol = [-1.9, -0.9]``
    lhs : its own
        From, to: a Latin hypercube over all variables of this kind.
        ``lhs = [-1.9, -0.9]``
    grid
        Values at equal distances.
        ``grid = {start = -1.9, stop = 1.9, count = 41}``
    list : its own
        Values.
        ``list = [0.2, 0.3, 0.5]``
    file
        A CSV file beside this one, whose first row names variables; those of one file go together, a row each.
        ``file = "starts.csv"``
    """

    uniform: Pair | None = None
    loguniform: Pair | None = None
    normal: Pair | None = None
    lognormal: Pair | None = None
    sobol: Pair | None = None
    lhs: Pair | None = None
    grid: GridSpec | None = None
    values: Annotated[list[float], msgspec.Meta(min_length=1)] | None = msgspec.field(default=None, name="list")
    file: str | None = None

    @property
    def kind(self) -> str:
        """Which key it has."""
        return self.given()[0]

    def given(self) -> list[str]:
        """Return the keys it has."""
        keys = zip(self.__struct_fields__, KINDS, strict=True)
        return [key for name, key in keys if getattr(self, name) is not None]


KINDS = VariableSpec.__struct_encode_fields__


class OutputSpec(_Spec, frozen=True):
    """A quantity of a run, and what is kept of it.

    Attributes
    ----------
    of
        A coordinate, ``q_tree``, ``v_tree``, ``u``, ``tau``, ``phi``, ``error`` (q - q_d), ``energy``,
        ``dissipated`` (NaN with ``friction_smoothing``), ``lyapunov``, ``t``; ``max_abs_u``, ``max_abs_tau``,
        ``max_phi``, ``energy_drift`` (largest change), ``settled`` (1 where everything rests at the end, if only to
        turn round, at q_d if there is one, 0 where not), ``event.NAME`` or ``event.K`` (when that was met first).
        ``of = "error"``
    reduce
        What is kept of it over the member's output instants; of those named after ``t`` nothing but themselves.
        ``reduce = "max_abs"``
    tolerance : rad, of the size
        Of ``settled``: of each coordinate and its rate.
        ``tolerance = 1e-4``
    """

    of: Annotated[str, msgspec.Meta(min_length=1)]
    reduce: Reduction = "end"
    tolerance: Annotated[float, msgspec.Meta(gt=0)] = 1e-3


class SweepSpec(_Spec, frozen=True):
    """The whole file.

    Attributes
    ----------
    scene
        A scene's shipped name, or its path beside this file.
        ``scene = "five_bar/swing"``
    variables
        By a parameter's name (see "parameters") or a scene's key: how it differs; a plain list is short for
        ``{list = ...}``.
        ``variables = {"link.link_2.mass" = {normal = [0.2611, 0.01]}}``
    outputs
        What is kept of each member, under names of yours; a string is short for ``{of = ...}``.
        ``outputs = {end = "q_tree", worst = {of = "error", reduce = "max_abs"}}``
    members
        How many, at each point of what is crossed; needed where something is drawn at random.
        ``members = 1000``
    seed
        Of what is drawn.
        ``seed = 1``
    overrides
        Of the scene, for all members, by dotted key.
        ``overrides = {t_end = 0.5, "solver.rtol" = 1e-6}``
    """

    scene: str
    variables: dict[str, VariableSpec]
    outputs: dict[str, str | OutputSpec]
    members: Count | None = None
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    overrides: dict[str, Any] = {}


def read_sweep(path: str | Path) -> tuple[SweepSpec, Sources]:
    """Read a sweep's file.

    Raises
    ------
    InputError
        No such file, malformed TOML, an unknown key, a wrong type or value.
    """
    path = Path(path)
    data = read_toml(read_text(path, "sweep"), str(path))
    join_dotted_keys(data, "overrides")
    return sweep_of(data, Sources(str(path), path.parent)), Sources(str(path), path.parent)


def sweep_of(data: dict[str, Any], sources: Sources) -> SweepSpec:
    """Check parsed data (InputError)."""
    if isinstance(data.get("variables"), dict):
        data["variables"] = dict(_variables("", data["variables"]))
    spec = convert(data, SweepSpec, sources.name)
    for name, variable in spec.variables.items():
        _check(name, variable, sources.name)
    if not spec.variables:
        raise InputError(f'{sources.name}: variables: name at least one, e.g. "initial.q.JOINT" = {{uniform = [a, b]}}')
    if not spec.outputs:
        raise InputError(f'{sources.name}: outputs: name at least one, e.g. end = "q_tree"')
    return spec


def scene_path(spec: SweepSpec, sources: Sources) -> str | Path:
    """Return the scene that a sweep names: beside its file where that is a path."""
    if sources.folder is not None and is_path(spec.scene):
        return sources.folder / spec.scene
    return spec.scene


def _variables(key: str, table: Mapping[str, Any]) -> Any:
    """Join tables into dotted names, down to those that say how a variable differs."""
    for name, value in table.items():
        if isinstance(value, dict) and value and not any(inner in KINDS for inner in value):
            yield from _variables(f"{key}{name}.", value)
        elif isinstance(value, list):
            yield f"{key}{name}", {"list": value}
        else:
            yield f"{key}{name}", value


def _check(name: str, variable: VariableSpec, source: str) -> None:
    where = f"{source}: variables: {name}"
    given = variable.given()
    if len(given) != 1:
        said = f"{' and '.join(given)} are given" if given else "nothing is given"
        raise InputError(f"{where}: {said}; give one of {', '.join(KINDS)}")
    pair: Any = getattr(variable, given[0], None)
    if given[0] in ("uniform", "sobol", "lhs", "loguniform") and not pair[0] <= pair[1]:
        raise InputError(f"{where}: {given[0]} = [{pair[0]:g}, {pair[1]:g}]: from the smaller to the larger number")
    if given[0] == "loguniform" and not pair[0] > 0:
        raise InputError(f"{where}: loguniform = [{pair[0]:g}, {pair[1]:g}]: expected numbers greater than 0")
    if given[0] in ("normal", "lognormal") and not pair[1] >= 0:
        raise InputError(f"{where}: {given[0]} = [mean, deviation]: the deviation {pair[1]:g} is negative")
