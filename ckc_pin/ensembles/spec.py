"""Typed structure of a sweep's file, `NAME.sweep.toml`."""

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
    "MAX_MEMBERS",
    "SUFFIX",
    "GridSpec",
    "OutputSpec",
    "Reduction",
    "SweepSpec",
    "VariableSpec",
    "find_scene_path",
    "parse_sweep",
    "read_sweep",
]

SUFFIX = ".sweep.toml"
MAX_MEMBERS = 10**9

Pair = tuple[float, float]
Count = Annotated[int, msgspec.Meta(ge=1, le=MAX_MEMBERS)]
Reduction = Literal["end", "min", "max", "max_abs", "mean", "rms", "integral", "trajectory"]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class GridSpec(_Spec, frozen=True):
    """Equidistant values, including both ends.

    Attributes
    ----------
    start : the variable's
        First value.
        ``start = -1.9``
    stop : the variable's
        Last value.
        ``stop = 1.9``
    count
        Number of values.
        ``count = 41``
    """

    start: float
    stop: float
    count: Count


class VariableSpec(_Spec, frozen=True):
    """Distribution of one variable over the members, given by one of the keys.

    Grids, lists and files are crossed with each other. The last one named varies fastest.

    Attributes
    ----------
    uniform : the variable's
        Lower and upper end.
        ``uniform = [-1.9, -0.9]``
    loguniform : the variable's
        Lower and upper end, both greater than 0. The logarithm is uniform.
        ``loguniform = [0.1, 10.0]``
    normal : the variable's
        Mean, standard deviation.
        ``normal = [0.2611, 0.01]``
    lognormal : of the logarithm
        Mean and standard deviation of the logarithm.
        ``lognormal = [0.0, 0.1]``
    sobol : the variable's
        Lower and upper end. A scrambled Sobol sequence over all variables of this kind; balanced if ``members`` is a
        power of 2.
        ``sobol = [-1.9, -0.9]``
    lhs : the variable's
        Lower and upper end. A Latin hypercube over all variables of this kind.
        ``lhs = [-1.9, -0.9]``
    grid
        Equidistant values.
        ``grid = {start = -1.9, stop = 1.9, count = 41}``
    list : the variable's
        Values.
        ``list = [0.2, 0.3, 0.5]``
    file
        A CSV file in the folder of this one, whose first row names variables. The variables of one file take their
        values from the same row.
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
        """The key that is set."""
        return self.find_keys()[0]

    def find_keys(self) -> list[str]:
        """Return the keys that are set."""
        keys = zip(self.__struct_fields__, KINDS, strict=True)
        return [key for name, key in keys if getattr(self, name) is not None]


KINDS = VariableSpec.__struct_encode_fields__


class OutputSpec(_Spec, frozen=True):
    """A quantity of a run and its reduction.

    Attributes
    ----------
    of
        A quantity by its name, such as ``theta_1``, ``tau.MOTOR``, ``error.theta_1`` or ``tip.x`` (see "names");
        ``q_tree``, ``v_tree``, ``u``, ``tau``, ``phi``, ``error`` (q - q_d), ``energy``, ``dissipated`` (NaN with
        ``friction_smoothing``), ``lyapunov``, ``t``; ``max_abs_u``, ``max_abs_tau``, ``max_phi``, ``energy_drift``
        (largest change), ``settled`` (1 if all rates are zero at the end, and q = q_d of a set point; else 0),
        ``event.NAME`` or ``event.K`` (its first occurrence, s).
        ``of = "error"``
    reduce
        Reduction over the member's output instants. The quantities that are listed after ``t`` are already reduced.
        ``reduce = "max_abs"``
    at : s
        Instead of ``reduce``: the value at the output instant nearest to this time. NaN if a member ended before.
        ``at = 0.5``
    tolerance : rad, of the size
        For ``settled``, of each coordinate and its rate.
        ``tolerance = 1e-4``
    """

    of: Annotated[str, msgspec.Meta(min_length=1)]
    reduce: Reduction = "end"
    at: Annotated[float, msgspec.Meta(ge=0)] | None = None
    tolerance: Annotated[float, msgspec.Meta(gt=0)] = 1e-3

    @property
    def reduction(self) -> Reduction | None:
        """The reduction over time; None for the value at a time."""
        return self.reduce if self.at is None else None

    def to_dict(self) -> dict[str, Any]:
        """Return the output as data. Without `at` they are as in stores of earlier versions, which can be resumed."""
        data: dict[str, Any] = msgspec.to_builtins(self)
        return {key: value for key, value in data.items() if key != "at" or value is not None}


class SweepSpec(_Spec, frozen=True):
    """The complete file.

    Attributes
    ----------
    scene
        A scene's shipped name, or its path relative to this file.
        ``scene = "five_bar/swing"``
    variables
        Distribution of each variable, by a parameter's name (see "parameters") or a scene's key. A list is short for
        ``{list = ...}``.
        ``variables = {"link.link_2.mass" = {normal = [0.2611, 0.01]}}``
    outputs
        Quantities to keep of each member, by names of your choice. A string is short for ``{of = ...}``.
        ``outputs = {end = "q_tree", worst = {of = "error", reduce = "max_abs"}}``
    members
        Number of members, at each point of the crossed variables. Needed if a variable is random.
        ``members = 1000``
    seed
        Seed of random variables.
        ``seed = 1``
    overrides
        Overrides of the scene, for all members, by dotted key.
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
        The file does not exist, is not TOML, or has an unknown key or a wrong value.
    """
    path = Path(path)
    data = read_toml(read_text(path, "sweep"), str(path))
    join_dotted_keys(data, "overrides")
    return parse_sweep(data, Sources(str(path), path.parent)), Sources(str(path), path.parent)


def parse_sweep(data: dict[str, Any], sources: Sources) -> SweepSpec:
    """Return the structure of parsed TOML (InputError)."""
    if isinstance(data.get("variables"), dict):
        data["variables"] = dict(_join_variable_names("", data["variables"]))
    spec = convert(data, SweepSpec, sources.name)
    for name, variable in spec.variables.items():
        _require_valid(name, variable, sources.name)
    for name, output in spec.outputs.items():
        if isinstance(output, OutputSpec) and output.reduce != "end" and output.at is not None:
            raise InputError(f"{sources.name}: outputs: {name}: give reduce or at, not both")
    if not spec.variables:
        raise InputError(f'{sources.name}: variables: name at least one, e.g. "initial.q.JOINT" = {{uniform = [a, b]}}')
    if not spec.outputs:
        raise InputError(f'{sources.name}: outputs: name at least one, e.g. end = "q_tree"')
    return spec


def find_scene_path(spec: SweepSpec, sources: Sources) -> str | Path:
    """Return the name of a sweep's scene, or its path, which is relative to the sweep's file."""
    if sources.folder is not None and is_path(spec.scene):
        return sources.folder / spec.scene
    return spec.scene


def _join_variable_names(key: str, table: Mapping[str, Any]) -> Any:
    """Yield dotted names of nested tables, each with the table of a variable's distribution."""
    for name, value in table.items():
        if isinstance(value, dict) and value and not any(inner in KINDS for inner in value):
            yield from _join_variable_names(f"{key}{name}.", value)
        elif isinstance(value, list):
            yield f"{key}{name}", {"list": value}
        else:
            yield f"{key}{name}", value


def _require_valid(name: str, variable: VariableSpec, source: str) -> None:
    where = f"{source}: variables: {name}"
    keys = variable.find_keys()
    if len(keys) != 1:
        problem = f"{' and '.join(keys)} are given" if keys else "nothing is given"
        raise InputError(f"{where}: {problem}; give one of {', '.join(KINDS)}")
    kind = keys[0]
    pair: Any = getattr(variable, kind, None)
    if kind in ("uniform", "sobol", "lhs", "loguniform") and not pair[0] <= pair[1]:
        raise InputError(f"{where}: {kind} = [{pair[0]:g}, {pair[1]:g}]: expected the smaller number first")
    if kind == "loguniform" and not pair[0] > 0:
        raise InputError(f"{where}: loguniform = [{pair[0]:g}, {pair[1]:g}]: expected numbers greater than 0")
    if kind in ("normal", "lognormal") and not pair[1] >= 0:
        raise InputError(f"{where}: {kind} = [mean, deviation]: the deviation {pair[1]:g} is negative")
