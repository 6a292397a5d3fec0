"""Files that stand whole or not at all: written beside their place and moved there.

What is being written is locked, so that a process killed meanwhile leaves something that the next one to write there
knows for left over, and one still at work leaves something that it does not touch.
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

UNFINISHED = ".unfinished"
PATIENCE = 10.0  # s


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write to; it takes its place when all is written, and on a failure what was there stays.

    Raises
    ------
    InputError
        It cannot be written.
    """
    if not path.name:
        raise InputError(f"{path}: a folder, not the name of a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clear(path)
        with _unfinished(path) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None


def write_atomic(path: Path, text: str) -> None:
    """Write a text as UTF-8 (InputError where that cannot be)."""
    with open_atomic(path) as file:
        file.write(text.encode())


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
    """Let one process at a time write the files of a result to a folder, so that they belong together.

    After `PATIENCE` it goes on beside the other one.
    """
    handle = os.open(folder, os.O_RDONLY)
    until = monotonic() + PATIENCE
    try:
        while not _locked(handle) and monotonic() < until:
            sleep(0.02)
        yield
    finally:
        os.close(handle)


def _locked(handle: int) -> bool:
    try:
        flock(handle, LOCK_EX | LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


@contextmanager
def _unfinished(path: Path) -> Iterator[BinaryIO]:
    """Make the file beside its place, locked, under a name of its own; it is gone afterwards unless it was moved."""
    temporary = path.with_name(f"{_prefix(path)}{uuid4().hex}{UNFINISHED}")
    try:
        with ExitStack() as stack:
            while not lexists(temporary):  # at first, and when it was taken for left over before it was locked
                file = stack.enter_context(temporary.open("xb"))
                with suppress(OSError):  # a file system without locks
                    flock(file, LOCK_EX)
            yield file
    finally:
        temporary.unlink(missing_ok=True)


def _prefix(path: Path) -> str:
    return f".{path.name[:50]}."  # a file system takes 255 bytes


def _clear(path: Path) -> None:
    """Remove what processes that are no more have left of this file."""
    for name in os.listdir(path.parent):
        if not (name.startswith(_prefix(path)) and name.endswith(UNFINISHED)):
            continue
        with suppress(OSError), (path.parent / name).open("rb") as file:
            flock(file, LOCK_EX | LOCK_NB)
            os.unlink(path.parent / name)


def _sync_folder(folder: Path) -> None:
    """Make the new name last as well when the machine goes down; some file systems have no such thing."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
