"""Recorded motions: measured quantities over time, from files, arrays, data frames and runs."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import field

from ckc_pin.base.arrays import Array, Immutable
from ckc_pin.base.validation import suggest_name
from ckc_pin.errors import InputError
from ckc_pin.identification.bags import is_bag, read_bag
from ckc_pin.identification.spec import UNITS, DataSpec
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.run.columns import list_quantities
from ckc_pin.run.run import Run

__all__ = ["Record", "read_csv", "read_record", "require_radians"]

MAX_BYTES = 2_000_000_000
RECORDED = ("q_tree", "v_tree", "tau", "point_positions")


class Record(Immutable, frozen=True):
    """Measurements of one motion.

    Attributes
    ----------
    source : str
        Name in messages.
    t : (m,) array
        Increasing, s.
    values : mapping of str to (m,) array
        By quantity, in SI units; NaN marks gaps.
    noise : mapping of str to float
        Standard deviations that are known.
    delay : mapping of str to float or "estimate"
        s.
    validation : bool
    unused : tuple of str
        Columns that are no quantity of the mechanism.
    """

    source: str
    t: Array
    values: Mapping[str, Array]
    noise: Mapping[str, float] = field(default_factory=dict)
    delay: Mapping[str, float | str] = field(default_factory=dict)
    validation: bool = False
    unused: tuple[str, ...] = ()

    def times(self, quantity: str) -> Array:
        """Return the times at which the values of a quantity happened, s."""
        delay = self.delay.get(quantity, 0.0)
        return self.t - (0.0 if isinstance(delay, str) else delay)


def read_record(data: Any, mechanism: Mechanism, spec: DataSpec | None = None, folder: Path | None = None) -> Record:
    """Return measurements as a record.

    Parameters
    ----------
    data : str, Path, Run, mapping of str to arrays, or DataFrame
        With ``t`` and quantities by name.
    mechanism : Mechanism
    spec : DataSpec, optional
        Noise, names, units and delays.
    folder : Path, optional
        That a file is relative to.

    Raises
    ------
    InputError
        A file that cannot be read, times that do not increase, or quantities that the mechanism does not have.
    """
    spec = spec or DataSpec(file="data")
    if isinstance(data, Run):
        columns = {"t": data.t, **dict(zip(mechanism.coordinates, data.q_tree.T, strict=True))}
        columns |= {f"tau.{name}": column for name, column in zip(mechanism.motors.names, data.tau.T, strict=True)}
        source = data.scene_name
    elif isinstance(data, str | Path):
        path = (folder or Path()) / data
        source, columns = str(data), _read_file(path)
    else:
        source = "data"
        columns = {str(name): np.asarray(data[name], dtype=float) for name in data}
    columns = {name: columns.pop(column) for name, column in _renamed(columns, spec, source).items()} | columns
    if "t" not in columns:
        raise InputError(
            f"{source}: no column 't'; there are {', '.join(columns)}; names = {{t = \"COLUMN\"}} renames one"
        )
    quantities = {name for name, x in list_quantities(mechanism).items() if x.array in RECORDED}
    factors = {name: UNITS[unit] for name, unit in spec.units.items()}
    t = np.asarray(columns["t"], dtype=float) * factors.get("t", 1.0)
    _require_increasing(t, source)
    values = {name: x * factors.get(name, 1.0) for name, x in columns.items() if name in quantities}
    for what, names in (("noise", spec.noise), ("units", spec.units), ("delay", spec.delay)):
        missing = next((name for name in names if name not in (*values, "t")), None)
        if missing is not None:
            raise InputError(
                f"{source}: {what}: {missing}: no such quantity{suggest_name(missing, list(values))}; the columns of "
                f"this mechanism are {', '.join(values)}"
            )
    for name, x in values.items():
        if x.shape != t.shape:
            raise InputError(
                f"{source}: {name}: {x.shape} values for {t.shape} times; one value for each time is needed"
            )
    inside = np.isfinite(t) if spec.span is None else (t >= spec.span[0]) & (t <= spec.span[1])
    values = {name: x[inside] for name, x in values.items()}
    unused = tuple(name for name in columns if name not in (*values, "t"))
    return Record(source, t[inside], values, spec.noise, spec.delay, spec.validation, unused)


def _renamed(columns: Mapping[str, Array], spec: DataSpec, source: str) -> dict[str, str]:
    for name, column in spec.names.items():
        if column not in columns:
            raise InputError(
                f"{source}: names: {name}: no column {column!r}{suggest_name(column, list(columns))}; there are "
                f"{', '.join(columns)}"
            )
    return dict(spec.names)


def _read_file(path: Path) -> dict[str, Array]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES / 1e9:.0f} GB; give a part of the recording")
        if path.suffix == ".parquet":
            return _read_parquet(path)
        if is_bag(path):
            return read_bag(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    return {name: np.array(column) for name, column in read_csv(path).items()}


def read_csv(path: str | Path) -> dict[str, list[float]]:
    """Return the columns of a CSV file. An empty cell is NaN.

    Raises
    ------
    InputError
        It cannot be read, a name stands twice in its first line, or another line has no numbers or not as many.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    header = [cell.strip() for cell in rows[0]] if rows else []
    if len(set(header)) < len(header):
        raise InputError(f"{path}: its first line names a column twice")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise InputError(f"{path}: row {number} has {len(row)} cells, the first line {len(header)}")
    try:
        numbers = [[float(cell) if cell.strip() else np.nan for cell in row] for row in rows[1:]]
    except ValueError as error:
        raise InputError(f"{path}: {error}; expected numbers below the names of readings") from None
    return {name: [row[k] for row in numbers] for k, name in enumerate(header)}


def _read_parquet(path: Path) -> dict[str, Array]:
    try:
        import pandas

        frame = pandas.read_parquet(path)
    except ImportError:
        raise InputError(f"{path}: reading Parquet needs pandas and pyarrow: pip install pandas pyarrow") from None
    return {str(name): np.asarray(frame[name], dtype=float) for name in frame.columns}


def _require_increasing(t: Array, source: str) -> None:
    if not np.all(np.isfinite(t)):
        raise InputError(f"{source}: t: row {int(np.argmin(np.isfinite(t))) + 1} has no time")
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{source}: t does not increase: {t[k]:.9g} is followed by {t[k + 1]:.9g} (value {k + 2}); sort the rows, "
            "and give each recording as data of its own"
        )


def describe_missing(record: Record, missing: Sequence[str], needed: str) -> str:
    """Return the message that a record has not the columns that are needed."""
    message = f"identify: {record.source}: no column {', '.join(missing)}; {needed} are needed, there are "
    message += ", ".join((*record.values, *record.unused)) or "none"
    if record.unused:
        message += f'; names = {{"{missing[0]}" = "COLUMN"}} takes a column of another name'
    return message


def require_radians(mechanism: Mechanism, record: Record, names: Sequence[str]) -> None:
    """Refuse readings of hinges that are degrees by their size."""
    lower, upper = mechanism.tree.limits()
    for name in names:
        k = mechanism.tree.index[name]
        x = record.values[name]
        largest = float(np.nanmax(np.abs(x), initial=0.0))
        bound = max(abs(lower[k]), abs(upper[k]))
        if not mechanism.tree.in_metres[k] and largest > (1.5 * bound if np.isfinite(bound) else 50.0):
            raise InputError(
                f"identify: {record.source}: {name} reaches {largest:.4g} rad; if these are degrees, give "
                f'units = {{{name} = "deg"}}'
            )
