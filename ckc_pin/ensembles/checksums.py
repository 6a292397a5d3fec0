"""Checksums of the files in an ensemble's store, which detect damaged and missing files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ckc_pin.ensembles.members import PENDING, STATUS

__all__ = ["CHECKSUMS", "NO_FILE", "ChunkChecksums", "checksum", "checksum_file", "describe_damage", "read_slices"]

CHECKSUMS = "checksums"  # a group, because xarray reads every array in the results' group as a result
TABLE = f"{CHECKSUMS}/chunks"
CHECKSUM_BYTES = 16
NO_FILE = bytes(CHECKSUM_BYTES)  # Zarr writes no file for a chunk that has only fill values
UNREADABLE = b""  # not equal to any checksum
Statuses = NDArray[np.uint8]
Rows = NDArray[np.uint8]


def checksum(data: bytes) -> bytes:
    """Return the checksum of bytes."""
    return blake2b(data, digest_size=CHECKSUM_BYTES).digest()


def checksum_file(path: Path) -> bytes:
    """Return the checksum of a file, or `NO_FILE` if the file does not exist."""
    try:
        return checksum(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return NO_FILE
    except OSError:
        return UNREADABLE


def describe_damage(path: Path) -> str:
    """Return whether a file with a wrong checksum is damaged or missing, as the predicate of a sentence."""
    return "is damaged" if path.exists() else "is missing"


class ChunkChecksums:
    """Table of the checksums of chunks in a store: one row for each chunk of members, one entry for each array.

    The entry of the first array, the status, is a checksum of the statuses themselves, because a chunk's row is written
    before its status. The other entries are checksums of the chunk's files.

    Parameters
    ----------
    group : zarr.Group
    path : Path
        The group's folder.
    names : sequence of str
        Names of the arrays over members, the status first.
    chunk : int
        Number of members in a chunk.
    """

    def __init__(self, group: Any, path: Path, names: Sequence[str], chunk: int) -> None:
        self.path, self.names, self._chunk = path, tuple(names), chunk
        self._arrays = [group[name] for name in names]
        self._table = group[TABLE]

    @staticmethod
    def create_table(group: Any, chunks: int, arrays: int) -> None:
        """Create the array that holds the table."""
        shape = (arrays, CHECKSUM_BYTES)
        group.create_array(
            TABLE, shape=(chunks, *shape), chunks=(1, *shape), dtype="u1", fill_value=0, compressors=None
        )

    def key(self, k: int, column: int) -> str:
        """Return the file of an array's chunk, relative to the store."""
        array = self._arrays[column]
        return f"{self.names[column]}/{array.metadata.encode_chunk_key((k,) + (0,) * (array.ndim - 1))}"

    def table_key(self, k: int) -> str:
        """Return the file of a row of the table, relative to the store."""
        return f"{TABLE}/{self._table.metadata.encode_chunk_key((k, 0, 0))}"

    def compute(self, k: int, status: Statuses) -> Rows:
        """Return the row of a chunk from its statuses and from its files."""
        files = [checksum_file(self.path / self.key(k, column)) for column in range(1, len(self.names))]
        row = np.zeros((len(self.names), CHECKSUM_BYTES), np.uint8)
        for entry, value in zip(row, [checksum(status.tobytes()), *files], strict=True):
            entry[: len(value)] = np.frombuffer(value, np.uint8)
        return row

    def write(self, k: int, status: Statuses) -> None:
        """Write the row of a chunk. Its files must have been written before."""
        self._table[k] = self.compute(k, status)

    def read(self) -> Rows:
        """Return the table, with zeros in missing and unreadable rows."""
        return np.concatenate(list(read_slices(self._table, 0, self._table.shape[0], 1)))

    def find_damage(self, statuses: Iterable[Statuses]) -> Iterator[tuple[int, str]]:
        """Yield the indices of damaged chunks, each with a sentence about its first damaged file.

        Parameters
        ----------
        statuses : iterable of array
            Statuses of each chunk; all pending if they cannot be read.
        """
        for k, (status, row) in enumerate(zip(statuses, self.read(), strict=True)):
            if (status == PENDING).all():
                if row.any() or (self.path / self.key(k, 0)).exists():  # a pending chunk has neither
                    yield k, f"{self.key(k, 0)} {describe_damage(self.path / self.key(k, 0))}"
            elif not row.any():
                yield k, f"{self.table_key(k)} {describe_damage(self.path / self.table_key(k))}"
            else:
                wrong = np.flatnonzero((self.compute(k, status) != row).any(axis=1))
                if len(wrong):
                    key = self.key(k, int(wrong[0]))
                    yield k, f"{key} {describe_damage(self.path / key)}"

    def add_missing_checksums(self, statuses: Iterable[Statuses]) -> Iterator[tuple[int, str]]:
        """Write the rows of chunks without checksums; yield chunks that cannot be read, as `find_damage` does.

        Parameters
        ----------
        statuses : iterable of array
        """
        for k, status in enumerate(statuses):
            if (status == PENDING).any():
                continue
            unreadable = self._find_unreadable(k, status)
            if unreadable:
                yield k, f"{unreadable} {describe_damage(self.path / unreadable)}"
            else:
                self.write(k, status)

    def _find_unreadable(self, k: int, status: Statuses) -> str:
        """Return an unreadable file of a chunk, or an empty string. Only messages may have no file."""
        if (status >= len(STATUS)).any():
            return self.key(k, 0)
        members = slice(k * self._chunk, (k + 1) * self._chunk)
        for column, array in enumerate(self._arrays):
            key = self.key(k, column)
            try:
                array[members]
                is_readable = array.dtype.kind != "f" or (self.path / key).exists()
            except Exception:  # a damaged file may make Zarr's codecs raise anything
                is_readable = False
            if not is_readable:
                return key
        return ""

    def remove_chunk(self, k: int) -> None:
        """Remove the files of a chunk, its status first, which makes its members pending."""
        keys = [self.key(k, column) for column in range(len(self.names))]
        for key in (*keys, self.table_key(k)):
            with suppress(FileNotFoundError, NotADirectoryError):
                (self.path / key).unlink()


def read_slices(array: Any, first: int, end: int, step: int) -> Iterator[NDArray[Any]]:
    """Yield a part of an array as a whole, or chunk by chunk if that fails; unreadable chunks have fill values."""
    try:
        yield array[first:end]
    except Exception:  # a damaged file may make Zarr's codecs raise anything
        for start in range(first, end, step):
            try:
                yield array[start : min(start + step, end)]
            except Exception:  # this chunk is damaged
                yield np.full((min(step, end - start), *array.shape[1:]), array.fill_value, array.dtype)
