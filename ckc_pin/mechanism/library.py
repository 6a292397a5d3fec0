"""The files of mechanisms, by shipped name or by path."""

from __future__ import annotations

import itertools
import re
from functools import cache
from os.path import exists, isdir, isfile
from pathlib import Path

from ckc_pin.base.sources import Sources
from ckc_pin.base.toml import convert, read_text
from ckc_pin.errors import InputError
from ckc_pin.mechanism.generators import GENERATORS, GeneratorSpec, generate

__all__ = [
    "describe_mechanism",
    "first_comment",
    "is_path",
    "library",
    "mechanism_file",
    "read_mechanism_texts",
    "shipped",
]

MECHANISM_FILE = "mechanism.toml"


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
        if isfile(library() / f"{name}.scene.toml"):
            raise InputError(f"{name!r} is a scene; its mechanism is {Path(name).parts[0]!r}")
        raise InputError(
            f"no mechanism {name!r}; shipped: {', '.join(shipped())}; or give the path of a {MECHANISM_FILE}"
        )
    return path


def describe_mechanism(name: str) -> str:
    """What a shipped mechanism is, in a sentence: the first comment of its file, so that the two cannot drift apart."""
    return first_comment(read_mechanism_texts(name)[0])


def first_comment(text: str) -> str:
    """Return the first sentence of the first comment of a TOML text, without its marks."""
    lines = text.splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith("#")), len(lines))
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines[start:])
    whole = " ".join(line.lstrip("# ").strip() for line in comment)
    return re.split(r"(?<=\.) +(?=[A-Z])", whole, maxsplit=1)[0]


def read_mechanism_texts(name: str | Path | GeneratorSpec) -> tuple[str, Sources]:
    """Return the text of a mechanism's file, and where the texts that it names come from.

    Raises
    ------
    InputError
        A file that is missing or cannot be read.
    """
    if isinstance(name, GeneratorSpec):
        return generate(name)
    if name in GENERATORS and not is_path(str(name)):
        return generate(convert({"generator": name}, GeneratorSpec, str(name)))
    path = mechanism_file(name)
    return read_text(path, "mechanism file"), Sources(str(path), path.parent)
