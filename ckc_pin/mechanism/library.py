"""Mechanisms by shipped name or by path."""

from __future__ import annotations

import itertools
import re
from copy import deepcopy
from functools import cache
from os.path import exists, isdir, isfile
from pathlib import Path
from threading import Lock

from ckc_pin.errors import InputError
from ckc_pin.mechanism.generators import GENERATORS, GeneratorSpec, generate
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.mechanism.toml import by_coordinate, convert, read_text, read_toml

__all__ = ["about", "build", "first_comment", "is_path", "library", "load", "mechanism_file", "shipped"]

MECHANISM_FILE = "mechanism.toml"
MOST_KEPT = 32  # of the mechanisms built

_built: dict[tuple[str, str, Path | None], Mechanism] = {}  # never handed out, only copied
_building = Lock()


@cache
def library() -> Path:
    """Folder of the shipped mechanisms: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "urdf"
    return inside if inside.is_dir() else package.parent / "urdf"


def shipped() -> list[str]:
    """Names of the shipped mechanisms, those of files and those made by rule."""
    return sorted([*(p.parent.name for p in library().glob(f"*/{MECHANISM_FILE}")), *GENERATORS])


def is_path(name: str) -> bool:
    """Whether a mechanism or scene is given by path: it exists, or ends in .toml."""
    return name.endswith(".toml") or exists(name)  # os.path's own takes names that no file system does


def mechanism_file(name: str | Path) -> Path:
    """Return the path of a mechanism's file.

    Raises
    ------
    InputError
        No such mechanism; the message lists the shipped ones.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        return path / MECHANISM_FILE if isdir(path) else path
    path = library() / name / MECHANISM_FILE
    if Path(name).name != name or not isfile(path):
        raise InputError(
            f"no mechanism {name!r}; shipped: {', '.join(shipped())}; or give the path of a {MECHANISM_FILE}"
        )
    return path


def load(name: str | Path | GeneratorSpec) -> Mechanism:
    """Load a mechanism by shipped name or path.

    Parameters
    ----------
    name : str, Path or GeneratorSpec
        For example ``"five_bar"`` or ``"robots/mine/mechanism.toml"``; ``"n_four_bar"`` is made with its
        usual number of links.

    Raises
    ------
    InputError
        A file that is missing, malformed, or has an unknown key.
    MechanismError
        A mechanism that cannot exist as described.
    """
    return build(*_text(name))


def about(name: str) -> str:
    """What a shipped mechanism is, in a sentence: the first comment of its file, so that the two cannot drift apart."""
    return first_comment(_text(name)[0])


def first_comment(text: str) -> str:
    """Return the first sentence of the first comment of a TOML text, without its marks."""
    lines = text.splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith("#")), len(lines))
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines[start:])
    whole = " ".join(line.lstrip("# ").strip() for line in comment)
    return re.split(r"(?<=\.) +(?=[A-Z])", whole, maxsplit=1)[0]


def _text(name: str | Path | GeneratorSpec) -> tuple[str, Sources]:
    if isinstance(name, GeneratorSpec):
        return generate(name)
    if name in GENERATORS and not is_path(str(name)):
        return generate(convert({"generator": name}, GeneratorSpec, str(name)))
    path = mechanism_file(name)
    return read_text(path, "mechanism file"), Sources(str(path), path.parent)


def build(text: str, sources: Sources) -> Mechanism:
    """Build a mechanism from the text of its file; the text is kept among its sources.

    One that was built of the same texts before is copied: parsing, assembling and counting freedoms take longer than
    many a run.
    """
    sources.texts[MECHANISM_FILE] = text
    key = (text, sources.name, sources.folder)
    built = _built.get(key)
    if built is not None and all(sources.text(file) == known for file, known in built.sources.texts.items()):
        twin = deepcopy(built)
        twin.sources = sources
        return twin
    mechanism = _build(text, sources)
    built = deepcopy(mechanism)
    built.tree.rest()
    with _building:
        _built[key] = built
        while len(_built) > MOST_KEPT:
            _built.pop(next(iter(_built)))
    return mechanism


def _build(text: str, sources: Sources) -> Mechanism:
    data = read_toml(text, sources.name)
    by_coordinate(data, "q_guess")
    spec = convert(data, MechanismSpec, sources.name)
    return Mechanism(spec, sources)
