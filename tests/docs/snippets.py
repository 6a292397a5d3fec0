"""Run the code blocks of a page, in their order, in one folder and one Python namespace.

=================  =====================================================================================
language           what is done
=================  =====================================================================================
``python``         executed
``sh``             commands of the program are run; ``# exit code 2`` expects that exit code
``toml``, ``xml``  written to a file if the first line is a comment with its name; other TOML is validated as part of
                   a scene or a mechanism
``text``           compared with the output of the last command; ``...`` stands for the rest of a line, or for lines
``console``        not run
=================  =====================================================================================
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

from ckc_pin.base.toml import join_dotted_keys
from ckc_pin.mechanism.spec import MechanismSpec
from ckc_pin.scene.spec import SceneSpec
from tests.contract.helpers.command import ckc

BLOCK = re.compile(r"^( *)(```+|~~~+)(\{?[\w-]+\}?)[^\n]*\n(.*?)^\1\2 *$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^(?:#|<!--) ([\w./-]+\.(?:toml|urdf|xml|csv))\b")
SHOWN = {"console", "csv", "bibtex", "json"}
SERVERS = (
    "ckc explore",
    "ckc play",
    "ckc run five_bar/swing --meshcat",
)  # open a server and wait: only their --help is run


@dataclass(frozen=True)
class Snippet:
    """A code block: its first line, its language and its text."""

    line: int
    language: str
    text: str


def snippets(page: str) -> list[Snippet]:
    """Return the code blocks of a page in order, without directives."""
    blocks = []
    for match in BLOCK.finditer(page):
        indent, language = match[1], match[3]
        if not language.startswith("{"):
            text = "".join(line.removeprefix(indent) for line in match[4].splitlines(keepends=True))
            blocks.append(Snippet(page.count("\n", 0, match.start()) + 1, language, text))
    return blocks


def run(snippet: Snippet, space: dict[str, Any]) -> None:
    """Run a code block in the working directory; raise AssertionError if it does not do what the page shows."""
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
            assert language == "toml", "an XML block begins with <!-- FILE -->"
            check_part(text)
    else:
        assert language in SHOWN, f"line {snippet.line}: unknown language {language!r}"


def check_printed(shown: str, printed: str) -> None:
    """Check that the output contains the lines shown, in that order."""
    lines = [re.escape(line).replace(r"\.\.\.", "[^\n]*") for line in shown.splitlines()]
    pattern = "\n".join(".*" if line.strip(r"\ ") == "[^\n]*" else line for line in lines)
    assert re.search(pattern, printed, re.DOTALL), f"shown:\n{shown}\nprinted:\n{printed}"


def _line(line: str) -> str:
    """Run commands joined by &&, with their ``cd``; return the output of the last one."""
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
    """Run a command and return its output."""
    words = shlex.split(line, comments=True)
    if not words or words[0].startswith("./scripts/") or words[0] in ("pip", "git", "cd"):
        return ""
    assert words[0] == "ckc", f"not a ckc command: {line}"
    if line.startswith(SERVERS) and "--html" not in words:
        assert ckc(words[1], "--help").code == 0
        return ""
    expected = re.search(r"# exit code (\d)", line)
    result = ckc(*words[1:])
    assert result.code == int(expected[1] if expected else 0), f"{line}\n{result.err}"
    return result.out


def check_part(text: str) -> None:
    """Validate keys as part of a scene, a mechanism or a controller."""
    data = tomllib.loads(text)
    for table in (("initial", "q"), ("initial", "q_dot"), ("controller", "q_d"), ("q_guess",)):
        join_dotted_keys(data, *table)
    scene = {"mechanism": "mechanism.toml", "formulation": "dae", "t_end": 1.0}
    controller = {"type": "tracking", "Lambda": 1.0, "K_D": 1.0, "desired": {}}
    if "controller" in data and "type" not in data["controller"]:
        data["controller"] = controller | data["controller"]
    is_scene = set(data) <= {field.encode_name for field in msgspec.structs.fields(SceneSpec)}
    if is_scene:
        msgspec.convert(scene | data, SceneSpec)
    else:
        msgspec.convert({"name": "mine", "urdf": "mine.urdf"} | data, MechanismSpec)
