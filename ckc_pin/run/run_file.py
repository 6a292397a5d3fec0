"""Read and write run files: NumPy npz without pickle, written atomically and read as untrusted input."""

from __future__ import annotations

import math
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.atomic_files import open_atomic
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.spec import FrameSpec, Vector3
from ckc_pin.scene.spec import InitialSpec, PrescribedSpec

if TYPE_CHECKING:
    import zipfile

__all__ = ["ARRAYS", "FORMAT", "OPTIONAL", "WORKS", "RunMeta", "hashes_of", "read_run", "write_run"]

FORMAT = 1
MAX_BYTES = 2**31  # of an uncompressed run
MAX_META_BYTES = 2**27  # of the JSON beside the arrays, which takes many times as much memory when it is parsed
MAX_HEADER_BYTES = 10_000  # of an array's header; NumPy's own limit
ARRAYS = ("t", "q_tree", "v_tree", "u", "tau", "phi", "w", "energy")
OPTIONAL = ("lyapunov", "dissipated", "works", "force_values", "prescribed_states")
WORKS = ("motors", "dampers", "friction", "forces", "impacts")  # columns of `Run.works`
OTHERS = ("coordinates", "meta")


class RunMeta(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Content of a run file beside its arrays, stored as JSON. Numbers that are not finite are null."""

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
    warnings: tuple[str, ...] = ()  # old files have no such key
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
    terms: Literal["pinocchio", "generated"] = "pinocchio"  # old files have no such key
    rhs_by_terms: dict[str, int] = {}


class _Controller(msgspec.Struct):
    type: Literal["set_point", "tracking", "joint_servo", "torques"]


class _Force(msgspec.Struct):
    frame: str | FrameSpec
    axes: Literal["world", "frame"] = "world"


class _Scene(msgspec.Struct):
    formulation: Literal["reduced", "spf", "dae"]
    epsilon: Annotated[float, msgspec.Meta(gt=0)]
    spf_coordinates: Literal["w", "z"]
    controller: _Controller | None = None
    parameters: dict[str, float | Vector3] = {}
    force: list[_Force] = []
    prescribed: list[PrescribedSpec] = []
    initial: InitialSpec = InitialSpec()


class _Cost(msgspec.Struct):
    calls: int
    seconds: float


# Parts that tables and figures read without further checks. The rest of a scene is checked where it is used.
CHECKED_TYPES = {"events": list[_Event], "stats": _Stats, "scene": _Scene, "profile": dict[str, _Cost]}


def write_run(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    """Write a run file (InputError if it cannot be written)."""
    meta.hashes = hashes_of(meta)
    content = {
        **arrays,
        "coordinates": np.array(coordinates),
        "meta": np.frombuffer(msgspec.json.encode(meta), dtype=np.uint8),
    }
    with open_atomic(path) as file:
        np.savez_compressed(file, allow_pickle=False, **content)


def read_run(path: Path) -> tuple[tuple[str, ...], dict[str, Array], RunMeta]:
    """Read a run file.

    Returns
    -------
    coordinates : tuple of str
    arrays : dict of str to array
    meta : RunMeta

    Raises
    ------
    InputError
        The file is no run file, damaged, too large, or of another version.
    """
    try:
        content = _read_arrays(path)
        encoded = content.pop("meta").tobytes()
        version = msgspec.json.decode(encoded, type=dict[str, Any]).get("format")
        if version != FORMAT:
            raise InputError(f"{path}: a run of format {version}; this program reads format {FORMAT}")
        meta = msgspec.json.decode(encoded, type=RunMeta)
        names = content.pop("coordinates")
        if names.ndim != 1 or names.dtype.kind != "U":
            raise InputError(f"{path}: damaged: coordinates is {names.shape} {names.dtype}, not names")
        coordinates = tuple(str(name) for name in names)
    except InputError:
        raise
    except Exception as error:  # NumPy, zlib and msgspec raise various errors for a damaged archive.
        raise InputError(f"{path}: not a run file, or damaged ({type(error).__name__}: {error})") from None
    if MECHANISM_FILE not in meta.texts or meta.hashes != hashes_of(meta):
        raise InputError(f"{path}: damaged: its texts do not match their hashes")
    for name, kind in CHECKED_TYPES.items():
        try:
            msgspec.convert(getattr(meta, name), kind)
        except msgspec.ValidationError as error:
            raise InputError(f"{path}: damaged: {name}: {error}") from None
    _check_shapes(path, coordinates, content, meta)
    return coordinates, content, meta


def _read_arrays(path: Path) -> dict[str, Any]:
    """Read the arrays, after checking the names, sizes and types that the file declares."""
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: a file of {path.stat().st_size} bytes; a run has at most {MAX_BYTES}")
    import zipfile

    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        names = sorted(entry.filename for entry in entries)
        allowed = {f"{name}.npy" for name in (*ARRAYS, *OPTIONAL, *OTHERS)}
        required = {f"{name}.npy" for name in (*ARRAYS, *OTHERS)}
        if len(set(names)) != len(names) or not required <= set(names) <= allowed:
            arrays = ", ".join(name.removesuffix(".npy") for name in names[:20])
            raise InputError(f"{path}: not a run file: it contains {arrays or 'nothing'}")
        total = 0
        for entry in entries:
            size = _declared_bytes(path, archive, entry)
            total += size
            limit = MAX_META_BYTES if entry.filename == "meta.npy" else MAX_BYTES
            if size > limit:
                raise InputError(f"{path}: an array of {size} bytes; a run has at most {limit}")
        if total > MAX_BYTES:
            raise InputError(f"{path}: {total} bytes when expanded; a run has at most {MAX_BYTES}")
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


def _declared_bytes(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Return the bytes that reading an entry would allocate, by the archive and by the array's header."""
    with archive.open(entry) as file:
        if np.lib.format.read_magic(file) != (1, 0):  # Headers of later versions may have up to 4 GiB.
            raise InputError(f"{path}: damaged: {entry.filename} has an array header of an unsupported version")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER_BYTES)
    if dtype.hasobject:
        raise InputError(f"{path}: damaged: {entry.filename} contains Python objects")
    return max(dtype.itemsize * math.prod(shape), entry.file_size)


def _check_shapes(path: Path, coordinates: tuple[str, ...], arrays: dict[str, Array], meta: RunMeta) -> None:
    """Raise InputError for shapes, types or times that no run has."""
    rows = len(arrays["t"]) if arrays["t"].ndim == 1 else 0
    closure = arrays["phi"].shape[1:]
    n = (len(coordinates),)
    shapes = {"t": (), "energy": (), "lyapunov": (), "dissipated": (), "phi": closure, "w": closure, "q_tree": n,
              "v_tree": n, "u": (len(meta.independent),), "tau": (len(meta.actuated),), "works": (len(WORKS),),
              "force_values": (6 * len(meta.scene.get("force", [])),),
              "prescribed_states": (2 * len(meta.scene.get("prescribed", [])),)}  # fmt: skip
    for name, array in arrays.items():
        if array.shape != (rows, *shapes[name]) or array.dtype != np.float64 or not rows:
            raise InputError(
                f"{path}: damaged: {name} is {array.shape} {array.dtype}, which does not fit the other arrays"
            )
    for name in ("t", "q_tree"):
        if not np.all(np.isfinite(arrays[name])):
            raise InputError(f"{path}: damaged: {name} contains numbers that are not finite")
    if not np.all(np.diff(arrays["t"]) > 0):
        raise InputError(f"{path}: damaged: t does not increase")


def hashes_of(meta: RunMeta) -> dict[str, str]:
    """Return the SHA-256 of every text and of the scene."""
    scene = msgspec.json.encode(meta.scene, order="sorted")
    return {
        "scene": sha256(scene).hexdigest(),
        **{f"texts/{name}": sha256(text.encode()).hexdigest() for name, text in meta.texts.items()},
    }
