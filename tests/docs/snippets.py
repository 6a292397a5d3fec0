"""Pieces of code in a page: commands and Python are run, files are written and read, keys are checked.

In a page's order, in one folder and one namespace. A TOML or XML piece whose first line is a comment with a file's
name is that file; a TOML piece without is checked as part of a scene or a mechanism. ``text`` is what the last command
before it prints, ``...`` standing for the rest of a line or for lines. ``console`` is only shown.
"""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ckc_pin.base.toml import by_coordinate
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.scene.spec import SceneSpec
from tests.contract.helpers.command import ckc

BLOCK = re.compile(r"^( *)(```+|~~~+)(\{?[\w-]+\}?)[^\n]*\n(.*?)^\1\2 *$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^(?:#|<!--) ([\w./-]+\.(?:toml|urdf|xml|csv))\b")
SHOWN = {"console", "csv", "bibtex", "json"}
FOREIGN = ("ckc play", "ckc run five_bar/swing --meshcat")  # they open a server, and wait


@dataclass(frozen=True)
class Snippet:
    """A piece: where it begins, its language, its text."""

    line: int
    language: str
    text: str


def snippets(page: str) -> list[Snippet]:
    """Return a page's pieces in order; directives are none."""
    found = []
    for match in BLOCK.finditer(page):
        indent, language = match[1], match[3]
        if not language.startswith("{"):
            text = "".join(line.removeprefix(indent) for line in match[4].splitlines(keepends=True))
            found.append(Snippet(page.count("\n", 0, match.start()) + 1, language, text))
    return found


def run(snippet: Snippet, space: dict[str, Any]) -> None:
    """Run a piece in the working directory; AssertionError where it is not as it says."""
    language, text = snippet.language, snippet.text
    if language == "python":
        exec(compile(text, f"line {snippet.line}", "exec"), space)
    elif language == "sh":
        for line in text.replace("\\\n", " ").splitlines():
            space["printed"] = _line(line) or space.get("printed", "")
    elif language == "text":
        check_printed(text, space["printed"])
    elif language in ("toml", "xml"):
        named = FILE.match(text)
        if named:
            path = Path(named[1])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        else:
            assert language == "toml", "an XML piece begins with <!-- FILE -->"
            check_part(text)
    else:
        assert language in SHOWN, f"line {snippet.line}: no language {language!r}"


def check_printed(shown: str, printed: str) -> None:
    """Check that what is shown was printed, in that order."""
    lines = [re.escape(line).replace(r"\.\.\.", "[^\n]*") for line in shown.splitlines()]
    wanted = "\n".join(".*" if line.strip(r"\ ") == "[^\n]*" else line for line in lines)
    assert re.search(wanted, printed, re.DOTALL), f"shown:\n{shown}\nprinted:\n{printed}"


def _line(line: str) -> str:
    """Run commands joined by &&, in the folders that they change to; return what the last one prints."""
    printed = ""
    parts = line.split(" && ")
    with chdir("."):
        for part in parts:
            if part.startswith("cd ") and len(parts) > 1:
                os.chdir(part.removeprefix("cd "))
            else:
                printed = _command(part)
    return printed


def _command(line: str) -> str:
    """Run a command, and return what it prints."""
    words = shlex.split(line, comments=True)
    if not words or words[0].startswith("./scripts/") or words[0] in ("pip", "git", "cd"):
        return ""
    assert words[0] == "ckc", f"not a command of the program: {line}"
    if line.startswith(FOREIGN) and "--html" not in words:
        assert ckc(words[1], "--help").code == 0
        return ""
    wanted = re.search(r"# exit code (\d)", line)
    found = ckc(*words[1:])
    assert found.code == int(wanted[1] if wanted else 0), f"{line}\n{found.err}"
    return found.out


def check_part(text: str) -> None:
    """Check keys as part of a scene, of a mechanism, or of a controller."""
    data = tomllib.loads(text)
    for table in (("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("q_guess",)):
        by_coordinate(data, *table)
    scene = {"mechanism": "mechanism.toml", "formulation": "dae", "t_end": 1.0}
    controller = {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": {}}
    if "controller" in data and "type" not in data["controller"]:
        data["controller"] = controller | data["controller"]
    is_scene = set(data) <= {field.encode_name for field in msgspec.structs.fields(SceneSpec)}
    if is_scene:
        msgspec.convert(scene | data, SceneSpec)
    else:
        msgspec.convert({"name": "mine", "urdf": "mine.urdf"} | data, MechanismSpec)
