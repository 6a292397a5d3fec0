"""Results on disk: a Zarr group that xarray opens, written chunk by chunk, each of them whole or not there."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec
import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined
from ckc_pin.simulation.ensembles.members import PENDING, STATUS, Chunk, Members

__all__ = ["RESULTS", "STAYS", "Store", "array_name", "require_libraries", "units_beside"]

RESULTS = "results.zarr"
FORMAT = 1
BLOCK = 2**20  # members whose status is read at once
STATUS_NAME, MESSAGE_NAME = "status", "message"
STAYS = "what is there stays, and the same command goes on from it"
UNITS = "SI units: s, m, rad, kg, N, N m, J"


def require_libraries() -> None:
    """Refuse to begin without xarray and Zarr (InputError)."""
    try:
        import xarray  # noqa: F401
        import zarr  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(
            f"ensembles are kept by {error.name}, which is not installed: pip install ckc_pin[ensembles]"
        ) from None


class Store:
    """The results of one sweep.

    Parameters
    ----------
    path : Path or None
        The group; None: in memory.
    sweep : mapping
        All that the results follow from, as plain data: who goes on with a store must have the same.
    members : Members
    count : int
    chunk : int
        Members that are written together; of a store that is there its own is kept.

    Raises
    ------
    InputError
        The store is of another sweep, is no store, or cannot be written.

    Attributes
    ----------
    chunk : int
    """

    def __init__(self, path: Path | None, sweep: Mapping[str, Any], members: Members, count: int, chunk: int) -> None:
        self.path, self.count = path, count
        _require_free_names(members)
        sweep = json.loads(json.dumps(sweep))
        self._identity = sha256(msgspec.json.encode(sweep, order="deterministic")).hexdigest()
        if path is not None and path.exists():
            self._group = self._open(path, sweep)
            with suppress(OSError):  # begun before there were units; what cannot be written can still be read
                _say_units(self._group, members)
        else:
            self._group = self._begin(path, sweep, members, min(chunk, count))
        self.chunk: int = self._group[STATUS_NAME].chunks[0]

    @property
    def place(self) -> Any:
        """What xarray opens."""
        return self._group.store if self.path is None else self.path

    def pending(self) -> Iterator[tuple[int, int]]:
        """Yield the chunks that are not there yet, as first and end of their members."""
        for block, status in self._statuses():
            for first in range(0, len(status), self.chunk):
                end = min(first + self.chunk, len(status))
                if (status[first:end] == PENDING).any():
                    yield block + first, block + end

    def counts(self) -> dict[str, int]:
        """Count members by how they ended."""
        counts = np.zeros(len(STATUS), dtype=np.int64)
        for _, status in self._statuses():
            counts += np.bincount(status, minlength=len(STATUS))
        return {name: int(counts[k]) for k, name in enumerate(STATUS)}

    def _statuses(self) -> Iterator[tuple[int, Any]]:
        """Read how members ended, many chunks at a time."""
        status: Any = self._group[STATUS_NAME]
        step = self.chunk * max(1, BLOCK // self.chunk)
        for first in range(0, self.count, step):
            yield first, status[first : first + step]

    def write(self, chunk: Chunk, names: tuple[str, ...]) -> None:
        """Write a chunk; how its members ended comes last, and says that it is whole.

        Raises
        ------
        InputError
            It cannot be written: a full disk. What was written before is whole.
        """
        at = slice(chunk.first, chunk.first + len(chunk.status))
        group: Any = self._group
        try:
            for k, name in enumerate(names):
                group[array_name(name)][at] = chunk.values[:, k]
            for name, values in chunk.outputs.items():
                group[array_name(name)][at] = values
            if any(chunk.message):
                group[MESSAGE_NAME][at] = np.array(chunk.message, dtype=np.dtypes.StringDType())
            group[STATUS_NAME][at] = chunk.status
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}; {STAYS}") from None

    def _begin(self, path: Path | None, sweep: Mapping[str, Any], members: Members, chunk: int) -> Any:
        """Make a store beside where it will be, so that it is there whole or not at all."""
        import zarr
        from zarr.storage import MemoryStore

        if path is None:
            group = zarr.open_group(MemoryStore(), mode="w", zarr_format=3)
            self._make(group, sweep, members, chunk)
            return group
        begun = path.with_name(f"{path.name}.begun")
        try:
            self._make(zarr.open_group(begun, mode="w", zarr_format=3), sweep, members, chunk)
            begun.replace(path)
            return zarr.open_group(path, mode="r+", zarr_format=3)
        except OSError as error:
            rmtree(begun, ignore_errors=True)
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None

    def _open(self, path: Path, sweep: Mapping[str, Any]) -> Any:
        import zarr

        try:
            group = zarr.open_group(path, mode="r+", zarr_format=3)
            attributes = dict(group.attrs)
        except Exception as error:  # whatever a damaged store makes Zarr raise
            raise InputError(
                f"{path}: no results of a sweep ({type(error).__name__}); remove it, or choose another DIR"
            ) from None
        if attributes.get("format") != FORMAT or "identity" not in attributes:
            raise InputError(f"{path}: not begun as results of a sweep; remove it, or choose another DIR")
        if attributes["identity"] != self._identity:
            other = json.loads(str(attributes["sweep"]))
            differs = [key for key in sweep if other.get(key) != sweep[key]]
            raise InputError(
                f"{path}: results of another sweep: {', '.join(differs) or 'its content'} differ; choose another "
                "DIR, or remove it"
            )
        return group

    def _make(self, group: Any, sweep: Mapping[str, Any], members: Members, chunk: int) -> None:
        labels = {name: found for name, found in members.outputs.labels.items() if _is_used(name, members)}
        for name, found in labels.items():
            place = group.create_array(name, shape=(len(found),), dtype=str, dimension_names=(name,))
            place[:] = np.array(found, dtype=np.dtypes.StringDType())
        if _is_used("time", members):
            place = group.create_array(
                "time", shape=(len(members.instants),), dtype="f8", dimension_names=("time",), attributes={"units": "s"}
            )
            place[:] = members.instants
        every = dict.fromkeys(members.names, ((), ())) | members.shapes
        for name, (dims, shape) in every.items():
            group.create_array(
                array_name(name), shape=(self.count, *shape), chunks=(chunk, *shape), dtype="f8", fill_value=np.nan,
                dimension_names=("member", *dims), attributes={"is": "variable" if name in members.names else "output"},
            )  # fmt: skip
        group.create_array(
            MESSAGE_NAME, shape=(self.count,), chunks=(chunk,), dtype=str, dimension_names=("member",), fill_value=""
        )
        _say_units(group, members)
        flags = {"flag_values": list(range(len(STATUS))), "flag_meanings": " ".join(STATUS)}
        group.create_array(
            STATUS_NAME, shape=(self.count,), chunks=(chunk,), dtype="u1", dimension_names=("member",),
            fill_value=PENDING, attributes=flags,
        )  # fmt: skip
        group.attrs.update(
            {"format": FORMAT, "units": UNITS, "sweep": json.dumps(sweep), "identity": self._identity}
        )  # last: what has none is no store of a sweep's


def _say_units(group: Any, members: Members) -> None:
    """Give each array its unit; where components differ, a coordinate beside it has each one's."""
    beside = []
    for name, units in members.units.items():
        array = group[array_name(name)]
        if joined(units) and "units" not in array.attrs:
            array.attrs["units"] = joined(units)
        if len(set(units)) > 1:
            beside.append(units_beside(name))
            if beside[-1] not in group:
                dimension = members.shapes[name][0][0]
                place = group.create_array(beside[-1], shape=(len(units),), dtype=str, dimension_names=(dimension,))
                place[:] = np.array(units, dtype=np.dtypes.StringDType())
    if beside and "coordinates" not in group.attrs:
        group.attrs["coordinates"] = " ".join(beside)  # what xarray takes for coordinates, not data


def _require_free_names(members: Members) -> None:
    """Refuse outputs that are called like something else in the store."""
    taken = {STATUS_NAME, MESSAGE_NAME, "member", "time", *members.outputs.labels, *map(array_name, members.names)}
    taken |= {units_beside(name) for name, units in members.units.items() if len(set(units)) > 1}
    for name in members.shapes:
        key = array_name(name)
        if key in taken:
            raise InputError(f"outputs: {name!r} is taken; choose another name")
        if key in ("", ".", "..", "zarr.json") or key.startswith("__") or "\0" in key:
            raise InputError(f"outputs: {name!r} can be no array's name in Zarr; choose another name")
        taken.add(key)


def _is_used(dimension: str, members: Members) -> bool:
    return any(dimension in dims for dims, _ in members.shapes.values())


def array_name(name: str) -> str:
    """Return what a variable or an output is called in the store: a slash would make groups of it."""
    return name.replace("/", "_")


def units_beside(name: str) -> str:
    """Return what the coordinate with the units of an output's components is called: one word."""
    return f"{'_'.join(array_name(name).split())}_unit"
