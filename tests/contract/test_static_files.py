"""Lint of the static files of the player and the explorer: JavaScript, CSS and HTML, and that they fit together."""

from __future__ import annotations

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from playwright._impl._driver import compute_driver_executable

from ckc_pin.explorer.page import STATIC as EXPLORE
from ckc_pin.explorer.page import read_explore_script, render_explore_page
from ckc_pin.view.page import STATIC as VIEW
from ckc_pin.view.page import read_live_script

FILES = sorted([*VIEW.iterdir(), *EXPLORE.iterdir()])
SCRIPTS = [path for path in FILES if path.suffix == ".js"]
SHARED = VIEW / "viewer.js"
# Page, style and scripts that belong together.
PAGES = {
    "player": (VIEW / "page.html", VIEW / "player.css", [path for path in SCRIPTS if path.parent == VIEW]),
    "explorer": (EXPLORE / "explore.html", EXPLORE / "explore.css",
                 [SHARED, *(path for path in SCRIPTS if path.parent == EXPLORE)]),
}  # fmt: skip
REPORT = VIEW / "report.html"  # with its style inside, and without scripts
VOID_ELEMENTS = {"meta", "link", "input"}
MAX_LINE_LENGTH = 120
UNSAFE = re.compile(r"\b(eval|innerHTML|outerHTML|insertAdjacentHTML|document\.write|new Function)\b")
FUNCTION = re.compile(r"\bfunction (\w+)\(")
BINDING = re.compile(r"\b(?:const|let|var) (\w+)")


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


def check_elements(page: Path) -> ElementChecker:
    checker = ElementChecker()
    checker.feed(page.read_text(encoding="utf-8"))
    checker.close()
    return checker


def test_all_static_files_are_checked() -> None:
    belonging = {path for page, style, scripts in PAGES.values() for path in (page, style, *scripts)}
    assert belonging | {REPORT} == set(FILES)


def test_report_closes_its_elements_and_runs_no_scripts() -> None:
    assert not check_elements(REPORT).errors
    text = REPORT.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "<script" not in text


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
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


@pytest.mark.parametrize("name", PAGES)
def test_names_in_scripts_are_used(name: str) -> None:
    script = remove_comments("".join(path.read_text(encoding="utf-8") for path in PAGES[name][2]))
    for used in FUNCTION.findall(script) + BINDING.findall(script):
        assert len(re.findall(rf"(?<![\w$]){used}(?![\w$])", script)) > 1, used


def test_scripts_are_strict() -> None:
    for script in (read_live_script(), read_explore_script()):
        assert remove_comments(script).strip().startswith('"use strict";')


@pytest.mark.parametrize("name", PAGES)
def test_html_elements_are_closed_and_ids_unique(name: str) -> None:
    checker = check_elements(PAGES[name][0])
    assert (checker.errors, checker.open_tags) == ([], [])
    assert len(checker.ids) == len(set(checker.ids))


@pytest.mark.parametrize("name", PAGES)
def test_ids_in_scripts_and_styles_exist_in_the_page(name: str) -> None:
    page, style, scripts = PAGES[name]
    ids = set(check_elements(page).ids) | {"scene"}  # a saved page has its scene in an element of its own
    for path in scripts:
        script = path.read_text(encoding="utf-8")
        used = re.findall(r"(?:\belement|getElementById|connectButton|cloneTemplate)\(\"([\w-]+)\"", script)
        used += re.findall(r"#([a-z][\w-]*)\)", script)
        assert set(used) <= ids, path.name
    selectors = "".join(re.findall(r"[^{}]*(?=\{)", style.read_text(encoding="utf-8")))
    assert set(re.findall(r"#([a-z][\w-]*)", selectors)) <= ids


def test_every_button_of_the_explorer_does_something() -> None:
    buttons = re.findall(r'<button id="([\w-]+)"', (EXPLORE / "explore.html").read_text(encoding="utf-8"))
    script = read_explore_script()
    assert len(buttons) > 15
    for button in set(buttons) - {"help-close"}:  # closes its dialog by itself
        assert re.search(rf'^    "?{button}"?: ', script, re.MULTILINE), button


def test_title_of_the_explorer_is_escaped() -> None:
    page = render_explore_page("</title><script>alert(1)</script> $style")
    assert "<script>alert" not in page
    assert "&lt;/title&gt;&lt;script&gt;alert(1)&lt;/script&gt; $style" in page


@pytest.mark.parametrize("name", PAGES)
def test_css_blocks_and_declarations_are_complete(name: str) -> None:
    css = re.sub(r"/\*.*?\*/", "", PAGES[name][1].read_text(encoding="utf-8"), flags=re.DOTALL)
    depth = 0
    for brace in re.findall(r"[{}]", css):
        depth += 1 if brace == "{" else -1
        assert 0 <= depth <= 2
    assert depth == 0
    blocks = re.findall(r"\{([^{}]*)\}", css)
    assert blocks
    for block in blocks:
        assert re.fullmatch(r"(\s*[a-z-]+: [^;{}:]+;)+\s*", block), block
