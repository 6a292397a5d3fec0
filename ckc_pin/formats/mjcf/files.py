"""The files that a MuJoCo model names: none is opened that is not under the model's own folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from stat import S_ISREG
from xml.etree.ElementTree import Element

from ckc_pin.base.sources import MAX_DEPTH, strict_xml
from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError

__all__ = ["Files", "expand"]

MAX_MESH = 64 * 2**20  # bytes


@dataclass
class Files:
    """Tokens for the files of a model and of those that it attaches, so that MuJoCo never sees a path.

    Attributes
    ----------
    home : Path
        The model's folder.
    paths : dict of str to Path
        The mesh file behind each token; it need not be there.
    """

    home: Path
    paths: dict[str, Path] = field(default_factory=dict)
    models: int = 0

    def mesh(self, path: Path) -> str:
        """Return a token for a mesh file."""
        token = f"mesh_{len(self.paths)}{path.suffix.lower()}"
        self.paths[token] = path
        return token

    def model(self) -> str:
        """Return a token for an attached model."""
        self.models += 1
        return f"model_{self.models}.xml"

    def inside(self, folder: Path, file: str, where: str) -> Path:
        """Return a file's path.

        Raises
        ------
        InputError
            It is not under the model's folder.
        """
        path = _resolved(folder / file)
        if not file or path is None or not path.is_relative_to(self.home):
            raise InputError(f"{where}: a file in the model's own folder is needed")
        return path

    def content(self, token: str) -> bytes | None:
        """Return what is in a mesh file; None where it cannot be read, or is not under the model's folder.

        Raises
        ------
        InputError
            It is too large.
        """
        path = _resolved(self.paths[token])
        if path is None or not path.is_relative_to(self.home):
            return None
        try:
            status = path.stat()
            if not S_ISREG(status.st_mode):
                return None
            if status.st_size > MAX_MESH:
                raise InputError(f"{path}: more than {MAX_MESH // 2**20} MiB, too large for a mesh")
            return path.read_bytes()
        except OSError:
            return None


def _resolved(path: Path) -> Path | None:
    """Return where a path leads; None where its links go round in a circle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return None


def expand(element: Element, folder: Path, files: Files, seen: set[Path], source: str, depth: int = 0) -> None:
    """Put included files in place of <include>, each at most once.

    Raises
    ------
    InputError
        A file that comes twice, is not under the model's folder, or is no XML.
    """
    if depth > MAX_DEPTH:
        raise InputError(f"{source}: elements nested more than {MAX_DEPTH} deep are not accepted")
    position = 0
    while position < len(element):
        child = element[position]
        if child.tag != "include":
            expand(child, folder, files, seen, source, depth + 1)
            position += 1
            continue
        file = child.get("file", "")
        path = files.inside(folder, file, f"{source}: <include file={file!r}>")
        if path in seen:
            raise InputError(f"{source}: {file!r} is included twice")
        seen.add(path)
        element[position : position + 1] = list(strict_xml(read_text(path, "MuJoCo model"), file))
