"""Desired trajectories q_d(t) with their first two derivatives."""

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

__all__ = ["Desired", "Harmonics", "Table", "cycles", "read_columns", "read_desired", "read_table"]

FEWEST = 6  # rows that a quintic spline needs
STILL = 1e-9  # rad or m, of a table's numbers: what moves no further does not move


class Desired(Protocol):
    """A trajectory of the independent coordinates; any callable of this form will do."""

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,)."""


def cycles(desired: Desired, t_end: float) -> float:
    """Return how often the quickest part of a trajectory comes round in t_end (s): 0 where it does not say."""
    return float(getattr(desired, "fastest", 0.0)) * t_end / (2 * np.pi)


class Harmonics:
    """offset + sum of amplitude * sin(frequency * t + phase), per coordinate.

    Parameters
    ----------
    specs : sequence of HarmonicsSpec
        In the order of `independent`.

    Attributes
    ----------
    fastest : float
        Of its waves' frequencies, rad/s.
    """

    def __init__(self, specs: Sequence[HarmonicsSpec]) -> None:
        most = max((len(spec.harmonics) for spec in specs), default=0)
        waves = np.zeros((3, len(specs), most))  # amplitude 0 where a coordinate has fewer waves
        for k, spec in enumerate(specs):
            waves[:, k, : len(spec.harmonics)] = np.array(spec.harmonics).reshape(-1, 3).T
        self.offset = np.array([spec.offset for spec in specs])
        self.amplitude, self.frequency, self.phase = waves
        self.fastest = float(np.abs(self.frequency[self.amplitude != 0]).max(initial=0.0))
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
    """Samples over time, interpolated by a quintic spline: the acceleration is smooth.

    Parameters
    ----------
    t : (m,) array
        Increasing times, at least six.
    q : (m, d) array

    Attributes
    ----------
    spline : scipy.interpolate.BSpline
        q_d.
    fastest : float
        Frequency of a wave with the ratio of largest acceleration to largest rate of the table's quickest column,
        rad/s.
    """

    def __init__(self, t: Array, q: Array) -> None:
        from scipy.interpolate import make_interp_spline

        self.spline = make_interp_spline(t, q, k=5)
        self._q_dot = self.spline.derivative()
        self._q_ddot = self._q_dot.derivative()
        moves = np.ptp(q, axis=0) > STILL * (1 + np.abs(q).max(axis=0))
        rates, changes = (np.abs(f(t)[:, moves]).max(axis=0) for f in (self._q_dot, self._q_ddot))
        self.fastest = float((changes / rates).max(initial=0.0))
        self.end = float(t[-1])

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        return self.spline(t), self._q_dot(t), self._q_ddot(t)


def read_desired(desired: Mapping[str, Any], names: Sequence[str], sources: Sources) -> Harmonics | Table:
    """Read the `[controller.desired]` table: harmonics by joint, or the name of a CSV file.

    Raises
    ------
    InputError
        An unknown or missing joint, a file that is not a trajectory.
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
    """Read a trajectory: `t` and a column for each name, splined."""
    return Table(*read_columns(text, names, file, FEWEST, "a smooth trajectory needs"))


def read_columns(text: str, names: Sequence[str], file: str, fewest: int, who: str) -> tuple[Array, Array]:
    """Read `t` and a column for each name, in any order, empty lines passed over: shapes (m,) and (m, names).

    Raises
    ------
    InputError
        Other columns, too few rows, what is no finite number, times that do not increase or start after 0.
    """
    import csv

    reader = csv.reader(text.splitlines())  # names may be quoted, and then have commas
    try:
        lines = [(reader.line_num, cells) for cells in reader if cells and (len(cells) > 1 or cells[0].strip())]
    except csv.Error as error:
        raise InputError(f"{file}, line {reader.line_num}: {error}") from None
    wanted = ["t", *names]
    header = [cell.strip() for cell in lines[0][1]] if lines else []
    if sorted(header) != sorted(wanted):
        found = f"its header is {','.join(header)[:80]!r}" if lines else "it is empty"
        raise InputError(f"{file}: {found}; the first line names the columns {', '.join(wanted)}")
    if len(lines) - 1 < fewest:
        raise InputError(f"{file}: {len(lines) - 1} rows; {who} at least {fewest}")
    table = np.array([_row(cells, len(wanted), f"{file}, line {number}") for number, cells in lines[1:]])
    table = table[:, [header.index(name) for name in wanted]]
    t = table[:, 0]
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        number = lines[back[0] + 2][0]
        raise InputError(f"{file}, line {number}: t = {t[back[0] + 1]:g} after t = {t[back[0]]:g}; t must increase")
    if t[0] > 0:
        raise InputError(f"{file}: starts at t = {t[0]:g} s; a run starts at 0")
    return t, table[:, 1:]


def _row(cells: Sequence[str], count: int, where: str) -> list[float]:
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != count or not all(map(math.isfinite, row)):
        raise InputError(f"{where}: {','.join(cells)[:80]!r} is not {count} finite numbers")
    return row
