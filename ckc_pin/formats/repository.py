"""Find the files that an untrusted model names, inside the repository that the model belongs to."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ckc_pin.errors import InputError

__all__ = ["find_folder", "find_in_repository", "repository_of", "resolve_links"]

MAX_LEVELS = 2  # of folders above a model that belong to it, where no repository is found


@cache
def repository_of(folder: Path) -> Path:
    """Return the folder whose files belong to a model in `folder`.

    It is the next folder upwards with .git, or else the highest of a few folders above the model. A folder at the top
    of the file system or of a home never counts.
    """
    folder = folder.resolve()
    above = [folder, *folder.parents]
    excluded = {Path(folder.anchor), *Path(folder.anchor).glob("*"), Path.home(), Path.home().parent}
    for candidate in above:
        if (candidate / ".git").exists() and candidate not in excluded:
            return candidate
    allowed = [candidate for candidate in above[: MAX_LEVELS + 1] if candidate not in excluded]
    return allowed[-1] if allowed else folder


def find_folder(name: str, root: Path, model: Path) -> Path:
    """Return the folder of a package inside a repository.

    Raises
    ------
    InputError
        The repository has no such folder.
    """
    choices = [folder for folder in (root, *sorted(root.glob("*")), *sorted(root.glob("*/*"))) if folder.name == name]
    if not choices:
        raise InputError(f"{model}: no package {name!r} in the model's repository {root.name!r}")
    return choices[0]


def resolve_links(path: Path) -> Path | None:
    """Return a path without symbolic links; None if these form a cycle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return None


def find_in_repository(uri: str, model: Path, where: str, default: str = "") -> Path:
    """Return a file that a model names by a relative path, ``model://NAME/PATH`` or ``package://NAME/PATH``.

    Parameters
    ----------
    uri : str
    model : Path
        File of the model.
    where : str
        Beginning of a message.
    default : str
        File to take in a folder.

    Raises
    ------
    InputError
        There is no such file in the model's repository.
    """
    scheme, _, rest = uri.rpartition("://")
    folder = model.absolute().parent
    root = repository_of(folder)
    tails = [Path(rest)] if not scheme else [Path(rest), Path(*Path(rest).parts[1:])]
    bases = (
        [folder]
        if not scheme
        else [b for b in (folder, *folder.resolve().parents) if b == folder or b.is_relative_to(root)]
    )
    for base in bases:
        for tail in tails:
            path = resolve_links(base / tail)
            if path is None or not path.is_relative_to(root):
                continue
            if path.is_dir() and default and (path / default).is_file():
                return path / default
            if path.is_file():
                return path
    for depth in ("*", "*/*") if scheme and rest and ".." not in rest else ():
        for path in sorted(root.glob(f"{depth}/{rest}{f'/{default}' if default and not Path(rest).suffix else ''}")):
            if path.is_file() and path.resolve().is_relative_to(root):
                return path
    raise InputError(f"{where}: no such file in the model's repository {root.name!r}")
