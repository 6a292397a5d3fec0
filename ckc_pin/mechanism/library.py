"""Mechanisms by shipped name or by path."""

from __future__ import annotations

from pathlib import Path

from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.sources import Sources
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.mechanism.toml import convert, read_text, read_toml

__all__ = ["build", "is_path", "library", "load", "mechanism_file", "shipped"]

MECHANISM_FILE = "mechanism.toml"


def library() -> Path:
    """Folder of the shipped mechanisms: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "urdf"
    return inside if inside.is_dir() else package.parent / "urdf"


def shipped() -> list[str]:
    """Names of the shipped mechanisms."""
    return sorted(p.parent.name for p in library().glob(f"*/{MECHANISM_FILE}"))


def is_path(name: str) -> bool:
    """Whether a mechanism or scene is given by path: it exists, or ends in .toml."""
    return name.endswith(".toml") or Path(name).exists()


def mechanism_file(name: str | Path) -> Path:
    """Return the path of a mechanism's file.

    Raises
    ------
    InputError
        No such mechanism; the message lists the shipped ones.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        return path / MECHANISM_FILE if path.is_dir() else path
    if name not in shipped():
        raise InputError(
            f"no mechanism {name!r}; shipped: {', '.join(shipped())}; or give the path of a {MECHANISM_FILE}"
        )
    return library() / name / MECHANISM_FILE


def load(name: str | Path) -> Mechanism:
    """Load a mechanism by shipped name or path.

    Parameters
    ----------
    name : str or Path
        For example ``"five_bar"`` or ``"robots/mine/mechanism.toml"``.

    Raises
    ------
    InputError
        A file that is missing, malformed, or has an unknown key.
    MechanismError
        A mechanism that cannot exist as described.
    """
    path = mechanism_file(name)
    return build(read_text(path, "mechanism file"), Sources(str(path), path.parent))


def build(text: str, sources: Sources) -> Mechanism:
    """Build a mechanism from the text of its file; the text is kept among its sources."""
    spec = convert(read_toml(text, sources.name), MechanismSpec, sources.name)
    sources.texts[MECHANISM_FILE] = text
    return Mechanism(spec, sources)
