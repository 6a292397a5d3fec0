"""Export a mechanism to the formats of other programs, with a list of how its motion differs there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ckc_pin.base.sources import write_texts
from ckc_pin.errors import InputError
from ckc_pin.formats.mjcf.writer import to_mjcf
from ckc_pin.formats.sdf.writer import to_sdf
from ckc_pin.formats.urdf.writer import to_urdf
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FORMATS", "Exported", "export", "write"]

FORMATS = {"mjcf": (to_mjcf, ".xml"), "urdf": (to_urdf, ".urdf"), "sdf": (to_sdf, ".sdf")}  # with suffixes


@dataclass(frozen=True)
class Exported:
    """A mechanism in another program's format.

    Attributes
    ----------
    file : str
        Suggested file name.
    text : str
        Content of the file.
    differences : list of str
        How the motion in the other program differs from the mechanism's.
    """

    file: str
    text: str
    differences: list[str]


def export(mechanism: Mechanism, to: str, **options: float) -> Exported:
    """Convert a mechanism, in its assembled configuration, to another program's format.

    Parameters
    ----------
    mechanism : Mechanism
    to : str
        "mjcf": a MuJoCo model. "urdf": a tree with <loop> elements. "sdf": a world of SDFormat, as Gazebo reads it,
        with its zero configuration where the mechanism is assembled.
    **options
        Of the format. "mjcf": `time_step`, s.

    Raises
    ------
    InputError
        The format is unknown, or has no counterpart for a part of the mechanism.
    """
    if to not in FORMATS:
        raise InputError(f"export: unknown format {to!r}; expected one of {', '.join(FORMATS)}")
    write_text, suffix = FORMATS[to]
    text, differences = write_text(mechanism, **options)
    return Exported(re.sub(r"[^\w.-]+", "_", mechanism.name) + suffix, text, differences)


def write(exported: Exported, folder: Path, overwrite: bool = False) -> Path:
    """Write an exported mechanism into a folder, which is created if it does not exist, and return the file's path.

    Raises
    ------
    InputError
        The file exists already, or the folder is not writable.
    """
    return write_texts(folder, {exported.file: exported.text}, overwrite)[0]
