"""A sweep's file, `NAME.sweep.toml`, as a typed structure. What each key means: docs/reference.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import is_path
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.toml import by_coordinate, convert, read_text, read_toml

__all__ = ["SUFFIX", "GridSpec", "OutputSpec", "Reduction", "SweepSpec", "VariableSpec", "read_sweep", "sweep_of"]

SUFFIX = ".sweep.toml"
MOST = 10**9  # members

Pair = tuple[float, float]
Count = Annotated[int, msgspec.Meta(ge=1, le=MOST)]
Reduction = Literal["end", "min", "max", "max_abs", "mean", "rms", "integral", "trajectory"]


class _Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class GridSpec(_Spec, frozen=True):
    """Values at equal distances, both ends among them."""

    start: float
    stop: float
    count: Count


class VariableSpec(_Spec, frozen=True):
    """How one variable differs between members: one of the keys."""

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
    """A quantity of a run, and what is kept of it."""

    of: Annotated[str, msgspec.Meta(min_length=1)]
    reduce: Reduction = "end"
    tolerance: Annotated[float, msgspec.Meta(gt=0)] = 1e-3


class SweepSpec(_Spec, frozen=True):
    """The whole file."""

    scene: str
    variables: dict[str, VariableSpec]
    outputs: dict[str, str | OutputSpec]
    members: Count | None = None
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    changes: dict[str, Any] = {}


def read_sweep(path: str | Path) -> tuple[SweepSpec, Sources]:
    """Read a sweep's file.

    Raises
    ------
    InputError
        No such file, malformed TOML, an unknown key, a wrong type or value.
    """
    path = Path(path)
    data = read_toml(read_text(path, "sweep"), str(path))
    return sweep_of(data, Sources(str(path), path.parent)), Sources(str(path), path.parent)


def sweep_of(data: dict[str, Any], sources: Sources) -> SweepSpec:
    """Check parsed data (InputError)."""
    by_coordinate(data, "changes")
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
        elif isinstance(value, list | np.ndarray):
            yield f"{key}{name}", {"list": [float(x) for x in value]}
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
        raise InputError(f"{where}: loguniform = [{pair[0]:g}, {pair[1]:g}]: numbers greater than 0 are needed")
    if given[0] in ("normal", "lognormal") and not pair[1] >= 0:
        raise InputError(f"{where}: {given[0]} = [mean, deviation]: the deviation {pair[1]:g} is negative")
