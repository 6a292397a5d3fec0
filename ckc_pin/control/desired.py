"""Desired trajectories q_d(t) with their first two derivatives."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ckc_pin.control.spec import HarmonicsSpec
from ckc_pin.errors import InputError
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.toml import convert
from ckc_pin.mechanism.tree import Array

__all__ = ["Desired", "Harmonics", "Table", "read_desired"]


class Desired(Protocol):
    """A trajectory of the independent coordinates; any callable of this form will do."""

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        """Return q_d, its rate and its acceleration at time t (s), each of shape (d,)."""


class Harmonics:
    """offset + sum of amplitude * sin(frequency * t + phase), per coordinate.

    Parameters
    ----------
    specs : sequence of HarmonicsSpec
        In the order of `independent`.
    """

    def __init__(self, specs: Sequence[HarmonicsSpec]) -> None:
        most = max((len(spec.harmonics) for spec in specs), default=0)
        waves = np.zeros((3, len(specs), most))  # amplitude 0 where a coordinate has fewer waves
        for k, spec in enumerate(specs):
            waves[:, k, : len(spec.harmonics)] = np.array(spec.harmonics).reshape(-1, 3).T
        self.offset = np.array([spec.offset for spec in specs])
        self.amplitude, self.frequency, self.phase = waves
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
    """

    def __init__(self, t: Array, q: Array) -> None:
        from scipy.interpolate import make_interp_spline

        self._q = make_interp_spline(t, q, k=5)
        self._q_dot = self._q.derivative()
        self._q_ddot = self._q_dot.derivative()
        self.end = float(t[-1])

    def __call__(self, t: float) -> tuple[Array, Array, Array]:
        return self._q(t), self._q_dot(t), self._q_ddot(t)


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
        return _read_table(sources.text(desired["file"]), names, desired["file"])
    unknown = [name for name in desired if name not in names]
    missing = [name for name in names if name not in desired]
    if unknown or missing:
        problem = f"{unknown[0]!r} is none of them" if unknown else f"{missing[0]!r} is missing"
        raise InputError(f"{where}: needs a table for each of {', '.join(names)} (or file); {problem}")
    specs = [convert(desired[name], HarmonicsSpec, f"{where}.{name}") for name in names]
    harmonics = Harmonics(specs)
    if not all(np.all(np.isfinite(x)) for x in (harmonics.offset, harmonics.amplitude, harmonics.frequency,
                                                harmonics.phase)):  # fmt: skip
        raise InputError(f"{where}: a number is not finite")
    return harmonics


def _read_table(text: str, names: Sequence[str], file: str) -> Table:
    rows = [row for row in csv.reader(io.StringIO(text)) if row]
    wanted = ["t", *names]
    header = [cell.strip() for cell in rows[0]] if rows else []
    if sorted(header) != sorted(wanted):
        raise InputError(f"{file}: its header is {','.join(header)!r}; needed are the columns {', '.join(wanted)}")
    table = np.empty((len(rows) - 1, len(wanted)))
    for k, row in enumerate(rows[1:]):
        try:
            table[k] = [float(cell) for cell in row]
        except ValueError:
            raise InputError(f"{file}, row {k + 2}: not {len(wanted)} numbers") from None
    table = table[:, [header.index(name) for name in wanted]]
    if len(table) < 6 or not np.all(np.isfinite(table)) or np.any(np.diff(table[:, 0]) <= 0):
        raise InputError(f"{file}: needs at least 6 rows of finite numbers with increasing t")
    if table[0, 0] > 0:
        raise InputError(f"{file}: starts at t = {table[0, 0]:g}; a run starts at 0")
    return Table(table[:, 0], table[:, 1:])
