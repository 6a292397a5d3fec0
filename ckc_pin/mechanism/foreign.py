"""Mechanisms in the formats of other programs, which `ckc_pin.formats` imports in memory."""

from __future__ import annotations

from os.path import isfile
from pathlib import Path

from ckc_pin.base.sources import Sources

__all__ = ["FOREIGN_SUFFIXES", "is_foreign", "read_foreign"]

FOREIGN_SUFFIXES = (".urdf", ".sdf", ".world", ".xml", ".mjcf", ".xacro", ".usd", ".usda", ".usdc", ".usdz")


def is_foreign(name: str | Path) -> bool:
    """Whether a name is the path of a file in the format of another program."""
    return str(name).lower().endswith(FOREIGN_SUFFIXES) and isfile(name)


def read_foreign(path: Path) -> Sources:
    """Import a file in memory: return the texts of its mechanism, URDF and scenes. Its notes are a warning.

    Raises
    ------
    InputError, MechanismError
        The file cannot be imported.
    """
    import ckc_pin  # the importer is in a room above

    texts: dict[str, str] = ckc_pin.formats.import_texts(path)  # type: ignore[attr-defined]
    return Sources(str(path), path.parent, texts)
