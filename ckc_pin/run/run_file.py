"""Run files: NumPy's npz without pickle, written whole or not at all, and read as if a stranger had made them."""

from __future__ import annotations

import math
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.spec import Vector3

__all__ = ["ARRAYS", "FORMAT", "OPTIONAL", "RunMeta", "hashes_of", "read_run", "write_run"]

FORMAT = 1
MAX_BYTES = 2**31  # of a run, expanded
MAX_META = 2**27  # of what it holds beside its arrays: as Python's objects that takes many times as much
MAX_HEADER = 10_000  # of an array's header; NumPy's own limit
ARRAYS = ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy")
OPTIONAL = ("lyapunov", "dissipated")
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


class _Event(msgspec.Struct):
    t: float
    name: str
    of: str
    coordinate: str | None
    value: float
    direction: int
    stop: bool


class _Stats(msgspec.Struct):
    rhs: int
    steps: int
    rejected: int
    newton: int
    factorizations: int
    method: str
    steps_by_method: dict[str, int]
    python_calls: int
    wall_s: float
    terms: Literal["pinocchio", "generated"] = "pinocchio"  # of files from before there were others
    rhs_by_terms: dict[str, int] = {}


class _Controller(msgspec.Struct):
    type: Literal["set_point", "tracking", "torques"]


class _Scene(msgspec.Struct):
    formulation: Literal["reduced", "spf", "dae"]
    epsilon: Annotated[float, msgspec.Meta(gt=0)]
    spf_coordinates: Literal["w", "z"]
    controller: _Controller | None = None
    parameters: dict[str, float | Vector3] = {}


class _Cost(msgspec.Struct):
    calls: int
    seconds: float


# what tables and figures read of them; the rest of a scene is checked where it is used
READ = {"events": list[_Event], "stats": _Stats, "scene": _Scene, "profile": dict[str, _Cost]}


def write_run(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    """Write a run's file (InputError where that cannot be)."""
    meta.hashes = hashes_of(meta)
    content = {
        **arrays,
        "coordinates": np.array(coordinates),
        "meta": np.frombuffer(msgspec.json.encode(meta), dtype=np.uint8),
    }
    with open_atomic(path) as file:
        np.savez_compressed(file, allow_pickle=False, **content)


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
        named = content.pop("coordinates")
        if named.ndim != 1 or named.dtype.kind != "U":
            raise InputError(f"{path}: damaged: coordinates is {named.shape} {named.dtype}, not names")
        coordinates = tuple(str(name) for name in named)
    except InputError:
        raise
    except Exception as error:  # whatever a damaged archive makes NumPy, zlib or msgspec raise
        raise InputError(f"{path}: not a run file, or damaged ({type(error).__name__}: {error})") from None
    if MECHANISM_FILE not in meta.texts or meta.hashes != hashes_of(meta):
        raise InputError(f"{path}: damaged: its texts do not match their hashes")
    for name, kind in READ.items():
        try:
            msgspec.convert(getattr(meta, name), kind)
        except msgspec.ValidationError as error:
            raise InputError(f"{path}: damaged: {name}: {error}") from None
    _check_shapes(path, coordinates, content, meta)
    return coordinates, content, meta


def _arrays(path: Path) -> dict[str, Any]:
    """Read the arrays, after everything that the file declares about them has been found harmless."""
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: a file of {path.stat().st_size} bytes; a run has at most {MAX_BYTES}")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        names = sorted(entry.filename for entry in entries)
        allowed = {f"{name}.npy" for name in (*ARRAYS, *OPTIONAL, *OTHERS)}
        needed = {f"{name}.npy" for name in (*ARRAYS, *OTHERS)}
        if len(set(names)) != len(names) or not needed <= set(names) <= allowed:
            arrays = ", ".join(name.removesuffix(".npy") for name in names[:20])
            raise InputError(f"{path}: not a run file: it holds {arrays or 'nothing'}")
        total = 0
        for entry in entries:
            size = _declared(path, archive, entry)
            total += size
            most = MAX_META if entry.filename == "meta.npy" else MAX_BYTES
            if size > most:
                raise InputError(f"{path}: an array of {size} bytes; a run has at most {most}")
        if total > MAX_BYTES:
            raise InputError(f"{path}: {total} bytes when expanded; a run has at most {MAX_BYTES}")
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


def _declared(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Bytes that an entry says it has, which is what would be allocated: by the archive and by the array's header."""
    with archive.open(entry) as file:
        if np.lib.format.read_magic(file) != (1, 0):  # a later version's header may itself be of 4 GiB
            raise InputError(f"{path}: damaged: {entry.filename} has a header that a run does not need")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER)
    if dtype.hasobject:
        raise InputError(f"{path}: damaged: {entry.filename} holds Python objects")
    return max(dtype.itemsize * math.prod(shape), entry.file_size)


def _check_shapes(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    rows = len(arrays["t"]) if arrays["t"].ndim == 1 else 0
    closure = arrays["phi"].shape[1:]
    n = (len(coordinates),)
    wanted = {"t": (), "energy": (), "lyapunov": (), "dissipated": (), "phi": closure, "w": closure, "q_tree": n,
              "v_tree": n, "u": (len(meta.independent),), "tau": (len(meta.actuated),)}  # fmt: skip
    for name, array in arrays.items():
        if array.shape != (rows, *wanted[name]) or array.dtype != np.float64 or not rows:
            raise InputError(f"{path}: damaged: {name} is {array.shape} {array.dtype}, which does not fit the rest")
    for name in ("t", "q_tree"):
        if not np.all(np.isfinite(arrays[name])):
            raise InputError(f"{path}: damaged: {name} holds numbers that are not finite")
    if not np.all(np.diff(arrays["t"]) > 0):
        raise InputError(f"{path}: damaged: t does not increase")


def hashes_of(meta: RunMeta) -> dict[str, str]:
    """SHA-256 of every text, and of the scene as resolved."""
    scene = msgspec.json.encode(meta.scene, order="sorted")
    return {
        "scene": sha256(scene).hexdigest(),
        **{f"texts/{name}": sha256(text.encode()).hexdigest() for name, text in meta.texts.items()},
    }
