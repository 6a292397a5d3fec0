"""Find the files that an untrusted model names, inside the repository that the model belongs to."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from ckc_pin.base.toml import read_text
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
    """Return the folder of a package inside a repository, by the <name> in its package.xml or the folder's own."""
    folders = [root, *sorted(root.glob("*")), *sorted(root.glob("*/*"))]
    is_named = re.compile(rf"<name>\s*{re.escape(name)}\s*</name>").search
    manifests = [folder / "package.xml" for folder in folders]
    choices = [m.parent for m in manifests if m.is_file() and is_named(read_text(m, "package manifest"))]
    choices += [folder for folder in folders if folder.name == name]
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

    `default` is the file to take in a folder. The file must exist in the model's repository.
    """
    scheme, _, rest = uri.rpartition("://")
    folder = model.absolute().parent
    root = repository_of(folder)
    candidates = [folder / rest]
    if scheme:
        below = "/".join(Path(rest).parts[1:])
        bases = [base for base in (folder, *folder.resolve().parents) if base == folder or base.is_relative_to(root)]
        candidates = [base / tail for base in bases for tail in (rest, below) if tail]
        candidates += [
            path for depth in ("*", "*/*") if rest and ".." not in rest for path in sorted(root.glob(f"{depth}/{rest}"))
        ]
    for candidate in candidates:
        path = resolve_links(candidate / default if default and candidate.is_dir() else candidate)
        if path is not None and path.is_relative_to(root) and path.is_file():
            return path
    raise InputError(f"{where}: no such file in the model's repository {root.name!r}")
