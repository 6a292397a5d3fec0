"""The pages at the top: of this version, with the paper cited, and with links that lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import ckc_pin

ROOT = Path(__file__).resolve().parents[2]


def test_change_log_and_citation_are_of_this_version() -> None:
    assert f"\n## [{ckc_pin.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {ckc_pin.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", ["README.md", "CITATION.cff", "docs/reference.md", "docs/paper_joss/paper.bib"])
def test_the_paper_is_cited_with_author_and_title(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "Balaji" in text
    assert re.search(r"Dynamics \\?& Control of Closed Kinematic Chains", text)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/reference.md"])
def test_links_between_the_pages_lead_somewhere(page: str) -> None:
    path = ROOT / page
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    assert links
    assert [link for link in links if not (path.parent / link).exists()] == []


def test_the_first_page_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
