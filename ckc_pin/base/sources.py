"""Where texts come from: a folder, a package of robots, or the texts that a saved run carries. And where they go."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os.path import isdir, lexists
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from ckc_pin.base.atomic_files import write_atomic
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError, MechanismError

__all__ = [
    "MAX_DEPTH",
    "Sources",
    "resolve",
    "strict_xml",
    "write_texts",
]

PACKAGE = "package://"


class Sources:
    """Texts by the name that a mechanism file gives them; what was read is kept, so a run can carry it.

    Parameters
    ----------
    name : str
        What messages call the mechanism file.
    folder : Path or None
        Relative names are resolved here. None: only `texts` exist.
    texts : mapping, optional
        Texts that are there already.
    """

    def __init__(self, name: str, folder: Path | None, texts: Mapping[str, str] | None = None) -> None:
        self.name = name
        self.folder = folder
        self.texts = dict(texts or {})

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Have messages begin with the file: what reads a part of it knows its table alone."""
        try:
            yield
        except (InputError, MechanismError) as error:
            if str(error).startswith(self.name):
                raise
            raise type(error)(f"{self.name}: {error}") from None

    def text(self, file: str) -> str:
        """Return a file's text.

        Raises
        ------
        InputError
            No such file or package.
        """
        if file not in self.texts:
            if self.folder is None:
                raise InputError(f"{self.name}: the text of {file!r} is not part of it")
            self.texts[file] = read_text(resolve(file, self.folder, self.name), "file")
        return self.texts[file]


def resolve(file: str, folder: Path, where: str) -> Path:
    """Return the path of a file named relative to a folder, or as ``package://PACKAGE/PATH``."""
    if not file.startswith(PACKAGE):
        return folder / file
    package, _, rest = file.removeprefix(PACKAGE).partition("/")
    if package in ("", ".", ".."):
        raise InputError(f"{where}: {file!r} names no package; write package://PACKAGE/PATH")
    if "\0" in file:
        raise InputError(f"{where}: {file!r} is not a valid path; it has a null character")
    for share in _shares():
        base = (share / package).resolve()
        if isdir(base):
            path = (base / rest).resolve()
            if not path.is_relative_to(base):
                raise InputError(f"{where}: {file!r} leaves its package")
            return path
    raise InputError(f"{where}: {file!r}: no package {package!r} is installed; example-robot-data is one: "
                     "pip install example-robot-data")  # fmt: skip


def write_texts(folder: Path, texts: Mapping[str, str], overwrite: bool) -> list[Path]:
    """Write texts by file name into a folder, which is made if it is not there.

    Raises
    ------
    InputError
        A file is there already and may not be replaced, or the folder cannot be written to.
    """
    there = [str(folder / file) for file in texts if lexists(folder / file)]
    if there and not overwrite:
        raise InputError(f"{' and '.join(there)}: there already; write elsewhere with --out DIR, or say --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    for file, text in texts.items():
        write_atomic(folder / file, text)
    return [folder / file for file in texts]


def _shares() -> list[Path]:
    """Folders that hold robot packages: beside Pinocchio's wheel, and the interpreter's own."""
    import pinocchio

    wheel = Path(pinocchio.__file__).resolve().parents[4] / "share"
    return [wheel, Path(sys.prefix) / "share"]


MAX_DEPTH = 300  # of nested elements; ElementTree writes by recursion


def strict_xml(text: str, source: str) -> ElementTree.Element:
    """Parse XML from a stranger: no recovery, no document type, hence no entities, no abyss of nested elements.

    Raises
    ------
    InputError
        With the line, where expat has one.
    """
    depth = 0

    def refuse(name: str, *_: object) -> None:
        raise InputError(f"{source}: a document type declaration ({name}) is not accepted")

    def enter(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise InputError(f"{source}: elements nested more than {MAX_DEPTH} deep are not accepted")

    def leave(_: str) -> None:
        nonlocal depth
        depth -= 1

    # The text is UTF-8, or it would not have been read, whatever its first line says.
    checker = expat.ParserCreate("utf-8")
    checker.StartDoctypeDeclHandler = refuse
    checker.StartElementHandler, checker.EndElementHandler = enter, leave
    try:
        checker.Parse(text.encode(), True)
        return ElementTree.fromstring(text.encode(), ElementTree.XMLParser(encoding="utf-8"))
    except (expat.ExpatError, ElementTree.ParseError) as error:
        raise InputError(f"{source}: malformed XML: {error}") from None
