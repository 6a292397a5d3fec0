"""Export a mechanism to the formats of other programs, with a list of how its motion differs there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ckc_pin.base.sources import write_texts
from ckc_pin.errors import InputError
from ckc_pin.formats.c.writer import to_c
from ckc_pin.formats.mjcf.writer import to_mjcf
from ckc_pin.formats.sdf.writer import to_sdf
from ckc_pin.formats.urdf.writer import to_urdf
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FORMATS", "Exported", "export", "write"]

SUFFIXES = {"mjcf": ".xml", "urdf": ".urdf", "sdf": ".sdf"}  # of formats of one file
FORMATS = (*SUFFIXES, "c")


@dataclass(frozen=True)
class Exported:
    """A mechanism in another program's format.

    Attributes
    ----------
    files : dict of str
        Contents by file name. All formats but "c" have one file.
    differences : list of str
        How the motion in the other program differs from the mechanism's.
    """

    files: dict[str, str]
    differences: list[str]

    @property
    def text(self) -> str:
        """Content of the only file."""
        (text,) = self.files.values()
        return text


def export(mechanism: Mechanism, to: str, **options: float) -> Exported:
    """Convert a mechanism, in its assembled configuration, to another program's format.

    Parameters
    ----------
    mechanism : Mechanism
    to : str
        "mjcf": a MuJoCo model. "urdf": a tree with <loop> elements. "sdf": a world of SDFormat, as Gazebo reads it,
        with its zero configuration where the mechanism is assembled. "c": C99 of the dynamics and the controllers.
    **options
        Of the format. "mjcf": `time_step`, s.

    Raises
    ------
    InputError
        The format is unknown, or has no counterpart for a part of the mechanism.
    """
    stem = re.sub(r"[^\w.-]+", "_", mechanism.name)
    if to == "c":
        return Exported(*to_c(mechanism, stem))
    if to not in SUFFIXES:
        raise InputError(f"export: unknown format {to!r}; expected one of {', '.join(FORMATS)}")
    text, differences = {"mjcf": to_mjcf, "urdf": to_urdf, "sdf": to_sdf}[to](mechanism, **options)
    return Exported({stem + SUFFIXES[to]: text}, differences)


def write(exported: Exported, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write an exported mechanism into a folder, which is created if it does not exist, and return the files' paths.

    Raises
    ------
    InputError
        A file exists already, or the folder is not writable.
    """
    return write_texts(folder, exported.files, overwrite)
