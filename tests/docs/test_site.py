"""The site builds without warnings, has no broken links, loads nothing from the network, and its search finds units."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote, urlsplit

import pytest
from docutils import nodes
from playwright.sync_api import Page

from scripts.site.gallery import ROOT, examples
from scripts.site.links import broken
from scripts.site.search_texts import read_page_text
from tests.browser.pages import PATIENCE, Tabs, browser, tabs

__all__ = ["browser", "tabs"]  # fixtures


@pytest.fixture
def page(tabs: Tabs) -> Iterator[Page]:
    """A tab without network."""
    visit = tabs.visit((1280, 900), offline=True)
    yield visit.page
    tabs.leave(visit)


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


def test_gallery_shows_thumbnails_sharply(site: Path, page: Page) -> None:
    page.goto((site / "gallery.html").as_uri())
    sizes = page.evaluate(
        """() => Array.from(document.querySelectorAll(".sd-card-img-top")).map(i => [i.naturalWidth, i.clientWidth])"""
    )
    assert len(sizes) == len(examples())
    assert all(2 * shown <= natural for natural, shown in sizes)


def test_search_finds_key_by_its_unit(site: Path, page: Page) -> None:
    """Searched from disk, in a browser without network; the result links to the key."""
    page.goto(f"{(site / 'search.html').as_uri()}?q=rad%2Fs")
    result = page.locator("#search-results li a", has_text="frequency [rad/s]").first
    result.wait_for(timeout=PATIENCE * 1e3)
    result.click()
    page.wait_for_url("**/reference/scene.html*")
    key = page.evaluate("document.getElementById(decodeURIComponent(location.hash.slice(1))).textContent")
    assert "frequency" in key
    assert "rad/s" in key


def search(site: Path, page: Page, query: str) -> list[dict[str, str]]:
    """Search from disk; return title, excerpt and address of each result."""
    page.goto(f"{(site / 'search.html').as_uri()}?q={quote(query)}")
    page.locator("#search-results li").first.wait_for(timeout=PATIENCE * 1e3)
    page.get_by_text("Search finished").wait_for(timeout=PATIENCE * 1e3)
    results: list[dict[str, str]] = page.evaluate(
        """() => Array.from(document.querySelectorAll("#search-results li")).map(item => ({
             title: item.querySelector("a").textContent, address: item.querySelector("a").href,
             excerpt: item.querySelector("p.context").textContent}))"""
    )
    return results


def test_search_from_disk_shows_excerpts_with_the_query(site: Path, page: Page) -> None:
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    for query in ("rad/s", "friction", "--video"):
        results = search(site, page, query)
        assert results
        assert [r for r in results if query not in f"{r['title']} {r['excerpt']}".lower()] == []
        assert [r for r in results if not 10 < len(r["excerpt"]) <= 250] == []
    assert [url for url in requests if not url.startswith("file:")] == []


def test_search_for_a_unit_ranks_keys_of_that_unit_first(site: Path, page: Page) -> None:
    """Pages that have "rad" and an "s" somewhere are not results, nor are keys in rad/s² alone."""
    results = search(site, page, "rad/s")
    is_key = ["rad/s" in result["title"] for result in results]
    assert sum(is_key) > 5
    assert is_key == sorted(is_key, reverse=True)
    assert not [result for result in results if "rad/s²" in result["title"]]
    for result in results[sum(is_key) :]:
        file = urlsplit(result["address"]).path
        assert re.search(r"rad/s(?![²\w])", re.sub(r"<[^>]+>", "", Path(file).read_text(encoding="utf-8")))
    assert search(site, page, "friction")[0]["title"].startswith("joint.friction")


@pytest.mark.parametrize("width", [390, 1100, 1280, 1600])
def test_no_line_of_code_is_cut_off(site: Path, page: Page, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 900})
    for path in ("start.html", "gallery.html", "guide/events.html", "guide/control.html", "reference/errors.html"):
        page.goto((site / path).as_uri())
        cut = page.evaluate(
            """() => Array.from(document.querySelectorAll("pre")).filter(block => block.scrollWidth > block.clientWidth)
                 .map(block => block.textContent.slice(0, 80))"""
        )
        assert cut == []
        assert page.evaluate("document.documentElement.scrollWidth") == width


def test_anchors_of_page_texts_are_where_their_text_begins() -> None:
    section = nodes.section("", nodes.title("", "Second part"), nodes.paragraph("", "has x^2 rad/s."), ids=["second"])
    doctree = nodes.document(None, None)
    doctree += [nodes.title("", "First"), nodes.math_block("", "x^2"), section]
    assert read_page_text(doctree) == {"text": "First\nSecond part\nhas x^2 rad/s.", "anchors": {"second": 6}}
