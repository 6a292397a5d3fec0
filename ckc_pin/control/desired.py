"""Desired trajectories q_d(t) with their first two derivatives, and CSV files with columns over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert
from ckc_pin.control.spec import HarmonicsSpec
from ckc_pin.errors import InputError

__all__ = ["Desired", "Harmonics", "Table", "count_cycles", "read_columns", "read_desired", "read_table"]

MIN_SPLINE_ROWS = 6  # of a quintic spline
CONSTANT_TOLERANCE = 1e-9  # relative to 1 + largest value: range of a table's column that counts as constant


class Desired(Protocol):
    """A trajectory of the independent coordinates. Any callable of this form can be used."""

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,)."""


def count_cycles(desired: Desired, t_end: float) -> float:
    """Return the number of periods of a trajectory's highest frequency until t_end (s), 0 if it is unknown."""
    return float(getattr(desired, "max_frequency", 0.0)) * t_end / (2 * np.pi)


class Harmonics:
    """offset + sum of amplitude * sin(frequency * t + phase), per coordinate.

    Parameters
    ----------
    specs : sequence of HarmonicsSpec
        In the order of `independent`.

    Attributes
    ----------
    max_frequency : float
        Highest frequency of the waves, rad/s.
    end : float
        Infinite: the trajectory has no end.
    """

    def __init__(self, specs: Sequence[HarmonicsSpec]) -> None:
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


class Table:
    """Samples over time, interpolated by a quintic spline, so that the acceleration is smooth.

    Parameters
    ----------
    t : (m,) array
        Increasing times, at least six, s.
    q : (m, d) array

    Attributes
    ----------
    spline : scipy.interpolate.BSpline
        q_d.
    max_frequency : float
        Frequency of a sine wave with the ratio of largest acceleration to largest rate of the table's fastest column,
        rad/s.
    end : float
        Last time, s.
    """

    def __init__(self, t: Array, q: Array) -> None:
        from scipy.interpolate import make_interp_spline

        self.spline = make_interp_spline(t, q, k=5)
        self._q_dot = self.spline.derivative()
        self._q_ddot = self._q_dot.derivative()
        varies = np.ptp(q, axis=0) > CONSTANT_TOLERANCE * (1 + np.abs(q).max(axis=0))
        rates, accelerations = (np.abs(f(t)[:, varies]).max(axis=0) for f in (self._q_dot, self._q_ddot))
        self.max_frequency = float((accelerations / rates).max(initial=0.0))
        self.end = float(t[-1])

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        return self.spline(t), self._q_dot(t), self._q_ddot(t)


def read_desired(desired: Mapping[str, Any], names: Sequence[str], sources: Sources) -> Harmonics | Table:
    """Read the `[controller.desired]` table: harmonics by joint, or the name of a CSV file.

    Raises
    ------
    InputError
        An unknown or missing joint, or a file that is not a trajectory.
    """
    where = f"{sources.name}: controller.desired"
    if "file" in desired:
        if len(desired) > 1 or not isinstance(desired["file"], str):
            raise InputError(f'{where}: either file = "NAME.csv" alone, or a table for each of {", ".join(names)}')
        return read_table(sources.text(desired["file"]), names, desired["file"])
    unknown = [name for name in desired if name not in names]
    missing = [name for name in names if name not in desired]
    if unknown or missing:
        problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
        raise InputError(f"{where}: needs a table for each of {', '.join(names)} (or file); {problem}")
    return Harmonics(
        [convert(desired[name], HarmonicsSpec, sources.name, f"controller.desired.{name}") for name in names]
    )


def read_table(text: str, names: Sequence[str], file: str) -> Table:
    """Read a trajectory from CSV text with `t` and a column for each name."""
    return Table(*read_columns(text, names, file, MIN_SPLINE_ROWS, "a smooth trajectory needs"))


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
    import csv

    reader = csv.reader(text.splitlines())  # quoted names may contain commas
    try:
        lines = [(reader.line_num, cells) for cells in reader if cells and (len(cells) > 1 or cells[0].strip())]
    except csv.Error as error:
        raise InputError(f"{file}, line {reader.line_num}: {error}") from None
    columns = ["t", *names]
    header = [cell.strip() for cell in lines[0][1]] if lines else []
    if sorted(header) != sorted(columns):
        problem = f"its header is {','.join(header)[:80]!r}" if lines else "it is empty"
        raise InputError(f"{file}: {problem}; the first line must name the columns {', '.join(columns)}")
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
