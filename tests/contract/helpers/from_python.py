"""The tables of shipped files as arguments of Python."""

from __future__ import annotations

import tomllib
from typing import Any

from ckc_pin import Mechanism
from ckc_pin.mechanism.library import library

LISTS = {"loop": "loops", "coupling": "couplings", "spring": "springs", "force": "forces", "joint": "joints",
         "motor": "motors", "point": "points", "tree": "trees"}  # fmt: skip


def mechanism_arguments(name: str, file: str = "mechanism.toml") -> dict[str, Any]:
    """Return the arguments of `Mechanism.from_urdf` for a shipped mechanism, with its URDF as text."""
    folder = library() / name
    data = tomllib.loads((folder / file).read_text())
    if "urdf" in data:
        data["urdf"] = (folder / data["urdf"]).read_text()
    for tree in data.get("tree", []):
        if "://" not in tree["file"]:
            tree["file"] = (folder / tree["file"]).read_text()
    return {LISTS.get(key, key): value for key, value in data.items()}


def mechanism_from_python(name: str, file: str = "mechanism.toml") -> Mechanism:
    return Mechanism.from_urdf(**mechanism_arguments(name, file))
