"""Lint of the player's static files: JavaScript, CSS and HTML, and that they fit together."""

from __future__ import annotations

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from playwright._impl._driver import compute_driver_executable

from ckc_pin.view.page import STATIC, read_live_script

SCRIPTS = sorted(STATIC.glob("*.js"))
VOID_ELEMENTS = {"meta", "link", "input"}
MAX_LINE_LENGTH = 120
UNSAFE = re.compile(r"\b(eval|innerHTML|outerHTML|insertAdjacentHTML|document\.write|new Function)\b")
FUNCTION = re.compile(r"\bfunction (\w+)\(")
BINDING = re.compile(r"\b(?:const|let|var) (\w+)")


def read_page() -> str:
    return (STATIC / "page.html").read_text(encoding="utf-8")


def remove_comments(script: str) -> str:
    return re.sub(r"(?m)(^|\s)//.*$", "", script)


class ElementChecker(HTMLParser):
    """Collects ids, and the tags that are not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.open_tags: list[str] = []
        self.errors: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID_ELEMENTS:
            self.open_tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open_tags or self.open_tags.pop() != tag:
            self.errors.append(f"</{tag}> at {self.getpos()}")


def find_ids() -> set[str]:
    checker = ElementChecker()
    checker.feed(read_page())
    return set(checker.ids)


def test_all_static_files_are_checked() -> None:
    assert {path.name for path in STATIC.iterdir()} == {"live.js", "page.html", "player.css", "player.js", "saved.js"}


@pytest.mark.parametrize("path", sorted(STATIC.iterdir()), ids=lambda path: path.name)
def test_lines_are_short_and_clean(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.endswith("\n")
    for line in text.splitlines():
        assert len(line) <= MAX_LINE_LENGTH, line
        assert line == line.rstrip(), line
        assert "\t" not in line, line


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_valid_javascript(path: Path) -> None:
    """Node comes with Playwright, which the browser tests use."""
    node, _ = compute_driver_executable()
    check = subprocess.run([node, "--check", str(path)], capture_output=True, text=True, check=False)
    assert (check.returncode, check.stderr) == (0, "")


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_do_not_parse_text_as_code_or_html(path: Path) -> None:
    assert UNSAFE.findall(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_can_be_inlined(path: Path) -> None:
    """A saved page contains its scripts between script tags."""
    assert re.search(r"</?script|<!--", path.read_text(encoding="utf-8"), re.IGNORECASE) is None


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_names_in_scripts_are_used(path: Path) -> None:
    script = remove_comments(path.read_text(encoding="utf-8"))
    for name in FUNCTION.findall(script) + BINDING.findall(script):
        uses = len(re.findall(rf"(?<![\w$]){name}(?![\w$])", script))
        assert uses > 1 or name in ("player", "showStatus"), name  # the starting scripts use those two


def test_scripts_are_strict() -> None:
    assert remove_comments(read_live_script()).strip().startswith('"use strict";')


def test_html_elements_are_closed_and_ids_unique() -> None:
    checker = ElementChecker()
    checker.feed(read_page())
    checker.close()
    assert (checker.errors, checker.open_tags) == ([], [])
    assert len(checker.ids) == len(set(checker.ids))


def test_ids_in_scripts_and_styles_exist_in_the_page() -> None:
    ids = find_ids() | {"scene"}  # a saved page has its scene in an element of its own
    for path in SCRIPTS:
        script = path.read_text(encoding="utf-8")
        used = re.findall(r"(?:\belement|getElementById|connectButton)\(\"([\w-]+)\"", script)
        used += re.findall(r"#([a-z][\w-]*)\)", script)
        assert set(used) <= ids, path.name
    css = (STATIC / "player.css").read_text(encoding="utf-8")
    selectors = "".join(re.findall(r"[^{}]*(?=\{)", css))
    assert set(re.findall(r"#([a-z][\w-]*)", selectors)) <= ids


def test_css_blocks_and_declarations_are_complete() -> None:
    css = re.sub(r"/\*.*?\*/", "", (STATIC / "player.css").read_text(encoding="utf-8"), flags=re.DOTALL)
    depth = 0
    for brace in re.findall(r"[{}]", css):
        depth += 1 if brace == "{" else -1
        assert 0 <= depth <= 2
    assert depth == 0
    blocks = re.findall(r"\{([^{}]*)\}", css)
    assert blocks
    for block in blocks:
        assert re.fullmatch(r"(\s*[a-z-]+: [^;{}:]+;)+\s*", block), block
