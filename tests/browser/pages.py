"""Pages in a headless Chromium, with their errors and requests."""

from __future__ import annotations

import os
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

__all__ = ["Tabs", "Visit", "browser", "look_at", "tabs"]

NAMES = ("chromium", "chromium-browser", "google-chrome", "/Applications/Chromium.app/Contents/MacOS/Chromium")
# WebGL without a GPU. Other parts of pages are drawn faster without it. Antialiasing takes a third of
# the processor time of a frame, and no test looks at edges.
SOFTWARE = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",
    "--webgl-antialiasing-mode=none",
]
SANDBOX = [] if os.getuid() else ["--no-sandbox"]  # Chromium's own does not run as root
PATIENCE = 60.0  # s

# Objects of meshcat's tree by path, their placements in the axes of /world, and what is seen of them.
TREE = """() => {
  const objects = {};
  viewer.scene.updateMatrixWorld(true);
  const world = viewer.scene_tree.find(["world"]).object.matrixWorld.clone().invert();
  (function walk(node, path) {
    for (const [name, child] of Object.entries(node.children)) {
      const one = child.object, here = path + "/" + name;
      objects[here] = {
        type: one.type, visible: one.visible,
        matrix: world.clone().multiply(one.matrixWorld).elements,
        opacity: one.material ? one.material.opacity : null,
        color: one.material && one.material.color ? one.material.color.getHex() : null,
        corners: one.geometry ? one.geometry.attributes.position.count : null,
      };
      walk(child, here);
    }
  })(viewer.scene_tree, "");
  return objects;
}"""

# Moves the time slider and says where objects are then.
SEEK = """([times, paths]) => {
  viewer.animator.pause();
  const world = viewer.scene_tree.find(["world"]).object;
  return times.map(time => {
    viewer.animator.seek(time);
    viewer.scene.updateMatrixWorld(true);
    const back = world.matrixWorld.clone().invert();
    return paths.map(path => {
      const one = viewer.scene_tree.find(path.split("/").filter(Boolean)).object;
      return back.clone().multiply(one.matrixWorld).elements;
    });
  });
}"""


class Visit:
    """A page, what it logged, and what it asked for."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self._listeners: dict[Any, Callable[[Any], None]] = {
            "console": lambda message: self.complaints.append(f"{message.type}: {message.text}"),
            "pageerror": lambda error: self.complaints.append(f"error: {error}"),
            "crash": lambda _: self.complaints.append("crash"),
            "request": lambda request: self.requests.append(request.url),
            "websocket": lambda connection: self.requests.append(connection.url),
        }
        for event, listener in self._listeners.items():
            page.on(event, listener)

    def leave(self) -> None:
        """Stop listening, release the mouse, and leave the page."""
        for event, listener in self._listeners.items():
            self.page.remove_listener(event, listener)
        self.page.mouse.up()
        self.page.mouse.move(0, 0)
        self.page.goto("about:blank")

    def until(self, condition: str) -> None:
        """Wait for something to be true; the page's policy forbids that the browser itself evaluates it."""
        deadline = time.monotonic() + PATIENCE
        while not self.page.evaluate(f"() => Boolean({condition})"):
            assert time.monotonic() < deadline, f"{condition}; {self.complaints}"
            time.sleep(0.05)

    def tree(self) -> dict[str, dict[str, Any]]:
        """Objects by path."""
        objects: dict[str, dict[str, Any]] = self.page.evaluate(TREE)
        return objects

    def placements(self, times: np.ndarray, paths: list[str]) -> np.ndarray:
        """Placements (times, paths, 4, 4) in the axes of /world."""
        columns = self.page.evaluate(SEEK, [times.tolist(), paths])
        return np.swapaxes(np.array(columns).reshape(len(times), len(paths), 4, 4), 2, 3)

    def caption(self) -> list[str]:
        """The lines of words on the page."""
        return [line for line in self.page.locator("#caption").inner_text().splitlines() if line]


class Tabs:
    """Tabs that are used again, in which a page is loaded in a third of the time that it takes in a new one."""

    def __init__(self, browser: Browser) -> None:
        self._contexts = {has_touch: browser.new_context(has_touch=has_touch) for has_touch in (False, True)}
        self._free: defaultdict[BrowserContext, list[Page]] = defaultdict(list)

    def visit(self, size: tuple[int, int], *, offline: bool = False, has_touch: bool = False) -> Visit:
        """Return a blank page."""
        context = self._contexts[has_touch]
        context.set_offline(offline)
        page = self._free[context].pop() if self._free[context] else context.new_page()
        page.set_viewport_size({"width": size[0], "height": size[1]})
        return Visit(page)

    def leave(self, visit: Visit) -> None:
        """Leave a page, whose tab is free then."""
        visit.leave()
        self._free[visit.page.context].append(visit.page)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests of a file."""
    where = next(filter(None, map(shutil.which, NAMES)), None)
    assert where is not None, "no Chromium here: ./scripts/chromium installs it or says how"
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=where, args=[*SOFTWARE, *SANDBOX])
        yield started
        started.close()


@pytest.fixture(scope="module")
def tabs(browser: Browser) -> Tabs:
    """Tabs for all tests of a file."""
    return Tabs(browser)


@pytest.fixture
def look_at(tabs: Tabs) -> Iterator[Callable[..., Visit]]:
    """Open an address, wait for its scene, and find at the end that the page has not complained about anything."""
    visits: list[Visit] = []

    def open_page(
        url: str,
        until: str = "viewer.animator.actions.length",
        offline: bool = False,
        size: tuple[int, int] = (960, 540),
        has_touch: bool = False,
    ) -> Visit:
        visits.append(tabs.visit(size, offline=offline, has_touch=has_touch))
        visits[-1].page.goto(url)
        visits[-1].until(f"window.viewer && {until}")
        return visits[-1]

    yield open_page
    complaints = [visit.complaints for visit in visits]
    for visit in visits:
        tabs.leave(visit)
    assert not any(complaints), complaints
