"""Store of an ensemble's results: a Zarr group that xarray opens, written atomically chunk by chunk.

Every file has a checksum: a table in the group has those of the chunks, the group's attributes those of all other
files. They are checked when a store is opened again. Damaged chunks become pending, other damaged files are written
again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ckc_pin.ensembles.checksums import ChunkChecksums, read_slices
from ckc_pin.ensembles.members import PENDING, STATUS, Chunk, Members
from ckc_pin.ensembles.store_layout import (
    FORMAT,
    MESSAGE_NAME,
    STATUS_NAME,
    array_name,
    array_names,
    convert_files,
    create_arrays,
    create_store,
    identify,
    read_files_attributes,
    read_store_attributes,
    require_free_names,
    restore_files,
    set_store_attributes,
)
from ckc_pin.errors import InputError

__all__ = ["RESULTS", "RESUME_HINT", "Store", "require_libraries"]

RESULTS = "results.zarr"
BLOCK_SIZE = 2**20  # members whose status is read at once
MAX_NAMED_CHUNKS = 3  # damaged chunks that one message names
RESUME_HINT = "finished members are kept, and the same command resumes the sweep"


def require_libraries() -> None:
    """Raise InputError if xarray or Zarr is not installed."""
    try:
        import xarray  # noqa: F401
        import zarr  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(
            f"ensembles need {error.name}, which is not installed: pip install ckc_pin[ensembles]"
        ) from None


class Store:
    """The results of one sweep.

    Parameters
    ----------
    path : Path or None
        The group's folder; None for a store in memory.
    sweep : mapping
        Everything that the results depend on. A store can only be resumed with the same content.
    members : Members
    count : int
        Number of members.
    chunk : int
        Number of members that are written together. An existing store keeps its number.

    Raises
    ------
    InputError
        The store belongs to another sweep, is not a store, cannot be repaired, or cannot be written.

    Attributes
    ----------
    chunk : int
    repairs : str
        One line about damaged files that were repaired or are computed again; empty without any.
    """

    def __init__(self, path: Path | None, sweep: Mapping[str, Any], members: Members, count: int, chunk: int) -> None:
        self.path, self.count = path, count
        require_free_names(members)
        self._members, self._sweep = members, json.loads(json.dumps(sweep))
        self.repairs = ""
        self._checksums: ChunkChecksums | None = None
        if path is None:
            self._group, self.chunk = self._create_in_memory(min(chunk, count)), min(chunk, count)
            return
        if path.exists():
            self._open(path)
        else:
            self._begin(path, min(chunk, count))

    def open(self) -> Any:
        """Return the store for xarray, which verifies checksums if it is on disk."""
        if self._checksums is None:
            return self._group.store
        from ckc_pin.ensembles.verified_store import open_verified

        return open_verified(self._checksums, read_files_attributes(self._checksums.path)["files"])

    def find_pending(self) -> Iterator[tuple[int, int]]:
        """Yield first and end of the members of each pending chunk."""
        for block, status in self._statuses():
            for first in range(0, len(status), self.chunk):
                end = min(first + self.chunk, len(status))
                if (status[first:end] == PENDING).any():
                    yield block + first, block + end

    def count_statuses(self) -> dict[str, int]:
        """Return the number of members by status."""
        counts = np.zeros(len(STATUS), dtype=np.int64)
        for _, status in self._statuses():
            counts += np.bincount(status, minlength=len(STATUS))
        return {name: int(counts[k]) for k, name in enumerate(STATUS)}

    def _statuses(self) -> Iterator[tuple[int, Any]]:
        """Yield first member and statuses of blocks of many chunks."""
        status: Any = self._group[STATUS_NAME]
        step = self.chunk * max(1, BLOCK_SIZE // self.chunk)
        for first in range(0, self.count, step):
            for part in read_slices(status, first, min(first + step, self.count), self.chunk):
                yield first, part
                first += len(part)

    def _chunk_statuses(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the statuses of each chunk."""
        for _, status in self._statuses():
            for first in range(0, len(status), self.chunk):
                yield status[first : first + self.chunk]

    def write(self, chunk: Chunk, names: tuple[str, ...]) -> None:
        """Write a chunk. Its status is written last, which marks the chunk as complete.

        Raises
        ------
        InputError
            The chunk cannot be written, for example because the disk is full. Earlier chunks are complete.
        """
        members = slice(chunk.first, chunk.first + len(chunk.status))
        group: Any = self._group
        try:
            for k, name in enumerate(names):
                group[array_name(name)][members] = chunk.values[:, k]
            for name, values in chunk.outputs.items():
                group[array_name(name)][members] = values
            if any(chunk.message):
                group[MESSAGE_NAME][members] = np.array(chunk.message, dtype=np.dtypes.StringDType())
            if self._checksums is not None:
                self._checksums.write(chunk.first // self.chunk, chunk.status)
            group[STATUS_NAME][members] = chunk.status
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}; {RESUME_HINT}") from None

    def _create_in_memory(self, chunk: int) -> Any:
        import zarr
        from zarr.storage import MemoryStore

        group = zarr.open_group(MemoryStore(), mode="w", zarr_format=3)
        create_arrays(group, self._members, self.count, chunk)
        set_store_attributes(group, self._sweep)
        return group

    def _create(self, chunk: int) -> Callable[[Path], None]:
        """Return the function that creates this store in a folder."""
        return lambda folder: create_store(folder, self._sweep, self._members, self.count, chunk)

    def _begin(self, path: Path, chunk: int) -> None:
        """Create a store in a temporary folder and move it into place, so that no partial store is visible."""
        begun = path.with_name(f"{path.name}.begun")
        try:
            self._create(chunk)(begun)
            begun.replace(path)
        except BaseException as error:  # an interrupt, too
            rmtree(begun, ignore_errors=True)
            if isinstance(error, OSError):
                raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
            raise
        self._use(path)

    def _open(self, path: Path) -> None:
        """Open an existing store and repair it."""
        attributes = read_store_attributes(path)
        if attributes["identity"] != identify(self._sweep):
            stored = json.loads(attributes["sweep"])
            differences = [key for key in self._sweep if stored.get(key) != self._sweep[key]]
            raise InputError(
                f"{path}: results of another sweep: {', '.join(differences) or 'its content'} differ; choose another "
                "DIR, or remove it"
            )
        try:
            if attributes["format"] == FORMAT:
                layout = read_files_attributes(path)
                restored = restore_files(path, self._create(layout["chunk"]), layout["files"])
                checksums = self._use(path)
                self._repair(checksums, restored, checksums.find_damage(self._chunk_statuses()))
            else:
                finish = convert_files(path, self._create)
                checksums = self._use(path)
                self._repair(checksums, [], checksums.add_missing_checksums(self._chunk_statuses()))
                finish()
        except OSError as error:
            raise InputError(f"{path}: cannot be repaired or converted: {error.strerror or error}") from None

    def _use(self, path: Path) -> ChunkChecksums:
        import zarr

        self._group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
        self.chunk = self._group[STATUS_NAME].chunks[0]
        checksums = self._checksums = ChunkChecksums(self._group, path, array_names(self._members), self.chunk)
        return checksums

    def _repair(self, checksums: ChunkChecksums, restored: list[str], damage: Iterable[tuple[int, str]]) -> None:
        """Make damaged chunks pending, and describe all repairs."""
        damaged = []
        for k, sentence in damage:
            checksums.remove_chunk(k)
            damaged.append(f"members {k * self.chunk} to {min((k + 1) * self.chunk, self.count) - 1} ({sentence})")
        parts = [f"written again: {_join(restored)}"] if restored else []
        parts += [f"computed again: {_join(damaged)}"] if damaged else []
        self.repairs = f"{self.path}: {'; '.join(parts)}" if parts else ""


def _join(parts: list[str]) -> str:
    omitted = len(parts) - MAX_NAMED_CHUNKS
    return ", ".join(parts[:MAX_NAMED_CHUNKS]) + (f" and {omitted} more" if omitted > 0 else "")
