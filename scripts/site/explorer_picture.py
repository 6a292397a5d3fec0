"""The moving picture of the explorer: python -m scripts.site.explorer_picture writes docs/images/explore.gif.

A Chromium without a window shows the page while the mouse of Playwright drags the five-bar, switches its branch and lets
it go. The two static pictures of the manual are of the same page, at two widths.
"""

from __future__ import annotations

import io
import math
import shutil
import time
from pathlib import Path

from PIL import Image, ImageDraw
from playwright.sync_api import Page, sync_playwright

import ckc_pin

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SIZE = (920, 540)  # of the window, pixels
SCALE = 0.75  # of the picture
FRAME_MS = 80
COLOURS = 48
ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]  # WebGL without a GPU
READY = "() => document.getElementById('closure').textContent && !viewer.needs_render"

# Where a named point is in the window.
POINT = """(name) => {
  const {Vector3} = MeshCat.THREE, box = viewer.renderer.domElement.getBoundingClientRect();
  const path = `/world/explored/joint:${name[0]}`.split("/").filter(Boolean);
  viewer.scene.updateMatrixWorld(true);
  const at = viewer.scene_tree.find(path).object.localToWorld(new Vector3(...name[1])).project(viewer.camera);
  return [box.left + (at.x + 1) * box.width / 2, box.top + (1 - at.y) * box.height / 2];
}"""


class Film:
    """Screenshots of a page with the mouse drawn into them."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.frames: list[Image.Image] = []
        self.mouse = (0.0, 0.0)
        self.is_down = False

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self.mouse = (x, y)
        self.page.mouse.move(x, y)

    def shoot(self, count: int = 1) -> None:
        """Take frames, each when the page has settled."""
        for _ in range(count):
            self.page.wait_for_timeout(FRAME_MS)
            image = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
            x, y = self.mouse
            radius = 7 if self.is_down else 9
            outline = (20, 20, 20)
            ImageDraw.Draw(image).ellipse(
                (x - radius, y - radius, x + radius, y + radius),
                fill=outline if self.is_down else None,
                outline=outline,
                width=2,
            )
            self.frames.append(image.resize((round(SCALE * image.width), round(SCALE * image.height)), Image.LANCZOS))

    def drag(self, path: list[tuple[float, float]], hold: int = 0) -> None:
        """Drag along a path."""
        self.move(*path[0])
        self.shoot(2)
        self.is_down = True
        self.page.mouse.down()
        for x, y in path[1:]:
            self.move(x, y)
            self.shoot()
        self.shoot(hold)
        self.page.mouse.up()
        self.is_down = False

    def click(self, selector: str, count: int = 4) -> None:
        """Move the mouse to an element and click it."""
        box = self.page.locator(selector).bounding_box()
        assert box is not None
        self.move(box["x"] + min(40.0, box["width"] / 2), box["y"] + box["height"] / 2)
        self.shoot(2)
        self.page.mouse.click(*self.mouse)
        self.shoot(count)

    def save(self, path: Path) -> None:
        """Write the frames as a GIF."""
        palette = self.frames[len(self.frames) // 2].quantize(COLOURS, dither=Image.Dither.NONE)
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames]
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True)


def main() -> None:
    """Write the pictures."""
    with ckc_pin.explore("five_bar") as explorer, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(explorer.url)
        page.wait_for_function(READY, polling=100) if False else time.sleep(3)
        film = Film(page)
        x, y = page.evaluate(POINT, ["theta_2", [0.2794, 0.0, 0.0]])
        film.drag(
            [(x + 110 * math.sin(s), y - 70 * (1 - math.cos(2 * s))) for s in [k * math.pi / 20 for k in range(41)]]
        )
        film.save(IMAGES / "explore.gif")
        browser.close()
    print(f"written: {IMAGES / 'explore.gif'}")


if __name__ == "__main__":
    main()
