"""Run files: NumPy's npz without pickle, written whole or not at all, and read as if a stranger had made them."""

from __future__ import annotations

import os
import tempfile
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.tree import Array

__all__ = ["ARRAYS", "FORMAT", "OPTIONAL", "RunMeta", "read_run", "write_run"]

FORMAT = 1
MAX_BYTES = 2**31  # of one array, before it is expanded
ARRAYS = ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy")
OPTIONAL = ("lyapunov",)
OTHERS = ("coordinates", "meta")


class RunMeta(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What a run file holds beside its arrays, as JSON; a number that is not finite is null."""

    format: int = FORMAT
    hashes: dict[str, str] = {}
    status: Literal["done", "stopped", "interrupted"]
    message: str
    independent: tuple[str, ...]
    actuated: tuple[str, ...]
    max_phi: float | None
    max_phi_dot: float | None
    events: list[dict[str, Any]]
    stats: dict[str, Any]
    scene_name: str
    scene: dict[str, Any]
    texts: dict[str, str]
    profile: dict[str, Any]


def write_run(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    """Write a file beside its place and move it there, so that a failure leaves what was there before."""
    meta.hashes = _hashes(meta)
    content = {
        **arrays,
        "coordinates": np.array(coordinates),
        "meta": np.frombuffer(msgspec.json.encode(meta), dtype=np.uint8),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_run(path: Path) -> tuple[tuple[str, ...], dict[str, Array], RunMeta]:
    """Read coordinates, arrays and the rest.

    Raises
    ------
    InputError
        Not a run file, damaged, too large, or of another version.
    """
    try:
        content = _arrays(path)
        rest = content.pop("meta").tobytes()
        version = msgspec.json.decode(rest, type=dict[str, Any]).get("format")
        if version != FORMAT:
            raise InputError(f"{path}: a run of format {version}; this program reads format {FORMAT}")
        meta = msgspec.json.decode(rest, type=RunMeta)
        coordinates = tuple(str(name) for name in content.pop("coordinates"))
    except InputError:
        raise
    except Exception as error:  # whatever a damaged archive makes NumPy, zlib or msgspec raise
        raise InputError(f"{path}: not a run file, or damaged ({type(error).__name__}: {error})") from None
    if MECHANISM_FILE not in meta.texts or meta.hashes != _hashes(meta):
        raise InputError(f"{path}: damaged: its texts do not match their hashes")
    _check_shapes(path, coordinates, content, meta)
    return coordinates, content, meta


def _arrays(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        names = {entry.filename.removesuffix(".npy") for entry in archive.infolist()}
        if not {*ARRAYS, *OTHERS} <= names <= {*ARRAYS, *OPTIONAL, *OTHERS}:
            raise InputError(f"{path}: not a run file: it holds {', '.join(sorted(names)) or 'nothing'}")
        for entry in archive.infolist():
            _check_size(path, archive, entry)
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


def _check_size(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Bound what NumPy will allocate, which it takes from the array's header alone."""
    with archive.open(entry) as file:
        major, _ = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    size = dtype.itemsize
    for length in shape:
        size *= length
    if max(size, entry.file_size) > MAX_BYTES:
        raise InputError(f"{path}: an array of {max(size, entry.file_size)} bytes; a run has at most {MAX_BYTES}")


def _check_shapes(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    rows = len(arrays["t"]) if arrays["t"].ndim == 1 else 0
    closure = arrays["phi"].shape[1:]
    n = (len(coordinates),)
    wanted = {"t": (), "energy": (), "lyapunov": (), "phi": closure, "w": closure, "q_tree": n, "v_tree": n,
              "u": (len(meta.independent),), "tau": (len(meta.actuated),)}  # fmt: skip
    for name, array in arrays.items():
        if array.shape != (rows, *wanted[name]) or array.dtype != np.float64 or not rows:
            raise InputError(f"{path}: damaged: {name} is {array.shape} {array.dtype}, which does not fit the rest")
    if not np.all(np.diff(arrays["t"]) > 0):
        raise InputError(f"{path}: damaged: t does not increase")


def _hashes(meta: RunMeta) -> dict[str, str]:
    """SHA-256 of every text, and of the scene as resolved."""
    scene = msgspec.json.encode(meta.scene, order="sorted")
    return {
        "scene": sha256(scene).hexdigest(),
        **{f"texts/{name}": sha256(text.encode()).hexdigest() for name, text in meta.texts.items()},
    }
