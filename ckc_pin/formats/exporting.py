"""Export a mechanism to the formats of other programs, with a list of how its motion differs there."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from ckc_pin.base.sources import write_files
from ckc_pin.base.validation import require_type
from ckc_pin.errors import InputError
from ckc_pin.formats.c.writer import to_c
from ckc_pin.formats.fmu.writer import to_fmu
from ckc_pin.formats.mjcf.writer import to_mjcf
from ckc_pin.formats.sdf.writer import to_sdf
from ckc_pin.formats.urdf.writer import to_urdf
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.scene.scene import Scene, as_scene

__all__ = ["FORMATS", "Exported", "export", "write"]

SUFFIXES = {"mjcf": ".xml", "urdf": ".urdf", "sdf": ".sdf"}  # of formats of one file
FORMATS = (*SUFFIXES, "c", "fmu")


@dataclass(frozen=True)
class Exported:
    """A mechanism in another program's format.

    Attributes
    ----------
    files : dict of str or bytes
        Contents by file name. All formats but "c" have one file, and that of "fmu" is binary.
    differences : list of str
        How the motion in the other program differs from the mechanism's.
    """

    files: Mapping[str, str | bytes]
    differences: list[str]

    @property
    def text(self) -> str:
        """Content of the only file, a text."""
        (text,) = self.files.values()
        return str(text)


def export(model: Mechanism | Scene | str | Path, to: str, **options: Any) -> Exported:
    """Convert a mechanism, in its assembled configuration, or a scene to another program's format.

    Parameters
    ----------
    model : Mechanism or Scene
        A scene, or its name or path, for "fmu"; a mechanism for the others.
    to : str
        "mjcf": a MuJoCo model. "urdf": a tree with <loop> elements. "sdf": a world of SDFormat, as Gazebo reads it,
        with its zero configuration where the mechanism is assembled. "c": C99 of the dynamics and the controllers.
        "fmu": a functional mock-up unit, which starts as the scene does.
    **options
        Of the format. "mjcf": `time_step`, s. "fmu": `fmi`, "2.0" or "3.0".

    Raises
    ------
    InputError
        The format is unknown, or has no counterpart for a part of the mechanism.
    """
    if to not in FORMATS:
        raise InputError(f"export: unknown format {to!r}; expected one of {', '.join(FORMATS)}")
    if to == "fmu":
        return Exported(*to_fmu(as_scene(model, None, "export"), **options))
    require_type(model, Mechanism, "export: model", "a Mechanism")
    mechanism = cast(Mechanism, model)
    stem = re.sub(r"[^\w.-]+", "_", mechanism.name)
    if to == "c":
        return Exported(*to_c(mechanism, stem))
    text, differences = {"mjcf": to_mjcf, "urdf": to_urdf, "sdf": to_sdf}[to](mechanism, **options)
    return Exported({stem + SUFFIXES[to]: text}, differences)


def write(exported: Exported, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write an exported mechanism into a folder, which is created if it does not exist, and return the files' paths.

    Raises
    ------
    InputError
        A file exists already, or the folder is not writable.
    """
    return write_files(folder, exported.files, overwrite)
