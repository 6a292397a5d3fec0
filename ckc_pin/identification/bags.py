"""Recordings of ROS: rosbag2 folders, MCAP files and rosbag1 files, as columns over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.errors import InputError

__all__ = ["BAG_SUFFIXES", "is_bag", "read_bag"]

BAG_SUFFIXES = (".mcap", ".bag", ".db3")
JOINT_STATE = "sensor_msgs/msg/JointState"
MAX_ENTRIES = 64  # of an array in a message
NANOSECOND = 1e-9


def is_bag(path: Path) -> bool:
    """Whether a path is a recording of ROS by its suffix, or a rosbag2 folder."""
    return path.suffix in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def read_bag(path: Path) -> dict[str, Array]:
    """Return ``t`` and columns by name; NaN where a message of another topic stands.

    Joint states have the columns ``JOINT``, ``v.JOINT`` and ``tau.JOINT``. Numbers of other messages are called by
    topic and field, ``/tracker.pose.position.x``. Times are those of the messages' headers if they have one, and begin
    at 0.

    Raises
    ------
    InputError
        The recording cannot be read, or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"{path}: reading recordings of ROS needs rosbags: pip install ckc_pin[bags]") from None
    entries: dict[str, dict[int, float]] = {}
    folder = path.parent if path.suffix in (".mcap", ".db3") and (path.parent / "metadata.yaml").is_file() else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, logged, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                at = _stamp(message) or logged
                for name, value in _numbers(connection.topic, connection.msgtype, message):
                    entries.setdefault(name, {})[at] = value
    except (AnyReaderError, OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not a recording of ROS that can be read: {str(error).splitlines()[0]}") from None
    times = sorted({at for column in entries.values() for at in column})
    if not times:
        raise InputError(f"{path}: no message with numbers")
    columns = {"t": NANOSECOND * np.array([at - times[0] for at in times], dtype=float)}
    return columns | {name: np.array([x.get(at, np.nan) for at in times]) for name, x in entries.items()}


def _stamp(message: Any) -> int:
    """Return the time of a message's header, ns; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _numbers(topic: str, kind: str, message: Any) -> Iterator[tuple[str, float]]:
    if kind == JOINT_STATE:
        for prefix, values in (("", message.position), ("v.", message.velocity), ("tau.", message.effort)):
            yield from ((f"{prefix}{name}", float(x)) for name, x in zip(message.name, values, strict=False))
    else:
        yield from _flatten(topic, message)


def _flatten(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their names, without its header."""
    if isinstance(value, int | float | np.number) and not isinstance(value, bool):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and value.ndim == 1 and len(value) <= MAX_ENTRIES:
        yield from ((f"{name}[{k}]", float(x)) for k, x in enumerate(value))
    elif is_dataclass(value):
        for part in fields(value):
            if part.name != "header" and not part.name.startswith("__"):
                yield from _flatten(f"{name}.{part.name}", getattr(value, part.name))
