"""A mechanism in other programs' formats: one writer for each, and what the other program does differently."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ckc_pin.base.sources import write_texts
from ckc_pin.errors import InputError
from ckc_pin.formats.mjcf.writer import mjcf
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["FORMATS", "Exported", "export", "write"]

FORMATS = {"mjcf": mjcf}


@dataclass(frozen=True)
class Exported:
    """A file for another program.

    Attributes
    ----------
    file : str
        Name that suits it.
    text : str
    differs : list of str
        What moves otherwise there than here.
    """

    file: str
    text: str
    differs: list[str]


def export(mechanism: Mechanism, to: str) -> Exported:
    """Write a mechanism for another program, assembled as it is here.

    Parameters
    ----------
    mechanism : Mechanism
    to : str
        "mjcf", MuJoCo's models.

    Raises
    ------
    InputError
        Another format, or something of the mechanism that the format has no counterpart of.
    """
    if to not in FORMATS:
        raise InputError(f"export: no format {to!r}; there are {', '.join(FORMATS)}")
    text, differs = FORMATS[to](mechanism)
    return Exported(re.sub(r"[^\w.-]+", "_", mechanism.name) + ".xml", text, differs)


def write(exported: Exported, folder: Path, overwrite: bool = False) -> Path:
    """Write the file into a folder, which is made if it is not there.

    Raises
    ------
    InputError
        The file is there already, or cannot be written.
    """
    return write_texts(folder, {exported.file: exported.text}, overwrite)[0]
