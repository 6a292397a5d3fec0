"""A Zarr store that compares every file with its checksum when it is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from zarr.storage import LocalStore, WrapperStore

from ckc_pin.ensembles.checksums import (
    NO_FILE,
    ChunkChecksums,
    Rows,
    checksum,
    checksum_file,
    describe_damage,
)
from ckc_pin.errors import InputError

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype

__all__ = ["VerifiedStore", "open_verified"]


def open_verified(checksums: ChunkChecksums, files: Mapping[str, str]) -> VerifiedStore:
    """Open a finished store for reading.

    Parameters
    ----------
    checksums : ChunkChecksums
    files : mapping of str to str
        Checksums of the files that are not chunks of members.
    """
    rows = checksums.read()
    for k, row in enumerate(rows):  # the table has the checksum of the statuses instead of their file's
        row[0] = np.frombuffer(checksum_file(checksums.path / checksums.key(k, 0)), np.uint8)
    columns = {name: column for column, name in enumerate(checksums.names)}
    return VerifiedStore(LocalStore(checksums.path, read_only=True), columns, rows, files)


class VerifiedStore(WrapperStore[LocalStore]):
    """A finished store for reading. Reading a file that was damaged or removed raises InputError.

    Parameters
    ----------
    store : LocalStore
    columns : mapping of str to int
        The column of each array over members in `rows`.
    rows : (chunks, arrays, bytes) array
        Checksums of all these arrays' chunk files.
    files : mapping of str to str
        Checksums of other files, in hexadecimal digits.
    """

    def __init__(self, store: LocalStore, columns: Mapping[str, int], rows: Rows, files: Mapping[str, str]) -> None:
        super().__init__(store)
        self._columns, self._rows, self._files = columns, rows, files

    def _with_store(self, store: LocalStore) -> VerifiedStore:
        return VerifiedStore(store, self._columns, self._rows, self._files)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Read a file (InputError if its checksum is wrong)."""
        data = await super().get(key, prototype, byte_range)
        expected = self._expected(key)
        if expected is not None and expected != (NO_FILE if data is None else checksum(data.to_bytes())):
            file = Path(self._store.root) / key
            raise InputError(f"{file} {describe_damage(file)}; run the same sweep again to compute its members again")
        return data

    def _expected(self, key: str) -> bytes | None:
        name, _, chunk = key.partition("/c/")
        if name in self._columns and chunk:
            return self._rows[int(chunk.partition("/")[0]), self._columns[name]].tobytes()
        return bytes.fromhex(self._files[key]) if key in self._files else None
