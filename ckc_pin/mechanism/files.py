"""The files of a mechanism as texts by name that all lie in one folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import read_toml
from ckc_pin.base.toml_writer import to_table, write_toml
from ckc_pin.mechanism.library import MECHANISM_FILE

if TYPE_CHECKING:
    from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["choose_local_name", "local_texts", "mechanism_sources"]


def mechanism_sources(mechanism: Mechanism) -> Sources:
    """Return the sources that a mechanism was built from, with the text of its mechanism file."""
    sources = mechanism.sources
    if MECHANISM_FILE in sources.texts:
        return sources.with_texts({})
    return sources.with_texts({MECHANISM_FILE: write_toml(to_table(mechanism.spec))})  # it was not built from a text


def local_texts(mechanism: Mechanism) -> dict[str, str]:
    """Return the mechanism's file and its URDFs by name, without parameter values that were set in addition.

    URDFs of other folders and packages get names of their own, so that the files can be written into one folder.
    """
    sources = mechanism_sources(mechanism)
    text = sources.text(MECHANISM_FILE)
    data = read_toml(text, sources.name)
    tables, texts = [(data, "urdf")] if "urdf" in data else [(tree, "file") for tree in data["tree"]], dict[str, str]()
    names: dict[str, str] = {}
    for table, key in tables:
        file = table[key]
        if file not in names:
            names[file] = choose_local_name(file, (MECHANISM_FILE, *texts))
            texts[names[file]] = sources.text(file)
        table[key] = names[file]
    is_unchanged = all(file == name for file, name in names.items())
    return {MECHANISM_FILE: text if is_unchanged else write_toml(data), **texts}


def choose_local_name(file: str, taken: Iterable[str]) -> str:
    """Return a file's name relative to a folder that it can be written into: unchanged, or without its folders.

    Parameters
    ----------
    file : str
        A relative or absolute path, or ``package://...``.
    taken : iterable of str
        Names that another file has.
    """
    path, used = PurePosixPath(file), set(taken)
    is_local = not path.is_absolute() and ".." not in path.parts and "://" not in file and str(path) == file
    if is_local and file not in used:
        return file
    names = (path.name, *(f"{path.stem}_{k}{path.suffix}" for k in range(2, len(used) + 3)))
    return next(name for name in names if name not in used)
