"""Texts of mechanism files and where they come from, package paths, and strict parsing of XML."""

from __future__ import annotations

import re
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
    "MAX_XML_DEPTH",
    "Sources",
    "parse_xml",
    "resolve_path",
    "write_files",
]

PACKAGE = "package://"
MAX_XML_DEPTH = 300  # nested elements; ElementTree writes by recursion
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


class Sources:
    """Texts of the files that a mechanism or scene names. Each text that was used is kept, so that a run can store it.

    Parameters
    ----------
    name : str
        Name of the file that names the others, for messages.
    folder : Path or None
        Folder that relative names refer to. None: there are no other texts than `texts`.
    texts : mapping, optional
        Texts by file name, which are taken instead of files.

    Attributes
    ----------
    texts, available : dict of str to str
        The texts that were used, and those that were given, by file name.
    """

    def __init__(self, name: str, folder: Path | None, texts: Mapping[str, str] | None = None) -> None:
        self.name = name
        self.folder = folder
        self.texts: dict[str, str] = {}
        self.available = dict(texts or {})

    def with_texts(self, texts: Mapping[str, str]) -> Sources:
        """Return sources with further texts, none of which was used yet."""
        return Sources(self.name, self.folder, {**self.available, **self.texts, **texts})

    @contextmanager
    def prefix_errors(self) -> Iterator[None]:
        """Prepend the file's name to errors raised in the block, which name only the table or key."""
        try:
            yield
        except (InputError, MechanismError) as error:
            if str(error).startswith(self.name):
                raise
            raise type(error)(f"{self.name}: {error}") from None

    def text(self, file: str) -> str:
        """Return the text of a file.

        Raises
        ------
        InputError
            The file or package does not exist.
        """
        if file not in self.texts:
            if file in self.available:
                self.texts[file] = self.available[file]
            elif self.folder is None:
                raise InputError(f"{self.name}: it does not contain the text of {file!r}")
            else:
                self.texts[file] = read_text(resolve_path(file, self.folder, self.name), "file")
        return self.texts[file]


def resolve_path(file: str, folder: Path, where: str) -> Path:
    """Return the path of a file that is named relative to a folder, or as ``package://PACKAGE/PATH``.

    Raises
    ------
    InputError
        The package is not installed, or the path leaves it.
    """
    if not file.startswith(PACKAGE):
        return folder / file
    package, _, rest = file.removeprefix(PACKAGE).partition("/")
    if package in ("", ".", ".."):
        raise InputError(f"{where}: {file!r} names no package; write package://PACKAGE/PATH")
    if "\0" in file:
        raise InputError(f"{where}: {file!r} is not a valid path; it has a null character")
    for share in _share_folders():
        base = (share / package).resolve()
        if isdir(base):
            path = (base / rest).resolve()
            if not path.is_relative_to(base):
                raise InputError(f"{where}: {file!r} leaves its package")
            return path
    raise InputError(f"{where}: {file!r}: no package {package!r} is installed; example-robot-data is one: "
                     "pip install example-robot-data")  # fmt: skip


def write_files(folder: Path, files: Mapping[str, str | bytes], overwrite: bool) -> list[Path]:
    """Write contents by file name into a folder, which is created if it does not exist. Return their paths.

    Raises
    ------
    InputError
        A file exists and `overwrite` is False, or the folder cannot be written to.
    """
    existing = [str(folder / file) for file in files if lexists(folder / file)]
    if existing and not overwrite:
        raise InputError(f"{', '.join(existing)}: there already; write elsewhere with --out DIR, or say --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    for file, content in files.items():
        write_atomic(folder / file, content)
    return [folder / file for file in files]


def _share_folders() -> list[Path]:
    """Return the folders of installed robot packages: Pinocchio's wheel and the interpreter's."""
    import pinocchio  # imported here because most mechanisms name no package

    wheel = Path(pinocchio.__file__).resolve().parents[4] / "share"
    return [wheel, Path(sys.prefix) / "share"]


def _keep_lines(comment: re.Match[str]) -> str:
    return "\n" * comment[0].count("\n")


def parse_xml(text: str, source: str) -> ElementTree.Element:
    """Parse XML from an untrusted file: no error recovery, no document type, no entities, limited nesting.

    Names keep their prefix, as in "drake:joint". Namespaces are not resolved, because robot files rarely declare them.

    Raises
    ------
    InputError
        The text is not valid XML (the message has the line), declares a document type, or is nested too deeply.
    """
    depth = 0
    builder = ElementTree.TreeBuilder()

    def reject_doctype(name: str, *_: object) -> None:
        raise InputError(f"{source}: a document type declaration ({name}) is not accepted")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_XML_DEPTH:
            raise InputError(f"{source}: elements nested more than {MAX_XML_DEPTH} deep are not accepted")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    # The text was decoded as UTF-8, so an encoding named in its first line is ignored.
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = reject_doctype
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    stripped = text.lstrip("\ufeff \t\r\n")
    if stripped.startswith("<?xml"):  # published files have empty lines above the declaration, which XML forbids
        text = stripped
    text = COMMENT.sub(_keep_lines, text)  # published files have "--" in comments, which XML forbids
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise InputError(f"{source}: malformed XML: {error}") from None
    return builder.close()
