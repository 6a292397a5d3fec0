"""Write files atomically: to a temporary file in the same folder, which then replaces the target.

The temporary file is locked while it is written. The next process that writes the same target removes temporary files
that no process locks, since a killed process left them, and leaves locked ones alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from fcntl import LOCK_EX, LOCK_NB, flock
from os.path import lexists
from pathlib import Path
from time import monotonic, sleep
from typing import BinaryIO
from uuid import uuid4

from ckc_pin.errors import InputError

__all__ = ["lock_folder", "open_atomic", "temporary_folder", "write_atomic"]

UNFINISHED = ".unfinished"  # suffix of temporary files
LOCK_TIMEOUT_S = 10.0
LOCK_POLL_S = 0.02
MAX_NAME = 50  # characters of the target's name in the temporary one; a file system allows 255 bytes


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a file that replaces `path` when the block ends without an error; otherwise `path` stays as it was.

    Parameters
    ----------
    path : Path
        The target. Missing folders are created.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    if not path.name:
        raise InputError(f"{path}: expected the name of a file, got a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        with _temporary_file(path) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write bytes, or a text as UTF-8, atomically. Raises as `open_atomic` does."""
    with open_atomic(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def temporary_folder(place: Path | None = None) -> Iterator[Path]:
    """Create a folder in `place` (absent: the system's temporary directory) and remove it with its content afterwards.

    `tempfile.TemporaryDirectory` leaves the folder behind if an interrupt arrives while it is created.
    """
    import shutil
    import tempfile

    folder = (Path(tempfile.gettempdir()) if place is None else place) / f"ckc_pin-{uuid4().hex}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Let one process at a time write to a folder, so that the files of a result belong together.

    If another process still holds the lock after `LOCK_TIMEOUT_S`, the block runs without it.
    """
    handle = os.open(folder, os.O_RDONLY)
    deadline = monotonic() + LOCK_TIMEOUT_S
    try:
        while not _try_lock(handle) and monotonic() < deadline:
            sleep(LOCK_POLL_S)
        yield
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool:
    try:
        flock(handle, LOCK_EX | LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # the file system has no locks
        pass
    return True


@contextmanager
def _temporary_file(path: Path) -> Iterator[BinaryIO]:
    """Create a locked file with a unique name in the folder of `path`. It is removed afterwards unless it was moved."""
    temporary = path.with_name(f"{_prefix(path)}{uuid4().hex}{UNFINISHED}")
    try:
        with ExitStack() as stack:
            # Another process may remove the file before it is locked; then it is created again.
            while not lexists(temporary):
                file = stack.enter_context(temporary.open("xb"))
                with suppress(OSError):  # the file system has no locks
                    flock(file, LOCK_EX)
            yield file
    finally:
        temporary.unlink(missing_ok=True)


def _prefix(path: Path) -> str:
    return f".{path.name[:MAX_NAME]}."


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files of `path` that killed processes have left."""
    for name in os.listdir(path.parent):
        if not (name.startswith(_prefix(path)) and name.endswith(UNFINISHED)):
            continue
        with suppress(OSError), (path.parent / name).open("rb") as file:
            flock(file, LOCK_EX | LOCK_NB)
            os.unlink(path.parent / name)


def _sync_folder(folder: Path) -> None:
    """Flush the folder to disk, so that the new name survives a power failure; not all file systems can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
