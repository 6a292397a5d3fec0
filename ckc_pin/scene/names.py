"""Find scene files by shipped name or path, and list the shipped ones."""

from __future__ import annotations

from os.path import isdir, isfile
from pathlib import Path

from ckc_pin.base.toml import read_text
from ckc_pin.errors import InputError
from ckc_pin.mechanism.library import MECHANISM_FILE, describe_mechanism, first_comment, is_path, library, shipped

__all__ = [
    "DEFAULT",
    "SUFFIX",
    "describe_scene_name",
    "find_scene_file",
    "is_scene_name",
    "list_catalogue",
    "list_scene_names",
    "shorten_scene_name",
]

SUFFIX = ".scene.toml"
DEFAULT = "default"


def list_scene_names(mechanism: str) -> list[str]:
    """Return the names of a shipped mechanism's scenes."""
    return sorted(p.name.removesuffix(SUFFIX) for p in (library() / mechanism).glob(f"*{SUFFIX}"))


def find_scene_file(name: str | Path) -> Path:
    """Return the path of a scene given as MECHANISM, MECHANISM/SCENE, a path, or a path without ``.scene.toml``.

    Raises
    ------
    InputError
        There is no such scene. The message lists the existing ones.
    """
    if isinstance(name, Path) or is_path(name):
        path = Path(name)
        if isdir(path) or path.name == MECHANISM_FILE:
            path = _find_default(path if isdir(path) else path.parent)
        return path
    if isfile(f"{name}{SUFFIX}"):
        return Path(f"{name}{SUFFIX}")
    mechanism, _, scene = name.partition("/")
    path = library() / mechanism / f"{scene or DEFAULT}{SUFFIX}"
    if Path(name).parts in ((mechanism,), (mechanism, scene)) and isfile(path):
        return path
    if mechanism not in shipped():
        raise InputError(
            f"no mechanism {mechanism!r}; shipped: {', '.join(shipped())}; or give the path of a *{SUFFIX} file"
        )
    raise InputError(f"{mechanism} has no scene {scene!r}; it has {', '.join(list_scene_names(mechanism))}")


def _find_default(folder: Path) -> Path:
    """Return a folder's default scene, or its only one."""
    path = folder / f"{DEFAULT}{SUFFIX}"
    others = sorted(p.name for p in folder.glob(f"*{SUFFIX}"))
    if isfile(path):
        return path
    if len(others) == 1:
        return folder / others[0]
    if others:
        raise InputError(f"{folder}: no {path.name}; name one of its scenes: {', '.join(others)}")
    if isfile(folder / "run.npz"):
        raise InputError(f"{folder}: a finished run, not a scene; ckc play, plot and inverse accept this folder")
    raise InputError(f"{folder}: it contains no scene, *{SUFFIX}; ckc new NAME makes a folder with an example")


def describe_scene_name(name: str | Path, path: Path) -> str:
    """Return the user's name for a scene, or FOLDER/SCENE if the user gave a folder."""
    return _join_folder_and_scene(path) if isdir(name) else str(name)


def shorten_scene_name(name: str) -> str:
    """Return FOLDER/SCENE for the name of a scene that is the path of its file, and other names as they are."""
    files = (Path(file) for file in (name, f"{name}{SUFFIX}") if file.endswith(SUFFIX) and isfile(file))
    return next(map(_join_folder_and_scene, files), name)


def _join_folder_and_scene(path: Path) -> str:
    scene = path.name.removesuffix(SUFFIX)
    return path.parent.resolve().name + ("" if scene == DEFAULT else f"/{scene}")


def list_catalogue() -> list[tuple[str, str, dict[str, str]]]:
    """Return (name, description, {scene: description}) of each shipped mechanism.

    The description is the first comment of the file, so that it is kept in one place.
    """
    return [
        (
            name,
            describe_mechanism(name),
            {scene: first_comment(_read_scene(name, scene)) for scene in list_scene_names(name)},
        )
        for name in shipped()
    ]


def _read_scene(mechanism: str, scene: str) -> str:
    return read_text(library() / mechanism / f"{scene}{SUFFIX}", "scene")


def is_scene_name(name: str) -> bool:
    """Whether a name or path denotes a scene, not a mechanism."""
    if is_path(name):
        return name.endswith(SUFFIX)
    return "/" in name or isfile(f"{name}{SUFFIX}")
