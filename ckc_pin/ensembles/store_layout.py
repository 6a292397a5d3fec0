"""The files of an ensemble's store that never change: its arrays' documents, labels and attributes.

The attributes of the group and of its group of checksums have a checksum of their own. The latter have the checksums of
all these files. The files follow from the sweep, so that damaged ones are written again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ckc_pin.base.atomic_files import open_atomic, temporary_folder
from ckc_pin.base.interrupt import uninterrupted_thread
from ckc_pin.ensembles.checksums import CHECKSUMS, ChunkChecksums, checksum, checksum_file, describe_damage
from ckc_pin.ensembles.members import PENDING, STATUS, Members
from ckc_pin.errors import InputError
from ckc_pin.mechanism.units import joined

__all__ = [
    "FORMAT", "MESSAGE_NAME", "STATUS_NAME", "array_name", "array_names",
    "convert_files", "create_arrays", "create_store", "identify", "read_files_attributes", "read_store_attributes",
    "require_free_names", "restore_files", "set_store_attributes", "units_beside",
]  # fmt: skip

FORMAT = 2
FORMAT_WITHOUT_CHECKSUMS = 1
DOCUMENT = "zarr.json"
REMOVE = "remove it, or choose another DIR"
STATUS_NAME, MESSAGE_NAME = "status", "message"
UNITS = "SI units: s, m, rad, kg, N, N m, J"


def create_store(folder: Path, sweep: Mapping[str, Any], members: Members, count: int, chunk: int) -> None:
    """Create a store in a folder; one without attributes is not finished."""
    # Zarr writes files in a thread of its own. It would go on after an interrupt, while the caller removes the folder.
    with uninterrupted_thread() as pool:
        pool.submit(_write_store, folder, sweep, members, count, chunk).result()


def _write_store(folder: Path, sweep: Mapping[str, Any], members: Members, count: int, chunk: int) -> None:
    import zarr

    group = zarr.open_group(folder, mode="w", zarr_format=3)
    create_arrays(group, members, count, chunk)
    ChunkChecksums.create_table(group, -(-count // chunk), len(array_names(members)))
    keys = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    files = {key: checksum_file(folder / key).hex() for key in keys if key not in (DOCUMENT, f"{CHECKSUMS}/{DOCUMENT}")}
    _set_attributes(group[CHECKSUMS], {"chunk": chunk, "files": files})
    set_store_attributes(group, sweep)


def array_names(members: Members) -> list[str]:
    """Return the arrays over members, the status first."""
    return [STATUS_NAME, MESSAGE_NAME, *map(array_name, (*members.names, *members.shapes))]


def identify(sweep: Any) -> str:
    """Return a checksum of all that the results follow from."""
    return sha256(msgspec.json.encode(sweep, order="deterministic")).hexdigest()


def set_store_attributes(group: Any, sweep: Mapping[str, Any]) -> None:
    """Give a group the attributes that say whose results it has."""
    attributes = {"format": FORMAT, "units": UNITS, "sweep": json.dumps(sweep), "identity": identify(sweep)}
    _set_attributes(group, attributes)


def read_store_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store.

    Raises
    ------
    InputError
        They are damaged; there is no store; it has another format.
    """
    attributes = _read_attributes(path, path)
    if "format" not in attributes or "identity" not in attributes:
        raise InputError(f"{path / DOCUMENT}: not begun as results of a sweep; remove {path}, or choose another DIR")
    if "checksum" in attributes or attributes["format"] == FORMAT:
        sound = _has_sound_checksum(attributes)
    else:
        sound = attributes["format"] != FORMAT_WITHOUT_CHECKSUMS or _has_sound_sweep(attributes)
    if not sound:
        raise _damaged(path, path)
    if attributes["format"] not in (FORMAT, FORMAT_WITHOUT_CHECKSUMS):
        raise InputError(f"{path}: results of format {attributes['format']}; this program reads {FORMAT}; {REMOVE}")
    return attributes


def read_files_attributes(path: Path) -> dict[str, Any]:
    """Return a store's ``chunk``, the members in a chunk, and ``files``, the checksums by file.

    Raises
    ------
    InputError
        They are damaged.
    """
    attributes = _read_attributes(path / CHECKSUMS, path)
    if not _has_sound_checksum(attributes):
        raise _damaged(path / CHECKSUMS, path)
    return attributes


def _set_attributes(group: Any, attributes: Mapping[str, Any]) -> None:
    group.attrs.update(attributes)
    group.attrs["checksum"] = _checksum_attributes(dict(group.attrs))


def _read_attributes(group: Path, path: Path) -> dict[str, Any]:
    import zarr

    try:
        return dict(zarr.open_group(group, mode="r", zarr_format=3, use_consolidated=False).attrs)
    except Exception as error:  # whatever a damaged document makes Zarr raise
        says = f"cannot be read ({type(error).__name__}), so {path.name} is damaged or has no results of a sweep"
        raise InputError(f"{group / DOCUMENT}: {says}; remove {path}, or choose another DIR") from None


def _damaged(group: Path, path: Path) -> InputError:
    return InputError(
        f"{group / DOCUMENT}: its checksum differs, so it is damaged; remove {path}, or choose another DIR"
    )


def _has_sound_checksum(attributes: Mapping[str, Any]) -> bool:
    return bool(attributes.get("checksum") == _checksum_attributes(attributes))


def _has_sound_sweep(attributes: Mapping[str, Any]) -> bool:
    try:
        return bool(attributes["identity"] == identify(json.loads(attributes["sweep"])))
    except (KeyError, TypeError, ValueError):
        return False


def _checksum_attributes(attributes: Mapping[str, Any]) -> str:
    """Return the checksum of the attributes written by this program, ignoring attributes that others added."""
    own = {
        key: attributes.get(key) for key in ("format", "units", "sweep", "identity", "coordinates", "chunk", "files")
    }
    return checksum(msgspec.json.encode(own, order="deterministic")).hex()


def restore_files(path: Path, create: Callable[[Path], None], files: Mapping[str, str]) -> list[str]:
    """Write damaged files again; return a sentence on each.

    Parameters
    ----------
    path : Path
        The store.
    create : callable
        Creates the same store in an empty folder.
    files : mapping of str to str
        The checksum of each file.

    Raises
    ------
    InputError
        This version of Zarr writes another file; a file cannot be written.
    """
    damaged = [key for key, wanted in files.items() if checksum_file(path / key).hex() != wanted]
    if not damaged:
        return []
    said = [f"{key} {describe_damage(path / key)}" for key in damaged]
    with temporary_folder() as folder:
        create(folder)
        for key, says in zip(damaged, said, strict=True):
            if checksum_file(folder / key).hex() != files[key]:
                raise InputError(f"{path}/{says}; remove {path}, or choose another DIR")
        _copy(folder, path, damaged)
    return said


def convert_files(path: Path, create: Callable[[int], Callable[[Path], None]]) -> Callable[[], None]:
    """Write all files but the group's own document as this version has them; return what writes that as well.

    Parameters
    ----------
    path : Path
        A store of an earlier version.
    create : callable
        Gives for a chunk's length a function that creates the same store in an empty folder.

    Raises
    ------
    InputError
        The chunk's length is unknown because the document of the status is damaged; a file cannot be written.
    """
    import zarr

    try:
        chunk = zarr.open_array(path / STATUS_NAME, mode="r", zarr_format=3).chunks[0]
    except Exception as error:  # whatever a damaged document makes Zarr raise
        file = path / STATUS_NAME / DOCUMENT
        raise InputError(
            f"{file}: cannot be read ({type(error).__name__}); remove {path}, or choose another DIR"
        ) from None
    with temporary_folder() as folder:
        create(chunk)(folder)
        document = (folder / DOCUMENT).read_bytes()
        files = read_files_attributes(folder)["files"]
        _copy(folder, path, [*files, f"{CHECKSUMS}/{DOCUMENT}"])

    def finish() -> None:
        with open_atomic(path / DOCUMENT) as file:
            file.write(document)

    return finish


def _copy(source: Path, to: Path, keys: Iterable[str]) -> None:
    for key in keys:
        with open_atomic(to / key) as file:
            file.write((source / key).read_bytes())


def create_arrays(group: Any, members: Members, count: int, chunk: int) -> None:
    """Create the arrays of a group, with labels and units."""
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
            array_name(name), shape=(count, *shape), chunks=(chunk, *shape), dtype="f8", fill_value=np.nan,
            dimension_names=("member", *dims), attributes={"is": "variable" if name in members.names else "output"},
        )  # fmt: skip
    group.create_array(
        MESSAGE_NAME, shape=(count,), chunks=(chunk,), dtype=str, dimension_names=("member",), fill_value=""
    )
    _say_units(group, members)
    flags = {"flag_values": list(range(len(STATUS))), "flag_meanings": " ".join(STATUS)}
    group.create_array(
        STATUS_NAME, shape=(count,), chunks=(chunk,), dtype="u1", dimension_names=("member",),
        fill_value=PENDING, attributes=flags,
    )  # fmt: skip


def _say_units(group: Any, members: Members) -> None:
    """Set the unit of each array; arrays with mixed units get a coordinate that has one for each component."""
    beside = []
    for name, units in members.units.items():
        array = group[array_name(name)]
        if joined(units):
            array.attrs["units"] = joined(units)
        if len(set(units)) > 1:
            beside.append(units_beside(name))
            dimension = members.shapes[name][0][0]
            place = group.create_array(beside[-1], shape=(len(units),), dtype=str, dimension_names=(dimension,))
            place[:] = np.array(units, dtype=np.dtypes.StringDType())
    if beside:
        group.attrs["coordinates"] = " ".join(beside)  # what xarray takes for coordinates, not data


def require_free_names(members: Members) -> None:
    """Refuse outputs that are called like something else in the store."""
    taken = {
        STATUS_NAME,
        MESSAGE_NAME,
        CHECKSUMS,
        "member",
        "time",
        *members.outputs.labels,
        *map(array_name, members.names),
    }
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
