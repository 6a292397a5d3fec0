"""Constant files of an ensemble's store: the documents of its arrays, labels and attributes.

The attributes of the group and of its group of checksums contain their own checksum. The latter also contain the
checksums of all other constant files. These follow from the sweep, so that damaged ones can be written again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    "require_free_names", "restore_files", "set_store_attributes", "unit_coordinate_name",
]  # fmt: skip

FORMAT = 2
FORMAT_WITHOUT_CHECKSUMS = 1
DOCUMENT = "zarr.json"
REMOVE = "remove it, or choose another DIR"
STATUS_NAME, MESSAGE_NAME = "status", "message"
UNITS = "SI units: s, m, rad, kg, N, N m, J"


def create_store(folder: Path, sweep: Mapping[str, Any], members: Members, count: int, chunk: int) -> None:
    """Create a store in a folder. Its attributes are written last, which marks it as complete."""
    # Zarr writes files in another thread, which would continue after an interrupt while the caller removes the folder.
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
    """Return the names of the arrays over members, the status first."""
    return [STATUS_NAME, MESSAGE_NAME, *map(array_name, (*members.names, *members.shapes))]


def identify(sweep: Any) -> str:
    """Return the hash of everything that the results depend on."""
    return sha256(msgspec.json.encode(sweep, order="deterministic")).hexdigest()


def set_store_attributes(group: Any, sweep: Mapping[str, Any]) -> None:
    """Set the attributes of a group that identify its sweep."""
    attributes = {"format": FORMAT, "units": UNITS, "sweep": json.dumps(sweep), "identity": identify(sweep)}
    _set_attributes(group, attributes)


def read_store_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store.

    Raises
    ------
    InputError
        The attributes are damaged, or the folder is not a store or has an unsupported format.
    """
    attributes = _read_attributes(path, path)
    if "format" not in attributes or "identity" not in attributes:
        raise InputError(f"{path / DOCUMENT}: not a store of a sweep; remove {path}, or choose another DIR")
    if "checksum" in attributes or attributes["format"] == FORMAT:
        is_sound = _has_sound_checksum(attributes)
    else:
        is_sound = attributes["format"] != FORMAT_WITHOUT_CHECKSUMS or _has_sound_sweep(attributes)
    if not is_sound:
        raise _damaged(path, path)
    if attributes["format"] not in (FORMAT, FORMAT_WITHOUT_CHECKSUMS):
        raise InputError(f"{path}: results of format {attributes['format']}; this program reads {FORMAT}; {REMOVE}")
    return attributes


def read_files_attributes(path: Path) -> dict[str, Any]:
    """Return a store's ``chunk``, the members in a chunk, and ``files``, the checksums by file.

    Raises
    ------
    InputError
        The attributes are damaged.
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
    except Exception as error:  # a damaged document may make Zarr raise anything
        raise InputError(
            f"{group / DOCUMENT}: cannot be read ({type(error).__name__}), so {path.name} is damaged or not a store of "
            f"a sweep; remove {path}, or choose another DIR"
        ) from None


def _damaged(group: Path, path: Path) -> InputError:
    return InputError(
        f"{group / DOCUMENT}: is damaged, because its checksum is wrong; remove {path}, or choose another DIR"
    )


def _has_sound_checksum(attributes: Mapping[str, Any]) -> bool:
    return bool(attributes.get("checksum") == _checksum_attributes(attributes))


def _has_sound_sweep(attributes: Mapping[str, Any]) -> bool:
    try:
        return bool(attributes["identity"] == identify(json.loads(attributes["sweep"])))
    except (KeyError, TypeError, ValueError):
        return False


def _checksum_attributes(attributes: Mapping[str, Any]) -> str:
    """Return the checksum of the attributes that this program writes, ignoring other attributes."""
    protected = {
        key: attributes.get(key) for key in ("format", "units", "sweep", "identity", "coordinates", "chunk", "files")
    }
    return checksum(msgspec.json.encode(protected, order="deterministic")).hex()


def restore_files(path: Path, create: Callable[[Path], None], files: Mapping[str, str]) -> list[str]:
    """Write damaged files again, and return a sentence about each.

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
        This version of Zarr writes a different file, or a file cannot be written.
    """
    damaged = [key for key, expected in files.items() if checksum_file(path / key).hex() != expected]
    if not damaged:
        return []
    sentences = [f"{key} {describe_damage(path / key)}" for key in damaged]
    with temporary_folder() as folder:
        create(folder)
        for key, sentence in zip(damaged, sentences, strict=True):
            if checksum_file(folder / key).hex() != files[key]:
                raise InputError(f"{path}/{sentence}; remove {path}, or choose another DIR")
        _copy(folder, path, damaged)
    return sentences


def convert_files(path: Path, create: Callable[[int], Callable[[Path], None]]) -> Callable[[], None]:
    """Write all constant files in the present format, except the group's document; return the function that writes it.

    Parameters
    ----------
    path : Path
        A store of an earlier version.
    create : callable
        Takes the number of members in a chunk, and returns a function that creates the store in an empty folder.

    Raises
    ------
    InputError
        The document of the status, which contains the number of members in a chunk, is damaged, or a file cannot be
        written.
    """
    import zarr

    try:
        chunk = zarr.open_array(path / STATUS_NAME, mode="r", zarr_format=3).chunks[0]
    except Exception as error:  # a damaged document may make Zarr raise anything
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
    for name, labels in members.outputs.labels.items():
        if _is_used(name, members):
            _create_labels(group, name, name, labels)
    if _is_used("time", members):
        times = group.create_array(
            "time", shape=(len(members.instants),), dtype="f8", dimension_names=("time",), attributes={"units": "s"}
        )
        times[:] = members.instants
    shapes = dict.fromkeys(members.names, ((), ())) | members.shapes
    for name, (dims, shape) in shapes.items():
        group.create_array(
            array_name(name), shape=(count, *shape), chunks=(chunk, *shape), dtype="f8", fill_value=np.nan,
            dimension_names=("member", *dims), attributes={"is": "variable" if name in members.names else "output"},
        )  # fmt: skip
    group.create_array(
        MESSAGE_NAME, shape=(count,), chunks=(chunk,), dtype=str, dimension_names=("member",), fill_value=""
    )
    _set_units(group, members)
    flags = {"flag_values": list(range(len(STATUS))), "flag_meanings": " ".join(STATUS)}
    group.create_array(
        STATUS_NAME, shape=(count,), chunks=(chunk,), dtype="u1", dimension_names=("member",),
        fill_value=PENDING, attributes=flags,
    )  # fmt: skip


def _create_labels(group: Any, name: str, dimension: str, labels: Sequence[str]) -> None:
    array = group.create_array(name, shape=(len(labels),), dtype=str, dimension_names=(dimension,))
    array[:] = np.array(labels, dtype=np.dtypes.StringDType())


def _set_units(group: Any, members: Members) -> None:
    """Set the unit of each array; arrays with mixed units get a coordinate that has one for each component."""
    unit_coordinates = []
    for name, units in members.units.items():
        array = group[array_name(name)]
        if joined(units):
            array.attrs["units"] = joined(units)
        if len(set(units)) > 1:
            unit_coordinates.append(unit_coordinate_name(name))
            _create_labels(group, unit_coordinates[-1], members.shapes[name][0][0], units)
    if unit_coordinates:
        group.attrs["coordinates"] = " ".join(unit_coordinates)  # xarray reads these as coordinates, not as data


def require_free_names(members: Members) -> None:
    """Refuse outputs whose names are reserved or cannot be names of arrays (InputError)."""
    reserved = {
        STATUS_NAME,
        MESSAGE_NAME,
        CHECKSUMS,
        "member",
        "time",
        *members.outputs.labels,
        *map(array_name, members.names),
    }
    reserved |= {unit_coordinate_name(name) for name, units in members.units.items() if len(set(units)) > 1}
    for name in members.shapes:
        key = array_name(name)
        if key in reserved:
            raise InputError(f"outputs: {name!r} is taken; choose another name")
        if key in ("", ".", "..", "zarr.json") or key.startswith("__") or "\0" in key:
            raise InputError(f"outputs: {name!r} cannot be the name of an array in Zarr; choose another name")
        reserved.add(key)


def _is_used(dimension: str, members: Members) -> bool:
    return any(dimension in dims for dims, _ in members.shapes.values())


def array_name(name: str) -> str:
    """Return the name of a variable or output in the store, where a slash would create groups."""
    return name.replace("/", "_")


def unit_coordinate_name(name: str) -> str:
    """Return the name, without spaces, of the coordinate with the units of an output's components."""
    return f"{'_'.join(array_name(name).split())}_unit"
