"""The site builds without warnings, has no broken links, loads nothing from the network, and its search finds units."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from scripts.site.gallery import ROOT, examples
from scripts.site.links import broken
from tests.browser.pages import PATIENCE, browser

__all__ = ["browser"]  # a fixture


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-d",
        out.as_posix() + "-trees",
        "docs",
        str(out),
    ]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return out


def test_site_has_no_broken_links(site: Path) -> None:
    assert broken(site) == []


def test_broken_link_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<p id="here"><a href="b.html">b</a><a href="a.html#there">c</a><a href="#here">d</a>'
    )
    assert broken(tmp_path) == ["a.html: b.html: no such file", "a.html: a.html#there: no such anchor"]


def test_docstrings_are_rendered_unchanged(site: Path) -> None:
    page = re.sub(r"<[^>]+>", "", (site / "reference" / "api.html").read_text(encoding="utf-8"))
    assert "Values by dotted key, e.g. " in page
    assert "Largest |phi - w| and |phi_dot - w_dot| over the output instants." in page
    assert "!! processed by numpydoc !!" not in page


def test_pages_load_nothing_from_the_network(site: Path) -> None:
    pages = [path.read_text(encoding="utf-8") for path in site.rglob("*.html")]
    assert len(pages) > 30
    remote = [
        m
        for page in pages
        for m in re.findall(r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"(https?:[^\"]*)", page)
    ]
    assert remote == []


def test_gallery_has_every_example(site: Path) -> None:
    page = (site / "gallery.html").read_text(encoding="utf-8")
    assert [
        example.name for example in examples() if f'id="example-{example.name.replace("_", "-")}"' not in page
    ] == []


def test_search_finds_key_by_its_unit(site: Path, browser: Browser) -> None:
    """Searched from disk, in a browser without network; the result links to the key."""
    page = browser.new_context(offline=True).new_page()
    page.goto(f"{(site / 'search.html').as_uri()}?q=rad%2Fs")
    result = page.locator("#search-results li a", has_text="frequency [rad/s]").first
    result.wait_for(timeout=PATIENCE * 1e3)
    result.click()
    page.wait_for_url("**/reference/scene.html*")
    key = page.evaluate("document.getElementById(decodeURIComponent(location.hash.slice(1))).textContent")
    assert "frequency" in key
    assert "rad/s" in key
    page.context.close()
