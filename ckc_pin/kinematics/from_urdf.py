"""Mechanisms from Python: the arguments become the text of a mechanism file, which is read as any other."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ckc_pin.base.sources import Sources, parse_xml, resolve_path
from ckc_pin.base.toml import convert, join_dotted_keys, read_text
from ckc_pin.base.toml_writer import to_toml_value, write_toml
from ckc_pin.base.validation import describe_value, require_path, require_type
from ckc_pin.errors import InputError
from ckc_pin.kinematics.loading import build, check_overrides
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.spec import (
    CouplingSpec,
    ForceSpec,
    JointSpec,
    LoopSpec,
    MechanismSpec,
    MotorSpec,
    PointSpec,
    SpringSpec,
    TreeSpec,
)

__all__ = ["FUNCTION", "from_urdf"]

FUNCTION = "Mechanism.from_urdf"
LISTS: dict[str, tuple[str, type]] = {  # by argument: the key of the file and the type of an entry
    "loops": ("loop", LoopSpec),
    "couplings": ("coupling", CouplingSpec),
    "springs": ("spring", SpringSpec),
    "forces": ("force", ForceSpec),
    "joints": ("joint", JointSpec),
    "motors": ("motor", MotorSpec),
    "points": ("point", PointSpec),
}
EXPECTED_URDF = "the text of a URDF or its path"
MAX_LISTED_MESHES = 3


def from_urdf(urdf: Any, trees: Any, name: Any, meshes: Any, parameters: Any, keys: Mapping[str, Any]) -> Mechanism:
    """Return an assembled mechanism; see `Mechanism.from_urdf`.

    Parameters
    ----------
    urdf, trees, name, meshes, parameters : object
        As there.
    keys : mapping
        Its other arguments by name. None stands for the default.

    Raises
    ------
    InputError, MechanismError
    """
    texts: dict[str, str] = {}
    folders: list[Path | None] = []
    data: dict[str, Any] = {"name": "", **_add_trees(urdf, trees, texts, folders)}
    data["name"] = next(iter(texts)).removesuffix(".urdf") if name is None else name
    data |= {key: to_toml_value(value) for key, value in keys.items() if value is not None and key not in LISTS}
    if "q_guess" in data:
        data["q_guess"] = _name_guess(data["q_guess"], data.get("independent"))
    join_dotted_keys(data, "q_guess")
    for argument, (key, kind) in LISTS.items():
        entries = to_toml_value(keys[argument])
        convert(entries, list[kind], FUNCTION, argument)  # type: ignore[valid-type]
        data |= {key: entries} if entries else {}
    convert(data, MechanismSpec, FUNCTION)
    overrides = None if parameters is None else check_overrides(parameters, f"{FUNCTION}: parameters")
    if meshes is not None:
        require_path(meshes, f"{FUNCTION}: meshes", "the folder of the mesh files")
    folder = next((folder for folder in folders if folder is not None), None) if meshes is None else Path(meshes)
    mechanism = build(write_toml(data), Sources(data["name"], folder, texts), overrides)
    if folder is None and (missing := _list_meshes(texts)):
        mechanism.warnings.append(
            f"the URDF is a text, so its meshes are not there: {missing}; give meshes = the folder that they are "
            "relative to. Links without a mesh are drawn as rods, and the motion is the same"
        )
    return mechanism


def _add_trees(urdf: Any, trees: Any, texts: dict[str, str], folders: list[Path | None]) -> dict[str, Any]:
    """Add the URDFs' texts and folders, and return the keys of the mechanism file that name them."""
    if (urdf is None) == (not trees):
        raise InputError(f"{FUNCTION}: give either urdf, {EXPECTED_URDF}, or trees, a list of tables")
    if urdf is not None:
        return {"urdf": _add_urdf(urdf, f"{FUNCTION}: urdf", texts, folders)}
    require_type(trees, (list, tuple), f"{FUNCTION}: trees", "a list of tables")
    tables = to_toml_value(trees)
    named = [{**table, "file": "x"} if isinstance(table, dict) and "file" in table else table for table in tables]
    convert(named, list[TreeSpec], FUNCTION, "trees")
    for k, table in enumerate(tables):
        table["file"] = _add_urdf(table["file"], f"{FUNCTION}: trees[{k}].file", texts, folders)
    return {"tree": tables}


def _add_urdf(urdf: Any, where: str, texts: dict[str, str], folders: list[Path | None]) -> str:
    """Add the text of a URDF and the folder of its file, and return its name among the texts."""
    if isinstance(urdf, str) and urdf.lstrip().startswith("<"):
        text, folder, stem = urdf, None, _robot_name(urdf, where)
    else:
        require_path(urdf, where, EXPECTED_URDF)
        path = resolve_path(str(urdf), Path(), where)
        text, folder, stem = read_text(path, "URDF"), path.parent, path.stem
    same = next((name for name, other in texts.items() if other == text), None)
    if same is not None:
        return same
    stem = re.sub(r"[^\w.-]+", "_", stem).strip("_.") or "tree"
    names = (f"{stem}{'' if k == 1 else f'_{k}'}.urdf" for k in range(1, len(texts) + 2))
    name = next(name for name in names if name not in texts)
    texts[name] = text
    folders.append(folder)
    return name


def _robot_name(text: str, where: str) -> str:
    return parse_xml(text, where).get("name", "")


def _name_guess(guess: Any, independent: Any) -> Any:
    """Return q_guess as a table. An array is in the order of `independent`."""
    if not isinstance(guess, list):
        return guess
    if not isinstance(independent, Sequence):
        raise InputError(
            f"{FUNCTION}: q_guess: an array is in the order of independent, which is not given; give a table by "
            f"coordinate, got {describe_value(guess)}"
        )
    if len(guess) != len(independent):
        raise InputError(
            f"{FUNCTION}: q_guess: expected {len(independent)} numbers, in the order {', '.join(map(str, independent))}"
            f", got {len(guess)}"
        )
    return dict(zip(independent, guess, strict=True))


def _list_meshes(texts: Mapping[str, str]) -> str:
    """Return the relative mesh files of URDFs as text, the first of many."""
    elements = (mesh for text in texts.values() for mesh in ElementTree.fromstring(text).iterfind("link/visual//mesh"))
    files = dict.fromkeys(mesh.get("filename", "") for mesh in elements)
    relative = [file for file in files if file and "://" not in file and not Path(file).is_absolute()]
    omitted = len(relative) - MAX_LISTED_MESHES
    return ", ".join(relative[:MAX_LISTED_MESHES]) + (f" and {omitted} more" if omitted > 0 else "")
