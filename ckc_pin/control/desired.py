"""Desired trajectories q_d(t) with their first two derivatives, and CSV files with columns over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert
from ckc_pin.control.piecewise import (
    Interpolation,
    PiecewisePolynomial,
    interpolate,
    line,
    pass_waypoints,
    side_by_side,
)
from ckc_pin.control.spec import MotionSpec, TableSpec, require_profile
from ckc_pin.errors import InputError

__all__ = [
    "Desired",
    "Harmonics",
    "Sum",
    "Table",
    "count_cycles",
    "find_rate_jump",
    "make_motion",
    "read_columns",
    "read_desired",
    "read_some_columns",
    "read_table",
]

MIN_SPLINE_ROWS = 6  # of a quintic spline
CONSTANT_TOLERANCE = 1e-9  # relative to 1 + largest value: range of a table's column that counts as constant


class Desired(Protocol):
    """A trajectory of the independent coordinates. Any callable of this form can be used.

    It may have the attribute `max_frequency`, in rad/s: the workspace check samples it and waves of this frequency
    finely enough.
    """

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,)."""


def count_cycles(desired: Desired, t_end: float) -> float:
    """Return the number of periods of a trajectory's highest frequency until t_end (s), 0 if it is unknown."""
    return float(getattr(desired, "max_frequency", 0.0)) * t_end / (2 * np.pi)


def find_rate_jump(desired: Desired, t_end: float) -> float | None:
    """Return the first time between 0 and t_end (s) at which the rate of a trajectory jumps, None if it never does."""
    jumps = np.asarray(getattr(desired, "rate_jumps", ()))
    inside = jumps[(jumps > 0.0) & (jumps < t_end)]
    return float(inside[0]) if len(inside) else None


class Harmonics:
    """offset + sum of amplitude * sin(frequency * t + phase), per coordinate.

    Parameters
    ----------
    specs : sequence of MotionSpec
        In the order of `independent`. Rates and waypoints are left out.

    Attributes
    ----------
    max_frequency : float
        Highest frequency of the waves, rad/s.
    end : float
        Infinite: the trajectory has no end.
    """

    def __init__(self, specs: Sequence[MotionSpec]) -> None:
        count = max((len(spec.harmonics) for spec in specs), default=0)
        waves = np.zeros((3, len(specs), count))  # padded with zero amplitudes
        for k, spec in enumerate(specs):
            waves[:, k, : len(spec.harmonics)] = np.array(spec.harmonics).reshape(-1, 3).T
        self.offset = np.array([spec.offset for spec in specs])
        self.amplitude, self.frequency, self.phase = waves
        self.max_frequency = float(np.abs(self.frequency[self.amplitude != 0]).max(initial=0.0))
        self.end = np.inf

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        angle = self.frequency * t + self.phase
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        return (
            self.offset + sine.sum(axis=1),
            (self.frequency * cosine).sum(axis=1),
            -(self.frequency**2 * sine).sum(axis=1),
        )


class Table(PiecewisePolynomial):
    """Samples over time, interpolated.

    Parameters
    ----------
    t : (m,) array
        Increasing times, s. A spline with fewer rows than its degree + 1 is one polynomial.
    q : (m, d) array
    interpolation : {"quintic", "cubic", "linear"}
        The rate of a linear interpolation jumps at each row. The splines are smooth, but may swing beyond their rows.

    Attributes
    ----------
    max_frequency : float
        Frequency of a sine wave with the ratio of largest acceleration to largest rate of the table's fastest column,
        rad/s.
    end : float
        Last time, s.
    """

    def __init__(self, t: Array, q: Array, interpolation: Interpolation = "quintic") -> None:
        breaks, coefficients = interpolate(t, q, interpolation)
        jumps = t[1:-1] if interpolation == "linear" else ()
        corners = () if interpolation == "quintic" else breaks[1:-1]
        super().__init__(breaks, coefficients, corners=corners, rate_jumps=jumps, end=float(t[-1]))
        varies = np.ptp(q, axis=0) > CONSTANT_TOLERANCE * (1 + np.abs(q).max(axis=0))
        _, rates, accelerations = (np.abs(x[:, varies]) for x in self(t))
        if interpolation == "linear":
            steps = np.diff(t)
            accelerations = np.abs(np.diff(rates, axis=0)[:-1]) / np.minimum(steps[1:], steps[:-1])[:, np.newaxis]
        largest = (x.max(axis=0, initial=0.0) for x in (accelerations, rates))
        self.max_frequency = float(np.divide(*largest).max(initial=0.0))


class Sum:
    """Sum of harmonics and a piecewise polynomial.

    Parameters
    ----------
    harmonics : Harmonics
    polynomial : PiecewisePolynomial

    Attributes
    ----------
    max_frequency, corners, rate_jumps, end
        As of its parts.
    """

    def __init__(self, harmonics: Harmonics, polynomial: PiecewisePolynomial) -> None:
        self.harmonics, self.polynomial = harmonics, polynomial
        self.max_frequency = max(harmonics.max_frequency, polynomial.max_frequency)
        self.corners, self.rate_jumps, self.end = polynomial.corners, polynomial.rate_jumps, polynomial.end

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        (x, x_dot, x_ddot), (y, y_dot, y_ddot) = self.harmonics(t), self.polynomial(t)
        return x + y, x_dot + y_dot, x_ddot + y_ddot


def read_desired(
    desired: Mapping[str, Any], names: Sequence[str], sources: Sources
) -> Harmonics | PiecewisePolynomial | Sum:
    """Read the `[controller.desired]` table: a motion for each joint, or the name of a CSV file.

    Raises
    ------
    InputError
        An unknown or missing joint, or a file that is not a trajectory.
    """
    where = f"{sources.name}: controller.desired"
    if "file" in desired and "file" not in names:
        if not isinstance(desired["file"], str) or not set(desired) <= {"file", "interpolation"}:
            raise InputError(
                f'{where}: either file = "NAME.csv", alone or with interpolation, or a table for each of '
                f"{', '.join(names)}"
            )
        spec = convert(dict(desired), TableSpec, sources.name, "controller.desired")
        return read_table(sources.text(spec.file), names, spec.file, spec.interpolation)
    unknown = [name for name in desired if name not in names]
    missing = [name for name in names if name not in desired]
    if unknown or missing:
        problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
        raise InputError(f"{where}: needs a table for each of {', '.join(names)} (or file); {problem}")
    specs = [convert(desired[name], MotionSpec, sources.name, f"controller.desired.{name}") for name in names]
    return make_motion(specs, [f"{where}.{name}" for name in names])


def make_motion(specs: Sequence[MotionSpec], where: Sequence[str]) -> Harmonics | PiecewisePolynomial | Sum:
    """Build the motion of several coordinates, each from its own table.

    Parameters
    ----------
    specs : sequence of MotionSpec
    where : sequence of str
        The place of each table, for messages.

    Raises
    ------
    InputError
        Keys that do not go together, times that do not increase, or a trapezoid beyond its limits.
    """
    for spec, place in zip(specs, where, strict=True):
        require_profile(spec, place)
    harmonics = Harmonics(specs)
    if all(spec.rate == 0.0 and spec.waypoints is None for spec in specs):
        return harmonics
    polynomial = side_by_side([_polynomial(spec, place) for spec, place in zip(specs, where, strict=True)])
    harmonics.offset = np.zeros(len(specs))
    return Sum(harmonics, polynomial) if any(spec.harmonics for spec in specs) else polynomial


def _polynomial(spec: MotionSpec, where: str) -> PiecewisePolynomial:
    """Return offset + rate t, plus the waypoints."""
    motion = line(np.array([float(spec.offset)]), np.array([float(spec.rate)]))
    if spec.waypoints is None:
        return motion
    t, x = np.array(spec.waypoints, dtype=float).reshape(-1, 2).T
    limits = (spec.max_rate, spec.max_acceleration)
    way = pass_waypoints(t, x[:, np.newaxis], spec.profile or "quintic", *limits, f"{where}.waypoints")
    way.coefficients[-1] += motion(way.breaks[:-1])[0]
    way.coefficients[-2] += spec.rate
    way.max_frequency += motion.max_frequency
    return way


def read_table(text: str, names: Sequence[str], file: str, interpolation: Interpolation | None = None) -> Table:
    """Read a trajectory from CSV text with `t` and a column for each name.

    Without an interpolation, it is quintic, and the rows must be enough for one that is smooth.
    """
    if interpolation is None:
        requirement = (
            'without the key interpolation, which may be "linear", "cubic" or "quintic", a smooth trajectory needs'
        )
        return Table(*read_columns(text, names, file, MIN_SPLINE_ROWS, requirement))
    return Table(*read_columns(text, names, file, 2, "interpolation needs"), interpolation)


def read_columns(text: str, names: Sequence[str], file: str, min_rows: int, requirement: str) -> tuple[Array, Array]:
    """Read `t` and a column for each name from CSV text, columns in any order, empty lines ignored.

    Parameters
    ----------
    text : str
    names : sequence of str
    file : str
        For messages.
    min_rows : int
    requirement : str
        What needs that many rows, as the message begins: ``"a smooth trajectory needs"``.

    Returns
    -------
    (m,) array, (m, names) array

    Raises
    ------
    InputError
        Other columns, too few rows, a value that is not a finite number, times that do not increase or start after 0.
    """
    lines, header = _read_lines(text, file)
    columns = ["t", *names]
    if sorted(header) != sorted(columns):
        problem = f"its header is {','.join(header)[:80]!r}" if lines else "it is empty"
        raise InputError(f"{file}: {problem}; the first line must name the columns {', '.join(columns)}")
    return _read_rows(lines, header, columns, file, min_rows, requirement)


def read_some_columns(
    text: str, names: Sequence[str], file: str, min_rows: int, requirement: str
) -> tuple[Array, Array]:
    """Read `t` and one or more of the named columns, as `read_columns` does. Columns that are not there are zero."""
    lines, header = _read_lines(text, file)
    unknown = next((name for name in header if name not in ("t", *names)), None)
    if unknown is not None or "t" not in header or len(set(header)) < max(2, len(header)):
        problem = f"its header is {','.join(header)[:80]!r}" if lines else "it is empty"
        raise InputError(f"{file}: {problem}; the first line must name t and some of {', '.join(names)}, each once")
    there = [name for name in names if name in header]
    t, values = _read_rows(lines, header, ["t", *there], file, min_rows, requirement)
    table = np.zeros((len(t), len(names)))
    table[:, [names.index(name) for name in there]] = values
    return t, table


Lines = list[tuple[int, list[str]]]


def _read_lines(text: str, file: str) -> tuple[Lines, list[str]]:
    """Return the lines of a CSV text that are not empty, with their numbers, and the names in the first one."""
    import csv

    reader = csv.reader(text.splitlines())  # quoted names may contain commas
    try:
        lines = [(reader.line_num, cells) for cells in reader if cells and (len(cells) > 1 or cells[0].strip())]
    except csv.Error as error:
        raise InputError(f"{file}, line {reader.line_num}: {error}") from None
    return lines, [cell.strip() for cell in lines[0][1]] if lines else []


def _read_rows(
    lines: Lines, header: list[str], columns: list[str], file: str, min_rows: int, requirement: str
) -> tuple[Array, Array]:
    """Return t and the other columns, in the order of `columns`."""
    if len(lines) - 1 < min_rows:
        raise InputError(f"{file}: {len(lines) - 1} rows; {requirement} at least {min_rows}")
    table = np.array([_read_row(cells, len(columns), f"{file}, line {number}") for number, cells in lines[1:]])
    table = table[:, [header.index(name) for name in columns]]
    t = table[:, 0]
    decreasing = np.flatnonzero(np.diff(t) <= 0)
    if len(decreasing):
        k = decreasing[0]
        raise InputError(f"{file}, line {lines[k + 2][0]}: t = {t[k + 1]:g} after t = {t[k]:g}; t must increase")
    if t[0] > 0:
        raise InputError(f"{file}: starts at t = {t[0]:g} s; a run starts at 0")
    return t, table[:, 1:]


def _read_row(cells: Sequence[str], count: int, where: str) -> list[float]:
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != count or not all(map(math.isfinite, row)):
        raise InputError(f"{where}: {','.join(cells)[:80]!r} is not {count} finite numbers")
    return row
