"""Read a file of another program's format, and write it as ``mechanism.toml`` with a URDF.

Supported: MuJoCo's MJCF, SDFormat, USD, and URDFs whose loops are declared in one of several dialects, by a file beside
them, by pairs of closing frames, or not at all.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from ckc_pin.base.sources import parse_xml, write_files
from ckc_pin.base.toml import read_text
from ckc_pin.base.toml_writer import LINE_WIDTH, format_key, format_value, to_table
from ckc_pin.errors import ImportNote, InputError, MechanismError, printable
from ckc_pin.formats.conversion import make_unique
from ckc_pin.formats.draft import Draft, choose_independent
from ckc_pin.formats.loop_types import propose_loop_types
from ckc_pin.formats.mjcf.reader import read_mjcf
from ckc_pin.formats.physics import check_physics
from ckc_pin.formats.robot import Robot
from ckc_pin.formats.sdf.reader import read_sdf
from ckc_pin.formats.tree import make_draft
from ckc_pin.formats.urdf.loop_closures_yaml import LOOP_CLOSURES_YAML
from ckc_pin.formats.urdf.reader import ROBOT_YAML, find_urdf_beside, read_urdf
from ckc_pin.formats.urdf.xacro import expand_xacro, is_xacro
from ckc_pin.formats.usd.reader import USD_SUFFIXES, read_usd
from ckc_pin.kinematics.closing import close_loops
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.spec import LoopType
from ckc_pin.scene.names import DEFAULT, SUFFIX

__all__ = ["Draft", "draft_texts", "import_texts", "mechanism_text", "read", "read_robot", "write"]

LOOP_TYPES = get_args(LoopType)
MAX_UNSAID_MOVE = 1e-4  # rad or m; key frames have rounded numbers
SCENE_SECONDS = 1.0  # of free motion in the scenes that import writes
READERS = {"mujoco": read_mjcf, "robot": read_urdf, "sdf": read_sdf}  # by the root element


def read(path: Path, repair: bool = False) -> Draft:
    """Read a file of another program's format.

    Parameters
    ----------
    path : Path
        A MuJoCo model, an SDFormat file, a USD stage, a URDF, or a robot.yaml or loop_closures.yaml beside its URDF.
    repair : bool
        Whether impossible inertias and swapped limits are replaced by possible ones, instead of being refused.

    Returns
    -------
    Draft

    Raises
    ------
    InputError, MechanismError
        The file is not of a supported format, or an element of it is invalid. The message names the element.
    """
    robot = read_robot(path)
    check_physics(robot, repair)
    draft = make_draft(robot)
    propose_loop_types(draft)
    _remove_loops_within_a_body(draft)
    choose_independent(draft)
    _close_key_frames(draft)
    return draft


def read_robot(path: Path) -> Robot:
    """Read a file of another program's format as a graph of links and joints."""
    if path.suffix in (".yaml", ".yml"):
        if path.name not in (ROBOT_YAML, LOOP_CLOSURES_YAML):
            raise InputError(
                f"{path}: cannot import this YAML file; it would have to be a {ROBOT_YAML} or a {LOOP_CLOSURES_YAML} "
                "beside its URDF"
            )
        read_text(path, "YAML file")
        path = find_urdf_beside(path)
    if path.suffix.lower() in USD_SUFFIXES:
        return read_usd(path)
    text = read_text(path, "robot file")
    if "<%" in text:
        raise InputError(f"{path}: a template of ERB (<% ... %>); expand it first, and import the result")
    expanded = is_xacro(path, text)
    if expanded:
        text = expand_xacro(path)
    tag = parse_xml(text, str(path)).tag
    if tag not in READERS:
        raise InputError(
            f"{path}: the root element is <{tag}>; expected <mujoco> (MJCF), <robot> (URDF) or <sdf> (SDFormat)"
        )
    robot = READERS[tag](text, path)
    robot.origin += ", expanded by xacro" if expanded else ""
    return robot


def _close_key_frames(draft: Draft) -> None:
    """Move each key frame to the nearest configuration that closes the loops, where a run can start."""
    if not draft.key_frames or not (draft.loops or draft.couplings):
        return
    try:
        mechanism = draft.build_mechanism()
    except MechanismError:
        return
    tree, frames = mechanism.tree, draft.key_frames
    draft.key_frames = {}
    for name, config in frames.items():
        numbers = np.array([config.get(label, 0.0) for label in tree.coordinates])
        closed = close_loops(
            tree, mechanism.closure, tree.from_coordinates(numbers), np.ones(tree.n), mechanism.tolerance, restarts=0
        )
        if closed.residual > mechanism.tolerance:
            draft.left_out.append(f"key frame {name!r}, from where the loops do not close")
            continue
        values = tree.to_coordinates(closed.q_tree)
        draft.key_frames[name] = dict(zip(tree.coordinates, values.tolist(), strict=True))
        if (moved := float(np.abs(values - numbers).max())) > MAX_UNSAID_MOVE:
            draft.guessed.append(f"key frame {name!r} starts where the loops close, {moved:.2g} rad or m away")


def _remove_loops_within_a_body(draft: Draft) -> None:
    """Leave out loops between two frames of one rigid body, because they constrain no coordinate."""
    _, frames, _ = draft.build_tree()
    loops = []
    for spec, comment in draft.loops:
        ends = [frames.find(frame, f"loop {spec.name!r}").joint for frame in (spec.frame_a, spec.frame_b)]
        if ends[0] == ends[1]:
            draft.left_out.append(f"loop {spec.name}: both of its frames are on one rigid body")
        else:
            loops.append((spec, comment))
    draft.loops = loops


# --- writing ``mechanism.toml`` ------------------------------------------------------------------------------------


def write(draft: Draft, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write ``mechanism.toml``, the URDF and the scenes of a draft: free motion, and one for each further key frame.

    Parameters
    ----------
    draft : Draft
    folder : Path
        Created if it does not exist.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of Path
        The files written, ``mechanism.toml`` first.

    Raises
    ------
    InputError
        A file exists already, or the folder is not writable.
    """
    return write_files(folder, draft_texts(draft), overwrite)


def draft_texts(draft: Draft) -> dict[str, str]:
    """Return the texts of ``mechanism.toml``, the URDF and the scenes by file name, ``mechanism.toml`` first."""
    texts = {MECHANISM_FILE: mechanism_text(draft), draft.urdf_file: draft.urdf_text()}
    texts[f"{DEFAULT}{SUFFIX}"] = _scene_text("the assembled configuration", {"at": "assembled"})
    for name, config in draft.key_frames.items():
        file = make_unique(re.sub(r"[^\w-]+", "_", name), [text.removesuffix(SUFFIX) for text in texts])
        texts[f"{file}{SUFFIX}"] = _scene_text(f"key frame {name!r} of the imported file", {"q": config})
    return texts


def _scene_text(start: str, initial: dict[str, Any]) -> str:
    """Return the text of a scene without control."""
    lines = [*_comment(f"Free motion from {start}."), f"mechanism = {format_value(MECHANISM_FILE)}"]
    lines += [
        f"formulation = {format_value('reduced')}",
        f"t_end = {SCENE_SECONDS}",
        "",
        "[initial]",
        f"at = {format_value('assembled')}",
    ]
    if config := initial.get("q"):
        values = ", ".join(f"{format_key(key)} = {format_value(float(x))}" for key, x in config.items())
        lines[-1] = f"q = {{{values}}}"
    return "\n".join(lines) + "\n"


def import_texts(path: Path) -> dict[str, str]:
    """Import a file in memory: return the texts that `write` would write. The notes are a warning.

    Raises
    ------
    InputError, MechanismError
        As in `read`.
    """
    draft = read(path)
    notes = [f"warning: {note}" for note in draft.warnings] + [f"guessed: {note}" for note in draft.guessed]
    notes += [f"left out: {note}" for note in draft.left_out]
    warnings.warn(
        "\n  ".join(map(printable, [f"{path} is imported as {draft.origin}", *notes])), ImportNote, stacklevel=2
    )
    return draft_texts(draft)


def mechanism_text(draft: Draft) -> str:
    """Return the text of ``mechanism.toml``, with the notes on what was guessed and left out as comments."""
    lines = [*_comment(f"Imported from {draft.origin}. Read it, correct it, keep it."), ""]
    for title, items in (("Warnings", draft.warnings), ("Guessed", draft.guessed), ("Left out", draft.left_out)):
        if items:
            lines += [f"# {title}:", *(line for item in items for line in _comment(item, "#   - ", "#     ")), ""]
    spec = draft.to_spec()
    lines += [
        f"name = {format_value(spec.name)}",
        f"urdf = {format_value(draft.urdf_file)}",
        f"gravity = {format_value([*map(float, spec.gravity)])}",
    ]
    if draft.independent is not None:
        lines += _comment(draft.why_independent) + _name_list("independent", draft.independent)
    if spec.actuated is not None:
        lines += _name_list("actuated", spec.actuated)
    if draft.q_guess:
        lines += ["", "[q_guess]", *(f"{format_key(k)} = {format_value(float(v))}" for k, v in draft.q_guess.items())]
    for table, entries in draft.tables.items():
        for entry, comment in entries:
            lines += ["", *_comment(comment), f"[[{table}]]", *_entries(entry)]
    if not draft.loops:
        lines += ["", *_loop_template(draft)]
    return "\n".join(lines) + "\n"


def _loop_template(draft: Draft) -> Iterator[str]:
    """Yield a commented-out loop between two links without children, for the user to complete."""
    names = [link.get("name", "") for link in draft.robot.findall("link")]
    parents = {parent.get("link") for parent in draft.robot.iterfind("joint/parent")}
    ends = [name for name in names if name not in parents]
    other = ends[-2] if len(ends) > 1 else names[0]
    yield from _comment(f"No loop is closed. Complete this table to close one; type is one of {', '.join(LOOP_TYPES)}:")
    yield "# [[loop]]"
    table = {"name": "closed", "type": "hinge"}
    yield from (f"# {key} = {format_value(value)}" for key, value in table.items())
    for key, end in (("frame_a", ends[-1]), ("frame_b", other)):
        yield f"# {key} = {{link = {format_value(end)}, xyz = [0.0, 0.0, 0.0], rpy = [0.0, 0.0, 0.0]}}"
    yield from (f"# axis_{end} = [0.0, 0.0, 1.0]" for end in "ab")


def _entries(spec: msgspec.Struct) -> Iterator[str]:
    """Yield the keys of a table whose values differ from the defaults. Conversion turns integers into numbers."""
    table = to_table(msgspec.convert(msgspec.to_builtins(spec), type(spec)))
    yield from (f"{format_key(key)} = {format_value(value)}" for key, value in table.items())


def _name_list(key: str, names: Iterable[str]) -> list[str]:
    """Return a list of names as TOML, one name a line where one line would be too long."""
    one_line = f"{key} = {format_value(list(names))}"
    if len(one_line) <= LINE_WIDTH:
        return [one_line]
    return [f"{key} = [", *(f"    {format_value(name)}," for name in names), "]"]


def _comment(text: str, first: str = "# ", rest: str = "# ") -> list[str]:
    """Return a text as comment lines. Control characters, which could end a comment, become spaces."""
    lines, line = [], ""
    for word in re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029]+", " ", text).split():
        if line and len(line) + len(word) + len(rest) > LINE_WIDTH:
            lines.append(line)
            line = ""
        line = f"{line} {word}" if line else word
    lines += [line] if line else []
    return [f"{rest if k else first}{line}" for k, line in enumerate(lines)]
