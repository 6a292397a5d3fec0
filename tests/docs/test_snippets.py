"""The code blocks of README and of the manual run, and print what the pages show."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.site.gallery import ROOT
from tests.docs.snippets import check_printed, run, snippets

GENERATED = {
    "paper.md",
    "errata.md",
    "stability.md",
    "published_robots.md",
    "report.md",
}  # written by experiments, without code to run
PAGES = [ROOT / "README.md"] + [path for path in sorted((ROOT / "docs").rglob("*.md")) if path.name not in GENERATED]
WITH_CODE = [path for path in PAGES if snippets(path.read_text(encoding="utf-8"))]


def test_pages_have_code() -> None:
    assert len(WITH_CODE) > 8


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_code_blocks_of_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": "page"}
    for snippet in snippets(page.read_text(encoding="utf-8")):
        try:
            run(snippet, space)
        except Exception as error:
            raise AssertionError(f"{page.name}, line {snippet.line}: {error}") from error


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ('```python\nraise ValueError("this one")\n```\n', "this one"),
        ("```sh\nckc check five_bra\n```\n", "five_bra"),
        ("```toml\n[solver]\nrtl = 1e-3\n```\n", "rtl"),
        ("```pyton\n1\n```\n", "pyton"),
    ],
)
def test_wrong_code_block_fails(text: str, wrong: str) -> None:
    (snippet,) = snippets(text)
    with pytest.raises(Exception, match=wrong):
        run(snippet, {})


@pytest.mark.parametrize("shown", ["a 1\n...\nd 4", "b ...\nc 3"])
def test_output_may_be_shown_in_part(shown: str) -> None:
    check_printed(shown, "a 1\nb 2\nc 3\nd 4\n")


@pytest.mark.parametrize("shown", ["a 1\nd 4", "d 4\n...\na 1", "b ...\nd 4", "a 2"])
def test_output_that_differs_fails(shown: str) -> None:
    with pytest.raises(AssertionError, match="shown"):
        check_printed(shown, "a 1\nb 2\nc 3\nd 4\n")
