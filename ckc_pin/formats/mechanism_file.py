"""Writing a draft down: `mechanism.toml`, to read and correct, and the URDF that it names."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import msgspec

from ckc_pin.base.sources import write_texts
from ckc_pin.formats.draft import Draft
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.spec import LoopType

__all__ = ["mechanism_text", "write"]

WIDTH = 116
LOOP_TYPES = get_args(LoopType)


def write(draft: Draft, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the files of a draft.

    Parameters
    ----------
    draft : Draft
    folder : Path
        Is made if it is not there.
    overwrite : bool
        Whether files that are there may be replaced.

    Raises
    ------
    InputError
        A file is there already, or the folder cannot be written to.
    """
    texts = {MECHANISM_FILE: mechanism_text(draft), draft.urdf_file: draft.urdf()}
    return write_texts(folder, texts, overwrite)


def mechanism_text(draft: Draft) -> str:
    """Return the text of ``mechanism.toml``, with what was guessed and left out as comments."""
    lines = [*_comment(f"Imported from {draft.origin}. Read it, correct it, keep it."), ""]
    for title, items in (("Guessed", draft.guessed), ("Left out", draft.left_out)):
        if items:
            lines += [f"# {title}:", *(line for item in items for line in _comment(item, "#   - ", "#     ")), ""]
    spec = draft.spec()
    lines += [f"name = {_value(spec.name)}", f"urdf = {_value(draft.urdf_file)}", f"gravity = {_value(spec.gravity)}"]
    if draft.independent is not None:
        lines += _comment(draft.why_independent) + _list("independent", draft.independent)
    if spec.actuated is not None:
        lines += _list("actuated", spec.actuated)
    if draft.q_guess:
        lines += ["", "[q_guess]", *(f"{_key(k)} = {_value(v)}" for k, v in draft.q_guess.items())]
    tables: dict[str, Sequence[tuple[msgspec.Struct, str]]] = {
        "loop": draft.loops,
        "coupling": draft.couplings,
        "spring": draft.springs,
        "force": draft.forces,
        "joint": draft.joints,
        "motor": draft.motors,
        "point": draft.points,
    }
    for table, noted in tables.items():
        for entry, comment in noted:
            lines += ["", *_comment(comment), f"[[{table}]]", *_entries(entry)]
    if not draft.loops:
        lines += ["", *_example(draft)]
    return "\n".join(lines) + "\n"


def _example(draft: Draft) -> Iterator[str]:
    """Yield a loop to fill in, commented out, between links that nothing hangs on."""
    names = [link.get("name", "") for link in draft.robot.findall("link")]
    parents = {parent.get("link") for parent in draft.robot.iterfind("joint/parent")}
    ends = [name for name in names if name not in parents]
    other = ends[-2] if len(ends) > 1 else names[0]
    yield from _comment(f"No loop is closed. A table like this one closes one; type is one of {', '.join(LOOP_TYPES)}:")
    yield "# [[loop]]"
    table = {"name": "closed", "type": "hinge"}
    yield from (f"# {key} = {_value(value)}" for key, value in table.items())
    for key, end in (("frame_a", ends[-1]), ("frame_b", other)):
        yield f"# {key} = {{link = {_value(end)}, xyz = [0.0, 0.0, 0.0], rpy = [0.0, 0.0, 0.0]}}"
    yield from (f"# axis_{end} = [0.0, 0.0, 1.0]" for end in "ab")


def _entries(spec: msgspec.Struct) -> Iterator[str]:
    """Yield the keys of a structure that differ from their defaults."""
    for field in msgspec.structs.fields(spec):
        value = getattr(spec, field.name)
        made = field.default_factory
        if field.required or value != (field.default if made is msgspec.NODEFAULT else made()):
            yield f"{_key(field.encode_name)} = {_value(value)}"


def _list(key: str, names: Iterable[str]) -> list[str]:
    """Return a list of names, broken where it is long."""
    whole = f"{key} = {_value(list(names))}"
    if len(whole) <= WIDTH:
        return [whole]
    return [f"{key} = [", *(f"    {_value(name)}," for name in names), "]"]


def _value(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float | int):
        return repr(float(value))
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(x) for x in value)}]"
    keys = {f.encode_name: getattr(value, f.name) for f in msgspec.structs.fields(value)}
    shown = ", ".join(f"{_key(k)} = {_value(v)}" for k, v in keys.items() if isinstance(v, str) or any(v))
    return f"{{{shown}}}"


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _comment(text: str, first: str = "# ", rest: str = "# ") -> list[str]:
    """Return a text as comment lines; control characters, which could end a comment, become spaces."""
    lines, line = [], ""
    for word in re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029]+", " ", text).split():
        if line and len(line) + len(word) + len(rest) > WIDTH:
            lines.append(line)
            line = ""
        line = f"{line} {word}" if line else word
    lines += [line] if line else []
    return [f"{rest if k else first}{line}" for k, line in enumerate(lines)]
